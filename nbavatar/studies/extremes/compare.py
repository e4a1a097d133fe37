"""Errors between a kernel's numbers and its oracle's, and gradients of both."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

__all__ = ["derivative", "gradient_error", "gradients", "precise", "relative"]


def relative(found: object, true: object, *, least: float = 0.0) -> float:
    """|found - true| / max(|true|, least) in the Euclidean norm; NaN if `found` is not finite where `true` is.

    Equal infinities and NaN in the same places count as agreement. Where the truth is zero, and `least` too, the
    error itself is returned.
    """
    a, b = _flat(found), _flat(true)
    if a.shape != b.shape:
        return math.nan
    same = (a == b) | (np.isnan(a) & np.isnan(b))
    if not np.isfinite(a[~same]).all() or not np.isfinite(b[~same]).all():
        return math.nan
    a, b = np.where(same, 0.0, a), np.where(same & ~np.isfinite(b), 0.0, b)
    gap = np.where(same, 0.0, a - b)
    # hypot over the scaled values: squares of 1e-200 or 1e200 must neither vanish nor overflow
    return _norm(gap) / (max(_norm(b), least) or 1.0)


def gradients(function: Callable[..., Tensor], inputs: Sequence[Tensor]) -> tuple[Tensor, list[Tensor]]:
    """Value of a scalar function, and its gradient by every input (zeros where it does not depend on one)."""
    leaves = [value.detach().clone().requires_grad_() for value in inputs]
    value = function(*leaves)
    if not value.requires_grad:
        return value.detach(), [torch.zeros_like(leaf) for leaf in leaves]
    found = torch.autograd.grad(value, leaves, allow_unused=True)
    pairs = zip(found, leaves, strict=True)
    return value.detach(), [torch.zeros_like(leaf) if grad is None else grad for grad, leaf in pairs]


def gradient_error(found: Sequence[object], true: Sequence[object], *, least: float = 0.0) -> float:
    """Largest relative error among gradients by several inputs."""
    errors = [relative(a, b, least=least) for a, b in zip(found, true, strict=True)]
    return math.nan if any(math.isnan(error) for error in errors) else max(errors)


def precise(values: object) -> np.ndarray:
    """Numbers of any shape as an object array of mpmath's, exactly."""
    from mpmath import mpf

    array = np.asarray(values, np.float64)
    result = np.full(array.shape, None, object)
    for index in np.ndindex(array.shape):
        result[index] = mpf(float(array[index]))
    return result


def derivative(function: Callable[..., object], at: np.ndarray) -> np.ndarray:
    """Gradient of a scalar mpmath function by central differences of 1e-20 (error about 1e-40 at 60 digits)."""
    from mpmath import mpf

    result = np.zeros(at.shape)
    for index in np.ndindex(at.shape):
        step = mpf(10) ** -20 * max(abs(at[index]), mpf(10) ** -6)
        above, below = at.copy(), at.copy()
        above[index] += step
        below[index] -= step
        result[index] = float((function(above) - function(below)) / (2 * step))  # type: ignore[operator]
    return result


def _flat(values: object) -> np.ndarray:
    if isinstance(values, Tensor):
        return values.detach().to(torch.float64).cpu().numpy().ravel()
    return np.asarray(values).astype(np.float64).ravel()


def _norm(values: np.ndarray) -> float:
    largest = float(np.abs(values).max(initial=0.0))
    return largest * float(np.sqrt(np.square(values / largest).sum())) if largest > 0 else 0.0
