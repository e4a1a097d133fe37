"""Training of one avatar by any method, one view a step (paper, section 4.1; supplement A): Adam on all parameters, or
Muon where a method's groups say `muon`.

Every random number of a step comes from (seed, step), so a run that is cut off anywhere and resumed from its last
checkpoint computes the same bits as an unbroken one (on the CPU, with the same number of threads). A step whose loss or
gradients are not finite is skipped and counted; several in a row end the training with one line.
"""

import contextlib
import math
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from nbavatar.config.training import TrainConfig
from nbavatar.data.views import ViewStore, ViewStream
from nbavatar.errors import NBAvatarError
from nbavatar.methods.base import MeshAvatar, Method
from nbavatar.optimization.adam import Adam
from nbavatar.optimization.groups import split_groups
from nbavatar.optimization.muon import Muon
from nbavatar.optimization.schedule import Plan
from nbavatar.training.determinism import sums_in_order
from nbavatar.training.preview import contact_sheet

__all__ = ["Store", "train"]

_LOG_EVERY = 25
# Silhouette loss of billboards and masks that have nothing in common, and in how many logs in a row that is no chance.
_NOTHING = 0.999
_NOTHING_LOGS = 8
_ANCHOR_BYTES = 256_000_000  # most memory for kept face frames


class Store(Protocol):
    """Where checkpoints, events and previews go (`nbavatar.training.state.RunFolder`)."""

    def load(self) -> dict[str, Any] | None:
        """Last checkpoint, or None."""

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the checkpoint."""

    def log(self, event: Mapping[str, Any]) -> None:
        """Append an event."""

    def preview(self, step: int, image: np.ndarray) -> None:
        """Keep a picture."""


def train(
    method: Method,
    views: ViewStore,
    count: int,
    meshes: Mapping[str, Tensor],
    lpips: Callable[[Tensor, Tensor], Tensor] | None,
    config: TrainConfig,
    store: Store,
    *,
    device: str = "cpu",
    on_step: Callable[[int, float, dict[str, float]], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> dict[str, Any]:
    """Train an avatar in place.

    Args:
        method: with its avatar in its initial state, on `device`.
        views: training pictures; `count` of them.
        meshes: vertices per part over all frames, float32 (N, V, 3) [m].
        lpips: perceptual distance on `device`, or None when the method does without (`Method.lpips_net`).
        config: training options.
        store: checkpoints, events and previews.
        device: where the avatar computes.
        on_step: called after every step with its number, progress in [0, 1] and the last logged values.
        should_stop: asked before every step; True checkpoints and returns early.

    Returns:
        Summary: `finished`, `steps`, `seconds`, `skipped`, `last` (logged values), `views`, `decoded`, `primitives`,
        `parameters` (trained numbers), `model_bytes` (of the avatar's tensors).

    Raises:
        NBAvatarError: too many non-finite steps in a row, or nothing is rendered where the masks are.
    """
    avatar = method.avatar
    state = store.load()
    if state is not None:
        avatar.restore(state["model"])  # first: the number of primitives may differ from the initial one
        method.load_state_dict(state["method"])
    groups = [{**group, "base": group["lr"]} for group in method.parameter_groups()]
    for_adam, for_muon = split_groups(groups)
    optimizer, muon = Adam(for_adam, eps=method.adam_eps), Muon(for_muon)
    moved = [*optimizer.param_groups, *muon.param_groups]
    vertices = {part: meshes[part].to(device) for part in avatar.parts}
    anchors = _Anchors(avatar, vertices)
    clock = _Clock(method.total_steps(), config.max_minutes)
    step, skipped, in_a_row = 0, 0, 0
    if state is not None:
        optimizer.load_state_dict(state["optimizer"])
        muon.load_state_dict(state["muon"])
        step, skipped, in_a_row = state["step"], state["skipped"], state["in_a_row"]
        clock.seconds_before = state["seconds"]
    previews = _PreviewTimes(config.previews, clock.progress(step))
    stream = ViewStream(views, count, config.seed, config.prefetch)
    last: dict[str, float] = {}
    nothing = 0
    side = views.side
    saved_at = time.monotonic()

    def checkpoint() -> None:
        store.save(
            {
                "model": avatar.state_dict(),
                "method": method.state_dict(),
                "optimizer": optimizer.state_dict(),
                "muon": muon.state_dict(),
                "step": step,
                "skipped": skipped,
                "in_a_row": in_a_row,
                "seconds": clock.seconds(),
            }
        )

    avatar.train()
    with contextlib.closing(stream), sums_in_order(device):
        while not clock.done(step):
            if should_stop is not None and should_stop():
                checkpoint()
                return _summary(False, step, clock, skipped, last, count, views, avatar)
            progress = clock.progress(step)
            plan = method.plan(progress, side, step)
            _set_rates(moved, plan, progress)
            sample = stream.get(step, plan.shrink)
            anchor = anchors.get(sample.view.row, sample.view.frame)
            random = torch.Generator().manual_seed(config.seed * 1_000_003 + step)
            optimizer.zero_grad()
            muon.zero_grad()
            total, terms, aux = method.step_loss(sample, anchor, lpips, plan, random)
            good = bool(torch.isfinite(total))
            if good:
                total.backward()
                good = _finite_gradients(avatar)
            if good:
                for group in moved:
                    if group.get("clip", 0.0) > 0:
                        nn.utils.clip_grad_norm_(group["params"], group["clip"])
                optimizer.step()
                muon.step()
                method.after_step(optimizer, aux, step, progress, random)
                in_a_row = 0
            else:
                skipped, in_a_row = skipped + 1, in_a_row + 1
                if in_a_row >= config.max_bad_steps:
                    raise NBAvatarError(
                        f"training: {in_a_row} steps in a row up to step {step} had a loss or gradient that is not "
                        f"finite (camera {sample.view.camera}, frame {sample.view.frame}); "
                        "lower rate_factor or clip the gradients (clip)"
                    )
            step += 1
            progress = clock.progress(step)
            if step % _LOG_EVERY == 0 or step == 1 or progress >= 1.0:
                last = _values(total, terms, plan, clock, skipped)
                store.log({"step": step, "progress": progress, **_json_safe(last)})
                nothing = nothing + 1 if last.get("nb", 0.0) >= _NOTHING else 0
                if nothing >= _NOTHING_LOGS:
                    raise NBAvatarError(
                        f"training: the billboards miss the masks in all {nothing} views looked at up to step {step} "
                        f"(camera {sample.view.camera}, frame {sample.view.frame}: silhouette loss {last['nb']:.4g}); "
                        "do the meshes project onto the masks? see `nbavatar check`"
                    )
            if previews.due(progress):
                store.preview(step, contact_sheet(avatar, views.preview_samples(), vertices))
            if on_step is not None:
                on_step(step, progress, last)
            if time.monotonic() - saved_at >= config.checkpoint_seconds:
                checkpoint()
                saved_at = time.monotonic()
        checkpoint()
    avatar.eval()
    return _summary(True, step, clock, skipped, last, count, views, avatar)


class _Anchors:
    """Face frames of the frames seen last, in bounded memory; computed anew where a refinement moves the meshes."""

    def __init__(self, avatar: MeshAvatar, vertices: Mapping[str, Tensor]) -> None:
        self._avatar, self._vertices = avatar, vertices
        self._most = 1 if avatar.fixed_anchors else 0
        self._kept: OrderedDict[int, Any] = OrderedDict()

    def get(self, row: int, frame: str) -> Any:
        """Anchor of one frame."""
        if row in self._kept:
            self._kept.move_to_end(row)
            return self._kept[row]
        verts = {part: values[row] for part, values in self._vertices.items()}
        anchor = self._avatar.anchor(verts, frame)
        if self._most > 0:
            self._most = max(1, _ANCHOR_BYTES // max(1, _tensor_bytes(anchor)))
            self._kept[row] = anchor
            if len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return anchor


class _Clock:
    """Progress by steps, or by time where a budget is given."""

    def __init__(self, steps: int, max_minutes: float | None) -> None:
        self._steps = steps
        self._budget = None if max_minutes is None else 60.0 * max_minutes
        self._started = time.monotonic()
        self.seconds_before = 0.0

    def seconds(self) -> float:
        """Seconds spent on this training, earlier runs of it included."""
        return self.seconds_before + time.monotonic() - self._started

    def progress(self, step: int) -> float:
        """Share of the training that is done, in [0, 1]."""
        if self._budget is None:
            return min(1.0, step / self._steps)
        return min(1.0, self.seconds() / max(self._budget, 1e-9))

    def done(self, step: int) -> bool:
        """Whether the training is over."""
        return self.progress(step) >= 1.0


class _PreviewTimes:
    """Evenly spread moments, the first after a hundredth of the training, the last at its end."""

    def __init__(self, number: int, progress: float) -> None:
        moments = [1.0] if number == 1 else [max(0.01, i / (number - 1)) for i in range(number)]
        self._left = [moment for moment in moments if moment > progress]

    def due(self, progress: float) -> bool:
        """Whether a moment has passed since the last call."""
        passed = [moment for moment in self._left if moment <= progress]
        self._left = self._left[len(passed) :]
        return bool(passed)


def _tensor_bytes(values: Any) -> int:
    """Memory [bytes] of the tensors in nested tuples."""
    if isinstance(values, Tensor):
        return values.numel() * values.element_size()
    return sum(_tensor_bytes(value) for value in values) if isinstance(values, tuple) else 0


def _set_rates(groups: Sequence[dict[str, Any]], plan: Plan, progress: float) -> None:
    # A group with `final` decays exponentially to that factor, beside what the plan does to all groups.
    progress = min(max(progress, 0.0), 1.0)
    for group in groups:
        group["lr"] = group["base"] * plan.rate * group.get("final", 1.0) ** progress


def _finite_gradients(avatar: MeshAvatar) -> bool:
    # A sum is finite only if all its terms are (up to overflow, which is as bad); far cheaper than isfinite().all().
    sums = [p.grad.sum() for p in avatar.parameters() if p.grad is not None]
    return bool(torch.isfinite(torch.stack(sums)).all()) if sums else True


def _values(total: Tensor, terms: Mapping[str, Tensor], plan: Plan, clock: _Clock, skipped: int) -> dict[str, float]:
    values = {name: float(value) for name, value in terms.items()}
    values["loss"] = float(total.detach())
    values["psnr"] = -10.0 * math.log10(max(values["mse"], 1e-12)) if math.isfinite(values["mse"]) else math.nan
    values |= {"shrink": plan.shrink, "rate": plan.rate, "seconds": round(clock.seconds(), 3), "skipped": skipped}
    return values


def _json_safe(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in values.items()}


def _summary(
    finished: bool,
    step: int,
    clock: _Clock,
    skipped: int,
    last: Mapping[str, float],
    count: int,
    views: ViewStore,
    avatar: MeshAvatar,
) -> dict[str, Any]:
    tensors = list(avatar.state_dict().values())
    return {
        "finished": finished,
        "steps": step,
        "seconds": round(clock.seconds(), 3),
        "skipped": skipped,
        "last": _json_safe(last),
        "views": count,
        "decoded": views.decoded,
        "cached_mb": round(views.cached_bytes / 1e6, 3),
        "method": avatar.method,
        "primitives": avatar.primitives,
        "parameters": sum(parameter.numel() for parameter in avatar.parameters()),
        "model_bytes": sum(tensor.numel() * tensor.element_size() for tensor in tensors),
    }
