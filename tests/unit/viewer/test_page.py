"""The viewer in a real browser: it loads, turning and the frame slider change the picture, nothing complains."""

import io
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from nbavatar.cli import main, view
from nbavatar.methods.storage import save_avatar
from nbavatar.viewer.page import Viewer, _Tab
from tests.browser import Browser, find_browser
from tests.scenes.toy import write_scene
from tests.unit.methods.billboards.test_model import make_avatar

SIZE = (1000, 700)


@pytest.fixture
def browser(tmp_path):
    """Skips where no Chromium is installed (Debian: apt-get install chromium)."""
    program = find_browser()
    if program is None:
        pytest.skip("no Chromium found")
    window = Browser(program, tmp_path / "profile", SIZE)
    yield window
    window.close()


@pytest.fixture
def viewer(tmp_path):
    """A toy capture and an avatar in the places of a run."""
    scene = write_scene(tmp_path / "scene")
    run = tmp_path / "results" / "toy"
    for name in ("deform", "crop/center/toy", "train/toy/full"):
        (run / name).mkdir(parents=True)
    (run / "deform" / "toy.npz").write_bytes(scene["meshes"].read_bytes())
    for path in scene["packs"]:
        (run / "crop" / "center" / "toy" / path.name).write_bytes(path.read_bytes())
    save_avatar(run / "train" / "toy" / "full" / "model.pt", make_avatar(deferred=False))
    (run / "train" / "toy" / "with_unet").mkdir()
    save_avatar(run / "train" / "toy" / "with_unet" / "model.pt", make_avatar())
    parser = view.argparse.ArgumentParser()
    view.add_arguments(parser)
    opened = view.open_scene(parser.parse_args([str(run)]), "cpu")
    assert list(opened.packs) == ["cam0", "cam1", "cam2"] and opened.frames == ["f0", "f1", "f2", "f3"]
    running = Viewer(opened, host="127.0.0.1", port=8790, side=128, title="toy")
    yield running
    running.stop()


def picture(browser) -> np.ndarray:
    """The canvas to the left of the controls, int (H, W, 3)."""
    shown = Image.open(io.BytesIO(browser.screenshot())).convert("RGB")
    return np.asarray(shown).astype(int)[200:, :650]


def changed(browser, before: np.ndarray, what: str, level: int = 40) -> np.ndarray:
    """Waits until more than a few pixels differ by more than a level; the picture then."""

    def other():
        now = picture(browser)
        return now if (np.abs(now - before).max(-1) > level).mean() > 0.002 else None

    found: list[np.ndarray] = []

    def look() -> bool:
        now = other()
        if now is not None:
            found.append(now)
        return now is not None

    browser.wait(look, what)
    return found[-1]


@pytest.mark.slow
def test_the_page_turns_and_plays(viewer, browser) -> None:
    browser.open(viewer.address)
    browser.wait(lambda: " ms" in browser.text(), "the first picture", 120)
    empty = np.full_like(picture(browser), 255)
    first = changed(browser, empty, "an avatar on the canvas")
    browser.drag((350, 400), (480, 430))
    turned = changed(browser, first, "another picture after turning")
    browser.wait(lambda: "while moving" not in browser.text(), "a whole picture at rest")
    turned = picture(browser)
    assert "frame f0" in browser.text()
    browser.evaluate("document.querySelector('[role=slider]').focus()")
    for _ in range(3):
        browser.press("ArrowRight", 39)
    browser.wait(lambda: "frame f3" in browser.text(), "the last frame")
    browser.wait(lambda: "while moving" not in browser.text(), "a whole picture of the last frame")
    # Two pictures of one state are equal. The toy's frames are alike (0.8 % of the pixels differ by more than 10), and
    # the arrow keys turn the camera too, but only for as long as the browser sees them held: not on a busy machine.
    changed(browser, turned, "another picture in another frame", level=10)
    assert "decoded by" not in browser.text(), "there is no U-Net"
    (tab,) = viewer._tabs.values()
    tab._first.value = "with_unet"
    engine = viewer.scene.entries["with_unet"].avatar.engine
    name = "torch" if engine is None else engine.name
    browser.wait(lambda: f"decoded by {name}" in browser.text(), "the name of what decodes")
    assert browser.console == []


def test_the_last_picture_that_is_asked_for_is_of_the_latest_state(monkeypatch) -> None:
    """One thread has read the controls and is held up, while another one reads and asks."""
    tab, asked, second_is_done = object.__new__(_Tab), [], threading.Event()
    states, reading = iter(["old", "new"]), threading.Event()

    def eye(_):
        state = next(states)
        reading.set()
        if state == "old":
            second_is_done.wait(0.5)
        return state

    monkeypatch.setattr(_Tab, "_eye", eye)
    for name, value in (
        ("frame", 0), ("first", "full"), ("second", "nothing"), ("wipe", 0.5), ("what", "render"), ("preset", "exact"),
        ("background", (255, 255, 255)), ("side", 64),
    ):  # fmt: skip
        setattr(tab, f"_{name}", SimpleNamespace(value=value))
    tab._asking, tab._closed, tab._client = threading.RLock(), threading.Event(), SimpleNamespace(client_id=1)
    scene = SimpleNamespace(frames=["f0"])
    tab._viewer = SimpleNamespace(scene=scene, submit=lambda client, request, side: asked.append(request.eye))
    first = threading.Thread(target=tab._ask)
    first.start()
    assert reading.wait(30)
    second = threading.Thread(target=lambda: (tab._ask(), second_is_done.set()))
    second.start()
    first.join(30)
    second.join(30)
    assert asked == ["old", "new"]


def test_what_is_not_there_to_view_is_one_line(tmp_path, capsys) -> None:
    (tmp_path / "results").mkdir()
    assert main(["view", str(tmp_path / "results")]) == 2
    save_avatar(tmp_path / "alone.pt", make_avatar())
    assert main(["view", str(tmp_path / "alone.pt")]) == 2
    assert main(["view", str(tmp_path / "absent.pt")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 3
    assert "expected results with train/<subject>/<variant>/model.pt" in lines[0]
    assert "--meshes: expected the mesh sequence of" in lines[1]
    assert "expected a trained avatar (model.pt) or a folder of results" in lines[2]
