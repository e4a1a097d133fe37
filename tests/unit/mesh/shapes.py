"""Analytic test surfaces."""

import numpy as np
import trimesh

__all__ = ["face_normals", "grid", "sphere", "torus"]


def sphere(subdivisions: int = 3, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Icosphere."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)


def torus(
    n_major: int = 96, n_minor: int = 40, major: float = 1.0, minor: float = 0.4
) -> tuple[np.ndarray, np.ndarray]:
    """Torus of revolution about z."""
    a = 2 * np.pi * np.arange(n_major) / n_major
    b = 2 * np.pi * np.arange(n_minor) / n_minor
    ring = major + minor * np.cos(b)
    verts = np.stack(
        (np.cos(a)[:, None] * ring, np.sin(a)[:, None] * ring, np.broadcast_to(minor * np.sin(b), (n_major, n_minor))),
        -1,
    ).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n_major), np.arange(n_minor), indexing="ij")
    p, q = i * n_minor + j, ((i + 1) % n_major) * n_minor + j
    r, s = ((i + 1) % n_major) * n_minor + (j + 1) % n_minor, i * n_minor + (j + 1) % n_minor
    return verts, np.concatenate((np.stack((p, q, r), -1).reshape(-1, 3), np.stack((p, r, s), -1).reshape(-1, 3)))


def grid(nx: int, ny: int, width: float = 1.0, height: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Flat rectangle in z = 0 with nx by ny vertices."""
    x, y = np.meshgrid(np.linspace(0, width, nx), np.linspace(0, height, ny), indexing="ij")
    verts = np.stack((x, y, np.zeros_like(x)), -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(nx - 1), np.arange(ny - 1), indexing="ij")
    p = i * ny + j
    return verts, np.concatenate(
        (np.stack((p, p + ny, p + ny + 1), -1).reshape(-1, 3), np.stack((p, p + ny + 1, p + 1), -1).reshape(-1, 3))
    )


def face_normals(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of faces that have an area, (F, 3)."""
    cross = np.cross(verts[faces[:, 1]] - verts[faces[:, 0]], verts[faces[:, 2]] - verts[faces[:, 0]])
    return cross / np.linalg.norm(cross, axis=1, keepdims=True)
