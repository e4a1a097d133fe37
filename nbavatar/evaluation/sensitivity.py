"""How far figures move when only the protocol changes: the same renders, judged in many ways.

One factor at a time departs from the base (whole image, the protocol's background, native size, soft coverage):

    crop         square box around the foreground, over the sequence of a camera or frame by frame, with a margin of
                 `pad` times the box on each side, brought back to the image's size
    background   colour behind both images; the render's is exchanged by its own opacity
    resize       half size, by filter
    mask         where the truth ends: coverage as it is, cut at one half, grown or shrunk by 1% of the image

The metric net is a factor of its own and stands in the columns. Nothing is rendered again.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from nbavatar.evaluation.evaluate import PSNR_CAP
from nbavatar.evaluation.truth import foreground
from nbavatar.metrics.lpips import LPIPS
from nbavatar.metrics.psnr import psnr
from nbavatar.metrics.ssim import ssim

__all__ = ["Images", "Setting", "apply_setting", "foreground_box", "settings", "sweep"]

_GROW = 0.01


@dataclass(frozen=True)
class Images:
    """One rendered image and its truth, uint8: colours [H, W, 3], coverages [H, W] (255 = full).

    Where the truth says nothing, if anywhere, `unseen` is true, bool [H, W].
    """

    camera: str
    prediction: np.ndarray
    opacity: np.ndarray | None
    rgb: np.ndarray
    alpha: np.ndarray
    unseen: np.ndarray | None = None


@dataclass(frozen=True)
class Setting:
    """One way to judge; the defaults are the base.

    Attributes:
        factor: what departs from the base; ``base`` for itself.
        name: the value it takes.
        crop: ``whole``, ``sequence`` or ``frame``.
        pad: margin on each side of the box as a share of it.
        background: sRGB in [0, 1]; None for the protocol's own.
        resample: filter that halves the size; empty for native size.
        mask: ``soft``, ``hard``, ``grown`` or ``shrunk``.
    """

    factor: str = "base"
    name: str = "whole image, soft coverage"
    crop: str = "whole"
    pad: float = 0.0
    background: tuple[float, float, float] | None = None
    resample: str = ""
    mask: str = "soft"


def settings(*, opacity: bool) -> list[Setting]:
    """The base and every departure from it; backgrounds only where renders know their opacity."""
    base = Setting()
    result = [base]
    for pad in (0.0, 0.1, 0.25, 0.5):
        text = f"sequence box, pad {pad:.0%}"
        result.append(replace(base, factor="crop", name=text, crop="sequence", pad=pad))
    result.append(replace(base, factor="crop", name="frame box, pad 10%", crop="frame", pad=0.1))
    if opacity:
        colours = {
            "white": (1.0, 1.0, 1.0),
            "black": (0.0, 0.0, 0.0),
            "grey": (0.5, 0.5, 0.5),
            "green": (0.0, 1.0, 0.0),
        }
        result += [replace(base, factor="background", name=n, background=c) for n, c in colours.items()]
    for name in ("box", "bilinear", "bicubic", "lanczos", "nearest"):
        result.append(replace(base, factor="half size", name=name, resample=name))
    result += [replace(base, factor="mask", name=name, mask=name) for name in ("hard", "grown", "shrunk")]
    return result


def foreground_box(alpha: np.ndarray) -> tuple[float, float, float, float] | None:
    """Tight box x0, y0, x1, y1 [px] of coverage of one half or more; None without foreground."""
    ys, xs = np.nonzero(foreground(alpha))
    return (float(xs.min()), float(ys.min()), float(xs.max() + 1), float(ys.max() + 1)) if len(xs) else None


def apply_setting(
    setting: Setting,
    images: Images,
    background: Sequence[float],
    box: tuple[float, float, float, float] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """The pair of images that a setting compares.

    Args:
        setting: how to judge.
        images: render and truth.
        background: the protocol's own, sRGB in [0, 1], on which the render stands.
        box: foreground box [px] of the frame or the sequence, for crops; None leaves the image whole.

    Returns:
        prediction and truth, float32 [H, W, 3] in [0, 1], rounded to 8 bits as stored images are.
    """
    old = np.asarray(background, np.float32)
    new = old if setting.background is None else np.asarray(setting.background, np.float32)
    covered = _masked(images.alpha, setting.mask)
    if images.unseen is not None:  # a grown mask does not reach where nothing is known and the render is blank
        covered = np.where(images.unseen, np.uint8(0), covered)
    coverage = covered.astype(np.float32)[..., None] / 255
    truth = coverage * (images.rgb.astype(np.float32) / 255) + (1 - coverage) * new
    prediction = images.prediction.astype(np.float32) / 255
    if setting.background is not None and images.opacity is not None:
        clear = 1 - images.opacity.astype(np.float32)[..., None] / 255
        prediction = prediction + clear * (new - old)
    pair = [np.round(np.clip(image, 0, 1) * 255).astype(np.uint8) for image in (prediction, truth)]
    if setting.crop != "whole" and box is not None:
        pair = [_cropped(image, _squared(box, setting.pad), new) for image in pair]
    if setting.resample:
        pair = [_halved(image, setting.resample) for image in pair]
    return pair[0].astype(np.float32) / 255, pair[1].astype(np.float32) / 255


def sweep(
    frames: Iterable[Images], background: Sequence[float], nets: Mapping[str, LPIPS], boxes: Mapping[str, tuple]
) -> list[dict[str, object]]:
    """Mean metrics of all frames under every setting.

    Args:
        frames: renders and truths.
        background: the protocol's own.
        nets: LPIPS modules by name.
        boxes: camera -> foreground box over its whole sequence [px].

    Returns:
        one row a setting: factor, setting, psnr [dB], ssim, lpips_<net>, and their differences to the base
        (``d_psnr`` and so on).
    """
    totals: dict[Setting, list[dict[str, float]]] = {}
    for images in frames:
        for setting in settings(opacity=images.opacity is not None):
            box = boxes.get(images.camera) if setting.crop == "sequence" else foreground_box(images.alpha)
            x, y = (_tensor(image) for image in apply_setting(setting, images, background, box))
            with torch.inference_mode():
                values = {"psnr": min(float(psnr(x, y)), PSNR_CAP), "ssim": float(ssim(x, y))}
                values |= {f"lpips_{name}": float(net(x, y)) for name, net in nets.items()}
            totals.setdefault(setting, []).append(values)
    rows: list[dict[str, object]] = []
    base: dict[str, float] = {}
    for setting, values in totals.items():
        means = {name: math.fsum(v[name] for v in values) / len(values) for name in values[0]}
        base = base or means
        differences = {f"d_{name}": value - base[name] for name, value in means.items()}
        rows.append({"factor": setting.factor, "setting": setting.name, **means, **differences})
    return rows


def _masked(alpha: np.ndarray, kind: str) -> np.ndarray:
    if kind == "soft":
        return alpha
    if kind == "hard":
        return np.where(foreground(alpha), 255, 0).astype(np.uint8)
    from PIL import Image, ImageFilter

    reach = 2 * max(1, round(_GROW * min(alpha.shape))) + 1
    chosen = ImageFilter.MaxFilter(reach) if kind == "grown" else ImageFilter.MinFilter(reach)
    return np.asarray(Image.fromarray(alpha).filter(chosen))


def _squared(box: tuple[float, float, float, float], pad: float) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = box
    half = max(x1 - x0, y1 - y0) * (0.5 + pad)
    cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
    return cx - half, cy - half, cx + half, cy + half


def _cropped(image: np.ndarray, box: tuple[float, float, float, float], background: np.ndarray) -> np.ndarray:
    """Box of an image, brought to the image's own size; outside it is background."""
    from PIL import Image

    height, width = image.shape[:2]
    margin = math.ceil(max(0.0, -box[0], -box[1], box[2] - width, box[3] - height))
    canvas = np.tile(np.round(background * 255).astype(np.uint8), (height + 2 * margin, width + 2 * margin, 1))
    canvas[margin : margin + height, margin : margin + width] = image
    moved = (box[0] + margin, box[1] + margin, box[2] + margin, box[3] + margin)
    side = min(height, width)
    return np.asarray(Image.fromarray(canvas).resize((side, side), Image.Resampling.BICUBIC, box=moved))


def _halved(image: np.ndarray, name: str) -> np.ndarray:
    from PIL import Image

    size = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling[name.upper()]))


def _tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None]
