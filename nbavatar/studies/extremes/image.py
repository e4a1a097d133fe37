"""Cells of boxes, masks and foreground colours: empty, full, one pixel, missing detections."""

import math

import numpy as np
import torch

from nbavatar.methods.billboards.billboards import Posed
from nbavatar.methods.billboards.region import region_of, visible_box
from nbavatar.preprocess.boxes import fill_missing, square_window, union_box
from nbavatar.preprocess.clean import clean_labels, repair_flicker, spread_labels, threshold_matte
from nbavatar.preprocess.foreground import estimate_foreground
from nbavatar.studies.extremes.cells import Level, Limit, Refusal, Sample, Tolerance, cell
from nbavatar.studies.extremes.compare import relative

__all__: list[str] = []

_EQUAL = Tolerance(0.0, 0.0)


@cell(
    "image",
    "union_box",
    "share of missing boxes",
    "missing [1]",
    (0.0, 0.5, 0.9, 1.0),
    oracle="box of the valid rows",
    exact=_EQUAL,
    refuses=lambda share: share == 1.0,
)
def _union(share: float) -> Sample | Refusal:
    boxes = _boxes(share)
    found = union_box(boxes)
    valid = boxes[np.isfinite(boxes).all(1)]
    if not len(valid):
        return Refusal("NaN: no valid box") if np.isnan(found).all() else Sample(math.nan)
    return Sample(relative(found, [*valid[:, :2].min(0), *valid[:, 2:].max(0)]))


def _boxes(share: float) -> np.ndarray:
    random = np.random.default_rng(0)
    low = random.uniform(0, 50, (10, 2))
    boxes = np.concatenate((low, low + random.uniform(10, 40, (10, 2))), 1)
    boxes[: round(10 * share), 1] = np.nan
    return boxes


@cell(
    "image",
    "fill_missing",
    "share of missing boxes",
    "missing [1]",
    (0.0, 0.5, 0.9, 1.0),
    oracle="the nearest valid row before the first",
    exact=_EQUAL,
    refuses=lambda share: share == 1.0,
)
def _fill(share: float) -> Sample | Refusal:
    boxes = _boxes(share)
    found = fill_missing(boxes)
    first = round(10 * share)
    if first == 10:
        return Refusal("NaN: no valid box") if np.isnan(found).any(1).all() else Sample(math.nan)
    return Sample(relative(found, np.concatenate((np.tile(boxes[first], (first, 1)), boxes[first:]))))


@cell(
    "image",
    "square_window",
    "box",
    "case",
    ("inside", "one point", "larger than the image", "outside the image", "1e6 px away", "inverted"),
    oracle="square; inside the image, or holding all of it",
    exact=_EQUAL,
)
def _window(case: Level) -> Sample:
    box = {
        "inside": [20.0, 30, 60, 50],
        "one point": [20.0, 20, 20, 20],
        "larger than the image": [-50.0, -50, 900, 700],
        "outside the image": [200.0, 200, 240, 240],
        "1e6 px away": [1e6, 1e6, 1e6 + 10, 1e6 + 10],
        "inverted": [60.0, 50, 20, 30],
    }[str(case)]
    width, height = 100, 80
    x0, y0, side = square_window(np.array(box), width, height, pad=0.1)
    good = side >= 2
    for first, limit in ((x0, width), (y0, height)):
        good &= (0 <= first <= limit - side) if side <= limit else (first <= 0 and first + side >= limit)
    return Sample(0.0 if good else math.nan)


@cell(
    "image",
    "clean_labels",
    "labels",
    "case",
    ("empty", "full", "one pixel", "checkerboard", "one-pixel image", "empty support"),
    quick=("empty", "full"),
    oracle="no label that was not there; whole parts stay",
    exact=_EQUAL,
)
def _clean(case: Level) -> Sample:
    label = np.zeros((24, 32), np.uint8)
    support = label.copy()
    if case == "full":
        label[:] = support[:] = 1
    elif case == "one pixel":
        label[5, 6] = support[5, 6] = 2
    elif case == "checkerboard":
        label[::2, ::2] = label[1::2, 1::2] = 1
        support[:] = 1
    elif case == "one-pixel image":
        label = support = np.ones((1, 1), np.uint8)
    elif case == "empty support":
        label[4:20, 4:20] = 3
    found = clean_labels(label, support, hole_fraction=0.05, island_fraction=0.05)
    known = set(np.unique(label)) | set(np.unique(support)) | {0}
    kept = case == "checkerboard" or (found >= label).all()
    spread = spread_labels(label)
    filled = (spread > 0).all() if label.any() else not spread.any()
    still = np.array_equal(repair_flicker(label, label, label, support), label)
    return Sample(0.0 if set(np.unique(found)) <= known and kept and filled and still else math.nan)


@cell(
    "image",
    "threshold_matte",
    "matte",
    "case",
    ("all 0", "all 255", "one white pixel", "constant at the threshold"),
    oracle="count of foreground pixels",
    exact=_EQUAL,
)
def _matte(case: Level) -> Sample:
    matte = np.zeros((9, 9), np.uint8)
    if case == "all 255":
        matte[:] = 255
    elif case == "one white pixel":
        matte[4, 4] = 255
    elif case == "constant at the threshold":
        matte[:] = 128
    return Sample(abs(float(threshold_matte(matte, 128).sum()) - (81.0 if case == "all 255" else 0.0)))


@cell(
    "image",
    "estimate_foreground",
    "coverage",
    "coverage [1/255]",
    (128.0, 1.0, 254.0, 0.0, 255.0),
    oracle="a constant foreground over a constant backdrop",
    exact=Tolerance(3.0, 1.0),
    unit="grey levels",
    limits=(Limit(lambda coverage: coverage == 128.0, 20.0, 1.0, "fused from blurs: dark far from the full pixels"),),
)
def _foreground(coverage: float) -> Sample:
    """A white disc over black, its rim covered by this much; the rim must become white as far as it can be told."""
    y, x = np.mgrid[:40, :40] - 19.5
    radius = np.hypot(x, y)
    alpha = np.where(radius < 8, 255, np.where(radius < 12, coverage, 0)).astype(np.uint8)
    image = np.repeat(alpha[..., None], 3, 2)
    found = estimate_foreground(image, alpha).astype(np.float64)
    rim = (alpha > 0) & (alpha < 255)
    same = np.array_equal(found[~rim], image[~rim])
    if not same or not np.isfinite(found).all():
        return Sample(math.nan)
    return Sample(float(np.abs(found[rim] - 255).mean()) if rim.any() else 0.0)


@cell(
    "image",
    "region_of",
    "billboards",
    "case",
    ("in view", "none", "behind", "at the camera", "outside the image", "1e6 m away", "of 1e6 m"),
    oracle="projected corners lie in the window",
    exact=_EQUAL,
)
def _region(case: Level) -> Sample:
    means = torch.tensor([[0.0, 0.0, 2.0], [0.1, -0.1, 2.1]])
    extents = torch.full((2, 2), 0.05)
    shift = {"behind": (0, 0, -5.0), "outside the image": (50.0, 0, 0), "1e6 m away": (0, 0, 1e6)}
    means = means + torch.tensor(shift.get(str(case), (0.0, 0.0, 0.0)))
    if case == "none":
        means, extents = means[:0], extents[:0]
    elif case == "at the camera":
        means = means * 0
    elif case == "of 1e6 m":
        extents = extents * 2e7
    posed = Posed(means, torch.tensor([[1.0, 0, 0, 0]]).expand(len(means), 4), extents, torch.zeros_like(means))
    K = torch.tensor([[100.0, 0, 64], [0, 100.0, 48], [0, 0, 1]])
    box = visible_box(posed, torch.eye(4), K, 128, 96)
    region = region_of(posed, torch.eye(4), K, 128, 96, multiple=32, margin=0.1)
    if (box is None) != (case in ("none", "behind", "outside the image")):
        return Sample(math.nan)
    if region.width % 32 or region.height % 32 or region.width < 32 or region.height < 32:
        return Sample(math.nan)
    if case in ("in view", "1e6 m away"):
        corners = means[:, None] + extents[:, None, :1] * torch.tensor(
            [[1.0, 1, 0], [-1, 1, 0], [1, -1, 0], [-1, -1, 0]]
        )
        pixels = corners[..., :2] / corners[..., 2:] * 100 + torch.tensor([64.0, 48.0])
        low = torch.tensor([float(region.x0), float(region.y0)])
        high = low + torch.tensor([float(region.width), float(region.height)])
        return Sample(0.0 if bool(((pixels >= low) & (pixels <= high)).all()) else math.nan)
    return Sample(0.0)
