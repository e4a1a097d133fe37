"""Compensation of mesh-fitting errors: a smooth displacement and a rigid motion per training frame and part.

Not part of the paper, which names it as future work: a mesh fitted to video is off by a millimetre or two, and an
avatar that cannot move it back blurs. The displacement of a frame is B c with B the low spectral modes of the part
(and the constant one, through the rigid part), so a few numbers per frame bend the surface smoothly and cannot paint
detail. Frames that were not trained on are left as they are: nothing is ever fitted at test time.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from nbavatar.math.rotations import axis_angle_to_matrix

__all__ = ["Refinement", "displacement_basis"]


def displacement_basis(coords: Mapping[str, Tensor], modes: int) -> dict[str, Tensor]:
    """First modes of each part, scaled to unit root mean square, so that coefficients are metres.

    Args:
        coords: spectral coordinates per part, float [V, K].
        modes: how many are used; fewer where a part has fewer.

    Returns:
        float32 [V, min(modes, K)] per part.
    """
    basis = {}
    for part, values in coords.items():
        chosen = values[:, :modes].float()
        basis[part] = chosen / chosen.square().mean(0, keepdim=True).sqrt().clamp_min(1e-6)
    return basis


class Refinement(nn.Module):
    """Learned displacement of the meshes of known frames.

    Attributes:
        frames: ids of the frames that were trained on.
    """

    def __init__(self, frames: Sequence[str], basis: Mapping[str, Tensor], *, rigid: bool) -> None:
        """Start at zero displacement.

        Args:
            frames: N ids.
            basis: modes per part, float [V, K].
            rigid: whether parts also move rigidly.
        """
        super().__init__()
        self.frames = list(frames)
        self._row = {frame: row for row, frame in enumerate(self.frames)}
        self.rigid = rigid
        self.parts = list(basis)
        for part, modes in basis.items():
            self.register_buffer(f"basis_{part}", modes)
            self.register_parameter(f"bend_{part}", nn.Parameter(torch.zeros(len(frames), modes.shape[1], 3)))
            if rigid:
                self.register_parameter(f"turn_{part}", nn.Parameter(torch.zeros(len(frames), 3)))
                self.register_parameter(f"shift_{part}", nn.Parameter(torch.zeros(len(frames), 3)))

    def forward(self, part: str, verts: Tensor, frame: str) -> tuple[Tensor, Tensor]:
        """Refine one part's vertices (V, 3) [m] in world space.

        Returns:
            refined vertices (V, 3) and the mean squared bending displacement [m^2]; unchanged and 0 for an unknown
            frame.
        """
        row = self._row.get(frame)
        if row is None:
            return verts, verts.new_zeros(())
        bend = self.get_buffer(f"basis_{part}") @ self.get_parameter(f"bend_{part}")[row]
        penalty = bend.square().sum(-1).mean()
        moved = verts + bend
        if self.rigid:
            centre = verts.mean(0)
            turn = axis_angle_to_matrix(self.get_parameter(f"turn_{part}")[row])
            moved = (moved - centre) @ turn.T + centre + self.get_parameter(f"shift_{part}")[row]
        return moved, penalty

    @torch.no_grad()
    def centre(self) -> None:
        """Take what all frames have in common out of the refinement.

        A motion shared by every frame is no error of one frame's fit, and the billboards can follow it: without this
        the avatar drifts off its meshes, and frames without refinement are rendered where it no longer is. So a
        sequence of one frame is not refined.
        """
        for values in self.parameters():
            values -= values.mean(0)
