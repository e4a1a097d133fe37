"""Names from files through the whole workflow: hostile ones stop it before any job, odd ones reach commands whole."""

import json
import shlex

import pytest
import yaml

from tests.scenes.capture import write_capture
from tests.workflow.conftest import Project

# A capture through stubs, a few seconds each.
pytestmark = pytest.mark.slow

COMMAND = "x;touch pwned;"
ODD = "it's $(touch pwned) 头像; touch pwned & *"


def _pwned(folder):
    return sorted(path for path in folder.rglob("*pwned*") if path.name in ("pwned", "pwned;"))


def _rename_camera(capture, name):
    path = capture / "cameras.json"
    cameras = json.loads(path.read_text())
    cameras[name] = cameras.pop("c1")
    path.write_text(json.dumps(cameras))
    if "/" not in name:
        for kind in ("images", "masks"):
            (capture / kind / "c1").rename(capture / kind / name)


@pytest.mark.parametrize("name", [COMMAND, "../evil", "a\n$(touch pwned)"])
def test_a_hostile_camera_stops_the_workflow_in_one_line(project, tmp_path, name):
    capture = write_capture(tmp_path / "toy")
    _rename_camera(capture, name)
    done = project.snakemake("--config", f"data_root={capture}", config="config/capture.yaml")
    text = done.stdout + done.stderr
    assert done.returncode != 0 and "Traceback" not in text
    assert "cameras.json: camera: expected a name of letters, digits" in text
    assert not (project.folder / "results/capture").exists() and not (project.folder / "logs/capture").exists()
    assert not _pwned(project.folder) and not list(tmp_path.rglob("*evil*"))


@pytest.mark.parametrize("key", ["variants", "crops", "protocols"])
def test_a_hostile_configuration_stops_the_workflow(project, tmp_path, key):
    config = yaml.safe_load((project.folder / "config/capture.yaml").read_text())
    config["data_root"] = str(write_capture(tmp_path / "toy"))
    config[key][COMMAND] = next(iter(config[key].values()))
    (project.folder / "config/hostile.yaml").write_text(yaml.safe_dump(config))
    done = project.snakemake(config="config/hostile.yaml")
    assert done.returncode != 0
    assert f"config.{key}: expected a name of letters, digits" in done.stdout + done.stderr
    assert not _pwned(project.folder)


def test_a_hostile_sheet_stops_the_workflow(project):
    sheet = project.folder / "config/hostile.tsv"
    sheet.write_text(f"subject\ttrain_cameras\ttest_camera\nS2\t084,{COMMAND}\t100\n")
    done = project.snakemake("--config", f"subjects={sheet.relative_to(project.folder)}")
    assert done.returncode != 0
    assert "hostile.tsv, line 2: camera: expected a name" in done.stdout + done.stderr
    assert not _pwned(project.folder)


def test_odd_folders_and_names_of_any_script_reach_the_commands_whole(tmp_path):
    odd = Project(tmp_path / ODD / "p")
    capture = write_capture(tmp_path / ODD / "张三's 头像")
    _rename_camera(capture, "камера.1-कै")
    done = odd.snakemake("--config", f"data_root={capture}", config="config/capture.yaml")
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    assert (odd.folder / "results/capture/ingest/张三_s_头像/камера.1-कै.zip").is_file()
    assert not _pwned(tmp_path)
    calls = [shlex.split(line) for line in (odd.folder / "calls").read_text().splitlines()]
    assert {words[words.index("--root") + 1] for words in calls if "--root" in words} == {str(capture)}
    # Braces are wildcards in inputs, and nothing escapes them in what a function returns.
    (tmp_path / "{a}").symlink_to(capture)
    refused = odd.snakemake("-n", "--config", f"data_root={tmp_path}/{{a}}", config="config/capture.yaml")
    assert "config.data_root: expected a path without braces" in refused.stdout + refused.stderr
    assert odd.plan("--config", f"data_root={capture}", config="config/capture.yaml") == {}
