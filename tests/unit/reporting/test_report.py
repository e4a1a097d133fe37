"""The HTML report: self-contained, complete, readable without any of its parts."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urljoin, urlsplit

import numpy as np
import pytest

from nbavatar.cli import main
from nbavatar.cli.report import beside
from nbavatar.io.framepack import FramePackWriter
from nbavatar.io.images import encode_png
from nbavatar.reporting.comparison import find_truth
from nbavatar.reporting.curves import line_chart, thin
from nbavatar.reporting.markdown import markdown_to_html
from nbavatar.reporting.pictures import ERROR_MAX, RAMP, error_map, reduce_picture, spread

SIZE = 32
VOID = {"meta", "link", "img", "input", "br"}


class Page(HTMLParser):
    """Checks nesting while it collects tags."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)
        assert not self.open, self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def all(self, tag):
        return [attrs for name, attrs in self.tags if name == tag]


def write_pack(path, subject, camera, frames, layers, *, K_at=16.0, record=None, per_frame=False):
    K = [[40.0, 0, K_at], [0, 40.0, K_at], [0, 0, 1]]
    manifest = {
        "stage": "x", "subject": subject, "camera": camera, "width": SIZE, "height": SIZE, "frames": frames,
        "cam_from_world": None, "layers": dict.fromkeys(layers, ""), "record": record or {}, "background": [1, 1, 1],
        **({"K_per_frame": dict.fromkeys(frames, K)} if per_frame else {"K": K}),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(len(str(path)))
    with FramePackWriter(path, manifest) as pack:
        for frame in frames:
            for layer in layers:
                shape = (SIZE, SIZE, 3) if layer == "rgb" else (SIZE, SIZE)
                pack.add(layer, frame, rng.integers(0, 256, shape).astype(np.uint8))
    return str(path)


@pytest.fixture
def run(tmp_path):
    """A small run: two variants, two cameras, tables, histories, one further picture."""
    frames = [f"{i:04}" for i in range(6)]
    crops = [write_pack(tmp_path / f"crop/{c}.zip", "S2", c, frames, ("rgb", "alpha")) for c in ("102", "108")]
    renders, evals, histories, speeds = [], [], [], []
    for variant in ("full", "no_nb"):
        names = [f"102/{f}" for f in frames]
        path = tmp_path / f"render/S2/{variant}/nv1024.zip"
        record = {"config": {"name": "nv1024"}}
        renders.append(write_pack(path, "S2", "102", names, ("rgb", "nb_alpha"), record=record, per_frame=True))
        evals.append(str(tmp_path / f"{variant}.json"))
        rows = [{"camera": "102", "frame": f, "psnr": 20.5, "ssim": 0.9, "lpips_vgg": 0.1} for f in frames]
        content = {"subject": "S2", "variant": variant, "protocol": {"name": "nv1024"}, "per_image": rows, "count": 6}
        content["metrics"] = {"psnr": 20.5 + len(renders), "ssim": 0.9, "lpips_vgg": None}
        content |= {"protocol_hash": "abcdef012345", "record": {"code": "c0de", "device": "cpu: x", "config": {"a": 1}}}
        Path(evals[-1]).write_text(json.dumps(content))
        speed = {"ms": {"total_fp32": 10.0 * len(renders)}, "peak_memory_mb": 100.0, "model_mb": 1.5}
        speeds.append(str(tmp_path / f"speed/S2/{variant}.json"))
        Path(speeds[-1]).parent.mkdir(parents=True, exist_ok=True)
        Path(speeds[-1]).write_text(json.dumps({"device": "cpu: test", "speed": speed}))
        histories.append(str(tmp_path / f"train/S2/{variant}/history.jsonl"))
        Path(histories[-1]).parent.mkdir(parents=True)
        lines = [{"step": s, "mse": 1 / (1 + s), "psnr": 10 + s / 10, "progress": s / 50} for s in range(50)]
        Path(histories[-1]).write_text("\n".join(map(json.dumps, lines)))
    previews = tmp_path / "train/S2/full/model.pt.state/previews"
    previews.mkdir(parents=True)
    (previews / "step_0000050.png").write_bytes(encode_png(np.zeros((20, 30, 3), np.uint8)))
    (tmp_path / "ablation.md").write_text(
        "## Ablation <study>\n\n| a | b |\n| --- | ---: |\n| x | **1** |\n\n- note & more\n"
    )
    (tmp_path / "ablation.csv").write_text("table\nablation\n")
    (tmp_path / "S2.png").write_bytes(encode_png(np.full((9, 9, 3), 200, np.uint8)))
    (tmp_path / "novel_view.png").write_bytes(encode_png(np.full((9, 9, 3), 100, np.uint8)))
    said = {"kind": "figure", "title": "Novel views", "caption": "As <seen>.", "shown": ["S2 102/0000"]}
    (tmp_path / "novel_view.json").write_text(json.dumps(said))
    (tmp_path / "turntable.mp4").write_bytes(b"not looked into")
    options = {
        "--tables": [str(tmp_path / "ablation.md"), str(tmp_path / "ablation.csv")],
        "--evals": evals, "--renders": renders, "--frames": crops, "--histories": histories,
        "--pictures": [str(tmp_path / "S2.png"), str(tmp_path / "novel_view.png")], "--speeds": speeds,
        "--videos": [str(tmp_path / "turntable.mp4")],
    }  # fmt: skip
    return tmp_path, options


def build(folder, options, *extra):
    words = [word for name, files in options.items() for word in (name, *files)]
    assert main(["report", *words, "--out", str(folder / "index.html"), *extra]) == 0
    return (folder / "index.html").read_text(encoding="utf-8")


def test_page_is_self_contained_and_accessible(run):
    text = build(*run, "--size-label", "smoke size")
    page = Page(text)
    assert not re.search(r"(src|href)=[\"'](?!data:|#)", text) and "@import" not in text and "url(" not in text
    assert all(image.get("alt") and image["src"].startswith("data:image/") for image in page.all("img"))
    identities = [attrs["id"] for _, attrs in page.tags if attrs.get("id")]
    assert len(identities) == len(set(identities))
    sections = ("tables", "pareto", "pictures", "figures", "videos", "training", "stages", "provenance")
    assert {f"#{i}" for i in sections} == {attrs["href"] for attrs in page.all("a") if attrs["href"].startswith("#")}
    assert all(attrs["value"] in identities for attrs in page.all("option"))
    assert page.all("meta")[1]["name"] == "viewport"
    assert "smoke size: not comparable with the paper" in text and "Ablation &lt;study&gt;" in text


def test_page_shows_truth_renders_errors_masks_and_figures(run):
    text = build(*run, "--cfg", '{"frames": 2}')
    for words in (
        "Ground truth (camera 102, frame 0000)", "no_nb (camera 102, frame 0005)", "zoom into full (camera 102",
        "error map of full (camera 102", "coverage of full (camera 102", "PSNR 20.50 dB, SSIM 0.900, LPIPS 0.100 (VGG)",
        "PSNR on the training view", "PSNR [dB]", "Training preview of S2/full", "abcdef012345", "ablation.csv",
    ):  # fmt: skip
        assert words in text, words
    assert "frame 0002" not in text.partition('<section id="pictures">')[2], "the opening may show another frame"


def test_page_opens_with_truth_render_error_turntable_and_three_figures(run):
    folder, options = run
    judged = json.loads(Path(options["--evals"][1]).read_text())
    for row, value in zip(judged["per_image"], (30.0, 10.0, 22.0, 21.0, 25.0, 12.0), strict=True):
        row["psnr"] = value  # of six, the lower of the middle two is 21, that of frame 0003
    judged["metrics"] = {"psnr": 20.004, "ssim": 0.91234, "lpips_vgg": None, "lpips_alex": 0.1}
    Path(options["--evals"][1]).write_text(json.dumps(judged))
    film = folder / "video/S2/no_nb/turntable.mp4"
    film.parent.mkdir(parents=True)
    film.write_bytes(b"a film")
    options |= {"--videos": [*options["--videos"], str(film)]}
    text = build(folder, options)
    opening = text.partition('<section id="opening">')[2].partition("</section>")[0]
    assert text.index('id="opening"') < text.index("<nav>") < text.index('id="tables"')
    # Both have truth and figures; the one with a turntable stands for the run.
    assert "no_nb of S2, protocol nv1024, camera 102, frame 0003: the image of median PSNR" in opening
    assert re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd><dd>(.*?)</dd>", opening) == [
        ("PSNR [dB]", "20.00", "higher is better"),
        ("SSIM", "0.912", "higher is better"),
        ("LPIPS, AlexNet", "0.100", "lower is better"),
    ]
    assert [image["alt"].partition(" ")[0] for image in Page(opening).all("img")] == ["Truth", "Render", "Error"]
    (played,) = Page(opening).all("video")
    assert played["src"].startswith("data:video/mp4") and {"autoplay", "loop", "muted", "controls"} <= set(played)
    assert text.count(played["src"]) == 1, "what the opening plays is not put into the page again"
    alone = build(folder, {"--renders": options["--renders"]})
    opening = alone.partition('<section id="opening">')[2].partition("</section>")[0]
    assert [image["alt"].partition(" ")[0] for image in Page(opening).all("img")] == ["Render"]
    assert "<dl>" not in opening and "<video" not in opening and "median" not in opening
    assert 'id="opening"' not in build(folder, {"--evals": options["--evals"]})


def test_every_part_may_be_missing(run):
    folder, options = run
    whole = build(folder, options)
    for name in options:
        text = build(folder, {key: value for key, value in options.items() if key != name})
        Page(text)
        assert len(text) < len(whole)
    Page(build(folder, {}))


def test_a_table_of_numbers_is_shown_by_group(tmp_path):
    (tmp_path / "deform").mkdir()
    rows = ("group,quantity,value", "a.before,depth_mm,5.912345", "a.before,frames,", "after,depth_mm,0.04")
    (tmp_path / "deform/S2.csv").write_text("\n".join(rows))
    text = build(tmp_path, {"--tables": [str(tmp_path / "deform/S2.csv")]})
    Page(text)
    assert "deform S2" in text and '<th scope="col">quantity</th><th scope="col">value</th>' in text
    heads = re.findall(r'<tr class="block"><th colspan="2" scope="rowgroup"><span><i>(.*?)</i>', text)
    assert heads == ["a: before", "after"]
    cells = re.findall(r'<tr><th scope="row">(.*?)</th><td>(.*?)</td></tr>', text)
    assert cells == [("depth mm", "5.912"), ("frames", "none"), ("depth mm", "0.04")]


def test_savings_and_stages_before_training_stand_beside_the_sweep(tmp_path, capsys):
    table = "| saving | faster |\n|---|---:|\n| region of interest | 3.1x |\n"
    saving = {"saving": "region of interest", "scene": "an avatar far away", "faster": 3.1}
    step = {"stage": "refit", "knob": "cameras", "value": 4, "error_mm": 0.7, "ms": 12.0, "meaning": "median distance"}
    for place, kind, row in (("S2/full", "savings", saving), ("S2/offline", "offline", step)):
        folder = tmp_path / "tradeoff" / place
        folder.mkdir(parents=True)
        (folder / f"{kind}.json").write_text(json.dumps({"kind": kind, "rows": [row]}))
        (folder / f"{kind}.md").write_text(table)
    (folder / "offline.png").write_bytes(encode_png(np.full((9, 9, 3), 200, np.uint8)))
    files = [str(tmp_path / "tradeoff/S2" / name) for name in ("full/savings.json", "offline/offline.json")]
    text = build(tmp_path, {"--tradeoffs": files})
    page = Page(text)
    for words in (
        "Only what a scene requires: S2 full", "(an avatar far away), 3.1x", "Stages before training: S2</h3>",
        "Refit, cameras (median distance): 4: 0.70 mm in 12 ms.", "<td>3.1x</td>",
    ):  # fmt: skip
        assert words in text, words
    assert len(page.all("img")) == 1 and page.all("table") and not page.all("details")
    (tmp_path / "other.json").write_text('{"kind": "figure"}')
    assert main(["report", "--tradeoffs", str(tmp_path / "other.json"), "--out", str(tmp_path / "i.html")]) == 2
    assert "one of tradeoff, savings, offline" in capsys.readouterr().err


def test_quality_against_cost_figures_and_videos(run):
    folder, options = run
    text = build(folder, options)
    # Two variants: three costs, of which memory and bytes are equal and the better one stands alone on the front.
    assert text.count('class="front"') == 2 * 3 and "PSNR over time of one picture" in text
    assert "Timed on cpu: test" in text
    assert "Novel views. As &lt;seen&gt;" in text and "S2 102/0000" in text
    assert 'src="data:video/mp4;base64,' in text
    linked = build(folder, options, "--cfg", '{"video_mb": 0}')
    assert '<a href="./turntable.mp4">' in linked and "<video" not in linked


def test_a_link_to_a_video_is_one_whatever_its_folder_is_called():
    folder = "javascript:alert(1)#a?b%"
    page_path, video = Path("page.html"), Path(folder, "x.mp4")
    address = urlsplit(urljoin("file:///here/page.html", beside(video, page_path)))
    assert (address.scheme, unquote(address.path)) == ("file", f"/here/{folder}/x.mp4")
    assert (address.query, address.fragment) == ("", "")


def test_same_files_give_the_same_page(run):
    assert build(*run) == build(*run)


def test_missing_file_is_one_line_and_exit_2(tmp_path, capsys):
    for option in ("--tables", "--evals", "--renders", "--frames", "--histories", "--pictures", "--videos"):
        assert main(["report", option, str(tmp_path / "nothing.png"), "--out", str(tmp_path / "i.html")]) == 2
        error = capsys.readouterr().err.strip()
        assert "nothing.png" in error and "\n" not in error
    assert not (tmp_path / "i.html").exists()


def test_truth_is_found_by_subject_camera_size_and_intrinsics(tmp_path):
    from nbavatar.io.framepack import FramePack

    render = FramePack(write_pack(tmp_path / "r.zip", "S2", "102", ["102/f"], ("rgb",), per_frame=True))
    crops = [
        FramePack(write_pack(tmp_path / f"{i}.zip", subject, camera, ["f"], ("rgb", "alpha"), K_at=at))
        for i, (subject, camera, at) in enumerate(
            [("S1", "102", 16), ("S2", "108", 16), ("S2", "102", 12), ("S2", "102", 16)]
        )
    ]
    assert find_truth(render, "102/f", crops) is crops[3]
    assert find_truth(render, "102/f", crops[:3]) is None


def test_error_map_has_a_fixed_scale_of_rising_lightness():
    levels = np.linspace(0, 1.2 * ERROR_MAX, 40, dtype=np.float32)
    truth = np.broadcast_to(1 - levels[None, :, None], (3, 40, 3)).astype(np.float32)
    shown = error_map(np.full((3, 40, 3), 255, np.uint8), truth).astype(float)
    assert tuple(shown[0, 0]) == RAMP[0] and tuple(shown[0, -1]) == RAMP[-1]
    lightness = shown[0] @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) >= 0).all() and lightness[-1] > 200


def test_small_helpers():
    assert (
        spread(list("abcdefg"), 3) == ["a", "d", "g"] and spread(["a"], 3) == ["a"] and spread(list("abc"), 1) == ["b"]
    )
    assert reduce_picture(np.zeros((40, 80, 3), np.uint8), 20).shape == (10, 20, 3)
    same = np.zeros((4, 4), np.uint8)
    assert reduce_picture(same, 4) is same
    points = [(float(i), 2.0 * i) for i in range(1000)]
    thinned = thin(points, 100)
    assert len(thinned) == 100 and all(y == pytest.approx(2 * x) for x, y in thinned)


def test_chart_leaves_out_what_cannot_be_drawn_and_labels_its_axes():
    series = {"a": [(0.0, 1.0), (1.0, 0.1), (2.0, float("nan"))], "b<": [(0.0, -1.0)]}
    chart = line_chart("T", series, x_label="step", y_label="loss [1]", log_y=True)
    assert ">step<" in chart and ">loss [1]<" in chart and "b&lt;" not in chart and "nan" not in chart
    assert line_chart("T", {"b": [(0.0, -1.0)]}, x_label="x", y_label="y", log_y=True) == ""
    flat = line_chart("T", {"c": [(0.0, 3.0), (5.0, 3.0)]}, x_label="x", y_label="y")
    assert "nan" not in flat and "inf" not in flat


@pytest.mark.parametrize(
    ("values", "labels"),
    [
        ((0.0063, 0.12), ["0.01", "0.03", "0.1"]),
        ((1e-6, 2.0), ["1e-06", "0.0001", "0.01", "1"]),
        ((0.27, 0.31), ["0.27", "0.28", "0.29", "0.3", "0.31"]),
        ((0.5, 40.0), ["1", "3", "10", "30"]),
    ],
)
def test_log_axes_have_round_labels(values, labels):
    chart = line_chart("T", {"a": [(0.0, values[0]), (1.0, values[1])]}, x_label="x", y_label="y", log_y=True)
    assert re.findall(r'text-anchor="end">([^<]+)<', chart) == labels


def test_markdown_of_tables():
    table = "| h | k |\n| --- | ---: |\n| *block* |  |\n| r | **1** <u>2</u> |\n"
    text = f"## A\n\npara *i* `c`\n\n{table}\n- n\n\nSources:\n\n- `f`\n"
    html = markdown_to_html(text + "\n<!-- {} -->\n")
    assert "<h3>A</h3>" in html and '<tr class="block"><th colspan="2"' in html and "<td><b>1</b> <u>2</u></td>" in html
    assert "<details><summary>Sources</summary>" in html and "<!--" not in html
    Page(html)
    assert "<script>" not in markdown_to_html("<script>alert(1)</script>")
