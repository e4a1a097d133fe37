"""All results of a run as one tidy table: one number a row, ready for pandas.

    column         meaning
    run            name of the run
    subject        subject
    variant        variant
    protocol       protocol of the evaluation; empty for timings
    view           camera of the image that was judged
    frame          frame of the image that was judged
    metric         name of the number, see below
    value          the number, float64 with all its digits
    unit           dB, ms, MB, min, or 1 where it has none
    protocol_hash  digest of the protocol and of the options of the evaluation
    size           size of the images [px], as 1024x1024
    source         file that the number is read from
    digest         sha256:<hex> of the bytes of that file

View and frame are both empty where a number is of the whole: the mean over all images, a timing, the cost of a
training. Metrics are those of ``nbavatar evaluate`` (psnr, ssim, lpips_vgg, lpips_alex, psnr_fg, ssim_fg), the same of
the trivial answers (background.psnr, mean_image.psnr, ...), what the training took (primitives, model_mb,
train_minutes, train_memory_mb), and of ``nbavatar speed`` memory_mb and one time a stage (ms.raster, ms.total_fp32).

In a notebook (identifiers stay text):

    results = pandas.read_csv("results/paper/results.csv", dtype={name: str for name in ("subject", "view", "frame")})
"""
# pyright: reportArgumentType=false, reportReturnType=false
# The stubs of pandas take a column for a table and know one kind of key.

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from nbavatar.errors import DataError
from nbavatar.reporting.cells import Source, style_of

__all__ = ["COLUMNS_OF_RESULTS", "Result", "tidy_results"]

Result = tuple[Mapping[str, Any], Source]

COLUMNS_OF_RESULTS = (
    "run", "subject", "variant", "protocol", "view", "frame", "metric", "value", "unit", "protocol_hash", "size",
    "source", "digest",
)  # fmt: skip
# Metric -> key in the record of a training, divisor.
_TRAINING = {
    "primitives": ("primitives", 1.0),
    "model_mb": ("model_bytes", 1e6),
    "train_minutes": ("train_seconds", 60.0),
    "train_memory_mb": ("peak_memory_mb", 1.0),
}


def tidy_results(results: Sequence[Result], run: str = "", *, images: bool = True) -> pd.DataFrame:
    """The table that the module describes.

    Args:
        results: content and source of each file of ``nbavatar evaluate`` and ``nbavatar speed``; each content has its
            ``subject`` and ``variant``.
        run: name of the run.
        images: with one row for each image and metric, or with the numbers of the whole only.

    Returns:
        One row a number, in the order of the results; numbers that a result has not are left out.

    Raises:
        DataError: two results of the same subject, variant and protocol.
    """
    parts = []
    known: dict[tuple[str, str, str], str] = {}
    for content, source in results:
        judged = "metrics" in content
        identity = str(content["subject"]), str(content["variant"]), content["protocol"]["name"] if judged else ""
        if identity in known:
            raise DataError.of(source.path, expected="one result a cell", found=f"the same cell in {known[identity]}")
        known[identity] = source.path
        rows = [("", "", metric, value) for metric, value in (_evaluated if judged else _timed)(content).items()]
        if images and judged:
            rows += [
                (image["camera"], image["frame"], metric, image.get(metric))
                for image in content["per_image"]
                for metric in content["metrics"]
            ]
        part = pd.DataFrame(rows, columns=["view", "frame", "metric", "value"]).dropna(subset="value")
        size = "x".join(map(str, source.size or ()))
        origin = {"protocol_hash": source.protocol_hash, "size": size, "source": source.path, "digest": source.digest}
        names = dict(zip(("subject", "variant", "protocol"), identity, strict=True))
        parts.append(part.astype({"value": float}).assign(run=run, **names, **origin))
    table = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=COLUMNS_OF_RESULTS)
    units = {metric: style_of(metric).unit for metric in table["metric"].unique()}
    return table.assign(unit=table["metric"].map(units))[list(COLUMNS_OF_RESULTS)]


def _evaluated(content: Mapping[str, Any]) -> dict[str, Any]:
    numbers = dict(content["metrics"])
    for answer, metrics in (content.get("trivial") or {}).items():
        numbers |= {f"{answer}.{metric}": value for metric, value in metrics.items()}
    training = content.get("training") or {}
    found = {metric: (training.get(key), divisor) for metric, (key, divisor) in _TRAINING.items()}
    return numbers | {metric: v / divisor for metric, (v, divisor) in found.items() if v is not None}


def _timed(content: Mapping[str, Any]) -> dict[str, Any]:
    speed = content["speed"]
    numbers = {f"ms.{stage}": value for stage, value in speed["ms"].items()}
    return {metric: value for metric, value in (numbers | {"memory_mb": speed.get("peak_memory_mb")}).items() if value}
