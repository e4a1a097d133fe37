"""Muon: steps of a weight matrix along the nearest orthogonal matrix of its momentum.

The momentum M of a weight (N, D) has a few large singular values and many small ones; Muon sets all to about one, so
that a step moves every direction alike (Jordan et al., "Muon: An optimizer for hidden layers in neural networks",
2024). Steps are 0.2 sqrt(max(N, D)) times that matrix, whose entries are then as large as Adam's, and rates found for
Adam serve (Liu et al., "Muon is scalable for LLM training", 2025, section 2.2). torch's own Muon takes matrices alone,
not convolutions, computes in bfloat16, and imports torch's compiler; a test holds the two together.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from nbavatar.optimization.groups import forget_gradients

__all__ = ["Muon", "orthogonalized"]

# Jordan's momentum, rounds and quintic s -> a s + b s^3 + c s^5: what is over 0.0015 of the norm ends in [0.68, 1.21].
_MOMENTUM = 0.95
_ROUNDS = 5
_QUINTIC = (3.4445, -4.7750, 2.0315)
_ADAM = 0.2  # root mean square of an entry of Adam's steps, in units of the rate
_TINY = 1e-8  # a momentum of this norm is rounding noise: steps shrink with it, as Adam's do by its epsilon


class Muon:
    """Muon without weight decay, with Nesterov's momentum.

    Args:
        groups: dicts with `params`, weights of two dimensions or more (the first: outputs), and `lr`; further keys are
            kept.

    Attributes:
        param_groups: the groups; `lr` may be changed between steps.
    """

    def __init__(self, groups: Iterable[Mapping[str, Any]]) -> None:
        self.param_groups = [{**group, "params": list(group["params"])} for group in groups]
        self._momentum: dict[int, Tensor] = {}

    def zero_grad(self) -> None:
        """Forgets all gradients."""
        forget_gradients(self.param_groups)

    @torch.no_grad()
    def step(self) -> None:
        """One update of every weight that has a gradient."""
        index = -1
        for group in self.param_groups:
            for weight in group["params"]:
                index += 1
                if weight.grad is None:
                    continue
                gradient = weight.grad.reshape(len(weight), -1)
                if index not in self._momentum:
                    self._momentum[index] = torch.zeros_like(gradient)
                momentum = self._momentum[index].lerp_(gradient, 1.0 - _MOMENTUM)
                step = orthogonalized(gradient.lerp(momentum, _MOMENTUM))
                weight.sub_(step.reshape(weight.shape), alpha=group["lr"] * _ADAM * max(step.shape) ** 0.5)

    def state_dict(self) -> dict[str, Any]:
        """Momentum by the weight's place in the groups."""
        return {"momentum": dict(self._momentum)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes over what `state_dict` gave, for the same weights in the same order."""
        weights = [weight for group in self.param_groups for weight in group["params"]]
        self._momentum = {int(i): value.to(weights[int(i)].device) for i, value in state["momentum"].items()}


def orthogonalized(matrix: Tensor) -> Tensor:
    """The matrix with its singular values near one, by five rounds of Newton-Schulz (Jordan et al. 2024).

    Args:
        matrix: float32 or float64 (N, D).

    Returns:
        (N, D): U p(S / |S|) V^T of the matrix U S V^T, with |S| the root of the sum of squares, and p five rounds of
        the quintic. A singular value below about 0.0015 |S| ends smaller than the others; zero stays zero. In
        float32 small ones are right to 1e-3.
    """
    a, b, c = _QUINTIC
    wide = matrix if matrix.shape[0] <= matrix.shape[1] else matrix.T
    value = wide / (wide.norm() + _TINY)
    # Each round multiplies from the left by a polynomial of value value^T. These commute, so they are gathered in the
    # small square: less than half of the work of rounds on the matrix itself.
    square = value @ value.T
    same = torch.eye(len(value), dtype=value.dtype, device=value.device)
    gathered = a * same + b * square + c * (square @ square)
    factor = gathered
    for _ in range(_ROUNDS - 1):
        square = factor @ square @ factor
        factor = a * same + b * square + c * (square @ square)
        gathered = factor @ gathered
    value = gathered @ value
    return value if wide is matrix else value.T
