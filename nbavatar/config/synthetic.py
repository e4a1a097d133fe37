"""Options of the synthetic dataset. Standard library only."""

import dataclasses
import json
import os
from pathlib import Path

from nbavatar.config.core import option
from nbavatar.errors import ConfigError

__all__ = ["CAMERAS", "HAIR", "RECORD", "SUBJECTS", "SynthesizeConfig", "refuse_others"]

RECORD = "synthetic.json"
"""By this file in it a synthetic dataset is known; it is there before anything else."""

CAMERAS = ("084", "100", "102", "108", "110", "111", "121", "122")
"""Camera ids of the release."""

SUBJECTS = ("S1", "S2", "S3", "S4", "S5", "S6", "S7", "S8")
"""Subjects of the release; S1, S3 and S6 lie in its folder `test`, the others in `train`."""

HAIR = ("cap", "ponytail", "long", "beard")
"""Styles of hair: on the scalp only, or also a ponytail, long hair over the shoulders, a full beard."""


@dataclasses.dataclass(frozen=True)
class SynthesizeConfig:
    """Synthetic subjects: a complete dataset in the layout of the Decaf release, body models included, or captures."""

    layout: str = option(
        "decaf", "Layout of the Decaf release, or one capture a subject (pinholes, exact masks, meshes).",
        choices=("decaf", "capture"),
    )  # fmt: skip
    hair: str = option(
        "cap",
        "Hair: on the scalp only, or also what no mesh has: a ponytail, long hair over the shoulders, a full beard.",
        choices=HAIR,
    )

    subjects: tuple[str, ...] = option(("S1", "S2", "S3", "S4"), "Subjects to make.", choices=SUBJECTS)
    cameras: tuple[str, ...] = option(CAMERAS, "Cameras to render.", choices=CAMERAS)
    frames: int = option(120, "Frames a subject; one cut divides them.", min=4, max=100000)
    width: int = option(1920, "Image width [px].", min=32, max=7680)
    height: int = option(1080, "Image height [px].", min=32, max=4320)
    supersample: int = option(2, "Samples a pixel along x and y.", min=1, max=4)
    mesh: str = option(
        "full", "Body models: 5,023 + 778 vertices like the originals, or 612 + 200.", choices=("full", "tiny")
    )
    focal: float = option(2.9, "Focal length as a multiple of the image height.", min=0.5, max=20.0)
    distortion: float = option(1.0, "Factor on the lens distortion; 0 for ideal pinholes.", min=0.0, max=2.0)
    press: float = option(6.0, "How deep the hand would reach into the undeformed face [mm].", min=0.0, max=15.0)
    keypoint_noise: float = option(1.5, "Standard deviation of keypoints at 1080 lines [px].", min=0.0, max=50.0)
    missing: float = option(0.03, "Share of keypoints and boxes that are missing.", min=0.0, max=0.9)
    parameter_noise: float = option(
        0.0, "Error of the stored parameters, in multiples of 1 mm and 0.5 degrees.", min=0.0, max=20.0
    )
    mesh_noise: float = option(
        1.0, "Captures: error of the meshes, a rigid motion a part and frame, in multiples of 1 mm and 0.3 degrees.",
        min=0.0, max=20.0,
    )  # fmt: skip
    codec: str = option("mp4v", "FourCC code of the videos.")
    seed: int = option(0, "Seed of everything random.", min=0)


def refuse_others(root: str | os.PathLike[str]) -> None:
    """Lets a synthetic dataset be written only where there is none, or one that was made so: never over other files.

    Raises:
        ConfigError: the folder holds files, and no record of a synthetic dataset.
    """
    try:
        known = "subjects" in json.loads(Path(root, RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError, RecursionError):
        known = False
    if known or not os.path.isdir(root):
        return
    for folder, _, files in os.walk(root):
        for name in files:
            raise ConfigError.of(
                root, expected=f"a folder without files, or a synthetic dataset ({RECORD})",
                found=os.path.relpath(os.path.join(folder, name), root),
                fix="name another folder: what is made would take the place of these files",
            )  # fmt: skip
