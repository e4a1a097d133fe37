"""Posed meshes with their contact, part by part, as other programs take them."""

from collections.abc import Sequence

import numpy as np

from nbavatar.data.sequences import MeshSequence
from nbavatar.io.gltf import Shape

__all__ = ["contact_of", "mesh_colours", "shapes_of"]

_SKIN, _TOUCHED = np.array([222, 184, 164], np.uint8), np.array([200, 40, 40], np.uint8)


def contact_of(sequence: MeshSequence, part: str, rows: Sequence[int]) -> np.ndarray:
    """Which vertices of a part touch another one in the frames, bool [len(rows), V]; none without contact stored."""
    stored = sequence.extras.get(f"contact.{part}")
    shape = (len(sequence.frames), len(sequence.parts[part].rest))
    if stored is None or stored.shape != shape:
        return np.zeros((len(rows), shape[1]), bool)
    return np.asarray(stored, bool)[list(rows)]


def mesh_colours(contact: np.ndarray) -> np.ndarray:
    """Skin, red where there is contact: bool [V] to uint8 [V, 3], sRGB."""
    return np.where(contact[:, None], _TOUCHED, _SKIN)


def shapes_of(sequence: MeshSequence, rows: Sequence[int]) -> list[Shape]:
    """All parts over some frames, red where a vertex touches another part in any of them.

    A part that is not in a frame (NaN) is shrunk to a point there; one that is in none is left out.
    """
    shapes = []
    for name, part in sequence.parts.items():
        verts = np.array(part.verts[list(rows)], np.float32)
        there = np.isfinite(verts).all(axis=(1, 2))
        if not there.any():
            continue
        verts[~there] = verts[there].mean(axis=(0, 1))
        contact = np.asarray(contact_of(sequence, name, rows).any(axis=0))
        shapes.append(Shape(name, verts, part.faces, colours=mesh_colours(contact)))
    return shapes
