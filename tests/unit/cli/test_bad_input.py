"""What goes wrong in practice: each ends in one line, exit code 2, and no file of any kind is left."""

import json
import pickle
import subprocess
import sys

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.io.pickles import read_pickle


def run(verb, root, out, *more, cfg="{}", subject="S2", camera="084", layout="decaf"):
    words = [verb, "--layout", layout, "--root", str(root), "--subject", subject, "--cfg", cfg]
    words += ["--camera", camera] if verb == "ingest" else []
    return main([*words, "--out", str(out / f"{verb}.out"), *more])


def edit_parameters(decaf, change):
    path = decaf / "train/params/S2/params_smoothed.pkl"
    content = read_pickle(path)
    change(content)
    path.write_bytes(pickle.dumps(content, protocol=2))


def halve(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def shorten(path):
    np.save(path, np.load(path)[:-2])


class Hostile:
    def __reduce__(self):
        import os

        return os.mkdir, ("owned",)


CASES = {
    "missing camera": ("ingest", None, {"camera": "111"}, "no camera '111'; known: 084, 100"),
    "missing video": (
        "ingest",
        lambda d: (d / "train/videos/S2/084.mp4").unlink(),
        {},
        "subject S2 has no video 084.mp4; known: 100",
    ),
    "missing mask video": (
        "ingest",
        lambda d: (d / "train/segmentations/S2/084.mp4").unlink(),
        {},
        "segmentations/S2/084.mp4: expected a video file, found no such file",
    ),
    "truncated video": (
        "ingest",
        lambda d: halve(d / "train/videos/S2/084.mp4"),
        {},
        "084.mp4: expected a readable video",
    ),
    "truncated mask video": (
        "ingest",
        lambda d: halve(d / "train/segmentations/S2/084.mp4"),
        {},
        "084.mp4: expected a readable video",
    ),
    "frame counts": (
        "ingest",
        lambda d: shorten(d / "train/head_keys/S2/084.npy"),
        {},
        "head_keys/S2/084.npy: frames: expected 12 as 9 other files of this subject, found 10",
    ),
    "frame counts of tracks": (
        "tracks",
        lambda d: shorten(d / "train/contacts/S2/contacts_rh.npy"),
        {},
        "contacts_rh.npy: frames: expected 12",
    ),
    "NaN": (
        "tracks",
        lambda d: edit_parameters(d, lambda p: p[3]["head"]["transl"].__setitem__(0, np.nan)),
        {},
        "frame 3: head.transl: expected finite numbers, found NaN",
    ),
    "hostile pickle": (
        "tracks",
        lambda d: (d / "train/params/S2/params_smoothed.pkl").write_bytes(pickle.dumps(Hostile())),
        {},
        "which is not allowed",
    ),
    "hostile body model": (
        "tracks",
        lambda d: (d / "assets/generic_model.pkl").write_bytes(pickle.dumps(Hostile())),
        {},
        "which is not allowed",
    ),
    "hostile cameras": (
        "ingest",
        lambda d: (d / "train/cameras/S2/cameras.pkl").write_bytes(pickle.dumps(Hostile())),
        {},
        "which is not allowed",
    ),
    "config typo": ("ingest", None, {"cfg": '{"evry": 2}'}, "unknown key 'evry'; did you mean 'every'?"),
    "config range": ("ingest", None, {"cfg": '{"every": 0}'}, "expected at least 1, found 0"),
    "config syntax": ("tracks", None, {"cfg": "{every: 2"}, "--cfg: expected JSON"),
    "unknown subject": ("ingest", None, {"subject": "S9"}, "unknown subject 'S9'; known: S2"),
    "start beyond the end": ("ingest", None, {"cfg": '{"start": 99}'}, "expected more than start = 99, found 12"),
    "wrong topology": (
        "tracks",
        lambda d: np.save(d / "train/deformations/S2/deforms.npy", np.zeros((12, 39, 3))),
        {},
        "deforms.npy: shape: expected [frames, 40, 3], found [12, 39, 3]",
    ),
    "missing body model": (
        "tracks",
        lambda d: (d / "assets/mano_v1_2/models/MANO_RIGHT.pkl").unlink(),
        {},
        "MANO_RIGHT.pkl: expected a readable file",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_one_line_exit_code_2_and_nothing_left(decaf, tmp_path, capfd, monkeypatch, name):
    verb, damage, options, line = CASES[name]
    if damage is not None:
        damage(decaf)
    out = tmp_path / "out"
    out.mkdir()
    monkeypatch.chdir(out)
    before = sorted(path for path in decaf.rglob("*"))
    assert run(verb, decaf, out, **options) == 2
    lines = [
        text
        for text in capfd.readouterr().err.replace("\r", "\n").splitlines()
        if "it/s" not in text and "?it" not in text
    ]
    assert [text for text in lines if text.strip()] == [lines[-1]], lines
    assert lines[-1].startswith(f"nbavatar {verb}: error: ") and line in lines[-1]
    assert list(out.iterdir()) == []
    assert sorted(path for path in decaf.rglob("*")) == before


def test_a_video_that_ends_early_leaves_no_half_pack(decaf, tiny, tmp_path, capfd, monkeypatch):
    """The header promises twelve frames, ten decode: found only after ten have been written."""
    from nbavatar.io import video

    real = video._Capture

    class Short(real):
        def __init__(self, path):
            super().__init__(path)
            handle, left = self.handle, [10 if "videos" in str(path) else 99]

            class Handle:
                retrieve, release, get = handle.retrieve, handle.release, handle.get

                @staticmethod
                def grab():
                    left[0] -= 1
                    return left[0] >= 0 and handle.grab()

            self.handle = Handle

    monkeypatch.setattr(video, "_Capture", Short)
    out = tmp_path / "out"
    out.mkdir()
    assert run("ingest", decaf, out) == 2
    assert "084.mp4: frames: expected 12, found 10 that decode; the video is truncated" in capfd.readouterr().err
    assert list(out.iterdir()) == []


def test_an_interrupt_leaves_nothing(decaf, tmp_path, monkeypatch):
    from nbavatar.io.framepack import FramePackWriter

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(FramePackWriter, "add", interrupt)
    out = tmp_path / "out"
    out.mkdir()
    assert run("ingest", decaf, out) == 130
    assert list(out.iterdir()) == []


@pytest.mark.parametrize("verb", ["ingest", "masks", "crop", "check"])
def test_light_verbs_start_without_torch(verb):
    code = (
        "import sys, importlib\n"
        f"importlib.import_module('nbavatar.cli.{verb}')\n"
        "heavy = {'torch', 'igl', 'trimesh', 'pymeshlab', 'matplotlib', 'pandas', 'OpenEXR'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_capture_errors_are_one_line_too(capture, tmp_path, capfd):
    cameras = json.loads((capture / "cameras.json").read_text())
    cameras["left"]["t"] = [0, 0]
    (capture / "cameras.json").write_text(json.dumps(cameras))
    out = tmp_path / "out"
    out.mkdir()
    for verb in ("ingest", "tracks"):
        assert run(verb, capture, out, layout="capture", camera="left") == 2
        assert "camera left: t: expected 3 finite numbers" in capfd.readouterr().err
    assert list(out.iterdir()) == []
