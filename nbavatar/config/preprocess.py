"""Options of the stages that turn a dataset into training images: ingest, tracks, masks, crop."""

import dataclasses

from nbavatar.config.core import option

__all__ = [
    "MATTE_THRESHOLD",
    "CheckConfig",
    "CropConfig",
    "FramesConfig",
    "IngestConfig",
    "MasksConfig",
    "TracksConfig",
]

MATTE_THRESHOLD = 127
"""A matte above this is foreground, unless the options of `masks` say otherwise [0..255]."""


@dataclasses.dataclass(frozen=True)
class FramesConfig:
    """Which frames are used and which of them are held out; the same for all cameras of a subject."""

    start: int = option(0, "First frame used [frames].", min=0)
    every: int = option(1, "Use one frame in so many [frames].", min=1)
    max_frames: int = option(0, "Use at most so many frames, 0 = all.", min=0)
    test_fraction: float = option(
        0.2, "Share of each uncut run that is held out as one contiguous block (of each piece, see test_blocks).",
        min=0.0, max=0.9,
    )  # fmt: skip
    test_blocks: int = option(1, "Pieces into which each uncut run is divided; each holds out its last part.", min=1)
    pixel_center: float = option(
        0.5, "Where the dataset's camera matrices put the centre of pixel (0, 0) [px]: 0.5, or 0 as OpenCV does.",
        choices=(0.0, 0.5),
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class CheckConfig:
    """What is done about the defects of a capture."""

    stop: bool = option(True, "Whether defects stop the run before anything is made of the capture, or are only said.")


@dataclasses.dataclass(frozen=True)
class IngestConfig(FramesConfig):
    """Video or image folder to frame pack."""


@dataclasses.dataclass(frozen=True)
class TracksConfig(FramesConfig):
    """Dataset parameters, or a capture's meshes, to one mesh sequence."""

    contact: str = option(
        "solve",
        "solve: heads enter undeformed by contact (a capture's head_rigid where it has one) and the deform stage adds "
        "the contact; given: a capture's final heads are taken as they are.",
        choices=("solve", "given"),
    )
    shape_tolerance: float = option(
        1.0e-3, "Largest allowed deviation of a frame's shape parameters from the subject's own shape [1].", min=0.0
    )
    rotation_tolerance: float = option(
        1.0e-3, "Largest allowed element-wise deviation of the stored head poses from the head rotations [1].", min=0.0
    )


@dataclasses.dataclass(frozen=True)
class MasksConfig:
    """Person matte, or masks supplied by the user, to part labels and coverage."""

    supplied: str = option(
        "",
        "Folder with masks of your own, used instead of the dataset's: [<subject>/]<camera>/<frame>.png or "
        "[<subject>/]<camera>.mp4; labels 0..3 and 255 (not in lossy files), or mattes of the person, to be cut by the "
        "meshes.",
    )
    threshold: int = option(
        MATTE_THRESHOLD, "A matte above this is foreground; mask videos are lossy [0..255].", min=0, max=254
    )
    keep: str = option(
        "parts",
        "What of a matte is labelled: parts, what the meshes say is head or hand; person, all of it (hair of any "
        "length, shoulders, arms), as head where no hand is. Billboards start on the meshes all the same.",
        choices=("parts", "person"),
    )
    hair_margin: float = option(0.06, "How far hair may stand off the scalp of the head mesh [m].", min=0.0)
    neck_margin: float = option(0.012, "How far the neck and the jaw may stand off the mesh [m].", min=0.0)
    hand_margin: float = option(0.008, "How far the hand may stand off the mesh [m].", min=0.0)
    forearm_length: float = option(
        0.12, "Length of the stretch beyond the wrist that is cut from the head [m].", min=0.0
    )
    clothes: bool = option(True, "Tell collars from necks by colour (mattes only) and leave them out.")
    clothes_evidence: float = option(
        1.0, "How much likelier cloth has to be than head, as a natural logarithm [1].", min=0.0
    )
    covered: str = option(
        "background",
        "What pixels of a matte count as where a collar or a sleeve, neither head nor hand, hides a mesh: background; "
        "or unknown, which training and evaluation ignore. Masks with labels say so by 255.",
        choices=("background", "unknown"),
    )
    hole_fraction: float = option(0.002, "Holes smaller than this share of the part are filled [1].", min=0.0, max=1.0)
    island_fraction: float = option(
        0.02, "Islands smaller than this share of the part are removed [1].", min=0.0, max=1.0
    )
    temporal: bool = option(True, "Repair flicker of single frames where the meshes agree with both neighbours.")
    soft_alpha: bool = option(False, "Keep the matte's own grey values at the border as coverage instead of 0 and 255.")


@dataclasses.dataclass(frozen=True)
class CropConfig:
    """Undistort, crop and resize."""

    kind: str = option(
        "center",
        "center: largest centred square; box: square over the tracked head and hand; full: the whole frame.",
        choices=("center", "box", "full"),
    )
    size: int = option(1024, "Side of the result [px]; 0 keeps the native scale.", min=0, max=8192)
    pad: float = option(0.1, "box: margin on each side as a share of the box [1].", min=0.0, max=2.0)
    per_frame: bool = option(False, "box: one box a frame, of one size, instead of one box for the sequence.")
    multiple: int = option(32, "full: the side is padded up to a multiple of this [px].", min=1, max=256)
    undistort: bool = option(True, "Remove lens distortion where a camera has coefficients.")
    edge_color: bool = option(
        False, "Replace colours of partly covered pixels by estimated foreground colours, free of the backdrop."
    )
