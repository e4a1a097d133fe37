"""Images of one camera, frame after frame, from either input layout: one frame is in memory at a time."""

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from nbavatar.camera.distortion import checked_coefficients
from nbavatar.camera.pinhole import Camera
from nbavatar.data.capture import Capture, read_rgb
from nbavatar.data.decaf_files import DecafSubject
from nbavatar.data.frame_plan import FramePlan
from nbavatar.errors import DataError
from nbavatar.io.framepack import FramePack, mark_unseen, unseen_in
from nbavatar.io.video import probe_video, read_video
from nbavatar.preprocess.capture_masks import CameraMasks
from nbavatar.preprocess.clean import spread_labels

__all__ = ["LAYERS", "camera_of", "capture_images", "capture_layers", "decaf_images", "frame_masks"]

LAYERS = {
    "rgb": "colour, sRGB, uint8",
    "person": "matte of the whole person as delivered, 0..255",
    "label": "0 background, 1 head, 2 right hand, 3 left hand, 255 unknown",
    "alpha": "coverage of the labelled parts, 0..255",
}


def camera_of(pack: FramePack) -> Camera:
    """The camera of a pack, with the lens that its pictures were recorded with.

    Raises:
        DataError: the coefficients of the lens are no finite numbers of a length that OpenCV knows.
    """
    name, lens = str(pack.manifest["camera"]), pack.manifest.get("distortion")
    if lens is not None:
        lens = checked_coefficients(lens, f"{pack.path}: {name}")
    K = pack.intrinsics(pack.frames[0])
    return Camera(name, int(pack.manifest["width"]), int(pack.manifest["height"]), K, pack.cam_from_world, lens)


def decaf_images(subject: DecafSubject, camera: Camera, plan: FramePlan) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """(frame id, {rgb, person}) of all frames, from the two videos decoded in step.

    Raises:
        DataError: at once, if a video is missing or the mask has another size; on the way, if one is truncated or has
            another number of frames.
    """
    colour = subject.video(camera.name)
    matte = subject.matte(camera.name)
    info = probe_video(matte)
    if (info.width, info.height) != (camera.width, camera.height):
        expected = f"{camera.width} x {camera.height} as in {colour}"
        raise DataError.of(matte, "size", expected=expected, found=f"{info.width} x {info.height}")
    return _in_step(colour, matte, plan)


def _in_step(colour: Path, matte: Path, plan: FramePlan) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    pictures = read_video(colour, indices=plan.numbers, count=plan.count)
    mattes = read_video(matte, indices=plan.numbers, count=plan.count, gray=True)
    for frame in plan.frames:
        picture, person = next(pictures, None), next(mattes, None)
        if picture is None or person is None:  # the readers raise before this when a video is short
            raise DataError.of(colour if picture is None else matte, f"frame {frame}", expected="a frame", found="none")
        yield frame, {"rgb": picture, "person": person}
    for _ in chain(pictures, mattes):  # decodes the rest, which is what finds a truncated file
        pass


def capture_layers(masks: CameraMasks) -> tuple[str, ...]:
    """Layers that `capture_images` will yield, from the kinds of masks that the capture holds.

    Label masks give rgb, label, alpha; mattes, or alpha alone, give rgb and person (to be cut by the meshes), and alpha
    where there is any; a capture with neither gives rgb only, which is enough where masks are supplied separately.
    """
    if masks.mask is not None and masks.mask.kind == "label":
        return ("rgb", "label", "alpha")
    if masks.coverage is not None:
        return ("rgb", "person", "alpha")
    return ("rgb",) if masks.mask is None else ("rgb", "person")


def capture_images(
    capture: Capture, masks: CameraMasks, frames: Sequence[str]
) -> Iterator[tuple[str, dict[str, np.ndarray]]]:
    """Yields (frame id, images of `capture_layers`) of the masks' camera.

    Coverage of labels is the capture's alpha within their reach, or 255 wherever a label is. Where alpha is above zero
    and the label is 0 (hair, soft edges) the label is taken from the nearest labelled pixel, so that every covered
    pixel belongs to a part.
    """
    for frame in frames:
        yield frame, {"rgb": read_rgb(capture, masks.camera, frame), **frame_masks(masks, frame)}


def frame_masks(masks: CameraMasks, frame: str) -> dict[str, np.ndarray]:
    """The layers of `capture_layers` but rgb, of one frame."""
    layers, mask, alpha = capture_layers(masks), masks.read_mask(frame), masks.read_coverage(frame)
    images: dict[str, np.ndarray] = {}
    if "label" in layers:
        assert mask is not None
        if alpha is None:
            alpha = np.where(mask > 0, np.uint8(255), np.uint8(0))
        images["label"], images["alpha"] = _agree(mask, alpha)
    elif "person" in layers:
        person = mask if mask is not None else alpha
        assert person is not None
        images["person"] = person
        if alpha is not None:
            images["alpha"] = alpha
    return images


def _agree(label: np.ndarray, alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels spread to all covered pixels, that of pixels that say nothing too (the soft edge of a garment is the
    garment's); labels of parts where nothing is covered are dropped.
    """
    label = np.where((alpha > 0) | unseen_in(label), label, np.uint8(0))
    orphan = (alpha > 0) & (label == 0)
    if orphan.any():
        label = np.where(orphan, spread_labels(label), label)
    alpha = np.where(label > 0, alpha, np.uint8(0))
    mark_unseen(label, alpha, unseen_in(label))
    return label, alpha
