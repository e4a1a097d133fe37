"""Cells of the face frames, float32: slivers, points, extreme sizes, far from the origin.

Oracle of sound faces is the textbook frame in float64, written anew; of degenerate ones, whose frame is a
definition of this project, the same function in float64, and that the rotation is orthonormal.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.mesh.frames import face_frames
from nbavatar.methods.billboards.billboards import initial_half_extents
from nbavatar.studies.extremes.cells import Level, Limit, Sample, cell
from nbavatar.studies.extremes.compare import gradient_error, gradients, relative

__all__: list[str] = []

_TEXTBOOK = "edge and normal frame, float64"
_DEFINITION = "the same definition, float64"


def patch(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy 4 x 4 grid of 18 triangles, 1 m wide, around the origin, (16, 3) and (18, 3)."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 4), np.linspace(-0.5, 0.5, 4), indexing="ij")
    noise = np.random.default_rng(seed).normal(size=(16, 3)) * 0.03
    verts = np.stack((x, y, 0.2 * x * x - 0.3 * x * y), -1).reshape(-1, 3) + noise
    corner = (np.arange(3)[:, None] * 4 + np.arange(3)).ravel()
    faces = np.concatenate(
        (np.stack((corner, corner + 4, corner + 1), 1), np.stack((corner + 1, corner + 4, corner + 5), 1))
    )
    return verts, faces.astype(np.int64)


def _textbook(verts: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    v0, v1, v2 = verts[faces].unbind(1)
    edge, side = v1 - v0, v2 - v0
    x = edge / edge.norm(dim=-1, keepdim=True)
    cross = torch.linalg.cross(edge, side)
    z = cross / cross.norm(dim=-1, keepdim=True)
    y = torch.linalg.cross(z, x)
    k = 0.5 * (edge.norm(dim=-1) + (y * side).sum(-1).abs())
    return (v0 + v1 + v2) / 3, torch.stack((x, y, z), -1), k


def _measure(
    verts: np.ndarray, faces: np.ndarray, *, textbook: bool, size: float = 1.0, only: int | None = None
) -> Sample:
    """Errors of centroid and k against the mesh's size, of the rotation, and of the gradient by the vertices."""
    single = torch.tensor(verts, dtype=torch.float32)
    ids = torch.tensor(faces)
    random = torch.Generator().manual_seed(2)
    probes = [torch.randn(len(faces), *shape, generator=random, dtype=torch.float64) for shape in ((3,), (3, 3), ())]
    if only is not None:
        for probe in probes:
            probe[torch.arange(len(faces)) != only] = 0.0
    outputs: list[tuple[Tensor, ...]] = []

    def loss(function):
        def run(v: Tensor) -> Tensor:
            found = tuple(function(v, ids))
            outputs.append(tuple(value.detach() for value in found))
            scales = (size, 1.0, size)
            return sum((p.to(f.dtype) * f / s).sum() for p, f, s in zip(probes, found, scales, strict=True))  # type: ignore

        return run

    found = gradients(loss(face_frames), [single])[1]
    true = gradients(loss(_textbook if textbook else face_frames), [single.double()])[1]
    (T, R, k), (T0, R0, k0) = outputs
    upright = R.double().transpose(-1, -2) @ R.double() - torch.eye(3, dtype=torch.float64)
    chosen = slice(None) if only is None else slice(only, only + 1)
    gap, span = (T.double() - T0)[chosen], size * max(1, len(T0[chosen])) ** 0.5
    forward = max(
        float(gap.norm()) / span,
        relative(R[chosen], R0[chosen]),
        relative(k[chosen], k0[chosen], least=1e-3 * span),
        float(upright.abs().max() if len(R) else 0.0),
    )
    finite = all(bool(torch.isfinite(value).all()) for value in (T, R, k, *found))
    return Sample(forward if finite else float("nan"), gradient_error(found, true))


def _cell(condition: str, axis: str, levels: tuple[Level, ...], oracle: str, **more: Any):
    return cell("frames", "face_frames float32", condition, axis, levels, oracle=oracle, **more)


@_cell(
    "size of the mesh",
    "width [m]",
    (1.0, 1e-3, 1e-6, 1e-12, 1e-17, 1e3, 1e6, 1e12),
    _TEXTBOOK,
    quick=(1.0, 1e-12, 1e12),
)
def _size(size: float) -> Sample:
    verts, faces = patch()
    return _measure(verts * size, faces, textbook=True, size=size)


_FAR = tuple(
    Limit(lambda offset, most=most: offset == most, 1e-7 * most, 1e-4, "centroids are rounded to float32")
    for most in (1e2, 1e3, 1e4)
)


@_cell("mesh far from the origin", "offset / width [1]", (0.0, 1.0, 10.0, 1e2, 1e3, 1e4), _TEXTBOOK, limits=_FAR)
def _offset(offset: float) -> Sample:
    verts, faces = patch()
    return _measure(verts + offset * np.array([1.0, -0.7, 0.4]), faces, textbook=True)


@_cell(
    "sliver",
    "height / edge of one face [1]",
    (1.0, 1e-1, 1e-2, 2e-3),
    _TEXTBOOK,
    limits=(
        Limit(lambda ratio: float(ratio) <= 1e-2, 1e-4, 1e-3, "the normal of a thin face from 24-bit coordinates"),
    ),
)
def _sliver(ratio: float) -> Sample:
    verts, faces = _with_sliver(ratio)
    return _measure(verts, faces, textbook=True, only=len(faces) - 1)


@_cell(
    "sliver under the threshold",
    "height / edge of one face [1]",
    (9e-4, 5e-4, 2e-4, 1e-4, 1e-6, 1e-12, 0.0),
    _DEFINITION,
    quick=(5e-4, 0.0),
    limits=(Limit(lambda ratio: float(ratio) <= 9e-4, 2e-3, 1e-2, "frame between the face's own and its neighbours'"),),
)
def _flat(ratio: float) -> Sample:
    verts, faces = _with_sliver(ratio)
    return _measure(verts, faces, textbook=False)


def _with_sliver(ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """The patch with one more face along an edge, of small height."""
    verts, faces = patch()
    a, b = verts[0], verts[4]
    verts = np.concatenate((verts, [0.6 * a + 0.4 * b - [0, ratio * np.linalg.norm(b - a), 0]]))
    return verts, np.concatenate((faces, [[4, 0, len(verts) - 1]]))


@_cell(
    "degenerate mesh",
    "case",
    (
        "repeated vertex",
        "first edge of no length",
        "three corners in one point",
        "isolated sliver",
        "isolated point",
        "whole mesh in one point",
        "faces folded onto each other",
        "one face",
        "no face",
        "normal along -z",
    ),
    _DEFINITION,
    quick=("repeated vertex", "whole mesh in one point"),
    limits=(Limit(lambda case: True, 1e-3, 1e-3, "frame of the neighbours"),),
)
def _degenerate(case: str) -> Sample:
    verts, faces = patch()
    if case == "repeated vertex":
        faces = np.concatenate((faces, [[3, 3, 7]]))
    elif case == "first edge of no length":
        verts = np.concatenate((verts, verts[:1]))
        faces = np.concatenate((faces, [[0, 16, 5]]))
    elif case == "three corners in one point":
        faces = np.concatenate((faces, [[5, 5, 5]]))
    elif case in ("isolated sliver", "isolated point"):
        extra = [[2.0, 0, 0], [3.0, 0, 0], [2.5, 0, 0]] if case == "isolated sliver" else [[2.0, 0, 0]] * 3
        verts = np.concatenate((verts, extra))
        faces = np.concatenate((faces, [[16, 17, 18]]))
    elif case == "whole mesh in one point":
        verts = np.zeros_like(verts) + 0.5
    elif case == "faces folded onto each other":
        faces = np.concatenate((faces, faces[:, ::-1]))
    elif case == "one face":
        faces = faces[:1]
    elif case == "no face":
        faces = faces[:0]
    else:
        verts = verts * [1.0, -1.0, 0.0]
    return _measure(verts, faces, textbook=False)


@cell(
    "frames",
    "initial_half_extents",
    "sliver",
    "height / edge of one face [1]",
    (1.0, 1e-2, 1e-4, 1e-12, 0.0),
    oracle=_DEFINITION,
    limits=(Limit(lambda ratio: float(ratio) <= 1e-2, 1e-3, 1e-3, "the face's frame has few digits"),),
)
def _extents(ratio: float) -> Sample:
    verts, faces = _with_sliver(ratio)
    results = []
    for dtype in (torch.float32, torch.float64):
        points, ids = torch.tensor(verts, dtype=torch.float32).to(dtype), torch.tensor(faces)
        results.append(initial_half_extents(points, ids, face_frames(points, ids), margin=1.2))
    return Sample(relative(*results) if bool((results[0] > 0).all()) else float("nan"))
