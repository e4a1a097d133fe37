"""Quality against cost: which variants are worth their time, memory and bytes.

A variant is on the front of a plot if no other is at least as good and at least as cheap, and better in one of the two.
Timings belong to the device that the caption names; they are compared among themselves only.
"""

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nbavatar.reporting.curves import PALETTE, legend_columns, ticks, widened

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COSTS", "QUALITIES", "Measured", "measured_variants", "pareto_figure", "pareto_front", "scatter_chart"]

# Key -> axis with unit.
COSTS: Mapping[str, str] = {
    "ms": "time of one picture [ms]",
    "peak_memory_mb": "peak memory [MB]",
    "model_mb": "model file [MB]",
}
# Key -> axis with unit, whether more is better.
QUALITIES: Mapping[str, tuple[str, bool]] = {
    "psnr": ("PSNR [dB]", True),
    "ssim": ("SSIM [1]", True),
    "lpips_alex": ("LPIPS, AlexNet [1]", False),
    "lpips_vgg": ("LPIPS, VGG16 [1]", False),
}
_MARKERS = "osD^vP*Xhd"
_WIDTH, _HEIGHT, _LEFT, _RIGHT, _TOP, _BOTTOM = 420, 280, 62, 14, 30, 44


@dataclass(frozen=True)
class Measured:
    """One variant: its mean quality over the subjects that have it, and its cost."""

    variant: str
    quality: Mapping[str, float]
    cost: Mapping[str, float]


def measured_variants(
    evals: Iterable[Mapping[str, Any]], speeds: Iterable[tuple[str, Mapping[str, Any]]], protocol: str
) -> list[Measured]:
    """Variants with both an evaluation under a protocol and a timing, in the order of the timings.

    Quality is the mean over the subjects that every such variant was evaluated on, so that none is judged on easier
    ones; if they share none, over whatever each has.

    Args:
        evals: results of ``nbavatar evaluate``.
        speeds: (variant, result of ``nbavatar speed``).
        protocol: name of the protocol.
    """
    quality: dict[str, dict[str, Mapping[str, Any]]] = {}
    for result in evals:
        if result["protocol"]["name"] == protocol:
            quality.setdefault(str(result["variant"]), {})[str(result["subject"])] = result["metrics"]
    costs: dict[str, dict[str, float]] = {}
    for variant, result in speeds:
        speed = result["speed"]
        found = {"ms": speed["ms"].get("total_fp32")} | {key: speed.get(key) for key in COSTS if key != "ms"}
        costs.setdefault(variant, {key: float(value) for key, value in found.items() if value})
    known = [variant for variant in costs if variant in quality]
    shared = set.intersection(*(set(quality[variant]) for variant in known)) if known else set()
    measured = []
    for variant in known:
        subjects = [s for s in quality[variant] if s in shared or not shared]
        means = {}
        for key in QUALITIES:
            values = [quality[variant][s].get(key) for s in subjects]
            if values and all(value is not None for value in values):
                means[key] = sum(float(value) for value in values if value is not None) / len(values)
        measured.append(Measured(variant, means, costs[variant]))
    return measured


def pareto_front(points: Sequence[tuple[float, float]], *, higher_is_better: bool) -> list[int]:
    """Indices of the points (cost, quality) that no other beats, by rising cost; of equal points all."""

    def beaten(a: tuple[float, float], b: tuple[float, float]) -> bool:
        gain = (b[1] - a[1]) * (1 if higher_is_better else -1)
        return b[0] <= a[0] and gain >= 0 and (b[0] < a[0] or gain > 0)

    kept = [i for i, own in enumerate(points) if not any(beaten(own, other) for other in points)]
    return sorted(kept, key=lambda i: points[i])


def _panels(measured: Sequence[Measured]) -> list[tuple[str, str, list[tuple[str, float, float]], list[int]]]:
    """(cost, quality, named points, front) of every plot that has a point."""
    panels = []
    for quality, (_, higher) in QUALITIES.items():
        for cost in COSTS:
            named = [
                (m.variant, m.cost[cost], m.quality[quality])
                for m in measured
                if cost in m.cost and quality in m.quality
            ]
            if named:
                front = pareto_front([(x, y) for _, x, y in named], higher_is_better=higher)
                panels.append((cost, quality, named, front))
    return panels


def pareto_figure(measured: Sequence[Measured]) -> "Figure":
    """One row of plots a metric, one column a cost; the line joins the front. Colour and shape tell variants apart."""
    from matplotlib.figure import Figure

    panels = _panels(measured)
    across = max(1, len({cost for cost, *_ in panels}))
    down = max(1, -(-len(panels) // across))
    names = [m.variant for m in measured]
    foot = 0.2 * max(1, -(-len(names) // 6)) + 0.15
    width, height = 3.3 * across, 2.5 * down + foot
    figure = Figure(figsize=(width, height), dpi=150)
    axes = figure.subplots(down, across, squeeze=False).ravel()
    figure.subplots_adjust(
        left=0.75 / width, right=1 - 0.12 / width, top=1 - 0.12 / height, bottom=(foot + 0.5) / height,
        wspace=0.85 / 2.45, hspace=0.62 / 1.88,
    )  # fmt: skip
    for axis in axes[len(panels) :]:
        axis.axis("off")
    for axis, (cost, quality, named, front) in zip(axes, panels, strict=False):
        axis.plot([named[i][1] for i in front], [named[i][2] for i in front], color="#999999", linewidth=1, zorder=1)
        for variant, x, y in named:
            number = names.index(variant)
            axis.scatter(
                [x], [y], color=PALETTE[number % len(PALETTE)], marker=_MARKERS[number % len(_MARKERS)], s=28, zorder=2
            )
        axis.set_xlabel(COSTS[cost], fontsize=8)
        axis.set_ylabel(QUALITIES[quality][0], fontsize=8)
        axis.tick_params(which="both", labelsize=7)
        axis.grid(linewidth=0.4, alpha=0.6)
        axis.margins(0.12)
        axis.spines[["top", "right"]].set_visible(False)
    if panels:
        from matplotlib.lines import Line2D

        handles = [
            Line2D([], [], linestyle="", color=PALETTE[i % len(PALETTE)], marker=_MARKERS[i % len(_MARKERS)])
            for i in range(len(names))
        ]
        figure.legend(handles, names, loc="lower center", ncols=min(6, len(names)), fontsize=7, frameon=False)
    return figure


def scatter_chart(measured: Sequence[Measured], cost: str, quality: str) -> str:
    """One plot as an ``<svg>`` element that follows the page's colours; empty text if nothing has both."""
    label, higher = QUALITIES[quality]
    named = [(m.variant, m.cost[cost], m.quality[quality]) for m in measured if cost in m.cost and quality in m.quality]
    if not named:
        return ""
    front = pareto_front([(x, y) for _, x, y in named], higher_is_better=higher)
    x_range = _padded([x for _, x, _ in named])
    y_range = _padded([y for *_, y in named])
    columns = legend_columns([f"{len(named)} {variant}" for variant, *_ in named], 4, 12)
    rows = -(-len(named) // columns)
    bottom = _HEIGHT - _BOTTOM

    def place(x: float, y: float) -> tuple[float, float]:
        across, up = (x - x_range[0]) / (x_range[1] - x_range[0]), (y - y_range[0]) / (y_range[1] - y_range[0])
        return _LEFT + across * (_WIDTH - _LEFT - _RIGHT), bottom - up * (bottom - _TOP)

    title = html.escape(f"{label.partition(' [')[0]} over {COSTS[cost].partition(' [')[0]}")
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT + 16 * rows}" role="img" aria-label="{title}"><title>{title}</title>',
        f'<text class="head" x="{_LEFT}" y="18">{title}</text>',
    ]
    for tick, name in ticks(*y_range, False):
        y = place(x_range[0], tick)[1]
        parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{name}</text>')
    for tick, name in ticks(*x_range, False):
        x = place(tick, y_range[0])[0]
        parts.append(f'<path class="grid" d="M{x:.1f} {_TOP}V{bottom}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{name}</text>')
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{bottom + 34}" text-anchor="middle">{html.escape(COSTS[cost])}</text>')
    parts.append(
        f'<text transform="translate(14 {(_TOP + bottom) / 2}) rotate(-90)" text-anchor="middle">'
        f"{html.escape(label)}</text>"
    )
    path = "L".join("{:.1f} {:.1f}".format(*place(*named[i][1:])) for i in front)
    parts.append(f'<path class="front" d="M{path}"/>')
    for number, (variant, x, y) in enumerate(named):
        colour = PALETTE[number % len(PALETTE)]
        px, py = place(x, y)
        name = html.escape(variant)
        # The number beside a dot and in the legend tells variants apart without colours.
        parts.append(
            f'<circle cx="{px:.1f}" cy="{py:.1f}" r="4" fill="{colour}">'
            f"<title>{name}: {x:.4g}, {y:.4g}</title></circle>"
        )
        right = px < _WIDTH - _RIGHT - 24
        anchor = "start" if right else "end"
        parts.append(
            f'<text x="{px + (6 if right else -6):.1f}" y="{py - 5:.1f}" text-anchor="{anchor}">{number + 1}</text>'
        )
        lx, ly = 8 + (number % columns) * (_WIDTH - 8) / columns, _HEIGHT + 4 + 16 * (number // columns)
        parts.append(f'<circle cx="{lx + 4:.0f}" cy="{ly - 4}" r="4" fill="{colour}"/>')
        parts.append(f'<text x="{lx + 12:.0f}" y="{ly}">{number + 1} {name}</text>')
    return "\n".join([*parts, "</svg>"])


def _padded(values: Sequence[float]) -> tuple[float, float]:
    low, high = widened(min(values), max(values))
    margin = 0.08 * (high - low)
    return low - margin, high + margin
