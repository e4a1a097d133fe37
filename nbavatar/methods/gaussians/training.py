"""Training that the Gaussian baselines share: the published calendar, one view's gradient, density control."""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nbavatar.config.training import TrainConfig
from nbavatar.data.views import Sample, View
from nbavatar.methods.base import MeshAvatar, Method, Taken
from nbavatar.methods.gaussians.avatar import GaussianAvatar, PosedGaussians
from nbavatar.methods.gaussians.density import Statistics, densify, remove, reset_opacity
from nbavatar.methods.gaussians.losses import Pair, compare
from nbavatar.methods.gaussians.options import DensityConfig
from nbavatar.methods.gaussians.start import take_over
from nbavatar.optimization.adam import Adam
from nbavatar.optimization.schedule import Plan, total_steps

__all__ = ["Calendar", "GaussianTraining", "Seen", "camera_extent"]

_WHITE = 1.0


class Seen(NamedTuple):
    """What a step's render leaves for density control.

    Attributes:
        offsets: zeros added to the projected centres, whose gradient counts, (M, 2).
        radii: on screen [px], (M,).
        scales: posed, (M, 3) [m]; rows: which Gaussians, or None for all.
        width, height: of the picture [px].
    """

    offsets: Tensor
    radii: Tensor
    scales: Tensor
    rows: Tensor | None
    width: int
    height: int


class Calendar:
    """Published iterations as a function of steps.

    Args:
        published: length of the published training [iterations].
        steps: length of this training; None where time decides.
        scaled: whether the published calendar is passed through in this training's length.

    Attributes:
        now: published iteration that was reached; `before`: that of the step before.
    """

    def __init__(self, published: int, steps: int | None, *, scaled: bool) -> None:
        self._published, self._steps, self._scaled = published, steps, scaled
        self.before = self.now = 0.0
        self._step, self._per_step = 0, 1.0

    def advance(self, step: int, progress: float) -> None:
        """Count a step.

        Args:
            step: its number, from 0.
            progress: of the training at its start, in [0, 1].
        """
        self.before = self.now
        self._step = step + 1
        if not self._scaled:
            self.now = float(step + 1)
            return
        steps = self._steps if self._steps is not None else (step + 1) / max(progress, 1e-6)
        self._per_step = self._published / max(steps, 1.0)
        self.now = progress * self._published if self._steps is None else (step + 1) * self._per_step

    def due(self, interval: int, floor_steps: int = 1) -> bool:
        """Whether a multiple of an interval [iterations] was passed by the last step.

        Args:
            interval: 0 means never.
            floor_steps: in a scaled training, the fewest steps between two times.
        """
        if interval <= 0:
            return False
        if self._scaled and floor_steps * self._per_step > interval:
            return self._step % floor_steps == 0
        return math.floor(self.now / interval + 1e-9) > math.floor(self.before / interval + 1e-9)

    def leaves(self, steps: int) -> bool:
        """Whether a scaled training has so many steps left: what has to settle would else be judged before it has."""
        return not self._scaled or self.now + steps * self._per_step <= self._published


class GaussianTraining(Method):
    """A Gaussian baseline in training.

    Attributes:
        density: options of density control; extent: size of the scene it is measured by [m].
        calendar: where in the published training this one is.
        statistics: what density control has seen.
    """

    adam_eps = 1e-15
    avatar: GaussianAvatar

    def __init__(
        self, avatar: GaussianAvatar, config: TrainConfig, density: DensityConfig, iterations: int, extent: float
    ) -> None:
        super().__init__(avatar, config)
        self.density, self.extent, self._iterations = density, extent, iterations
        steps = None if config.max_minutes is not None else self.total_steps()
        self.calendar = Calendar(iterations, steps, scaled=config.schedule == "fast")
        self.statistics = Statistics(avatar.primitives, avatar.faces.device)

    def groups_of(
        self, place: tuple[str, float, Tensor, float], rates: Any, colour_rest: float
    ) -> list[dict[str, Any]]:
        """Adam groups of a Gaussian avatar.

        Args:
            place: name, rate, parameter and final factor of what says where the Gaussians are.
            rates: of `colour`, `opacity`, `scale`, `rotation`.
            colour_rest: rate of the higher harmonics.
        """
        avatar, factor = self.avatar, self.config.rate_factor
        named = [
            place,
            ("colour", rates.colour, avatar.colour, 1.0),
            ("colour_rest", colour_rest, avatar.colour_rest, 1.0),
            ("opacity", rates.opacity, avatar.opacity_logit, 1.0),
            ("scale", rates.scale, avatar.log_scale, 1.0),
            ("rotation", rates.rotation, avatar.quat, 1.0),
        ]
        return [
            {"name": name, "lr": rate * factor, "params": [parameter], "final": final}
            for name, rate, parameter, final in named
        ]

    def take_over(self, other: MeshAvatar, parts: Sequence[str]) -> Taken:
        """See `Method.take_over`; density control counts the Gaussians that there are then."""
        assert isinstance(other, GaussianAvatar)
        taken = take_over(self.avatar, other, parts)
        self.statistics = Statistics(self.avatar.primitives, self.avatar.faces.device)
        return taken

    def total_steps(self) -> int:
        """The budget's steps; the published number under `schedule: paper`."""
        if self.config.steps is None and self.config.schedule == "paper":
            return self._iterations
        return total_steps(self.config)

    def plan(self, progress: float, side: int, step: int) -> Plan:
        """Full resolution throughout; a final decay of all rates only under `schedule: fast`, as for the billboards."""
        plan = super().plan(progress, side, step)
        return plan._replace(shrink=1, crop=None, perceptual=step % self.config.lpips_every == 0)

    def background(self, kind: str, random: torch.Generator) -> Tensor:
        """RGB (3,): white or random; the generator is drawn from alike."""
        drawn = torch.rand(3, generator=random)
        return (drawn if kind == "random" else torch.full((3,), _WHITE)).to(self.avatar.faces.device)

    def picture(self, sample: Sample, anchor: Any, background: Tensor) -> tuple[Pair, Seen, PosedGaussians]:
        """Render a view beside its truth."""
        device = self.avatar.faces.device
        posed = self.avatar.pose(anchor)
        offsets = posed.means.new_zeros((len(posed.means), 2)).requires_grad_()
        viewmat, K = sample.view.viewmat.to(device), sample.K.to(device)
        image = self.avatar.splat(posed, viewmat, K, sample.width, sample.height, offsets)
        pair = compare(image.colour, image.alpha, sample, background)
        seen = Seen(offsets, image.radii, posed.scales.detach(), posed.rows, sample.width, sample.height)
        return pair, seen, posed

    def after_step(self, optimizer: Adam, aux: Seen, step: int, progress: float, random: torch.Generator) -> None:
        """Density control, then what the method does (`between_steps`)."""
        self.calendar.advance(step, progress)
        calendar, density = self.calendar, self.density
        if calendar.now < density.stop:
            if aux.offsets.grad is not None:
                self.statistics.observe(aux.offsets.grad, aux.radii, aux.rows, aux.width, aux.height)
            floor, reset_floor = density.floor_steps, density.reset_floor_steps
            if calendar.now >= density.start and calendar.due(density.interval, floor) and calendar.leaves(floor):
                self._control(optimizer, aux, random)
            if calendar.due(density.reset, reset_floor) and calendar.leaves(reset_floor):
                reset_opacity(self.avatar, optimizer)
        self.between_steps(optimizer, step, random)

    @abstractmethod
    def between_steps(self, optimizer: Adam, step: int, random: torch.Generator) -> None:
        """What a method does after density control of a step."""

    def state_dict(self) -> dict[str, Any]:
        """Statistics and calendar."""
        return {**self.statistics.state_dict(), "iteration": self.calendar.now}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Method.load_state_dict`."""
        self.statistics.load_state_dict(state)
        self.calendar.now = float(state["iteration"])

    def _control(self, optimizer: Adam, aux: Seen, random: torch.Generator) -> None:
        density, statistics = self.density, self.statistics
        sizes = aux.scales.amax(1)
        if aux.rows is not None:  # those that are not in this frame count as small
            sizes = torch.zeros(len(statistics.views), device=sizes.device).index_copy(0, aux.rows, sizes)
        before = self.avatar.log_scale.detach().amax(1)
        source = densify(
            self.avatar,
            optimizer,
            statistics.mean(),
            sizes,
            random,
            threshold=density.gradient,
            split_above=density.dense * self.extent,
            most=density.max_gaussians,
        )
        sizes = sizes[source] * torch.exp(
            self.avatar.log_scale.detach().amax(1) - before[source]
        )  # children are smaller
        unwanted = torch.sigmoid(self.avatar.opacity_logit.detach()) < density.min_opacity
        if density.reset > 0 and self.calendar.now > density.reset:
            unwanted |= sizes > density.max_size * self.extent
            if density.max_radius > 0:
                unwanted |= statistics.radius[source] > density.max_radius
        remove(self.avatar, optimizer, unwanted)
        self.statistics = Statistics(self.avatar.primitives, self.avatar.faces.device)


def camera_extent(views: Sequence[View]) -> float:
    """Size of a scene by its cameras [m]: 1.1 times the largest distance of one from their mean (Kerbl et al. 2023).

    Where all stand in one point it is 1.
    """
    poses = torch.stack([view.viewmat for view in views]).double()
    centres = -torch.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    centres = torch.unique(centres, dim=0)  # one vote a camera, however many frames it has
    reach = float((centres - centres.mean(0)).norm(dim=1).max())
    return 1.1 * reach if reach > 0 else 1.0
