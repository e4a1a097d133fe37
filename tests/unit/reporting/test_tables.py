"""Tables through the command: layout, ranks, missing cells, sizes, traceability."""

import csv
import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from nbavatar.cli import main
from nbavatar.config.core import to_mapping
from nbavatar.config.evaluation import PROTOCOLS, EvaluateConfig, protocol_hash

ROOT = Path(__file__).parents[3]
LAYOUT, REPORTED = str(ROOT / "config/tables.yaml"), str(ROOT / "config/reported.csv")
TABLES = (
    "novel_view_1024", "self_reenactment_1024", "interactavatar_512", "ablation", "channels", "speed", "cameras",
)  # fmt: skip


def evaluation(folder, subject, variant, protocol, size, *, psnr=25.0, ssim=0.95, lpips=0.05, name="", **more):
    path = folder / "eval" / subject / variant / f"{protocol}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    metrics = {"psnr": psnr, "ssim": ssim, "lpips_vgg": lpips, "lpips_alex": lpips / 2, "psnr_fg": psnr - 5}
    content = {
        "kind": "evaluation", "subject": subject, "variant": variant,
        "protocol": to_mapping(PROTOCOLS[protocol]) | {"name": name or protocol},
        "protocol_hash": protocol_hash(PROTOCOLS[protocol], EvaluateConfig()), "size": [size, size], "count": 3,
        "frames": "0123456789ab", "metrics": metrics, "cameras": ["108"], "train_cameras": ["122", "110"],
        "trivial": {"background": {"psnr": 9.5}, "mean_image": {"psnr": 14.25}}, "per_image": [], "record": {},
    }  # fmt: skip
    path.write_text(json.dumps(content | more))
    return str(path)


def timing(folder, subject, variant, size, **ms):
    path = folder / "speed" / subject / f"{variant}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"device": "cpu: test", "speed": {"ms": ms, "size": [size, size], "billboards": 20}}))
    return str(path)


def make(folder, table, evals=(), speeds=(), *extra, layout=LAYOUT):
    stem = str(folder / table)
    code = main(
        ["table", "--table", table, "--layout", layout, "--reported", REPORTED, "--evals", *evals]
        + ["--speeds", *speeds, "--out-stem", stem, *extra]
    )
    assert code == 0
    with open(f"{stem}.csv", newline="") as stream:
        cells = {(r["panel"], r["block"], r["row"], r["column"]): r for r in csv.DictReader(stream)}
    assert "<title>" in Path(f"{stem}.html").read_text()
    return cells, Path(f"{stem}.md").read_text(), Path(f"{stem}.tex").read_text()


@pytest.mark.parametrize("table", TABLES)
def test_without_any_result_printed_numbers_stand_and_the_rest_is_missing(tmp_path, table):
    cells, markdown, latex = make(tmp_path, table)
    blocks = {key[1] for key in cells}
    assert blocks == {"printed", "reproduced"}
    assert all(cell["text"] == "" for key, cell in cells.items() if key[1] == "reproduced")
    assert any(cell["text"] for key, cell in cells.items() if key[1] == "printed")
    assert "—" in markdown and "---" in latex


def test_every_cell_names_its_file_its_digest_and_its_protocol(tmp_path):
    path = evaluation(tmp_path, "S2", "full", "nv1024", 1024, psnr=29.004)
    cells, markdown, latex = make(tmp_path, "novel_view_1024", [path])
    cell = cells["", "reproduced", "Ours", "S2.psnr"]
    digest = "sha256:" + hashlib.sha256(Path(path).read_bytes()).hexdigest()
    assert (cell["text"], cell["value"], cell["source"], cell["digest"]) == ("29.00", "29.004", path, digest)
    assert cell["protocol_hash"] == protocol_hash(PROTOCOLS["nv1024"], EvaluateConfig())
    assert cell["size"] == "1024x1024" and cell["comparable"] == "yes"
    assert cells["", "printed", "Ours", "S2.psnr"]["source"] == REPORTED
    for text in (markdown, latex):
        assert path in text and digest in text
        assert protocol_hash(PROTOCOLS["nv1024"], EvaluateConfig()) in text
    shown = {key: c for key, c in cells.items() if c["shown"] == "yes" and c["text"]}
    assert all(c["source"] and c["digest"].startswith("sha256:") for c in shown.values())


def test_differences_are_those_of_the_digits_shown(tmp_path):
    path = evaluation(tmp_path, "S2", "full", "nv1024", 1024, psnr=28.6349, ssim=0.9712, lpips=0.0324)
    cells, _, _ = make(tmp_path, "novel_view_1024", [path])
    # printed 28.63, 0.976, 0.032
    found = [cells["", "difference", "Ours", f"S2.{m}"]["text"] for m in ("psnr", "ssim", "lpips")]
    assert found == ["0.00", "-0.005", "0.000"]
    cells, _, _ = make(tmp_path, "ablation", [path])
    assert cells["", "difference", "Full Method", "S2.ssim"]["text"] == "-0.005"


@pytest.mark.parametrize(("size", "extra"), [(64, ()), (1024, ("--size-label", "synthetic data"))])
def test_what_is_not_comparable_is_labelled_and_never_subtracted(tmp_path, size, extra):
    path = evaluation(tmp_path, "S2", "full", "nv1024", size, psnr=33.0)
    cells, markdown, latex = make(tmp_path, "novel_view_1024", [path], (), *extra)
    assert {key[1] for key in cells} == {"printed", "reproduced"}
    assert cells["", "reproduced", "Ours", "S2.psnr"]["comparable"] == "no"
    assert cells["", "printed", "Ours", "S2.psnr"]["text"] == "28.63"
    label = extra[1] if extra else "size 64 x 64 px"
    assert f"*Reproduced ({label}; not comparable with the paper)*" in markdown
    caption = re.search(r"\\caption\{(.*)\}", latex)
    assert caption and f"{label}; not comparable with the paper" in caption.group(1)


def test_a_rehearsal_stands_beside_the_paper_and_its_caption_says_what_the_difference_is_worth(tmp_path):
    extra = ("--size-label", "rehearsal", "--cfg", '{"difference": "size"}')
    path = evaluation(tmp_path, "S2", "full", "nv1024", 1024, psnr=33.0)
    cells, markdown, latex = make(tmp_path, "novel_view_1024", [path], (), *extra)
    assert cells["", "difference", "Ours", "S2.psnr"]["text"] == "+4.37"  # 33.00 - 28.63
    assert cells["", "difference", "Ours", "S2.psnr"]["comparable"] == "no"
    sentence = "Differences are between unlike things (here: rehearsal)"
    assert markdown.count(sentence) == 1 and latex.count(sentence) == 1
    # Images of another size are never subtracted.
    small = evaluation(tmp_path, "S2", "full", "nv1024", 64, psnr=33.0)
    cells, markdown, _ = make(tmp_path, "novel_view_1024", [small], (), *extra)
    assert {key[1] for key in cells} == {"printed", "reproduced"} and sentence not in markdown


def test_means_need_every_subject_and_are_recomputed(tmp_path):
    values = {"S1": 27.001, "S2": 28.002, "S3": 23.003, "S4": 24.005}
    paths = [evaluation(tmp_path, s, "full", "nv1024", 1024, psnr=v) for s, v in values.items()]
    cells, _, _ = make(tmp_path, "novel_view_1024", paths[:3])
    assert cells["", "reproduced", "Ours", "mean.psnr"]["text"] == ""
    cells, _, _ = make(tmp_path, "novel_view_1024", paths)
    mean = cells["", "reproduced", "Ours", "mean.psnr"]
    assert float(mean["value"]) == pytest.approx(sum(values.values()) / 4, abs=1e-12)
    assert mean["source"].split(";") == paths
    assert cells["", "difference", "Ours", "mean.psnr"]["text"] == "-0.15"  # 25.50 - 25.65


def test_ranks_are_taken_within_a_block(tmp_path):
    paths = [
        evaluation(tmp_path, "S1", "full", "nv1024", 1024, psnr=20.0, lpips=0.05),
        evaluation(tmp_path, "S1", "gaussian_avatars", "nv1024", 1024, psnr=21.0, lpips=0.06),
        evaluation(tmp_path, "S1", "splatting_avatar", "nv1024", 1024, psnr=19.0, lpips=0.04),
    ]
    cells, markdown, latex = make(tmp_path, "novel_view_1024", paths)

    def marks(column):
        return [cells["", "reproduced", row, column]["mark"] for row in ("SA", "GA", "Ours")]

    assert marks("S1.psnr") == ["", "best", "second"]
    assert marks("S1.lpips") == ["best", "", "second"]
    assert "| **21.00** |" in markdown and r"\textbf{21.00} & " in latex and r"\underline{20.00}" in latex


def test_panels_and_single_subjects_of_the_512_table(tmp_path):
    paths = [
        evaluation(tmp_path, "S2", "full512", "nv512", 64, psnr=22.0),
        evaluation(tmp_path, "S2", "full512", "sr512", 64, psnr=21.0),
    ]
    cells, markdown, latex = make(tmp_path, "interactavatar_512", paths)
    assert cells["Novel View", "printed", "IA", "mean.psnr"]["text"] == "29.85"
    assert cells["Novel View", "reproduced", "Ours", "mean.psnr"]["text"] == ""
    assert cells["Novel View", "reproduced", "Ours, S2 alone", "mean.psnr"]["text"] == "22.00"
    assert cells["Self-Reenactment", "reproduced", "Ours, S2 alone", "mean.psnr"]["text"] == "21.00"
    assert markdown.count("### ") == 2 and latex.count(r"\begin{subtable}") == 2 == latex.count(r"\end{subtable}")


def test_channels_and_speed_take_timings(tmp_path):
    times = {"raster": 2.0, "raster_rgb": 1.0, "renderer_fp32": 30.0, "renderer_bf16": 16.0}
    times |= {"total_fp32": 40.0, "total_bf16": 20.0}
    speed = timing(tmp_path, "S2", "full", 1024, **times)
    cells, markdown, _ = make(tmp_path, "speed", (), [speed])
    found = {row: cells["", "reproduced", row, "ms"]["text"] for _, block, row, _ in cells if block == "reproduced"}
    assert found == {
        "Rasterization - RGB": "1.0",
        "Rasterization - NT": "2.0",
        "Neural Rendering - fp32": "30.0",
        "Neural Rendering - half": "16.0",
        "Total (NT; half)": "20.0",
    }
    assert cells["", "reproduced", "Total (NT; half)", "fps"]["text"] == "50"
    assert cells["", "reproduced", "Total (NT; half)", "fps"]["note"] == "total_bf16"
    assert cells["", "difference", "Rasterization - NT", "ms"]["text"] == "+0.7"
    assert "cpu: test, 1024 x 1024 px, 20 billboards" in markdown
    cells, _, _ = make(tmp_path, "channels", [evaluation(tmp_path, "S2", "full", "nv1024", 1024)], [speed])
    assert (
        cells["", "reproduced", "6", "S2.fps"]["text"] == "25" and cells["", "reproduced", "3", "S2.fps"]["text"] == ""
    )


def test_cost_stands_beside_quality_with_mode_and_budget_of_every_method(tmp_path):
    spent = {
        "steps": 1200,
        "train_seconds": 90.0,
        "primitives": 5000,
        "model_bytes": 2_500_000,
        "peak_memory_mb": 700.4,
    }
    paths = [
        evaluation(tmp_path, "S2", "full", "nv1024", 1024, training={"method": "billboards", **spent}),
        evaluation(
            tmp_path, "S2", "splatting_avatar", "nv1024", 1024,
            training={"method": "splatting_avatar", "mode": "paper", **spent, "steps": 30_000, "primitives": 81_234},
        ),
    ]  # fmt: skip
    speed = timing(tmp_path, "S2", "full", 1024, total_fp32=12.5)
    content = json.loads(Path(speed).read_text())
    content["speed"]["peak_memory_mb"] = 431.2
    Path(speed).write_text(json.dumps(content))
    cells, markdown, latex = make(tmp_path, "cost", paths, [speed])
    row = {
        key[3].partition(".")[2]: cell["text"]
        for key, cell in cells.items()
        if key[2] == "Ours" and cell["shown"] == "yes"
    }
    assert row == {
        "psnr": "25.00", "ssim": "0.950", "lpips": "0.050", "ms": "12.5", "memory_mb": "431", "model_mb": "2.5",
        "primitives": "5000", "train_minutes": "1.5", "train_memory_mb": "700",
    }  # fmt: skip
    other = {key[3].partition(".")[2]: cell["text"] for key, cell in cells.items() if key[2] == "SA"}
    assert other["primitives"] == "81234" and other["ms"] == "" and other["memory_mb"] == ""
    assert {cell["text"] for key, cell in cells.items() if key[2] == "GA"} == {""}
    said = "Trained here: SA: splatting avatar, mode paper, 30,000 steps; Ours: billboards, 1,200 steps."
    assert said in markdown and said in latex
    assert "rank nothing" not in markdown


def test_the_caption_says_when_trainings_were_too_short_to_rank_anything(tmp_path):
    for steps, words, budget in (
        (120, "120 training steps rank nothing: they show", "billboards, 120 steps."),
        (1, "One training step ranks nothing: it shows", "billboards, 1 step."),
    ):
        trained = {"method": "billboards", "steps": steps}
        paths = [evaluation(tmp_path, "S2", v, "nv1024", 64, training=trained) for v in ("full", "splatting_avatar")]
        _, markdown, latex = make(tmp_path, "cost", paths)
        said = f"{words} that every stage runs, not which method is better."
        assert said in markdown.split("| ")[0] and said in latex.partition("\\caption")[2].partition("\n")[0]
        assert budget in markdown


def test_baselines_fill_the_rows_of_the_paper(tmp_path):
    paths = [
        evaluation(tmp_path, s, v, "nv1024", 1024, psnr=p)
        for s in ("S1", "S2", "S3", "S4")
        for v, p in (("splatting_avatar", 24.0), ("splatting_avatar_released", 23.0), ("gaussian_avatars", 25.0))
    ]
    cells, _, _ = make(tmp_path, "novel_view_1024", paths)
    means = {key[1:3]: cell["text"] for key, cell in cells.items() if key[3] == "mean.psnr"}
    assert means["reproduced", "SA"] == "24.00" and means["reproduced", "SA, as released"] == "23.00"
    assert means["reproduced", "GA"] == "25.00" and means["reproduced", "Ours"] == ""
    assert ("printed", "SA, as released") not in means and means["printed", "SA"] == "25.17"
    assert means["difference", "SA"] == "-1.17"


def test_cameras_are_compared_as_sets(tmp_path):
    train = ["084", "100", "102", "110", "111", "121", "122"]
    path = evaluation(tmp_path, "S2", "full", "nv1024", 1024, train_cameras=train)
    other = evaluation(tmp_path, "S1", "full", "nv1024", 1024, train_cameras=train)
    cells, _, _ = make(tmp_path, "cameras", [path, other])
    assert cells["", "difference", "S2", "train_cameras"]["text"] == "same"
    assert cells["", "difference", "S2", "test_camera"]["text"] == "same"
    assert cells["", "difference", "S1", "train_cameras"]["text"] == "differs"
    assert cells["", "printed", "S3", "test_camera"]["text"] == "084"


def test_lpips_net_is_chosen_named_and_the_other_is_in_the_csv(tmp_path):
    path = evaluation(tmp_path, "S2", "full", "nv1024", 1024, lpips=0.08)
    cells, markdown, _ = make(tmp_path, "novel_view_1024", [path])
    assert cells["", "reproduced", "Ours", "S2.lpips"]["text"] == "0.080" and "LPIPS by VGG16" in markdown
    assert cells["", "reproduced", "Ours", "S2.lpips_alex"]["text"] == "0.040"
    assert cells["", "reproduced", "Ours", "S2.mean_image.psnr"]["text"] == "14.25"
    cells, markdown, _ = make(tmp_path, "novel_view_1024", [path], (), "--cfg", '{"lpips_net": "alex"}')
    assert cells["", "reproduced", "Ours", "S2.lpips"]["text"] == "0.040" and "LPIPS by AlexNet" in markdown


def test_captions_list_the_papers_own_deviations_and_trivial_answers(tmp_path):
    path = evaluation(tmp_path, "S2", "full", "sr1024", 1024)
    _, markdown, _ = make(tmp_path, "self_reenactment_1024", [path])
    assert "All printed means follow from the printed cells within rounding." in markdown
    assert "SA S1 SSIM (paper: unmarked; digits: underlined); SA mean LPIPS" in markdown
    assert "S2 background only 9.50, mean training image 14.25" in markdown


def test_capture_layout_takes_whatever_subjects_there_are(tmp_path):
    paths = [evaluation(tmp_path, s, "full", "nv1024", 300, name="nv") for s in ("me", "you")]
    cells, markdown, _ = make(tmp_path, "novel_view", paths, layout=str(ROOT / "config/capture/tables.yaml"))
    assert {key[1] for key in cells} == {"reproduced"}
    assert not re.search("paper|[Pp]rinted", markdown.partition("Sources")[0])
    assert [c["text"] for key, c in cells.items() if key[3] == "mean.psnr"] == ["25.00"]


def test_a_captures_speed_table_shows_every_stage(tmp_path):
    stages = ("raster_rgb", "raster", "renderer_fp32", "renderer_bf16", "total_bf16")
    path = timing(tmp_path, "me", "full", 256, **dict.fromkeys(stages, 2.0))
    cells, _, _ = make(tmp_path, "speed", [], [path], layout=str(ROOT / "config/capture/tables.yaml"))
    assert [c["text"] for key, c in cells.items() if key[3].endswith("ms")] == ["2.0"] * 5


@pytest.mark.parametrize("table", TABLES)
def test_latex_is_balanced_and_escaped(tmp_path, table):
    paths = [evaluation(tmp_path, "S2", v, p, 64) for v, p in (("full", "nv1024"), ("full512", "nv512"))]
    _, _, latex = make(tmp_path, table, paths, [timing(tmp_path, "S2", "full", 64, total_fp32=3.0)])
    body = "\n".join(line for line in latex.splitlines() if not line.startswith("%"))
    assert body.count("{") == body.count("}")
    for name in re.findall(r"\\begin\{(\w+)\}", body):
        assert body.count(f"\\begin{{{name}}}") == body.count(f"\\end{{{name}}}")
    assert body.isascii() and body.count("$") % 2 == 0
    columns = [spec.replace(" ", "") for spec in re.findall(r"\\begin\{tabular\}\{([lc ]+)\}", body)]
    tabulars = re.findall(r"\\begin\{tabular\}.*?\\end\{tabular\}", body, flags=re.DOTALL)
    for spec, tabular in zip(columns, tabulars, strict=True):
        for line in tabular.splitlines():
            if line.endswith(r"\\") and not line.startswith((r"\multicolumn", "& ")):
                assert line.count(" & ") == len(spec) - 1, line
    outside_math = re.sub(r"\$[^$]*\$|\\[a-zA-Z]+\{[^{}]*\}|\\_", "", body)
    assert "_" not in re.sub(r"\\label\{[^}]*\}", "", outside_math)


@pytest.mark.slow
def test_every_table_compiles_and_fits_the_page(tmp_path, latex):
    paths = [
        evaluation(tmp_path, s, v, p, 64) for s in ("S1", "S2") for v, p in (("full", "nv1024"), ("full512", "nv512"))
    ]
    speed = timing(tmp_path, "S2", "full", 64, total_fp32=3.0, raster=1.0)
    bodies = [make(tmp_path, table, paths, [speed])[2] for table in (*TABLES, "cost")]
    packages = "\\usepackage{booktabs,graphicx,subcaption}\n\\usepackage[table]{xcolor}\n"
    text = "\n\\clearpage\n".join(bodies)
    log = latex(f"\\documentclass{{article}}\n{packages}\\begin{{document}}\n{text}\n\\end{{document}}\n")
    assert "Overfull \\hbox" not in log and "undefined" not in log


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--table", "abblation"], "unknown table 'abblation'; did you mean 'ablation'"),
        (["--table", "ablation", "--evals", "nothing.json"], "no such file"),
        (["--table", "ablation", "--reported", "nothing.csv"], "the numbers printed in the paper"),
        (["--table", "ablation", "--layout", "nothing.yaml"], "the layout of the tables"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(tmp_path, capsys, arguments, message):
    base = {"--layout": LAYOUT, "--reported": REPORTED, "--out-stem": str(tmp_path / "t")}
    given = dict(zip(arguments[::2], arguments[1::2]))
    code = main(["table", *(word for pair in (base | given).items() for word in pair)])
    error = capsys.readouterr().err.strip()
    assert code == 2 and message in error and "\n" not in error
    assert not list(tmp_path.glob("t.*"))


def test_two_results_for_one_cell_are_refused(tmp_path, capsys):
    first = evaluation(tmp_path / "a", "S2", "full", "nv1024", 1024)
    second = evaluation(tmp_path / "b", "S2", "full", "nv1024", 1024)
    arguments = ["--layout", LAYOUT, "--reported", REPORTED, "--out-stem", str(tmp_path / "t")]
    assert main(["table", "--table", "ablation", "--evals", first, second, *arguments]) == 2
    assert "one result a cell" in capsys.readouterr().err


def test_tables_start_without_torch():
    code = (
        "import sys; import nbavatar.cli.table, nbavatar.cli.report, nbavatar.cli.figure; "
        "print(sorted({'torch', 'numba', 'scipy', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


HARMLESS = r"w/o $\mathcal{L}_{NB}^{2} \times 3$, 5% & more"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("label", r"x}\input{/etc/passwd}\label{y", "expected letters, digits"),
        ("row", r"$\input{/etc/passwd}$", r"a plain formula between \$ signs, found \\input"),
        ("row", r"a $x$ and $\csname input\endcsname{/etc/passwd}$", r"found \\csname"),
        ("row", "$^^5cinput{/etc/passwd}$", "a plain formula"),
        ("row", "$x$ $%\n$", "a plain formula"),
        ("row", HARMLESS, ""),
    ],
)
def test_a_layout_brings_no_commands_into_latex(tmp_path, capsys, key, value, message):
    row = {"label": value if key == "row" else "Ours", "variant": "full"}
    panel = {"protocol": "nv1024"}
    table = {"kind": "mean", "title": "T", "label": value if key == "label" else "t", "subjects": ["S2"],
             "columns": ["psnr"], "panels": [panel], "rows": [row]}  # fmt: skip
    (tmp_path / "t.yaml").write_text(json.dumps({"one": table}))
    words = ["table", "--table", "one", "--layout", str(tmp_path / "t.yaml"), "--reported", REPORTED]
    code = main([*words, "--evals", "--speeds", "--out-stem", str(tmp_path / "one")])
    assert code == (2 if message else 0)
    if message:
        assert re.search(message, capsys.readouterr().err)
    else:
        assert r"w/o $\mathcal{L}_{NB}^{2} \times 3$, 5\% \& more" in (tmp_path / "one.tex").read_text()


def test_results_bring_no_commands_into_latex(tmp_path, capsys):
    evil = evaluation(tmp_path, "S2", "full", "nv1024", 1024)
    named = tmp_path / "e\n\\immediate\\write18{id}\n.json"
    Path(evil).rename(named)
    _, markdown, latex = make(tmp_path, "novel_view_1024", [str(named)])
    assert not any(line.startswith("\\immediate") for text in (markdown, latex) for line in text.splitlines())
    content = json.loads(named.read_text()) | {"subject": r"$\input{/etc/passwd}$"}
    named.write_text(json.dumps(content))
    code = main(["table", "--table", "novel_view_1024", "--layout", LAYOUT, "--reported", REPORTED,
                 "--evals", str(named), "--speeds", "--out-stem", str(tmp_path / "o")])  # fmt: skip
    assert code == 2 and "subject: expected a name" in capsys.readouterr().err
