"""Comparisons frame by frame: truth, every method's render, a zoom at the contact, billboard opacity, error map."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nbavatar.io.framepack import FramePack, unseen_in
from nbavatar.preprocess.crop import blank_unseen
from nbavatar.reporting.insets import contact_pixels, contact_window, cut
from nbavatar.reporting.page import Card, Strip
from nbavatar.reporting.pictures import data_uri, error_map, reduce_picture, spread

__all__ = ["ROWS", "Column", "Comparison", "Rendered", "compare_frame", "compare_frames", "find_truth"]
__all__ += ["frames_in_contact", "to_strip"]

ROWS = ("whole", "zoom", "coverage", "error")
_WORDS = {
    "whole": "{} ({})",
    "zoom": "zoom into {} ({})",
    "coverage": "coverage of {} ({})",
    "error": "error map of {} ({})",
}


@dataclass(frozen=True)
class Rendered:
    """One render: whose it is, its images, and its figures per image (``<camera>/<frame>`` -> metrics)."""

    subject: str
    variant: str
    protocol: str
    background: Sequence[float]
    pack: FramePack
    per_image: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Column:
    """One method's pictures by row of ``ROWS``, uint8 [H, W, 3] or [H, W]; what it has not is absent."""

    title: str
    pictures: Mapping[str, np.ndarray]
    figures: Mapping[str, Any]


@dataclass(frozen=True)
class Comparison:
    """One frame of one camera; the window (x0, y0, x1, y1) [px] is what the row ``zoom`` enlarges."""

    camera: str
    frame: str
    columns: Sequence[Column]
    window: tuple[int, int, int, int] | None


def find_truth(render: FramePack, name: str, crops: Sequence[FramePack]) -> FramePack | None:
    """The crop that a rendered frame is compared with: same subject, camera, size and intrinsics; None if not given.

    Args:
        render: rendered images.
        name: ``<camera>/<frame>``.
        crops: ground-truth crops of any cameras and kinds.
    """
    camera, _, frame = name.partition("/")
    size = (render.manifest["width"], render.manifest["height"])
    own = render.intrinsics(name) if render.manifest.get("K_per_frame") or render.manifest.get("K") else None
    for crop in crops:
        manifest = crop.manifest
        if manifest["subject"] != render.manifest["subject"] or str(manifest["camera"]) != camera:
            continue
        if (manifest["width"], manifest["height"]) != size or frame not in crop.frames:
            continue
        # float32 on the way through the renderer: a thousandth of a pixel of slack.
        if own is None or np.allclose(own, crop.intrinsics(frame), atol=1e-3 * max(size)):
            return crop
    return None


def compare_frames(
    renders: Sequence[Rendered], crops: Sequence[FramePack], *, frames: int
) -> dict[tuple[str, str], list[Comparison]]:
    """Comparisons by (subject, protocol).

    Args:
        renders: every method's renders, in the order of the columns.
        crops: ground-truth crops; without the right one there is no truth, no zoom and no error map.
        frames: how many, evenly spread over the frames of the first method.
    """
    groups: dict[tuple[str, str], list[Rendered]] = {}
    for render in renders:
        groups.setdefault((render.subject, render.protocol), []).append(render)
    return {
        key: [compare_frame(name, group, crops) for name in spread(group[0].pack.frames, frames)]
        for key, group in groups.items()
    }


def frames_in_contact(names: Sequence[str], pack: FramePack, crops: Sequence[FramePack], count: int) -> list[str]:
    """The frames with the largest contact of hand and head, one from each of ``count`` equal stretches of the list.

    At most 24 labels are looked at, evenly spread; without labels the middle of each stretch is taken.

    Args:
        names: ``<camera>/<frame>``, in order.
        pack: a render of them.
        crops: ground-truth crops; their layer ``label`` tells where hand meets head.
        count: how many frames.
    """
    count = min(count, len(names))
    looked = {}
    for name in spread(names, max(24, count)):
        crop = find_truth(pack, name, crops)
        if crop is not None and "label" in crop.layers:
            looked[name] = contact_pixels(crop.read("label", name.partition("/")[2]))
    chosen = []
    for i in range(count):
        stretch = names[round(i * len(names) / count) : round((i + 1) * len(names) / count)]
        best = max(stretch, key=lambda name: looked.get(name, 0))
        chosen.append(best if looked.get(best, 0) > 0 else stretch[len(stretch) // 2])
    return chosen


def compare_frame(name: str, group: Sequence[Rendered], crops: Sequence[FramePack]) -> Comparison:
    """One frame ``<camera>/<frame>``: the truth where there is one, then every method of the group that has it."""
    camera, _, frame = name.partition("/")
    truth, window, unseen = None, None, None
    columns = []
    crop = find_truth(group[0].pack, name, crops)
    if crop is not None:
        alpha = crop.read("alpha", frame)
        label = crop.read("label", frame) if "label" in crop.layers else None
        unseen = None if label is None else unseen_in(label)
        truth = _composite(crop.read("rgb", frame), alpha, group[0].background)
        window = contact_window(label, alpha)
        picture = np.round(truth * 255).astype(np.uint8)
        columns.append(Column("Ground truth", {"whole": picture, "zoom": cut(picture, window), "coverage": alpha}, {}))
    for render in group:
        if name not in render.pack.frames:
            continue
        rgb = render.pack.read("rgb", name)
        pictures = {"whole": rgb}
        if window is not None:
            pictures["zoom"] = cut(rgb, window)
        if "nb_alpha" in render.pack.layers:
            pictures["coverage"] = render.pack.read("nb_alpha", name)
        if truth is not None and truth.shape == rgb.shape:
            pictures["error"] = error_map(blank_unseen(rgb, unseen, render.background), truth)
        columns.append(Column(render.variant, pictures, render.per_image.get(name, {})))
    return Comparison(camera, frame, columns, window)


def to_strip(comparison: Comparison, *, max_side: int) -> Strip:
    """A comparison as a strip of the page, its pictures reduced to ``max_side`` [px] and embedded."""
    where = f"camera {comparison.camera}, frame {comparison.frame}"
    cards = []
    for column in comparison.columns:
        height, width = column.pictures["whole"].shape[:2]
        frame = None
        if comparison.window is not None:
            x0, y0, x1, y1 = comparison.window
            frame = (x0 / width, y0 / height, (x1 - x0) / width, (y1 - y0) / height)
        pictures = [
            (data_uri(reduce_picture(column.pictures[row], max_side)), _WORDS[row].format(column.title, where))
            for row in ROWS
            if row in column.pictures
        ]
        caption = _figures(column.figures) or ("whole, zoom, coverage" if frame else "")
        cards.append(Card(column.title, pictures, caption, max(height, width) <= 128, frame))
    return Strip(where, cards)


def _figures(metrics: Mapping[str, Any]) -> str:
    """The figures of one image as a short line."""
    shown = (
        ("psnr", "PSNR {:.2f} dB"),
        ("ssim", "SSIM {:.3f}"),
        ("lpips_vgg", "LPIPS {:.3f} (VGG)"),
        ("lpips_alex", "LPIPS {:.3f} (AlexNet)"),
    )
    return ", ".join(words.format(metrics[key]) for key, words in shown if metrics.get(key) is not None)


def _composite(rgb: np.ndarray, alpha: np.ndarray, background: Sequence[float]) -> np.ndarray:
    """Truth on the protocol's background, float32 [H, W, 3] in [0, 1], as the evaluation composes it."""
    coverage = alpha.astype(np.float32)[..., None] / np.float32(255)
    return coverage * (rgb.astype(np.float32) / 255) + (1 - coverage) * np.asarray(background, dtype=np.float32)
