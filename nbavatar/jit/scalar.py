"""Arithmetic of one hit: the functions that all compiled kernels share.

Each is a few lines on numbers of one floating-point type, without branches and without access
to memory. They are written against four operations that the target supplies, so the same
source is compiled for eight pixels at a time (vector
instructions, `lanes.py`) and for a GPU thread. Numba would widen `float32 * literal` to
float64; every constant is therefore passed in as `zero` or `one`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

__all__ = ["Scalars", "build"]

Function = Callable[..., Any]


class Scalars(NamedTuple):
    """The compiled functions; see `build`."""

    affine: Function
    first_texel: Function
    weights: Function
    slopes: Function
    mix: Function
    plane_slopes: Function


def build(jit: Callable[[Function], Function], floor: Function, minimum: Function, maximum: Function,
          select: Function) -> Scalars:  # fmt: skip
    """Compiles the functions.

    Args:
        jit: compiler of the target.
        floor, minimum, maximum: on floating-point numbers, giving such.
        select: `select(condition, yes, no)`.
    """

    @jit
    def affine(a, b, c, x, y):
        """The function a x + b y + c of the pixel."""
        return a * x + (b * y + c)

    @jit
    def first_texel(t, size, zero, one):
        """First of the two texels, as a float, that surround texel coordinate t; 0 ... size - 2."""
        return maximum(minimum(floor(t), size - one - one), zero)

    @jit
    def weights(t, first, step, zero, one):
        """Weights of texels `first` and `first + step`: tents, so 0 for what lies outside the texture.

        `step` is 1, or 0 where the texture has a single texel and no second one.
        """
        d = t - first
        below = maximum(zero, one - maximum(d, -d))
        e = d - one
        above = maximum(zero, one - maximum(e, -e)) * step
        return below, above

    @jit
    def slopes(t, first, step, zero, one):
        """Derivatives of `weights` by t, from the right where the tent has a kink."""
        d = t - first
        e = d - one
        below = select((d >= -one) & (d < one), select(d < zero, one, -one), zero)
        above = select((e >= -one) & (e < one), select(e < zero, one, -one), zero) * step
        return below, above

    @jit
    def mix(t00, t01, t10, t11, x0, x1, y0, y1):
        """Bilinear value from texels t[row][column], column weights x and row weights y."""
        return y0 * (x0 * t00 + x1 * t01) + y1 * (x0 * t10 + x1 * t11)

    @jit
    def plane_slopes(grad_s, grad_t, s, t, r):
        """Gradients by p_s, p_t, p_w of coordinates s = p_s / p_w, t = p_t / p_w; r = 1 / p_w.

        Wherever the coordinates count from. From the texture's middle, as those of `Projection.plane` do, the
        result is that plane's gradient as it stands: a shift afterwards would subtract large sums.
        """
        return grad_s * r, grad_t * r, -(grad_s * s + grad_t * t) * r

    return Scalars(affine, first_texel, weights, slopes, mix, plane_slopes)
