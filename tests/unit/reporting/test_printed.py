"""The sheet of printed numbers: complete, and consistent where the paper is."""

from decimal import Decimal
from pathlib import Path

import pandas as pd
import pytest

from nbavatar.config.tables import read_tables
from nbavatar.errors import DataError
from nbavatar.reporting.printed import deviating_marks, deviating_means, read_printed, recomputed_mean
from nbavatar.reporting.ranks import rank_marks

ROOT = Path(__file__).parents[3]
GRIDS = ("novel_view_1024", "self_reenactment_1024")
SUBJECTS = ("S1", "S2", "S3", "S4")


@pytest.fixture(scope="module")
def cells():
    path = ROOT / "config/reported.csv"
    return read_printed(path.read_text(encoding="utf-8").splitlines(), str(path))


def test_every_printed_number_is_there(cells):
    assert cells["table"].value_counts().to_dict() == {
        "novel_view_1024": 3 * 5 * 3,
        "self_reenactment_1024": 3 * 5 * 3,
        "interactavatar_512_novel_view": 6,
        "interactavatar_512_self_reenactment": 6,
        "ablation": 12,
        "channels": 16,
        "speed": 10,
        "cameras": 8,
    }


def test_checksums_of_the_printed_tables(cells):
    # Sums of all PSNR, SSIM and LPIPS cells, added up by hand from the paper's LaTeX source.
    def total(table, metric):
        return sum(map(Decimal, cells["value"][(cells["table"] == table) & cells["column"].str.endswith(metric)]))

    assert total("novel_view_1024", "psnr") == Decimal("380.63")
    assert total("self_reenactment_1024", "psnr") == Decimal("381.72")
    assert total("ablation", "ssim") == Decimal("3.8874")
    assert total("channels", "fps") == 113
    assert total("speed", "ms") == Decimal("67.4")


@pytest.mark.parametrize("table", GRIDS)
def test_recomputed_means_reproduce_the_printed_ones(cells, table):
    assert deviating_means(cells, table, SUBJECTS) == []
    texts = cells.set_index(["table", "row", "column"])["value"]
    mean = recomputed_mean([texts["novel_view_1024", "SA", f"{s}.psnr"] for s in SUBJECTS])
    assert mean == Decimal("25.1675") and texts["novel_view_1024", "SA", "mean.psnr"] == "25.17"


def test_recomputed_marks_reproduce_the_printed_ones_but_for_ties(cells):
    assert deviating_marks(cells, "novel_view_1024", second=True) == []
    # Equal digits, of which the paper underlines one: GA's .974 and .066, and not SA's.
    assert deviating_marks(cells, "self_reenactment_1024", second=True) == [
        ("SA", "S1.ssim", "", "second"),
        ("SA", "mean.lpips", "", "second"),
    ]
    for table in ("interactavatar_512_novel_view", "interactavatar_512_self_reenactment", "ablation"):
        assert deviating_marks(cells, table, second=False) == []


def test_a_wrong_mean_and_a_wrong_mark_are_found(cells):
    changed = cells.set_index(["table", "row", "column"])
    changed.loc[("novel_view_1024", "GA", "mean.psnr"), ["value", "mark"]] = "25.32", "best"
    changed = changed.reset_index()
    assert deviating_means(changed, "novel_view_1024", SUBJECTS) == [("GA", "psnr", "25.32", Decimal("25.3075"))]
    assert deviating_marks(changed, "novel_view_1024", second=True) == [("GA", "mean.psnr", "best", "second")]


def test_cells_that_the_layout_asks_for_exist(cells):
    for name, table in read_tables(ROOT / "config/tables.yaml").items():
        for panel in table.panels:
            own = cells[cells["table"] == panel.reported]
            wanted = {row.reported_id for row in table.rows if row.reported_id and panel.reported}
            assert set(own["row"]) == wanted, name
            columns = {column.rpartition(".")[2] for column in own["column"]}
            assert columns == set(table.columns) or not panel.reported, name


@pytest.mark.parametrize(
    ("texts", "higher", "second", "marks"),
    [
        (["1.0", "2.0", "3.0"], True, True, ["", "second", "best"]),
        (["1.0", "2.0", "3.0"], False, True, ["best", "second", ""]),
        (["2.0", "2.00", "1.0"], True, True, ["best", "best", ""]),
        (["3.0", "2.0", "2.0"], True, True, ["best", "second", "second"]),
        (["1.0", "—", "3.0"], True, True, ["second", "", "best"]),
        (["—", "—", "3.0"], True, True, ["", "", ""]),
        (["1.0", "2.0"], True, False, ["", "best"]),
        (["nan", "inf", "1.0"], True, True, ["", "", ""]),
    ],
)
def test_rank_marks(texts, higher, second, marks):
    assert list(rank_marks(pd.Series(texts), higher_is_better=higher, second=second)) == marks


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["table,row,column,value,mark"], "expected table, row, column, value, mark, note"),
        (["table,row,column,value,mark,note", "t,r,c,1,bold,"], "mark best, second or nothing, found 'bold'"),
        (["table,row,column,value,mark,note", "t,r,c,1,,", "t,r,c,2,,"], "each cell once"),
    ],
)
def test_damaged_sheet_is_one_clear_line(lines, message):
    with pytest.raises(DataError, match=message):
        read_printed(lines, "reported.csv")
