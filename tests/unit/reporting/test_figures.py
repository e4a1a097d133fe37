"""Figures for print: what is shown, in which order, and that nothing is cut off or missing in silence."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.backends.backend_agg import FigureCanvasAgg

from nbavatar.cli import main
from nbavatar.config.figures import FigureColumn, FigureLayout, read_figures
from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.errors import ConfigError
from nbavatar.io.framepack import FramePack, FramePackWriter
from nbavatar.io.images import decode_image
from nbavatar.reporting.comparison import Rendered, frames_in_contact
from nbavatar.reporting.contact import best_camera, deepest_frames, dent_pictures, dent_scale
from nbavatar.reporting.figures import label_figure
from nbavatar.reporting.gallery import comparison_drawn, curves_drawn
from nbavatar.reporting.pareto import Measured, measured_variants, pareto_figure, pareto_front, scatter_chart

ROOT = Path(__file__).parents[3]
SIZE = 40
K = [[60.0, 0, 20], [0, 60.0, 20], [0, 0, 1]]


def pack(path, subject, camera, frames, layers, *, contact=()):
    """A pack of flat pictures; hand and head touch in the frames `contact`, the more the later in that list."""
    path.parent.mkdir(parents=True, exist_ok=True)
    manifest = {
        "stage": "x", "subject": subject, "camera": camera, "width": SIZE, "height": SIZE, "K": K,
        "cam_from_world": np.eye(4).tolist(), "frames": frames, "layers": dict.fromkeys(layers, ""), "record": {},
    }  # fmt: skip
    with FramePackWriter(path, manifest) as writer:
        for number, frame in enumerate(frames):
            label = np.zeros((SIZE, SIZE), np.uint8)
            label[5:20, 5:20] = 1
            rank = contact.index(frame) + 1 if frame in contact else 0
            label[5 : 5 + 3 * rank, 20:30] = 2
            for layer in layers:
                plain = np.full((SIZE, SIZE), 50 + 20 * number, np.uint8)
                value = {"label": label, "alpha": np.where(label > 0, 255, 0).astype(np.uint8)}.get(layer, plain)
                writer.add(layer, frame, np.stack([value] * 3, -1) if layer == "rgb" else value)
    return FramePack(path)


@pytest.fixture
def group(tmp_path):
    frames = [f"{i:03}" for i in range(8)]
    crop = pack(tmp_path / "crop.zip", "S2", "102", frames, ("rgb", "alpha", "label"), contact=["001", "002", "006"])
    renders = []
    for variant in ("no_nb", "full"):
        made = pack(tmp_path / variant / "nv.zip", "S2", "102", [f"102/{f}" for f in frames], ("rgb", "nb_alpha"))
        figures = {f"102/{f}": {"psnr": 20.0} for f in frames}
        renders.append(Rendered("S2", variant, "nv", (1.0, 1.0, 1.0), made, figures))
    return renders, [crop]


def texts(figure):
    return [text.get_text() for axes in figure.axes for text in axes.texts]


def test_frames_with_the_largest_contact_are_chosen(group):
    renders, crops = group
    names = renders[0].pack.frames
    assert frames_in_contact(names, renders[0].pack, crops, 1) == ["102/006"]
    assert frames_in_contact(names, renders[0].pack, crops, 2) == ["102/002", "102/006"]
    # Stretches without contact, or without labels, give their middle frame.
    assert frames_in_contact(names[:1], renders[0].pack, crops, 3) == ["102/000"]
    assert frames_in_contact(names, renders[0].pack, [], 2) == ["102/002", "102/006"]
    assert frames_in_contact(names[3:6], renders[0].pack, crops, 1) == ["102/004"]


def test_comparison_shows_truth_then_methods_in_the_order_of_the_layout(group):
    renders, crops = group
    columns = [FigureColumn("missing", "Not trained"), FigureColumn("full", "Ours"), FigureColumn("no_nb", "w/o L_NB")]
    layout = FigureLayout(protocol="nv", columns=columns, rows=["whole", "zoom", "coverage", "error"])
    drawn = comparison_drawn(renders, crops, layout)
    shown = texts(drawn.figure)
    assert shown[:3] == ["Ground truth", "Ours", "w/o L_NB"] and drawn.shown == ["S2 102/006"]
    assert shown.count("20.00 dB") == 2 and "|error|, sRGB [1]" in shown
    # Pictures: 3 whole, 3 zooms, 3 coverages, 2 errors, the colour bar.
    assert len(drawn.figure.axes[0].images) == 12
    width, height = drawn.figure.get_size_inches()
    drawn.figure.canvas.draw()
    for text in drawn.figure.axes[0].texts:
        box = text.get_window_extent().transformed(drawn.figure.dpi_scale_trans.inverted())
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height, text.get_text()


def test_a_figure_without_results_says_so(group):
    layout = FigureLayout(title="Ablation", protocol="sr", columns=[FigureColumn("full")])
    drawn = comparison_drawn(group[0], group[1], layout)
    assert drawn.shown == [] and "no render under sr yet" in drawn.figure.texts[0].get_text()


@given(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=1, max_size=12), st.booleans())
def test_front_holds_exactly_what_nothing_beats(points, higher):
    sign = 1 if higher else -1
    front = pareto_front(points, higher_is_better=higher)
    assert front and [points[i][0] for i in front] == sorted(points[i][0] for i in front)
    for i, (cost, quality) in enumerate(points):
        beaten = any(c <= cost and sign * q >= sign * quality and (c, q) != (cost, quality) for c, q in points)
        assert (i in front) == (not beaten)


def test_variants_are_compared_on_the_subjects_that_all_of_them_have():
    def result(subject, variant, psnr):
        return {"subject": subject, "variant": variant, "protocol": {"name": "nv"}, "metrics": {"psnr": psnr}}

    evals = [result("S1", "a", 30.0), result("S2", "a", 20.0), result("S2", "b", 22.0), result("S2", "untimed", 9.0)]
    speeds = [(v, {"speed": {"ms": {"total_fp32": 5.0}, "peak_memory_mb": None}}) for v in ("a", "b", "unjudged")]
    measured = measured_variants(evals, speeds, "nv")
    assert measured == [Measured("a", {"psnr": 20.0}, {"ms": 5.0}), Measured("b", {"psnr": 22.0}, {"ms": 5.0})]
    chart = scatter_chart(measured, "ms", "psnr")
    assert "time of one picture [ms]" in chart and "PSNR [dB]" in chart and chart.count('r="4"') == 4
    assert scatter_chart(measured, "model_mb", "psnr") == ""
    figure = pareto_figure(measured)
    assert [axes.get_xlabel() for axes in figure.axes] == ["time of one picture [ms]"]
    assert measured_variants(evals, speeds, "other") == []


def dented():
    """A flat grid that faces the camera at the origin, pushed in by up to 40 mm in the second of three frames."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 13), np.linspace(-0.3, 0.3, 13))
    rest = np.stack([x.ravel(), y.ravel(), np.ones(169)], 1).astype(np.float32)
    at = np.arange(169).reshape(13, 13)
    a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel()
    faces = np.concatenate([np.stack((a, c, b), 1), np.stack((b, c, d), 1)]).astype(np.int64)
    rigid = np.stack([rest] * 3)
    verts = rigid.copy()
    verts[1, :, 2] += 0.04 * np.exp(-((rest[:, 0] - 0.1) ** 2 + rest[:, 1] ** 2) / 0.005)
    return MeshSequence(["a", "b", "c"], {"head": Part(faces, rest, verts)}, {"head_rigid": rigid})


def test_dents_are_found_seen_from_the_front_and_measured():
    sequence = dented()
    assert deepest_frames(sequence, ["a", "b", "c"], 2) == ["b"]
    assert deepest_frames(sequence, ["a", "c"], 2) == []
    assert deepest_frames(MeshSequence(sequence.frames, sequence.parts), ["b"], 2) == []
    assert dent_scale(sequence, ["b"]) == pytest.approx(50.0)
    behind = np.diag([-1.0, 1.0, -1.0, 1.0])
    behind[2, 3] = 2.0
    index, place = best_camera(sequence, "b", [behind, np.eye(4)])
    assert index == 1 and np.abs(place[:2] - (0.1, 0)).max() < 0.03
    made = dent_pictures(sequence, "b", np.array(K), np.eye(4), SIZE, SIZE, 40.0)
    assert list(made) == ["before", "after", "displacement"]
    light = made["displacement"].astype(int).sum(-1)
    light[(made["displacement"] == 255).all(-1)] = 0  # the white around it
    row, column = np.unravel_index(light.argmax(), light.shape)
    assert abs(column - (20 + 60 * 0.1)) <= 2 and abs(row - 20) <= 2
    assert (made["before"] != made["after"]).any()


@pytest.mark.slow
def test_every_figure_of_the_layout_is_drawn_the_same_twice(group, tmp_path):
    renders, crops = group
    history = tmp_path / "S2" / "full" / "history.jsonl"
    history.parent.mkdir(parents=True)
    history.write_text("\n".join(json.dumps({"step": s, "mse": 1 / (1 + s)}) for s in range(20)))
    layout = tmp_path / "figures.yaml"
    layout.write_text(
        "view: {protocol: nv, columns: [{variant: full, label: Ours}], rows: [whole, error]}\n"
        "training: {kind: curves}\npareto: {kind: pareto, protocol: nv}\n"
    )
    files = {
        "view": ["--renders", str(renders[1].pack.path), "--frames", str(crops[0].path)],
        "training": ["--histories", str(history)],
        "pareto": [],
    }
    for name, arguments in files.items():
        both = []
        for stem in (tmp_path / f"{name}1", tmp_path / f"{name}2"):
            assert main(["figure", "--figure", name, "--layout", str(layout), *arguments, "--out-stem", str(stem)]) == 0
            both.append([stem.with_suffix(suffix).read_bytes() for suffix in (".png", ".pdf")])
        assert both[0] == both[1]
        record = json.loads((tmp_path / f"{name}1.json").read_text())
        assert record["record"]["command"] == "figure" and bool(record["shown"]) == (name != "pareto")


def test_a_rehearsal_is_written_below_its_figures_and_covers_nothing(tmp_path):
    history = tmp_path / "S2" / "full" / "history.jsonl"
    history.parent.mkdir(parents=True)
    history.write_text("\n".join(json.dumps({"step": s, "mse": 1 / (1 + s)}) for s in range(3)))
    layout = tmp_path / "figures.yaml"
    layout.write_text("training: {kind: curves}\n")
    words = ["figure", "--figure", "training", "--layout", str(layout), "--histories", str(history), "--out-stem"]
    assert main([*words, str(tmp_path / "plain")]) == 0
    assert main([*words, str(tmp_path / "marked"), "--size-label", "rehearsal, $2 steps"]) == 0
    plain, marked = (decode_image(tmp_path / f"{name}.png") for name in ("plain", "marked"))
    # The same picture above a strip, but for places of letters and lines, which fall between pixels otherwise.
    assert 20 < len(marked) - len(plain) < 60
    assert np.abs(marked[: len(plain)].astype(float) - plain).mean() < 4.0
    assert (marked[len(plain) :] < 128).any()
    assert main([*words, str(tmp_path / "long"), "--size-label", "a reason that is told at length, " * 9]) == 0
    long = decode_image(tmp_path / "long.png")  # several lines, none of them cut off at the right
    assert len(long) > len(marked) and (long[len(plain) :, -8:] == 255).all()
    assert json.loads((tmp_path / "marked.json").read_text())["label"] == "rehearsal, $2 steps"
    assert "label" not in json.loads((tmp_path / "plain.json").read_text())


def test_the_strip_of_a_label_lies_below_all_that_is_drawn():
    variants = [Measured(f"variant_{n}", {"psnr": 20.0 + n}, {"ms": 5.0 + n}) for n in range(9)]  # a legend of two rows
    figure = pareto_figure(variants)
    label_figure(figure, "rehearsal: " + "synthetic people in few frames, " * 9)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    label = figure.texts[-1].get_window_extent()
    drawn = [axes.get_tightbbox() for axes in figure.axes] + [legend.get_window_extent() for legend in figure.legends]
    assert len(drawn) > 1 and 0 < label.y0 and label.y1 < min(box.y0 for box in drawn)


def test_no_label_of_training_curves_is_cut_off():
    names = ("psnr", "loss", "delta", "l1", "position")
    events = [{"step": s} | {name: 2.4e-5 * (1 + s / 40) for name in names} for s in (1, 25, 120)]
    drawn = curves_drawn({"S2/splatting_avatar_released": events, "S2/full": events[:1]})
    canvas = FigureCanvasAgg(drawn.figure)
    canvas.draw()
    width, height = canvas.get_width_height()
    for axis in drawn.figure.axes:
        box = axis.get_tightbbox(canvas.get_renderer())
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height, axis.get_title()
    assert [text.get_text() for text in drawn.figure.legends[0].get_texts()] == list(drawn.shown)


def test_layouts_are_read_and_name_known_variants_and_protocols(tmp_path, capsys):
    import yaml

    for sheet, run in (
        ("config/figures.yaml", "config/paper.yaml"),
        ("config/capture/figures.yaml", "config/capture.yaml"),
    ):
        figures = read_figures(ROOT / sheet)
        config = yaml.safe_load((ROOT / run).read_text())
        protocols = set(config.get("protocols") or {}) | {"nv1024", "sr1024", "nv512", "sr512"}
        assert all(not f.protocol or f.protocol in protocols for f in figures.values())
    (tmp_path / "f.yaml").write_text("a: {kind: comparison}\n")
    with pytest.raises(ConfigError, match="columns and a protocol"):
        read_figures(tmp_path / "f.yaml")
    assert (
        main(["figure", "--figure", "abblation", "--layout", str(ROOT / "config/figures.yaml"), "--out-stem", "x"]) == 2
    )
    assert "did you mean 'ablation'" in capsys.readouterr().err
