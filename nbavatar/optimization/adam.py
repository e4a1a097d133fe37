"""Adam (Kingma and Ba, 2014) on torch's fused kernel.

The same arithmetic, bit for bit, as `torch.optim.Adam(fused=True)`, whose first call imports torch's whole compiler:
many seconds that a short training does not have, for nothing that it uses. A test holds the two equal.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from nbavatar.optimization.groups import forget_gradients

__all__ = ["Adam"]


class Adam:
    """Adam without weight decay.

    Args:
        groups: dicts with `params` and `lr`; further keys are kept.
        betas: decay rates of the two moments [1].
        eps: added to the root of the second moment [1].

    Attributes:
        param_groups: the groups; `lr` may be changed between steps.
    """

    def __init__(
        self, groups: Iterable[Mapping[str, Any]], *, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8
    ) -> None:
        self.param_groups = [{**group, "params": list(group["params"])} for group in groups]
        self._betas, self._eps = betas, eps
        self._state: dict[int, tuple[Tensor, Tensor, Tensor]] = {}

    def zero_grad(self) -> None:
        """Forgets all gradients."""
        forget_gradients(self.param_groups)

    @torch.no_grad()
    def step(self) -> None:
        """One update of every parameter that has a gradient."""
        index = 0
        for group in self.param_groups:
            used, states = [], []
            for parameter in group["params"]:
                if parameter.grad is not None:
                    if index not in self._state:
                        first, second = torch.zeros_like(parameter), torch.zeros_like(parameter)
                        count = torch.zeros((), dtype=torch.float32, device=parameter.device)
                        self._state[index] = (first, second, count)
                    used.append(parameter)
                    states.append(self._state[index])
                index += 1
            if not used:
                continue
            counts = [state[2] for state in states]
            torch._foreach_add_(counts, 1)
            torch._fused_adam_(
                used,
                [parameter.grad for parameter in used],
                [state[0] for state in states],
                [state[1] for state in states],
                [],
                counts,
                lr=group["lr"],
                beta1=self._betas[0],
                beta2=self._betas[1],
                weight_decay=0.0,
                eps=self._eps,
                amsgrad=False,
                maximize=False,
            )

    def moments(self, parameter: Tensor) -> tuple[Tensor, Tensor] | None:
        """First and second moment of a parameter, of its shape; None before its first update."""
        state = self._state.get(self._index(parameter))
        return None if state is None else (state[0], state[1])

    @torch.no_grad()
    def replace(self, old: Tensor, new: Tensor, source: Tensor | None = None, fresh: Tensor | None = None) -> None:
        """Puts a parameter in another's place when rows are added, removed or rewritten; the step count goes on.

        Args:
            old: a parameter of the groups, (N, ...).
            new: what takes its place, (N', ...).
            source: row of `old` whose moments each row of `new` inherits, int64 (N',); None: the same rows.
            fresh: rows of `new` that start with zero moments, bool (N',); None: no row.

        Raises:
            ValueError: `old` is not in the groups.
        """
        index = place = self._index(old)
        for group in self.param_groups:
            if place < len(group["params"]):
                group["params"][place] = new
                break
            place -= len(group["params"])
        if index not in self._state:
            return
        first, second, count = self._state[index]
        moments = [first.clone(), second.clone()] if source is None else [first[source], second[source]]
        if fresh is not None:
            for moment in moments:
                moment[fresh] = 0.0
        self._state[index] = (moments[0], moments[1], count)

    def _index(self, parameter: Tensor) -> int:
        index = 0
        for group in self.param_groups:
            for known in group["params"]:
                if known is parameter:
                    return index
                index += 1
        raise ValueError("the optimizer does not know this parameter")

    def state_dict(self) -> dict[str, Any]:
        """Moments and step counts by the parameter's place in the groups."""
        return {"state": {index: list(state) for index, state in self._state.items()}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes over what `state_dict` gave, for the same parameters in the same order."""
        parameters = [parameter for group in self.param_groups for parameter in group["params"]]
        self._state = {}
        for index, values in state["state"].items():
            first, second, count = (value.to(parameters[int(index)].device) for value in values)
            self._state[int(index)] = (first, second, count)
