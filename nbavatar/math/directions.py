"""Directions in space, in numpy: spread over the sphere, and axes across a given one."""

import numpy as np

__all__ = ["axes_along", "sphere_directions"]


def sphere_directions(count: int) -> np.ndarray:
    """Unit vectors spread evenly over the sphere, float64 (count, 3), by a Fibonacci lattice (Gonzalez 2010).

    Args:
        count: how many, one at least.
    """
    place = np.arange(count) + 0.5
    z = 1.0 - 2.0 * place / count
    angle = place * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def axes_along(directions: np.ndarray) -> np.ndarray:
    """Right-handed orthonormal axes whose third is the direction; which way the other two point is arbitrary.

    Args:
        directions: unit, float64 (K, 3).

    Returns:
        float64 (K, 3, 3), an axis a row.
    """
    # The helper is never within 36 degrees of the direction, so the cross product keeps its digits.
    helper = np.where(np.abs(directions[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    right = np.cross(helper, directions)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(directions, right), directions], axis=1)
