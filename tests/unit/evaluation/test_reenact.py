"""Driving one subject by another: deformation transfer, parameters, contact kept, one clear line where it cannot be."""

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.data.sequences import MeshSequence, Part, read_sequence, write_sequence
from nbavatar.errors import DataError
from nbavatar.evaluation.reenact import check_topology, drive
from nbavatar.evaluation.transfer import DeformationTransfer, rigid_rotation


def sphere(rings=10, sectors=14, centre=(0.0, 0.0, 0.0), radius=0.1):
    """A closed sphere of triangles."""
    polar = np.linspace(0, np.pi, rings + 1)[1:-1]
    around = np.linspace(0, 2 * np.pi, sectors, endpoint=False)
    grid = [[np.sin(p) * np.cos(a), np.cos(p), np.sin(p) * np.sin(a)] for p in polar for a in around]
    verts = np.array([[0, 1, 0], *grid, [0, -1, 0]], float) * radius + centre
    faces = [[0, 1 + (j + 1) % sectors, 1 + j] for j in range(sectors)]
    for i in range(rings - 2):
        for j in range(sectors):
            a, b = 1 + i * sectors + j, 1 + i * sectors + (j + 1) % sectors
            faces += [[a, b, a + sectors], [b, b + sectors, a + sectors]]
    last = len(verts) - 1
    faces += [[last, last - sectors + j, last - sectors + (j + 1) % sectors] for j in range(sectors)]
    return verts, np.array(faces, np.int64)


def rotation(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@pytest.fixture
def two_components():
    """A big sphere with a small one inside its rim, as an eyeball."""
    big, big_faces = sphere()
    small, small_faces = sphere(6, 8, centre=(0.0, 0.02, 0.085), radius=0.02)
    return np.concatenate((big, small)), np.concatenate((big_faces, small_faces + len(big)))


def test_own_poses_come_back_whatever_they_are(two_components, rng):
    rest, faces = two_components
    posed = np.stack(
        [rest @ rotation((1, 2, 3), a).T + (a, 0, 1) + 0.004 * rng.normal(size=rest.shape) for a in (0, 1)]
    )
    result = np.stack(list(DeformationTransfer(rest, rest, faces).poses(posed)))
    # The loose weight of 1e-9 pulls towards the rigid rest.
    np.testing.assert_allclose(result, posed, atol=1e-8)


def test_rigid_motion_and_scale_of_the_target_are_those_of_the_source(two_components):
    rest, faces = two_components
    source = rest * (1.3, 0.9, 1.1) + (0.5, 0, 0)
    turn = rotation((0, 1, 0.3), 1.1)
    posed = (rest @ turn.T * 1.25 + (0.1, 0.2, 0.3))[None]
    (result,) = DeformationTransfer(source, rest, faces).poses(posed)
    aligned = (source - source.mean(0)) @ rigid_rotation(source, rest).T
    # Only lengths across an edge-and-normal frame scale as one, so shape differences are scaled alike.
    expected = 1.25 * aligned @ turn.T
    difference = result - expected
    np.testing.assert_allclose(difference, np.broadcast_to(difference[0], difference.shape), atol=1e-8)


def test_a_twist_is_transferred_to_another_shape_and_the_eyeball_stays_in_place(two_components):
    rest, faces = two_components
    source = rest * (1.2, 1.0, 1.2)

    def twisted(verts):
        c, s = np.cos(6 * verts[:, 1]), np.sin(6 * verts[:, 1])
        return np.column_stack((c * verts[:, 0] + s * verts[:, 2], verts[:, 1], c * verts[:, 2] - s * verts[:, 0]))

    (result,) = DeformationTransfer(source, rest, faces).poses(twisted(rest)[None])
    wanted = twisted(source)
    error = (result - result.mean(0)) - (wanted - wanted.mean(0))
    # Normals have no derivative of their own: shear across tilted faces is met only in part.
    assert np.abs(error).max() < 0.15 * np.linalg.norm(wanted - source, axis=1).max()
    big = len(sphere()[0])
    offset = result[big:].mean(0) - result[:big].mean(0)
    assert np.linalg.norm(offset - (wanted[big:].mean(0) - wanted[:big].mean(0))) < 3e-3


def test_frames_without_a_part_stay_without(two_components):
    rest, faces = two_components
    posed = np.stack((np.full_like(rest, np.nan), rest))
    first, second = DeformationTransfer(rest, rest, faces).poses(posed)
    assert np.isnan(first).all() and np.abs(second - rest).max() < 1e-8


def subject(scale, frames, gap, *, name="head"):
    """A head of a given size with a hand that comes from the right and stops `gap` metres beside its skin."""
    head, head_faces = sphere(radius=0.1)
    hand, hand_faces = sphere(6, 8, radius=0.03)
    head = head * scale
    heads = np.stack([head + (0.0, 0.001 * i, 0.0) for i in range(frames)])
    touch = head[:, 0].max() + 0.03 + gap
    hands = np.stack([hand + (touch, 0.001 * i, 0.0) for i in range(frames)])
    f32 = np.float32
    parts = {
        "head": Part(head_faces, head.astype(f32), heads.astype(f32)),
        "right_hand": Part(hand_faces, hand.astype(f32), hands.astype(f32)),
    }
    return MeshSequence([f"{i:03}" for i in range(frames)], parts, {"split": np.array(["train"] * frames)})


@pytest.mark.parametrize("scale", [0.9, 1.15])
def test_a_touching_hand_touches_the_other_head_too(scale):
    source, target = subject(scale, 2, 0.0), subject(1.0, 3, 0.0)
    driven = drive(source, target, ["head", "right_hand"], place="target")
    assert driven.frames == target.frames and list(driven.extras["driver"]) == target.frames
    for row in range(3):
        head, hand = (driven.parts[part].verts[row] for part in ("head", "right_hand"))
        gap = hand[:, 0].min() - head[:, 0].max()
        # The weight spreads over 2 cm of curved skin, so that a millimetre or two of the 10 to 15 may remain.
        assert abs(gap) < 0.004
    free = drive(source, target, ["head", "right_hand"], place="target", keep_contact=False)
    gap = free.parts["right_hand"].verts[0][:, 0].min() - free.parts["head"].verts[0][:, 0].max()
    assert abs(gap) == pytest.approx(0.1 * abs(scale - 1), abs=1e-4)


def test_a_distant_hand_is_not_moved():
    source, target = subject(1.2, 2, 0.0), subject(1.0, 2, 0.2)
    driven = drive(source, target, ["head", "right_hand"], place="target")
    assert np.abs(driven.extras["shift.right_hand"]).max() < 1e-9


def test_the_motion_moves_to_where_the_source_is():
    source, target = subject(1.0, 4, 0.0), subject(1.0, 4, 0.0)
    away = MeshSequence(
        target.frames,
        {name: Part(p.faces, p.rest, p.verts + np.float32(1.5)) for name, p in target.parts.items()},
    )
    driven = drive(source, away, ["head", "right_hand"], place="source")
    for name, part in driven.parts.items():
        np.testing.assert_allclose(part.verts, source.parts[name].verts, atol=1e-6)


def test_other_topology_is_one_clear_line(tmp_path, capsys):
    source, target = subject(1.0, 2, 0.0), subject(1.0, 2, 0.0)
    other, other_faces = sphere(8, 10)
    parts = {"head": Part(other_faces, other.astype(np.float32), np.stack([other] * 2).astype(np.float32))}
    with pytest.raises(DataError, match=r"head.faces: expected the 252 faces"):
        check_topology(source, MeshSequence(target.frames, parts), "a.npz", "b.npz")
    write_sequence(tmp_path / "a.npz", source, {})
    write_sequence(tmp_path / "b.npz", MeshSequence(target.frames, parts), {})
    arguments = ["--source", str(tmp_path / "a.npz"), "--target", str(tmp_path / "b.npz")]
    assert main(["reenact", *arguments, "--out", str(tmp_path / "c.npz")]) == 2
    error = capsys.readouterr().err.strip()
    assert "b.npz" in error and "one topology" in error and "\n" not in error
    assert not (tmp_path / "c.npz").exists()


def test_parts_that_one_lacks_are_left_out_and_none_in_common_is_refused(tmp_path, capsys):
    source, target = subject(1.0, 2, 0.0), subject(1.1, 2, 0.0)
    head_only = MeshSequence(target.frames, {"head": target.parts["head"]})
    write_sequence(tmp_path / "S1.npz", source, {})
    write_sequence(tmp_path / "S2.npz", head_only, {})
    arguments = ["--source", str(tmp_path / "S1.npz"), "--target", str(tmp_path / "S2.npz")]
    assert main(["reenact", *arguments, "--out", str(tmp_path / "c.npz")]) == 0
    driven, record = read_sequence(tmp_path / "c.npz")
    assert list(driven.parts) == ["head"] and record["source"] == "S1" and record["target"] == "S2"
    assert record["config"]["by"] == "deformation transfer"
    hand_only = MeshSequence(target.frames, {"right_hand": target.parts["right_hand"]})
    with pytest.raises(DataError, match="one of the parts right_hand"):
        check_topology(hand_only, head_only, "a", "b")
    assert main(["reenact", *arguments, "--by", "parameters", "--out", str(tmp_path / "d.npz")]) == 2
    assert "--by parameters" in capsys.readouterr().err
