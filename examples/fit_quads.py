"""Fits textured quads to one photo: python examples/fit_quads.py photo.jpg fitted.png"""

import sys

import numpy as np
import torch
from PIL import Image

from nbavatar.rendering.billboards import render_billboards

photo = Image.open(sys.argv[1]).convert("RGB")
photo.thumbnail((256, 256))
target = torch.from_numpy(np.asarray(photo).copy()).permute(2, 0, 1).float() / 255
_, height, width = target.shape
torch.manual_seed(0)
count, texels = 400, 8
K = torch.tensor([[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]])
place = torch.rand(count, 3) - 0.5
means = (place * torch.tensor([1.0, height / width, 0.2]) + torch.tensor([0.0, 0.0, 1.0])).requires_grad_()
quats = (torch.tensor([1.0, 0, 0, 0]) + 0.1 * torch.randn(count, 4)).requires_grad_()
log_extents = torch.full((count, 2), -3.0, requires_grad=True)
colours = (0.5 + 0.1 * torch.randn(count, texels, texels, 3)).requires_grad_()
logits = torch.zeros(count, texels, texels, requires_grad=True)
rates = ((means, 1e-3), (quats, 1e-2), (log_extents, 1e-2), (colours, 2e-2), (logits, 5e-2))
optimizer = torch.optim.Adam([{"params": [tensor], "lr": rate} for tensor, rate in rates])
for step in range(301):
    image, _ = render_billboards(
        means, quats, log_extents.exp(), colours, logits.sigmoid(), torch.eye(4), K, width, height
    )
    loss = (image - target).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 50 == 0:
        print(f"step {step}: PSNR {-10 * loss.log10().item():.2f} dB")
Image.fromarray((image.detach().clamp(0, 1) * 255).byte().permute(1, 2, 0).numpy()).save(sys.argv[2])
