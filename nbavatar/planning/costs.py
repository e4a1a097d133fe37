"""What a run will cost: processor hours, memory and disk by rule, from jobs that were measured at the same image size.

The sheet of measured jobs has one row a job: `rule, of, unit, units, cpu_s, peak_mb, out_mb`. `of` is what a rule's
jobs differ by (a variant, a crop), `unit` what its work is counted in, `units` how many of them the job had. Of jobs
that were measured at two sizes the cost of another size follows by the straight line through both; of one size, it is
in proportion to the units, or fixed where the unit is `job`. Memory grows only where it was seen to, and never shrinks.
Standard library only.
"""

import csv
import dataclasses
import math
import os
from collections.abc import Iterable, Mapping, Sequence

from nbavatar.config.run import stage_options
from nbavatar.config.tradeoff import TradeoffConfig
from nbavatar.config.training import STEPS
from nbavatar.errors import DataError, parsing
from nbavatar.planning import units
from nbavatar.planning.run import Plan

__all__ = ["Cost", "Line", "Work", "cost_of", "read_costs", "workload"]

_COLUMNS = ("rule", "of", "unit", "units", "cpu_s", "peak_mb", "out_mb")
ON_GPU = ("train", "render", "evaluate", "video", "speed", "tradeoff", "savings")
"""Rules whose jobs lease a GPU where there is one."""

_HELD = ("frames", "views")  # what a job may hold all of; steps and pictures pass one by one
_GROWTH = 1.1  # of memory, from the smaller measured size to the larger one
_PICTURES_A_POINT = 2  # every timed picture of a point stands beside one at the exact setting


@dataclasses.dataclass(frozen=True)
class Line:
    """A straight line over the number of units."""

    fixed: float
    slope: float

    def at(self, count: float) -> float:
        """Its value for so many units, never negative."""
        return max(0.0, self.fixed + self.slope * count)


@dataclasses.dataclass(frozen=True)
class Cost:
    """What jobs of one kind cost.

    Attributes:
        seconds: processor time of a job [s].
        memory: peak memory of a job [MB].
        disk: size of what it writes [MB].
        sizes: numbers of units that were measured.
    """

    seconds: Line
    memory: Line
    disk: Line
    sizes: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Work:
    """Jobs of one kind that a run has: `jobs` of them, with `count` units each."""

    rule: str
    of: str
    unit: str
    jobs: int
    count: float


def read_costs(path: str | os.PathLike[str]) -> dict[tuple[str, str], Cost]:
    """Reads the sheet of measured jobs: (rule, of) -> cost.

    Raises:
        DataError: another header, or a value that is no number.
    """
    with parsing(path, "a sheet of measured jobs (.tsv)", damaged="text that does not parse"):
        with open(path, newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader((line for line in stream if not line.startswith("#")), delimiter="\t"))
    if not rows or tuple(rows[0]) != _COLUMNS:
        found = ", ".join(map(str, rows[0])) if rows else "no row"
        raise DataError.of(path, "header", expected=", ".join(_COLUMNS), found=found)
    jobs: dict[tuple[str, str], list[tuple[float, float, float, float]]] = {}
    units_of: dict[tuple[str, str], str] = {}
    for number, row in enumerate(rows, start=2):
        with parsing(path, "numbers", field=f"row {number}", damaged="others"):
            values = (float(row["units"]), float(row["cpu_s"]), float(row["peak_mb"]), float(row["out_mb"]))
        key = (row["rule"], row["of"])
        jobs.setdefault(key, []).append(values)
        units_of[key] = row["unit"]
    return {key: _cost(values, units_of[key]) for key, values in jobs.items()}


def _cost(jobs: Sequence[tuple[float, float, float, float]], unit: str) -> Cost:
    sizes = tuple(sorted({job[0] for job in jobs}))
    by_size = [[job for job in jobs if job[0] == size] for size in sizes]
    seconds, memory, disk = (
        [summary(job[column] for job in group) for group in by_size]
        for column, summary in ((1, _mean), (2, max), (3, _mean))
    )
    constant = unit == "job"
    return Cost(
        _line(sizes, seconds, constant=constant),
        # Most jobs take one picture at a time: only growth over frames that is more than noise is one.
        _line(sizes, memory, constant=unit not in _HELD or len(sizes) == 1 or memory[-1] < _GROWTH * memory[0]),
        # A model is as large after any number of steps.
        _line(sizes, disk, constant=constant or unit == "steps"),
        sizes,
    )


def _mean(values: Iterable[float]) -> float:
    found = list(values)
    return math.fsum(found) / len(found)


def _line(sizes: Sequence[float], values: Sequence[float], *, constant: bool) -> Line:
    slope = (values[-1] - values[0]) / (sizes[-1] - sizes[0]) if len(sizes) > 1 else values[0] / sizes[0]
    # A slope that noise has made negative is none.
    return Line(max(values), 0.0) if constant or slope <= 0 else Line(values[-1] - slope * sizes[-1], slope)


def cost_of(costs: Mapping[tuple[str, str], Cost], work: Work) -> Cost | None:
    """The cost of jobs of a kind; of a variant or crop that was not measured, of the first of its rule that was."""
    exact = costs.get((work.rule, work.of))
    return exact or next((cost for (rule, _), cost in costs.items() if rule == work.rule), None)


def workload(plan: Plan, frames: int, sheet: TradeoffConfig) -> list[Work]:
    """All jobs of a run on subjects of so many frames each.

    Args:
        plan: the run.
        frames: frames a subject and camera, held out ones included.
        sheet: knobs of the sweep of speed against accuracy.
    """
    run = plan.run
    held = round(run.frames.test_fraction * frames)
    films = {"driven": frames, "turntable": round(run.stages.video.fps * run.stages.video.seconds)}
    found: dict[tuple[str, str, str, float], int] = {}

    def add(rule: str, of: str, unit: str, count: float) -> None:
        key = (rule, of, unit, float(count))
        found[key] = found.get(key, 0) + 1

    for _ in units.views(plan):
        add("ingest", "", "frames", frames)
        add("masks", "", "frames", frames)
    for crop in units.crops(plan):
        add("crop", crop.crop, "frames", frames)
    for person in units.people(plan):
        cameras = len(plan.subjects[person.subject].train_cameras)
        add("tracks", "", "frames", frames)
        add("fit", "", "views", frames * cameras)
        add("spectral", "", "job", 1)
        add("deform", "", "frames", frames)
    for _ in run.reenact:
        add("reenact", "", "frames", frames)
        add("reenact_contact", "", "frames", frames)
    for avatar in (*units.avatars(plan), *units.starts(plan)):
        add("train", avatar.variant, "steps", training_steps(plan, avatar.variant))
    for row in plan.rows:
        novel = plan.holds_out_view(row.protocol)
        images = frames - held if novel else held * len(plan.subjects[row.subject].train_cameras)
        crop = run.protocols[row.protocol].crop
        add("render", row.variant, "images", images)
        add("evaluate", crop, "images", images)
    for avatar in units.timed(plan):
        add("speed", avatar.variant, "passes", speed_passes(plan))
    for video in units.videos(plan):
        add("video", "", "frames", min(films[video.kind], run.stages.video.max_frames or films[video.kind]))
    for _ in units.swept(plan, run.tradeoff.variants):
        add("tradeoff", "", "pictures", sweep_pictures(sheet))
        if "savings" in run.tradeoff.also:
            add("savings", "", "job", 1)
        if "offline" in run.tradeoff.also:
            add("offline", "", "job", 1)
    for rule, count in (("extremes", bool(run.extremes)), ("collect", 1), ("report", 1)):
        for _ in range(int(count)):
            add(rule, "", "job", 1)
    for _ in plan.tables:
        add("table", "", "job", 1)
    for _ in plan.figures:
        add("figure", "", "job", 1)
    return [Work(rule, of, unit, jobs, count) for (rule, of, unit, count), jobs in found.items()]


def training_steps(plan: Plan, variant: str) -> int:
    """Steps of a variant's training: as its options say, or as its method or schedule does by default."""
    options = stage_options(plan.run, "train", variant)
    if options["steps"]:
        return int(options["steps"])
    if options["schedule"] == "fast":
        return STEPS["fast"]
    return int(options[options["method"]].get("iterations", STEPS["paper"]))


def speed_passes(plan: Plan) -> int:
    """Passes of one timing over every stage."""
    speed = plan.run.stages.speed
    return speed.repeats + speed.warmup


def sweep_pictures(sheet: TradeoffConfig) -> int:
    """Pictures that a sweep renders, before it joins what promises most."""
    points = 1 + sum(len(values) for values in sheet.knobs.values()) + len(sheet.combinations)
    return points * (sheet.images + _PICTURES_A_POINT * (sheet.repeats + sheet.warmup))
