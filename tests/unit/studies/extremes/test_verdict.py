"""What makes a measurement exact, degraded, refused or a defect; the registry; the tables."""

import csv
import dataclasses
import io
import math

import numpy as np
import pytest
import torch

from nbavatar.errors import DataError
from nbavatar.reporting.extremes import extremes_markdown
from nbavatar.studies.extremes.cells import FAMILIES, Cell, Limit, Refusal, Sample, Tolerance, cells
from nbavatar.studies.extremes.compare import derivative, gradient_error, gradients, precise, relative
from nbavatar.studies.extremes.table import count_verdicts, csv_text
from nbavatar.studies.extremes.verdict import judge, measure, worst


def make(measured, *, limits=(), refuses=lambda level: False) -> Cell:
    def run(level):
        if isinstance(measured, Exception):
            raise measured
        return measured

    return Cell(
        "raster", "kernel", "condition", "x [m]", (1.0, 2.0), (1.0,), "oracle", run, Tolerance(1e-5, 1e-4), "rel. L2",
        limits, refuses,
    )  # fmt: skip


LIMIT = (Limit(lambda level: True, 1e-2, 1e-1, "few digits"),)


@pytest.mark.parametrize(
    ("outcome", "limits", "verdict", "text"),
    [
        (Sample(1e-6), (), "exact", ""),
        (Sample(1e-6, 9e-5), (), "exact", ""),
        (Sample(1e-4), (), "defect", "where none is expected"),
        (Sample(1e-6, 1e-3), (), "defect", "where none is expected"),
        (Sample(1e-4), LIMIT, "degrades", "few digits"),
        (Sample(1e-6, 1e-3), LIMIT, "degrades", "few digits"),
        (Sample(1.0), LIMIT, "defect", "beyond its bound"),
        (Sample(1e-6, 1.0), LIMIT, "defect", "beyond its bound"),
        (Sample(math.nan), LIMIT, "defect", "not finite"),
        (Sample(math.inf), LIMIT, "defect", "not finite"),
        (Sample(0.0, math.nan), LIMIT, "defect", "gradient is not finite"),
        (Refusal("no point"), (), "defect", "refused without need"),
        (DataError("wrong"), (), "defect", "refused without need"),
        (ZeroDivisionError("division by zero"), (), "defect", "crash: ZeroDivisionError: division by zero"),
    ],
)
def test_judges(outcome, limits, verdict, text):
    found, message = judge(make(None, limits=limits), 1.0, outcome)
    assert found == verdict
    assert text in message


@pytest.mark.parametrize(
    ("outcome", "verdict"),
    [
        (Refusal("no point"), "refuses"),
        (DataError("depth: expected a number, found NaN"), "refuses"),
        (Refusal("two\nlines"), "defect"),
        (ValueError(""), "defect"),
        (KeyError("x"), "defect"),  # an accident, even where a refusal is right
    ],
)
def test_refusals_have_one_line(outcome, verdict):
    assert judge(make(None, refuses=lambda level: True), 1.0, outcome)[0] == verdict


def test_measures_and_survives_a_crash():
    row = measure(make(IndexError("out of range")), 2.0)
    assert (row.verdict, row.forward, row.gradient) == ("defect", None, None)
    row = measure(make(Sample(1e-3, 1e-6), limits=LIMIT), 2.0)
    assert (row.verdict, row.forward, row.forward_bound, row.gradient_bound) == ("degrades", 1e-3, 1e-2, 1e-1)
    assert worst([row, measure(make(Sample(0.0)), 1.0)]) == "degrades"


def test_registry_is_sound():
    found = cells()
    assert {one.family for one in found} == set(FAMILIES)
    assert len({one.name for one in found}) == len(found)
    for one in found:
        assert len(set(one.levels)) == len(one.levels), one.name
        assert set(one.quick) <= set(one.levels), one.name
        assert "[" in one.axis or all(isinstance(level, str) for level in one.levels), one.name


def test_tables_hold_every_measurement():
    rows = [measure(make(Sample(1e-3, 1e-6), limits=LIMIT), level) for level in (1.0, 2.0)]
    lines = list(csv.DictReader(io.StringIO(csv_text(rows))))
    assert [float(line["level"]) for line in lines] == [1.0, 2.0]
    assert float(lines[0]["forward"]) == 1e-3
    assert count_verdicts(rows) == {"exact": 0, "degrades": 2, "refuses": 0, "defect": 0}
    text = extremes_markdown([dataclasses.asdict(row) for row in rows])
    assert "| kernel | condition | x [m]: 1, 2 | degrades | 1.0e-03 | 1.0e-06 | 1, 2: few digits |" in text


def test_relative_errors():
    assert relative([3.0, 4.0], [3.0, 4.0]) == 0.0
    assert relative([3.0, 4.0], [0.0, 0.0]) == 5.0
    assert relative([0.0, 1.0], [0.0, 2.0]) == 0.5
    assert relative([1e-300], [2e-300]) == pytest.approx(0.5)  # squares would vanish
    assert relative([1e300, 0.0], [2e300, 0.0]) == pytest.approx(0.5)
    assert relative([1.1], [1.0], least=10.0) == pytest.approx(0.01)
    assert relative([math.inf, math.nan], [math.inf, math.nan]) == 0.0
    assert math.isnan(relative([math.nan], [1.0]))
    assert math.isnan(relative([1.0], [math.inf]))
    assert math.isnan(relative([1.0, 2.0], [1.0]))


def test_gradients_of_all_inputs():
    x, y, z = torch.tensor([2.0, 3.0]), torch.tensor(4.0), torch.tensor(1.0)
    value, found = gradients(lambda a, b, c: (a * a).sum() * b, [x, y, z])
    assert float(value) == 52.0
    assert [tensor.tolist() for tensor in found] == [[16.0, 24.0], 13.0, 0.0]
    assert math.isnan(gradient_error([torch.tensor(math.nan)], [1.0]))


def test_derivative_in_many_digits():
    import mpmath

    with mpmath.workdps(60):
        at = precise(np.array([0.3, 2.0]))
        found = derivative(lambda v: mpmath.sin(v[0]) * v[1] ** 3, at)
    np.testing.assert_allclose(found, [8 * math.cos(0.3), 12 * math.sin(0.3)], rtol=1e-15)
