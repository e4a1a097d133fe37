"""Multi-view refit of head and hand models to keypoints, all frames at once.

Reads
  --tracks   mesh sequence (.npz, `nbavatar tracks`): keypoints.<part>.<camera> [N, L, 3] (x, y [px, distorted
             full frame], confidence), camera.<camera>.{K, cam_from_world, distortion, size}, segments, and where they
             exist parameters param.<part>.<name> to start from; without any, the start is triangulated
  --assets   folder with generic_model.pkl (FLAME), landmark_embedding.npy and mano_v1_2/models/MANO_RIGHT.pkl
             (MANO_LEFT.pkl); a missing side is the mirror image of the other
  --frames   frame packs (.zip, `nbavatar ingest`) of the cameras to use, drawn on the sheet; their masks (layer label,
             or person) bound the contours of the meshes; without packs all cameras with keypoints are used
and writes
  --out      mesh sequence with fitted meshes and parameters; extras reprojection.<part>.{before, after} [M, 4]
             (median and 95th percentile [px], share unexplained, count), convergence.<part> [I, 4],
             fit_error.<part> [N] [px], explained.<part> [M, N, L]
  --sheet    contact sheet (.png): meshes over images, convergence, errors per camera

Cameras that are left out of --frames are not looked at, so a camera held out for evaluation stays unseen.
"""

import argparse
import contextlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nbavatar.bodymodels.files import read_flame, read_landmarks, read_mano
from nbavatar.bodymodels.flame import Flame
from nbavatar.bodymodels.mano import Mano, mirror_model
from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.config.core import to_mapping
from nbavatar.config.geometry import FitConfig
from nbavatar.config.preprocess import MATTE_THRESHOLD
from nbavatar.data.decaf_files import Assets
from nbavatar.data.sequences import MeshSequence, read_sequence, write_sequence
from nbavatar.errors import DataError
from nbavatar.fitting.pictures import contact_sheet
from nbavatar.fitting.stage import Bodies, Masks, fit_sequence
from nbavatar.io.arrays import read_arrays
from nbavatar.io.atomic import atomic_write
from nbavatar.io.framepack import FramePack, unseen_in
from nbavatar.io.images import encode_png
from nbavatar.provenance import run_record

__all__ = ["add_arguments", "main"]

# A share of keypoints off the fitted mesh above which the fit itself is in doubt.
_UNEXPLAINED = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--tracks", required=True, metavar="NPZ", help="mesh sequence with keypoints")
    parser.add_argument("--assets", required=True, metavar="DIR", help="folder of the body models")
    parser.add_argument("--frames", nargs="*", default=[], metavar="ZIP", help="frame packs of the cameras to use")
    parser.add_argument("--out", required=True, metavar="NPZ", help="fitted mesh sequence to write")
    parser.add_argument("--sheet", metavar="PNG", help="contact sheet to write")
    add_cfg_argument(parser, FitConfig)


def main(args: argparse.Namespace) -> None:
    """Fits and writes."""
    cfg = stage_config(args, FitConfig)
    tracks, assets = _read_tracks(args.tracks), Assets(Path(args.assets))
    bodies, files = _read_bodies(assets, tracks.extras)
    with contextlib.ExitStack() as stack:
        packs: dict[str, FramePack] = {}
        for path in args.frames:
            pack = stack.enter_context(FramePack(path))
            packs[str(pack.manifest["camera"])] = pack
        fitted, report = fit_sequence(
            tracks.frames, tracks.parts, tracks.extras, bodies, cfg, cameras=list(packs) or None,
            masks=_read_masks(packs, tracks.frames, cfg), progress=_progress,
        )  # fmt: skip
        options = {"frames": cfg.sheet_frames, "cameras": cfg.sheet_cameras, "tile": cfg.sheet_tile}
        sheet = contact_sheet(fitted, packs, **options) if args.sheet else None
    for part, summary in report.items():
        _tell(part, summary)
    inputs = {"tracks": args.tracks, **files}
    write_sequence(args.out, fitted, run_record("fit", config=to_mapping(cfg), inputs=inputs, extra={"fit": report}))
    if sheet is not None:
        with atomic_write(args.sheet) as temporary:
            temporary.write_bytes(encode_png(sheet))


def _read_tracks(path: str) -> MeshSequence:
    """A mesh sequence, or one without any mesh: keypoints and cameras are enough."""
    arrays, _ = read_arrays(path, required=("frames",))
    if any(name.endswith(".verts") for name in arrays):
        return read_sequence(path)[0]
    frames = [str(frame) for frame in arrays.pop("frames")]
    return MeshSequence(frames, {}, arrays)


def _read_bodies(assets: Assets, extras: dict[str, Any]) -> tuple[Bodies, dict[str, Path]]:
    """The models that the keypoints ask for, and the files they came from."""
    wanted = {name.split(".")[1] for name in extras if name.startswith("keypoints.")}
    files: dict[str, Path] = {}
    head, hands = None, {}
    if "head" in wanted:
        files = {"flame": assets.flame, "landmarks": assets.landmarks}
        arrays = read_flame(files["flame"])
        counts = {
            key: extras[name].shape[1]
            for key, name in (("shape_count", "param.head.shape"), ("expression_count", "param.head.expression"))
            if name in extras
        }
        landmarks = read_landmarks(files["landmarks"], len(arrays.faces))
        head = Flame.build(arrays, landmarks, dtype=torch.float64, **counts)
    if wanted & {"right_hand", "left_hand"}:
        found = {side: assets.mano(side) for side in ("right", "left")}
        folder = assets.mano().parent
        found = {side: path for side, path in found.items() if path.is_file()}
        if not found:
            raise DataError.of(folder, expected="MANO_RIGHT.pkl or MANO_LEFT.pkl", found="neither")
        models = {side: read_mano(path) for side, path in found.items()}
        for side, other in (("right", "left"), ("left", "right")):
            arrays = models[side] if side in models else mirror_model(models[other])
            hands[side] = Mano.build(arrays, side, dtype=torch.float64)
        files |= {f"mano_{side}": path for side, path in found.items()}
    return Bodies(head, hands), files


def _read_masks(packs: dict[str, FramePack], frames: list[str], cfg: FitConfig) -> Masks | None:
    """Masks of some frames that all packs have: labels of head and hands where there are any, else person mattes.

    What says nothing counts as head or hand, for there the meshes may be, but draws no contour to its border.
    """
    layers = [layer for layer in ("label", "person") if packs and all(layer in pack.layers for pack in packs.values())]
    common = [i for i, frame in enumerate(frames) if all(frame in pack.frames for pack in packs.values())]
    if cfg.silhouette_weight == 0 or not layers or not common:
        return None
    spread = np.linspace(0, len(common) - 1, min(cfg.silhouette_frames, len(common))).round().astype(int)
    chosen = [common[i] for i in spread]
    labels, layer = layers[0] == "label", layers[0]
    images = {
        camera: np.stack([pack.read(layer, frames[i]) > (0 if labels else MATTE_THRESHOLD) for i in chosen])
        for camera, pack in packs.items()
    }
    unseen = {}
    if labels and any(pack.manifest.get("unseen") for pack in packs.values()):
        unseen = {
            name: np.stack([unseen_in(pack.read(layer, frames[i])) for i in chosen]) for name, pack in packs.items()
        }
    return Masks(chosen, images, labels, unseen)


def _progress(part: str, step: Any) -> None:
    errors = f"median {step.median_px:.3f} px  sigma {step.sigma_px:.3f} px"
    print(f"{part}: stage {step.stage}  cost {step.cost:.6g}  {errors}", file=sys.stderr)


def _tell(part: str, summary: dict[str, Any]) -> None:
    before, after = summary["median_px_before"], summary["median_px_after"]
    if before is not None and after is not None:
        print(f"{part}: median keypoint error {before:.2f} -> {after:.2f} px in {len(summary['cameras'])} cameras")
    if (summary["unexplained_after"] or 0.0) > _UNEXPLAINED:
        print(
            f"nbavatar fit: warning: {summary['unexplained_after']:.0%} of keypoints.{part} are far from the fitted "
            "mesh: check the calibration, and that cameras and keypoints belong together",
            file=sys.stderr,
        )
    found = summary.get("handedness", {})
    if found and found["found"] in (found["expected"], "undecided"):
        said = "as said" if found["found"] == found["expected"] else "undecided"
        print(f"{part}: side of the hand {said} (error by side [px]: {found['error_px']})")
    elif found:
        print(
            f"nbavatar fit: warning: keypoints.{part} are said to be of the {found['expected']} hand, but fit "
            f"{found['found']} better (error by side [px]: {found['error_px']})",
            file=sys.stderr,
        )
