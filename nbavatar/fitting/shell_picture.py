"""Picture of the head with its shell, for a person to look at."""

import numpy as np

from nbavatar.fitting.shell import Shell
from nbavatar.mesh.drawing import draw_mesh, look_from

__all__ = ["shell_picture"]

_SIDES = ((0.0, 0.1, 1.0), (1.0, 0.1, 0.3), (0.0, 0.2, -1.0), (-1.0, 0.1, 0.3))
_SKIN, _SHELL = (0.86, 0.78, 0.70), (0.30, 0.45, 0.80)


def shell_picture(rest: np.ndarray, faces: np.ndarray, shell: Shell, size: int) -> np.ndarray:
    """Four views of the head in its rest frame, the shell in blue.

    Args:
        rest: vertices (V, 3) [m]; faces: (F, 3); there may be none.
        shell: the surface, maybe empty.
        size: side of a view [px].

    Returns:
        uint8 (size, 4 size, 3); white where there is nothing to show.
    """
    verts = np.concatenate([rest, shell.verts])
    if not len(verts):
        return np.full((size, 4 * size, 3), 255, np.uint8)
    joined = np.concatenate([faces, shell.faces + len(rest)])
    colours = np.concatenate([np.tile(_SKIN, (len(rest), 1)), np.tile(_SHELL, (len(shell.verts), 1))])
    views = []
    for side in _SIDES:
        K, pose = look_from(verts.astype(np.float64), np.array(side), np.array([0.0, 1.0, 0.0]), size)
        views.append(draw_mesh(verts, joined, colours, K, pose, size))
    return np.concatenate(views, axis=1)
