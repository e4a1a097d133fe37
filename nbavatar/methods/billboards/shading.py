"""How much of the studio's light each face gets, as one more channel for the decoder. Not part of the paper.

Lights stand still while heads and hands turn and shadow each other. A texture cannot say how bright a place is in a
pose that was not trained; the light that reaches the face can, since it is computed from the meshes. It is told as
2 E^(1/2.2) - 1, where E is the light on the face, in units of what a face gets in the mean that nothing hides: on the
scale of the pictures, and between -1 and little more than 1.

Faces that were pruned away (`nbavatar.methods.billboards.compression`) still throw shadows.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from nbavatar.data.lights import Light

__all__ = ["Shading"]

_GAMMA = 2.2
_OCCLUDERS = "occluders_"


class Shading(nn.Module):
    """Far lights, and what throws shadows.

    Attributes:
        directions: towards the lights, unit, world (K, 3).
        weights: how strong each is (K,), 4 in all.
    """

    directions: Tensor
    weights: Tensor

    def __init__(self, light: Light, occluders: Mapping[str, Tensor] | None = None) -> None:
        """Of the light, and of faces of each part that throw shadows, integers (O, 3); None where those lit do."""
        super().__init__()
        self.register_buffer("directions", torch.from_numpy(np.array(light.directions, np.float32)))
        self.register_buffer("weights", torch.from_numpy(np.array(light.weights, np.float32)))
        for part, faces in (occluders or {}).items():
            self.register_buffer(_OCCLUDERS + part, faces.to(torch.int32))

    @classmethod
    def of_state(cls, state: Mapping[str, Tensor], prefix: str) -> "Shading":
        """Of the stored shape, its values still to be loaded."""
        start = prefix + _OCCLUDERS
        occluders = {name[len(start) :]: value for name, value in state.items() if name.startswith(start)}
        light = Light(*(state[prefix + name].numpy() for name in Light._fields))
        return cls(light, occluders)

    @property
    def occluders(self) -> dict[str, Tensor]:
        """Faces of each part that throw shadows, int32 (O, 3); empty where those that are lit do."""
        return {name[len(_OCCLUDERS) :]: v for name, v in self.named_buffers() if name.startswith(_OCCLUDERS)}

    def without(self, parts: Sequence[str], faces: Mapping[str, Tensor]) -> "Shading":
        """For an avatar that keeps only some billboards.

        Args:
            parts: that it still has.
            faces: of all parts before, in their own vertex numbers.
        """
        known = self.occluders or faces
        light = Light(self.directions.cpu().numpy(), self.weights.cpu().numpy())
        return Shading(light, {part: known[part] for part in parts}).to(self.directions.device)

    def forward(self, points: Tensor, faces: Tensor, normals: Tensor, first: Mapping[str, int]) -> Tensor:
        """Light on faces, (G, 1), without gradients.

        Args:
            points: vertices of all parts in one array, world (V, 3).
            faces: that are lit, in numbers of that array (G, 3); normals: theirs, unit (G, 3).
            first: parts that are in the frame, and where the vertices of each begin.
        """
        from nbavatar.mesh.incidence import incidence  # with Numba, which avatars without shading do not need

        stored = self.occluders
        hiding = torch.cat([stored[part] + start for part, start in first.items()]) if stored and first else faces
        reached = incidence(
            points.detach().cpu().numpy(), faces.cpu().numpy(), normals.detach().cpu().numpy(),
            self.directions.cpu().numpy(), occluders=hiding.cpu().numpy(),
        )  # fmt: skip
        # In one order, whatever the number of threads.
        shine = (self.weights.cpu().double().numpy()[:, None] * reached).sum(0)
        return torch.from_numpy(2.0 * shine ** (1.0 / _GAMMA) - 1.0)[:, None].to(points)
