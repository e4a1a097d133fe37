"""Hair off the scalp, which no mesh has: a ponytail, long hair over the shoulders, a full beard.

Lengths in the tables are millimetres from the origin between the eyes: x to the subject's left, y up, z forward.
"""

import numpy as np

from nbavatar.mesh.zbuffer import joined_meshes

__all__ = ["beard", "loose_hair"]

# Centre line and radius of the ponytail: from the back of the head outwards, then down behind the left shoulder.
_PONYTAIL = (
    (18.0, 48.0, -148.0, 15.0),
    (34.0, 66.0, -188.0, 17.0),
    (58.0, 56.0, -220.0, 23.0),
    (82.0, 12.0, -234.0, 26.0),
    (96.0, -38.0, -230.0, 24.0),
    (98.0, -84.0, -220.0, 17.0),
    (96.0, -112.0, -214.0, 6.0),
)
# Two locks that fall over the shoulders to the front, the left one further than the right one.
_LEFT_LOCK = (
    (64.0, 58.0, -70.0, 10.0),
    (82.0, 12.0, -74.0, 15.0),
    (86.0, -50.0, -62.0, 19.0),
    (84.0, -105.0, -40.0, 20.0),
    (84.0, -150.0, -16.0, 16.0),
    (80.0, -185.0, 0.0, 6.0),
)
_RIGHT_LOCK = (
    (-64.0, 58.0, -74.0, 10.0),
    (-82.0, 12.0, -80.0, 15.0),
    (-88.0, -50.0, -72.0, 18.0),
    (-90.0, -100.0, -54.0, 17.0),
    (-92.0, -136.0, -36.0, 6.0),
)
_CURTAIN = np.radians(np.arange(18.0, 163.0, 12.0))  # where locks hang at the back, from the left ear to the right one
_RINGS, _SIDES = 36, 20
_BEARD = 24.0  # thickness [mm]


def loose_hair(style: str) -> tuple[np.ndarray, np.ndarray]:
    """Hair that hangs off the head and moves with it, as closed tubes that may overlap.

    Args:
        style: one of `nbavatar.config.synthetic.HAIR`.

    Returns:
        vertices (V, 3) [m] from the origin between the eyes, and faces (F, 3), counter-clockwise seen from outside;
        without elements where a style has none.

    Raises:
        KeyError: an unknown style.
    """
    lines = {"cap": [], "beard": [], "ponytail": [_PONYTAIL], "long": [_LEFT_LOCK, _RIGHT_LOCK, *_curtain()]}[style]
    nothing = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    verts, faces, _ = joined_meshes([nothing, *(_tube(np.array(line)) for line in lines)])
    return verts, faces


def beard(points: np.ndarray) -> np.ndarray:
    """How far a full beard stands off the skin [m], (V,), 0 or less where there is none.

    Args:
        points: of the head's template (V, 3) [mm] from the origin between the eyes.
    """
    x, y, z = points.T
    mouth = np.hypot(x / 27.0, (y + 72.0) / 12.0) - 1.0  # lips are bare
    cheek = (-42.0 - 0.35 * np.clip(-z, 0.0, 70.0) - y) / 20.0  # and so is what lies above
    neck = (y + 135.0 + 0.6 * np.clip(-z - 10.0, 0.0, 60.0)) / 14.0
    back = (z + 72.0) / 16.0
    return 1e-3 * _BEARD * np.minimum.reduce([mouth, cheek, neck, back]).clip(-0.3, 1.0)


def _curtain() -> list[list[tuple[float, float, float, float]]]:
    """Centre lines and radii of the locks at the back [mm]; every other one hangs a little higher."""
    # height, half axes across and to the back of the ellipse about the head's middle on which they hang, radius
    rows = (
        (62, 58, 66, 9),
        (15, 76, 82, 14),
        (-45, 82, 86, 16),
        (-105, 84, 84, 17),
        (-150, 90, 88, 15),
        (-176, 94, 90, 5),
    )
    return [
        [
            (across * np.cos(angle), y + 14.0 * (number % 2) * (y < 0), -84.0 - back * np.sin(angle), radius)
            for y, across, back, radius in rows
        ]
        for number, angle in enumerate(_CURTAIN)
    ]


def _tube(line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closed tube about a centre line with radii (N, 4) [mm]; vertices in metres, and faces."""
    from scipy.interpolate import CubicSpline

    knots = np.linspace(0.0, 1.0, len(line))
    curve = CubicSpline(knots, line)(np.linspace(0.0, 1.0, _RINGS))
    path, radius = 1e-3 * curve[:, :3], 1e-3 * curve[:, 3]
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
