"""Training views: frames of the training cameras, decoded once, streamed in a fixed order.

A frame is kept as the smallest rectangle with coverage, uint8 [h, w, 5] (colour, coverage, ignored), which loses
nothing: everything outside is background. Memory is bounded by the cache's size plus a handful of frames in flight;
what does not fit is decoded again when its turn comes, in a background thread, ahead of its use. The order depends on
seed and step only, so neither timing nor cache size changes a result.
"""

import functools
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nbavatar.camera.pinhole import project
from nbavatar.data.sequences import PARTS
from nbavatar.errors import DataError
from nbavatar.io.framepack import FramePack, unseen_in

__all__ = ["Sample", "View", "ViewStore", "ViewStream", "check_views", "shuffled", "views_of"]


class View(NamedTuple):
    """One training picture: which pack (camera), which frame, the row of its mesh, and the camera.

    Attributes:
        pack: index of the camera's frame pack.
        camera, frame: ids.
        row: row of the frame in the mesh sequence.
        width, height: image size [px].
        K: intrinsics, float32 (3, 3) [px].
        viewmat: world to camera, float32 (4, 4).
    """

    pack: int
    camera: str
    frame: str
    row: int
    width: int
    height: int
    K: Tensor
    viewmat: Tensor


class Sample(NamedTuple):
    """One decoded picture at the resolution of the current stage.

    Attributes:
        view: where it comes from (intrinsics and sizes at full resolution).
        pixels: premultiplied colour (3), coverage (1) and ignored share (1), float32 (5, h, w) in [0, 1].
        x0, y0: where the rectangle lies in the picture [px].
        width, height: size of the picture at this resolution [px].
        K: intrinsics at this resolution, (3, 3).
    """

    view: View
    pixels: Tensor
    x0: int
    y0: int
    width: int
    height: int
    K: Tensor


def views_of(
    packs: Sequence[FramePack], frames: Sequence[str], chosen: Sequence[Sequence[str]], layers: Sequence[str] = ()
) -> list[View]:
    """Views of chosen frames, in the order camera, time.

    Args:
        packs: one opened frame pack per camera.
        frames: frame ids of the mesh sequence.
        chosen: frame ids of every pack.
        layers: layers that every pack must have.

    Raises:
        DataError: a pack lacks a layer, a chosen frame has no mesh, or no view is left.
    """
    rows = {frame: row for row, frame in enumerate(frames)}
    views = []
    for index, (pack, names) in enumerate(zip(packs, chosen, strict=True)):
        for layer in layers:
            if layer not in pack.layers:
                found = ", ".join(pack.layers)
                raise DataError.of(
                    pack.path, "layers", expected=layer, found=found, fix="use the packs of `nbavatar crop`"
                )
        camera = torch.tensor(pack.cam_from_world, dtype=torch.float32)
        for frame in names:
            if frame not in rows:
                raise DataError.of(pack.path, f"frame {frame}", expected="a mesh of that frame", found="none")
            views.append(
                View(
                    index,
                    str(pack.manifest["camera"]),
                    frame,
                    rows[frame],
                    int(pack.manifest["width"]),
                    int(pack.manifest["height"]),
                    torch.tensor(pack.intrinsics(frame), dtype=torch.float32),
                    camera,
                )
            )
    if not views:
        names = ", ".join(str(pack.path) for pack in packs) or "no frame packs"
        raise DataError.of(names, "split", expected="at least one frame of the split", found="none")
    return views


def check_views(
    packs: Sequence[FramePack], views: Sequence[View], meshes: Mapping[str, np.ndarray], *, mesh_file: str
) -> None:
    """Looks for one vertex that projects onto a covered pixel: without any, there is nothing to be learnt.

    Args:
        packs: opened frame packs with the layer alpha.
        views: from `views_of`.
        meshes: part -> vertices `[N, V, 3]` [m, world], a row for each frame of the sequence.
        mesh_file: named in the error.

    Raises:
        DataError: no view has a covered pixel, or none has one where the meshes are.
    """
    covered = False
    for index in np.random.default_rng(0).permutation(len(views)):  # nearly always the first will do
        view = views[index]
        alpha = packs[view.pack].read("alpha", view.frame)
        covered = covered or bool(alpha.any())
        points = np.concatenate([verts[view.row] for verts in meshes.values()]).astype(np.float64)
        points = points[np.isfinite(points).all(1)]
        pixels, depth = project(points, view.K.double().numpy(), view.viewmat.double().numpy())
        x, y = np.floor(np.where(depth[:, None] > 0, pixels, -1.0)).clip(-1, 1 << 20).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < alpha.shape[1]) & (y < alpha.shape[0])
        if alpha[y[inside], x[inside]].any():
            return
    if not covered:
        where = ", ".join(str(pack.path) for pack in packs)
        raise DataError.of(where, "alpha", expected="covered pixels in a training view", found=f"none in {len(views)}")
    raise DataError.of(
        mesh_file, expected="meshes that project onto the covered pixels of a training view",
        found=f"none in {len(views)} views", fix="see `nbavatar check` on the capture",
    )  # fmt: skip


def shuffled(step: int, count: int, seed: int) -> int:
    """Index of the view used at a step: every epoch is a fresh permutation, fixed by the seed."""
    epoch, place = divmod(step, count)
    return int(_permutation(epoch, count, seed)[place])


@functools.lru_cache(maxsize=4)
def _permutation(epoch: int, count: int, seed: int) -> np.ndarray:
    return np.random.default_rng((seed, epoch)).permutation(count)


class ViewStore:
    """Decoded views with a bounded cache.

    Args:
        packs: opened frame packs.
        views: from `views_of`.
        parts: parts that are modelled; pixels of other labelled parts, and those that say nothing (label 255), are
            marked as ignored.
        cache_bytes: most memory for decoded views [bytes].
    """

    def __init__(
        self, packs: Sequence[FramePack], views: Sequence[View], parts: Sequence[str], cache_bytes: int
    ) -> None:
        self._packs, self._views, self._bound = packs, views, cache_bytes
        self._cache: OrderedDict[int, tuple[np.ndarray, int, int]] = OrderedDict()
        self._excluded = [label for label, part in enumerate(PARTS, start=1) if part not in parts]
        self._lock = threading.Lock()
        self.cached_bytes = 0
        self.decoded = 0

    def sample(self, index: int, shrink: int = 1) -> Sample:
        """One view, its picture made `shrink` times smaller by averaging blocks (a remainder at the far border is
        cut).
        """
        view = self._views[index]
        with self._lock:
            kept, x0, y0 = self._load(index)
        width, height = view.width // shrink, view.height // shrink
        pixels = kept.astype(np.float32) / 255.0
        pixels[..., :3] *= pixels[..., 3:4]
        if shrink > 1:
            pixels, x0, y0 = _average(pixels, x0, y0, shrink)
            pixels = pixels[: max(0, height - y0), : max(0, width - x0)]
        K = view.K.clone()
        K[:2] /= shrink
        planes = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))
        return Sample(view, planes, x0, y0, width, height, K)

    @property
    def side(self) -> int:
        """Shorter side of the smallest picture [px]."""
        return min(min(view.width, view.height) for view in self._views)

    def preview_samples(self, number: int = 2, side: int = 512) -> list[Sample]:
        """A few fixed views spread over cameras and time, no larger than `side`."""
        chosen = sorted({round(i * (len(self._views) - 1) / max(1, number - 1)) for i in range(number)})
        result = []
        for index in chosen:
            shrink = 1
            while min(self._views[index].width, self._views[index].height) // (2 * shrink) >= side // 2 + 1:
                shrink *= 2
            result.append(self.sample(index, shrink))
        return result

    def _load(self, index: int) -> tuple[np.ndarray, int, int]:
        if index in self._cache:
            self._cache.move_to_end(index)
            return self._cache[index]
        view = self._views[index]
        pack = self._packs[view.pack]
        rgb, alpha = pack.read("rgb", view.frame), pack.read("alpha", view.frame)
        for layer, image in (("rgb", rgb), ("alpha", alpha)):
            if image.shape[:2] != (view.height, view.width):
                expected, found = f"{view.width}x{view.height}", f"{image.shape[1]}x{image.shape[0]}"
                raise DataError.of(pack.path, f"{layer}/{view.frame}", expected=expected, found=found)
        ignored = np.zeros_like(alpha)
        if "label" in pack.layers and (self._excluded or pack.manifest.get("unseen")):
            label = pack.read("label", view.frame)
            ignored[np.isin(label, self._excluded) | unseen_in(label)] = 255
            alpha = np.where(ignored > 0, 0, alpha).astype(np.uint8)
        self.decoded += 1
        used = (alpha > 0) | (ignored > 0)
        rows, columns = np.flatnonzero(used.any(1)), np.flatnonzero(used.any(0))
        if len(rows) == 0:
            entry = (np.zeros((0, 0, 5), np.uint8), 0, 0)
        else:
            window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            planes = (rgb[window], alpha[window][..., None], ignored[window][..., None])
            entry = (np.concatenate(planes, axis=2), int(columns[0]), int(rows[0]))
        size = entry[0].nbytes
        while self._cache and self.cached_bytes + size > self._bound:
            _, (dropped, _, _) = self._cache.popitem(last=False)
            self.cached_bytes -= dropped.nbytes
        if size <= self._bound:
            self._cache[index] = entry
            self.cached_bytes += size
        return entry


def _average(pixels: np.ndarray, x0: int, y0: int, shrink: int) -> tuple[np.ndarray, int, int]:
    """Block means of a rectangle at (x0, y0), on the grid of the whole picture.

    Of a block with a pixel that says nothing, nothing is known: half of its colour and coverage is missing.
    """
    height, width, channels = pixels.shape
    if height == 0:
        return pixels, 0, 0
    left, top = x0 % shrink, y0 % shrink
    right, bottom = -(left + width) % shrink, -(top + height) % shrink
    padded = np.pad(pixels, ((top, bottom), (left, right), (0, 0)))
    blocks = padded.reshape(padded.shape[0] // shrink, shrink, padded.shape[1] // shrink, shrink, channels)
    small = blocks.mean((1, 3), dtype=np.float32)
    small[small[..., 4] > 0] = (0.0, 0.0, 0.0, 0.0, 1.0)
    return small, x0 // shrink, y0 // shrink


class ViewStream:
    """Samples in training order, decoded ahead of their use by one background thread.

    Args:
        store: where they come from.
        count: number of views.
        seed: of the order.
        ahead: how many are prepared in advance; 0 decodes in place.
    """

    def __init__(self, store: ViewStore, count: int, seed: int, ahead: int) -> None:
        self._store, self._count, self._seed, self._ahead = store, count, seed, ahead
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="decode") if ahead > 0 else None
        self._waiting: dict[tuple[int, int], Future[Sample]] = {}

    def get(self, step: int, shrink: int) -> Sample:
        """Sample of one step at the resolution of its stage."""
        if self._pool is None:
            return self._store.sample(shuffled(step, self._count, self._seed), shrink)
        for number in range(step, step + 1 + self._ahead):
            if (number, shrink) not in self._waiting:
                index = shuffled(number, self._count, self._seed)
                self._waiting[number, shrink] = self._pool.submit(self._store.sample, index, shrink)
        wanted = self._waiting.pop((step, shrink))
        # A change of resolution leaves samples of the old one behind.
        for key in [key for key in self._waiting if key[0] <= step or key[1] != shrink]:
            self._waiting.pop(key).cancel()
        return wanted.result()

    def close(self) -> None:
        """Stop the background thread."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
