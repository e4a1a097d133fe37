"""Light on faces: rays through a tree as the oracle, convex bodies that shadow nothing, and what must not matter."""

import igl
import numpy as np
import pytest

from nbavatar.math.directions import sphere_directions
from nbavatar.mesh.incidence import incidence
from nbavatar.mesh.zbuffer import joined_meshes
from tests.unit.mesh.shapes import face_normals, sphere, torus


def _by_rays(verts: np.ndarray, faces: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The same by a ray from each centroid to each light."""
    tree = igl.AABB()
    tree.init(verts, faces)
    normals, centres = face_normals(verts, faces), verts[faces].mean(1)
    found = np.zeros((len(directions), len(faces)))
    for k, direction in enumerate(directions):
        cosine = normals @ direction
        facing = np.flatnonzero(cosine > 0)
        hit = tree.intersect_ray_first(
            verts, faces, centres[facing] + 1e-6 * normals[facing], np.tile(direction, (len(facing), 1))
        )[0]
        found[k, facing] = np.where(hit < 0, cosine[facing], 0.0)
    return found


def _scene() -> tuple[np.ndarray, np.ndarray]:
    """A ring above a ball: they shadow each other, the ring itself too."""
    ball, ring = sphere(3), torus(48, 20, 0.9, 0.3)
    verts, faces, _ = joined_meshes([ball, (ring[0] + [0.2, 0.1, 1.6], ring[1])])
    return verts, faces


def test_shadows_are_those_of_rays() -> None:
    verts, faces = _scene()
    directions = sphere_directions(12)
    exact = _by_rays(verts, faces, directions)
    found = incidence(verts, faces, face_normals(verts, faces), directions, side=512)
    wrong = np.abs(found - exact)
    shadowed = (exact == 0) & (face_normals(verts, faces) @ directions.T > 0.1).T
    assert shadowed.mean() > 0.05  # there are shadows to find
    # Borders of shadows, one pixel of the map or 0.01 wide, cross one face in a hundred.
    assert (wrong > 0.2).mean() < 0.01 and wrong.mean() < 0.004
    coarse = np.abs(incidence(verts, faces, face_normals(verts, faces), directions, side=64) - exact)
    assert wrong.mean() < 0.5 * coarse.mean()


@pytest.mark.parametrize("side", [32, 192, 1000])
def test_a_convex_body_does_not_shadow_itself(side: int) -> None:
    verts, faces = sphere(4)
    verts = verts * [1.0, 0.6, 1.7] + [300.0, -20.0, 5.0]
    directions = sphere_directions(20)
    normals = face_normals(verts, faces)
    expected = np.maximum(directions @ normals.T, 0.0)
    steep = expected > 0.25  # where light grazes, faces hide centroids by less than a pixel of the map
    found = incidence(verts, faces, normals, directions, side=side)
    np.testing.assert_allclose(found[steep], expected[steep], rtol=0, atol=1e-12)
    assert (np.abs(found - expected) <= 0.25).all()


def test_neither_threads_nor_units_nor_place_matter() -> None:
    verts, faces = _scene()
    normals, directions = face_normals(verts, faces), sphere_directions(30)
    once = incidence(verts, faces, normals, directions, workers=1)
    assert np.array_equal(once, incidence(verts, faces, normals, directions, workers=3))
    # Powers of two are exact.
    assert np.array_equal(once, incidence(1024.0 * verts, faces, normals, directions))


def test_what_is_not_lit_may_throw_shadows() -> None:
    verts, faces = _scene()
    ball = faces[:1280]
    up = np.array([[0.0, 0.0, 1.0]])
    normals = face_normals(verts, ball)
    alone = incidence(verts, ball, normals, up)
    below = incidence(verts, ball, normals, up, occluders=faces)
    steep = normals[:, 2] > 0.25
    np.testing.assert_allclose(alone[0, steep], normals[steep, 2], atol=1e-12)
    assert (below[0, steep] <= alone[0, steep] + 1e-12).all() and below.sum() < 0.8 * alone.sum()
    assert incidence(verts, ball[:0], normals[:0], up).shape == (1, 0)


def test_vertices_must_be_numbers() -> None:
    verts, faces = sphere(1)
    verts[3, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        incidence(verts, faces, np.ones((len(faces), 3)), sphere_directions(8))
