"""Groups of parameters: dicts with `params`, and how these are moved (`Method.parameter_groups`)."""

from collections.abc import Iterable, Mapping
from typing import Any

__all__ = ["forget_gradients", "split_groups"]


def split_groups(groups: Iterable[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Groups for Adam, and those that say `muon`."""
    every = list(groups)
    return [group for group in every if not group.get("muon")], [group for group in every if group.get("muon")]


def forget_gradients(groups: Iterable[Mapping[str, Any]]) -> None:
    """Leaves every parameter of the groups without a gradient."""
    for group in groups:
        for parameter in group["params"]:
            parameter.grad = None
