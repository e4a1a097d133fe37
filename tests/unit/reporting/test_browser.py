"""The report in a real browser: nothing complains, pictures load, sliders move, phones can read it."""

import json
import re

import numpy as np
import pytest
from PIL import Image

from nbavatar.cli import main
from nbavatar.io.framepack import FramePackWriter
from nbavatar.io.video import VideoWriter

pytestmark = pytest.mark.slow

SIZE = 48
# Runs in the page after its own script: moves the first slider, changes its right side, and reports what it sees.
PROBE = """
<script>
addEventListener("load", () => {
  const box = document.querySelector(".slider"), handle = box.querySelector("input");
  const before = box.querySelector(".bar").getBoundingClientRect().left;
  handle.value = 80;
  handle.dispatchEvent(new Event("input"));
  const after = box.querySelector(".bar").getBoundingClientRect().left;
  const choice = box.querySelector('select[data-side="right"]'), under = box.querySelector(".under");
  const first = under.src;
  choice.selectedIndex = 2;
  choice.dispatchEvent(new Event("change"));
  const texts = [...document.querySelectorAll("svg text")].map(t => t.getBoundingClientRect());
  const frames = [...document.querySelectorAll("svg")].map(s => s.getBoundingClientRect());
  const inside = r => frames.some(f => r.left >= f.left - 1 && r.right <= f.right + 1 && r.top >= f.top - 1
                                       && r.bottom <= f.bottom + 1);
  const legends = [...document.querySelectorAll("svg")].map(s => [...s.querySelectorAll("text:not([transform])")]
    .map(t => t.getBoundingClientRect()));
  const before_or_above = (a, b) => a.right <= b.left + 1 || a.bottom <= b.top + 3;
  const apart = (a, b) => before_or_above(a, b) || before_or_above(b, a);
  const meet = legends.flatMap(all => all.flatMap((a, i) => all.slice(i + 1).filter(b => !apart(a, b))));
  const film = document.querySelector("video");
  const found = {
    film: [film.videoWidth, film.videoHeight, film.error ? film.error.message : ""],
    moved: after - before, width: box.querySelector(".stack").clientWidth, changed: under.src !== first,
    alt: under.alt, broken: [...document.images].filter(i => !i.complete || i.naturalWidth === 0).length,
    images: document.images.length, page: document.documentElement.scrollWidth, window: innerWidth,
    cut: texts.filter(r => !inside(r)).length, texts: texts.length, overlapping: meet.length,
  };
  const place = document.createElement("pre");
  place.id = "probe";
  place.textContent = JSON.stringify(found);
  document.body.append(place);
});
</script>
"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """A report of two variants with a wide table and training curves."""
    folder = tmp_path_factory.mktemp("report")
    K = [[40.0, 0, 24], [0, 40.0, 24], [0, 0, 1]]
    base = {"stage": "x", "subject": "S2", "width": SIZE, "height": SIZE, "K": K, "cam_from_world": None, "record": {}}
    ramp = np.linspace(0, 255, SIZE).astype(np.uint8)
    picture = np.stack([np.broadcast_to(ramp, (SIZE, SIZE)), np.broadcast_to(ramp[:, None], (SIZE, SIZE))] * 2, -1)
    picture = np.ascontiguousarray(picture[..., :3])
    layers = {"rgb": "", "alpha": ""}
    with FramePackWriter(folder / "102.zip", base | {"camera": "102", "frames": ["f"], "layers": layers}) as pack:
        pack.add("rgb", "f", picture)
        pack.add("alpha", "f", np.full((SIZE, SIZE), 255, np.uint8))
    renders = []
    for i, variant in enumerate(("full", "splatting_avatar_released")):
        path = folder / variant / "nv1024.zip"
        path.parent.mkdir()
        manifest = base | {"camera": "102", "frames": ["102/f"], "layers": {"rgb": ""}}
        with FramePackWriter(path, manifest) as pack:
            pack.add("rgb", "102/f", np.roll(picture, 5 * (i + 1), axis=1))
        renders.append(str(path))
    histories = []
    for variant in ("full", "splatting_avatar", "splatting_avatar_released"):
        histories.append(folder / "S2" / variant / "history.jsonl")
        histories[-1].parent.mkdir(parents=True)
        lines = [{"step": s, "mse": 0.1 / (s + 1), "psnr": 9 + s**0.5} for s in range(400)]
        histories[-1].write_text("\n".join(map(json.dumps, lines)))
    heads = " | ".join(f"column {i}" for i in range(16))
    (folder / "wide.md").write_text(f"## Wide\n\n| {heads} |\n|{' --- |' * 16}\n| {' | '.join(['28.63'] * 16)} |\n")
    timings, evals = [], []
    for i, variant in enumerate(("full", "splatting_avatar_released")):
        speed = {"ms": {"total_fp32": 10.0 + i}, "peak_memory_mb": 100.0 + i, "model_mb": 1.5}
        timings.append(folder / "speed" / "S2" / f"{variant}.json")
        timings[-1].parent.mkdir(parents=True, exist_ok=True)
        timings[-1].write_text(json.dumps({"device": "cpu: test", "speed": speed}))
        evals.append(folder / f"{variant}.json")
        content = {
            "subject": "S2",
            "variant": variant,
            "protocol": {"name": "nv1024"},
            "protocol_hash": "h",
            "per_image": [],
            "count": 1,
        }
        evals[-1].write_text(json.dumps(content | {"metrics": {"psnr": 20.0 + i}, "record": {}}))
    video = folder / "video" / "S2" / "full" / "turntable.mp4"
    with VideoWriter(video, 25) as writer:
        for shift in range(4):
            writer.add(np.roll(picture, shift, axis=0))
    out = folder / "index.html"
    arguments = ["--renders", *renders, "--frames", str(folder / "102.zip"), "--histories", *map(str, histories)]
    arguments += ["--evals", *map(str, evals), "--speeds", *map(str, timings), "--videos", str(video)]
    assert main(["report", "--tables", str(folder / "wide.md"), *arguments, "--out", str(out)]) == 0
    probed = folder / "probed.html"
    probed.write_text(out.read_text(encoding="utf-8").replace("</body>", PROBE + "</body>"), encoding="utf-8")
    return probed


def probe(document: str) -> dict:
    found = re.search(r'<pre id="probe">(.*?)</pre>', document, flags=re.DOTALL)
    assert found, "the probe did not run"
    return json.loads(found.group(1))


def test_pictures_load_sliders_move_and_nothing_complains(report, browse):
    document, console = browse(report)
    found = probe(document)
    assert console == ""
    assert found["images"] >= 8 and found["broken"] == 0
    assert found["moved"] == pytest.approx(0.3 * found["width"], abs=1.5)
    assert found["changed"] and found["alt"] == "splatting_avatar_released (camera 102, frame f)"
    assert found["texts"] > 10 and found["cut"] == 0 and found["overlapping"] == 0
    assert found["film"] == [SIZE, SIZE, ""], "the page's own player must read the codec that videos are written in"


def test_phone_width_does_not_scroll_sideways(report, browse, tmp_path):
    # Chromium's window is never below 500 px, so the page is put into a frame of a phone's width.
    outer = tmp_path / "phone.html"
    outer.write_text(
        f'<body style="margin:0"><iframe id="f" src="{report.as_uri()}" style="width:360px;height:800px;border:0">'
        "</iframe><script>f.onload = () => setTimeout(() => { const p = document.createElement('pre'); p.id = 'probe';"
        "p.textContent = f.contentDocument.getElementById('probe').textContent; document.body.append(p); }, 500)"
        "</script></body>"
    )
    document, console = browse(outer)
    found = probe(document)
    assert console == "" and found["window"] == 360
    assert found["page"] <= 360 and found["cut"] == 0


@pytest.mark.parametrize("size", [(1200, 900), (600, 1200)])
def test_screenshot_shows_a_page(report, browse, tmp_path, size):
    browse(report, tmp_path / "page.png", size)
    shown = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
    assert shown.shape == (size[1], size[0], 3)
    dark = (shown.sum(-1) < 200).mean()
    assert 0.002 < dark < 0.6 and (shown.max(-1) - shown.min(-1) > 60).mean() > 0.01
