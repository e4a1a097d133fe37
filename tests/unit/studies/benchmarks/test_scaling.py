"""How cost grows: exponents, scenes of other sizes, what the verb writes."""

import csv
import subprocess
import sys

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.synthetic.scene import full_scene
from nbavatar.fitting.details import look
from nbavatar.fitting.outline import rims_of
from nbavatar.io.images import decode_image
from nbavatar.mesh.topology import boundary_edges, edges
from nbavatar.studies.benchmarks.scaling import fitted_exponents
from nbavatar.studies.benchmarks.scaling_works import WORKS, _divided, _plan_of, _with_faces
from tests.unit.planning.plans import ROOT


def test_exponents_of_power_laws_and_of_a_law_with_a_constant() -> None:
    sizes = [1, 10, 100, 1000]
    assert fitted_exponents(sizes, [3.0 * size**1.7 for size in sizes]) == pytest.approx((1.7, 1.7))
    overall, at_large = fitted_exponents(sizes, [100.0 + size for size in sizes])
    assert overall < 0.4 and at_large == pytest.approx(np.log10(1100 / 200))


@pytest.fixture(scope="module")
def full() -> MeshSequence:
    return full_scene(4, dents=False)


def test_divided_meshes_are_the_same_surface_with_four_times_the_faces(full) -> None:
    head = full.parts["head"]
    fine = _divided(head)
    assert len(fine.faces) == 4 * len(head.faces)

    def area(part, frame):
        a, b, c = (part.verts[frame][part.faces[:, corner]].astype(float) for corner in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()

    for frame in (0, 2):  # of vertices in float32, whose middles are rounded
        assert area(fine, frame) == pytest.approx(area(head, frame), rel=1e-5)
    assert len(edges(fine.faces)) == 2 * len(edges(head.faces)) + 3 * len(head.faces)
    assert len(boundary_edges(fine.faces)) == 2 * len(boundary_edges(head.faces))


@pytest.mark.parametrize("count", WORKS["step.billboards"].sizes)
def test_scenes_have_about_the_faces_that_are_asked_for(full, count: int) -> None:
    parts = _with_faces(full, count).parts.values()
    assert sum(len(part.faces) for part in parts) == pytest.approx(count, rel=0.01)


def test_plans_of_more_subjects_have_the_papers_rows_for_each() -> None:
    one, many = _plan_of(1, str(ROOT)), _plan_of(5, str(ROOT))
    assert len({row.variant for row in one.rows}) > 5 and len(many.rows) == 5 * len(one.rows)
    assert {row.subject for row in many.rows} == set(many.subjects)


def test_the_verb_writes_points_and_exponents(tmp_path, capsys) -> None:
    works = ["subjects", "frames", "cameras"]
    words = ["scaling", "--only", *works, "--largest", "100", "--repeats", "1", "--out", str(tmp_path)]
    assert main(["bench", *words]) == 0
    assert "subjects_exponent_at_large" in capsys.readouterr().out
    with open(tmp_path / "scaling.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["work"], int(row["size"])) for row in rows] == [
        *(("subjects", size) for size in (1, 10, 100)), *(("frames", size) for size in (10, 100)),
        *(("cameras", size) for size in (1, 10, 100)),
    ]  # fmt: skip
    assert all(float(row["ms"]) > 0 for row in rows)
    assert decode_image(tmp_path / "scaling.png").std() > 5
    assert main(["bench", "scaling", "--only", "subjects", "--largest", "1"]) == 2
    assert "--largest: expected at least 10" in capsys.readouterr().err


def test_meshes_are_aligned_to_the_cameras_of_the_scene(monkeypatch) -> None:
    """What is measured is the work: meshes that the pictures say nothing about would be left alone at once."""
    counted, seen = [], []

    def counting(*arguments):
        counted.append(rims_of(*arguments))
        return counted[-1]

    def looking(*arguments):
        found = look(*arguments)
        seen.append(found[0])
        return found

    monkeypatch.setattr("nbavatar.fitting.bend.rims_of", counting)
    for stage in ("align", "bend"):
        monkeypatch.setattr(f"nbavatar.fitting.{stage}.look", looking)
    WORKS["align.cameras"].prepare(3, "", "")()
    assert len(counted) == 2 and len(seen) == 2  # two scales of detail; moved, then bent
    for rims in counted:
        assert {rim.camera for rim in rims["head"]} == {0, 1, 2}
    # The middle camera is before the face: the nose's tip, the head's foremost vertex, is seen in all frames.
    head = full_scene(4, dents=False).parts["head"].verts
    tip = int(np.argmin(head[0][:, 1]))
    assert all(visible["head"][1, :, tip].all() for visible in seen)


def test_more_cameras_than_files_may_be_open_are_told_in_one_line() -> None:
    """A pack stays open for each camera; the limit is the process's, so another process meets it."""
    words = ["bench", "scaling", "--only", "cameras", "--largest", "100", "--repeats", "1"]
    code = (
        "import resource, sys; from nbavatar.cli import main; "
        "resource.setrlimit(resource.RLIMIT_NOFILE, (90, 90)); "
        f"sys.exit(main({words!r}))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode == 2, run.stderr
    assert "Too many open files; raise the limit of open files (ulimit -n)" in run.stderr.splitlines()[-1]
