"""Comparison strips: truth, every method's render, its error map and its billboards' opacity, frame by frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nbavatar.io.framepack import FramePack
from nbavatar.reporting.insets import contact_window, cut
from nbavatar.reporting.page import Card, Strip
from nbavatar.reporting.pictures import data_uri, error_map, reduce_picture, spread

__all__ = ["Rendered", "comparison_strips", "find_truth"]


@dataclass(frozen=True)
class Rendered:
    """One render: whose it is, its images, and its figures per image (``<camera>/<frame>`` -> metrics)."""

    subject: str
    variant: str
    protocol: str
    background: Sequence[float]
    pack: FramePack
    per_image: Mapping[str, Mapping[str, Any]]


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


def comparison_strips(
    renders: Sequence[Rendered], crops: Sequence[FramePack], *, frames: int, max_side: int
) -> dict[str, list[Strip]]:
    """Strips by heading (subject and protocol).

    Args:
        renders: every method's renders, in the order of the columns.
        crops: ground-truth crops; without the right one a strip has no truth and no error maps.
        frames: strips per heading, evenly spread over the frames of the first method.
        max_side: pictures are reduced to this side [px].
    """
    groups: dict[str, list[Rendered]] = {}
    for render in renders:
        groups.setdefault(f"{render.subject}, protocol {render.protocol}", []).append(render)
    return {
        heading: [_strip(name, group, crops, max_side) for name in spread(group[0].pack.frames, frames)]
        for heading, group in groups.items()
    }


def _strip(name: str, group: Sequence[Rendered], crops: Sequence[FramePack], max_side: int) -> Strip:
    camera, _, frame = name.partition("/")
    where = f"camera {camera}, frame {frame}"
    truth, window = None, None
    cards = []
    crop = find_truth(group[0].pack, name, crops)
    if crop is not None:
        alpha = crop.read("alpha", frame)
        truth = _composite(crop.read("rgb", frame), alpha, group[0].background)
        window = contact_window(crop.read("label", frame) if "label" in crop.layers else None, alpha)
        picture = np.round(truth * 255).astype(np.uint8)
        pictures = [
            (picture, f"Ground truth, {where}"),
            (cut(picture, window), f"Ground truth at the contact, {where}"),
        ]
        pictures.append((alpha, f"True coverage, {where}"))
        cards.append(_card("Ground truth", pictures, "whole, at the contact, coverage", max_side, window))
    for render in group:
        if name not in render.pack.frames:
            continue
        rgb = render.pack.read("rgb", name)
        pictures = [(rgb, f"Render of {render.variant}, {where}")]
        if window is not None:
            pictures.append((cut(rgb, window), f"Render of {render.variant} at the contact, {where}"))
        if "nb_alpha" in render.pack.layers:
            mask = render.pack.read("nb_alpha", name)
            pictures.append((mask, f"Opacity of the billboards of {render.variant}, {where}"))
        if truth is not None and truth.shape == rgb.shape:
            pictures.append((error_map(rgb, truth), f"Error map of {render.variant}, {where}"))
        caption = _figures(render.per_image.get(name, {}))
        cards.append(_card(render.variant, pictures, caption, max_side, window))
    return Strip(where, cards)


def _card(
    title: str,
    pictures: Sequence[tuple[np.ndarray, str]],
    caption: str,
    max_side: int,
    window: tuple[int, int, int, int] | None,
) -> Card:
    height, width = pictures[0][0].shape[:2]
    frame = None
    if window is not None:
        x0, y0, x1, y1 = window
        frame = (x0 / width, y0 / height, (x1 - x0) / width, (y1 - y0) / height)
    embedded = [(data_uri(reduce_picture(picture, max_side)), text) for picture, text in pictures]
    return Card(title, embedded, caption, max(height, width) <= 128, frame)


def _figures(metrics: Mapping[str, Any]) -> str:
    """The figures of one image as a short line."""
    shown = (("psnr", "PSNR", 2), ("ssim", "SSIM", 3), ("lpips_vgg", "LPIPS", 3))
    words = [f"{word} {metrics[key]:.{digits}f}" for key, word, digits in shown if metrics.get(key) is not None]
    return ", ".join(words)


def _composite(rgb: np.ndarray, alpha: np.ndarray, background: Sequence[float]) -> np.ndarray:
    """Truth on the protocol's background, float32 [H, W, 3] in [0, 1], as the evaluation composes it."""
    coverage = alpha.astype(np.float32)[..., None] / np.float32(255)
    return coverage * (rgb.astype(np.float32) / 255) + (1 - coverage) * np.asarray(background, dtype=np.float32)
