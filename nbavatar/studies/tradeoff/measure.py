"""One point of the trade: what a setting costs, and what it changes.

Times are taken in pairs, a picture at the exact setting beside each picture at the setting in question, and the
speed-up is the median of their ratios: on a shared machine both are slowed alike, so ratios are far steadier than
milliseconds.

Pictures may be rendered larger than the frames that judge them: quality is then measured on the pictures averaged down
to the frames' size, since there is no truth beyond it, and how far they are from the exact setting's pictures at full
size, which is where lost detail shows.
"""

import contextlib
import ctypes
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from nbavatar.camera.pinhole import scale_intrinsics
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.views import View
from nbavatar.evaluation.evaluate import PSNR_CAP, composite, measure
from nbavatar.evaluation.truth import foreground
from nbavatar.methods.billboards.compression.reduce import avatar_bytes
from nbavatar.metrics.lpips import LPIPS
from nbavatar.metrics.psnr import psnr
from nbavatar.studies.tradeoff.tuned import TunedAvatar

__all__ = ["STAGES", "Reference", "Shot", "difference", "measure_point", "peak_memory_mb", "prepare_shots",
           "quality", "reference", "time_pairs"]  # fmt: skip

STAGES = ("pose", "raster", "renderer", "compose")
_LEVEL = 1.0 / 255.0


@dataclass(frozen=True)
class Shot:
    """One held-out picture.

    Attributes:
        verts: vertices per part, float32 (V, 3) [m].
        view: camera and frame; its size is the truth's, or a whole multiple of it.
        viewmat, K: on the device.
        frame: id given to the avatar (its refinement of training frames), or None.
        background: RGB (3,).
        truth: on that background, float32 (1, 3, H, W).
        mask: foreground, bool (1, H, W).
        unseen: pixels without truth, bool (H, W), or None.
        features: LPIPS features of the truth.
    """

    verts: Mapping[str, Tensor]
    view: View
    viewmat: Tensor
    K: Tensor
    frame: str | None
    background: Tensor
    truth: Tensor
    mask: Tensor
    unseen: Tensor | None
    features: Sequence[Tensor]

    def render(self, avatar: TunedAvatar, laps: Any = None) -> tuple[Tensor, Tensor, Tensor]:
        """This picture of an avatar: image (3, H, W), alpha, the billboards' alpha."""
        v = self.view
        return avatar.render(
            self.verts, self.viewmat, self.K, v.width, v.height, self.background, frame=self.frame, laps=laps
        )


def prepare_shots(
    sequence: MeshSequence,
    parts: Sequence[str],
    views: Sequence[View],
    truths: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray | None]],
    background: Sequence[float],
    net: LPIPS,
    *,
    refined: bool,
    enlarge: int = 1,
    device: str,
) -> list[Shot]:
    """Held-out pictures and what they are judged by.

    Args:
        sequence: meshes of the frames.
        parts: parts of the avatar.
        views: cameras and frames.
        truths: colours uint8 (H, W, 3) and coverage uint8 (H, W) of each view, and the pixels that say
            nothing, bool (H, W), if there are any.
        background: sRGB in [0, 1].
        net: LPIPS on `device`.
        refined: whether training frames use their refinement.
        enlarge: pictures are this many times as large as the truth.
        device: where the avatar computes.
    """
    shots = []
    for view, (rgb, alpha, unseen) in zip(views, truths, strict=True):
        truth = torch.from_numpy(composite(rgb, alpha, background).transpose(2, 0, 1).copy())[None].to(device)
        with torch.inference_mode():
            features = net.features(truth)
        verts = {
            part: torch.from_numpy(np.asarray(sequence.parts[part].verts[view.row], dtype=np.float32)).to(device)
            for part in parts
        }
        K = torch.from_numpy(scale_intrinsics(view.K.numpy(), enlarge, enlarge)).float()
        view = view._replace(width=enlarge * view.width, height=enlarge * view.height, K=K)
        shots.append(
            Shot(
                verts, view, view.viewmat.to(device), view.K.to(device), view.frame if refined else None,
                torch.tensor(background, dtype=torch.float32, device=device), truth,
                torch.from_numpy(foreground(alpha))[None].to(device),
                None if unseen is None else torch.from_numpy(unseen).to(device), features,
            )
        )  # fmt: skip
    return shots


def measure_point(
    avatar: TunedAvatar,
    exact: TunedAvatar,
    pictures: Sequence["Reference"],
    shots: Sequence[Shot],
    net: LPIPS,
    *,
    repeats: int,
    warmup: int,
    device: str,
) -> dict[str, Any]:
    """Quality, difference, times, memory and work of one setting.

    Args:
        avatar: under the setting.
        exact: under the exact setting (the same object for that point itself).
        pictures: what `exact` shows of the shots.
        shots: held-out pictures.
        net: LPIPS.
        repeats, warmup: timed pairs, and pairs before timing starts.
        device: `cpu` or `cuda`.

    Returns:
        JSON-ready: `psnr` and `psnr_fg` [dB], `ssim`, `lpips`; `diff_max` [1] and `diff_share` (of the pixels that
        differ by more than 1/255 in a channel), `psnr_apart` [dB] and `lpips_apart` against the exact setting's
        pictures at full size; `ms` by stage and `total` (medians), `exact_ms` (median of the paired exact pictures),
        `speedup`; `peak_memory_mb` (tensors of the avatar and what a picture needs besides); `model_mb`; `work` a
        picture.
    """
    rows, apart = [], []
    before = asdict(avatar.work)
    for shot, picture in zip(shots, pictures, strict=True):
        image = shot.render(avatar)[0]
        rows.append(quality(image, shot, net))
        apart.append(difference(image, picture, net))
    work = {name: round((value - before[name]) / len(shots), 1) for name, value in asdict(avatar.work).items()}
    work.pop("pictures")
    times = time_pairs(avatar, exact, shots, repeats=repeats, warmup=warmup, device=device)
    return {
        "psnr": _mean(rows, "psnr"),
        "psnr_fg": _mean(rows, "psnr_fg"),
        "ssim": _mean(rows, "ssim"),
        "lpips": _mean(rows, "lpips_net"),
        "diff_max": max(row["diff_max"] for row in apart),
        **{name: _mean(apart, name) for name in ("diff_share", "psnr_apart", "lpips_apart")},
        **times,
        "peak_memory_mb": round(peak_memory_mb(avatar, shots[0], device)[0], 1),
        "model_mb": round(avatar_bytes(avatar.avatar) / 1e6, 3),
        "work": work,
    }


class Reference(NamedTuple):
    """A picture that others are compared with, (3, H, W), and the LPIPS features of what is stored of it."""

    image: Tensor
    features: Sequence[Tensor]


def reference(image: Tensor, net: LPIPS) -> Reference:
    """A picture (3, H, W) to compare others with."""
    with torch.inference_mode():
        return Reference(image, net.features(_stored(image)))


def difference(image: Tensor, other: Reference, net: LPIPS) -> dict[str, float]:
    """How far a picture (3, H, W) is from another of its size.

    Returns:
        `diff_max`: largest absolute difference [1]; `diff_share`: share of the pixels where any channel differs by
        more than 1/255; `psnr_apart` [dB] and `lpips_apart` of the two as they are stored.
    """
    apart = (image - other.image).abs().amax(0)
    with torch.inference_mode():
        distance = net.distance(net.features(_stored(image)), other.features)
    return {
        "diff_max": float(apart.max()),
        "diff_share": float((apart > _LEVEL * (1.0 + 1e-4)).float().mean()),
        "psnr_apart": min(float(psnr(_stored(image), _stored(other.image))), PSNR_CAP),
        "lpips_apart": float(distance),
    }


def quality(image: Tensor, shot: Shot, net: LPIPS) -> dict[str, float | None]:
    """Metrics of a picture (3, H, W) of a shot against its truth, averaged down to the truth's size."""
    times = image.shape[-1] // shot.truth.shape[-1]
    picture = functional.avg_pool2d(_stored(image), times)
    if shot.unseen is not None:
        picture = torch.where(shot.unseen, shot.background[:, None, None], picture)
    return measure(picture, shot.truth, shot.mask, {"net": net}, {"net": shot.features})


def _stored(image: Tensor) -> Tensor:
    """A picture (3, H, W) as it is written, 8 bits a channel, as a batch of one."""
    return torch.round(image.clamp(0.0, 1.0)[None] * 255.0) / 255.0


def time_pairs(
    avatar: TunedAvatar, exact: TunedAvatar, shots: Sequence[Shot], *, repeats: int, warmup: int, device: str
) -> dict[str, Any]:
    """Median milliseconds by stage, those of the paired exact pictures, and the speed-up."""
    alone = avatar is exact
    laps: list[dict[str, float]] = []
    exact_ms: list[float] = []
    for number in range(warmup + repeats):
        shot = shots[number % len(shots)]
        other = None if alone else sum(_timed(exact, shot, device).values())
        own = _timed(avatar, shot, device)
        if number >= warmup:
            laps.append(own)
            exact_ms.append(sum(own.values()) if other is None else other)
    totals = [sum(own.values()) for own in laps]
    ms = {stage: round(median(own[stage] for own in laps), 3) for stage in STAGES}
    ratios = [1.0 if alone else mine / own for mine, own in zip(exact_ms, totals, strict=True)]
    return {
        "ms": ms | {"total": round(median(totals), 3)},
        "exact_ms": round(median(exact_ms), 3),
        "speedup": round(median(ratios), 4),
    }


def _timed(avatar: TunedAvatar, shot: Shot, device: str) -> dict[str, float]:
    """Milliseconds of every stage of one picture."""
    spent: dict[str, float] = {}

    def now() -> float:
        if device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    last = now()

    def lap(stage: str) -> None:
        nonlocal last
        here = now()
        spent[stage] = 1000.0 * (here - last)
        last = here

    shot.render(avatar, lap)
    return spent


def peak_memory_mb(avatar: TunedAvatar, shot: Shot, device: str) -> tuple[float, Tensor]:
    """Memory of one picture [MB]: what the avatar keeps, and the most that rendering holds besides; and the picture.

    On a GPU from its allocator. On Linux from the process's peak resident set, which is reset before; elsewhere it
    cannot be reset, and what the avatar keeps alone is counted.
    """
    kept = avatar.kept_bytes() / 1e6
    if device == "cuda":
        torch.cuda.synchronize()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        image = shot.render(avatar)[0]
        return kept + (torch.cuda.max_memory_allocated() - before) / 1e6, image
    _give_back()
    counted = True
    try:
        with open("/proc/self/clear_refs", "w") as stream:
            stream.write("5")
        start = _resident("VmRSS")
    except OSError:
        counted, start = False, 0.0
    image = shot.render(avatar)[0]
    return kept + (max(0.0, _resident("VmHWM") - start) if counted else 0.0), image


def _resident(key: str) -> float:
    """A line of /proc/self/status [MB]."""
    with open("/proc/self/status") as stream:
        for line in stream:
            if line.startswith(key + ":"):
                return int(line.split()[1]) * 1024 / 1e6
    return 0.0


def _give_back() -> None:
    """Returns freed memory to the system, so that a peak is not hidden by what an earlier picture left behind."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def _mean(rows: Sequence[Mapping[str, float | None]], name: str) -> float | None:
    present = [value for row in rows if (value := row[name]) is not None]
    return sum(present) / len(present) if present else None
