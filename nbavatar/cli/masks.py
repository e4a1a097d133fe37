"""Head and hand masks of one camera: the person's matte, cut by the posed meshes and cleaned.

Reads a frame pack with `person` (a matte of the whole person, 0..255) or `label` masks, and a mesh sequence (.npz)
with the same frames; or a capture's folders of masks and alpha images (--capture); or masks of your own (--supplied, or
`supplied` in --cfg): FOLDER/[SUBJECT/]CAMERA/FRAME.png or FOLDER/[SUBJECT/]CAMERA.mp4, with labels 0..3 and 255 (images
only, or video without loss) or mattes of the person.

Writes a frame pack of the same frames, size and camera (still distorted):

  label     uint8 [H, W]      0 background, 1 head with neck and hair, 2 right hand, 3 left hand (above the wrist),
                              255 unknown: something else is in front
  alpha     uint8 [H, W]      coverage, 255 = full

Whatever is neither head nor hand (torso, arms) becomes background, unless `keep` is `person`; or 255 where it hides a
mesh, if `covered` is `unknown`. Holes and islands that
the meshes contradict are repaired, and so is what flickers in single frames. The record counts the pixels that each
repair changed.
"""

import argparse
import dataclasses
from collections.abc import Iterator

import numpy as np

from nbavatar.camera.pinhole import Camera
from nbavatar.cli.common import add_cfg_argument, progress, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.preprocess import MasksConfig
from nbavatar.data.capture import open_capture
from nbavatar.data.sequences import read_sequence
from nbavatar.errors import DataError
from nbavatar.io.framepack import FramePack, FramePackWriter
from nbavatar.preprocess.capture_masks import CameraMasks, open_masks
from nbavatar.preprocess.clothes import ClothesModel
from nbavatar.preprocess.masking import MaskNumbers, MaskStatistics, cut_masks
from nbavatar.preprocess.part_masks import Margins, PartCutter
from nbavatar.preprocess.sources import LAYERS, camera_of, capture_layers, frame_masks
from nbavatar.preprocess.supplied_masks import supplied_masks
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--frames", required=True, metavar="ZIP", help="frame pack of `nbavatar ingest`")
    parser.add_argument(
        "--meshes", required=True, metavar="NPZ", help="mesh sequence of `nbavatar tracks` (or fit, deform)"
    )
    parser.add_argument(
        "--capture", metavar="DIR", help="the capture whose masks to take, where the frame pack has none"
    )
    parser.add_argument("--supplied", metavar="DIR", help="masks of your own, instead of all others")
    parser.add_argument("--out", required=True, metavar="ZIP", help="frame pack to write")
    add_cfg_argument(parser, MasksConfig)


def main(args: argparse.Namespace) -> None:
    """Writes the pack."""
    cfg = stage_config(args, MasksConfig)
    sequence, _ = read_sequence(args.meshes)
    with FramePack(args.frames) as pack:
        manifest, frames = pack.manifest, pack.frames
        sequence.index(frames)
        camera = camera_of(pack)
        margins = Margins(cfg.hair_margin, cfg.neck_margin, cfg.hand_margin, cfg.forearm_length)
        cutter = PartCutter(sequence, camera, margins, whole=cfg.keep == "person")
        runs = [frames[first : last + 1] for first, last in manifest.get("segments", [[0, len(frames) - 1]])]
        numbers = MaskNumbers(
            cfg.threshold, cfg.hole_fraction, cfg.island_fraction, cfg.temporal, cfg.soft_alpha, cfg.covered
        )
        statistics = MaskStatistics()
        supplied = args.supplied or cfg.supplied
        extra = {"subject": manifest["subject"], "camera": camera.name, "supplied": bool(supplied)}
        if args.capture and not supplied:
            capture = open_capture(args.capture)
            found = open_masks(capture, capture.camera(camera.name), frames)
            masks, matte = _capture_masks(found, frames)
            extra["masks"] = found.summary()
        else:
            masks, matte = _masks(pack, supplied, manifest["subject"], camera, tuple(sequence.parts))
        inputs = {"frames": args.frames, "meshes": args.meshes}
        record = run_record("masks", config=to_mapping(cfg), inputs=inputs, extra=extra)
        layers = {name: LAYERS[name] for name in ("label", "alpha")}
        with FramePackWriter(args.out, {**manifest, "stage": "masks", "layers": layers, "record": record}) as out:
            model = ClothesModel(cfg.clothes_evidence) if _sorts_clothes(cfg, pack) else None
            images = {"images": lambda frame: pack.read("rgb", frame), "clothes": model}
            cut = cut_masks(masks, cutter, runs, numbers, statistics, matte=matte, **images)
            for frame, label, alpha in progress(cut, f"masks {manifest['subject']}/{camera.name}", len(frames)):
                out.add("label", frame, label)
                out.add("alpha", frame, alpha)
            record["pixels"] = dataclasses.asdict(statistics)
            out.manifest |= {"unseen": statistics.unseen > 0, "keep": cfg.keep}
            if statistics.labelled == 0:
                raise DataError.of(
                    args.frames, f"camera {camera.name}", expected="pixels of a head or a hand in a frame at least",
                    found=f"none in {len(frames)} frames, after {statistics.dropped} pixels of mattes were dropped",
                    fix="do the meshes project onto the masks? see `nbavatar check`; or leave this camera out",
                )  # fmt: skip


def _sorts_clothes(cfg: MasksConfig, pack: FramePack) -> bool:
    return cfg.clothes and cfg.keep == "parts" and "rgb" in pack.layers


def _capture_masks(
    masks: CameraMasks, frames: list[str]
) -> tuple[Iterator[tuple[str, np.ndarray, np.ndarray | None]], bool]:
    """The same as `_masks`, from a capture's folders."""
    layers = capture_layers(masks)
    if layers == ("rgb",):
        where, fix = masks.root / "masks" / masks.camera.name, "supply masks of your own with --supplied"
        raise DataError.of(where, expected="a mask (or an alpha image) for each frame", found="none", fix=fix)
    read = ((frame, frame_masks(masks, frame)) for frame in frames)
    if "person" in layers:
        return ((frame, images["person"], images.get("alpha")) for frame, images in read), True
    return ((frame, images["label"], images["alpha"]) for frame, images in read), False


def _masks(
    pack: FramePack, supplied: str, subject: str, camera: Camera, parts: tuple[str, ...]
) -> tuple[Iterator[tuple[str, np.ndarray, np.ndarray | None]], bool]:
    """(frame, mask, coverage or None), from the user's files or from the pack; and whether they are mattes."""
    if supplied:
        own, meaning = supplied_masks(supplied, subject, camera, pack.frames, parts)
        return ((frame, mask, None) for frame, mask in zip(pack.frames, own)), meaning.kind == "person"
    alpha = "alpha" in pack.layers
    for layer in ("label", "person"):
        if layer in pack.layers:
            read = ((f, pack.read(layer, f), pack.read("alpha", f) if alpha else None) for f in pack.frames)
            return read, layer == "person"
    fix = "supply masks of your own with --supplied"
    raise DataError.of(pack.path, "layers", expected="person or label", found=", ".join(pack.layers), fix=fix)
