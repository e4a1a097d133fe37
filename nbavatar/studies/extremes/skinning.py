"""Cells of linear blend skinning, float32 and float64, against a twin in float64 that shares no formula with it.

The twin multiplies 4x4 matrices about each joint and takes rotations as matrix exponentials; gradients by autograd.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.bodymodels.lbs import skinned_mesh
from nbavatar.fitting.parts import right_jacobian
from nbavatar.fitting.points import skew
from nbavatar.math.rotations import axis_angle_to_matrix
from nbavatar.studies.extremes.cells import DOUBLE, SINGLE, Level, Limit, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import gradient_error, gradients, relative

__all__: list[str] = []

_VERTS, _SIZE = 24, 0.1
_ANGLES = (
    0.0, 1e-30, 1e-10, 1e-5, 9.99e-4, 1e-2, 1.0, math.pi - 1e-3, math.pi - 1e-6, math.pi, 2 * math.pi - 1e-3,
    2 * math.pi, 1e2, 1e4, 1e6,
)  # fmt: skip
_QUICK = (0.0, math.pi, 2 * math.pi)
_GROWS = tuple(
    Limit(lambda angle, most=most: angle == most, 3e-7 * most, 3e-6 * most, "24 bits of the angle, less its turns")
    for most in (1e2, 1e4, 1e6)
)
_FAR = tuple(
    Limit(lambda offset, most=most: offset == most, 3e-6 * most, 3e-5 * most, "24 bits of the offset")
    for most in (1e2, 1e4, 1e6)
)
_CASES = (
    "one joint", "no shape directions", "a vertex bound to nothing", "weights of sum 2", "all joints in one place",
    "a star of joints", "NaN in another pose",
)  # fmt: skip


def _body(joints: int = 4, shapes: int = 3) -> dict[str, Any]:
    """Arrays of a random body about 10 cm wide, its joints in a chain."""
    random = np.random.default_rng(7)
    weights = random.random((_VERTS, joints)) ** 4
    regressor = random.random((joints, _VERTS)) ** 8
    return {
        "template": _SIZE * random.normal(size=(_VERTS, 3)),
        "shape_dirs": 0.1 * _SIZE * random.normal(size=(_VERTS, 3, shapes)),
        "pose_dirs": 0.02 * _SIZE * random.normal(size=(_VERTS, 3, 9 * (joints - 1))),
        "joint_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "parents": tuple(range(-1, joints - 1)),
    }


def _twin(body: dict[str, Any], shape: Tensor, vectors: Tensor, shift: Tensor) -> Tensor:
    """Posed vertices `[V, 3]` in float64."""
    arrays = {name: torch.tensor(value) for name, value in body.items() if name != "parents"}
    shaped = arrays["template"] + arrays["shape_dirs"] @ shape
    joints = arrays["joint_regressor"] @ shaped
    turns = torch.linalg.matrix_exp(skew(vectors))
    posed = shaped + arrays["pose_dirs"] @ (turns[1:] - torch.eye(3, dtype=torch.float64)).reshape(-1)
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    worlds: list[Tensor] = []
    for j, parent in enumerate(body["parents"]):
        about = torch.cat([torch.cat([turns[j], (joints[j] - turns[j] @ joints[j])[:, None]], 1), last])
        worlds.append(about if parent < 0 else worlds[parent] @ about)
    whole = torch.cat([posed, torch.ones(len(posed), 1, dtype=torch.float64)], 1)
    return torch.einsum("vj,jab,vb->va", arrays["weights"], torch.stack(worlds)[:, :3], whole) + shift


def _compare(
    body: dict[str, Any], shape: np.ndarray, vectors: np.ndarray, shift: float = 0.0, dtype: torch.dtype = torch.float32
) -> Sample:
    """Errors of vertices, in units of the body's size, and of the gradients by shape, angles and translation."""
    mesh = skinned_mesh(**body, dtype=dtype)
    probe = torch.randn(_VERTS, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inputs = [torch.tensor(value).to(dtype) for value in (shape, vectors, np.array([shift, -shift, 0.5 * shift]))]
    values: list[Tensor] = []

    def posed(b: Tensor, v: Tensor, t: Tensor) -> Tensor:
        values.append(mesh.pose(b[None], axis_angle_to_matrix(v)[None]).verts[0] + t)
        return (values[-1] * probe.to(dtype)).sum()

    def twin(b: Tensor, v: Tensor, t: Tensor) -> Tensor:
        values.append(_twin(body, b, v, t))
        return (values[-1] * probe).sum()

    # The twin has the arrays as the kernel has them, so that only the computation is compared.
    body = body | {
        name: np.asarray(torch.tensor(value).to(dtype).to(torch.float64))
        for name, value in body.items()
        if name not in ("parents", "joint_regressor")
    }
    found = gradients(posed, inputs)[1]
    true = gradients(twin, [value.double() for value in inputs])[1]
    size = float(torch.linalg.norm(values[1].detach() - values[1].detach().mean(0)))
    gap = (values[0].detach().double() - values[1].detach()) / (size or 1.0)
    return Sample(relative(gap, torch.zeros_like(gap)), gradient_error(found, true))


def _pose(angle: float, joints: int = 4) -> np.ndarray:
    axes = np.random.default_rng(3).normal(size=(joints, 3))
    return angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)


_SHAPE = np.array([0.7, -1.2, 0.4])


def _cell(kernel: str, condition: str, axis: str, levels: tuple[Level, ...], exact: Tolerance = SINGLE, **more: Any):
    oracle = "4x4 matrices and their exponentials, float64"
    return cell("skinning", kernel, condition, axis, levels, oracle=oracle, unit="error / size", exact=exact, **more)


@_cell("pose float32", "identity to many turns of all joints", "angle [rad]", _ANGLES, quick=_QUICK, limits=_GROWS)
def _angles(angle: float) -> Sample:
    return _compare(_body(), _SHAPE, _pose(angle))


@_cell("pose float64", "identity to many turns of all joints", "angle [rad]", _ANGLES, DOUBLE, quick=(math.pi,))
def _angles_double(angle: float) -> Sample:
    return _compare(_body(), _SHAPE, _pose(angle), dtype=torch.float64)


@_cell("pose float32", "huge shape coefficients", "coefficient [1]", (0.0, 1.0, 1e2, 1e6, 1e15, 1e30))
def _shapes(size: float) -> Sample:
    return _compare(_body(), size * _SHAPE, _pose(0.5))


@_cell("pose float32", "size of the body", "size [m]", (0.1, 1e-15, 1e-6, 1.0, 1e3, 1e15), quick=(0.1,))
def _sizes(size: float) -> Sample:
    body = _body()
    return _compare(body | {k: body[k] * (size / _SIZE) for k in ("template", "shape_dirs", "pose_dirs")}, _SHAPE,
                    _pose(0.5))  # fmt: skip


@_cell(
    "pose float32", "template far from its origin", "offset [m]", (0.0, 0.3, 1e2, 1e4, 1e6), quick=(0.3, 1e4),
    limits=_FAR,
)  # fmt: skip
def _far_template(offset: float) -> Sample:
    body = _body()
    return _compare(body | {"template": body["template"] + offset * np.array([1.0, -0.7, 0.4])}, _SHAPE, _pose(0.5))


@_cell("pose float32", "far from the origin", "translation [m]", (0.0, 0.3, 1e2, 1e4, 1e6), limits=_FAR)
def _far(shift: float) -> Sample:
    return _compare(_body(), _SHAPE, _pose(0.5), shift)


@_cell("pose float32", "long chains", "joints [1]", (2.0, 16.0, 55.0, 400.0), quick=(16.0,))
def _chain(joints: float) -> Sample:
    return _compare(_body(int(joints)), _SHAPE, _pose(0.5, int(joints)))


@_cell("pose float32", "odd bodies", "case", _CASES, quick=_CASES[2:3])
def _odd(case: str) -> Sample:
    body = _body(1) if case == "one joint" else _body(shapes=0) if case == "no shape directions" else _body()
    shape, vectors = _SHAPE[: body["shape_dirs"].shape[2]], _pose(0.5, len(body["parents"]))
    if case == "a vertex bound to nothing":
        body["weights"][3] = 0.0
    elif case == "weights of sum 2":
        body["weights"] = 2.0 * body["weights"]
    elif case == "all joints in one place":
        body["joint_regressor"][1:] = body["joint_regressor"][0]
    elif case == "a star of joints":
        body["parents"] = (-1, 0, 0, 0)
    elif case == "NaN in another pose":
        mesh = skinned_mesh(**body, dtype=torch.float64)
        turns = axis_angle_to_matrix(torch.tensor(np.stack([vectors, vectors * np.nan])))
        found = mesh.pose(torch.tensor(np.stack([shape, shape * np.nan])), turns).verts[0]
        return Sample(relative(found, _twin(body, *(torch.tensor(v) for v in (shape, vectors, np.zeros(3))))))
    return _compare(body, shape, vectors)


@_cell("centroid float32", "template far from its origin", "offset [m]", (0.0, 0.3, 1e2, 1e4, 1e6), quick=(0.3,),
       limits=_FAR)  # fmt: skip
def _centroid(offset: float) -> Sample:
    body = _body()
    body["template"] = (body["template"] + offset).astype(np.float32).astype(np.float64)
    turns = axis_angle_to_matrix(torch.tensor(_pose(0.5)))
    found = skinned_mesh(**body).mean(torch.tensor(_SHAPE)[None].float(), turns[None].float())[0]
    true = _twin(body, *(torch.tensor(v) for v in (_SHAPE, _pose(0.5), np.zeros(3)))).mean(0)
    return Sample(float(torch.linalg.norm(found.double() - true)) / _SIZE)


@cell(
    "skinning", "right_jacobian float64", "identity to many turns", "angle [rad]", _ANGLES,
    quick=(0.0, 9.99e-4, 2 * math.pi), oracle="100 digits (mpmath)", exact=Tolerance(1e-12, 1.0),
    limits=(Limit(lambda angle: float(angle) >= 1e4, 1e-9, 1.0, "16 digits of the angle, less its turns"),),
)  # fmt: skip
def _jacobian(angle: float) -> Sample:
    import mpmath

    vector = _pose(angle, 1)[0]
    found = right_jacobian(torch.tensor(vector))
    with mpmath.workdps(100):
        x, y, z = (mpmath.mpf(float(v)) for v in vector)
        size = mpmath.sqrt(x * x + y * y + z * z)
        cross = mpmath.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        first = mpmath.mpf(1) / 2 if size == 0 else (1 - mpmath.cos(size)) / size**2
        second = mpmath.mpf(1) / 6 if size == 0 else (size - mpmath.sin(size)) / size**3
        true = mpmath.eye(3) - first * cross + second * cross * cross
    return Sample(relative(found, np.array(true.tolist()).astype(np.float64)))
