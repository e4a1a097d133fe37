"""Commands of the documents run as they stand, in one tiny folder; documented.py fills in what is the reader's."""

import glob
import importlib.util
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from nbavatar.cli import main
from nbavatar.methods.storage import save_avatar
from tests.architecture.documented import COMMANDS, HERE, PLANNED, ROOT, Case, known
from tests.scenes import foreign
from tests.scenes.solid import CAMERAS, write_solid
from tests.scenes.tiny_sam3 import write_tiny_sam3
from tests.scenes.toy import write_scene
from tests.scenes.training import train_options
from tests.unit.methods.billboards.test_model import make_avatar
from tests.unit.methods.gaussians.test_avatars import bound
from tests.workflow import imported
from tools.pictures import WANTED

pytestmark = pytest.mark.slow

TRAIN = train_options({
    "steps": 2, "texels": 4, "unet": {"width": 4, "depth": 3, "max_width": 8, "convs": 1}, "weight_lpips": 0.0,
    "previews": 0, "coarse_side": 16,
})  # fmt: skip
FILMED = (
    '{"mesh": "tiny", "subjects": ["S2"], "cameras": ["084", "100", "102"], "width": 96, "height": 54, "frames": 4,'
    ' "keypoint_noise": 0.5, "missing": 0.0}'
)
ENVIRONMENT = {
    **os.environ,
    "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    "PYTHONPATH": str(ROOT),
}


def commands(table) -> list[str]:
    """Commands of all pages whose beginning stands in a table; of those that come to the same, one."""
    found = {tuple(swapped(command)): command for _, command in reversed(COMMANDS) if known(command) in table}
    return list(reversed(found.values()))


def swapped(command: str) -> list[str]:
    """Words of a command with the reader's filled in."""
    case = HERE.get(known(command), Case())
    return [case.swap.get(word, word) for word in [*shlex.split(command), *shlex.split(case.more)]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Everything that the documents take for granted: a run, captures, folders of other programs, a filmed subject."""
    here = tmp_path_factory.mktemp("documented")
    before = Path.cwd()
    os.chdir(here)
    try:
        _make_run(here)
        _make_captures(here)
        _make_film()
    finally:
        os.chdir(before)
    return here


def _make_run(here: Path) -> None:
    """results/smoke with three avatars of a toy; the middle camera is held out."""
    scene, run = write_scene(here / "scene"), here / "results/smoke"
    for path, place in (
        (scene["meshes"], "deform/S2.npz"), (scene["spectral"], "spectral/S2.npz"),
        *((pack, f"crop/center/S2/{pack.name}") for pack in scene["packs"]),
    ):  # fmt: skip
        (run / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, run / place)
    words = "train --frames results/smoke/crop/center/S2/cam0.zip results/smoke/crop/center/S2/cam2.zip"
    words += " --meshes results/smoke/deform/S2.npz --spectral results/smoke/spectral/S2.npz --device cpu"
    assert main([*words.split(), "--out", "results/smoke/train/S2/full/model.pt", "--cfg", json.dumps(TRAIN)]) == 0
    for name, avatar in (("no_dnr", make_avatar(deferred=False)), ("gaussian_avatars", bound())):
        (run / "train/S2" / name).mkdir()
        save_avatar(run / "train/S2" / name / "model.pt", avatar)


def _make_captures(here: Path) -> None:
    write_solid(here / "capture")
    write_solid(here / "captures/S2")
    assert main("tracks --layout capture --root capture --subject me --out capture.npz".split()) == 0
    for name, without in (("bare", "meshes"), ("unmasked", "masks")):
        shutil.copytree(here / "capture", here / name)
        shutil.rmtree(here / name / without)
    foreign.write_flame(here / "generic_model.pkl")
    foreign.write_vhap(here / "vhap")
    foreign.write_vhap(here / "vhap_meshes", mode="mesh")
    foreign.write_colmap(here / "rig", calibration_only=True)
    foreign.write_pictures(here / "video")
    foreign.write_colmap(here / "colmap")
    foreign.write_nerfstudio(here / "nerfstudio")
    foreign.write_meshes(here / "meshes")
    if importlib.util.find_spec("transformers"):
        write_tiny_sam3(here / "sam3")


def _make_film() -> None:
    assert main(["synthesize", "--out", "dataset", "--cfg", FILMED]) == 0
    common = "--layout decaf --root dataset --subject S2".split()
    for camera in ("084", "100", "102"):
        assert main(["ingest", *common, "--camera", camera, "--out", f"filmed/{camera}.zip"]) == 0
    assert main(["tracks", *common, "--out", "keypoints.npz"]) == 0


def filled(command: str) -> list[str]:
    """Words of a command with the reader's filled in and wildcards as the shell takes them."""
    found: list[str] = []
    for word in swapped(command):
        files = sorted(glob.glob(word)) if "*" in word else [word]
        assert files, f"nothing is called {word}"
        found += [file for file in files if file]
    return found


def run(words: list[str], capfd) -> tuple[int, str]:
    """Exit code and output of a command: ours in this process, others in one of their own."""
    if words[0] == "nbavatar":
        try:
            code = main(words[1:])
        except SystemExit as end:  # of --help
            code = end.code
        return code, "".join(capfd.readouterr())
    words = [sys.executable, str(ROOT / words[1]), *words[2:]]
    done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("command", [c for c in commands(HERE) if " view " not in c], ids=lambda c: c[:60])
def test_a_documented_command_runs(command, folder, monkeypatch, capfd) -> None:
    if "sam3" in command:
        pytest.importorskip("transformers")
    monkeypatch.chdir(folder)
    case = HERE[known(command)]
    for pattern in case.makes:
        for path in glob.glob(pattern):
            os.remove(path)
    code, said = run(filled(command), capfd)
    assert code == 0, said[-2000:]
    assert case.says in said
    for pattern in case.makes:
        assert glob.glob(pattern), f"{command} has not made {pattern}"


@pytest.mark.parametrize("command", [c for c in commands(HERE) if " view " in c], ids=lambda c: c[:60])
def test_the_viewer_answers_until_it_is_interrupted(command, folder) -> None:
    before = Path.cwd()
    os.chdir(folder)
    try:
        words = filled(command)
    finally:
        os.chdir(before)
    # A shell that begins the tests with `&` has them ignore interrupts, and all that they begin.
    heard = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    started = f"from nbavatar.cli import main; sys.exit(main({words[1:]!r}))"
    command_line = [sys.executable, "-c", heard + started]
    with subprocess.Popen(command_line, cwd=folder, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as viewer:
        try:
            line = viewer.stdout.readline()
            address = re.match(rf"{HERE[known(command)].says}\d+", line)
            assert address, line
            with urllib.request.urlopen(address[0].removeprefix("viewer: "), timeout=60) as page:
                assert b"<html" in page.read()
            viewer.send_signal(signal.SIGINT)
            assert viewer.wait(timeout=60) == 0
        finally:
            viewer.kill()


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """The repository with a configuration that may be changed."""
    place = tmp_path_factory.mktemp("project")
    for name in ("Snakefile", "workflow", "nbavatar", "profiles"):
        (place / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "config", place / "config")
    return place


def planned(words: list[str], where: Path) -> str:
    """Output of the plan that words of snakemake or of `nbavatar run` make."""
    if words[0] == "nbavatar":
        words = [sys.executable, "-m", *words, *(() if "--" in words else ("--",)), "-n"]
        done = subprocess.run(words, cwd=where, env=ENVIRONMENT, capture_output=True, text=True)
    else:
        configured = [] if "--configfile" in words else ["--configfile", "config/smoke.yaml"]  # the paper needs Decaf
        words = ["-n", "--cores", "2", *words[1:], *configured]
        done = imported.snakemake(words, where, ENVIRONMENT | {"PYTHONPATH": str(where)})
    assert done.returncode == 0, (done.stdout + done.stderr)[-2000:]
    return done.stdout + done.stderr


@pytest.mark.parametrize("command", [c for c in commands(PLANNED) if not c.startswith("printf")], ids=lambda c: c[:60])
def test_a_documented_command_is_planned(command, folder, project) -> None:
    places = {"/path/to/capture": str(folder / "capture"), "/path/to/captures": str(folder / "captures")}
    places |= {"CAPTURE=CAPTURE": f"CAPTURE={folder / 'capture'}"}
    places |= {f"{key}={name}": f"{key}={places[name]}" for key in ("CAPTURE", "data_root") for name in places}
    words = [places.get(word, word) for word in shlex.split(command)]
    if words[0] == "make":
        done = subprocess.run(["make", "-n", *words[1:]], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        said = done.stdout
    else:
        said = planned(words, project)
    assert PLANNED[known(command)][0] in said


def test_the_tutorial_changes_one_thing(project, tmp_path) -> None:
    """Its variant, its row and its plan: one more avatar is trained, rendered and judged."""
    text = (ROOT / "docs/tutorial.md").read_text(encoding="utf-8")
    (variant,) = re.findall(r"^```yaml\nvariants:\n(.*?)^```", text, re.M | re.S)
    (row,) = [command for command in commands(PLANNED) if command.startswith("printf")]
    plan = shlex.split("snakemake --configfile config/smoke.yaml -n")

    def jobs() -> dict[str, int]:
        said = planned(plan, tmp_path)
        return {rule: int(count) for rule, count in re.findall(r"^(train|render|evaluate) +(\d+)$", said, re.M)}

    shutil.copytree(project, tmp_path, symlinks=True, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".snakemake"))
    before = jobs()
    config = tmp_path / "config/smoke.yaml"
    config.write_text(config.read_text().replace("variants:\n", "variants:\n" + variant, 1))
    subprocess.run(["bash", "-c", row], cwd=tmp_path, check=True)
    assert jobs() == {rule: count + 1 for rule, count in before.items()} and len(before) == 3


def test_the_pictures_of_the_documents_need_the_camera_that_is_held_out(folder, project) -> None:
    words = ["snakemake", *WANTED[:-1], str(ROOT / WANTED[-1]), "--config", f"data_root={folder / 'captures/S2'}"]
    said = planned(words, project)
    assert re.search(r"^train +1$", said, re.M) and re.search(rf"^crop +{len(CAMERAS)}$", said, re.M)


def test_the_pictures_of_the_documents_are_drawn(folder) -> None:
    """tools/pictures.py on the tiny run; the viewer's picture is left out, test_page.py looks at the page."""
    words = "-m tools.pictures --results results/smoke --out pictures --only strip film".split()
    done = subprocess.run([sys.executable, *words], cwd=folder, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (folder / "pictures").iterdir()} == {"avatar.webp", "avatar-moves.webp"}
