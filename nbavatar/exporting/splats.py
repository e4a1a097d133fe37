"""Gaussians of one frame in the columns of a 3DGS `.ply`, as the reference code of Kerbl et al. 2023 writes them.

    x y z            centre [m], world
    nx ny nz         0; viewers expect the columns
    f_dc_0..2        harmonics of degree 0: colour = 0.5 + 0.2820948 f_dc
    f_rest_0..44     higher harmonics, all 15 of red, then of green, then of blue; degrees that are not used are 0
    opacity          logit
    scale_0..2       logarithm of the standard deviation [log m]
    rot_0..3         quaternion wxyz, unit

All float32. Viewers look at files of degree 3 only, so a lower degree is filled up with zeros.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from nbavatar.errors import DataError
from nbavatar.methods.gaussians.avatar import GaussianAvatar

__all__ = ["splat_columns"]

_REST = 15  # harmonics of the degrees 1 to 3


def splat_columns(
    avatar: GaussianAvatar, verts: Mapping[str, Tensor], frame: str | None = None
) -> dict[str, np.ndarray]:
    """Columns of the Gaussians of an avatar on one frame's meshes; see the module.

    Args:
        avatar: of a method with Gaussians.
        verts: vertices per part, float (V, 3) [m]; Gaussians of a part that is missing or not finite are left out.
        frame: id of the frame.

    Returns:
        Property -> float32 [N], in the order of the file.

    Raises:
        DataError: the avatar has no Gaussians.
    """
    if not isinstance(avatar, GaussianAvatar):
        raise DataError.of(
            "splats", "method", expected="a method of Gaussians", found=avatar.method,
            fix="billboards are no Gaussians: export --to billboards, tensors or decoder",
        )  # fmt: skip
    with torch.no_grad():
        posed = avatar.pose(avatar.anchor(verts, frame))
        harmonics = avatar.appearance(posed)[1]
        used = (int(avatar.degree) + 1) ** 2 - 1
        rest = torch.zeros(len(posed.means), 3, _REST)
        rest[:, :, :used] = harmonics[:, 1 : 1 + used].transpose(1, 2).cpu()
        tables = {
            "f_dc": harmonics[:, 0],
            "f_rest": rest.flatten(1),
            "opacity": avatar.logits(posed)[:, None],
            "scale": posed.scales.clamp_min(1e-30).log(),
            "rot": torch.nn.functional.normalize(posed.quats, dim=1),
        }
        arrays = {name: value.float().cpu().numpy() for name, value in tables.items()}
        centres = posed.means.float().cpu().numpy()
    columns = {axis: centres[:, i] for i, axis in enumerate("xyz")}
    columns |= {axis: np.zeros(len(centres), np.float32) for axis in ("nx", "ny", "nz")}
    for name, values in arrays.items():
        columns |= {name if name == "opacity" else f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
    return columns
