"""One subject of the paper alone, and a second one that comes later: commands are stubs."""

import pytest

from tests.workflow.test_dag import _decaf

# A hundred stub jobs.
pytestmark = pytest.mark.slow


def test_a_second_subject_runs_only_itself_and_what_shows_both(project):
    _decaf(project)
    (project.folder / "config/s2.yaml").write_text("only: [S2]\n")
    (project.folder / "config/both.yaml").write_text("only: [S2, S4]\n")
    done = project.snakemake("--quiet", "all", config="config/paper.yaml config/s2.yaml")
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    assert project.plan(config="config/paper.yaml config/s2.yaml") == {}
    (project.folder / "calls").unlink()
    done = project.snakemake("--cores", "1", "--quiet", "all", config="config/paper.yaml config/both.yaml")
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    calls = (project.folder / "calls").read_text().splitlines()
    shared = {"table", "figure", "collect", "report"}
    calls = [call for call in calls if call.strip()]
    own = [call for call in calls if call.split()[0] not in shared]
    assert own and all("S4" in call for call in own)
    assert {call.split()[0] for call in calls} >= shared | {"ingest", "fit", "train", "evaluate", "video"}
