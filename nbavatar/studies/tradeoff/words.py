"""What was measured, in plain words: a paragraph a knob, written from the data."""

from collections.abc import Sequence

from nbavatar.config.tradeoff import TradeoffConfig
from nbavatar.studies.tradeoff.front import Point, losses
from nbavatar.studies.tradeoff.sweep import knob_of

__all__ = ["KNOBS", "knob_paragraphs", "point_sentence"]

# Knob -> what it is called in a sentence.
KNOBS = {
    "resolution": "Rendering resolution",
    "decode": "Resolution of the U-Net",
    "precision": "Arithmetic of the U-Net",
    "roi": "Region of interest",
    "roi_margin": "Margin of the region of interest",
    "order": "Compositing order",
    "t_min": "End of a ray",
    "alpha_min": "Smallest opacity",
    "low_pass": "Low-pass of small billboards",
    "texels": "Texture size",
    "billboards": "Share of the billboards kept",
    "mips": "Textures by size on screen",
    "channels_last": "Memory layout of the U-Net",
    "threads": "Threads",
}
_SAME_SPEED = 0.03
_SAME_PSNR, _SAME_LPIPS = 0.005, 0.00005


def knob_paragraphs(points: Sequence[Point], sheet: TradeoffConfig) -> dict[str, str]:
    """One paragraph for every knob of which a value was measured alone.

    Args:
        points: of one model, the exact one first.
        sheet: names the exact setting and the limits of the presets.
    """
    exact, found = points[0], {}
    for point in points[1:]:
        knob = knob_of(point, sheet.exact)
        if knob is not None and point.model == exact.model:
            found.setdefault(knob, []).append(point)
    result = {}
    for knob, tried in found.items():
        base = _value(getattr(sheet.exact, knob))
        sentences = [point_sentence(point, exact, _value(getattr(point.setting, knob)), base) for point in tried]
        result[knob] = f"{KNOBS.get(knob, knob)} (`{knob}`). " + " ".join(sentences) + _verdict(tried, exact, sheet)
    return result


def point_sentence(point: Point, exact: Point, name: str, base: str) -> str:
    """One point against the exact one: speed, memory, what changes, quality."""
    values = point.values
    psnr, lpips = losses(point, exact)
    if values["diff_max"] == 0.0:
        change = "changes no pixel"
    else:
        share = values["diff_share"]
        percent = "no pixel" if share == 0 else f"{100 * share:.2g}% of the pixels"
        change = f"changes {percent} by more than 1/255 (most: {255 * values['diff_max']:.1f}/255)"
        if values["lpips_apart"] >= _SAME_LPIPS:
            change += f", {values['lpips_apart']:.4f} LPIPS away"
        if abs(psnr) < _SAME_PSNR and abs(lpips) < _SAME_LPIPS:
            change += " and no quality figure"
        else:
            change += f"; PSNR {0.0 - psnr:+.2f} dB, LPIPS {lpips:+.4f}"
    memory = values["peak_memory_mb"] - exact.values["peak_memory_mb"]
    extra = f", with {abs(memory):.0f} MB {'more' if memory > 0 else 'less'} memory" if abs(memory) >= 1 else ""
    return f"`{name}` {_speed(point.speedup)} `{base}`{extra}, and {change}."


def _speed(ratio: float) -> str:
    if abs(ratio - 1.0) < _SAME_SPEED:
        return "is as fast as"
    return f"is {ratio:.2g}x as fast as" if ratio > 1 else f"is slower than ({1 / ratio:.2g}x the time of)"


def _verdict(tried: Sequence[Point], exact: Point, sheet: TradeoffConfig) -> str:
    """Which presets may use a value of the knob."""
    parts = []
    for name, limits in sheet.presets.items():
        fitting = [
            point for point in tried
            if point.speedup > 1.0 + _SAME_SPEED
            and losses(point, exact)[0] < limits.psnr
            and losses(point, exact)[1] < limits.lpips
        ]  # fmt: skip
        if fitting:
            best = max(fitting, key=lambda point: point.speedup)
            parts.append(f"`{name}` may use {best.label} for {best.speedup:.2g}x")
    return (" Alone, " + " and ".join(parts) + ".") if parts else " Alone it is no gain that a preset may take."


def _value(value: object) -> str:
    if value is None:
        return "as trained"
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
