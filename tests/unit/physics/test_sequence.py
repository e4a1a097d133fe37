"""Frames in order: warm starts that respect cuts, NaN, resumption, and the verb around them."""

import json

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.data.sequences import MeshSequence, Part, read_sequence, write_sequence
from nbavatar.io.exr import read_vertex_maps
from nbavatar.physics.contact import ContactNumbers, ContactSolver
from nbavatar.physics.sequence import SequenceSolver, enclosed_volume, pack, uncut_runs, unpack
from nbavatar.physics.shapes import capsule_hand, press, round_head
from nbavatar.physics.tissue import soft_surface

HEAD, FACES = round_head(900)
HAND, HAND_FACES = capsule_hand(160, fingers=2)
DEPTHS = [-0.02, 0.002, 0.006, 0.009, 0.004, -0.004, 0.005, 0.007]


@pytest.fixture(scope="module")
def clip() -> tuple[np.ndarray, np.ndarray]:
    """A head that moves rigidly and a hand that presses it twice, float32."""
    heads, hands = [], []
    for i, depth in enumerate(DEPTHS):
        angle = 0.05 * i
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        shift = np.array([0.01 * i, 0.0, 0.5])
        heads.append(HEAD @ turn.T + shift)
        hands.append(press(HAND, depth, 0.002 * i) @ turn.T + shift)
    return np.array(heads, np.float32), np.array(hands, np.float32)


@pytest.fixture(scope="module")
def solver() -> ContactSolver:
    surface = soft_surface(HEAD, FACES, np.full(len(HEAD), 1e6))
    return ContactSolver(surface, HEAD, [(HAND, HAND_FACES)], ContactNumbers())


def _run(solver, clip, runs, first=0, last=len(DEPTHS) - 1):
    return list(SequenceSolver(solver, runs).frames(clip[0], [clip[1]], first, last))


def test_free_frames_keep_their_bits_and_contact_frames_their_far_side(solver, clip):
    for frame, depth in enumerate(DEPTHS):
        record = _run(solver, clip, [(0, 7)])[frame]
        if depth < 0:
            assert record.head.tobytes() == clip[0][frame].tobytes()
            assert record.hands[0].tobytes() == clip[1][frame].tobytes()
        else:
            assert record.active > 0 and record.depth[1] < 2e-4
            same = (record.head == clip[0][frame]).all(axis=1)
            assert same.sum() > 0.4 * len(HEAD) and not same.all()


def test_a_cut_means_a_fresh_start(solver, clip):
    """After a cut the second run is what it is alone; without the cut it is not: the warm start matters."""
    cut = _run(solver, clip, [(0, 2), (3, 7)])
    alone = _run(solver, clip, [(3, 7)], first=3)
    uncut = _run(solver, clip, [(0, 7)])
    for a, b in zip(cut[3:], alone, strict=True):
        assert a.head.tobytes() == b.head.tobytes() and a.hands[0].tobytes() == b.hands[0].tobytes()
    assert uncut[3].head.tobytes() != cut[3].head.tobytes()


def test_resumed_pieces_equal_an_unbroken_run(solver, clip):
    whole = _run(solver, clip, [(0, 7)])
    stored = pack(whole[:4])
    rest = SequenceSolver(solver, [(0, 7)])
    rest.resume(unpack(stored, -1), clip[0][3], [clip[1][3]])
    again = list(rest.frames(clip[0], [clip[1]], 4, 7))
    for a, b in zip(whole[4:], again, strict=True):
        assert a.head.tobytes() == b.head.tobytes() and a.hands[0].tobytes() == b.hands[0].tobytes()
        assert a.pose.tobytes() == b.pose.tobytes()


@pytest.mark.parametrize("part", [0, 1])
def test_nan_frame_is_named_and_the_rest_kept(solver, clip, part):
    broken = [clip[0].copy(), clip[1].copy()]
    broken[part][3, 5, 1] = np.nan
    records = _run(solver, broken, [(0, 7)])
    assert [r.finite for r in records] == [i != 3 for i in range(8)]
    np.testing.assert_array_equal(records[3].head, broken[0][3])
    np.testing.assert_array_equal(records[3].hands[0], broken[1][3])
    whole = _run(solver, clip, [(0, 7)])
    for i in range(3):
        assert records[i].head.tobytes() == whole[i].head.tobytes()
    assert records[4].depth[1] < 2e-4


@pytest.mark.parametrize(
    ("segments", "runs"),
    [
        (None, [(0, 9)]),
        ([[0, 3], [4, 9]], [(0, 3), (4, 9)]),
        ([[5, 9], [0, 2]], [(0, 2), (3, 4), (5, 9)]),
        ([[0, 99]], [(0, 9)]),
        ([[2, 3]], [(0, 1), (2, 3), (4, 9)]),
    ],
)
def test_runs_cover_every_frame_once(segments, runs):
    assert uncut_runs(None if segments is None else np.array(segments), 10) == runs


def test_enclosed_volume_of_an_open_sphere():
    from nbavatar.mesh.bvh import DeformingMesh

    verts = HEAD / np.array([0.075, 0.115, 0.095])
    verts = verts / np.linalg.norm(verts, axis=1, keepdims=True)
    rim = np.cos(0.86 * np.pi)
    cap = np.pi * (1 + rim) ** 2 * (3 - (1 + rim)) / 3
    np.testing.assert_allclose(enclosed_volume(DeformingMesh(verts, FACES), verts), 4 / 3 * np.pi - cap, rtol=0.01)


def _write(path, clip, **extras):
    parts = {
        "head": Part(FACES, HEAD.astype(np.float32), clip[0]),
        "right_hand": Part(HAND_FACES, HAND.astype(np.float32), clip[1]),
    }
    write_sequence(path, MeshSequence([f"f{i}" for i in range(len(clip[0]))], parts, extras), {})


def test_verb_writes_sequence_maps_and_picture(tmp_path, clip, capsys):
    broken = clip[0].copy()
    broken[7] = np.nan  # the head is not in this frame
    reference = np.zeros_like(clip[0])
    _write(tmp_path / "in.npz", (broken, clip[1]), **{"deformation.head": reference, "segments": np.array([[0, 7]])})
    arguments = ["deform", "--meshes", str(tmp_path / "in.npz"), "--out", str(tmp_path / "out.npz")]
    arguments += ["--exr", str(tmp_path / "out.exr.zip"), "--validate", str(tmp_path / "out.png")]
    arguments += ["--cfg", json.dumps({"picture_size": 64, "stiffness": "uniform"}), "--table", str(tmp_path / "o.csv")]
    assert main(arguments) == 0
    figures = json.loads(capsys.readouterr().out)
    rows = dict(line.rsplit(",", 1) for line in (tmp_path / "o.csv").read_text().splitlines())
    assert rows["frames,not_finite"] == "f7" and rows["group,quantity"] == "value"
    for group, quantity in (
        ("right_hand.before", "max_depth_mm"), ("right_hand.before", "volume_mm3"), ("right_hand.after", "volume_mm3"),
        ("right_hand.after", "non_collision_ratio"), ("right_hand.after", "touch_ratio"),
        ("volume_change_percent", "worst"), ("reference", "moved_mean_mm"), ("reference_labels", "f1"),
    ):  # fmt: skip
        assert float(rows[f"validation.{group},{quantity}"]) == figures["validation"][group][quantity]
    assert (
        figures["validation"]["right_hand.after"]["volume_mm3"]
        < figures["validation"]["right_hand.before"]["volume_mm3"]
    )
    assert figures["frames"]["not_finite"] == ["f7"] and figures["frames"]["simulated"] == 5
    assert figures["validation"]["right_hand.after"]["max_depth_mm"] < 0.2
    assert figures["validation"]["right_hand.before"]["max_depth_mm"] > 5
    result, record = read_sequence(tmp_path / "out.npz")
    assert record["frames"] == figures["frames"]
    np.testing.assert_array_equal(result.extras["head_rigid"], broken)
    for name in ("contact.head", "contact.right_hand", "correction.right_hand", "residual.depth_after"):
        assert len(result.extras[name]) == 8
    assert "reference.deformation.head" in result.extras and "deformation.head" not in result.extras
    maps, frames, _ = read_vertex_maps(tmp_path / "out.exr.zip")
    assert frames == result.frames
    assert maps["head.position"].tobytes() == result.parts["head"].verts.tobytes()
    np.testing.assert_array_equal(maps["head.displacement"], result.parts["head"].verts - broken)
    assert (tmp_path / "out.png").stat().st_size > 1000
    assert not (tmp_path / "out.npz.state").exists()
    first = (tmp_path / "out.npz").read_bytes()
    assert main(arguments) == 0 and (tmp_path / "out.npz").read_bytes() == first


def test_verb_takes_the_users_stiffness_and_refuses_a_wrong_one(tmp_path, clip, capsys):
    own = np.full(len(HEAD), 3e6)
    short = tuple(part[:2] for part in clip)
    out = ["--out", str(tmp_path / "o.npz"), "--cfg", '{"stiffness": "data"}']
    _write(tmp_path / "a.npz", short, **{"stiffness.head": own})
    assert main(["deform", "--meshes", str(tmp_path / "a.npz"), *out]) == 0
    np.testing.assert_array_equal(read_sequence(tmp_path / "o.npz")[0].extras["stiffness.head"], own)
    (tmp_path / "o.npz").unlink()
    _write(tmp_path / "b.npz", short, **{"stiffness.head": own[:-1]})
    assert main(["deform", "--meshes", str(tmp_path / "b.npz"), *out]) == 2
    _write(tmp_path / "c.npz", short)
    assert main(["deform", "--meshes", str(tmp_path / "c.npz"), *out]) == 2
    assert not (tmp_path / "o.npz").exists()
    lines = capsys.readouterr().err.strip().splitlines()
    assert sum("stiffness" in line for line in lines) == 2


@pytest.mark.parametrize("left", ["head", "right_hand"])
def test_verb_passes_on_scenes_without_a_pair(tmp_path, clip, left):
    part = Part(FACES, HEAD.astype(np.float32), clip[0]) if left == "head" else Part(
        HAND_FACES, HAND.astype(np.float32), clip[1])  # fmt: skip
    write_sequence(tmp_path / "in.npz", MeshSequence([f"f{i}" for i in range(8)], {left: part}, {}), {})
    arguments = ["deform", "--meshes", str(tmp_path / "in.npz"), "--out", str(tmp_path / "out.npz")]
    assert main([*arguments, "--exr", str(tmp_path / "o.exr.zip"), "--validate", str(tmp_path / "o.png")]) == 0
    result, _ = read_sequence(tmp_path / "out.npz")
    assert result.parts[left].verts.tobytes() == part.verts.tobytes()
    assert (tmp_path / "o.png").is_file() and (tmp_path / "o.exr.zip").is_file()


def test_verb_measures_against_a_captures_own_deformed_heads(tmp_path, clip, capsys):
    short = tuple(part[:4] for part in clip)
    _write(tmp_path / "in.npz", short)
    arguments = ["deform", "--meshes", str(tmp_path / "in.npz"), "--out", str(tmp_path / "out.npz")]
    assert main(arguments) == 0
    own = read_sequence(tmp_path / "out.npz")[0].parts["head"].verts
    _write(tmp_path / "in.npz", short, head_final=own)
    capsys.readouterr()
    assert main([*arguments, "--validate", "--cfg", '{"picture_size": 64}']) == 0
    reference = json.loads(capsys.readouterr().out)["validation"]["reference"]
    assert reference["mean_mm"] == 0 and reference["reference_mm"] > 1
    np.testing.assert_allclose(reference["cosine"], 1.0, rtol=1e-6)
    assert (tmp_path / "out.png").is_file()


def test_a_killed_run_goes_on_where_it_stopped(tmp_path, clip, monkeypatch, capsys):
    """Pieces that are there are not solved again, and the result has the bits of an unbroken run."""
    from nbavatar.cli import deform as verb

    monkeypatch.setattr(verb, "_PIECE", 3)
    _write(tmp_path / "in.npz", clip)
    arguments = ["deform", "--meshes", str(tmp_path / "in.npz"), "--out", str(tmp_path / "out.npz")]
    assert main(arguments) == 0
    whole = (tmp_path / "out.npz").read_bytes()
    (tmp_path / "out.npz").unlink()
    frames, solved = SequenceSolver.frames, []

    def counted(self, head, hands, first, last):
        for i, record in enumerate(frames(self, head, hands, first, last)):
            if stop is not None and first + i == stop:
                raise KeyboardInterrupt
            solved.append(first + i)
            yield record

    monkeypatch.setattr(SequenceSolver, "frames", counted)
    stop: int | None = 7
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        raise SystemExit(main(arguments))
    assert not (tmp_path / "out.npz").exists() and solved == [0, 1, 2, 3, 4, 5, 6]
    stop = None
    solved.clear()
    assert main(arguments) == 0
    assert solved == [6, 7] and (tmp_path / "out.npz").read_bytes() == whole
    assert not (tmp_path / "out.npz.state").exists()
