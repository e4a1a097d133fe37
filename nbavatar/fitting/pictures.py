"""Which pictures of a fitted sequence go on its contact sheet."""

from collections.abc import Mapping, Sequence

import numpy as np

from nbavatar.data.sequences import MeshSequence
from nbavatar.fitting.sheet import View, draw_sheet
from nbavatar.io.framepack import FramePack

__all__ = ["contact_sheet"]


def contact_sheet(
    fitted: MeshSequence, packs: Mapping[str, FramePack], *, frames: int, cameras: int, tile: int
) -> np.ndarray:
    """Draws frames spread over the sequence, the worst fitted one among them, in a few cameras.

    Args:
        fitted: result of `stage.fit_sequence`.
        packs: camera -> frame pack with the layer `rgb`; cameras without one are drawn on grey.
        frames: number of rows.
        cameras: number of columns.
        tile: height of a picture [px].

    Returns:
        uint8 `[H, W, 3]`.
    """
    names = [str(name) for name in fitted.extras["reprojection.cameras"]]
    spread = np.linspace(0, len(names) - 1, min(cameras, len(names))).round().astype(int)
    columns = [names[i] for i in dict.fromkeys(spread)]
    rows = [[_view(fitted, packs, camera, index) for camera in columns] for index in _choose(fitted, frames)]
    parts = [part for part in fitted.parts if f"convergence.{part}" in fitted.extras]
    curves = {part: fitted.extras[f"convergence.{part}"] for part in parts}
    errors = {
        part: (fitted.extras[f"reprojection.{part}.before"], fitted.extras[f"reprojection.{part}.after"])
        for part in parts
    }
    return draw_sheet(rows, curves, errors, names, tile=tile)


def _choose(fitted: MeshSequence, count: int) -> Sequence[int]:
    total = len(fitted.frames)
    even = {int(i) for i in np.linspace(0, total - 1, min(count, total)).round()}
    errors = [value for name, value in fitted.extras.items() if name.startswith("fit_error.")]
    worst = int(np.max(errors, axis=0).argmax())
    if worst not in even and len(even) > 1:
        even.discard(min(even, key=lambda i: abs(i - worst)))
    return sorted(even | {worst})[: max(count, 1)]


def _view(fitted: MeshSequence, packs: Mapping[str, FramePack], camera: str, index: int) -> View:
    extras, frame = fitted.extras, fitted.frames[index]
    pack = packs.get(camera)
    image = None
    if pack is not None and "rgb" in pack.layers and frame in pack.frames:
        image = pack.read("rgb", frame)
    K = np.asarray(extras[f"camera.{camera}.K"], np.float64)
    default = (2 * K[0, 2], 2 * K[1, 2])
    size = np.asarray(extras.get(f"camera.{camera}.size", default)).round().astype(int)
    distortion = extras.get(f"camera.{camera}.distortion")
    row = [str(name) for name in extras["reprojection.cameras"]].index(camera)
    keypoints = {}
    for part in fitted.parts:
        name = f"keypoints.{part}.{camera}"
        if name in extras and f"explained.{part}" in extras:
            kind = extras[f"explained.{part}"][row, index].astype(np.float64)
            keypoints[part] = np.concatenate([extras[name][index, :, :2], kind[:, None]], axis=1)
    return View(
        f"{camera}  frame {frame}",
        image,
        (int(size[0]), int(size[1])) if image is None else (image.shape[1], image.shape[0]),
        K,
        np.asarray(extras[f"camera.{camera}.cam_from_world"], np.float64),
        distortion if distortion is not None and np.any(distortion) else None,
        {name: (part.verts[index].astype(np.float64), part.faces) for name, part in fitted.parts.items()},
        keypoints,
    )
