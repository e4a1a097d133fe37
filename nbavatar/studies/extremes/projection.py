"""Cells of the projection that all rasterizer backends share, in float64, against ray-plane intersection in mpmath."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from nbavatar.camera.pinhole import project
from nbavatar.rendering.billboards.projection import project_billboards
from nbavatar.studies.extremes.cells import DOUBLE, Level, Limit, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import derivative, gradient_error, gradients, precise, relative
from nbavatar.studies.extremes.raster import camera, tilted

__all__: list[str] = []

_ORACLE = "ray-plane intersection, 50 digits (mpmath)"
_EXACT = Tolerance(1e-9, 1e-8)


def _intersect(
    means: np.ndarray,
    quats: np.ndarray,
    extents: np.ndarray,
    view: np.ndarray,
    K: np.ndarray,
    pixel: tuple[float, float],
) -> tuple[object, object, object]:
    """Texture coordinates (u, v) and inverse depth of one billboard at one pixel, in mpmath."""
    from mpmath import mpf

    w, x, y, z = quats / np.sqrt((quats * quats).sum())
    two = mpf(2)
    axes = np.array(
        [
            [1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
            [two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)],
            [two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)],
        ]
    )
    axes = view[:3, :3] @ axes
    centre = view[:3, :3] @ means + view[:3, 3]
    down = (mpf(pixel[1]) - K[1, 2]) / K[1, 1]
    ray = np.array([(mpf(pixel[0]) - K[0, 2] - K[0, 1] * down) / K[0, 0], down, mpf(1)])
    normal = axes[:, 2]
    depth = (normal @ centre) / (normal @ ray)
    point = depth * ray - centre
    return point @ axes[:, 0] / extents[0], point @ axes[:, 1] / extents[1], 1 / depth


def _measure(tensors: list[Tensor], pose: Tensor | None = None, matrix: Tensor | None = None) -> Sample:
    """Errors at a pixel within the billboard of (u, v, 1/z), and of the gradient of a mix of u and v.

    The inverse depth only settles the order of hits and has no gradient.
    """
    import mpmath

    view = pose if pose is not None else torch.eye(4, dtype=torch.float64)
    K = matrix if matrix is not None else camera()
    inputs = [tensor[:1].double() for tensor in tensors[:3]]
    centre = view[:3, :3] @ inputs[0][0] + view[:3, 3]
    middle = K @ (centre / centre[2])
    pixel = float(middle[0]) + 0.3, float(middle[1]) - 0.2
    at = torch.tensor([*pixel, 1.0], dtype=torch.float64)
    mix = torch.tensor([0.7, -0.4, 0.0], dtype=torch.float64)
    values: list[Tensor] = []

    def loss(means: Tensor, quats: Tensor, extents: Tensor) -> Tensor:
        projection = project_billboards(means, quats, extents, view, K, near=1e-6, low_pass=0.0, support=1.0)
        p = (projection.plane[0] * at).sum(-1)
        values.append(torch.stack((p[0] / p[2], p[1] / p[2], p[2])))
        return (values[-1] * mix).sum()

    found = gradients(loss, inputs)[1]
    with mpmath.workdps(60):
        exact = [precise(tensor[0].numpy()) for tensor in inputs]
        motion, intrinsics = precise(view.numpy()), precise(K.numpy())
        weights = precise(mix.numpy())

        def truth(*arrays: np.ndarray) -> object:
            return sum(a * b for a, b in zip(_intersect(*arrays, motion, intrinsics, pixel), weights, strict=True))

        true = np.array([float(value) for value in _intersect(*exact, motion, intrinsics, pixel)])
        slopes = [derivative(lambda moved, k=k: truth(*exact[:k], moved, *exact[k + 1 :]), exact[k]) for k in range(3)]
    return Sample(
        max(relative(v, t) for v, t in zip(values[0].detach(), true, strict=True)), gradient_error(found, slopes)
    )


def _cell(condition: str, axis: str, levels: tuple[Level, ...], **more: Any):
    return cell("projection", "float64", condition, axis, levels, oracle=_ORACLE, exact=_EXACT, **more)


@_cell(
    "grazing view",
    "angle to the plane [deg]",
    (45.0, 10.0, 1.0, 0.1, 1e-2, 1e-4, 1e-6),
    limits=(Limit(lambda angle: float(angle) <= 1e-2, 1e-6, 1e-5, "n . c loses digits in proportion to the angle"),),
)
def _grazing(angle: float) -> Sample:
    tensors = tilted(45.0, count=1)
    half = 0.5 * np.radians(90.0 - angle)
    tensors[1] = torch.tensor([[np.cos(half), np.sin(half), 0.0, 0.0]], dtype=torch.float64)
    return _measure(tensors)


@_cell("size", "half-extent [m]", (0.3, 1.0, 1e3, 1e6, 1e-3, 1e-6, 1e-9))
def _size(size: float) -> Sample:
    tensors = tilted(40.0, count=1)
    tensors[2] = torch.tensor([[size, 0.7 * size]], dtype=torch.float64)
    return _measure(tensors)


@_cell("depth", "depth [m]", (1.0, 0.02, 10.0, 1e3, 1e6))
def _depth(depth: float) -> Sample:
    return _measure(tilted(40.0, size=0.3 * depth, depth=depth, count=1))


@_cell(
    "small and far",
    "depth / half-extent [1]",
    (10.0, 1e3, 1e5, 1e7),
    limits=(Limit(lambda ratio: float(ratio) >= 1e7, 1e-7, 1e-6, "differences of cross products of far vectors"),),
)
def _far(ratio: float) -> Sample:
    return _measure(tilted(40.0, size=1.0 / ratio, count=1))


@_cell(
    "scene far from the origin",
    "offset [m]",
    (0.0, 1.0, 1e2, 1e4, 1e6),
    limits=(Limit(lambda offset: float(offset) >= 1e4, 1e-8, 1e-7, "R m + t is right to 1e-16 of the offset"),),
)
def _offset(offset: float) -> Sample:
    tensors = tilted(40.0, count=1)
    rotation = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    place = np.array([1.0, -0.7, 0.4]) * offset
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = torch.tensor(rotation)
    view[:3, 3] = torch.tensor(-rotation @ place)
    mean = rotation.T @ tensors[0][0].double().numpy() + place
    tensors[0] = torch.tensor(mean[None])
    # The billboard's rotation in the world, so that it looks the same to the camera.
    from nbavatar.math.rotations import matrix_to_quaternion, quaternion_multiply

    tensors[1] = quaternion_multiply(matrix_to_quaternion(torch.tensor(rotation.T)), tensors[1].double())
    return _measure(tensors, view)


@_cell("focal length", "f [px]", (24.0, 1.0, 1e4, 1e8))
def _focal(focal: float) -> Sample:
    return _measure(tilted(40.0, count=1), matrix=camera(focal))


@_cell(
    "principal point off the image",
    "shift [px]",
    (0.0, 1e3, 1e6, 1e9),
    limits=(Limit(lambda shift: float(shift) >= 1e9, 1e-5, 1e-5, "pixel coordinates have 53 bits"),),
)
def _principal(shift: float) -> Sample:
    return _measure(tilted(40.0, count=1), matrix=camera(24.0 + shift, shift, -shift))


@cell(
    "projection",
    "pinhole project",
    "points far from the origin, float32",
    "offset [m]",
    (0.0, 10.0, 1e2, 1e3, 1e4),
    oracle="float64 on the same numbers",
    unit="px",
    exact=Tolerance(1e-2, 1e-4),
    limits=(Limit(lambda offset: float(offset) >= 1e2, 5.0, 1.0, "float32 holds 1e-7 of the offset; use float64"),),
)
def _pinhole_single(offset: float) -> Sample:
    return _pinhole(offset, np.float32)


@cell(
    "projection",
    "pinhole project",
    "points far from the origin, float64",
    "offset [m]",
    (0.0, 1e2, 1e4, 1e6),
    oracle="50 digits (mpmath)",
    unit="px",
    exact=Tolerance(1e-6, 1e-6),
)
def _pinhole_double(offset: float) -> Sample:
    return _pinhole(offset, np.float64)


def _pinhole(offset: float, dtype: type) -> Sample:
    import mpmath

    random = np.random.default_rng(1)
    place = offset * np.array([1.0, -0.7, 0.4])
    points = (random.uniform(-0.3, 0.3, (5, 3)) + [0, 0, 1.0] + place).astype(dtype)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    points = (points @ turn).astype(dtype)
    view = np.eye(4, dtype=dtype)
    view[:3, :3], view[:3, 3] = turn, -place
    K = np.array([[1000, 0, 512], [0, 1000, 512], [0, 0, 1]], dtype)
    pixels, _ = project(points, K, view)
    with mpmath.workdps(50):
        camera_points = precise(points) @ precise(view[:3, :3]).T + precise(view[:3, 3])
        true = camera_points[:, :2] / camera_points[:, 2:] * 1000 + 512
        return Sample(float(np.abs(pixels - true.astype(np.float64)).max()))


@cell(
    "projection",
    "pinhole project",
    "points at depth 0 and behind",
    "depth [m]",
    (1.0, 1e-6, 1e-30, -1.0),
    oracle="50 digits (mpmath)",
    exact=DOUBLE,
)
def _pinhole_depth(depth: float) -> Sample:
    K = np.array([[1000.0, 0, 512], [0, 1000.0, 512], [0, 0, 1]])
    pixels, found = project(np.array([[0.5 * depth, -0.25 * depth, depth]]), K, np.eye(4))
    return Sample(max(relative(pixels, [[1012.0, 262.0]]), relative(found, [depth])))
