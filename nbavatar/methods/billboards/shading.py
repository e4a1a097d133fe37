"""How much of the studio's light each face gets, as one more channel for the decoder. Not part of the paper.

Lights stand still while heads and hands turn and shadow each other. A texture cannot say how bright a place is in a
pose that was not trained; the light that reaches the face can, since it is computed from the meshes. It is told as
2 E^(1/2.2) - 1, where E is the light on the face, in units of what a face gets in the mean that nothing hides: on the
scale of the pictures, and between -1 and little more than 1.

Faces that were pruned away (`nbavatar.methods.billboards.compression`) still throw shadows. A shell throws none: carved
from silhouettes it is more solid than hair, and would keep light from skin that is lit between its locks.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from nbavatar.data.lights import Light

__all__ = ["Shading"]

_GAMMA = 2.2
_OCCLUDERS = "occluders_"
_KEPT_BYTES = 64_000_000  # of poses whose light is remembered: cameras that look at one pose ask again


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
        self._kept: OrderedDict[bytes, np.ndarray] = OrderedDict()

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
        arrays = [value.detach().cpu().numpy() for value in (points, faces, normals, self.directions, self.weights)]
        digest = hashlib.blake2b(repr(list(first)).encode())
        for array in arrays:
            digest.update(array.tobytes())
        key = digest.digest()
        told = self._kept.pop(key, None)
        if told is None:
            told = self._told(*arrays, first)
        self._kept[key] = told
        while len(self._kept) > max(1, _KEPT_BYTES // max(1, told.nbytes)):
            self._kept.popitem(last=False)
        return torch.from_numpy(told)[:, None].to(points)

    def _told(
        self, points: np.ndarray, faces: np.ndarray, normals: np.ndarray, directions: np.ndarray, weights: np.ndarray,
        first: Mapping[str, int],
    ) -> np.ndarray:  # fmt: skip
        """The same as `forward`, computed; float32 (G,)."""
        from nbavatar.mesh.incidence import incidence  # with Numba, which avatars without shading do not need

        stored, hiding = self.occluders, faces
        if stored and first:
            hiding = np.concatenate([stored[part].cpu().numpy() + start for part, start in first.items()])
        reached = incidence(points, faces, normals, directions, occluders=hiding)
        # In one order, whatever the number of threads.
        shine = (weights.astype(np.float64)[:, None] * reached).sum(0)
        return (2.0 * shine ** (1.0 / _GAMMA) - 1.0).astype(np.float32)
