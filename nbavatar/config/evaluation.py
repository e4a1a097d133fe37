"""Options of evaluation, tables and report: protocols as data.

In this field a protocol's details move PSNR more than methods do, so every one of them is a value here, is hashed
into each result, and is printed in the captions.
"""

import hashlib
import json
from dataclasses import dataclass

from nbavatar.config.core import option, to_mapping

__all__ = ["PROTOCOLS", "EvaluateConfig", "ProtocolConfig", "ReportConfig", "SpeedConfig", "TableConfig", "VideoConfig"]
__all__ += ["protocol_hash"]

AUTO, EAGER = "auto", "eager"
ENGINES = (AUTO, EAGER, "openvino", "onnxruntime")
"""What may decode pictures (`nbavatar.methods.billboards.engine`): the best that is installed, torch, or others."""


@dataclass(frozen=True)
class SpeedConfig:
    """Timing of a trained avatar."""

    frames: int = option(8, "Different frames that are timed.", min=1)
    repeats: int = option(20, "Timed passes over each stage.", min=1)
    warmup: int = option(3, "Passes before timing starts.", min=0)
    precisions: list[str] = option(
        ["fp32", "bf16"], "Arithmetics of the U-Net to time.", choices=("fp32", "bf16", "fp16")
    )


@dataclass(frozen=True)
class ProtocolConfig:
    """Which images are compared: crop, frames, background, and how the avatar is rendered for it."""

    name: str = option("", "Name, for captions: nv1024, sr1024, nv512, sr512 are the paper's.")
    crop: str = option("center", "Name of the crop (see `crops`) whose frames are compared.")
    split: str = option(
        "novel_view",
        "novel_view: training frames in the held-out camera; self_reenactment: held-out frames in the training "
        "cameras; all: every frame of the cameras given.",
        choices=("novel_view", "self_reenactment", "all"),
    )
    limit: int | None = option(None, "At most this many frames a camera, evenly spaced; all by default.", min=1)
    background: list[float] = option(
        [1.0, 1.0, 1.0], "Colour behind avatar and truth, sRGB in [0, 1].", min=0.0, max=1.0
    )
    precision: str = option("fp32", "Arithmetic of the neural renderer.", choices=("fp32", "bf16", "fp16"))
    order: str | None = option(None, "Compositing order of the rasterizer; the model's own by default.")
    roi: bool | None = option(None, "Decode only a window around the avatar; the model's own choice by default.")
    preset: str = option(
        "", "Setting measured by `nbavatar tradeoff` that pictures are rendered with: accurate, balanced, fast; empty: "
        "precision, order and window as said here.",
    )  # fmt: skip
    refined: bool = option(True, "Use the per-frame refinement of training frames, where the model has one.")


@dataclass(frozen=True)
class EvaluateConfig:
    """How two images are compared."""

    nets: list[str] = option(["alex", "vgg"], "LPIPS backbones.", choices=("alex", "vgg"))
    foreground_threshold: float = option(
        0.5, "Pixels of at least this ground-truth coverage are the foreground of the masked metrics.", min=0.0, max=1.0
    )
    trivial: bool = option(True, "Also judge the trivial answers: background only, mean training image.")
    mean_frames: int = option(64, "Frames a camera, evenly spaced, that make up the mean training image.", min=1)
    device: str = option(
        "auto", "Device of all metrics; it moves no digit that a table shows.", choices=("auto", "cpu", "cuda")
    )


@dataclass(frozen=True)
class TableConfig:
    """Tables."""

    lpips_net: str = option(
        "vgg",
        "Backbone shown in the LPIPS columns; the paper names none, a commented-out sentence in its source says VGG. "
        "The others are in the csv.",
        choices=("alex", "vgg"),
    )
    difference: str = option(
        "comparable",
        "Where the difference from the paper's printed numbers stands: beside results that are comparable, or beside "
        "all of the paper's image sizes (a rehearsal), which the caption then says.",
        choices=("comparable", "size"),
    )


@dataclass(frozen=True)
class ReportConfig:
    """HTML report."""

    title: str = option("NBAvatar: results", "Title of the page.")
    frames: int = option(3, "Frames shown per subject, variant and protocol, evenly spaced.", min=1, max=50)
    max_side: int = option(512, "Pictures are reduced to this side [px]; the files themselves are not.", min=32)
    video_mb: float = option(4.0, "Videos up to this size are put into the page, larger ones linked [MB].", min=0.0)


@dataclass(frozen=True)
class VideoConfig:
    """Videos."""

    fps: float = option(25.0, "Frames a second [1/s].", min=0.1)
    seconds: float = option(4.0, "Length of a turntable [s].", min=0.1)
    arc: float = option(360.0, "How far a turntable goes; below 360 it swings out and back [degrees].", min=1, max=360)
    max_frames: int | None = option(None, "At most this many frames of a driven sequence; all by default.", min=1)
    codec: str = option(
        "vp09", "vp09 plays in browsers; mp4v encodes faster, for players only.", choices=("vp09", "mp4v")
    )


PROTOCOLS = {
    "nv1024": ProtocolConfig(name="nv1024", crop="center", split="novel_view"),
    "sr1024": ProtocolConfig(name="sr1024", crop="center", split="self_reenactment"),
    "nv512": ProtocolConfig(name="nv512", crop="box", split="novel_view"),
    "sr512": ProtocolConfig(name="sr512", crop="box", split="self_reenactment"),
}


def protocol_hash(protocol: ProtocolConfig, metrics: EvaluateConfig) -> str:
    """12 hex digits that name everything in a protocol that moves a number.

    The device and whether trivial answers are judged do not; frames and sizes are digested apart, from the files.
    """
    said = to_mapping(protocol)
    if not protocol.preset:  # figures from before there were presets keep their names
        del said["preset"]
    values = {
        "protocol": said,
        "nets": sorted(metrics.nets),
        "foreground_threshold": metrics.foreground_threshold,
    }
    text = json.dumps(values, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]
