"""Colours that depend on the direction of view: real spherical harmonics up to degree 3.

The basis is the real one with the Condon-Shortley phase, in the order (l, m) = (0, 0), (1, -1),
(1, 0), (1, 1), (2, -2) ...: with the complex Y_l^m of physics (scipy's `sph_harm_y`),

    m > 0: sqrt(2) Re Y_l^m,    m = 0: Y_l^0,    m < 0: sqrt(2) Im Y_l^|m|.

On the unit sphere each is a homogeneous polynomial of degree l in x, y, z, and as such is
evaluated here. Colour is the sum over the basis plus 0.5, cut off at 0 (Kerbl et al. 2023).
"""

import math

import torch
from torch import Tensor

__all__ = ["DEGREES", "L0", "L1", "L2", "L3", "basis", "harmonic_colours", "harmonic_count"]

DEGREES = (0, 1, 2, 3)

L0 = math.sqrt(1 / (4 * math.pi))
L1 = math.sqrt(3 / (4 * math.pi))
L2 = (math.sqrt(15 / (4 * math.pi)), math.sqrt(5 / (16 * math.pi)), math.sqrt(15 / (16 * math.pi)))
L3 = (
    math.sqrt(35 / (32 * math.pi)),
    math.sqrt(105 / (4 * math.pi)),
    math.sqrt(21 / (32 * math.pi)),
    math.sqrt(7 / (16 * math.pi)),
    math.sqrt(105 / (16 * math.pi)),
)


def harmonic_count(degree: int) -> int:
    """Number of basis functions up to a degree."""
    return (degree + 1) ** 2


def basis(directions: Tensor, degree: int) -> list[Tensor]:
    """Values of the basis functions.

    Args:
        directions: (..., 3) unit vectors.
        degree: highest degree, 0 to 3.

    Returns:
        `harmonic_count(degree)` tensors (...), in the order of the module's description.
    """
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, L0)]
    if degree > 0:
        values += [-L1 * y, L1 * z, -L1 * x]
    if degree > 1:
        a, b, c = L2
        xx, yy, zz = x * x, y * y, z * z
        values += [a * (x * y), -a * (y * z), b * (3 * zz - 1), -a * (x * z), c * (xx - yy)]
        if degree > 2:
            a, b, c, d, e = L3
            values += [
                -a * y * (3 * xx - yy),
                b * (x * y) * z,
                -c * y * (5 * zz - 1),
                d * z * (5 * zz - 3),
                -c * x * (5 * zz - 1),
                e * z * (xx - yy),
                -a * x * (xx - 3 * yy),
            ]
    return values


def harmonic_colours(coefficients: Tensor, offsets: Tensor, degree: int) -> Tensor:
    """Colours of Gaussians seen from a point.

    Args:
        coefficients: (N, K, 3) with K at least `harmonic_count(degree)`; those beyond are not used.
        offsets: (N, 3) from the camera to the centres, of any length; a zero offset looks along z.
        degree: 0 to 3.

    Returns:
        (N, 3) colours, at least 0, in the dtype of the coefficients. Where the cut-off acts the gradient is 0.
    """
    terms = coefficients.unbind(1)
    directions = offsets
    if degree > 0:
        # unbound, not multiplied as matrices: a row's bits then do not depend on its place
        x, y, z = offsets.unbind(-1)
        squared = x * x + y * y + z * z
        somewhere = squared > 0
        length = torch.where(somewhere, squared, 1.0).sqrt()
        directions = torch.stack([x / length, y / length, torch.where(somewhere, z / length, 1.0)], -1).to(
            coefficients.dtype
        )
    colour = terms[0] * L0 + 0.5
    for value, term in zip(basis(directions, degree)[1:], terms[1:], strict=False):
        colour = colour + value[:, None] * term
    return colour.clamp_min(0.0)
