"""What a method gives: its avatar (`MeshAvatar`) and how that is trained (`Method`).

Rendering, evaluation, timing and storage know an avatar by `MeshAvatar` only; the trainer (`nbavatar.training.loop`)
knows a method by `Method` only. The trainer owns the data, the clock, optimizers, checkpoints and pictures; a method
owns the rest: which avatar, at which rates, by which loss, and what is done between steps. Methods are listed in
`nbavatar.methods.registry`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nbavatar.config.evaluation import EAGER
from nbavatar.config.training import TrainConfig
from nbavatar.data.lights import Light
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import Sample, View
from nbavatar.errors import ConfigError, DataError
from nbavatar.optimization.adam import Adam
from nbavatar.optimization.schedule import Plan, plan_at, total_steps

__all__ = ["MeshAvatar", "Method", "Stages", "StepLoss", "Taken", "compose", "modelled_parts"]


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
        method: name of the kind, as in `TrainConfig.method` and in `nbavatar.methods.storage`.
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

    def face_ranges(self) -> dict[str, slice]:
        """Where the faces of each part lie in `faces`."""
        ranges, first = {}, 0
        for part in self.parts:
            ranges[part] = slice(first, first + self.face_counts[part])
            first += self.face_counts[part]
        return ranges

    def part_faces(self) -> dict[str, Tensor]:
        """Faces of each part in its own vertex numbers, int64 (F, 3), on the CPU."""
        faces, offset = {}, 0
        for part, rows in self.face_ranges().items():
            faces[part] = (self.faces[rows] - offset).cpu()
            offset += self.vertex_counts[part]
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

    def use_engine(self, kind: str) -> str:
        """Let an inference engine do what it can of a picture in torch's place, up to rounding.

        Args:
            kind: `eager` (none), or one of `nbavatar.config.evaluation.ENGINES` that is installed.

        Returns:
            Its name with its version for records; `eager` where the kind of avatar has nothing to hand over.
        """
        return EAGER

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


class Taken(NamedTuple):
    """What an avatar took over from another one, in words.

    Attributes:
        over: what has the other's values.
        left: what has not, each with the reason in brackets: it starts as without, or is left out.
    """

    over: list[str]
    left: list[str]


class StepLoss(NamedTuple):
    """Loss of one step.

    Attributes:
        total: scalar, to be differentiated.
        terms: its unweighted terms, detached; `mse` is always among them.
        aux: whatever `after_step` needs.
    """

    total: Tensor
    terms: dict[str, Tensor]
    aux: Any


class Method(ABC):
    """One way to train an avatar.

    Attributes:
        avatar: what is trained.
        config: training options; options: of them, those of this method.
        adam_eps: epsilon of Adam [1].
    """

    adam_eps: float = 1e-8

    def __init__(self, avatar: MeshAvatar, config: TrainConfig) -> None:
        self.avatar, self.config, self.options = avatar, config, config.own

    @classmethod
    @abstractmethod
    def create(
        cls,
        sequence: MeshSequence,
        coords: Mapping[str, np.ndarray],
        views: Sequence[View],
        config: TrainConfig,
        device: str,
        light: Light | None = None,
    ) -> "Method":
        """The method with its avatar in its initial state; the same seed gives the same bits.

        Args:
            sequence: meshes; faces and rest poses are used.
            coords: spectral coordinates per part, float (V, K); may be empty.
            views: the training views.
            config: training options.
            device: where to compute.
            light: of the studio, for methods that can use it; None where it is not known.
        """

    def take_over(self, other: MeshAvatar, parts: Sequence[str]) -> Taken:
        """Values of another avatar in place of the initial ones, before the optimizers are made.

        Args:
            other: of the same method, on the same device.
            parts: those whose faces are the same in both, one at least.

        Returns:
            what was taken over of these parts and besides, and what could not be.

        Raises:
            ConfigError: the method cannot.
        """
        raise ConfigError.of("start", expected="none for this method", found="an avatar")

    def lpips_net(self) -> str | None:
        """Backbone of the LPIPS that the loss needs, or None."""
        return None

    @abstractmethod
    def parameter_groups(self) -> list[dict[str, Any]]:
        """Groups of parameters for Adam, over all parameters of the avatar.

        Each has `name`, `params`, `lr` (the rate at the start), and may have `final` (factor on the rate at the end,
        reached exponentially), `clip` (largest norm of its gradient), and `muon`: its parameters, weights of two
        dimensions or more whose rows stay, are moved by Muon instead.
        """

    def total_steps(self) -> int:
        """Number of steps when no time budget is given."""
        return total_steps(self.config)

    def plan(self, progress: float, side: int, step: int) -> Plan:
        """Settings of one step (`nbavatar.optimization.schedule.plan_at`)."""
        return plan_at(progress, self.config, side, step)

    @abstractmethod
    def step_loss(
        self,
        sample: Sample,
        anchor: Any,
        lpips: Callable[[Tensor, Tensor], Tensor] | None,
        plan: Plan,
        random: torch.Generator,
    ) -> StepLoss:
        """Render one view and compare it.

        Args:
            sample: the view, at the resolution of the plan.
            anchor: `MeshAvatar.anchor` of its frame.
            lpips: perceptual distance of two batches, or None.
            plan: settings of this step.
            random: CPU generator, seeded by the step; drawn from in a fixed order.
        """

    def after_step(self, optimizer: Adam, aux: Any, step: int, progress: float, random: torch.Generator) -> None:
        """Between two steps: primitives may be added, removed or moved.

        Args:
            optimizer: to be kept in line with the parameters (`Adam.replace`).
            aux: of the step's loss, after its backward pass.
            step: number of the step that was just taken, from 0.
            progress: of that step, in [0, 1].
            random: the step's generator, where the loss left it.
        """
        return None

    def finish(self, meshes: Mapping[str, Tensor], views: Sequence[View]) -> MeshAvatar:
        """The avatar to store once training is done: made smaller, where the options ask for it.

        Args:
            meshes: vertices per part over all frames, float32 (N, V, 3) [m].
            views: the training views.
        """
        return self.avatar

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint must hold beside the avatar and the optimizer: tensors and numbers."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes over what `state_dict` gave."""
        return None


def modelled_parts(sequence: MeshSequence, config: TrainConfig) -> list[str]:
    """Parts of the scene that the avatar has, in the order of the sequence.

    Raises:
        ConfigError: a part is asked for that the meshes do not have.
    """
    if config.parts is None:
        return list(sequence.parts)
    for part in config.parts:
        if part not in sequence.parts:
            found = ", ".join(sequence.parts)
            raise ConfigError.of("--cfg.parts", expected=f"parts of the meshes ({found})", found=part)
    return [part for part in sequence.parts if part in config.parts]
