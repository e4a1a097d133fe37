"""Metrics of stored renders against ground truth.

No model and no GPU: a render is a set of images, and so is the truth. The truth is composited on the protocol's
background with the crop's coverage, I = a rgb + (1 - a) background, in float32 sRGB, and is not rounded to 8 bits
again (the render was, when it was stored). PSNR and SSIM are float64 throughout; LPIPS is float32 without the shortened
products (TF32) that GPUs take by default, so devices differ by rounding only (1e-6, three digits are shown).

    metric     meaning
    psnr       whole image [dB]; equal images count as 100 dB, so that means stay finite
    ssim       whole image, Wang 2004
    lpips_*    whole image, by backbone
    psnr_fg    pixels whose true coverage reaches the threshold [dB]; absent where there are none
    ssim_fg    windows centred there
    over       coverage too much, and `under`: too little, as shares of the true area; absent where a render has none

Trivial answers, judged in the same way, say what the figures are worth: the background alone, and the mean
training image (of the same camera where it was trained on, else over all training cameras).
"""

import contextlib
import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nbavatar.errors import DataError
from nbavatar.evaluation.silhouette import silhouette_error
from nbavatar.evaluation.truth import foreground, nobody
from nbavatar.metrics.lpips import LPIPS
from nbavatar.metrics.psnr import psnr
from nbavatar.metrics.ssim import WINDOW, ssim_map

__all__ = ["PSNR_CAP", "Pair", "composite", "evaluate", "mean_images", "measure"]

PSNR_CAP = 100.0
_SMALL = 256 * 256


@dataclass(frozen=True)
class Pair:
    """One rendered image and its truth.

    Attributes:
        camera: camera id.
        frame: frame id.
        prediction: uint8 [H, W, 3], already on the protocol's background.
        rgb: uint8 [H, W, 3], true colours.
        alpha: uint8 [H, W], true coverage, 255 = full.
        coverage: uint8 [H, W], the render's, or None where it is not known.
        unseen: bool [H, W], where the truth says nothing and has the background, as the prediction does; None: nowhere.
    """

    camera: str
    frame: str
    prediction: np.ndarray
    rgb: np.ndarray
    alpha: np.ndarray
    coverage: np.ndarray | None = None
    unseen: np.ndarray | None = None


def composite(rgb: np.ndarray, alpha: np.ndarray, background: Sequence[float]) -> np.ndarray:
    """Colours over a background: float32 [H, W, 3] in [0, 1].

    Args:
        rgb: uint8 [H, W, 3], straight alpha.
        alpha: uint8 [H, W], 255 = covered.
        background: sRGB in [0, 1].
    """
    coverage = alpha.astype(np.float32)[..., None] / np.float32(255)
    colour = rgb.astype(np.float32) / np.float32(255)
    return coverage * colour + (np.float32(1) - coverage) * np.asarray(background, dtype=np.float32)


def mean_images(
    images: Iterable[tuple[str, np.ndarray, np.ndarray, np.ndarray | None]], background: Sequence[float]
) -> dict[str, np.ndarray]:
    """Mean training image of each camera, and of all of them under the key ``''``.

    A pixel is the mean over the images that say something of it, and has the background where none does.

    Args:
        images: (camera, uint8 rgb [H, W, 3], uint8 alpha [H, W], bool [H, W] where it says nothing or None), all of one
            size.
        background: sRGB in [0, 1].

    Returns:
        camera -> float32 [H, W, 3]; empty if there are no images.
    """
    sums: dict[str, np.ndarray] = {}
    counts: dict[str, np.ndarray] = {}
    for camera, rgb, alpha, unseen in images:
        image = composite(rgb, alpha, background).astype(np.float64)
        known = np.ones(image.shape[:2]) if unseen is None else np.where(unseen, 0.0, 1.0)
        image *= known[..., None]
        for key in (camera, ""):
            if key in sums and sums[key].shape != image.shape:
                size, other = sums[key].shape[:2], image.shape[:2]
                raise DataError.of("training images", f"camera {camera}", expected=f"size {size}", found=other)
            sums[key] = sums[key] + image if key in sums else image
            counts[key] = counts[key] + known if key in counts else known
    blank = np.asarray(background, np.float64)
    return {
        key: np.where(counts[key][..., None] > 0, total / np.maximum(counts[key], 1.0)[..., None], blank).astype(
            np.float32
        )
        for key, total in sums.items()
    }


def measure(
    prediction: Tensor,
    truth: Tensor,
    mask: Tensor,
    nets: Mapping[str, LPIPS],
    truth_features: Mapping[str, Sequence[Tensor]],
    prediction_features: Mapping[str, Sequence[Tensor]] | None = None,
) -> dict[str, float | None]:
    """All metrics of one image.

    Args:
        prediction: float32 [1, 3, H, W] in [0, 1].
        truth: the same.
        mask: bool [1, H, W], the foreground.
        nets: LPIPS modules by name.
        truth_features: their features of the truth, by name (nets without an entry are left out).
        prediction_features: features of the prediction where they are known already.

    Returns:
        metric -> value; None where the image is too small for the metric, and everywhere where the foreground is empty:
        background like background says nothing about an avatar, and would count as a perfect picture.
    """
    if not bool(mask.any()):
        return dict.fromkeys(("psnr", "psnr_fg", "ssim", "ssim_fg", *(f"lpips_{name}" for name in truth_features)))
    values: dict[str, float | None] = {"psnr": min(float(psnr(prediction, truth)), PSNR_CAP)}
    values["psnr_fg"] = min(float(psnr(prediction, truth, mask)), PSNR_CAP)
    similarity = ssim_map(prediction, truth)
    values["ssim"] = float(similarity.mean())
    margin = WINDOW // 2
    inner = mask[:, margin:-margin, margin:-margin]
    values["ssim_fg"] = float(similarity[inner].mean()) if bool(inner.any()) else None
    with torch.inference_mode():
        for name, features in truth_features.items():
            known = (prediction_features or {}).get(name)
            own = nets[name].features(prediction) if known is None else known
            values[f"lpips_{name}"] = float(nets[name].distance(own, features))
    return values


def evaluate(
    pairs: Iterable[Pair],
    *,
    background: Sequence[float],
    nets: Mapping[str, LPIPS],
    foreground_threshold: float = 0.5,
    means: Mapping[str, np.ndarray] | None = None,
    trivial: bool = True,
    device: str = "cpu",
) -> dict:
    """Metrics of every pair, their means, and the same for the trivial answers.

    Args:
        pairs: images, one at a time (nothing is kept but figures).
        background: sRGB in [0, 1] of the protocol.
        nets: LPIPS modules by name, on `device`.
        foreground_threshold: true coverage from which a pixel is foreground, in [0, 1].
        means: result of ``mean_images``.
        trivial: judge the trivial answers too (LPIPS by the first net only, since it is the costly part).
        device: device of the LPIPS modules, where PSNR and SSIM are computed too (in float64 everywhere).

    Returns:
        ``per_image`` (list of camera, frame and metrics), ``metrics`` (means over images, psnr etc.), ``count``,
        ``empty`` (how many of them show nobody, and have no metrics), ``size`` [W, H], ``digests`` of all predictions
        and truths, ``trivial`` by answer.

    Raises:
        DataError: no pair at all, nobody in any truth, or a prediction of another size than its truth.
    """
    with _restored_settings():
        return _evaluate(pairs, background, nets, foreground_threshold, means, trivial, device)


@contextlib.contextmanager
def _restored_settings() -> Iterator[None]:
    """Full precision on GPUs; puts torch's settings back at the end."""
    before, threads = torch.backends.cudnn.allow_tf32, torch.get_num_threads()
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
        torch.set_num_threads(threads)


def _evaluate(
    pairs: Iterable[Pair],
    background: Sequence[float],
    nets: Mapping[str, LPIPS],
    foreground_threshold: float,
    means: Mapping[str, np.ndarray] | None,
    trivial: bool,
    device: str,
) -> dict:
    per_image: list[dict] = []
    answers: dict[str, list[dict]] = {}
    seen = {"prediction": hashlib.sha256(), "truth": hashlib.sha256()}
    cached: dict[str, tuple[bytes, Tensor, Mapping[str, Sequence[Tensor]]]] = {}
    size: tuple[int, int] | None = None
    first = next(iter(nets), None)
    for pair in pairs:
        where = f"{pair.camera}/{pair.frame}"
        height, width = pair.rgb.shape[:2]
        if pair.prediction.shape != pair.rgb.shape or pair.alpha.shape != (height, width):
            expected = f"{width}x{height}, as the truth"
            raise DataError.of(
                "render", where, expected=expected, found="x".join(map(str, pair.prediction.shape[1::-1]))
            )
        if size is None:
            size = (width, height)
            if width * height < _SMALL:
                # Small layers end before a second thread has started; on a busy machine waiting for it costs tenfold.
                torch.set_num_threads(1)
        if size != (width, height):
            raise DataError.of("render", where, expected=f"{size[0]}x{size[1]}, as before", found=f"{width}x{height}")
        seen["prediction"].update(where.encode() + pair.prediction.tobytes())
        seen["truth"].update(where.encode() + pair.rgb.tobytes() + pair.alpha.tobytes())
        truth = _tensor(composite(pair.rgb, pair.alpha, background), device)
        mask = torch.from_numpy(foreground(pair.alpha, foreground_threshold))[None].to(device)
        with torch.inference_mode():
            features = {name: net.features(truth) for name, net in nets.items()}
        prediction = _tensor(pair.prediction.astype(np.float32) / np.float32(255), device)
        values = measure(prediction, truth, mask, nets, features)
        if pair.coverage is not None:
            shown = bool(mask.any())
            over, under = silhouette_error(pair.coverage, pair.alpha)
            values |= {"over": over if shown else None, "under": under if shown else None}
        per_image.append({"camera": pair.camera, "frame": pair.frame, **values})
        if not trivial:
            continue
        for answer, key, version, make in _trivial_answers(pair, background, means):
            if key not in cached or cached[key][0] != version:
                image = _tensor(make(), device)
                with torch.inference_mode():
                    known = {first: nets[first].features(image)} if first is not None else {}
                cached[key] = version, image, known
            _, image, known = cached[key]
            answers.setdefault(answer, []).append(
                measure(image, truth, mask, nets, {name: features[name] for name in known}, known)
            )
    if size is None:
        raise DataError.of("render", expected="one image or more", found="none")
    empty = sum(item["psnr"] is None for item in per_image)
    if empty == len(per_image):
        raise nobody(empty)
    return {
        "per_image": per_image,
        "metrics": _means(per_image),
        "count": len(per_image),
        "empty": empty,
        "size": list(size),
        "digests": {name: "sha256:" + digest.hexdigest() for name, digest in seen.items()},
        "trivial": {answer: _means(values) for answer, values in answers.items()},
    }


def _trivial_answers(
    pair: Pair, background: Sequence[float], means: Mapping[str, np.ndarray] | None
) -> Iterator[tuple[str, str, bytes, Callable[[], np.ndarray]]]:
    """(answer, key under which its image is kept, which version of it, function that makes the image)."""
    shape = pair.rgb.shape

    def empty() -> np.ndarray:
        return np.broadcast_to(np.asarray(background, dtype=np.float32), shape).copy()

    yield "background", "background", b"", empty
    camera = pair.camera if means and pair.camera in means else ""
    if means and camera in means:
        if means[camera].shape != shape:
            expected = f"{shape[1]}x{shape[0]}, as the truth"
            found = "x".join(map(str, means[camera].shape[1::-1]))
            raise DataError.of("training images", expected=expected, found=found)

        def mean() -> np.ndarray:
            return means[camera] if pair.unseen is None else np.where(pair.unseen[..., None], empty(), means[camera])

        version = b"" if pair.unseen is None else pair.unseen.tobytes()
        yield "mean_image", f"mean of {camera}", version, mean


def _means(values: Sequence[Mapping[str, object]]) -> dict[str, float | None]:
    """Mean of each metric over the images that have it; summed exactly, so the order does not matter."""
    names = [name for name in values[0] if name not in ("camera", "frame")]
    result: dict[str, float | None] = {}
    for name in names:
        present = [value for item in values if isinstance(value := item[name], float)]
        result[name] = math.fsum(present) / len(present) if present else None
    return result


def _tensor(image: np.ndarray, device: str) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None].to(device)
