"""The z-buffer against ray casting, analytic shapes and its own promises."""

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from nbavatar.mesh.zbuffer import rasterize_mesh

K = np.array([[210.0, 0, 71.3], [0, 190.0, 52.8], [0, 0, 1]])
WIDTH, HEIGHT = 140, 110


def _rays() -> np.ndarray:
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1)


def _cast(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Depth of the nearest crossing of every pixel's ray (inf where none), by Moeller and Trumbore's test on all
    pairs."""
    rays = _rays().reshape(-1, 1, 3)
    a, e1, e2 = verts[faces[:, 0]], verts[faces[:, 1]] - verts[faces[:, 0]], verts[faces[:, 2]] - verts[faces[:, 0]]
    p = np.cross(rays, e2)
    det = (p * e1).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):  # rays parallel to a triangle, degenerate triangles
        u = (p * -a).sum(-1) / det
        q = np.cross(-a, e1)
        v = (rays * q).sum(-1) / det
        t = (q * e2).sum(-1) / det
        inside = u + v <= 1
    hit = (u >= 0) & (v >= 0) & inside & (t > 1e-3)
    return np.where(hit, t, np.inf).min(1).reshape(HEIGHT, WIDTH)


def test_depth_agrees_with_ray_casting_on_a_soup_that_crosses_the_camera_plane() -> None:
    rng = np.random.default_rng(1)
    verts = rng.normal(0, 0.5, (120, 3)) + [0, 0, 0.6]
    faces = rng.integers(0, 120, (150, 3))
    face_id, bary, depth = rasterize_mesh(verts, faces, K, WIDTH, HEIGHT)
    expected = _cast(verts, faces)
    # pixels whose ray grazes an edge may fall to either side of it in the two methods: a handful
    wrong = ~np.isclose(depth, expected, rtol=1e-5, atol=1e-6) & ~(np.isinf(depth) & np.isinf(expected))
    assert wrong.mean() < 1e-3
    seen = face_id >= 0
    assert (np.isfinite(depth) == seen).all() and (depth[seen] >= 1e-3).all()
    # what face and weights say is the point that the ray meets: float32 weights on coordinates of order one
    point = (verts[faces[face_id[seen]]] * bary[seen][..., None]).sum(1)
    np.testing.assert_allclose(point, _rays()[seen] * depth[seen][:, None], atol=2e-5)


def test_depth_and_face_agree_with_libigl_on_a_closed_mesh() -> None:
    mesh = trimesh.creation.icosphere(3, 0.2)
    verts = np.ascontiguousarray(mesh.vertices + [0.02, -0.03, 0.7])
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    face_id, bary, depth = rasterize_mesh(verts, faces, K, WIDTH, HEIGHT)
    same_face = 0
    pixels = [(y, x) for y in range(3, HEIGHT, 6) for x in range(2, WIDTH, 6)]
    hits = 0
    for y, x in pixels:
        ray = _rays()[y, x].copy()
        found = igl.ray_mesh_intersect(np.zeros(3), ray, verts, faces)
        assert bool(found) == (face_id[y, x] >= 0)
        if found:
            hits += 1
            face, t, u, v = found[0]
            assert depth[y, x] == pytest.approx(t, abs=2e-6)
            if face == face_id[y, x]:
                same_face += 1
                np.testing.assert_allclose(bary[y, x], [1 - u - v, u, v], atol=1e-4)
    assert hits > 40 and same_face >= hits - 2  # the rest lie on edges


def test_a_sphere_has_the_area_of_its_outline() -> None:
    mesh = trimesh.creation.icosphere(5, 0.1)
    k = np.array([[800.0, 0, 200], [0, 800.0, 200], [0, 0, 1]])
    face_id, _, depth = rasterize_mesh(mesh.vertices + [0, 0, 1.0], mesh.faces, k, 400, 400)
    # the outline is the cone tangent to the sphere: tan = r / sqrt(d^2 - r^2)
    expected = np.pi * (800 * 0.1 / np.sqrt(1 - 0.01)) ** 2
    assert (face_id >= 0).sum() == pytest.approx(expected, rel=5e-3)
    assert depth.min() == pytest.approx(0.9, abs=1e-4)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_closed_surfaces_have_no_cracks(seed: int) -> None:
    """Every pixel inside the outline of a fan around a point belongs to exactly one of its triangles, whatever the
    angle."""
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 9))
    rim = np.stack([np.cos(angle), np.sin(angle), 0.4 * rng.normal(size=9)], 1) * 0.3
    verts = np.concatenate([rim, [rng.normal(0, 0.03, 3)]]) + [0, 0, 1.0]
    faces = np.array([[i, (i + 1) % 9, 9] for i in range(9)])
    covered = rasterize_mesh(verts, faces, K, WIDTH, HEIGHT)[0] >= 0
    apart = sum((rasterize_mesh(verts, face[None], K, WIDTH, HEIGHT)[0] >= 0).astype(int) for face in faces)
    assert ((apart > 0) == covered).all()
    # one sign of the row: no uncovered pixel between covered ones of the star-shaped outline around the hub's pixel
    hub = (K @ (verts[9] / verts[9, 2]))[:2]
    y = int(np.clip(hub[1], 0, HEIGHT - 1))
    x = int(np.clip(hub[0], 0, WIDTH - 1))
    if apart[y, x]:
        row = covered[y]
        left = np.flatnonzero(~row[: x + 1])
        right = np.flatnonzero(~row[x:])
        inside = row[(left[-1] + 1 if len(left) else 0) : (x + right[0] if len(right) else WIDTH)]
        assert inside.all()


def test_a_triangle_through_the_camera_plane_is_drawn_only_in_front_of_it() -> None:
    verts = np.array([[0.0, 0.2, -1.0], [-0.5, 0.2, 2.0], [0.5, 0.2, 2.0]])
    face_id, _, depth = rasterize_mesh(verts, np.array([[0, 1, 2]]), K, WIDTH, HEIGHT, near=0.5)
    assert (face_id >= 0).any()
    assert depth[face_id >= 0].min() >= 0.5
    rows = np.flatnonzero((face_id >= 0).any(1))
    # the plane y = 0.2 is seen at row fy 0.2 / z + cy, between z = 0.5 and z = 2
    assert rows.min() == pytest.approx(190 * 0.2 / 2.0 + 52.8, abs=1.0)


def test_results_do_not_depend_on_threads_and_ties_go_to_the_lower_face() -> None:
    mesh = trimesh.creation.icosphere(3, 0.3)
    verts, k = mesh.vertices + [0, 0, 1.0], np.array([[600.0, 0, 200], [0, 600.0, 150], [0, 0, 1]])
    doubled = np.concatenate([mesh.faces, mesh.faces])
    one = rasterize_mesh(verts, doubled, k, 400, 300, workers=1)
    three = rasterize_mesh(verts, doubled, k, 400, 300, workers=3)
    for a, b in zip(one, three, strict=True):
        np.testing.assert_array_equal(a, b)
    assert one[0].max() < len(mesh.faces)


def test_culling_keeps_what_an_opaque_body_shows() -> None:
    mesh = trimesh.creation.icosphere(2, 0.3)
    verts = mesh.vertices + [0, 0, 1.0]
    whole, culled = (rasterize_mesh(verts, mesh.faces, K, WIDTH, HEIGHT, cull_back=c) for c in (False, True))
    for a, b in zip(whole, culled, strict=True):
        np.testing.assert_array_equal(a, b)
    # turned inside out only the far side is left, beyond the circle where rays touch the
    # sphere at z = d - r^2 / d = 0.91, less the size of a facet
    assert (rasterize_mesh(verts, mesh.faces[:, ::-1], K, WIDTH, HEIGHT, cull_back=True)[2] > 0.8).all()


def test_the_world_transform_is_applied_and_empty_meshes_draw_nothing() -> None:
    mesh = trimesh.creation.box((0.2, 0.2, 0.2))
    pose = np.eye(4)
    pose[:3, 3] = [0, 0, 1]
    a = rasterize_mesh(mesh.vertices, mesh.faces, K, WIDTH, HEIGHT, cam_from_world=pose)
    b = rasterize_mesh(mesh.vertices + [0, 0, 1], mesh.faces, K, WIDTH, HEIGHT)
    np.testing.assert_array_equal(a[0], b[0])
    nothing = rasterize_mesh(np.zeros((0, 3)), np.zeros((0, 3), int), K, WIDTH, HEIGHT)
    assert (nothing[0] == -1).all() and np.isinf(nothing[2]).all()


@pytest.mark.parametrize(
    ("verts", "faces", "message"),
    [
        (np.zeros((3, 2)), [[0, 1, 2]], "expected"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], "finite"),
        (np.zeros((3, 3)), [[0, 1, 3]], "ids"),
    ],
)
def test_wrong_input_is_refused(verts: np.ndarray, faces: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rasterize_mesh(verts, np.array(faces), K, WIDTH, HEIGHT)
