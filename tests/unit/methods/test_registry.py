"""Methods are rooms: another one, or an edit or an option of one, changes nothing about the others."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import nbavatar

SOURCE = Path(nbavatar.__file__).parent

# What a job of each method is keyed by: the digest of its code, and its options.
KEYS = """
import json
from nbavatar.config.run import load_run, stage_options
from nbavatar.methods.registry import METHODS
from nbavatar.provenance import code_digest
run = load_run({"variants": {name: {"stages": {"train": {"method": name}}} for name in METHODS}})
print(json.dumps({
    name: [code_digest("train", (name,)), code_digest("render", (name,)), stage_options(run, "train", name)]
    for name in METHODS
}))
"""
THIRD = """    "third": MethodEntry(
        avatar="nbavatar.methods.third.avatar:Third",
        training="nbavatar.methods.third.training:ThirdTraining",
        options="nbavatar.methods.third.options:ThirdConfig",
        title="A throw-away method",
        primitives="points",
    ),
}
"""


@pytest.fixture
def package(tmp_path):
    """A copy of the package that may be edited."""
    shutil.copytree(SOURCE, tmp_path / "nbavatar", ignore=shutil.ignore_patterns("__pycache__", "assets", "weights"))
    return tmp_path / "nbavatar"


def keys(package):
    done = subprocess.run([sys.executable, "-c", KEYS], cwd=package.parent, capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": str(package.parent)})  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def edit(path, old, new):
    text = path.read_text()
    assert text.count(old) >= 1
    path.write_text(text.replace(old, new, 1))


def test_a_third_method_is_a_folder_and_an_entry_and_changes_no_other_job(package):
    before = keys(package)
    room = package / "methods/third"
    room.mkdir()
    (room / "__init__.py").write_text("")
    (room / "avatar.py").write_text("from nbavatar.methods.base import MeshAvatar\n\nclass Third(MeshAvatar): ...\n")
    (room / "training.py").write_text("from nbavatar.methods.base import Method\n\nclass ThirdTraining(Method): ...\n")
    (room / "options.py").write_text(
        "from dataclasses import dataclass\nfrom nbavatar.config.core import option\n\n"
        "@dataclass(frozen=True)\nclass ThirdConfig:\n    points: int = option(3, 'Points.', min=1)\n"
    )
    registry = package / "methods/registry.py"
    text = registry.read_text()
    end = text.index("\n}\n") + 1
    registry.write_text(text[:end] + THIRD + text[end + 2 :])
    after = keys(package)
    assert after["third"][2]["third"] == {"points": 3}
    assert {name: after[name] for name in before} == before
    edit(room / "avatar.py", "...", "pass")
    edited = keys(package)
    assert edited["third"][0] != after["third"][0] and edited["third"][1] != after["third"][1]


@pytest.mark.parametrize("name", ["avatar.py", "training.py"])
def test_an_edit_of_one_method_changes_its_jobs_alone(package, name):
    before = keys(package)
    path = package / "methods/splatting_avatar" / name
    path.write_text(path.read_text() + "\nEDITED = 1\n")
    after = keys(package)
    assert {method for method in before if after[method] != before[method]} == {"splatting_avatar"}


def test_a_new_option_of_one_method_changes_its_jobs_alone(package):
    before = keys(package)
    path = package / "methods/gaussian_avatars/options.py"
    edit(path, "(BoundConfig):", '(BoundConfig):\n    extra: float = option(1.0, "Another.", min=0)')
    edit(path, "from nbavatar.methods", "from nbavatar.config.core import option\nfrom nbavatar.methods")
    after = keys(package)
    assert after["gaussian_avatars"][2]["gaussian_avatars"]["extra"] == 1.0
    assert {method for method in before if after[method] != before[method]} == {"gaussian_avatars"}
