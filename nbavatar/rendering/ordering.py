"""Orders of blending, and the rule that settles equal depths.

Hits of equal depth are blended in the order of the billboards' rank: by depth of the centre,
then by mean, quaternion and half-extents compared as numbers from left to right, then, for
billboards that agree in all of these, by their alpha and feature textures. The rank depends on
what a billboard is, not on where it stands in the arrays, so permuting them changes nothing.
"""

import numpy as np
import torch
from torch import Tensor

from nbavatar.errors import DataError

__all__ = ["canonical_rank", "parse_order"]


def parse_order(order: str) -> int:
    """Size of the per-pixel queue that an order stands for: -1 ray (unlimited), 0 center, n kbuffer(n).

    Raises:
        DataError: not one of `ray`, `center`, `kbuffer(n)` with n >= 1.
    """
    if order == "ray":
        return -1
    if order == "center":
        return 0
    digits = order.removeprefix("kbuffer(").removesuffix(")")
    if order == f"kbuffer({digits})" and digits.isascii() and digits.isdigit() and int(digits) > 0:
        return int(digits)
    raise DataError.of("render_billboards", "order", expected="'ray', 'center' or 'kbuffer(n)'", found=repr(order))


def canonical_rank(
    depth: Tensor,
    means: Tensor,
    quats: Tensor,
    half_extents: Tensor,
    features: Tensor,
    alpha: Tensor,
    uniform: Tensor | None = None,
) -> Tensor:
    """Billboards in the order of their rank.

    Args:
        depth: (F,) depth of the centres.
        means, quats, half_extents, features, alpha, uniform: the billboards, (F, ...), see `render_billboards`.

    Returns:
        (F,) int64 indices; `result[0]` is the billboard that comes first.
    """
    depth = depth.detach()
    ordered, rank = torch.sort(depth, stable=True)
    if len(rank) < 2:
        return rank
    tied = torch.zeros(len(rank), dtype=torch.bool, device=depth.device)
    equal = ordered[1:] == ordered[:-1]
    if not bool(equal.any()):
        return rank
    tied[1:] |= equal
    tied[:-1] |= equal
    places = tied.nonzero().squeeze(1)
    members = rank[places]
    with torch.no_grad():
        geometry = torch.cat([depth[members, None].double(), means[members].double(), quats[members].double(),
                              half_extents[members].double()], 1).cpu().numpy()  # fmt: skip
    order = np.lexsort(geometry.T[::-1])
    values = (alpha, features) if uniform is None else (alpha, features, uniform)
    order = _order_twins(order, geometry, members.cpu().numpy(), values)
    rank[places] = members[torch.from_numpy(order).to(members.device)]
    return rank


def _order_twins(
    order: np.ndarray, geometry: np.ndarray, members: np.ndarray, values: tuple[Tensor, ...]
) -> np.ndarray:
    """Orders runs of billboards of identical geometry by what else they have, in the same way in every precision."""
    sorted_geometry = geometry[order]
    same = (sorted_geometry[1:] == sorted_geometry[:-1]).all(1)
    if not same.any():
        return order
    starts = np.flatnonzero(np.r_[True, ~same])
    ends = np.r_[starts[1:], len(order)]
    for start, end in zip(starts, ends, strict=True):
        if end - start > 1:
            run = order[start:end]

            def texture_bytes(position: int) -> bytes:
                row = int(members[position])
                # Widened: float32 and float64 copies of one texture must compare alike.
                return b"".join(part[row].detach().double().cpu().numpy().tobytes() for part in values)

            order[start:end] = sorted(run, key=texture_bytes)
    return order
