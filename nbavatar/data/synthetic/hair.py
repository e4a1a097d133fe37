"""Hair that stands off the head: a ponytail, as a closed tube in the axes of the head's template."""

import numpy as np

__all__ = ["ponytail"]

# Centre line [mm] from the origin between the eyes (x to the subject's left, y up, z forward) and radius [mm]: from the
# back of the head outwards, then down behind the left shoulder.
_LINE = np.array(
    [
        [18.0, 48.0, -148.0, 15.0],
        [34.0, 66.0, -188.0, 17.0],
        [58.0, 56.0, -220.0, 23.0],
        [82.0, 12.0, -234.0, 26.0],
        [96.0, -38.0, -230.0, 24.0],
        [98.0, -84.0, -220.0, 17.0],
        [96.0, -112.0, -214.0, 6.0],
    ]
)
_RINGS, _SIDES = 36, 20


def ponytail(scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] from the origin between the eyes, and faces (F, 3), counter-clockwise seen from outside.

    Args:
        scale: of its thickness.
    """
    from scipy.interpolate import CubicSpline

    knots = np.linspace(0.0, 1.0, len(_LINE))
    curve = CubicSpline(knots, _LINE)(np.linspace(0.0, 1.0, _RINGS))
    path, radius = 1e-3 * curve[:, :3], 1e-3 * scale * curve[:, 3]
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [0.3, 0.2, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(along, side)
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    # Strands make it uneven.
    uneven = 1.0 + 0.06 * np.sin(5 * angle + 9 * np.linspace(0, 1, _RINGS)[:, None])
    ring = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * other[:, None]
    tube = path[:, None] + (radius[:, None] * uneven)[..., None] * ring
    verts = np.concatenate([tube.reshape(-1, 3), path[[0, -1]]])
    faces, last = [], (_RINGS - 1) * _SIDES
    for s in range(_SIDES):
        t = (s + 1) % _SIDES
        faces += [[s, len(verts) - 2, t], [last + s, last + t, len(verts) - 1]]
        for r in range(_RINGS - 1):
            a, b = r * _SIDES + s, r * _SIDES + t
            faces += [[a, b, a + _SIDES], [b, b + _SIDES, a + _SIDES]]
    return verts, np.array(faces)
