"""Meshes of a capture: one surface that moves, in a world near its cameras, without seams."""

import json

import numpy as np
import pytest

from nbavatar.data.capture import open_capture, read_mesh, read_topology
from nbavatar.data.capture_tracks import build_capture_tracks
from nbavatar.errors import DataError

FRAMES = [f"t{i}" for i in range(5)]


def change(path, edit):
    arrays = dict(np.load(path))
    edit(arrays)
    np.savez(path, **arrays)


def change_all(capture, edit):
    for frame in FRAMES:
        change(capture / f"meshes/{frame}.npz", edit)


def both_heads(move):
    return lambda a: a.update({key: move(a[key]) for key in ("head", "head_rigid")})


def exchanged(verts):
    verts = verts.copy()
    verts[[0, 300]] = verts[[300, 0]]
    return verts


def tracks(capture):
    return build_capture_tracks(open_capture(capture), FRAMES, contact="given")


@pytest.mark.parametrize(
    ("edit", "line"),
    [
        (both_heads(lambda v: np.random.default_rng(0).permutation(v)), "lengths that differ by a factor of"),
        (both_heads(lambda v: v * 1000), "lengths that differ by a factor of 1e.03"),
        (both_heads(lambda v: v * 1.3), "lengths that differ by a factor of 1.3"),
        (both_heads(exchanged), "m instead of .* m between vertices"),
        (lambda a: a.update(head_rigid=a["head_rigid"][::-1]), "head_rigid: expected edges as long"),
        (lambda a: a.update(right_hand=a["right_hand"][::-1]), "right_hand: expected edges as long"),
        (both_heads(lambda v: v * [-1, 1, 1]), "a surface as in the other frames, found one that is turned inside out"),
    ],
)
def test_one_frame_with_other_vertices_is_named(capture, edit, line):
    change(capture / "meshes/t3.npz", edit)
    with pytest.raises(DataError, match=rf"meshes/t3\.npz: .*{line}") as error:
        tracks(capture)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("edit", "line"),
    [
        (lambda a: a.update(head_faces=a["head_faces"][:, ::-1]), "head_faces: expected corners counter-clockwise"),
        (
            lambda a: a["head_faces"].__setitem__(slice(0, None, 5), a["head_faces"][::5, ::-1]),
            "head_faces: expected faces that all turn the same way",
        ),
    ],
)
def test_faces_that_turn_the_wrong_way(capture, edit, line):
    change(capture / "meshes/topology.npz", edit)
    with pytest.raises(DataError, match=line):
        tracks(capture)


@pytest.mark.parametrize(
    ("move", "line"),
    [
        (lambda v: v * 1000, "lengths that differ by a factor of 1e.03"),
        (lambda v: np.random.default_rng(0).permutation(v), "lengths that differ by a factor of"),
        (exchanged, "m instead of .* m between vertices"),
    ],
)
def test_a_rest_shape_that_is_another_mesh(capture, move, line):
    head = np.load(capture / "meshes/t0.npz")["head"]
    change(capture / "meshes/topology.npz", lambda a: a.update(head_rest=move(head)))
    with pytest.raises(DataError, match=f"topology.npz: head_rest: expected edges about as long.*{line}"):
        tracks(capture)


@pytest.mark.parametrize("with_rest", [False, True])
def test_a_seam_and_loose_vertices_change_nothing(capture, with_rest):
    if with_rest:
        head = np.load(capture / "meshes/t1.npz")["head_rigid"]
        change(capture / "meshes/topology.npz", lambda a: a.update(head_rest=head))
    expected, report = tracks(capture)
    assert report["vertices_left_out"] == {"head": 0, "right_hand": 0}
    faces = np.load(capture / "meshes/topology.npz")["head_faces"]
    # From the neck to the top: the vertices of one meridian twice, and three that no face uses.
    meridian = np.unique(faces[np.isin(faces, np.arange(0, 336, 24)).any(axis=1)])
    copies = {int(v): 337 + i for i, v in enumerate(meridian)}
    other_side = np.isin(faces % 24, np.arange(12)).all(axis=1)
    cut = faces.copy()
    cut[other_side] = np.vectorize(lambda v: copies.get(v, v))(faces[other_side])
    loose = np.full((3, 3), 7.0, np.float32)

    def grow(v):
        return np.concatenate([v, v[meridian], loose])

    change(capture / "meshes/topology.npz", lambda a: a.update(head_faces=cut))
    if with_rest:
        change(capture / "meshes/topology.npz", lambda a: a.update(head_rest=grow(a["head_rest"])))
    change_all(capture, both_heads(grow))
    found, report = tracks(capture)
    assert report["vertices_left_out"]["head"] == len(meridian) + 3
    for part, mesh in expected.parts.items():
        for name in ("faces", "rest", "verts"):
            np.testing.assert_array_equal(getattr(found.parts[part], name), getattr(mesh, name))
    for name in ("head_rigid", "head_final"):
        np.testing.assert_array_equal(found.extras[name], expected.extras[name])


OFFSET = np.array([5e5, 4e6, -120.0])


def move_world(capture, dtype):
    def edit(cameras):
        for entry in cameras.values():
            entry["t"] = (np.array(entry["t"]) - np.array(entry["R"]) @ OFFSET).tolist()

    path = capture / "cameras.json"
    cameras = json.loads(path.read_text())
    edit(cameras)
    path.write_text(json.dumps(cameras))
    change_all(capture, lambda a: a.update({key: (v.astype(float) + OFFSET).astype(dtype) for key, v in a.items()}))


def test_a_world_far_from_its_origin_is_moved_to_the_cameras(capture):
    before = open_capture(capture)
    assert not before.origin.any()
    expected = read_mesh(before, "t2", read_topology(capture))
    move_world(capture, np.float64)
    after = open_capture(capture)
    np.testing.assert_allclose(after.origin, OFFSET, atol=1.0)
    found = read_mesh(after, "t2", read_topology(capture))
    shift = after.origin - OFFSET
    for name, verts in expected.items():
        # float64 keeps 1e-9 m at 4,000 km, float32 1e-8 m at a tenth of a metre.
        np.testing.assert_allclose(found[name] + shift, verts, atol=1e-7)
    for name, camera in before.cameras.items():
        moved = after.cameras[name].cam_from_world
        np.testing.assert_array_equal(moved[:3, :3], camera.cam_from_world[:3, :3])
        np.testing.assert_allclose(
            moved[:3, :3] @ (found["head"][0] + np.zeros(3)) + moved[:3, 3],
            camera.cam_from_world[:3, :3] @ expected["head"][0].astype(float) + camera.cam_from_world[:3, 3],
            atol=1e-7,
        )


def test_vertices_that_float32_has_rounded_away_are_refused(capture):
    move_world(capture, np.float32)
    opened = open_capture(capture)
    with pytest.raises(
        DataError, match=r"t2\.npz: head: .* found a world so far from its origin that float32 rounds to 0\.25 m"
    ):
        read_mesh(opened, "t2", read_topology(capture))


def test_a_part_that_is_far_from_the_cameras_is_refused(capture):
    change(capture / "meshes/t2.npz", lambda a: a.update(right_hand=a["right_hand"].astype(float) + 5000))
    with pytest.raises(DataError, match=r"t2\.npz: right_hand: .*are lengths metres"):
        read_mesh(open_capture(capture), "t2", read_topology(capture))


def test_a_rest_shape_may_lie_anywhere(capture):
    head = np.load(capture / "meshes/t0.npz")["head"]
    change(capture / "meshes/topology.npz", lambda a: a.update(head_rest=head.astype(float) + OFFSET))
    rest = read_topology(capture)["head"][1]
    assert rest.dtype == np.float32 and np.abs(rest - rest.mean(0) - (head - head.mean(0))).max() < 1e-6
