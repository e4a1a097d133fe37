"""What billboards carry and what the renderer makes of it, as pictures.

Rasterized features have more channels than a picture: their first three principal components, over the pixels that
billboards cover, are shown as red, green and blue, each from its 1st to its 99th percentile. Signs of components are
fixed (the largest loading is positive), so equal features give equal pictures.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from nbavatar.data.views import View
from nbavatar.errors import DataError
from nbavatar.methods.billboards.avatar import Avatar
from nbavatar.methods.billboards.region import paste

__all__ = ["feature_pictures", "principal_colours"]

_COVERED = 0.5


def principal_colours(features: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """First three principal components as colours, on white.

    Args:
        features: float [C, H, W], premultiplied.
        alpha: float [H, W] in [0, 1].

    Returns:
        uint8 [H, W, 3]; fewer than three channels leave the missing colours at half.
    """
    covered = alpha > _COVERED
    straight = (features / np.maximum(alpha, 1e-6)).reshape(len(features), -1).T.astype(np.float64)
    used = straight[covered.ravel()]
    height, width = alpha.shape
    colours = np.full((height * width, 3), 0.5)
    if len(used) > len(features):
        centre = used.mean(axis=0)
        _, values, axes = np.linalg.svd(used - centre, full_matrices=False)
        for channel, axis in enumerate(axes[: min(3, len(features))]):
            if values[channel] <= 1e-9 * max(values[0], 1e-30):
                continue
            axis = axis * np.sign(axis[np.abs(axis).argmax()])
            position = (straight - centre) @ axis
            low, high = np.percentile(position[covered.ravel()], (1, 99))
            colours[:, channel] = np.clip((position - low) / max(high - low, 1e-12), 0, 1)
    shown = colours.reshape(height, width, 3)
    shown = shown * alpha[..., None] + 1 - alpha[..., None]
    return np.round(np.clip(shown, 0, 1) * 255).astype(np.uint8)


def feature_pictures(avatar: Avatar, verts: Mapping[str, Tensor], view: View) -> dict[str, np.ndarray]:
    """Pictures of one view of a trained avatar.

    Args:
        avatar: billboards with or without deferred rendering.
        verts: vertices per part, float (V, 3) [m].
        view: camera.

    Returns:
        title -> uint8 [H, W, 3] or [H, W]: features, mask of the billboards, colour and opacity of the renderer,
        picture on white.

    Raises:
        DataError: an avatar of another kind, which carries no features.
    """
    if not isinstance(avatar, Avatar):
        raise DataError.of("model", expected="an avatar of billboards", found=type(avatar).__name__)
    with torch.no_grad():
        posed, keep = avatar.pose(verts)
        window = avatar.window(posed, keep, view.viewmat, view.K, view.width, view.height, roi=False)
        own = window.features[: avatar.architecture.channels]  # normals that the decoder sees are not learnt
        size = view.width, view.height
        features, nb_alpha, colour, alpha = (
            paste(values, window.region, *size).double().numpy()
            for values in (own, window.nb_alpha, window.colour, window.alpha)
        )
    picture = colour.clip(0, 1) * alpha + 1 - alpha
    return {
        "features (PCA)": principal_colours(features, nb_alpha),
        "mask": _bytes(nb_alpha),
        "colour": _bytes(colour.transpose(1, 2, 0)),
        "opacity": _bytes(alpha),
        "picture": _bytes(picture.transpose(1, 2, 0)),
    }


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)
