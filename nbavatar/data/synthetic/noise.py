"""Value noise and the few scalar helpers that all procedural colours use; compiled, without allocation."""

import math

import numba

__all__ = ["helper", "jit", "noise", "put", "smooth_step", "white"]

# No checks for division by zero. One signature a helper: calls with whole numbers would compile it again for each
# mixture of
# types, which is most of the time of a first start.
_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy"}
jit = numba.njit(**_OPTIONS)


def helper(signature: str):
    """Decorator: compiles for exactly this signature."""
    return numba.njit(signature, **_OPTIONS)


@helper("f8(i8, i8, i8)")
def white(ix, iy, iz):
    """A number in [0, 1] for a lattice point, without pattern."""
    h = (ix * 374761393 + iy * 668265263 + iz * 1440662683) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFFFF) / 16777215.0


@helper("void(f8[:, ::1], i8, f8[::1])")
def noise(points, count, out):
    """Value noise in [-1, 1] on the unit lattice at `points` (count, 3), into `out`.

    One call for all the noises of a material: the function is inlined wherever it is called, and compiling it once
        instead of
    twenty times saves most of the start.
    """
    for j in range(count):
        fx, fy, fz = math.floor(points[j, 0]), math.floor(points[j, 1]), math.floor(points[j, 2])
        ix, iy, iz = int(fx), int(fy), int(fz)
        u, v, w = points[j, 0] - fx, points[j, 1] - fy, points[j, 2] - fz
        u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
        total = 0.0
        for i in range(8):
            a, b, c = i & 1, (i >> 1) & 1, i >> 2
            weight = (u if a else 1 - u) * (v if b else 1 - v) * (w if c else 1 - w)
            total += weight * white(ix + a, iy + b, iz + c)
        out[j] = 2 * total - 1


@helper("void(f8[:, ::1], i8, f8, f8, f8)")
def put(points, i, x, y, z):
    """Sets row `i` of `points` (n, 3)."""
    points[i, 0], points[i, 1], points[i, 2] = x, y, z


@helper("f8(f8, f8, f8)")
def smooth_step(lo, hi, x):
    """0 at `lo`, 1 at `hi` (which may be the smaller), smooth between."""
    t = min(max((x - lo) / (hi - lo), 0.0), 1.0)
    return t * t * (3 - 2 * t)
