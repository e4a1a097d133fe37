import subprocess
import sys

import pytest

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
