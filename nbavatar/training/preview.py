"""Pictures of an avatar in training, to look at: truth, render, and what its kind shows beside (`panels`)."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from nbavatar.data.views import Sample
from nbavatar.methods.base import MeshAvatar

__all__ = ["contact_sheet"]


def contact_sheet(avatar: MeshAvatar, samples: Sequence[Sample], meshes: Mapping[str, Tensor]) -> np.ndarray:
    """Draw one row per view: ground truth and the avatar's panels (render, own alpha, ...).

    Args:
        avatar: the model; evaluated without gradients, its mode is restored.
        samples: views at the resolution to draw.
        meshes: vertices per part over all frames (N, V, 3) [m], on the avatar's device.

    Returns:
        uint8 (H, W, 3).
    """
    device = avatar.faces.device
    grey = torch.full((3,), 0.5, device=device)
    mode = avatar.training
    avatar.eval()
    rows = []
    with torch.no_grad():
        for sample in samples:
            verts = {part: meshes[part][sample.view.row] for part in avatar.parts}
            camera = sample.view.viewmat.to(device), sample.K.to(device), sample.width, sample.height
            panels = avatar.panels(verts, *camera, grey, sample.view.frame)
            rows.append(torch.cat((_truth(sample, 0.5).to(device), *panels), 2))
    avatar.train(mode)
    width = max(row.shape[-1] for row in rows)
    sheet = torch.cat([torch.nn.functional.pad(row, (0, width - row.shape[-1])) for row in rows], 1)
    return (sheet.clamp(0, 1) * 255.0 + 0.5).to(torch.uint8).permute(1, 2, 0).cpu().numpy()


def _truth(sample: Sample, grey: float) -> Tensor:
    image = torch.full((3, sample.height, sample.width), grey)
    height, width = sample.pixels.shape[-2:]
    window = image[:, sample.y0 : sample.y0 + height, sample.x0 : sample.x0 + width]
    window.copy_(sample.pixels[:3] + (1.0 - sample.pixels[3]) * grey)
    return image
