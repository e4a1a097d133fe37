"""What is installed, declared, carried and named, compared with each other: no copy of a fact goes stale alone."""

import ast
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

import nbavatar
from nbavatar.metrics import lpips
from nbavatar.packages import distribution_of, install_line, remedy

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")

# Declared, and imported nowhere: who uses it instead.
UNIMPORTED = {
    "pygments": "snakemake --report",
    "snakemake": "run as a command",
    "snakemake-executor-plugin-slurm": "loaded by snakemake",
    "numba-cuda": "takes the place of numba.cuda",
    "pytest-xdist": "pytest -n",
    "jaxtyping": "shapes in annotations, checked by beartype",
    "beartype": "checks the annotations in tests",
    "sphinx": "a command",
    "myst-nb": "an extension of sphinx, named in docs/conf.py",
    "furo": "a theme of sphinx, named in docs/conf.py",
    "ruff": "a command",
    "snakefmt": "a command",
    "pyright": "a command",
    "import-linter": "a command, and its package importlinter in a test",
}
# Imported where it is installed, and declared nowhere on purpose: why.
UNDECLARED = {
    "anny": "an optional synthetic head",
    "gsplat": "another backend on a GPU, compiled by its users",
    "cupy": "a GPU alternative",
    "pycolmap": "reads COLMAP's files where somebody has it; we read them too",
    "tokenizers": "comes with transformers; tests only",
    "smplx": "its licence keeps it out; an oracle of tests where somebody has it",
    "jsonschema": "comes with snakemake; tests only",
    "packaging": "comes with pytest; tests only",
    "websockets": "comes with viser; tests only",
    "llvmlite": "comes with numba, of the version that numba needs",
    "nbclient": "comes with myst-nb; tests only",
    "nbformat": "comes with myst-nb; tests only",
    "setuptools": "builds the package",
    "importlinter": "import-linter's package",
}


def _load(name: str, path: Path):
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def installer():
    return _load("install", ROOT / "tools" / "install.py")


def _pins(name: str, *, here: bool = False) -> dict[str, str]:
    """Locked versions; `here`: of packages for this Python and system only."""
    pins = {}
    for line in (ROOT / name).read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            requirement = Requirement(line)
            (specifier,) = requirement.specifier
            assert specifier.operator == "==", line
            if here and requirement.marker and not requirement.marker.evaluate():
                continue
            pins[canonicalize_name(requirement.name)] = specifier.version
    return pins


def _declared(*extras: str) -> list[Requirement]:
    lines = list(PROJECT["dependencies"])
    for extra in extras:
        lines += PROJECT["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def test_the_lock_holds_every_declared_package_in_a_version_that_fits():
    base, gpu = _pins("requirements.lock"), _pins("requirements-cuda.lock")
    for requirement in _declared("pipeline", "view", "export", "engine", "completion", "docs", "test", "lint"):
        assert requirement.specifier.contains(base[canonicalize_name(requirement.name)]), requirement
    for requirement in _declared("cuda")[len(PROJECT["dependencies"]) :]:
        assert requirement.specifier.contains(gpu[canonicalize_name(requirement.name)]), requirement
    assert not base.keys() & gpu.keys()
    assert not any(name.startswith("nvidia-") for name in base), "libraries of the GPU belong to requirements-cuda.lock"


def test_the_lock_has_what_the_installed_packages_ask_for():
    """Complete, as `--no-deps` needs it to be: what every locked package requires is locked, in a version that fits."""
    from importlib import metadata

    base, here = _pins("requirements.lock"), _pins("requirements.lock", here=True)
    for name in here:
        for line in metadata.requires(name) or []:
            requirement = Requirement(line)
            if requirement.marker and not requirement.marker.evaluate({"extra": ""}):
                continue
            wanted = canonicalize_name(requirement.name)
            # The default build of torch asks for libraries of the GPU, the CPU build does not.
            pins = base if wanted in base or name != "torch" else _pins("requirements-cuda.lock")
            assert wanted in pins, f"{name} asks for {line}"
            assert requirement.specifier.contains(pins[wanted], prereleases=True), f"{name} asks for {line}"


def test_one_cuda_version_everywhere():
    (numba_cuda,) = _declared("cuda")[len(PROJECT["dependencies"]) :]
    suffixes = {name.rpartition("-")[2] for name in _pins("requirements-cuda.lock") if re.search(r"-cu\d+$", name)}
    assert numba_cuda.extras == suffixes and len(suffixes) == 1


def test_nothing_that_forbids_commercial_use_is_installed():
    assert "smplx" not in _pins("requirements.lock") | _pins("requirements-cuda.lock")
    assert "smplx" not in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["nbavatar-cpu.yaml", "nbavatar-cuda.yaml"])
def test_conda_environments_say_no_version_of_their_own(name):
    path = ROOT / "envs" / name
    dependencies = yaml.safe_load(path.read_text(encoding="utf-8"))["dependencies"]
    (python,) = [d.partition("=")[2] for d in dependencies if isinstance(d, str) and d.startswith("python")]
    assert SpecifierSet(PROJECT["requires-python"]).contains(python)
    (pip,) = [d["pip"] for d in dependencies if isinstance(d, dict)]
    files = [(path.parent / line.removeprefix("-r ")).resolve() for line in pip if line.startswith("-r ")]
    expected = ["requirements.lock"] + (["requirements-cuda.lock"] if "cuda" in name else [])
    assert files == [ROOT / lock for lock in expected]
    assert [line for line in pip if not line.startswith("-r ")] == [".."], "the package itself, and nothing else"


def test_pythons_are_the_same_everywhere(installer):
    allowed = SpecifierSet(PROJECT["requires-python"])
    assert [v for v in ("3.10", *PYTHONS, "3.15") if allowed.contains(v)] == list(PYTHONS)
    assert (installer.OLDEST, installer.NEWEST) == tuple(
        tuple(int(part) for part in v.split(".")) for v in (PYTHONS[0], PYTHONS[-1])
    )
    named = [
        c.rpartition(" ")[2] for c in PROJECT["classifiers"] if c.startswith("Programming Language :: Python :: 3.")
    ]
    assert named == list(PYTHONS)
    assert f"Python {PYTHONS[0]} to {PYTHONS[-1]}" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_torch_is_bounded_above_while_its_private_functions_are_called():
    calls = [
        path
        for path in (ROOT / "nbavatar").rglob("*.py")
        if re.search(r"\btorch\._[a-z]\w*\(", path.read_text(encoding="utf-8"))
    ]
    (torch,) = [r for r in _declared() if r.name == "torch"]
    assert calls, "nothing private is called any more: the bound can go"
    assert any(s.operator in ("<", "<=") for s in torch.specifier), calls


def _imported(folders: tuple[str, ...]) -> set[str]:
    names: set[str] = set()
    for folder in folders:
        path = ROOT / folder
        for file in [path] if path.is_file() else path.rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    names |= {alias.name.partition(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                    names.add(node.module.partition(".")[0])
                elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
                    if getattr(node.func, "id", getattr(node.func, "attr", "")) in ("require", "importorskip"):
                        names.add(str(node.args[0].value).partition(".")[0])
    ours = {"nbavatar", "tests", "tools", "install", "makehuman", "collapse", "tiny", "build_synthetic_assets"}
    return {name for name in names if name not in sys.stdlib_module_names} - ours


def test_what_is_imported_is_declared_and_what_is_declared_is_used():
    imported = {canonicalize_name(distribution_of(n)) for n in _imported(("nbavatar", "tests", "tools", "setup.py"))}
    declared = {canonicalize_name(r.name) for r in _declared(*PROJECT["optional-dependencies"])}
    assert imported - declared - UNDECLARED.keys() == set()
    assert declared - imported - UNIMPORTED.keys() == set()
    assert not UNDECLARED.keys() & declared


def test_a_missing_package_is_named_with_a_line_that_brings_it():
    assert install_line("cv2") == 'python -m pip install "nbavatar[pipeline]"'
    assert install_line("PIL") == "python -m pip install pillow"
    assert install_line("gsplat") == "python -m pip install gsplat"
    assert "apt-get install libgl1" in remedy("pymeshlab")


def test_the_weights_are_the_same_files_everywhere(installer, monkeypatch):
    monkeypatch.setattr("setuptools.setup", lambda **_: None)
    setup = _load("setup", ROOT / "setup.py")
    assert {Path(name).name: digest for name, digest in lpips._FILES.values()} == setup.DIGESTS
    assert setup.WEIGHTS == installer.CARRIER and installer.CARRIER in lpips.INSTALL


def test_the_image_has_one_name_and_our_version():
    (named,) = re.findall(r'container: "docker://(\S+)"', (ROOT / "Snakefile").read_text(encoding="utf-8"))
    assert named in (ROOT / "envs" / "Dockerfile").read_text(encoding="utf-8")
    assert named.endswith(f":{nbavatar.__version__}") and "/library/" not in named


def test_planning_without_the_package_is_one_clear_line(tmp_path):
    code = (
        "import sys; sys.modules['nbavatar'] = None\n"
        "from snakemake.cli import main\n"
        f"main(['-n', '--snakefile', {str(ROOT / 'Snakefile')!r}, '--cores', '1'])"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    said = found.stdout + found.stderr
    assert found.returncode != 0 and "nbavatar is not installed" in said and "make install" in said
    assert "Traceback" not in said


# The installer.


def test_an_environment_counts_as_installed_only_for_these_locks_and_this_torch(installer, tmp_path):
    stamp = tmp_path / ".installed"
    assert not installer.installed(stamp, "auto")
    stamp.write_text("")
    assert not installer.installed(stamp, "auto"), "an older installer left an empty stamp"
    stamp.write_text(f'{{"locks": "{installer.digest()}", "torch": "cpu"}}')
    assert installer.installed(stamp, "auto") and installer.installed(stamp, "cpu")
    assert not installer.installed(stamp, "cuda")
    stamp.write_text('{"locks": "of another day", "torch": "cpu"}')
    assert not installer.installed(stamp, "cpu")


def _installer_with(installer, monkeypatch, *, driver: bool, cpu_build: bool):
    def run(command, **_):
        folder = Path(command[command.index("--dest") + 1])
        if cpu_build:
            folder.mkdir(parents=True)
            (folder / "torch-2.13.0+cpu-cp311-cp311-linux_x86_64.whl").touch()
        return subprocess.CompletedProcess(command, 0 if cpu_build else 1, "", "ERROR: no such build\n")

    monkeypatch.setattr(installer, "has_driver", lambda: driver)
    monkeypatch.setattr(installer.subprocess, "run", run)
    monkeypatch.setattr(installer.sys, "platform", "linux")


@pytest.mark.parametrize(
    ("wish", "driver", "cpu_build", "kind"),
    [
        ("auto", True, True, "cuda"),
        ("auto", False, True, "cpu"),
        ("auto", False, False, "cuda"),
        ("cpu", True, True, "cpu"),
        ("cpu", False, False, None),
        ("cuda", False, True, "cuda"),
    ],
)
def test_which_torch_is_taken(installer, monkeypatch, tmp_path, wish, driver, cpu_build, kind):
    _installer_with(installer, monkeypatch, driver=driver, cpu_build=cpu_build)
    found, text = installer.choose_torch(wish, "torch==2.13.0", Path("python"), tmp_path)
    assert found == kind
    if kind is None:
        assert "no such build" in text and "TORCH=cuda" in text


def test_an_environment_that_does_not_work_is_never_called_installed(installer, monkeypatch, tmp_path, capsys):
    """The last step, `nbavatar doctor --brief`, fails: exit code 1, one line, no stamp."""
    venv = tmp_path / "venv"
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")

    def run(command, env=None, **_):
        if "venv" in command:
            (venv / "bin").mkdir(parents=True)
        if "doctor" in command:  # its imports leave byte code for all later commands
            assert env["PATH"] and "PYTHONDONTWRITEBYTECODE" not in env
        return subprocess.CompletedProcess(command, 2 if "doctor" in command else 0, "", "")

    class Done:
        def wait(self):
            return 0

    monkeypatch.setattr(installer.subprocess, "run", run)
    monkeypatch.setattr(installer.subprocess, "Popen", lambda *_, **__: Done())
    monkeypatch.setattr(installer, "has_driver", lambda: True)
    monkeypatch.setattr(installer.sys, "argv", ["install.py", "--venv", str(venv)])
    assert installer.main() == 1
    said = capsys.readouterr()
    assert "error: the environment does not work" in said.err and len(said.err.strip().splitlines()) == 1
    assert "MB" in said.out and not (venv / ".installed").exists()


@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
def test_commands_of_the_makefile_write_byte_code(monkeypatch):
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    show = ["make", "--no-print-directory", "--eval", "show:; @echo [$$PYTHONDONTWRITEBYTECODE]", "show"]
    assert subprocess.check_output(show, cwd=ROOT, text=True) == "[]\n"


def test_another_python_is_refused_in_one_line(installer, monkeypatch, capsys):
    monkeypatch.setattr(installer.sys, "version_info", (3, 10, 4))
    monkeypatch.setattr(installer.sys, "argv", ["install.py"])
    assert installer.main() == 1
    assert capsys.readouterr().err.strip().startswith("install: error: Python 3.11 to 3.14 is needed")


# The wheel.


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    tree = folder / "tree"
    ignore = shutil.ignore_patterns(".*", "results", "logs", "benchmarks", "__pycache__", "build", "*.egg-info")
    shutil.copytree(ROOT, tree, ignore=ignore)
    weights = Path(lpips.locate_weights("alex")).parent
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "-w"]
    done = subprocess.run(
        [*command, str(folder), str(tree)],
        env={**os.environ, "NBAVATAR_LPIPS_WEIGHTS": str(weights)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_carries_the_workflow_the_weights_and_the_licences(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    tracked = [*(ROOT / "workflow").rglob("*"), *(ROOT / "config").rglob("*"), *(ROOT / "profiles").rglob("*")]
    for path in tracked:
        if path.is_file() and "__pycache__" not in path.parts:
            assert f"nbavatar/pipeline/{path.relative_to(ROOT)}" in names
    for name in ("pipeline/Snakefile", "pipeline/resources/README.md", "pipeline/requirements.lock", "py.typed"):
        assert f"nbavatar/{name}" in names
    assert {"nbavatar/metrics/weights/alexnet.ckpt", "nbavatar/metrics/weights/vgg16.ckpt"} <= names
    assert {"nbavatar/data/synthetic/assets/human.npz", "nbavatar/data/synthetic/assets/LICENSE.md"} <= names
    licences = {name.partition("/licenses/")[2] for name in names if "/licenses/" in name}
    assert {"LICENSE", "NOTICE"} | {f"licences/{p.name}" for p in (ROOT / "licences").iterdir()} <= licences
    assert not any(name.startswith(("tests/", "tools/")) for name in names)


@pytest.mark.slow
def test_the_wheel_plans_the_smoke_run_in_an_empty_folder_and_keeps_what_the_user_has(wheel, tmp_path):
    site, here = tmp_path / "site", tmp_path / "here"
    zipfile.ZipFile(wheel).extractall(site)
    (here / "config").mkdir(parents=True)
    own = (ROOT / "config" / "smoke.yaml").read_text(encoding="utf-8") + "# mine\n"
    (here / "config" / "smoke.yaml").write_text(own, encoding="utf-8")
    command = [sys.executable, "-m", "nbavatar", "run", "smoke", "--cores", "2", "--", "-n"]
    found = subprocess.run(
        command, cwd=here, env={**os.environ, "PYTHONPATH": str(site)}, capture_output=True, text=True, timeout=300
    )
    assert found.returncode == 0, found.stderr
    assert "rule train" in found.stdout + found.stderr or "train " in found.stdout + found.stderr
    assert (here / "config" / "smoke.yaml").read_text(encoding="utf-8") == own
    for path in (ROOT / "config").rglob("*"):
        if path.is_file() and path.name != "smoke.yaml":
            assert (here / path.relative_to(ROOT)).read_bytes() == path.read_bytes()
    assert (here / "resources" / "README.md").is_file()
    code = "from nbavatar.metrics.lpips import locate_weights; print(locate_weights('vgg'))"
    where = subprocess.run(
        [sys.executable, "-c", code],
        cwd=here,
        env={**os.environ, "PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
    )
    assert where.stdout.strip() == str(site / "nbavatar" / "metrics" / "weights" / "vgg16.ckpt")
