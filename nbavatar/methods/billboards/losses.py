"""Loss terms of the paper, each a pure function of tensors (sections 3.3 and 3.4; weights in section 4.1).

    L = |I - GT|^2 + 0.1 LPIPS + 0.1 Dice(I_alpha^NB, GT_alpha) + 0.1 L_KNN + 0.001 L_Delta

LPIPS lives in `nbavatar.metrics.lpips`, the squared error with other differences of pictures in
`nbavatar.methods.photometric`. What the paper leaves open is decided here and said in each docstring.
"""

import torch
from torch import Tensor

__all__ = ["knn_graph", "loss_delta", "loss_dice", "loss_dice_haha", "loss_knn"]

_EPS = 1e-8
_CHUNK = 2048  # queries at once
_SLAB = 256  # the same, where their neighbourhood is to be thin
_MANY = 16384  # above this all distances are too many


def loss_dice(predicted: Tensor, target: Tensor, *, missed: Tensor | float = 0.0) -> Tensor:
    """Dice loss as Milletari et al. 2016 write it: 1 - 2 sum(p t) / (sum p^2 + sum t^2).

    Both areas are in the denominator, so a false positive costs as much as a miss: an all-ones prediction is not free.
    With an empty target and an empty prediction (a frame without the avatar) the loss is 0 and its gradient finite.

    Args:
        predicted: opacity of the billboards, float [..., H, W] in [0, 1].
        target: coverage, float [..., H, W] in [0, 1].
        missed: sum t^2 over pixels that lie outside the given window of a larger frame.

    Returns:
        Scalar in [0, 1], at least float32: sums of a large image, and the constant that keeps 0/0 away, do not fit half
        precision.
    """
    predicted, target = _widened(predicted), _widened(target)
    overlap = 2.0 * (predicted * target).sum()
    areas = predicted.square().sum() + target.square().sum() + missed
    return 1.0 - (overlap + _EPS) / (areas + _EPS)


def loss_dice_haha(predicted: Tensor, target: Tensor) -> Tensor:
    """Dice variant found in the code of HAHA (Svitov et al. 2024): 1 - (2 s + 1) / (s + sum t^2 + 1), s = sum(p t).

    The predicted area is counted inside the mask only, so false positives cost nothing. Kept for study, not for use.

    Args:
        predicted, target: float [..., H, W] in [0, 1].

    Returns:
        Scalar, at least float32.
    """
    predicted, target = _widened(predicted), _widened(target)
    overlap = (predicted * target).sum()
    return 1.0 - (2.0 * overlap + 1.0) / (overlap + target.square().sum() + 1.0)


def knn_graph(points: Tensor, groups: Tensor, neighbours: int, *, include_self: bool = True) -> Tensor:
    """Nearest points of the same group, by Euclidean distance.

    Neighbours come from the canonical pose, once: a hand that touches a cheek must not tie its billboards to the
    cheek's, so groups (parts) never mix. A group with fewer members than asked repeats its farthest one.

    Args:
        points: canonical centres [m], float [F, 3].
        groups: part of each point, int [F].
        neighbours: K, including the point itself if `include_self`.
        include_self: whether the point counts as its own first neighbour (GART, HAHA: yes).

    Returns:
        int64 [F, K], global indices, nearest first.
    """
    result = torch.zeros(len(points), neighbours, dtype=torch.int64, device=points.device)
    for group in torch.unique(groups).tolist():
        members = torch.nonzero(groups == group).squeeze(1)
        own = points[members].double()
        skip = 0 if include_self else 1
        count = min(neighbours + skip, len(members))
        nearest = (_nearest if len(members) <= _MANY else _nearest_of_many)(own, count)[:, min(skip, count - 1) :]
        if nearest.shape[1] < neighbours:
            nearest = torch.cat((nearest, nearest[:, -1:].expand(-1, neighbours - nearest.shape[1])), dim=1)
        result[members] = members[nearest]
    return result


def _nearest(points: Tensor, count: int) -> Tensor:
    """The `count` nearest of float64 [N, 3] to each of them, the point itself first; int64 [N, count]."""
    rows = []
    for start in range(0, len(points), _CHUNK):  # bounds the distance matrix
        rows.append(_nearest_in(points, start, points[start : start + _CHUNK], count)[0])
    return torch.cat(rows)


def _nearest_of_many(points: Tensor, count: int) -> Tensor:
    """As `_nearest`, in slabs across the longest axis: what is farther along it than the answer is never looked at."""
    axis = int((points.amax(0) - points.amin(0)).argmax())
    order = points[:, axis].argsort(stable=True)
    ranked = points[order]
    along = ranked[:, axis].contiguous()
    result = torch.empty(len(points), count, dtype=torch.int64, device=points.device)
    reach = 0.0
    for start in range(0, len(points), _SLAB):
        query = ranked[start : start + _SLAB]
        while True:
            low = min(start, int(torch.searchsorted(along, query[0, axis] - reach)))
            high = max(start + len(query), int(torch.searchsorted(along, query[-1, axis] + reach, right=True)))
            low, high = max(0, min(low, high - count)), min(len(points), max(high, low + count))
            found, distance = _nearest_in(ranked[low:high], start - low, query, count)
            farthest = float(distance.amax())
            if farthest <= reach or high - low == len(points):
                break
            reach = farthest
        result[order[start : start + _SLAB]] = order[low + found]
        reach = farthest
    return result


def _nearest_in(points: Tensor, start: int, query: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Places in `points` of those nearest to queries that stand there from `start` on, and their distances."""
    distance = torch.cdist(query, points, compute_mode="donot_use_mm_for_euclid_dist")
    # The point itself comes first even where others coincide with it.
    distance[torch.arange(len(query)), torch.arange(start, start + len(query))] = -1.0
    values, places = distance.topk(count, largest=False, sorted=True)
    return places, values


def loss_knn(means: Tensor, quats: Tensor, half_extents: Tensor, neighbours: Tensor) -> Tensor:
    """Keep neighbouring billboards alike and close, after GART and HAHA, on the posed primitives q', s', mu'.

    Over the K neighbours of each billboard: standard deviation (unbiased) of the quaternion components and of the half
    extents, averaged over billboards and components, plus the mean squared distance to the neighbours.

    Two traps are avoided: q and -q are one rotation, so signs are aligned to the first neighbour before the deviation;
    and the deviation is sqrt(var + 1e-8), whose gradient is finite where all neighbours agree.

    Args:
        means: posed centres [m], float [F, 3].
        quats: posed unit quaternions wxyz, float [F, 4].
        half_extents: posed half extents [m], float [F, 2].
        neighbours: int64 [F, K] from `knn_graph`.

    Returns:
        Scalar; quaternion term [1], extent term [m], distance term [m^2], summed as the sources do.
    """
    around = quats[neighbours]
    # torch.sign(0) is 0 and would erase a quaternion; orthogonal ones keep their sign.
    aligned = torch.where((around * around[:, :1]).sum(-1, keepdim=True) < 0, -around, around)
    distances = (means[neighbours] - means[:, None]).square().sum(-1)
    return _deviation(aligned) + _deviation(half_extents[neighbours]) + distances.mean()


def _deviation(values: Tensor) -> Tensor:
    """Mean unbiased standard deviation along axis 1 of float [F, K, D]; 0 for one neighbour."""
    count = values.shape[1]
    if count < 2:
        return values.new_zeros(())
    # Deviations do not depend on a common shift; taken from the first neighbour, close numbers differ exactly.
    values = values - values[:, :1].detach()
    variance = (values - values.mean(1, keepdim=True)).square().sum(1) / (count - 1)
    # sqrt(variance + eps) - sqrt(eps), written without the difference, which loses all digits of a small variance.
    return (variance / ((variance + _EPS).sqrt() + _EPS**0.5)).mean()


def _widened(values: Tensor) -> Tensor:
    """The values in float32 where they are narrower."""
    return values.float() if values.dtype in (torch.float16, torch.bfloat16) else values


def loss_delta(offsets: Tensor) -> Tensor:
    """Hold billboards on the mesh: mean squared length of the local offsets mu.

    Args:
        offsets: mu, in units of the face size k, float [F, 3].

    Returns:
        Scalar.
    """
    return offsets.square().sum(-1).mean()
