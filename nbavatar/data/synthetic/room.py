"""The room behind the subject, drawn once a camera: panels, shelves with books, a wooden floor."""

import math

import numpy as np

from nbavatar.data.synthetic.noise import jit, noise, put, smooth_step, white

__all__ = ["draw_room"]


@jit
def _room(ox, oy, oz, dx, dy, dz, points, field, out):
    """A studio seen from inside: stage axes [m]."""
    best, axis = 1e9, 0
    lo, hi = (-1.9, -0.75, -1.5), (2.1, 2.0, 4.0)
    o, d = (ox, oy, oz), (dx, dy, dz)
    for a in range(3):
        if abs(d[a]) > 1e-9:
            t = ((hi[a] if d[a] > 0 else lo[a]) - o[a]) / d[a]
            if t > 0 and t < best:
                best, axis = t, a
    x, y, z = ox + best * dx, oy + best * dy, oz + best * dz
    put(points, 0, x * 25, y * 25, z * 25)
    noise(points, 1, field)
    grain = 1 + 0.05 * field[0]
    if axis == 1:
        board = white(math.floor(x * 6), 7, 3)
        out[0], out[1], out[2] = 0.20 + 0.06 * board, 0.14 + 0.04 * board, 0.10 + 0.03 * board
    elif axis == 2:
        panel = (
            1
            - 0.45 * smooth_step(0.47, 0.49, abs(x * 1.1 - math.floor(x * 1.1) - 0.5))
            - 0.3 * smooth_step(0.48, 0.495, abs(y * 0.9 + 0.3 - math.floor(y * 0.9 + 0.3) - 0.5))
        )
        glow = math.exp(-((x - 0.7) ** 2 + (y - 1.2) ** 2) / 0.5)
        out[0], out[1], out[2] = (
            panel * (0.20 + 0.22 * glow),
            panel * (0.25 + 0.22 * glow),
            panel * (0.29 + 0.20 * glow),
        )
    else:
        shelf = smooth_step(0.46, 0.48, abs(y * 2.2 - math.floor(y * 2.2) - 0.5))
        book = white(math.floor(z * 14), math.floor(y * 2.2), 5)
        out[0] = 0.10 + 0.30 * book * (1 - shelf)
        out[1] = 0.09 + 0.22 * white(math.floor(z * 14), math.floor(y * 2.2), 8) * (1 - shelf)
        out[2] = 0.08 + 0.20 * white(math.floor(z * 14), math.floor(y * 2.2), 2) * (1 - shelf)
    for c in range(3):
        out[c] *= grain


@jit
def draw_room(k, cam_from_stage, image):
    """Fills `image` (H, W, 3) float32, linear light, with the empty room; `k` (4,) fx fy cx cy [px]."""
    height, width = image.shape[:2]
    r, t = cam_from_stage[:3, :3], cam_from_stage[:3, 3]
    ox = -(r[0, 0] * t[0] + r[1, 0] * t[1] + r[2, 0] * t[2])
    oy = -(r[0, 1] * t[0] + r[1, 1] * t[1] + r[2, 1] * t[2])
    oz = -(r[0, 2] * t[0] + r[1, 2] * t[1] + r[2, 2] * t[2])
    colour, points, field = np.zeros(3), np.zeros((8, 3)), np.zeros(8)
    for py in range(height):
        for px in range(width):
            x, y = (px + 0.5 - k[2]) / k[0], (py + 0.5 - k[3]) / k[1]
            dx, dy, dz = (
                r[0, 0] * x + r[1, 0] * y + r[2, 0],
                r[0, 1] * x + r[1, 1] * y + r[2, 1],
                r[0, 2] * x + r[1, 2] * y + r[2, 2],
            )
            _room(ox, oy, oz, dx, dy, dz, points, field, colour)
            for c in range(3):
                image[py, px, c] = colour[c]
