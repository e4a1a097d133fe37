"""Line charts as SVG text: training curves that follow the page's colours and need no plotting library."""

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

__all__ = ["PALETTE", "Curve", "legend_columns", "line_chart", "thin", "ticks", "training_curves", "widened"]

# Okabe and Ito's palette, distinguishable with every kind of colour vision; dashes tell series apart beyond its length.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8A7F00")
_DASHES = ("", "6 3", "2 3", "8 3 2 3")
_WIDTH, _HEIGHT = 420, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 12, 30, 44

Series = Mapping[str, Sequence[tuple[float, float]]]
_NOT_CURVES = {"step", "progress", "skipped", "seconds"}
# Logged quantity -> title, vertical axis with unit, logarithmic.
_TITLES = {
    "psnr": ("PSNR on the training view", "PSNR [dB]", False),
    "loss": ("Total loss", "loss [1]", True),
    "total": ("Total loss", "loss [1]", True),
    "mse": ("Mean squared error", "MSE [1]", True),
    "lpips": ("LPIPS term", "LPIPS [1]", True),
    "nb": ("Dice of the billboard silhouette", "1 - Dice [1]", True),
    "knn": ("Neighbour regulariser", "loss [1]", True),
    "delta": ("Offset regulariser", "loss [1]", True),
    "refine": ("Pose refinement penalty", "loss [1]", True),
    "l1": ("Mean absolute error", "L1 [1]", True),
    "dssim": ("Structural dissimilarity", "1 - SSIM [1]", True),
    "position": ("Offsets beyond their bound", "loss [1]", False),
    "scale": ("Sizes beyond their bound", "loss [1]", False),
    "rate": ("Learning-rate factor", "factor [1]", True),
    "rate_factor": ("Learning-rate factor", "factor [1]", True),
    "shrink": ("Resolution divisor", "divisor [1]", False),
    "steps_per_second": ("Training speed", "steps per second [1/s]", False),
}


@dataclass(frozen=True)
class Curve:
    """One quantity over the training steps, one series an avatar."""

    title: str
    y_label: str
    log_y: bool
    series: Series


def training_curves(histories: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Curve]:
    """Curves of every logged quantity, the known ones first.

    Args:
        histories: avatar -> logged lines, each with ``step`` and numbers; a quantity need not be in every line.
    """
    names = {
        name: None
        for events in histories.values()
        for event in events
        for name, value in event.items()
        if name not in _NOT_CURVES and _is_number(value)
    }
    order = [name for name in _TITLES if name in names] + sorted(set(names) - set(_TITLES))
    curves = []
    for name in order:
        title, y_label, log_y = _TITLES.get(name, (name, f"{name} [1]", False))
        series = {
            avatar: thin(
                [(float(e["step"]), float(e[name])) for e in events if _is_number(e.get(name)) and "step" in e]
            )
            for avatar, events in histories.items()
        }
        if name == "shrink" and len({y for points in series.values() for _, y in points}) == 1:
            continue  # one resolution throughout: nothing to see
        curves.append(Curve(title, y_label, log_y, series))
    return curves


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def thin(points: Sequence[tuple[float, float]], count: int = 200) -> list[tuple[float, float]]:
    """At most ``count`` points, each the mean of the points it stands for."""
    if len(points) <= count:
        return list(points)
    edges = [round(i * len(points) / count) for i in range(count + 1)]
    groups = [points[a:b] for a, b in zip(edges, edges[1:]) if b > a]
    return [(sum(x for x, _ in g) / len(g), sum(y for _, y in g) / len(g)) for g in groups]


def line_chart(title: str, series: Series, *, x_label: str, y_label: str, log_y: bool = False) -> str:
    """One chart with a legend.

    Args:
        title: what is shown.
        series: name -> points (x, y); values that cannot be drawn (not finite, or <= 0 on a log axis) are left out.
        x_label: horizontal axis, with its unit.
        y_label: vertical axis, with its unit.
        log_y: logarithmic vertical axis.

    Returns:
        An ``<svg>`` element, or an empty text if nothing can be drawn.
    """
    drawn = {name: _drawable(points, log_y) for name, points in series.items()}
    drawn = {name: points for name, points in drawn.items() if points}
    if not drawn:
        return ""
    xs = [x for points in drawn.values() for x, _ in points]
    ys = [y for points in drawn.values() for _, y in points]
    x_range = widened(min(xs), max(xs))
    y_range = widened(min(ys), max(ys))
    columns = legend_columns(drawn, 3, 25)
    rows = math.ceil(len(drawn) / columns)
    height = _HEIGHT + 16 * rows
    bottom = _HEIGHT - _BOTTOM

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - x_range[0]) / (x_range[1] - x_range[0])
        up = (y - y_range[0]) / (y_range[1] - y_range[0])
        return _LEFT + across * (_WIDTH - _LEFT - _RIGHT), bottom - up * (bottom - _TOP)

    text = html.escape(title)
    spoken = html.escape(f"{title}: {y_label} over {x_label}")
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{spoken}">',
        f"<title>{text}</title>",
        f'<text class="head" x="{_LEFT}" y="18">{text}</text>',
    ]
    for tick, name in ticks(*y_range, log_y):
        _, y = place(x_range[0], tick)
        parts.append(f'<path class="grid" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{name}</text>')
    for tick, name in ticks(*x_range, False):
        x, _ = place(tick, y_range[0])
        parts.append(f'<path class="grid" d="M{x:.1f} {_TOP}V{bottom}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{name}</text>')
    parts.append(f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{bottom + 34}" text-anchor="middle">{x_label}</text>')
    middle = (_TOP + bottom) / 2
    parts.append(
        f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">{html.escape(y_label)}</text>'
    )
    for number, (name, points) in enumerate(drawn.items()):
        colour = PALETTE[number % len(PALETTE)]
        dash = _DASHES[number // len(PALETTE) % len(_DASHES)]
        style = f'stroke="{colour}"' + (f' stroke-dasharray="{dash}"' if dash else "")
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in (place(*point) for point in points))
        if len(points) == 1:
            x, y = place(*points[0])
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>')
        parts.append(f'<path class="line" {style} d="M{path}"><title>{html.escape(name)}</title></path>')
        x0, y0 = 8 + (number % columns) * (_WIDTH - 8) / columns, _HEIGHT + 4 + 16 * (number // columns)
        parts.append(f'<path class="line" {style} d="M{x0:.0f} {y0 - 4}h20"/>')
        parts.append(f'<text x="{x0 + 25:.0f}" y="{y0}">{html.escape(name)}</text>')
    return "\n".join([*parts, "</svg>"])


def legend_columns(names: Iterable[str], most: int, mark: int) -> int:
    """Columns of a legend in which the longest name fits beside a mark of a width [px]; at most ``most``."""
    # A letter of a sans-serif face of 11 px takes 6 px on average.
    longest = max((len(name) for name in names), default=0)
    return max(1, min(most, int((_WIDTH - 8) / (mark + 6.2 * longest + 6))))


def _drawable(points: Sequence[tuple[float, float]], log_y: bool) -> list[tuple[float, float]]:
    good = [(x, y) for x, y in points if math.isfinite(x) and math.isfinite(y) and (y > 0 or not log_y)]
    return [(x, math.log10(y)) for x, y in good] if log_y else good


def widened(low: float, high: float) -> tuple[float, float]:
    """The range itself, or one around it if it has no extent."""
    largest = max(abs(low), abs(high))
    if high - low > 1e-12 * largest and high - low > 1e-30:
        return low, high
    margin = max(0.5, 1e-6 * largest)  # half a unit is nothing beside large numbers
    return low - margin, high + margin


def ticks(low: float, high: float, log: bool) -> list[tuple[float, str]]:
    """Round positions inside a range and their labels; on a log axis the range and the positions are exponents."""
    if log:
        return _log_ticks(low, high)
    return [(value, f"{value:g}" if abs(value) < 1e5 else f"{value / 1000:g}k") for value in _round_values(low, high)]


def _log_ticks(low: float, high: float) -> list[tuple[float, str]]:
    first, last = math.floor(low), math.ceil(high)
    for digits in ((1,), (1, 3), (1, 2, 5)):
        values = [d * 10.0**k for k in range(first, last + 1) for d in digits]
        inside = [v for v in values if low - 1e-9 <= math.log10(v) <= high + 1e-9]
        if len(inside) >= 3:
            inside = inside[:: math.ceil(len(inside) / 6)]
            break
    else:  # less than a decade: as on a linear axis
        inside = [v for v in _round_values(10**low, 10**high) if v > 0]
    return [(math.log10(v), f"{v:g}") for v in inside]


def _round_values(low: float, high: float) -> list[float]:
    raw = (high - low) / 4
    if not 0 < raw < 1e300:  # no damaged record has an axis worth drawing
        return []
    unit = 10 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 5, 10) if unit * m >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [float(f"{k * step:.12g}") for k in range(first, last + 1)]
