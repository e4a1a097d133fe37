"""An avatar in the browser: turn it, play it, compare it with others and with what the cameras saw.

    nbavatar view results/smoke                     avatars, meshes and cameras of a run
    nbavatar view MODEL [MODEL ...] --meshes NPZ    trained avatars (model.pt) on a mesh sequence
                  [--cameras ZIP ...]               and the frame packs of `nbavatar crop`: cameras to look through

Of a run, all avatars of one subject are taken (--subject; the first by default). For a model within a run's folder,
meshes and cameras are found beside it. Prints the address to open. The page can be reached from this machine only,
unless --host says otherwise; from elsewhere take `ssh -L 8080:127.0.0.1:8080 MACHINE` and open the same address there.

Pictures are small while something moves and whole (--side) at rest. Stops with Ctrl-C. Needs the package viser (extra
`view`); no display and no GPU.
"""

import argparse
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nbavatar.cli.settings import add_engine_argument, take_engine
from nbavatar.config.evaluation import AUTO
from nbavatar.devices import lease_device
from nbavatar.errors import DataError, did_you_mean

if TYPE_CHECKING:
    from nbavatar.viewer.scene import Entry, Scene

__all__ = ["add_arguments", "main", "open_scene"]

_MESH_STAGES = ("deform", "fit", "align", "tracks")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar view`."""
    parser.add_argument("path", nargs="+", metavar="MODEL|FOLDER", help="trained avatars, or one folder of results")
    parser.add_argument("--meshes", metavar="NPZ", help="mesh sequence")
    parser.add_argument("--cameras", nargs="+", default=[], metavar="ZIP", help="frame packs of the capture's cameras")
    parser.add_argument("--subject", metavar="NAME", help="of a folder of results: which subject")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (0.0.0.0: every one)")
    parser.add_argument("--port", type=int, default=8080, help="the next free one is taken if it is in use")
    parser.add_argument("--side", type=int, default=512, help="longer side of a picture at rest [px]")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"), help="where to compute")
    add_engine_argument(parser, AUTO)


def main(args: argparse.Namespace) -> int:
    """Runs `nbavatar view` until it is interrupted."""
    if not 64 <= args.side <= 1024:
        raise DataError.of("--side", expected="64 to 1024 px", found=args.side)
    if not 0 < args.port < 65536:
        raise DataError.of("--port", expected="1 to 65535", found=args.port)
    with lease_device(args.device) as device:
        from nbavatar.viewer.page import Viewer

        scene = open_scene(args, device)
        viewer = Viewer(scene, host=args.host, port=args.port, side=args.side, title=f"nbavatar: {args.path[0]}")
        try:  # whoever reads the address may interrupt at once
            print(f"viewer: {viewer.address}   (Ctrl-C ends it)", flush=True)
            if os.environ.get("SSH_CONNECTION") and args.host == "127.0.0.1":
                port = viewer.server.get_port()
                print(f"from your own machine first: ssh -L {port}:127.0.0.1:{port} {os.uname().nodename}", flush=True)
            threading.Event().wait()
        except KeyboardInterrupt:
            print()
        finally:
            viewer.stop()
    return 0


def open_scene(args: argparse.Namespace, device: str) -> "Scene":
    """What the command line names, opened: of a run's folder, or of models and files.

    Raises:
        DataError: nothing to look at; the line says what was looked for.
    """
    from nbavatar.io.framepack import FramePack
    from nbavatar.viewer.scene import Scene

    models, known = _models(args), {}
    entries = [_entry(model, name, args, known, device) for model, name in models.items()]
    first = next(iter(models))
    packs = [FramePack(path) for path in args.cameras or _cameras_of(first, entries[0].avatar.record)]
    return Scene(entries, {str(pack.manifest["camera"]): pack for pack in packs}, device)


def _models(args: argparse.Namespace) -> dict[Path, str]:
    """Model files and the names to show them under, the main variant first."""
    paths = [Path(path) for path in args.path]
    if len(paths) == 1 and paths[0].is_dir():
        trained = sorted(paths[0].glob("train/*/*/model.pt"))
        subjects = list(dict.fromkeys(model.parts[-3] for model in trained))
        if not trained:
            raise DataError.of(paths[0], expected="results with train/<subject>/<variant>/model.pt", found="none",
                               fix="run `nbavatar run smoke` first, or name a model.pt")  # fmt: skip
        subject = args.subject or subjects[0]
        if subject not in subjects:
            raise DataError(f"{paths[0]}: no avatar of subject '{subject}'; {did_you_mean(subject, subjects)}")
        own = {model: model.parts[-2] for model in trained if model.parts[-3] == subject}
        return dict(sorted(own.items(), key=lambda item: (item[1] != "full", item[1])))
    for path in paths:
        if not path.is_file():
            raise DataError.of(path, expected="a trained avatar (model.pt) or a folder of results", found="none")
    names = [path.parent.name if path.stem == "model" else path.stem for path in paths]
    unique = len(set(names)) == len(names)
    return {path: name if unique else str(path) for path, name in zip(paths, names, strict=True)}


def _entry(model: Path, name: str, args: argparse.Namespace, known: dict[str, Any], device: str) -> "Entry":
    """One avatar, not loaded yet; what is loaded of mesh sequences is kept in `known`."""
    from nbavatar.data.sequences import read_sequence
    from nbavatar.methods.storage import load_avatar
    from nbavatar.viewer.scene import Entry

    def load() -> Any:
        avatar = load_avatar(model, device)
        take_engine(args, avatar, device)
        meshes = args.meshes or _meshes_of(model, avatar.record)
        if meshes is None:
            raise DataError.of("--meshes", expected=f"the mesh sequence of {model}", found="none given, none beside it")
        if str(meshes) not in known:
            known[str(meshes)] = read_sequence(meshes)[0]
        return avatar, known[str(meshes)]

    presets, tune = _presets(model, device)
    return Entry(name, load, tune, presets)


def _presets(model: Path, device: str) -> tuple[list[str], Callable[[Any, str], Any] | None]:
    """Presets that were measured of a model, and how to take one."""
    from nbavatar.cli.settings import timed_device
    from nbavatar.config.tradeoff import ACCURATE
    from nbavatar.provenance import file_digest
    from nbavatar.studies.tradeoff.presets import preset_setting, presets_path, stored_presets

    place = model.resolve()
    files = [
        presets_path(place),
        *(run / "tradeoff" / Path(*place.parts[-3:-1]) / "presets.json" for run in _run(place)),
    ]
    path = next((file for file in files if file.is_file()), None)
    if path is None:
        return [], None
    digest = file_digest(model)
    names = [name for name in stored_presets(path, digest) if name != ACCURATE]

    def tune(avatar: Any, name: str) -> Any:
        import torch

        from nbavatar.studies.tradeoff.tuned import TunedAvatar

        chosen = preset_setting(path, name, model=digest, device=timed_device(device))
        importance = None if chosen.importance is None else torch.tensor(chosen.importance)[None]
        return TunedAvatar(avatar, chosen.setting, importance=importance)

    return names, tune


def _run(place: Path) -> list[Path]:
    """The folder of the run whose train/<subject>/<variant>/model.pt this is; none for a model elsewhere."""
    return [place.parents[3]] if len(place.parts) > 5 and place.parts[-4] == "train" else []


def _meshes_of(model: Path, record: dict[str, Any]) -> Path | None:
    """The meshes that an avatar in a run's folder was trained on: by their digest, else the first that are there."""
    from nbavatar.provenance import file_digest

    place = model.resolve()
    files = [run / stage / f"{place.parts[-3]}.npz" for run in _run(place) for stage in _MESH_STAGES]
    there = [path for path in files if path.is_file()]
    wanted = (record.get("inputs") or {}).get("meshes")
    return next((path for path in there if file_digest(path) == wanted), there[0] if there else None)


def _cameras_of(model: Path, record: dict[str, Any]) -> list[Path]:
    """Frame packs of the subject's cameras in a run's folder, of the crop that the avatar was trained on."""
    from nbavatar.provenance import file_digest

    place = model.resolve()
    folders = [folder for run in _run(place) for folder in sorted(run.glob(f"crop/*/{place.parts[-3]}"))]
    crops = [packs for packs in (sorted(folder.glob("*.zip")) for folder in folders) if packs]
    if len(crops) > 1:
        inputs = record.get("inputs") or {}
        wanted = {digest for name, digest in inputs.items() if name.startswith("frames")}
        crops = [packs for packs in crops if any(file_digest(path) in wanted for path in packs)] or crops
    return crops[0] if crops else []
