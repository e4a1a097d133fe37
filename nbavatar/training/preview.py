"""Pictures of an avatar in training, to look at: truth, render, opacity of the billboards, features."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from nbavatar.avatar.model import Avatar, compose
from nbavatar.avatar.region import paste
from nbavatar.data.views import Sample

__all__ = ["contact_sheet"]


def contact_sheet(avatar: Avatar, samples: Sequence[Sample], meshes: Mapping[str, Tensor]) -> np.ndarray:
    """Draw one row per view: ground truth, render, alpha of the billboards, first three features.

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
            posed, keep = avatar.pose(verts, sample.view.frame)
            camera = sample.view.viewmat.to(device), sample.K.to(device), sample.width, sample.height
            window = avatar.window(posed, keep, *camera)
            place = window.region, sample.width, sample.height
            image = compose(paste(window.colour, *place), paste(window.alpha, *place), grey)
            nb_alpha = paste(window.nb_alpha, *place).expand(3, -1, -1)
            rows.append(
                torch.cat((_truth(sample, 0.5).to(device), image, nb_alpha, _false_colour(window.features, place)), 2)
            )
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


def _false_colour(features: Tensor, place: tuple) -> Tensor:
    """First three channels, shifted so that zero is grey; fewer channels are repeated."""
    shown = features[[min(i, len(features) - 1) for i in range(3)]]
    return paste(0.5 + 0.5 * torch.tanh(shown), place[0], place[1], place[2], 0.5)
