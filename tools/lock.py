"""Resolves the versions that `make install` installs, and writes requirements.lock and requirements-cuda.lock.

    python tools/lock.py [--upgrade [PACKAGE ...]]          (needs `uv`: python -m pip install uv)

One resolution for Python 3.11 to 3.14, Linux and macOS, from what pyproject.toml declares. Versions that the locks
hold already are kept where they still fit. What torch needs only on a GPU goes to a lock of its own, because the CPU
build of torch does without. The bytes to download are counted at the package index, so that `make install` can tell.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path

from install import CARRIER

ROOT = Path(__file__).resolve().parent.parent
TORCH = "torch==2.13.0"
EXTRAS = ("pipeline", "view", "export", "engine", "completion", "docs", "test", "lint", "cuda")
EVERYWHERE = " ; sys_platform == 'darwin' or sys_platform == 'linux'"  # all that the resolution is made for
GPU_ONLY = re.compile(r"^(nvidia-|cuda-|numba-cuda|triton)")


def main() -> int:
    """Writes both locks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--upgrade", nargs="*", metavar="PACKAGE", help="take newer versions: of all, or of these")
    args = parser.parse_args()
    pins = resolve(args.upgrade)
    gpu = [pin for pin in pins if GPU_ONLY.match(pin)]
    base = [pin for pin in pins if pin not in gpu and pin != TORCH]
    write(
        ROOT / "requirements.lock",
        "# Versions that were tried together, for Python 3.11 to 3.14; written by tools/lock.py. `make install`\n"
        "# installs exactly these, and those of requirements-cuda.lock where torch is to use a GPU.\n"
        f"# Size: {megabytes([*base, CARRIER])} MB without torch, with the carrier of the LPIPS weights\n",
        [TORCH, *base],
    )
    write(
        ROOT / "requirements-cuda.lock",
        "# What the default build of torch for Linux needs beside requirements.lock, and the compiler of the\n"
        "# CUDA kernels (numba-cuda) for the same CUDA version; written by tools/lock.py. No CUDA toolkit is needed.\n"
        f"# Size: {megabytes([TORCH, *gpu])} MB with torch\n",
        gpu,
    )
    return 0


def resolve(upgrade: list[str] | None) -> list[str]:
    """One pin a package, with its markers."""
    held = [
        line
        for name in ("requirements.lock", "requirements-cuda.lock")
        if (ROOT / name).is_file()
        for line in (ROOT / name).read_text(encoding="utf-8").splitlines()
        if line and not line.startswith("#")
    ]
    with tempfile.TemporaryDirectory() as folder:
        wanted, out = Path(folder) / "torch.in", Path(folder) / "all.txt"
        wanted.write_text(TORCH + "\nsetuptools\n", encoding="utf-8")
        out.write_text("\n".join(held), encoding="utf-8")
        command = ["uv", "pip", "compile", "--quiet", "--universal", "--python-version", "3.11", "--no-header"]
        command += ["--no-annotate", "--output-file", str(out), str(wanted), str(ROOT / "pyproject.toml")]
        for extra in EXTRAS:
            command += ["--extra", extra]
        if upgrade is not None:
            command += [w for name in upgrade for w in ("--upgrade-package", name)] or ["--upgrade"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        lines = out.read_text(encoding="utf-8").splitlines()
    return [line.removesuffix(EVERYWHERE) for line in lines if line]


def megabytes(pins: list[str]) -> int:
    """Bytes that pip downloads for these pins here, in MB of 10^6, as the public index serves them."""
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as wanted:
        wanted.write("\n".join(pins))
        wanted.flush()
        command = [sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--no-deps", "--ignore-installed"]
        command += ["--report", "-", "-r", wanted.name]
        clean = {
            k: v for k, v in os.environ.items() if k not in ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL", "PIP_CONSTRAINT")
        }
        report = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True, env={**clean, "PIP_CONFIG_FILE": os.devnull}
        ).stdout
    total = 0
    for item in json.loads(report[report.index("{") :])["install"]:
        request = urllib.request.Request(item["download_info"]["url"], method="HEAD")
        with urllib.request.urlopen(request, timeout=60) as answer:
            total += int(answer.headers["Content-Length"])
    return round(total / 1e6)


def write(path: Path, header: str, pins: list[str]) -> None:
    """Writes a lock under a temporary name and renames it."""
    text = header + "".join(f"{pin}\n" for pin in pins)
    new = path.with_suffix(".new")
    new.write_text(text, encoding="utf-8")
    new.replace(path)


if __name__ == "__main__":
    sys.exit(main())
