"""The figures of the paper from stored results: what goes into which row. Arrays and records in, figures out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from nbavatar.config.figures import FigureLayout
from nbavatar.data.sequences import MeshSequence
from nbavatar.io.framepack import FramePack
from nbavatar.reporting.comparison import Comparison, Rendered, compare_frame, frames_in_contact
from nbavatar.reporting.curves import training_curves
from nbavatar.reporting.figures import curves_figure
from nbavatar.reporting.grids import GridRow, grid_figure
from nbavatar.reporting.pareto import measured_variants, pareto_figure
from nbavatar.reporting.pictures import ERROR_MAX

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Drawn", "comparison_drawn", "comparison_rows", "contact_drawn", "curves_drawn", "pareto_drawn"]
__all__ += ["pictures_drawn"]

_ERROR_BAR = ("|error|, sRGB [1]", ERROR_MAX)


@dataclass(frozen=True)
class Drawn:
    """A figure, and what it shows in words (subjects, cameras, frames, variants)."""

    figure: "Figure"
    shown: list[str] = field(default_factory=list)


def empty_figure(reason: str) -> "Figure":
    """A figure that says why it shows nothing."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0, 0.6), dpi=150)
    figure.text(0.5, 0.5, reason, ha="center", va="center", fontsize=8)
    return figure


def comparison_rows(
    comparison: Comparison,
    columns: Sequence[tuple[str, str]],
    rows: Sequence[str],
    *,
    name: str = "",
    space: bool = False,
) -> list[GridRow]:
    """Rows of one frame.

    Args:
        comparison: its pictures; the first column of the grid is its truth.
        columns: (title in the comparison, heading) of every column, the truth first.
        rows: names in ``nbavatar.reporting.comparison.ROWS``.
        name: written before the first row's name.
        space: leave room above the first row.
    """
    by_title = {column.title: column for column in comparison.columns}
    found = [by_title.get(title) for title, _ in columns]
    result = []
    for row in rows:
        pictures = [column.pictures.get(row) if column is not None else None for column in found]
        if not any(picture is not None for picture in pictures):
            continue
        window, notes = None, []
        if row == "whole":
            size = next(p.shape for p in pictures if p is not None)
            if comparison.window is not None and "zoom" in rows:
                x0, y0, x1, y1 = comparison.window
                window = (x0 / size[1], y0 / size[0], x1 / size[1], y1 / size[0])
            values = [column.figures.get("psnr") if column is not None else None for column in found]
            notes = ["" if value is None else f"{value:.2f} dB" for value in values]
        first = not result
        label = f"{name}\n{row}" if first and name else row
        result.append(GridRow(label, pictures, window, space=space and first, notes=notes))
    return result


def comparison_drawn(renders: Sequence[Rendered], crops: Sequence[FramePack], layout: FigureLayout) -> Drawn:
    """Truth and methods, subject by subject, in the frames with the largest contact."""
    order = {column.variant: i for i, column in enumerate(layout.columns)}
    used = [r for r in renders if r.protocol == layout.protocol and r.variant in order and layout.shows(r.subject)]
    used.sort(key=lambda r: order[r.variant])
    subjects = sorted(
        {r.subject for r in used}, key=lambda s: (layout.subjects.index(s) if s in layout.subjects else 0, s)
    )
    if not used:
        return Drawn(empty_figure(f"{layout.title}: no render under {layout.protocol} yet"))
    present = {r.variant for r in used}
    columns = [("Ground truth", "Ground truth")]
    columns += [(c.variant, c.label or c.variant) for c in layout.columns if c.variant in present]
    rows, shown = [], []
    for subject in subjects:
        group = [r for r in used if r.subject == subject]
        for number, name in enumerate(frames_in_contact(group[0].pack.frames, group[0].pack, crops, layout.frames)):
            comparison = compare_frame(name, group, crops)
            rows += comparison_rows(comparison, columns, layout.rows, name=subject, space=bool(rows) and number == 0)
            shown.append(f"{subject} {name}")
    error = "error" in layout.rows
    return Drawn(grid_figure([heading for _, heading in columns], rows, bar=_ERROR_BAR if error else None), shown)


def contact_drawn(sequences: Mapping[str, MeshSequence], crops: Sequence[FramePack], frames: int) -> Drawn:
    """Photo, meshes before and after the contact stage and the displacement, with a zoom at the deepest dent below."""
    # Meshes are drawn by Numba kernels, which the other figures need not load.
    from nbavatar.reporting.contact import best_camera, deepest_frames, dent_scale

    chosen = []
    for subject, sequence in sequences.items():
        own = [crop for crop in crops if crop.manifest["subject"] == subject]
        common = set.intersection(*(set(crop.frames) for crop in own)) if own else set()
        chosen += [(subject, sequence, own, f) for f in deepest_frames(sequence, sorted(common), frames)]
    if not chosen:
        return Drawn(empty_figure("no contact stage, or no contact in the frames given"))
    scale = max(dent_scale(sequence, [frame]) for _, sequence, _, frame in chosen)
    rows, shown, titles = [], [], []
    for subject, sequence, own, frame in chosen:
        index, place = best_camera(sequence, frame, [crop.cam_from_world for crop in own])
        crop = own[index]
        K, camera = np.array(crop.intrinsics(frame), np.float64), crop.cam_from_world
        width, height = int(crop.manifest["width"]), int(crop.manifest["height"])
        pixel = K @ (camera[:3, :3] @ place + camera[:3, 3])
        side = max(1, round(0.28 * min(width, height)))
        x0 = int(np.clip(round(pixel[0] / pixel[2] - side / 2), 0, width - side))
        y0 = int(np.clip(round(pixel[1] / pixel[2] - side / 2), 0, height - side))
        photo = crop.read("rgb", frame)
        # Meshes are drawn at print size: enlarged pixels of a small crop would show nothing.
        whole = _drawn_at(sequence, frame, K, camera, (width, height), scale)
        close = _drawn_at(sequence, frame, K - [[0, 0, x0], [0, 0, y0], [0, 0, 0]], camera, (side, side), scale)
        titles = ["photo", *whole]
        window = (x0 / width, y0 / height, (x0 + side) / width, (y0 + side) / height)
        rows.append(GridRow(f"{subject}\nwhole", [photo, *whole.values()], window, space=bool(rows)))
        rows.append(GridRow("zoom", [photo[y0 : y0 + side, x0 : x0 + side], *close.values()]))
        shown.append(f"{subject} {crop.manifest['camera']}/{frame}")
    return Drawn(grid_figure(titles, rows, bar=("displacement [mm]", scale)), shown)


def _drawn_at(
    sequence: MeshSequence, frame: str, K: np.ndarray, camera: np.ndarray, size: tuple[int, int], scale: float
) -> dict[str, np.ndarray]:
    from nbavatar.reporting.contact import dent_pictures

    factor = max(1.0, 512 / max(size))
    scaled = np.diag([factor, factor, 1.0]) @ K
    width, height = (max(1, round(factor * side)) for side in size)
    return dent_pictures(sequence, frame, scaled, camera, width, height, scale)


def curves_drawn(histories: Mapping[str, Sequence[Mapping[str, Any]]]) -> Drawn:
    """Every logged quantity over the steps."""
    curves = training_curves(histories)
    if not curves:
        return Drawn(empty_figure("no training history yet"))
    return Drawn(curves_figure(curves), list(histories))


def pareto_drawn(
    evals: Sequence[Mapping[str, Any]], speeds: Sequence[tuple[str, Mapping[str, Any]]], protocol: str
) -> Drawn:
    """Quality against time, memory and bytes."""
    measured = measured_variants(evals, speeds, protocol)
    if not measured:
        return Drawn(empty_figure(f"no variant is both timed and evaluated under {protocol} yet"))
    return Drawn(pareto_figure(measured), [m.variant for m in measured])


def pictures_drawn(
    titles: Sequence[str], rows: Sequence[tuple[str, Sequence[np.ndarray | None]]], shown: Sequence[str]
) -> Drawn:
    """A grid of ready pictures, one row (name, pictures) each."""
    if not rows:
        return Drawn(empty_figure("no avatar to show yet"))
    return Drawn(grid_figure(titles, [GridRow(name, pictures) for name, pictures in rows]), list(shown))
