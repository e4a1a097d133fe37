"""What every avatar on meshes has, whatever its primitives are: parts, faces, a record, and the calls that others use.

The paper's billboards (`nbavatar.avatar.model`) and the baselines (`nbavatar.baselines`) derive from `MeshAvatar`.
Rendering, evaluation, timing and storage know this interface only.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from nbavatar.errors import DataError

__all__ = ["MeshAvatar", "Stages", "compose"]


class Stages(NamedTuple):
    """What there is to time in one view.

    Attributes:
        calls: stage -> function without arguments; `total_*` are whole pictures from vertices to RGB.
        window: share of the picture that is computed, in [0, 1].
    """

    calls: dict[str, Callable[[], Any]]
    window: float


def compose(colour: Tensor, alpha: Tensor, background: Tensor) -> Tensor:
    """I = I_R I_alpha + (1 - I_alpha) C_bg (paper, eq. 2); (3, H, W), (H, W), (3,) or (3, H, W)."""
    behind = background[:, None, None] if background.ndim == 1 else background
    return colour * alpha + (1.0 - alpha) * behind


class MeshAvatar(nn.Module, ABC):
    """Base of all avatars that ride on the faces of meshes.

    A kind of avatar gives `method`, `anchor`, `render`, `panels`, `stages`, `facts`, `content`, `rebuild` and
    `primitives`; `restore` as well if the number of its primitives changes in training.

    Attributes:
        method: name of the kind, as in `TrainConfig.method` and in `nbavatar.avatar.storage`.
        parts: names of the parts in order; vertices and faces are concatenated in this order.
        vertex_counts, face_counts: vertices and faces of each part.
        faces: of all parts, int64 (F, 3).
        record: provenance.
    """

    method: ClassVar[str]
    faces: Tensor

    def __init__(
        self, faces: Mapping[str, Tensor], vertex_counts: Mapping[str, int], record: Mapping[str, Any] | None = None
    ) -> None:
        """Args: faces per part, int64 [F, 3]; vertices of each part; provenance."""
        super().__init__()
        self.parts = list(faces)
        self.vertex_counts = {part: int(vertex_counts[part]) for part in self.parts}
        self.face_counts = {part: len(faces[part]) for part in self.parts}
        merged, first = [], 0
        for part in self.parts:
            merged.append(faces[part].to(torch.int64) + first)
            first += self.vertex_counts[part]
        self.register_buffer("faces", torch.cat(merged))
        self.record = dict(record or {})

    @property
    @abstractmethod
    def primitives(self) -> int:
        """Number of billboards or Gaussians."""

    @property
    def fixed_anchors(self) -> bool:
        """Whether a frame's anchor stays the same while the avatar is trained, so that it may be kept."""
        return True

    def face_groups(self) -> Tensor:
        """Part index of every face, int64 [F]."""
        counts = torch.tensor([self.face_counts[part] for part in self.parts])
        return torch.repeat_interleave(torch.arange(len(self.parts)), counts)

    def part_faces(self) -> dict[str, Tensor]:
        """Faces of each part in its own vertex numbers, int64 (F, 3), on the CPU."""
        faces, first, offset = {}, 0, 0
        for part in self.parts:
            last = first + self.face_counts[part]
            faces[part] = (self.faces[first:last] - offset).cpu()
            first, offset = last, offset + self.vertex_counts[part]
        return faces

    def merged(
        self, verts: Mapping[str, Tensor], adjust: Callable[[str, Tensor], Tensor] | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """Vertices of all parts in one array.

        Args:
            verts: vertices per part, float (V, 3) [m]; a part that is missing or not finite in this frame is left out.
            adjust: applied to the vertices of every part that is there.

        Returns:
            vertices float (V, 3) [m], zero where a part is left out; indices int64 of the faces that are there, or
            None for all.

        Raises:
            DataError: a part has another number of vertices.
        """
        present, shown = [], []
        for part in self.parts:
            points = verts.get(part)
            if points is not None and points.shape != (self.vertex_counts[part], 3):
                raise DataError.of(
                    "meshes", part, expected=f"{self.vertex_counts[part]} vertices", found=f"{list(points.shape)}"
                )
            there = points is not None and bool(torch.isfinite(points).all())
            if points is None or not there:
                points = self.faces.new_zeros((self.vertex_counts[part], 3), dtype=next(self.parameters()).dtype)
            elif adjust is not None:
                points = adjust(part, points)
            present.append(points)
            shown.append(there)
        keep = None
        if not all(shown):
            keep = torch.tensor(shown)[self.face_groups()].nonzero().squeeze(1).to(self.faces.device)
        return torch.cat(present), keep

    @abstractmethod
    def anchor(self, verts: Mapping[str, Tensor], frame: str | None = None) -> Any:
        """Where the primitives of one frame ride: a tuple of tensors that does not depend on them.

        Args:
            verts: vertices per part, float (V, 3) [m].
            frame: id of a training frame, or None.
        """

    @abstractmethod
    def render(
        self,
        verts: Mapping[str, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        background: Tensor,
        *,
        frame: str | None = None,
        **options: Any,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One picture.

        Args:
            verts: vertices per part, float (V, 3) [m], world.
            viewmat: world to camera (4, 4); K: intrinsics (3, 3) [px]; width, height: picture size [px].
            background: RGB (3,) in [0, 1].
            frame: id of a training frame, to use what is known of it; None: the meshes as they are.
            options: `precision`, `roi`, `order`; those without a meaning for the kind are ignored.

        Returns:
            image (3, H, W), alpha (H, W) and the primitives' own alpha (H, W).
        """

    def panels(
        self,
        verts: Mapping[str, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        background: Tensor,
        frame: str | None = None,
    ) -> list[Tensor]:
        """Pictures for a preview, each (3, H, W), the render first; arguments as in `render`."""
        image, alpha, _ = self.render(verts, viewmat, K, width, height, background, frame=frame)
        return [image, alpha.expand(3, -1, -1)]

    def stages(
        self,
        verts: Mapping[str, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        background: Tensor,
        precisions: Sequence[str],
    ) -> Stages:
        """Stages of one view to time; arguments as in `render`, and the arithmetics that are asked for."""
        return Stages(
            {"total_fp32": lambda: self.render(verts, viewmat, K, width, height, background, precision="fp32")[0]}, 1.0
        )

    def facts(self, width: int, height: int) -> dict[str, Any]:
        """JSON-ready numbers that a timing of pictures of this size [px] is read with."""
        return {}

    def content(self) -> dict[str, Any]:
        """What a file must hold beside faces, state and record to build this avatar again: numbers, text, tensors."""
        return {}

    @classmethod
    @abstractmethod
    def rebuild(cls, content: Mapping[str, Any], state: Mapping[str, Tensor], record: Mapping[str, Any]) -> Any:
        """An avatar of the stored shape, its values still to be loaded from `state`."""

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave."""
        self.load_state_dict(dict(state))
