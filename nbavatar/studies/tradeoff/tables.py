"""Measured points as rows: a tidy csv of everything, and a markdown table to read."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from nbavatar.studies.tradeoff.front import Point, losses, pareto_front
from nbavatar.studies.tradeoff.measure import STAGES

__all__ = ["offline_markdown", "point_rows", "points_csv", "points_markdown", "rows_csv"]


def point_rows(points: Sequence[Point], presets: Mapping[str, Point], device: str) -> list[dict[str, Any]]:
    """One flat row a point: names, every knob, quality, difference, times, memory, work, presets and fronts it is on.

    Args:
        points: the exact one first.
        presets: by name.
        device: device with its threads.
    """
    exact, rows = points[0], []
    fronts = {
        name: set(pareto_front([cost(p) for p in points], [p.values["psnr"] for p in points]))
        for name, cost in (
            ("time", lambda p: p.ms),
            ("memory", lambda p: p.values["peak_memory_mb"]),
            ("bytes", lambda p: p.values["model_mb"]),
        )
    }
    for index, point in enumerate(points):
        v = point.values
        psnr, lpips = losses(point, exact)
        names = [name for name, chosen in {"accurate": exact, **presets}.items() if chosen == point]
        rows.append(
            {
                "model": point.model,
                "label": point.label,
                "presets": " ".join(names),
                "fronts": " ".join(name for name, members in fronts.items() if index in members),
                **asdict(point.setting),
                **{name: v[name] for name in ("psnr", "psnr_fg", "ssim", "lpips")},
                "psnr_lost": psnr,
                "lpips_gained": lpips,
                "diff_max": v["diff_max"],
                "diff_share": v["diff_share"],
                "psnr_apart": v["psnr_apart"],
                "lpips_apart": v["lpips_apart"],
                **{f"{stage}_ms": v["ms"][stage] for stage in (*STAGES, "total")},
                "exact_ms": v["exact_ms"],
                "steady_ms": point.ms,
                "speedup": point.speedup,
                "peak_memory_mb": v["peak_memory_mb"],
                "model_mb": v["model_mb"],
                **v["work"],
                "device": device,
            }
        )
    return rows


def points_csv(points: Sequence[Point], presets: Mapping[str, Point], device: str) -> str:
    """The rows of `point_rows` as csv; numbers in their shortest exact form, empty where there is no value."""
    return rows_csv(point_rows(points, presets, device))


def rows_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of equal keys as csv with a header."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def points_markdown(points: Sequence[Point], presets: Mapping[str, Point]) -> str:
    """A table to read, the fastest first; changes of quality are against the exact setting."""
    exact = points[0]
    head = ["setting", "preset", "ms", "raster", "U-Net", "compose", "faster", "PSNR [dB]", "change", "LPIPS", "change",
            "pixels changed", "LPIPS from exact", "memory [MB]", "avatar [MB]"]  # fmt: skip
    several = len({point.model for point in points}) > 1
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * 2 + "---:|" * (len(head) - 2)]
    for point in sorted(points, key=lambda p: (p.ms, p.label)):
        v = point.values
        psnr, lpips = losses(point, exact)
        names = ", ".join(name for name, chosen in {"accurate": exact, **presets}.items() if chosen == point)
        cells = [
            f"{point.model}: {point.label}" if several else point.label,
            names,
            f"{point.ms:.1f}",
            *(f"{v['ms'][stage]:.1f}" for stage in ("raster", "renderer", "compose")),
            f"{point.speedup:.2f}x",
            f"{v['psnr']:.2f}",
            f"{0.0 - psnr:+.3f}",
            f"{v['lpips']:.4f}",
            f"{lpips:+.4f}",
            f"{100 * v['diff_share']:.2f}%",
            f"{v['lpips_apart']:.4f}",
            f"{v['peak_memory_mb']:.0f}",
            f"{v['model_mb']:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def offline_markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of `nbavatar.studies.tradeoff.offline` as a table to read."""
    head = ["stage", "knob", "value", "time [ms]", "error [mm]", "worst [mm]", "depth left [mm]",
            "from the dataset [mm]", "faces", "what the error is"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|---|---|" + "---:|" * (len(head) - 3) + "---|"]
    for row in rows:
        numbers = [
            ("ms", ".1f"),
            ("error_mm", ".3f"),
            ("worst_mm", ".2f"),
            ("depth_mm", ".3f"),
            ("reference_mm", ".3f"),
        ]
        cells = [row["stage"], row["knob"], f"{row['value']:g}"]
        cells += ["" if row[key] is None else format(row[key], form) for key, form in numbers]
        cells += ["" if row["faces"] is None else str(row["faces"]), row["meaning"]]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
