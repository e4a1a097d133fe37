"""Knobs of the stages before training: errors by independent means, on shapes with known answers."""

import json

import numpy as np
import pytest

from nbavatar.config.tradeoff import OfflineConfig
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.errors import DependencyError, require
from nbavatar.studies.tradeoff.offline import decimate, decimation_rows, spectral_rows
from nbavatar.studies.tradeoff.section import offline_section, tradeoff_section


def sphere(rings: int = 14) -> tuple[np.ndarray, np.ndarray]:
    """A closed sphere of 10 cm radius by latitude and longitude."""
    around = 2 * rings
    polar, turn = np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(around) / around
    p, t = np.meshgrid(polar, turn, indexing="ij")
    middle = np.stack((np.sin(p) * np.cos(t), np.cos(p), np.sin(p) * np.sin(t)), -1).reshape(-1, 3)
    verts = 0.1 * np.vstack((middle, [[0, 1, 0], [0, -1, 0]]))
    top, bottom = len(middle), len(middle) + 1
    faces = []
    for i in range(around):
        j = (i + 1) % around
        faces.append([top, j, i])
        faces.append([bottom, (rings - 2) * around + i, (rings - 2) * around + j])
        for r in range(rings - 2):
            a, b, c, d = (r * around + i, r * around + j, (r + 1) * around + i, (r + 1) * around + j)
            faces += [[a, b, d], [a, d, c]]
    return verts, np.array(faces, np.int64)


@pytest.fixture
def pymeshlab() -> None:
    """Skips where the system lacks a library that pymeshlab wants, which no other stage does; CI installs them."""
    try:
        require("pymeshlab", "pymeshlab", "these tests")
    except DependencyError as error:
        pytest.skip(str(error))


@pytest.fixture
def ball() -> MeshSequence:
    """The sphere, at rest, moved, and stretched."""
    verts, faces = sphere()
    frames = np.stack([verts, verts + [0.3, 0.0, 0.1], verts * [1.0, 1.2, 0.9]]).astype(np.float32)
    return MeshSequence(["a", "b", "c"], {"head": Part(faces, verts.astype(np.float32), frames)}, {})


@pytest.mark.slow  # pymeshlab takes seconds to start
def test_a_coarser_sphere_is_still_a_sphere_and_rides_along(ball, pymeshlab) -> None:
    coarse = decimate(ball, 0.4)
    part, whole = coarse.parts["head"], ball.parts["head"]
    assert len(part.faces) == pytest.approx(0.4 * len(whole.faces), rel=0.05)
    # Optimal placement leaves the sphere by no more than the sagitta of its larger triangles, about 2 mm.
    assert np.abs(np.linalg.norm(part.rest, axis=1) - 0.1).max() < 2e-3
    # A rigid shift of the original shifts what rides on it; a stretch stretches it.
    shift = np.broadcast_to([0.3, 0.0, 0.1], part.rest.shape)
    np.testing.assert_allclose(part.verts[1] - part.verts[0], shift, atol=1e-6)
    np.testing.assert_allclose(part.verts[2], part.verts[0] * [1.0, 1.2, 0.9], atol=1e-6)


@pytest.mark.slow
def test_coarser_meshes_are_farther_from_the_original(ball, pymeshlab) -> None:
    rows = list(decimation_rows(ball, OfflineConfig(decimate_shares=[1.0, 0.5, 0.15], decimate_frames=3)))
    assert [row["faces"] for row in rows] == sorted((row["faces"] for row in rows), reverse=True)
    errors = [row["error_mm"] for row in rows]
    assert errors[0] < 1e-4 and errors[0] < errors[1] < errors[2] < 5.0


def test_three_modes_hold_a_sphere_and_no_mode_number_is_worse(ball) -> None:
    rows = list(spectral_rows(ball, OfflineConfig(spectral_modes=[1, 3, 8])))
    errors = [row["error_mm"] for row in rows]
    # The first three harmonics of a sphere are its coordinates; one of them leaves the other two out.
    assert errors[0] > 50 and errors[1] < 1.5 and errors[2] <= errors[1] + 1e-9


def test_the_report_names_every_stage(ball) -> None:
    rows = list(spectral_rows(ball, OfflineConfig(spectral_modes=[3])))
    section = offline_section({"rows": rows}, "| table |")
    assert section.paragraphs[0].startswith("Spectral, modes") and " mm in " in section.paragraphs[0]


def test_a_sweep_says_which_pictures_judge_where_they_are_smaller():
    result = {"device": "cpu", "size": [64, 64], "images": 2, "presets": {}, "complete": True, "paragraphs": {}}
    captions = {
        key: tradeoff_section(result | more, "| table |").figures[0][1]
        for key, more in {"older": {}, "same": {"frames": [64, 64]}, "smaller": {"frames": [32, 32]}}.items()
    }
    assert captions["older"] == captions["same"] and "32x32" not in captions["same"]
    assert "32x32 px" in captions["smaller"]


def test_without_pymeshlabs_libraries_only_the_coarser_meshes_are_left_out(ball, tmp_path, monkeypatch, capsys):
    """pymeshlab wants libGL from the system. The other stages are measured, and the sheet says what is lacking."""
    import sys

    from nbavatar.cli import main
    from nbavatar.data.sequences import write_sequence
    from nbavatar.studies.tradeoff import offline

    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    monkeypatch.setattr(offline, "contact_rows", lambda *_: [])
    monkeypatch.setattr(offline, "refit_rows", lambda *_: [])
    write_sequence(tmp_path / "meshes.npz", ball, {})
    sheet = json.dumps({"offline": {"spectral_modes": [3]}})
    words = ["--meshes", str(tmp_path / "meshes.npz"), "--sheet", sheet, "--out", str(tmp_path / "out")]
    assert main(["tradeoff", "--offline", *words]) == 0
    assert "warning: no coarser meshes are measured: package 'pymeshlab'" in capsys.readouterr().err
    result = json.loads((tmp_path / "out" / "offline.json").read_text(encoding="utf-8"))
    assert [row["stage"] for row in result["rows"]] == ["spectral"] and "pymeshlab" in result["lacking"]
    assert any("Coarser meshes were not measured" in text for text in offline_section(result, "").paragraphs)
