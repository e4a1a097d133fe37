"""The synthetic body models, their pickles, the dents and the scenes."""

import pickletools

import numpy as np
import pytest
import scipy.sparse
import torch
import trimesh

from nbavatar.bodymodels.files import landmark_arrays, model_arrays
from nbavatar.data.synthetic.contact import Surface, dent, rim_fan, signed_distance, vertex_normals
from nbavatar.data.synthetic.legacy_pickle import Ch, Select, dump_array, dump_legacy
from nbavatar.data.synthetic.models import (
    flame_content,
    hand_axes,
    landmark_content,
    load_human,
    mano_content,
    mirrored_mano_content,
)
from nbavatar.data.synthetic.scene import CONTACT_DISTANCE, Scene, build_bodies, full_scene, make_scene
from nbavatar.io.pickles import read_array, read_pickle
from nbavatar.math.rotations import axis_angle_to_matrix

COUNTS = {"full": (5023, 9976, 778, 1538), "tiny": (612, 1190, 200, 390)}


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return np.unique(np.sort(directed, 1), axis=0, return_counts=True)


@pytest.mark.parametrize("mesh", ["full", "tiny"])
def test_counts_and_topology(mesh: str) -> None:
    human = load_human(mesh)
    assert (len(human.head), len(human.head_faces), len(human.hand), len(human.hand_faces)) == COUNTS[mesh]
    for verts, faces in ((human.head, human.head_faces), (human.hand, human.hand_faces)):
        assert len(np.unique(faces)) == len(verts)
        _, uses = _edges(faces)
        assert uses.max() == 2  # manifold
        directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        assert len(np.unique(directed, axis=0)) == len(directed)  # consistently oriented
        corners = verts[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        assert area.min() > 1e-9
        volume = np.einsum(
            "fc,fc->f",
            corners[:, 0] - verts.mean(0),
            np.cross(corners[:, 1] - verts.mean(0), corners[:, 2] - verts.mean(0)),
        )
        assert volume.sum() > 0  # outward
        _, rims = rim_fan(faces, len(verts))
        assert len(rims) == 1 and (uses == 1).sum() == len(rims[0])  # one hole: neck, wrist
    graph = trimesh.graph.connected_component_labels(_edges(human.head_faces)[0], len(human.head))
    assert np.bincount(graph).tolist() == list(human.part_sizes)  # skin and two eyeballs
    assert 0.24 < np.ptp(human.head[:, 1]) < 0.36 and 0.15 < np.ptp(human.hand[:, 0]) < 0.23  # life size [m]


def test_tiny_is_a_subset_of_full() -> None:
    full, tiny = load_human("full"), load_human("tiny")
    for name in ("head", "hand"):
        rows = {tuple(row) for row in getattr(full, name)}
        assert all(tuple(row) in rows for row in getattr(tiny, name))


@pytest.mark.parametrize("mesh", ["full", "tiny"])
def test_flip_is_the_mirror_and_an_involution(mesh: str) -> None:
    human = load_human(mesh)
    np.testing.assert_array_equal(human.flip[human.flip], np.arange(len(human.head)))
    np.testing.assert_allclose(human.head[human.flip], human.head * [-1, 1, 1], atol=1e-7)  # float32 storage
    mirrored = {frozenset(f) for f in human.flip[human.head_faces].tolist()}
    skin = human.head_faces[(human.head_faces < human.part_sizes[0]).all(1)]
    assert all(frozenset(f) in mirrored for f in skin.tolist())


def test_landmarks_lie_where_they_should() -> None:
    human = load_human("full")
    points = (human.head[human.head_faces[human.landmark_faces]] * human.landmark_bary[..., None]).sum(1)
    # mirrored pairs, right side first (the subject's right is -x)
    pairs = [(0, 16), (17, 26), (36, 45), (39, 42), (31, 35), (48, 54)]
    for right, left in pairs:
        assert points[right, 0] < 0 < points[left, 0]
        np.testing.assert_allclose(points[right] * [-1, 1, 1], points[left], atol=3e-3)  # snapped to one mesh
    brow, eye, nose, mouth, chin = points[19, 1], points[37, 1], points[33, 1], points[57, 1], points[8, 1]
    assert brow > eye > nose > mouth > chin
    assert points[30, 2] == points[:, 2].max()  # the nose's tip is foremost


def test_joints_of_the_hand_are_inside_it_and_fingers_bend_to_the_palm() -> None:
    human = load_human("full")
    joints = human.hand_regressor @ human.hand
    assert (signed_distance(joints[1:], human.hand, human.hand_faces)[0] < 0).all()
    bodies = build_bodies("full")
    bend, _ = hand_axes(joints)
    pose = torch.zeros(1, 45, dtype=torch.float64)
    pose[0, :36] = torch.from_numpy(0.5 * bend[:12].ravel())
    zero = torch.zeros(1, 3, dtype=torch.float64)
    betas = torch.zeros(1, 10, dtype=torch.float64)
    rest = bodies.mano.forward(betas, torch.zeros(1, 45, dtype=torch.float64), zero).joints[0, 17:].numpy()
    bent = bodies.mano.forward(betas, pose, zero).joints[0, 17:].numpy()
    assert (bent[:, 1] < rest[:, 1] - 0.015).all()  # the palm looks down


@pytest.mark.parametrize("mesh", ["full", "tiny"])
def test_pickles_read_back_by_the_allow_list_are_the_models(mesh: str, tmp_path) -> None:
    human = load_human(mesh)
    right = mano_content(human)
    for name, content in (("flame", flame_content(human)), ("right", right), ("left", mirrored_mano_content(right))):
        path = tmp_path / f"{name}.pkl"
        path.write_bytes(dump_legacy(content, python2=True))
        plain = read_pickle(path)
        arrays = model_arrays(plain, name)  # refuses whatever disagrees
        assert arrays.shape_dirs.shape[2] == (400 if name == "flame" else 10)
        assert (np.abs(arrays.shape_dirs).max((0, 1)) > 1e-6).all()  # every direction does something
        source = content["v_template"].x if name == "flame" else content["v_template"]
        np.testing.assert_array_equal(arrays.template, source)
    landmark = tmp_path / "landmarks.npy"
    landmark.write_bytes(dump_array(landmark_content(human)))
    landmark_arrays(read_array(landmark), len(human.head_faces), "landmarks")


def test_pickles_name_what_the_originals_name(tmp_path) -> None:
    content = {
        "a": Ch(np.arange(3.0)),
        "b": scipy.sparse.csc_matrix(np.eye(2)),
        "c": Select(Ch(np.zeros(4)), np.arange(4), (2, 2)),
    }
    old = dump_legacy(content, python2=True)
    names = {argument for opcode, argument, _ in pickletools.genops(old) if opcode.name == "GLOBAL"}
    assert names >= {
        "chumpy.ch Ch",
        "chumpy.reordering Select",
        "scipy.sparse.csc csc_matrix",
        "numpy.core.multiarray _reconstruct",
        "numpy dtype",
    }
    assert old[:2] == b"\x80\x02" and not any(
        name.startswith(("builtins", "numpy._core", "scipy.sparse._")) for name in names
    )
    newer = dump_legacy({"a": np.arange(3), "b": [(1, 2)], "c": "text", "d": b"bytes"})
    assert newer[:2] == b"\x80\x03"
    (tmp_path / "newer.pkl").write_bytes(newer)
    loaded = read_pickle(tmp_path / "newer.pkl")
    assert loaded["b"] == [(1, 2)] and loaded["d"] == b"bytes" and (loaded["a"] == [0, 1, 2]).all()


def test_mirrored_hand_poses_as_the_mirror_image() -> None:
    from nbavatar.bodymodels.mano import Mano, mirror_axis_angle
    from nbavatar.data.synthetic.scene import _unwrapped

    human = load_human("tiny")
    content = mano_content(human)
    right = Mano.build(model_arrays(_unwrapped(content), "right"), dtype=torch.float64)
    left = Mano.build(model_arrays(_unwrapped(mirrored_mano_content(content)), "left"), "left", dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    pose, turn = (0.5 * torch.randn(1, n, dtype=torch.float64, generator=generator) for n in (45, 3))
    betas = torch.randn(1, 10, dtype=torch.float64, generator=generator)
    a = right.forward(betas, pose, turn).verts
    b = left.forward(betas, mirror_axis_angle(pose), mirror_axis_angle(turn)).verts
    torch.testing.assert_close(a * torch.tensor([-1.0, 1, 1]), b, atol=1e-12, rtol=0)


def test_signed_distance_of_a_cut_sphere_counts_the_hole_as_closed() -> None:
    mesh = trimesh.creation.icosphere(4, 1.0)
    faces = np.array(mesh.faces[(mesh.vertices[mesh.faces][:, :, 1] > -0.7).all(1)])
    used, faces = np.unique(faces, return_inverse=True)
    verts, faces = np.array(mesh.vertices[used]) * 0.02, faces.reshape(-1, 3)
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.03, 0.03, (500, 3))
    distance, _, nearest = signed_distance(points, verts, faces)
    np.testing.assert_allclose(np.abs(distance), np.linalg.norm(points - nearest, axis=1), atol=1e-12)
    inside = (np.linalg.norm(points, axis=1) < 0.0198) & (points[:, 1] > -0.012)
    outside = (np.linalg.norm(points, axis=1) > 0.0202) | (points[:, 1] < -0.0145)
    assert (distance[inside] < 0).all() and (distance[outside] > 0).all()


def test_a_ball_pressed_into_a_plate_leaves_nothing_inside_and_a_smooth_dent() -> None:
    n = 61
    x, y = np.meshgrid(np.linspace(-0.09, 0.09, n), np.linspace(-0.09, 0.09, n))
    verts = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    quad = np.arange(n * n).reshape(n, n)
    a, b, c, d = quad[:-1, :-1].ravel(), quad[:-1, 1:].ravel(), quad[1:, 1:].ravel(), quad[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    movable = (np.abs(verts[:, :2]) < 0.085).all(1)
    # a slab's lower side, so that "inside" means something
    deep = verts * [1, 1, 1] - [0, 0, 0.05]
    slab = np.concatenate([verts, deep])
    sides = np.concatenate([faces, faces[:, ::-1] + n * n])
    surface = Surface.build(slab, sides, np.concatenate([movable, np.zeros(n * n, bool)]))
    ball = trimesh.creation.icosphere(3, 0.012)
    solved = dent(surface, slab, np.array(ball.vertices) + [0.002, -0.001, 0.012 - 0.006], np.array(ball.faces))
    assert solved.residual <= 2e-4
    depth = -solved.offset[: n * n, 2].reshape(n, n)
    assert 0.0055 < depth.max() < 0.0085  # the ball reaches 6 mm in
    assert np.abs(solved.offset[n * n :]).max() == 0  # what may not move does not
    far = np.linalg.norm(verts[:, :2], axis=1) > 0.07
    assert np.abs(depth.ravel()[far]).max() < 0.5e-3  # it fades
    assert (
        np.abs(np.diff(depth, 2, axis=1)).max() < 2.5e-3
    )  # no spikes: less than the ball's own curvature allows at 3 mm


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(build_bodies("tiny"), "S2", 14, 0)


def test_nothing_penetrates_after_the_dent(scene: Scene) -> None:
    skin = scene.bodies.skin_faces
    human = scene.bodies.human
    before = 0.0
    for n in range(14):
        points = np.concatenate([scene.hand[n], scene.hand[n][human.hand_faces].mean(1)])
        distance = signed_distance(points, scene.head[n], skin)[0]
        assert distance.min() > -2.5e-4
        before = min(before, signed_distance(points, scene.head_rigid[n], skin)[0].min())
        inside = signed_distance(scene.head[n], scene.hand[n], human.hand_faces)[0]
        assert inside.min() > -2.5e-4
    assert -9e-3 < before < -4e-3  # it did press: 6 mm at its vertices
    assert scene.residual.max() <= 2e-4
    dented = np.linalg.norm(scene.offset, axis=2).max(1)
    assert (dented > 2e-3).sum() >= 5 and dented[0] == 0
    assert (scene.offset[:, human.neck()] == 0).all() and (scene.offset[:, human.part_sizes[0] :] == 0).all()


def test_dents_point_inwards_and_stay_local(scene: Scene) -> None:
    for n in np.flatnonzero(np.linalg.norm(scene.offset, axis=2).max(1) > 2e-3):
        offset = scene.offset[n]
        size = np.linalg.norm(offset, axis=1)
        normal = vertex_normals(scene.head_rigid[n], scene.bodies.skin_faces)
        strong = size > 0.5 * size.max()
        assert ((offset[strong] * normal[strong]).sum(1) < 0).all()
        at = scene.head_rigid[n][size.argmax()]
        far = np.linalg.norm(scene.head_rigid[n] - at, axis=1) > 0.12
        assert size[far].max() < 1e-3


def test_cut_and_speed(scene: Scene) -> None:
    """Within a take the hand moves like a hand, across the cut it jumps."""
    (_, last), (first, _) = scene.motion.segments
    step = np.linalg.norm(np.diff(scene.joints[:, 0], axis=0), axis=1)
    assert first == last + 1
    assert step[last] > 0.05


def test_world_is_not_the_models_frame(scene: Scene) -> None:
    rotation = axis_angle_to_matrix(torch.from_numpy(scene.parameters["head.global_orient"])).numpy()
    assert (np.arccos((np.trace(rotation, axis1=1, axis2=2) - 1) / 2) > 1.0).all()


def test_full_scene_gives_the_official_counts() -> None:
    sequence = full_scene(4, seed=1, dents=False)
    assert sequence.parts["head"].verts.shape == (4, 5023, 3) and sequence.parts["right_hand"].verts.shape == (
        4,
        778,
        3,
    )
    assert sequence.parts["head"].faces.shape == (9976, 3) and sequence.parts["right_hand"].faces.shape == (1538, 3)
    np.testing.assert_array_equal(sequence.extras["head_rigid"], sequence.parts["head"].verts)
    assert CONTACT_DISTANCE > 0


@pytest.mark.slow
def test_full_size_subjects_have_no_penetration_left() -> None:
    bodies = build_bodies("full")
    for name in ("S1", "S2", "S3", "S4"):
        posed = make_scene(bodies, name, 12, 0)
        assert posed.residual.max() <= 2.5e-4
        assert np.linalg.norm(posed.offset, axis=2).max() > 4e-3
