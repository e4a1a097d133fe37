"""A headless browser for the tests that look at pages."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.browser import find_browser


@pytest.fixture(scope="session")
def browse(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[str, str]]:
    """``browse(page, screenshot=None, size=(w, h))`` -> (document after its scripts ran, console messages).

    Skips where no Chromium is installed (Debian: apt-get install chromium).
    """
    program = find_browser()
    if program is None:
        pytest.skip("no Chromium found")
    profile = tmp_path_factory.mktemp("chromium")

    def run(page: Path, screenshot: Path | None = None, size: tuple[int, int] = (1200, 900)) -> tuple[str, str]:
        done = subprocess.run(
            [
                program,
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--hide-scrollbars",
                "--no-first-run",
                "--disable-background-networking",
                "--allow-file-access-from-files",
                "--enable-logging=stderr",
                "--virtual-time-budget=4000",
                f"--user-data-dir={profile}",
                f"--window-size={size[0]},{size[1]}",
                *([f"--screenshot={screenshot}"] if screenshot else ["--dump-dom"]),
                page.as_uri(),
            ],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        console = "\n".join(line for line in done.stderr.splitlines() if ":CONSOLE" in line)
        return done.stdout, console

    return run


@pytest.fixture(scope="session")
def latex(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """``latex(document)`` -> the log of pdflatex, which must end without an error.

    Skips where no pdflatex is installed (Debian: apt-get install texlive-latex-recommended); this is the only place
    that does. What can be checked without it, is.
    """
    program = shutil.which("pdflatex")
    if program is None:
        pytest.skip("no pdflatex found")
    folder = tmp_path_factory.mktemp("latex")

    def run(document: str) -> str:
        (folder / "document.tex").write_text(document, encoding="utf-8")
        command = [program, "-interaction=nonstopmode", "-halt-on-error", "document.tex"]
        done = subprocess.run(command, cwd=folder, capture_output=True, timeout=120, check=False)
        log = (folder / "document.log").read_text(encoding="latin-1")
        assert done.returncode == 0, log[-2000:]
        return log

    return run
