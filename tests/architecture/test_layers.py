import re
import subprocess
import sys
from pathlib import Path

import pytest

from nbavatar.imports import imports_of
from nbavatar.methods.registry import METHODS

# A GPU node needs torch, numpy, numba, Pillow, tqdm and yaml; these belong to the stages that use them.
HEAVY = (
    "igl",
    "pymeshlab",
    "trimesh",
    "OpenEXR",
    "cv2",
    "scipy",
    "pandas",
    "matplotlib",
    "skimage",
    "snakemake",
    "smplx",
)


def test_layers_import_downwards_only():
    out = subprocess.run([sys.executable, "-m", "importlinter.cli"], capture_output=True, text=True)
    if "No module named" in out.stderr or out.returncode not in (0, 1):
        from importlinter.cli import lint_imports

        assert lint_imports() == 0
    else:
        assert out.returncode == 0, out.stdout


ABOVE_METHODS = (
    "api", "checks", "cli", "detection", "evaluation", "exporting", "fitting", "reporting", "studies", "training",
    "viewer",
)  # fmt: skip


@pytest.mark.parametrize("method", METHODS)
def test_a_method_of_the_registry_imports_no_other_method_and_nothing_above(method):
    # The contract in pyproject.toml lists packages by name; this one holds for a method as soon as it is registered.
    rooms = {entry.training.partition(":")[0].rpartition(".")[0] for entry in METHODS.values()}
    room = METHODS[method].training.partition(":")[0].rpartition(".")[0]
    refused = (*(rooms - {room}), *(f"nbavatar.{layer}" for layer in ABOVE_METHODS))
    folder = Path(__file__).parents[2].joinpath(*room.split("."))
    modules = [f"{room}.{'.'.join(p.relative_to(folder).with_suffix('').parts)}" for p in folder.rglob("*.py")]
    assert len(modules) > 2
    for module in modules:
        for name in imports_of(module.removesuffix(".__init__")):
            assert not any(name == other or name.startswith(f"{other}.") for other in refused), (module, name)


@pytest.mark.parametrize("verb", ["train", "render", "speed"])
def test_training_and_rendering_import_no_geometry_library(verb):
    # numba itself imports SciPy where it is installed, so what is hidden here must be imported by nobody.
    code = (
        "import sys, importlib\n"
        f"for name in {HEAVY!r}: sys.modules[name] = None\n"
        "from nbavatar.provenance import code_modules\n"
        f"for name in code_modules('{verb}'):\n"
        "    if not name.endswith('.cuda'): importlib.import_module(name)\n"
        "print('imported')"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    assert out.stdout.strip().splitlines()[-1] == "imported"


# Packages that read and write files, and the modules elsewhere that are readers, writers or places of files.
FILES = ("api.py", "checks", "cli", "config", "data", "io", "planning", "preprocess")
READERS = {
    "bodymodels/files.py", "detection/sam3.py", "devices.py", "imports.py", "jit/cache.py", "jit/compile.py",
    "methods/storage.py", "metrics/lpips.py", "private.py", "provenance.py", "reporting/figures.py",
    "studies/benchmarks/raster.py", "studies/benchmarks/raster_sweep.py", "studies/tradeoff/presets.py",
    "studies/tradeoff/sweep.py", "syntax.py", "training/state.py",
}  # fmt: skip


def test_what_computes_takes_no_paths():
    package = Path(__file__).parents[2] / "nbavatar"
    elsewhere = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in FILES]
    with_paths = {p for p in elsewhere if re.search(r"\bPath\b|os\.PathLike", p.read_text(encoding="utf-8"))}
    assert {path.relative_to(package).as_posix() for path in with_paths} == READERS
