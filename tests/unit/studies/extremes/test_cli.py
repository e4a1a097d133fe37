"""The command: its files, and what it refuses."""

import json

from nbavatar.cli import main


def test_writes_tables_pictures_and_record(tmp_path, capsys):
    out = tmp_path / "extremes"
    arguments = ["extremes", "--out", str(out), "--families", "rotations", "image", "--quick", "--strict"]
    assert main(arguments) == 0
    names = {"table.csv", "table.md", "heatmap.png", "heatmap.pdf", "curves.png", "curves.pdf", "record.json"}
    assert {path.name for path in out.iterdir()} == names
    record = json.loads((out / "record.json").read_text())
    assert record["totals"]["defect"] == 0
    assert sum(record["totals"].values()) == len(record["rows"])
    assert {row["family"] for row in record["rows"]} == {"rotations", "image"}
    assert record["record"]["command"] == "extremes"
    assert (out / "heatmap.png").read_bytes()[:4] == b"\x89PNG"
    assert "0 defect" in capsys.readouterr().out


def test_refuses_an_unknown_family(tmp_path, capsys):
    assert main(["extremes", "--out", str(tmp_path / "x"), "--families", "rasters"]) == 2
    assert "did you mean 'raster'?" in capsys.readouterr().err
