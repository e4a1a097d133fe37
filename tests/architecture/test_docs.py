"""Links between the project's own documents lead somewhere."""

import re
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("config/*.md"), *ROOT.glob("resources/*.md")]
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files(page):
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
    assert [name for name in named if not (page.parent / name).exists()] == []
    mentioned = re.findall(r"(?<![\w/.])(docs/[\w/.-]+\.md)", text)
    assert [name for name in mentioned if not (ROOT / name).exists()] == []


def test_pictures_are_small_and_all_are_shown():
    """Of kinds that GitHub shows; one of them moves. A reader on a phone loads them all."""
    pictures = sorted((ROOT / "docs" / "pictures").iterdir())
    assert {path.suffix for path in pictures} <= {".png", ".webp", ".gif"}
    assert sum(path.stat().st_size for path in pictures) < 1.5e6
    shown = {
        Path(name).name for page in PAGES for name in re.findall(r"!\[[^]]+\]\(([^)]+)\)", page.read_text("utf-8"))
    }
    assert {path.name for path in pictures} == shown
    moving = []
    for path in pictures:
        with Image.open(path) as image:
            image.load()
            moving += [path.name] if getattr(image, "n_frames", 1) > 1 else []
    assert moving == ["avatar-moves.webp"]


def test_the_site_leads_to_every_page():
    """`make docs` refuses a page that no list of docs/index.md names; this says so in less than a minute."""
    lists = (ROOT / "docs" / "index.md").read_text("utf-8") + (ROOT / "docs" / "api" / "index.md").read_text("utf-8")
    pages = [path for path in PAGES if path.parent.name in ("docs", "api") and path.stem != "index"]
    assert [path.name for path in pages if not re.search(rf"^{path.stem}$", lists, flags=re.MULTILINE)] == []


def test_every_target_of_make_is_one():
    """A target that is called like a folder (docs) would be up to date for ever."""
    text = (ROOT / "Makefile").read_text("utf-8")
    (phony,) = re.findall(r"^\.PHONY: (.*)$", text, flags=re.MULTILINE)
    assert sorted(phony.split()) == sorted(re.findall(r"^([a-z][a-z-]*):", text, flags=re.MULTILINE))
