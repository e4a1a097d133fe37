"""How many pictures a second the viewer draws of a trained avatar, by torch and by inference engines, in turns.

    nbavatar bench viewer MODEL --meshes NPZ                   # seen from the front
    nbavatar bench viewer MODEL --meshes NPZ --cameras ZIP ... # as the page opens: from the middle one of the cameras

The viewer's own function draws (`nbavatar.viewer.pictures.draw`): meshes posed, billboards rasterized and decoded, the
picture as bytes. The way to the browser, JPEG included, comes on top. While something moves the page shows pictures of
about 256 px on two cores, at rest of 512 px, so these are measured (--size); every turn is another frame.

Figures for each size and decoder (`eager` is torch): medians of wall time [ms], pictures a second by it, and
processor time over all threads (`*_cpu_ms`), which other programs disturb less; of every engine that is installed
also `*_ratio`, the median over the turns of torch's processor time by the engine's, and `*_difference`, the largest
difference from torch's picture [steps of 255]. An avatar without a U-Net has nothing to hand over to an engine.
"""

import argparse
import os
import statistics
from typing import Any

import numpy as np
import torch

from nbavatar.camera.pinhole import facing_pose
from nbavatar.config.evaluation import EAGER
from nbavatar.data.sequences import MeshSequence, read_sequence
from nbavatar.devices import device_name
from nbavatar.errors import DataError
from nbavatar.io.framepack import FramePack
from nbavatar.methods.base import MeshAvatar
from nbavatar.methods.billboards.engine import RUNNERS, installed_engines
from nbavatar.methods.storage import load_avatar
from nbavatar.studies.benchmarks.turns import in_turns, median_ratio
from nbavatar.viewer.eye import Eye
from nbavatar.viewer.pictures import Request, draw
from nbavatar.viewer.scene import Entry, Scene

__all__ = ["add_arguments", "run"]

_CANVAS = 1024  # nominal side [px]; pictures are drawn at the sizes that are asked for


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the avatar's and the measurement's options."""
    parser.add_argument("model", metavar="MODEL", help="trained avatar (model.pt)")
    parser.add_argument("--meshes", required=True, metavar="NPZ", help="mesh sequence")
    parser.add_argument("--cameras", nargs="+", default=[], metavar="ZIP", help="frame packs of the capture's cameras")
    parser.add_argument("--size", type=int, nargs="+", default=[256, 512], help="picture sides [px] (default: 256 512)")
    parser.add_argument("--repeats", type=int, default=20, help="turns a median is taken of (default: %(default)s)")


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Measures; see the module's description for the figures.

    Raises:
        DataError: a side or number of repeats out of range, a file that is missing or does not fit.
    """
    if args.repeats < 1 or any(not 64 <= side <= 1024 for side in args.size):
        expected = "sides of 64 to 1024 px, and at least 1 repeat"
        raise DataError.of("bench viewer", "--size, --repeats", expected=expected, found=f"{args.size}, {args.repeats}")
    sequence = read_sequence(args.meshes)[0]
    avatars, engines = {EAGER: load_avatar(args.model)}, {}
    for kind in installed_engines():
        avatar = load_avatar(args.model)
        name = avatar.use_engine(kind)
        if name != EAGER:
            avatars[kind], engines[kind] = avatar, name
    packs = [FramePack(path) for path in args.cameras]
    entries = [_entry(kind, avatar, sequence) for kind, avatar in avatars.items()]
    scene = Scene(entries, {str(pack.manifest["camera"]): pack for pack in packs})
    figures: dict[str, Any] = {
        "device": device_name("cpu"),
        "threads": torch.get_num_threads(),
        "load": os.getloadavg()[0],
        "method": avatars[EAGER].method,
        "primitives": avatars[EAGER].primitives,
        "frames": len(scene.frames),
        "engines": ", ".join(engines.values()) or f"none: no U-Net, or none of {', '.join(RUNNERS)} is installed",
    }
    for side in args.size:
        figures |= {f"{side}_{name}": value for name, value in _turns(scene, side, args.repeats).items()}
    return figures


def _entry(kind: str, avatar: MeshAvatar, sequence: MeshSequence) -> Entry:
    return Entry(kind, lambda: (avatar, sequence))


def _first_eye(scene: Scene) -> Eye:
    """The page's first view on a square canvas."""
    view = scene.first_view(1.0)
    focal = 0.5 * _CANVAS / np.tan(0.5 * view.fov)
    K = np.array([[focal, 0.0, _CANVAS / 2], [0.0, focal, _CANVAS / 2], [0.0, 0.0, 1.0]])
    return Eye(K, facing_pose(view.position, view.look_at, scene.up), _CANVAS, _CANVAS, 1.0)


def _turns(scene: Scene, side: int, repeats: int) -> dict[str, float]:
    """Figures of one size."""
    eye = _first_eye(scene)

    def picture(kind: str, turn: int) -> np.ndarray:
        return draw(scene, Request(eye, scene.frames[turn % len(scene.frames)], kind), side).image

    first = {kind: picture(kind, 0).astype(int) for kind in scene.entries}  # prepares them, too
    turns = in_turns({kind: lambda turn, own=kind: picture(own, turn) for kind in scene.entries}, repeats)
    figures: dict[str, float] = {}
    for kind in scene.entries:
        figures[f"{kind}_ms"] = statistics.median(turns.wall[kind])
        figures[f"{kind}_per_s"] = 1e3 / figures[f"{kind}_ms"]
        figures[f"{kind}_cpu_ms"] = statistics.median(turns.spent[kind])
        if kind != EAGER:
            figures[f"{kind}_ratio"] = median_ratio(turns.spent[EAGER], turns.spent[kind])
            figures[f"{kind}_difference"] = float(np.abs(first[kind] - first[EAGER]).max())
    return figures
