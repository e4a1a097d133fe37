"""What the trainer asks of a method: which avatar, at which rates, by which loss, and what to do between steps.

The trainer (`nbavatar.training.loop`) owns the data, the clock, Adam, checkpoints and pictures; a method owns the rest.
Methods are listed in `nbavatar.avatar.storage.METHODS`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nbavatar.avatar.base import MeshAvatar
from nbavatar.avatar.storage import METHODS, resolve
from nbavatar.config.avatar import TrainConfig
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import Sample, View
from nbavatar.training.adam import Adam
from nbavatar.training.schedule import Plan, plan_at, total_steps

__all__ = ["Method", "StepLoss", "create_method"]


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
        config: training options.
        adam_eps: epsilon of Adam [1].
    """

    adam_eps: float = 1e-8

    def __init__(self, avatar: MeshAvatar, config: TrainConfig) -> None:
        self.avatar, self.config = avatar, config

    @classmethod
    @abstractmethod
    def create(
        cls,
        sequence: MeshSequence,
        coords: Mapping[str, np.ndarray],
        views: Sequence[View],
        config: TrainConfig,
        device: str,
    ) -> "Method":
        """The method with its avatar in its initial state; the same seed gives the same bits.

        Args:
            sequence: meshes; faces and rest poses are used.
            coords: spectral coordinates per part, float (V, K); may be empty.
            views: the training views.
            config: training options.
            device: where to compute.
        """

    def lpips_net(self) -> str | None:
        """Backbone of the LPIPS that the loss needs, or None."""
        return None

    @abstractmethod
    def parameter_groups(self) -> list[dict[str, Any]]:
        """Adam groups over all parameters of the avatar.

        Each has `name`, `params`, `lr` (the rate at the start), and may have `final` (factor on the rate at the end,
        reached exponentially) and `clip` (largest norm of its gradient).
        """

    def total_steps(self) -> int:
        """Number of steps when no time budget is given."""
        return total_steps(self.config)

    def plan(self, progress: float, side: int, step: int) -> Plan:
        """Settings of one step (`nbavatar.training.schedule.plan_at`)."""
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

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint must hold beside the avatar and the optimizer: tensors and numbers."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes over what `state_dict` gave."""
        return None


def create_method(
    sequence: MeshSequence,
    coords: Mapping[str, np.ndarray],
    views: Sequence[View],
    config: TrainConfig,
    device: str = "cpu",
) -> Method:
    """The method that `config.method` names, in its initial state; arguments as in `Method.create`."""
    training: type[Method] = resolve(METHODS[config.method].training)
    return training.create(sequence, coords, views, config, device)
