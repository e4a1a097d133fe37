"""Commands of the documents, and where each is run: at a tiny size, as a plan, by another test, or nowhere and why.

A table's keys are how a command begins, without `.venv/bin/`; the longest that fits counts.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("resources/*.md")])


class Case(NamedTuple):
    """How a command is run in the tiny folder of test_documented_runs.py.

    Attributes:
        swap: words of the page -> words in their place, where the page names what is the reader's.
        more: words put behind, to make it small.
        makes: files that it has to make.
        says: what its output has to contain.
    """

    swap: Mapping[str, str] = {}
    more: str = ""
    makes: tuple[str, ...] = ()
    says: str = ""


_SMALL = "--size 64 --billboards 60 --channels 3 --texels 4 --repeats 1 --window 16"
_MODEL = {"MODEL": "results/smoke/train/S2/full/model.pt", "NPZ": "results/smoke/deform/S2.npz"}
_CAMERAS = _MODEL | {"ZIP": "results/smoke/crop/center/S2/*.zip", "...": ""}
_COLOURS = _MODEL | {"MODEL": "results/smoke/train/S2/no_dnr/model.pt"}
_SPLATS = _MODEL | {"MODEL": "results/smoke/train/S2/gaussian_avatars/model.pt"}
_PACKS = {"packs/*.zip": "filmed/*.zip", "work/*.zip": "filmed/*.zip", "ASSETS": "dataset/assets"}

# Run here.
HERE = {
    "nbavatar --help": Case(says="train an avatar"),
    "nbavatar train --help": Case(says="--meshes"),
    "nbavatar train --frames results/smoke/": Case(
        {"/tmp/model.pt": "by_hand/model.pt"}, "--set steps=2", ("by_hand/model.pt",)
    ),
    "nbavatar view results/smoke": Case(says="viewer: http://127.0.0.1:"),
    "nbavatar view /tmp/model.pt": Case(
        {"/tmp/model.pt": "results/smoke/train/S2/full/model.pt"}, says="viewer: http://127.0.0.1:"
    ),
    "nbavatar view MODEL": Case(
        _CAMERAS | {"[MODEL": "results/smoke/train/S2/no_dnr/model.pt", "...]": ""},
        says="viewer: http://127.0.0.1:",
    ),
    "nbavatar doctor": Case(says="nbavatar"),
    "nbavatar doctor --plan": Case(says="train"),
    "nbavatar check": Case(
        {"/path/to/capture": "capture", "CAPTURE": "capture"}, makes=("overlays/overview.png",), says="0 defects"
    ),
    "nbavatar import vhap /path/to/export /path/to/capture --flame": Case(
        {"/path/to/export": "vhap", "/path/to/capture": "made/vhap"}, makes=("made/vhap/cameras.json",)
    ),
    "nbavatar import vhap EXPORT CAPTURE --flame": Case(
        {"EXPORT": "vhap", "CAPTURE": "made/flame"}, makes=("made/flame/cameras.json",)
    ),
    "nbavatar import vhap EXPORT CAPTURE": Case(
        {"EXPORT": "vhap_meshes", "CAPTURE": "made/obj"}, makes=("made/obj/meshes/topology.npz",)
    ),
    "nbavatar import colmap rig": Case({"CAPTURE": "made/rig"}, makes=("made/rig/cameras.json",)),
    "nbavatar import colmap WORKSPACE": Case(
        {"WORKSPACE": "colmap", "CAPTURE": "made/colmap", "M": "1.0", "MESHES": "meshes"},
        makes=("made/colmap/meshes/topology.npz",),
    ),
    "nbavatar import nerfstudio": Case(
        {"FOLDER": "nerfstudio", "CAPTURE": "made/nerfstudio", "M": "1.0", "MESHES": "meshes"},
        makes=("made/nerfstudio/meshes/topology.npz",),
    ),
    "nbavatar import meshes": Case(
        {"work/meshes.npz": "capture.npz", "CAPTURE": "bare"}, makes=("bare/meshes/topology.npz",)
    ),
    "nbavatar ingest": Case(
        {"CAPTURE": "capture", "$c": "low", "work/$c.zip": "work/low.zip"}, makes=("work/low.zip",)
    ),
    "nbavatar fit": Case(
        _PACKS | {"work/keypoints.npz": "keypoints.npz"} | {f"work/{name}": name for name in ("meshes.npz", "fit.png")},
        makes=("meshes.npz", "fit.png"),
    ),
    "nbavatar segment CAPTURE --method sam3": Case(
        {"CAPTURE": "unmasked"}, "--device cpu", ("unmasked/masks/*/*.png", "unmasked/segment/*.png")
    ),
    "nbavatar export MODEL --to splats": Case(_SPLATS | {"DIR": "out/splats"}, makes=("out/splats/*.ply",)),
    "nbavatar export MODEL --to billboards": Case(
        _COLOURS | {"FILE.glb": "out/quads.glb"}, makes=("out/quads.glb",)
    ),
    "nbavatar export --to meshes --meshes NPZ --out": Case(
        _MODEL | {"FILE.glb": "out/meshes.glb"}, makes=("out/meshes.glb",)
    ),
    "nbavatar export --to meshes --meshes NPZ --type obj": Case(
        _MODEL | {"DIR": "out/meshes"}, makes=("out/meshes/*.obj",)
    ),
    "nbavatar export MODEL --to tensors": Case(
        _MODEL | {"FILE.safetensors": "out/avatar.safetensors"}, makes=("out/avatar.safetensors",)
    ),
    "nbavatar export MODEL --to decoder": Case(_MODEL | {"FILE.onnx": "out/unet.onnx"}, makes=("out/unet.onnx",)),
    "nbavatar bench raster --json": Case(more=_SMALL, says='"forward_ms"'),
    "nbavatar bench raster --orders": Case(more=_SMALL, says="center"),
    "nbavatar bench viewer": Case(_CAMERAS, "--size 64 --repeats 1", says="64_eager_per_s"),
    "python examples/render_avatar.py": Case(makes=("new.png",), says="512x512"),
}  # fmt: skip

# Only planned: what would be run is found out, nothing is computed. Beginning -> a word of the plan, and why no more.
PLANNED = {
    "make smoke": ("nbavatar run smoke", "minutes; .ci/run runs it"),
    "make test": ("pytest", "it is what runs this"),
    "make capture": ("nbavatar run capture", "minutes; one line around `nbavatar run capture`"),
    "make paper": ("nbavatar run paper", "needs Decaf, FLAME and MANO; tests/workflow/test_dag.py plans its jobs"),
    "make rehearsal": ("nbavatar run rehearsal", "hours; docs/rehearsal.md says which jobs have been run"),
    "make rehearsal-small": ("config/rehearsal/small.yaml", "hours; docs/rehearsal.md says which jobs have been run"),
    "nbavatar run smoke": ("train", "minutes; .ci/run runs it"),
    "nbavatar run capture": ("train", "a minute; tests/workflow/test_capture.py runs all its jobs"),
    "nbavatar run compare": ("compare", "minutes of training are its purpose; its jobs are those of `run capture`"),
    "printf": ("train", "minutes; tests/workflow/test_rerun.py says what it makes run again"),
    "snakemake --configfile config/smoke.yaml -n": ("train", "it is a plan"),
    "nbavatar run capture /path/to/capture -- --configfile": ("train", "minutes; its jobs run in the smoke run"),
    "snakemake --configfile config/capture.yaml --config data_root=/path/to/capture": ("tradeoff", "tens of minutes"),
    "snakemake table_ablation": ("table", "minutes; .ci/run runs it in the smoke run"),
    "snakemake subject_S2": ("train", "minutes; .ci/run runs it in the smoke run"),
    "snakemake stage_deform": ("deform", "minutes; .ci/run runs it in the smoke run"),
}

# Run elsewhere: beginning -> the file that does, and what stands there.
ELSEWHERE = {
    "nbavatar run paper --profile slurm": ("tests/cluster/test_slurm.py", "profiles/slurm"),
    "nbavatar tradeoff": ("tests/unit/cli/test_tradeoff.py", '"tradeoff"'),
    "nbavatar render": ("tests/unit/cli/test_tradeoff.py", '"--max-ms"'),
    "nbavatar detect": ("tests/unit/detection/test_models.py", '"detect"'),
    "nbavatar segment CAPTURE --method person": ("tests/unit/cli/test_segment.py", '"person"'),
    "python -m pytest tests/unit/rendering/billboards/test_cuda_simulator.py": (".ci/run", "make test"),
}

# Run by no test, and why.
NOT_RUN = {
    "nbavatar bench raster --sweep": "tens of minutes: it measures every size in turn",
    "nbavatar bench raster --device cuda": "needs a GPU",
    "nbavatar doctor --gpu": "needs a GPU; what it does with one is tried on the CPU in test_device_check.py",
    "pip": "tests install nothing; .ci/run installs from the locks, test_packaging.py builds the wheel",
    "make install": "tests install nothing; `make smoke` in .ci/run begins with it",
    "python -m build": "it downloads what the build needs; test_packaging.py builds the wheel",
    "git clone": "the address is the reader's; .ci/run clones the repository",
    "cd nbavatar": "follows `git clone`",
    "ffmpeg": "another program",
    "mkdir": "prepares COLMAP's folder",
    "cp": "prepares COLMAP's folder",
    "mv": "prepares COLMAP's folder",
    "colmap": "another program; its files are read by `nbavatar import colmap`, which is run",
    "hf download": "some GB behind a licence that a person has to accept",
    "snakemake --workflow-profile profiles/kubernetes": "no cluster here; docs/cluster.md says that it is planned only",
}
TABLES = (HERE, PLANNED, ELSEWHERE, NOT_RUN)


def commands_of(page: Path) -> list[str]:
    """Commands of the page's blocks of shell and of its tables' first columns, one a command.

    Continued lines are joined, comments and loops taken off.
    """
    text, found = page.read_text(encoding="utf-8"), []
    for block in re.findall(r"^```sh\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            line = re.sub(r"(^|\s+)#.*$", "", line).strip()
            line = re.sub(r"^for \w+ in [^;]*; do (.*); done$", r"\1", line)
            found += [" ".join(part.split()).replace(".venv/bin/", "") for part in line.split(" && ") if part]
    return found + re.findall(r"^\| `(nbavatar [^`]+)` \|", text, flags=re.MULTILINE)


COMMANDS = [(page, command) for page in PAGES for command in commands_of(page)]


def known(command: str) -> str | None:
    """The longest beginning of a command that stands in one of the tables."""
    fits = [start for table in TABLES for start in table if command.startswith(start)]
    return max(fits, key=len, default=None)
