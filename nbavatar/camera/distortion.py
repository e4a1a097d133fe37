"""Lens distortion in OpenCV's rational model, and maps that remove it.

`x_d = x (1 + k1 r2 + k2 r4 + k3 r6) / (1 + k4 r2 + k5 r4 + k6 r6) + 2 p1 x y + p2 (r2 + 2 x2) + s1 r2 + s2 r4`, and
alike for y with p1 and p2, s3 and s4 in their place; coefficients in OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2
s3 s4]]]. Coordinates x, y are those of the plane z = 1 of the camera. Tilted sensors (14 coefficients) are refused.
"""

import numpy as np

from nbavatar.errors import DataError

__all__ = [
    "checked_coefficients",
    "distort_pixels",
    "distort_plane",
    "distort_vertices",
    "undistort_pixels",
    "undistortion_map",
]

_COUNTS = (4, 5, 8, 12)


def checked_coefficients(values: object, where: str) -> np.ndarray | None:
    """Validates distortion coefficients.

    Args:
        values: sequence of 4, 5, 8 or 12 numbers (14 if the last two are 0), of any nesting.
        where: file and field, for the error line.

    Returns:
        float64 `[12]`, zero where not given, or None if all are zero.

    Raises:
        DataError: another count, not numbers, or not finite.
    """
    try:
        flat = np.asarray(values, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise DataError.of(where, expected="distortion coefficients", found=type(values).__name__) from None
    if len(flat) == 14 and not flat[12:].any():
        flat = flat[:12]
    if len(flat) not in _COUNTS:
        raise DataError.of(where, expected="4, 5, 8 or 12 distortion coefficients", found=len(flat))
    if not np.isfinite(flat).all():
        raise DataError.of(where, expected="finite distortion coefficients", found=str(flat.tolist()))
    return np.pad(flat, (0, 12 - len(flat))) if flat.any() else None


def distort_plane(xy: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Maps ideal points of the plane z = 1 to where the lens puts them.

    Args:
        xy: `[..., 2]`.
        distortion: 4, 5, 8 or 12 coefficients.

    Returns:
        `[..., 2]`, float64.
    """
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = np.pad(distortion, (0, 12 - len(distortion)))
    xy = np.asarray(xy, dtype=np.float64)
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2)
    dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4)
    return np.stack([x * radial + dx, y * radial + dy], axis=-1)


def distort_pixels(pixels: np.ndarray, K: np.ndarray, distortion: np.ndarray | None) -> np.ndarray:
    """Maps ideal pixels `[..., 2]` [px] of camera `K` to pixels of the distorted image."""
    if distortion is None:
        return np.asarray(pixels, dtype=np.float64)
    return _from_plane(distort_plane(_to_plane(pixels, K), distortion), K)


def undistort_pixels(
    pixels: np.ndarray, K: np.ndarray, distortion: np.ndarray | None, *, iterations: int = 30
) -> np.ndarray:
    """Maps pixels `[..., 2]` [px] of the distorted image to ideal ones, the inverse of `distort_pixels`.

    Newton's iteration with a numerical Jacobian; points where the lens model folds over (far outside the image)
    do not converge and come back as NaN.
    """
    if distortion is None:
        return np.asarray(pixels, dtype=np.float64)
    target = _to_plane(pixels, K)
    guess, det = target.copy(), np.ones(target.shape[:-1])
    step = 1e-6
    for _ in range(iterations):
        error = distort_plane(guess, distortion) - target
        jx = (distort_plane(guess + [step, 0], distortion) - distort_plane(guess - [step, 0], distortion)) / (2 * step)
        jy = (distort_plane(guess + [0, step], distortion) - distort_plane(guess - [0, step], distortion)) / (2 * step)
        det = jx[..., 0] * jy[..., 1] - jx[..., 1] * jy[..., 0]
        det = np.where(np.abs(det) < 1e-9, np.nan, det)
        delta_x = (jy[..., 1] * error[..., 0] - jy[..., 0] * error[..., 1]) / det
        delta_y = (jx[..., 0] * error[..., 1] - jx[..., 1] * error[..., 0]) / det
        guess = guess - np.stack([delta_x, delta_y], axis=-1)
        if np.nanmax(np.abs(error), initial=0.0) < 1e-13:
            break
    missed = np.abs(distort_plane(guess, distortion) - target).max(axis=-1)
    # The equation has further roots beyond the radius where the lens folds over: there the orientation flips
    # (negative determinant) or the point lies on the other side of the axis.
    good = (missed < 1e-8) & (det > 0) & ((guess * target).sum(axis=-1) >= 0)
    return _from_plane(np.where(good[..., None], guess, np.nan), K)


def undistortion_map(
    K: np.ndarray, distortion: np.ndarray, new_K: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of an ideal image comes from in the distorted one.

    Args:
        K: camera matrix of the distorted image [px].
        distortion: its coefficients.
        new_K: camera matrix of the ideal image [px], for example that of a crop.
        width: width of the ideal image [px].
        height: its height [px].

    Returns:
        x and y, float32 `[H, W]`, as pixel INDICES of the source (its pixel centres at whole numbers, as
        `cv2.remap` takes them).
    """
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    source = _from_plane(distort_plane(_to_plane(grid, new_K), distortion), K) - 0.5
    return source[..., 0].astype(np.float32), source[..., 1].astype(np.float32)


def _to_plane(pixels: np.ndarray, K: np.ndarray) -> np.ndarray:
    pixels = np.asarray(pixels, dtype=np.float64)
    y = (pixels[..., 1] - K[1][2]) / K[1][1]
    x = (pixels[..., 0] - K[0][2] - K[0][1] * y) / K[0][0]
    return np.stack([x, y], axis=-1)


def _from_plane(xy: np.ndarray, K: np.ndarray) -> np.ndarray:
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([K[0][0] * x + K[0][1] * y + K[0][2], K[1][1] * y + K[1][2]], axis=-1)


def distort_vertices(points: np.ndarray, distortion: np.ndarray | None, reach: float) -> np.ndarray:
    """Moves points so that a pinhole camera sees them where the lens would.

    Args:
        points: `[V, 3]` in camera axes [m]; those behind the camera stay as they are.
        distortion: coefficients, or None.
        reach: radius in the plane z = 1 up to which the lens model is trusted (that of the farthest image corner);
            beyond, the displacement at that radius is kept in proportion, so that the model cannot fold points back
            into view.

    Returns:
        `[V, 3]`, depth unchanged.
    """
    if distortion is None:
        return points
    result = np.array(points, dtype=np.float64)
    front = result[:, 2] > 1e-6
    xy = result[front, :2] / result[front, 2:]
    shrink = np.minimum(1.0, reach / np.maximum(np.linalg.norm(xy, axis=1, keepdims=True), 1e-12))
    result[front, :2] = distort_plane(xy * shrink, distortion) / shrink * result[front, 2:]
    return result
