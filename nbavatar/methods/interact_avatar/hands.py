"""Points of hands, and how near a face they are."""

import torch
from torch import Tensor

__all__ = ["nearness", "spread_points"]

_NEIGHBOURS = 8


def spread_points(rest: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Vertices that are spread over a mesh, each the farthest from those before, and the nearest vertices of each.

    Args:
        rest: vertices (V, 3).
        count: points that are wanted.

    Returns:
        points: vertex ids, int64 (P,), P the smaller of `count` and V.
        groups: vertex ids, int64 (P, K), K the smaller of 8 and V, the point itself among them.
    """
    distance = (rest - rest.mean(0)).norm(dim=1)
    chosen: list[int] = []
    for _ in range(min(count, len(rest))):
        chosen.append(int(distance.argmax()))
        there = (rest - rest[chosen[-1]]).norm(dim=1)
        distance = there if len(chosen) == 1 else torch.minimum(distance, there)
        distance[chosen] = -1.0
    points = torch.tensor(chosen)
    between = (rest[points][:, None] - rest[None]).norm(dim=2)
    return points, torch.sort(between, dim=1, stable=True).indices[:, : min(_NEIGHBOURS, len(rest))]


def nearness(points: Tensor, others: Tensor, reach: float) -> Tensor:
    """How near the closest of other points is, (N,): 1 at distance 0, falling smoothly to 0 from `reach` on.

    Args:
        points: (N, 3); others: (M, 3), M may be 0; reach: in the same unit.
    """
    if len(others) == 0:
        return points.new_zeros(len(points))
    parts = [(part[:, None] - others[None]).square().sum(2).amin(1) for part in points.split(4096)]
    left = (1.0 - torch.cat(parts).sqrt() / reach).clamp_min(0.0)
    return left.square() * (3.0 - 2.0 * left)
