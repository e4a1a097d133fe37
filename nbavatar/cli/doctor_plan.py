"""What the paper's run will cost, for `nbavatar doctor --plan`: hours, memory and disk by rule, and smaller budgets."""

import argparse
import contextlib
import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nbavatar.cli.run import pipeline_folder
from nbavatar.config.core import merge
from nbavatar.config.tradeoff import read_sheet
from nbavatar.config.yamlfiles import read_yaml
from nbavatar.errors import ConfigError
from nbavatar.planning.costs import ON_GPU, Work, cost_of, read_costs, workload
from nbavatar.planning.run import Plan, read_plan
from nbavatar.planning.units import views

__all__ = ["add_plan_arguments", "plan_costs", "plan_lines"]

_FRAMES = 1630  # 400,000 steps are called 35 epochs over seven cameras
_GPU_MS = 29.0  # 1.3 + 27.7 ms, the paper's printed times of a picture in float32 on its RTX 4090
_NATIVE = (1920, 1080)  # pictures of the release [px]
_SHARED = ("ingest", "masks", "crop", "tracks", "fit", "spectral", "deform")
_BUDGETS: tuple[tuple[str, dict[str, Any], str], ...] = (
    ("a tenth of the steps", {"share": 0.1}, "converged textures: every number, by an amount that nobody has measured"),
    ("S2 alone", {"only": ["S2"]}, "means over subjects, cross-reenactment, and the rows of S1, S3 and S4"),
    ("our method alone", {"without": "avatar"}, "the other methods: rows SA, GA and after IA"),
    ("no ablations, no channels", {"keep": ("full", "full512", "gaussian_avatars", "interact_avatar",
     "interact_avatar512", "splatting_avatar", "splatting_avatar_released")},
     "tables ablation and channels but for their full method"),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _Planned:
    """Jobs of one rule together: hours of a core, hours on the GPU, most memory of a job [MB], disk [MB].

    `one_size` where the jobs work on frames and were measured for one number of them: memory may grow unseen.
    """

    rule: str
    jobs: int
    core_hours: float
    gpu_hours: float
    memory: float
    disk: float
    unmeasured: bool
    one_size: bool


def add_plan_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of the plan."""
    parser.add_argument("--frames", type=int, default=_FRAMES, metavar="N", help="plan: frames of a subject in each "
                        f"camera, held out ones included (default {_FRAMES})")  # fmt: skip
    parser.add_argument("--gpu-ms", type=float, default=_GPU_MS, metavar="MS", help="plan: time of one 1024 px picture "
                        "in float32 on the GPU, as `nbavatar speed` measures it (total_fp32); default: the paper's "
                        f"RTX 4090, {_GPU_MS:g} ms")  # fmt: skip


def plan_costs(frames: int, gpu_ms: float, cores: int) -> dict[str, Any]:
    """The plan as plain values: `rules`, `total`, `budgets`, and what was assumed."""
    for name, value in (("--frames", frames), ("--gpu-ms", gpu_ms)):
        if not value > 0:
            raise ConfigError.of(name, expected="more than 0", found=value)
    source = pipeline_folder()
    with contextlib.chdir(os.curdir if Path("config/paper.yaml").is_file() else source):
        mapping = read_yaml("config/paper.yaml", "a run")
        sheet = read_sheet(read_yaml("config/tradeoff.yaml", "a sheet of knobs"), "config/tradeoff.yaml")
        costs = read_costs(source / "config" / "costs.tsv")
        picture = costs[("render", "full")].seconds.slope
        faster = picture / (gpu_ms / 1000.0)

        def planned(change: dict[str, Any]) -> list[_Planned]:
            plan = read_plan(merge(mapping, {"only": change.get("only", [])}))
            kept = change.get("keep") or [n for n in plan.run.variants if change.get("without", "*") not in n]
            plan = dataclasses.replace(plan, rows=[row for row in plan.rows if row.variant in kept])
            return [_sum(rule, works, costs, faster) for rule, works in _by_rule(workload(plan, frames, sheet))]

        rules = planned({})
        budgets = []
        for name, change, lost in _BUDGETS:
            parts, share = planned(change), change.get("share", 1.0)
            budgets.append({"name": name, "gives_up": lost} | _total(parts, cores, train_share=share))
        plan = read_plan(mapping)
        raw = _raw_gb(plan, frames)
        trained = len({(row.subject, row.variant) for row in plan.rows})
        people = len({row.subject for row in plan.rows})
    total = _total(rules, cores)
    once = sum(part.core_hours for part in rules if part.rule in _SHARED)
    return {
        "frames": frames,
        "gpu_ms": gpu_ms,
        "gpu_faster": round(faster, 1),
        "cores": cores,
        "rules": [dataclasses.asdict(part) for part in rules],
        "total": total,
        "unshared_core_hours": round(once * trained / people - once, 1),
        "budgets": budgets,
        "disk_at_most_gb": round(raw, 1),
        "largest_memory_mb": max(part.memory for part in rules),
    }


def _raw_gb(plan: Plan, frames: int) -> float:
    """Disk that no footage exceeds: colours and mattes, or colours, labels and coverage of crops, uncompressed [GB]."""
    sides = [crop.size or max(_NATIVE) for crop in plan.run.crops.values()]
    a_frame = 4 * _NATIVE[0] * _NATIVE[1] + sum(5 * side * side for side in sides)
    return len(views(plan)) * frames * a_frame / 1e9


def _by_rule(works: Sequence[Work]) -> list[tuple[str, list[Work]]]:
    found: dict[str, list[Work]] = {}
    for work in works:
        found.setdefault(work.rule, []).append(work)
    return list(found.items())


def _sum(rule: str, works: Sequence[Work], costs: Any, faster: float) -> _Planned:
    seconds = memory = disk = 0.0
    unmeasured = one_size = False
    for work in works:
        cost = cost_of(costs, work)
        if cost is None:
            unmeasured = True
            continue
        seconds += work.jobs * cost.seconds.at(work.count)
        memory = max(memory, cost.memory.at(work.count))
        one_size |= work.unit in ("frames", "views") and len(cost.sizes) == 1
        disk += work.jobs * cost.disk.at(work.count)
    hours = seconds / 3600.0
    jobs = sum(work.jobs for work in works)
    return _Planned(rule, jobs, hours, hours / faster if rule in ON_GPU else hours, memory, disk, unmeasured, one_size)


def _total(parts: Sequence[_Planned], cores: int, *, train_share: float = 1.0) -> dict[str, float]:
    def hours(gpu: bool) -> tuple[float, float]:
        """Of rules that lease a GPU, and of the others."""
        found = [0.0, 0.0]
        for part in parts:
            share = train_share if part.rule == "train" else 1.0
            found[part.rule not in ON_GPU] += share * (part.gpu_hours if gpu else part.core_hours)
        return found[0], found[1]

    here, there = hours(False), hours(True)
    return {
        "hours_here": round(sum(here) / cores, 1),
        "hours_gpu": round(there[0] + there[1] / cores, 1),
        "disk_gb": round(sum(part.disk for part in parts) / 1000.0, 1),
    }


def plan_lines(found: dict[str, Any]) -> list[str]:
    """The plan as text."""
    cores, total = found["cores"], found["total"]
    lines = [
        f"plan       config/paper.yaml, {found['frames']:,} frames a camera; from jobs measured at the same image size",
        f"           here: {cores} cores, by processor time; GPU: one picture in {found['gpu_ms']:g} ms, so "
        f"{found['gpu_faster']:g} times one core, for {', '.join(ON_GPU)}",
        f"{'rule':<16}{'jobs':>5}{'hours here':>13}{'hours GPU':>12}{'memory a job':>15}{'disk':>11}",
    ]
    for part in found["rules"]:
        hours = (
            f"{part['core_hours'] / cores:,.1f}",
            f"{part['gpu_hours'] / (1 if part['rule'] in ON_GPU else cores):,.1f}",
        )
        memory, disk = (
            f"{part['memory'] / 1000:.1f} GB{'*' if part['one_size'] else ''}",
            f"{part['disk'] / 1000:,.1f} GB",
        )
        words = ("not measured", "", "", "") if part["unmeasured"] else (*hours, memory, disk)
        line = f"{part['rule']:<16}{part['jobs']:>5}{words[0]:>13}{words[1]:>12}{words[2]:>15}{words[3]:>11}"
        lines.append(line.rstrip())
    lines += [
        f"all        {total['hours_here']:,} hours here, {total['hours_gpu']:,} with the GPU, {total['disk_gb']:,} GB "
        f"of disk, at most {found['largest_memory_mb'] / 1000:.1f} GB of memory a job",
        "           * measured for one number of frames: memory for more may be larger",
        f"           disk is that of synthetic pictures, which compress well; noisy footage takes up to "
        f"{found['disk_at_most_gb']:,} GB in frame packs",
        f"shared     stages before training are made once a subject; once a variant they would take "
        f"{found['unshared_core_hours'] / cores:,.1f} hours more",
    ]
    lines += [
        f"smaller    {one['name']}: {one['hours_here']:,} hours here, {one['hours_gpu']:,} with the GPU, "
        f"{one['disk_gb']:,} GB; gives up {one['gives_up']}"
        for one in found["budgets"]
    ]
    return lines
