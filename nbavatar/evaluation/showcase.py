"""Pictures of the two figures that have to render: what billboards carry, and one subject driven by another."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from nbavatar.config.evaluation import ProtocolConfig
from nbavatar.data.sequences import MeshSequence
from nbavatar.evaluation.features import feature_pictures
from nbavatar.evaluation.orbit import driven_views
from nbavatar.evaluation.render import check_parts, render_views
from nbavatar.io.framepack import FramePack
from nbavatar.methods.base import MeshAvatar

__all__ = ["Showcase", "show_features", "show_reenactment", "spread_rows"]

# Titles of the columns, rows of pictures (name, uint8 arrays or None), and what is shown in words.
Showcase = tuple[list[str], list[tuple[str, list[np.ndarray | None]]], list[str]]


def spread_rows(sequence: MeshSequence, count: int, frames: Sequence[str] | None = None) -> list[int]:
    """Rows of at most ``count`` frames, evenly spread over those in which every part is there.

    Args:
        sequence: meshes.
        count: how many.
        frames: only these; all if None.
    """
    allowed = None if frames is None else set(frames)
    whole = [
        row
        for row, frame in enumerate(sequence.frames)
        if (allowed is None or frame in allowed)
        and all(np.isfinite(p.verts[row]).all() for p in sequence.parts.values())
    ]
    if len(whole) <= count:
        return whole
    return [whole[round((i + 0.5) * len(whole) / count - 0.5)] for i in range(count)]


def show_features(
    avatars: Mapping[str, MeshAvatar], sequences: Mapping[str, MeshSequence], crops: Sequence[FramePack], count: int
) -> Showcase:
    """Truth, features, mask, colour, opacity and picture of some frames of each subject.

    Args:
        avatars: subject -> avatar of billboards, on the CPU.
        sequences: subject -> meshes.
        crops: their truth and cameras; the first of each subject is used.
        count: frames a subject.
    """
    titles, rows, shown = [], [], []
    for subject, avatar in avatars.items():
        crop = _first(crops, subject)
        if crop is None or subject not in sequences:
            continue
        sequence = sequences[subject]
        check_parts(avatar, sequence)
        for row in spread_rows(sequence, count, crop.frames):
            frame = sequence.frames[row]
            (view,) = driven_views(sequence, [row], crop.manifest, crop.intrinsics(frame), crop.cam_from_world)
            verts = {
                part: torch.from_numpy(np.asarray(sequence.parts[part].verts[row], np.float32)) for part in avatar.parts
            }
            made = feature_pictures(avatar, verts, view)  # type: ignore[arg-type]
            titles = ["truth", *made]
            rows.append((subject, [_truth(crop, frame), *made.values()]))
            shown.append(f"{subject} {view.camera}/{frame}")
    return titles, rows, shown


def show_reenactment(
    avatars: Mapping[str, MeshAvatar],
    driven: Mapping[tuple[str, str], MeshSequence],
    crops: Sequence[FramePack],
    count: int,
) -> Showcase:
    """The subject itself, the driver, and the subject driven.

    Args:
        avatars: subject -> avatar, on the CPU.
        driven: (source, target) -> result of ``nbavatar.evaluation.reenact.drive``.
        crops: truth and cameras of sources and targets; the source's first camera looks.
        count: frames a pair.
    """
    rows, shown = [], []
    for (source, target), sequence in driven.items():
        own, other = _first(crops, source), _first(crops, target)
        if own is None or source not in avatars:
            continue
        chosen = spread_rows(sequence, count)
        K = own.intrinsics(own.frames[0])
        views = driven_views(sequence, chosen, own.manifest, K, own.cam_from_world)
        pictures = render_views(avatars[source], sequence, views, ProtocolConfig())
        for number, picture in enumerate(pictures):
            frame = picture.view.frame
            driver = _truth(other, frame) if other is not None and frame in other.frames else None
            subject = _truth(own, own.frames[int((2 * number + 1) * len(own.frames) / (2 * len(chosen)))])
            rows.append((f"{source} by {target}", [subject, driver, picture.rgb]))
            shown.append(f"{source} by {target} {picture.view.camera}/{frame}")
    return ["subject", "driver", "driven"], rows, shown


def _first(crops: Sequence[FramePack], subject: str) -> FramePack | None:
    return next((crop for crop in crops if crop.manifest["subject"] == subject), None)


def _truth(crop: FramePack, frame: str) -> np.ndarray:
    """The photo's foreground on white, uint8 [H, W, 3]."""
    alpha = crop.read("alpha", frame).astype(np.float32)[..., None] / 255
    return np.round(crop.read("rgb", frame) * alpha + 255 * (1 - alpha)).astype(np.uint8)
