"""Alignment of jittering meshes to pictures: an independent scene, drawn with exact meshes, has to come back."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from nbavatar.camera.pinhole import Camera, project
from nbavatar.cli import align as verb
from nbavatar.config.geometry import AlignConfig
from nbavatar.data.sequences import MeshSequence, Part, read_sequence, write_sequence
from nbavatar.errors import DataError
from nbavatar.fitting.align import Motion, align_block, blocks, moved
from nbavatar.fitting.details import Details, projected
from nbavatar.io.framepack import FramePackWriter
from tests.unit.fitting.ellipsoid import SIDE, camera_at, filmed, painted_ellipsoid

FRAMES = 8
CONFIG = AlignConfig(iterations=6)


@dataclasses.dataclass
class Scene:
    """A painted ellipsoid that moves slowly: exact and jittering vertices, and its pictures."""

    faces: np.ndarray
    exact: np.ndarray
    noisy: np.ndarray
    cameras: list[Camera]
    pictures: dict[str, list[np.ndarray]]

    def read(self, camera: str, frame: int) -> np.ndarray:
        return self.pictures[camera][frame]

    def error(self, verts: np.ndarray) -> float:
        """Root mean square [m] of what is not the same in all frames."""
        left = verts - self.exact
        return float(np.sqrt(((left - left.mean(0)) ** 2).sum(-1).mean()))


@pytest.fixture(scope="module")
def scene() -> Scene:
    rng = np.random.default_rng(3)
    rest, faces, paint = painted_ellipsoid(rng)
    step = np.linspace(-1, 1, FRAMES)
    exact = np.stack(
        [
            rest @ Rotation.from_euler("yx", [2 * t, t], degrees=True).as_matrix().T + [0.004 * t, 0.002 * t, 0]
            for t in step
        ]
    )
    jitter = Motion(np.radians(0.4) * rng.normal(size=(FRAMES, 3)), 1e-3 * rng.normal(size=(FRAMES, 3)), 0, 0)
    cameras = [camera_at("a", -35), camera_at("b", 0), camera_at("c", 40)]
    shown = filmed(cameras, exact, faces, paint)
    pictures = {camera.name: [shown[camera.name, row][0] for row in range(FRAMES)] for camera in cameras}
    return Scene(faces, exact, moved(exact, jitter), cameras, pictures)


def test_jitter_is_taken_out(scene: Scene) -> None:
    motion = align_block({"head": scene.noisy}, {"head": scene.faces}, scene.cameras, scene.read, CONFIG)["head"]
    # 1.5 mm are about a pixel here; an eighth of a pixel is what direct alignment of such pictures leaves.
    assert scene.error(scene.noisy) > 1.2e-3
    assert scene.error(moved(scene.noisy, motion)) < 0.2e-3
    assert motion.after < 0.7 * motion.before
    assert np.abs(motion.shift.mean(0)).max() < 1e-9  # what all frames share is left


def test_absent_parts_and_missing_pictures_are_left(scene: Scene) -> None:
    noisy = scene.noisy.copy()
    noisy[3] = np.nan

    def read(camera: str, frame: int) -> np.ndarray | None:
        return None if frame == 5 else scene.read(camera, frame)

    motion = align_block({"head": noisy}, {"head": scene.faces}, scene.cameras, read, CONFIG)["head"]
    assert not motion.shift[3].any() and not motion.turn[3].any()
    assert np.isfinite(motion.shift).all() and np.isfinite(motion.turn).all()
    kept = [i for i in range(FRAMES) if i not in (3, 5)]
    corrected = moved(scene.noisy, motion)[kept] - scene.exact[kept]
    assert np.sqrt(((corrected - corrected.mean(0)) ** 2).sum(-1).mean()) < 0.3e-3


def test_nothing_to_see_moves_nothing(scene: Scene) -> None:
    flat = np.full((SIDE, SIDE, 3), 90, np.uint8)
    motion = align_block({"head": scene.noisy}, {"head": scene.faces}, scene.cameras, lambda *_: flat, CONFIG)["head"]
    assert not motion.shift.any() and not motion.turn.any()
    single = align_block({"head": scene.noisy[:1]}, {"head": scene.faces}, scene.cameras, scene.read, CONFIG)["head"]
    assert not single.shift.any() and not single.turn.any()


@pytest.mark.parametrize("distortion", [None, np.array([-0.12, 0.05, 1e-3, -2e-3, 0.0])])
def test_projection_and_its_slope(distortion: np.ndarray | None) -> None:
    camera = camera_at("a", 20, distortion)
    shot = Details(camera, np.zeros((1, 80, 80, 3), np.float16), 0.5)
    points = np.random.default_rng(0).uniform(-0.08, 0.08, size=(1, 50, 3))
    pixels, slope = projected(points, shot)
    if distortion is None:
        np.testing.assert_allclose(pixels, 0.5 * project(points, camera.K, camera.cam_from_world)[0], atol=1e-12)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        numeric = (projected(points + step, shot)[0] - projected(points - step, shot)[0]) / 2e-6
        # The slope leaves the lens out: exact without one, within the lens' stretch otherwise.
        np.testing.assert_allclose(slope[..., axis], numeric, atol=1e-4 if distortion is None else 40.0)


@given(st.sets(st.integers(0, 60)), st.integers(2, 9), st.sets(st.integers(1, 60), max_size=4))
def test_blocks_hold_every_frame_once(rows: set[int], most: int, cuts: set[int]) -> None:
    edges = [0, *sorted(cuts), 61]
    segments = [(a, b - 1) for a, b in zip(edges, edges[1:], strict=False) if a < b]
    pieces = blocks(sorted(rows), segments, most)
    assert [row for piece in pieces for row in piece] == sorted(rows)
    for piece in pieces:
        assert 0 < len(piece) <= most
        assert sum(any(a <= row <= b for row in piece) for a, b in segments) == 1


def _write(scene: Scene, folder, *, split: list[str]) -> list[str]:
    frames = [f"{i:03d}" for i in range(FRAMES)]
    extras = {
        "split": np.array(split),
        "segments": np.array([[0, FRAMES - 1]]),
        "head_rigid": scene.noisy + [0, 0, 1e-3],
    }
    paths = []
    for camera in scene.cameras:
        extras |= {f"camera.{camera.name}.K": camera.K, f"camera.{camera.name}.cam_from_world": camera.cam_from_world}
        manifest = {
            "stage": "ingest", "subject": "s", "camera": camera.name, "width": SIDE, "height": SIDE,
            "K": camera.K.tolist(), "cam_from_world": camera.cam_from_world.tolist(), "frames": frames,
            "layers": {"rgb": "colour"},
        }  # fmt: skip
        paths.append(str(folder / f"{camera.name}.zip"))
        with FramePackWriter(paths[-1], manifest) as writer:
            for name, picture in zip(frames, scene.pictures[camera.name], strict=True):
                writer.add("rgb", name, picture)
    rest = scene.exact[0].astype(np.float32)
    sequence = MeshSequence(frames, {"head": Part(scene.faces, rest, scene.noisy.astype(np.float32))}, extras)
    write_sequence(folder / "meshes.npz", sequence, {})
    return paths


def _run(folder, packs: list[str], cfg: dict) -> MeshSequence:
    import argparse

    parser = argparse.ArgumentParser()
    verb.add_arguments(parser)
    verb.main(
        parser.parse_args(
            [
                "--meshes",
                str(folder / "meshes.npz"),
                "--frames",
                *packs,
                "--out",
                str(folder / "out.npz"),
                "--cfg",
                json.dumps(cfg),
            ]
        )
    )
    return read_sequence(folder / "out.npz")[0]


def test_verb_moves_training_frames_and_the_rigid_head(scene: Scene, tmp_path, capsys) -> None:
    packs = _write(scene, tmp_path, split=["train"] * 6 + ["test"] * 2)
    before, _ = read_sequence(tmp_path / "meshes.npz")
    after = _run(tmp_path, packs, {"iterations": 4, "frames": "train"})
    assert "head: moved" in capsys.readouterr().out
    verts, given = after.parts["head"].verts, before.parts["head"].verts
    np.testing.assert_array_equal(verts[6:], given[6:])  # held-out frames, to the bit
    assert (np.abs(verts[:6] - given[:6]).max((1, 2)) > 1e-4).all()
    assert not after.extras["align.head"][6:].any() and after.extras["align.head"].shape == (FRAMES, 6)
    # The other state of the head keeps its place beside the head: turned by less than two degrees, 1 mm stays 1 mm.
    apart = after.extras["head_rigid"] - verts
    np.testing.assert_allclose(np.linalg.norm(apart, axis=-1), 1e-3, atol=2e-7)
    np.testing.assert_array_equal(after.parts["head"].rest, before.parts["head"].rest)


def test_verb_refuses_a_camera_that_the_meshes_do_not_know(scene: Scene, tmp_path) -> None:
    packs = _write(scene, tmp_path, split=["train"] * FRAMES)
    sequence, record = read_sequence(tmp_path / "meshes.npz")
    extras = {name: value for name, value in sequence.extras.items() if not name.startswith("camera.b.")}
    write_sequence(tmp_path / "meshes.npz", dataclasses.replace(sequence, extras=extras), record)
    with pytest.raises(DataError, match=r"camera\.b.*found.*a, c"):
        _run(tmp_path, packs, {"iterations": 2})
    assert not (tmp_path / "out.npz").exists()


def test_verb_stops_where_no_part_is_in_any_image(scene: Scene, tmp_path) -> None:
    packs = _write(scene, tmp_path, split=["train"] * FRAMES)
    sequence, record = read_sequence(tmp_path / "meshes.npz")
    far = {
        name: dataclasses.replace(part, verts=part.verts + np.float32(50.0)) for name, part in sequence.parts.items()
    }
    write_sequence(tmp_path / "meshes.npz", dataclasses.replace(sequence, parts=far), record)
    with pytest.raises(DataError, match="expected vertices that project into the images of a, b, c, found none"):
        _run(tmp_path, packs, {"iterations": 2})
    assert not (tmp_path / "out.npz").exists()


def test_verb_stops_where_nothing_is_seen_twice_and_notes_a_part_that_is_not(scene: Scene, tmp_path, capsys) -> None:
    packs = _write(scene, tmp_path, split=["train"] * FRAMES)
    sequence, record = read_sequence(tmp_path / "meshes.npz")
    head = sequence.parts["head"]
    # A run of one frame has nothing to be compared with, however well it is seen.
    alone = sequence.subset(sequence.frames[:1])
    write_sequence(
        tmp_path / "meshes.npz", dataclasses.replace(alone, extras=alone.extras | {"segments": [[0, 0]]}), {}
    )
    with pytest.raises(
        DataError, match=r"expected a vertex that one camera sees in two frames.*found none.*iterations"
    ):
        _run(tmp_path, packs, {"iterations": 2})
    assert not (tmp_path / "out.npz").exists()
    # A hand that is there once is left, and said; the head is aligned.
    once = np.full_like(head.verts, np.nan)
    once[2] = head.verts[2] + np.float32(0.2)
    parts = {"head": head, "right_hand": dataclasses.replace(head, verts=once)}
    write_sequence(tmp_path / "meshes.npz", dataclasses.replace(sequence, parts=parts), record)
    after = _run(tmp_path, packs, {"iterations": 2})
    said = capsys.readouterr().out
    assert "right_hand: no vertex is seen in two frames" in said and "head: no vertex" not in said
    assert after.extras["align.head"].any() and not after.extras["align.right_hand"].any()
