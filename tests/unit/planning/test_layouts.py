"""Which files of the user's a job reads."""

import os

import yaml

from nbavatar.planning import layouts
from tests.scenes.capture import write_capture
from tests.unit.data.tiny import CAMERAS, write_decaf
from tests.unit.planning.plans import ROOT, shipped


def _plan(tmp_path, **changes):
    sheet = tmp_path / "subjects.tsv"
    sheet.write_text(f"subject\ttrain_cameras\ttest_camera\nS2\t{CAMERAS[0]}\t{CAMERAS[1]}\n")
    rows = tmp_path / "runs.tsv"
    rows.write_text("subject\tvariant\tprotocol\nS2\tfull\tnv1024\n")
    config = {"subjects": str(sheet), "runs": str(rows), "figures": "", "data_root": str(tmp_path / "decaf")}
    return shipped("smoke", **({"synthetic": False} | config | changes))


def test_the_files_of_a_job_are_there_wherever_the_release_keeps_the_subject(tmp_path):
    for folder in ("train", "test"):  # S2 is a training subject, but what is on disk decides
        here = tmp_path / folder
        here.mkdir()
        write_decaf(here / "decaf", folder=folder)
        plan = _plan(here)
        files = layouts.dataset(plan)
        assert all(path.is_file() for path in files) and len(files) == len(set(files))
        assert {path.relative_to(here / "decaf").parts[0] for path in files} == {folder, "assets"}


def test_a_dataset_that_is_to_be_made_is_declared_as_it_will_be_written(tmp_path):
    sheet = tmp_path / "two.tsv"
    sheet.write_text("subject\ttrain_cameras\ttest_camera\nS1\t084\t110\nS2\t084\t110\n")
    plan = _plan(tmp_path, subjects=str(sheet), synthetic=True)
    files = layouts.dataset(plan)
    assert len(files) == len(set(files)), "body models are shared, and a file is an output once"
    folders = {path.relative_to(plan.run.data_root).parts for path in files}
    assert ("test", "cutIDs", "S1.pkl") in folders and ("train", "cutIDs", "S2.pkl") in folders
    assert layouts.data_digest(plan, files) == "", "the run's own files are no files of the user's"


def test_a_digest_tells_one_camera_from_another(tmp_path):
    root = write_capture(tmp_path / "toy")
    plan = shipped("capture", data_root=str(root))
    assert [path.name for path in layouts.camera_files(plan, "toy", "c0")] == ["cameras.json", "splits.json"]
    images, masks = ([layouts.image_digest(plan, "toy", c), layouts.mask_digest(plan, "toy", c)] for c in ("c0", "c1"))
    assert len({*images, *masks}) == 4
    own = tmp_path / "own"
    (own / "c0").mkdir(parents=True)
    (own / "c0/f0.png").write_bytes(b"mask")
    stages = yaml.safe_load((ROOT / "config/capture.yaml").read_text())["stages"] | {"masks": {"supplied": str(own)}}
    supplied = shipped("capture", data_root=str(root), stages=stages)
    assert layouts.mask_digest(supplied, "toy", "c0") not in (*images, layouts.mask_digest(supplied, "toy", "c1"))
    before = layouts.capture_digests(supplied, "toy")
    assert len(before) == 2 + 2 * len(plan.subjects["toy"].cameras)
    assert os.path.isdir(plan.subjects["toy"].root) and layouts.meshes_digest(plan, "toy") == before[1]
