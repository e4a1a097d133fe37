"""What is released says one version, and who reports a fault is asked for what is needed to find it."""

import re
import tomllib
from datetime import date
from pathlib import Path

import pytest
import yaml

import nbavatar

ROOT = Path(__file__).parents[2]
FORMS = sorted(path for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml") if path.stem != "config")
# Every place that names a version of the project: a pattern whose group is the version.
NAMED = {
    "CHANGELOG.md": r"^## (\d\S*) ",  # the first is the newest
    "CITATION.cff": r"^version: (\S+)",
    "README.md": r"dist/nbavatar-([\d.]+)-py3",
    "Snakefile": r"/nbavatar:([\d.]+)",
    "envs/Dockerfile": r"/nbavatar:([\d.]+)",
    "profiles/kubernetes/profile.yaml": r"/nbavatar:([\d.]+)",
    "docs/cluster.md": r"/nbavatar:([\d.]+)",
}


@pytest.mark.parametrize("name", NAMED)
def test_every_file_names_this_version(name):
    found = re.findall(NAMED[name], (ROOT / name).read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert set(found[:1] if name == "CHANGELOG.md" else found) == {nbavatar.__version__}


def test_the_package_takes_its_version_from_the_module():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["dynamic"] == ["version"] and "version" not in project["project"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "nbavatar.__version__"}


def test_versions_and_days_of_the_changelog_only_go_back():
    heads = re.findall(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    parsed = [re.fullmatch(r"(\d+)\.(\d+)\.(\d+) \((\d{4}-\d\d-\d\d)\)", head) for head in heads]
    assert len(heads) > 1 and all(parsed), heads
    versions = [tuple(map(int, found.groups()[:3])) for found in parsed if found]
    days = [date.fromisoformat(found[4]) for found in parsed if found]
    assert versions == sorted(set(versions), reverse=True) and days == sorted(days, reverse=True)
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert date.fromisoformat(str(citation["date-released"])) == days[0]


@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.stem)
def test_forms_of_issues_are_whole_and_ask_for_the_doctor(form):
    """As GitHub asks of a form: name, description, and a body of fields with an id and a label each."""
    content = yaml.safe_load(form.read_text(encoding="utf-8"))
    assert set(content) == {"name", "description", "labels", "body"}
    assert all(field["type"] == "textarea" and field["attributes"]["label"] for field in content["body"])
    identities = [field["id"] for field in content["body"]]
    assert len(set(identities)) == len(identities) and content["body"][0]["validations"]["required"]
    (doctor,) = [field for field in content["body"] if field["id"] == "doctor"]
    assert "`nbavatar doctor`" in doctor["attributes"]["label"]
    assert form.stem != "bug" or doctor["validations"]["required"]


def test_there_are_three_forms():
    assert [form.stem for form in FORMS] == ["bug", "feature", "question"]
