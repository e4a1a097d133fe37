import importlib
import shutil
import sys
from pathlib import Path

import pytest

import nbavatar
from nbavatar import imports, provenance
from nbavatar.cli import VERBS

SOURCE = Path(nbavatar.__file__).parent


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of the package that may be edited, and a function that digests a verb of it afresh."""
    shutil.copytree(SOURCE, tmp_path / "nbavatar", ignore=shutil.ignore_patterns("__pycache__", "assets"))
    monkeypatch.setattr(imports, "ROOT", tmp_path / "nbavatar")
    caches = (
        *(provenance.code_digest, provenance.code_modules),
        *(imports.source_of, imports._text, imports.is_neutral, imports.imports_of, imports.kinds_of),
    )

    def digest(verb, methods=None):
        for function in caches:
            function.cache_clear()
        return provenance.code_digest(verb, methods)

    yield tmp_path / "nbavatar", digest
    for function in caches:
        function.cache_clear()


def test_every_verb_has_a_digest_of_its_own():
    digests = {verb: provenance.code_digest(verb) for verb in VERBS}
    assert len(set(digests.values())) == len(digests)
    assert all(len(value) == 12 for value in digests.values())


def test_digest_is_blind_to_comments_docstrings_and_layout(copy):
    root, digest = copy
    before = digest("render")
    path = root / "methods/billboards/unet.py"
    text = path.read_text()
    path.write_text("# a comment\n\n\n" + text.replace('"""', '"""Reworded. ', 1))
    assert path.read_text() != text
    assert digest("render") == before


def test_digest_sees_an_edit_behind_several_imports_and_only_there(copy):
    root, digest = copy
    before = {verb: digest(verb) for verb in ("train", "render", "table", "crop")}
    path = root / "rendering/billboards" / "functional.py"
    path.write_text(path.read_text() + "\nEDITED = 1\n")
    after = {verb: digest(verb) for verb in before}
    assert {verb for verb in before if before[verb] != after[verb]} == {"train", "render"}


def test_digest_follows_backends_that_are_imported_by_name(copy):
    root, digest = copy
    before = digest("train")
    path = root / "rendering/billboards" / "cpu.py"
    path.write_text(path.read_text() + "\nEDITED = 1\n")
    assert digest("train") != before


def test_digest_leaves_out_what_is_marked(copy):
    """Reworded errors, and the presets that `train` turns into options."""
    root, digest = copy
    before = digest("train")
    for name in ("errors.py", "studies/tradeoff/presets.py"):
        (root / name).write_text((root / name).read_text() + "\nEDITED = 1\n")
    assert digest("train") == before
    text = (root / "cli/train.py").read_text()
    assert "# provenance: neutral" in text
    (root / "cli/train.py").write_text(text.replace("# provenance: neutral", "# followed"))
    assert digest("train") != before


def test_every_family_of_extremes_is_followed():
    from nbavatar.studies.extremes.cells import FAMILIES

    assert {f"nbavatar.studies.extremes.{name}" for name in FAMILIES} <= set(provenance.code_modules("extremes"))


def test_run_record_is_json_with_all_that_traces_a_number(tmp_path):
    import json

    (tmp_path / "in.bin").write_bytes(b"abc")
    record = provenance.run_record(
        "evaluate", config={"net": "alex"}, inputs={"frames": tmp_path / "in.bin"}, seed=3, extra={"subject": "S2"}
    )
    json.dumps(record)
    assert record["inputs"]["frames"] == (
        "sha256:ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2's own example
    )
    assert record["config"] == {"net": "alex"}
    assert record["seed"] == 3
    assert record["subject"] == "S2"
    assert record["versions"]["nbavatar"] == nbavatar.__version__
    assert set(record) >= {"command", "code", "device", "git"}


def test_reading_configuration_and_digests_loads_nothing_heavy():
    import subprocess

    code = (
        "import sys, nbavatar.config.run, nbavatar.config.sheets, nbavatar.provenance as p; p.code_digest('train');"
        "print([m for m in ('torch', 'numpy', 'numba', 'pandas', 'cv2') if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_every_verb_is_a_module_with_a_description():
    for verb in VERBS:
        module = importlib.import_module(f"nbavatar.cli.{verb.replace('-', '_')}")
        assert module.__doc__ and callable(module.add_arguments) and callable(module.main)
