"""Normal equations of a refit: per-frame unknowns, coupled by smoothness over time and by one shared shape.

    [ H_1 + T     ...        C_1 ]   [ x_1 ]       [ g_1 ]
    [   ...    H_N + T       C_N ] * [ ... ]  =  - [ ... ]
    [ C_1^T  ...  C_N^T       S  ]   [  s  ]       [ g_s ]

H are dense blocks of one frame, T couples a frame with its two neighbours on either side (acceleration), C couples
frames with the shape. The frames' part is block-banded: block Cholesky per uncut run, the shape by its Schur
complement. The cost is linear in the number of frames, and the step is that of all frames and the shape at once.
"""

import dataclasses

import numpy as np
import torch
from torch import Tensor

__all__ = ["NormalEquations", "acceleration_bands", "accelerations", "solve"]


@dataclasses.dataclass
class NormalEquations:
    """Second-order model of the cost at a state.

    Attributes:
        blocks: `[N, d, d]`, without the coupling over time.
        gradient: `[N, d]`, with it.
        cross: `[N, d, S]`.
        shape_block: `[S, S]`.
        shape_gradient: `[S]`.
        cost: value of the cost.
        median_px: median error of the views that agree [px], for the convergence curve.
    """

    blocks: Tensor
    gradient: Tensor
    cross: Tensor
    shape_block: Tensor
    shape_gradient: Tensor
    cost: float
    median_px: float = 0.0


def accelerations(values: Tensor, segments: list[tuple[int, int]]) -> list[Tensor]:
    """Second differences over time of `[N, ...]`, one tensor `[n - 2, ...]` per run of three frames or more."""
    runs = [values[a : b + 1] for a, b in segments if b - a >= 2]
    return [run[2:] - 2 * run[1:-1] + run[:-2] for run in runs]


def acceleration_bands(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Diagonal `[n]` and two off-diagonals `[n - 1]`, `[n - 2]` of `D^T D`, D the second difference of n values."""
    main, first, second = (torch.zeros(max(count - k, 0), dtype=torch.float64) for k in range(3))
    for coefficient_a, shift_a in ((1.0, 0), (-2.0, 1), (1.0, 2)):
        for coefficient_b, shift_b in ((1.0, 0), (-2.0, 1), (1.0, 2)):
            band = (main, first, second)[abs(shift_a - shift_b)]
            if shift_b >= shift_a and count >= 3:
                band[shift_a : shift_a + count - 2] += coefficient_a * coefficient_b
    return main, first, second


def solve(
    system: NormalEquations, smoothness: Tensor, segments: list[tuple[int, int]], damping: float
) -> tuple[Tensor, Tensor]:
    """Levenberg-Marquardt step, all frames and the shape at once.

    Args:
        system: normal equations.
        smoothness: precision of the accelerations of each unknown `[d]`; zero where it is free.
        segments: first and last frame of each uncut run; together they cover all frames.
        damping: share of the diagonal that is added to it.

    Returns:
        steps of the frames `[N, d]` and of the shape `[S]`.

    Raises:
        numpy.linalg.LinAlgError: the system is not positive definite at this damping.
    """
    steps = torch.zeros_like(system.gradient)
    schur = system.shape_block + damping * torch.diag(torch.diagonal(system.shape_block))
    right = -system.shape_gradient
    answers: list[tuple[int, int, Tensor, Tensor]] = []
    if not bool((smoothness > 0).any()):
        segments = [(0, len(steps) - 1)]
    for first, last in segments:
        rows = slice(first, last + 1)
        cross = system.cross[rows]
        sides = torch.cat([-system.gradient[rows, :, None], cross], 2)
        answer = _run(system.blocks[rows], sides, smoothness, damping)
        schur = schur - torch.einsum("nds,ndt->st", cross, answer[..., 1:])
        right = right - torch.einsum("nds,nd->s", cross, answer[..., 0])
        answers.append((first, last, answer[..., 0], answer[..., 1:]))
    factor, failed = torch.linalg.cholesky_ex(0.5 * (schur + schur.mT))
    if failed:
        raise np.linalg.LinAlgError("shape system is not positive definite")
    shape_step = torch.cholesky_solve(right[:, None], factor)[:, 0]
    for first, last, alone, by_shape in answers:
        steps[first : last + 1] = alone - by_shape @ shape_step
    return steps, shape_step


def _run(blocks: Tensor, sides: Tensor, smoothness: Tensor, damping: float) -> Tensor:
    """Solves one uncut run: blocks `[n, d, d]`, right-hand sides `[n, d, k]`."""
    count, size = blocks.shape[:2]
    main, first, second = acceleration_bands(count)
    coupled = count >= 3 and bool((smoothness > 0).any())
    blocks = blocks + torch.diag_embed(main[:, None] * smoothness) if coupled else blocks.clone()
    diagonal = torch.diagonal(blocks, dim1=1, dim2=2)
    diagonal += damping * diagonal
    if not coupled:
        factor, failed = torch.linalg.cholesky_ex(blocks)
        if failed.any():
            raise np.linalg.LinAlgError("a frame's system is not positive definite")
        return torch.cholesky_solve(sides, factor)
    if count % 2:
        # Frames go in pairs below; an unknown that nothing refers to completes the last one.
        blocks = torch.cat([blocks, torch.eye(size, dtype=blocks.dtype)[None]])
        sides = torch.cat([sides, torch.zeros_like(sides[:1])])
    return _solve_pairs(blocks, sides, first, second, smoothness)[:count]


def _solve_pairs(blocks: Tensor, sides: Tensor, first: Tensor, second: Tensor, smoothness: Tensor) -> Tensor:
    """Block-tridiagonal Cholesky solution over pairs of frames.

    A frame reaches two frames ahead, so a pair reaches one pair ahead: `[[second, first], [0, second]]` of them.
    """
    size, width = blocks.shape[1], sides.shape[2]
    pairs = len(blocks) // 2
    extend = torch.zeros(len(blocks), dtype=blocks.dtype)
    near, far = extend.clone(), extend
    near[: len(first)], far[: len(second)] = first, second
    diagonal = blocks.new_zeros(pairs, 2 * size, 2 * size)
    diagonal[:, :size, :size], diagonal[:, size:, size:] = blocks[0::2], blocks[1::2]
    torch.diagonal(diagonal[:, size:, :size], dim1=1, dim2=2)[:] = near[0::2, None] * smoothness
    torch.diagonal(diagonal[:, :size, size:], dim1=1, dim2=2)[:] = near[0::2, None] * smoothness
    ahead = blocks.new_zeros(pairs, 2 * size, 2 * size)
    torch.diagonal(ahead[:, :size, :size], dim1=1, dim2=2)[:] = far[0::2, None] * smoothness
    torch.diagonal(ahead[:, size:, size:], dim1=1, dim2=2)[:] = far[1::2, None] * smoothness
    torch.diagonal(ahead[:, size:, :size], dim1=1, dim2=2)[:] = near[1::2, None] * smoothness
    right = sides.reshape(pairs, 2 * size, width)
    factors, reaches, halves = [], [], []
    remainder, side = diagonal[0], right[0]
    for k in range(pairs):
        factor, failed = torch.linalg.cholesky_ex(remainder)
        if failed:
            raise np.linalg.LinAlgError("a frame's system is not positive definite")
        solved = torch.linalg.solve_triangular(factor, torch.cat([side, ahead[k]], 1), upper=False)
        half, reach = solved[:, :width], solved[:, width:]
        factors.append(factor)
        halves.append(half)
        reaches.append(reach)
        if k + 1 < pairs:
            remainder = diagonal[k + 1] - reach.mT @ reach
            side = right[k + 1] - reach.mT @ half
    answer = torch.zeros_like(right)
    after = None
    for k in range(pairs - 1, -1, -1):
        half = halves[k] if after is None else halves[k] - reaches[k] @ after
        after = torch.linalg.solve_triangular(factors[k].mT, half, upper=True)
        answer[k] = after
    return answer.reshape(len(blocks), size, width)
