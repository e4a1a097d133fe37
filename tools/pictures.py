"""Makes the pictures of README.md and docs/: a synthetic person is filmed, an avatar trained, and drawn.

    python -m tools.pictures [--results results/pictures] [--capture resources/pictures] [--out docs/pictures]
                             [--only strip film viewer] [--cores N]

`make pictures` runs it. The avatar is that of config/capture.yaml with the changes of tools/pictures.yaml; its training
took 23 minutes on one core beside other work, everything together half an hour. What is done already is not done
again. With other --results, only their avatar is drawn. Everything is shown from a camera, or a place, that no training
saw. The viewer is photographed in headless Chromium (Debian: apt-get install chromium); without one its picture stays
as it is.
"""

import argparse
import io
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from nbavatar.cli.view import open_scene
from nbavatar.config.evaluation import AUTO, EAGER
from nbavatar.evaluation.orbit import turntable_views
from nbavatar.provenance import file_digest
from nbavatar.reporting.insets import contact_pixels
from nbavatar.viewer.eye import Eye
from nbavatar.viewer.page import Viewer
from nbavatar.viewer.pictures import Request, draw
from nbavatar.viewer.scene import Scene
from tests.browser import Browser, find_browser

FILMED = '{"layout": "capture", "subjects": ["S2"], "width": 320, "height": 320, "focal": 3.3, "frames": 48}'
SIDE = 256  # of one picture [px]
GAP = 6  # between pictures [px]
LINE = 26  # height of a line of text [px]
FPS = 12
SWING = math.radians(100)  # how far the free camera goes from side to side
BUDGET = 1.5e6  # bytes: of everything together
WINDOW = 1100, 640  # of the browser [px]
REST_S = 3.0  # after which a movement in the browser has come to rest
# Words of Snakemake. The picture needs the avatar, and the camera that is held out.
WANTED = ("results/pictures/render/S2/full/nv.zip", "--configfile", "config/capture.yaml", "tools/pictures.yaml")
PICTURES = ("strip", "film", "viewer")


def main() -> int:
    """Makes whatever is missing, then the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results/pictures"))
    parser.add_argument("--capture", type=Path, default=Path("resources/pictures"))
    parser.add_argument("--out", type=Path, default=Path("docs/pictures"))
    parser.add_argument("--only", nargs="+", default=PICTURES, choices=PICTURES)
    parser.add_argument("--cores", default="1")
    args = parser.parse_args()
    if args.results == Path("results/pictures"):
        train(args.capture, args.cores)
    scene = opened(args.results, EAGER)
    camera = held_out(scene)
    args.out.mkdir(parents=True, exist_ok=True)
    if "strip" in args.only:
        strip(scene, camera).save(args.out / "avatar.webp", quality=88, method=6)
    if "film" in args.only:
        films = film(scene, camera)
        films[0].save(
            args.out / "avatar-moves.webp", save_all=True, append_images=films[1:], duration=round(1000 / FPS), loop=0,
            quality=72, method=6,
        )  # fmt: skip
    program = find_browser()
    if "viewer" in args.only and program is None:
        print(f"no Chromium found: {args.out / 'viewer.webp'} stays as it is", file=sys.stderr)
    elif "viewer" in args.only:
        page(opened(args.results, AUTO), camera, program).save(args.out / "viewer.webp", quality=85, method=6)
    sizes = {path.name: path.stat().st_size for path in sorted(args.out.iterdir())}
    print("\n".join(f"{args.out / name}: {size / 1e3:.0f} kB" for name, size in sizes.items()))
    if sum(sizes.values()) > BUDGET:
        print(f"together more than {BUDGET / 1e6:g} MB", file=sys.stderr)
        return 1
    return 0


def train(capture: Path, cores: str) -> None:
    """The capture and the avatar, as far as they are not there."""
    ours = [sys.executable, "-m", "nbavatar"]
    if not (capture / "S2" / "splits.json").is_file():
        subprocess.run([*ours, "synthesize", "--out", str(capture), "--cfg", FILMED], check=True)
    subprocess.run([*ours, "run", "capture", str(capture / "S2"), "--cores", cores, "--", *WANTED], check=True)


def opened(results: Path, engine: str) -> Scene:
    """A run's avatars, decoded by an engine (`nbavatar.config.evaluation.ENGINES`)."""
    words = argparse.Namespace(path=[str(results)], meshes=None, cameras=[], subject=None, engine=engine)
    return open_scene(words, "cpu")


def held_out(scene: Scene) -> str:
    """The camera that no training saw."""
    trained = set(scene.entries["full"].avatar.record["inputs"].values())
    (camera,) = [name for name, pack in scene.packs.items() if file_digest(pack.path) not in trained]
    return camera


def look(scene: Scene, frame: str, camera: str) -> Eye:
    """Through a camera of the capture."""
    K, pose, width, height = scene.camera(camera, frame)
    return Eye(K, pose, width, height, width / height, camera)


def shown(scene: Scene, frame: str, eye: Eye, show: str = "render") -> Image.Image:
    """One picture of the avatar."""
    drawn = draw(scene, Request(eye, frame, first="full", show=show), SIDE)
    return Image.fromarray(drawn.image).resize((SIDE, SIDE), Image.Resampling.LANCZOS)


def truth(scene: Scene, frame: str, camera: str) -> Image.Image:
    """What the camera saw, over white."""
    found = scene.truth(camera, frame, np.ones(3))
    assert found is not None
    picture = Image.fromarray((found[0] * 255 + 0.5).astype(np.uint8))
    return picture.resize((SIDE, SIDE), Image.Resampling.LANCZOS)


def row(pictures: list[tuple[str, Image.Image]]) -> Image.Image:
    """Pictures side by side, each under its name."""
    width = len(pictures) * (SIDE + GAP) - GAP
    canvas = Image.new("RGB", (width, SIDE + LINE), "white")
    pen, font = ImageDraw.Draw(canvas), ImageFont.load_default(15)
    for i, (name, picture) in enumerate(pictures):
        x = i * (SIDE + GAP)
        canvas.paste(picture, (x, LINE))
        pen.text((x + SIDE / 2, LINE / 2), name, fill=(30, 34, 40), font=font, anchor="mm")
    return canvas


def contact_frame(scene: Scene, camera: str) -> str:
    """The frame in which hand and head share the longest border."""
    pack = scene.packs[camera]
    return max(pack.frames, key=lambda frame: contact_pixels(pack.read("label", frame)))


def strip(scene: Scene, camera: str) -> Image.Image:
    """One frame: truth, avatar, error, and what is inside."""
    frame = contact_frame(scene, camera)
    eye = look(scene, frame, camera)
    names = {"render": "avatar", "error": "error", "features": "features", "billboards": "billboards"}
    pictures = [("camera, never trained on", truth(scene, frame, camera))]
    return row(pictures + [(name, shown(scene, frame, eye, show)) for show, name in names.items()])


def film(scene: Scene, camera: str) -> list[Image.Image]:
    """All frames there and back, while a free camera swings; the last picture leads to the first."""
    K, pose, width, height = scene.camera(camera, scene.frames[0])
    manifest = {"camera": camera, "width": width, "height": height}
    order = [*range(0, len(scene.frames), 2), *reversed(range(1, len(scene.frames), 2))]
    wide = np.diag([0.85, 0.85, 1.0]) @ K  # the hand, beside the middle, stays in the picture
    views = turntable_views(scene.entries["full"].sequence, 0, manifest, wide, pose, len(order), arc=SWING)
    pictures = []
    for step, index in enumerate(order):
        frame, view = scene.frames[index], views[step]
        free = Eye(view.K.numpy(), view.viewmat.numpy(), width, height, width / height)
        pictures.append(
            row(
                [
                    ("camera, never trained on", truth(scene, frame, camera)),
                    ("avatar", shown(scene, frame, look(scene, frame, camera))),
                    ("from anywhere", shown(scene, frame, free)),
                ]
            )
        )
    return pictures


def page(scene: Scene, camera: str, program: str) -> Image.Image:
    """The viewer in a browser, at the frame of the contact, turned a little."""
    viewer = Viewer(scene, host="127.0.0.1", port=8790, side=512, title="nbavatar")
    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(program, Path(profile), WINDOW)
        try:
            browser.open(viewer.address)
            browser.wait(lambda: " ms" in browser.text(), "the first picture")
            browser.evaluate("document.querySelector('[role=slider]').focus()")
            for _ in range(scene.frames.index(contact_frame(scene, camera))):
                browser.press("ArrowRight", 39)
            browser.evaluate("document.activeElement.blur()")
            browser.mouse("mouseWheel", 350, 350, deltaX=0, deltaY=300)
            browser.drag((350, 350), (300, 345))
            # What viser says of a machine without a GPU.
            browser.evaluate("document.querySelectorAll('[class*=Notification-root]').forEach(note => note.remove())")
            frame = f"frame {contact_frame(scene, camera)}"
            for _ in range(2):  # what is shown at first may be from before the last movement
                time.sleep(REST_S)
                browser.wait(lambda: frame in browser.text() and "while moving" not in browser.text(), "rest")
            return Image.open(io.BytesIO(browser.screenshot())).convert("RGB")
        finally:
            browser.close()
            viewer.stop()


if __name__ == "__main__":
    sys.exit(main())
