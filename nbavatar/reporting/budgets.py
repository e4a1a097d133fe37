"""Quality against the budget of training: mean and spread over seeds, as rows, as a table and as plots."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nbavatar.config.compare import Compared
from nbavatar.reporting.curves import PALETTE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["QUALITIES", "Cell", "budget_cells", "budget_figure", "to_csv", "to_markdown"]

QUALITIES: Mapping[str, tuple[str, bool]] = {
    "psnr": ("PSNR [dB]", True),
    "ssim": ("SSIM [1]", True),
    "lpips_vgg": ("LPIPS, VGG16 [1]", False),
    "lpips_alex": ("LPIPS, AlexNet [1]", False),
    "psnr_fg": ("PSNR of the person [dB]", True),
    "ssim_fg": ("SSIM of the person [1]", True),
    "over": ("silhouette: too much [1]", False),
    "under": ("silhouette: too little [1]", False),
}
"""Figure -> axis with unit, whether more is better."""

_DIGITS = {"psnr": 2, "psnr_fg": 2}
_MARKERS = "osD^vP*Xhd"


@dataclass(frozen=True)
class Cell:
    """One variant at one budget on one subject under one protocol: figures of every seed that is there.

    Attributes:
        steps: steps that each seed made, where known.
        values: figure -> one value a seed, in the seeds' order.
    """

    subject: str
    protocol: str
    variant: str
    budget: float
    unit: str
    seeds: tuple[int, ...]
    steps: tuple[int | None, ...]
    values: Mapping[str, tuple[float, ...]]


def budget_cells(avatars: Sequence[Compared], evals: Iterable[Mapping[str, Any]]) -> tuple[list[Cell], list[str]]:
    """Sorts evaluations of a comparison.

    Args:
        avatars: all of the comparison.
        evals: results of ``nbavatar evaluate``; others than the comparison's are passed over.

    Returns:
        cells, by subject, protocol, budget and variant; and which avatars are missing, as `subject/variant/protocol`.
    """
    known = {one.name: one for one in avatars}
    found = {(e["subject"], e["protocol"]["name"], e["variant"]): e for e in evals if e["variant"] in known}
    places = sorted({key[:2] for key in found})
    cells, missing = [], []
    groups = list(dict.fromkeys((one.budget, one.unit, one.variant) for one in avatars))
    for subject, protocol in places:
        for budget, unit, variant in groups:
            there = []
            for one in avatars:
                if (one.budget, one.unit, one.variant) == (budget, unit, variant):
                    result = found.get((subject, protocol, one.name))
                    if result is None:
                        missing.append(f"{subject}/{one.name}/{protocol}")
                    else:
                        there.append((one.seed, result))
            if not there:
                continue
            values = {
                name: tuple(float(result["metrics"][name]) for _, result in there)
                for name in QUALITIES
                if all(_is_number(result["metrics"].get(name)) for _, result in there)
            }
            steps = tuple((result.get("training") or {}).get("steps") for _, result in there)
            seeds = tuple(seed for seed, _ in there)
            cells.append(Cell(subject, protocol, variant, budget, unit, seeds, steps, values))
    return cells, missing


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def to_csv(cells: Sequence[Cell]) -> str:
    """One line an avatar and protocol."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["subject", "protocol", "variant", "budget", "unit", "seed", "steps", *QUALITIES])
    for cell in cells:
        for i, seed in enumerate(cell.seeds):
            figures = [repr(cell.values[name][i]) if name in cell.values else "" for name in QUALITIES]
            steps = "" if cell.steps[i] is None else cell.steps[i]
            writer.writerow(
                [cell.subject, cell.protocol, cell.variant, f"{cell.budget:g}", cell.unit, seed, steps, *figures]
            )
    return stream.getvalue()


def to_markdown(cells: Sequence[Cell], missing: Sequence[str]) -> str:
    """A table a subject and protocol: mean over the seeds, and half of their range."""
    lines = ["# Quality against the budget of training", ""]
    lines.append(
        "Mean over the seeds ± half of the range between the best and the worst seed; without ± there was one seed. "
        "The best mean at a budget is bold. `over` and `under`: coverage too much and too little, as shares of the "
        "true area."
    )
    if missing:
        lines += ["", f"Not there yet: {len(missing)} results, " + ", ".join(f"`{name}`" for name in missing[:6])]
        lines[-1] += " ..." if len(missing) > 6 else ""
    for place in dict.fromkeys((cell.subject, cell.protocol) for cell in cells):
        own = [cell for cell in cells if (cell.subject, cell.protocol) == place]
        lines += ["", f"## {place[0]}, protocol {place[1]}", ""]
        lines.append("| budget | variant | seeds | steps | " + " | ".join(QUALITIES) + " |")
        lines.append("| --- " * (4 + len(QUALITIES)) + "|")
        for cell in own:
            rivals = [c for c in own if c.budget == cell.budget]
            figures = [_figure(cell, name, rivals) for name in QUALITIES]
            steps = [count for count in cell.steps if count is not None]
            mean = f"{sum(steps) / len(steps):.0f}" if steps else ""
            head = [f"{cell.budget:g} {cell.unit}", cell.variant, str(len(cell.seeds)), mean]
            lines.append("| " + " | ".join([*head, *figures]) + " |")
    return "\n".join(lines) + "\n"


def _figure(cell: Cell, name: str, rivals: Sequence[Cell]) -> str:
    """Mean and spread of one figure, bold where no rival's mean is better."""
    if name not in cell.values:
        return ""
    values, digits = cell.values[name], _DIGITS.get(name, 4)
    means = [sum(c.values[name]) / len(c.values[name]) for c in rivals if name in c.values]
    mean, best = sum(values) / len(values), (max if QUALITIES[name][1] else min)(means)
    text = f"{mean:.{digits}f}"
    text = f"**{text}**" if mean == best and len(means) > 1 else text
    return text + (f" ± {(max(values) - min(values)) / 2:.{digits}f}" if len(values) > 1 else "")


def budget_figure(cells: Sequence[Cell], title: str) -> "Figure":
    """One plot a figure: a line a variant through the means, a band from the worst to the best seed.

    Args:
        cells: of one subject and protocol.
        title: of the picture.
    """
    from matplotlib.figure import Figure

    shown = [name for name in QUALITIES if any(name in cell.values for cell in cells)]
    variants = list(dict.fromkeys(cell.variant for cell in cells))
    down = max(1, -(-len(shown) // 4))
    figure = Figure(figsize=(13.0, 2.9 * down + 0.7), dpi=120)
    axes = figure.subplots(down, 4, squeeze=False).ravel()
    for axis in axes[len(shown) :]:
        axis.axis("off")
    handles = []
    for axis, name in zip(axes, shown, strict=False):
        handles = []
        for number, variant in enumerate(variants):
            own = sorted((c.budget, c.values[name]) for c in cells if c.variant == variant and name in c.values)
            if not own:
                continue
            x, colour = [budget for budget, _ in own], PALETTE[number % len(PALETTE)]
            mean = [sum(values) / len(values) for _, values in own]
            (line,) = axis.plot(x, mean, color=colour, marker=_MARKERS[number % len(_MARKERS)], markersize=4, lw=1.4)
            low, high = [min(values) for _, values in own], [max(values) for _, values in own]
            axis.fill_between(x, low, high, color=colour, alpha=0.18, lw=0)
            axis.vlines(x, low, high, color=colour, lw=0.8)
            handles.append((line, variant))
        budgets = sorted({cell.budget for cell in cells})
        axis.set_xscale("log")
        axis.set_xticks(budgets, [f"{budget:g}" for budget in budgets])
        axis.minorticks_off()
        axis.set_ylabel(QUALITIES[name][0], fontsize=8)
        axis.set_xlabel({"min": "training [min]", "steps": "training [steps]"}[cells[0].unit], fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(linewidth=0.4, alpha=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    seeds = max((len(cell.seeds) for cell in cells), default=0)
    figure.suptitle(f"{title}: mean and range of {seeds} seed{'s' if seeds != 1 else ''}", fontsize=10)
    lines, names = [line for line, _ in handles], [name for _, name in handles]
    figure.legend(lines, names, loc="lower center", ncols=6, fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.06, 1, 0.97))
    return figure
