"""Writes a source as a capture: pictures linked or copied, our cameras, meshes and splits.

The folder is made under a temporary name beside its own and renamed when it is whole. Nothing that exists is replaced.
"""

import contextlib
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nbavatar.data.capture import open_capture, read_splits
from nbavatar.data.foreign.source import Lens, Meshes, Shot, Source, grid, one_lens, safe_names
from nbavatar.errors import DataError
from nbavatar.io.arrays import write_arrays
from nbavatar.io.records import write_json

__all__ = ["write_capture", "write_meshes"]

_FAR = 100.0  # [m]
Progress = Callable[[Sequence[Any], str], Iterable[Any]]


def write_capture(
    source: Source,
    out: Path,
    *,
    scale: float = 1.0,
    copy: bool = False,
    moving: bool = False,
    record: Callable[[], Mapping[str, Any]] = dict,
    progress: Progress = lambda items, _: items,
) -> list[str]:
    """Writes the capture.

    Args:
        source: what a format's reader found.
        out: folder to make; it may exist if it is empty.
        scale: metres per unit of the source's cameras.
        copy: copy pictures instead of linking to them.
        moving: one camera that moves: its axes become the world's, and the meshes move instead.
        record: makes what is kept as `import.json`, called when all has been read.
        progress: wraps the loops over pictures and meshes.

    Returns:
        what the user should know, one line each.

    Raises:
        DataError: the folder is taken, or the source contradicts itself; then nothing is written.
    """
    _refuse_taken(out)
    cameras, frames, shots = grid(source)
    called = safe_names(cameras, source.path, "camera"), safe_names(frames, source.path, "frame")
    notes = [
        f"{kind} {theirs!r} is called {ours!r}"
        for kind, names in zip(("camera", "frame"), called)
        for theirs, ours in names.items()
        if theirs != ours
    ]
    entries = {}
    for camera in cameras:
        lens = one_lens(source, camera, [shots[camera, frame] for frame in frames], moving=moving)
        if not (np.isfinite(lens.K).all() and np.isfinite(_scaled(lens, scale)).all()):
            raise DataError.of(
                source.path, f"camera {camera}", expected="finite numbers", found="others, after scaling"
            )
        entries[called[0][camera]] = _entry(lens, scale, moving)
    if moving and source.meshes is None:
        raise DataError.of(
            source.path,
            expected="meshes, which move instead of the camera",
            found="none",
            fix="name them with --meshes",
        )
    with _whole_folder(out) as folder:
        for camera in progress(cameras, "pictures"):
            for frame in frames:
                _place(shots[camera, frame], folder, called[0][camera], called[1][frame], copy)
        write_json(folder / "cameras.json", entries)
        write_json(folder / "splits.json", _splits(source, called[0], called[1]))
        try:
            open_capture(folder)
            read_splits(folder)
        except DataError as error:  # told as if it had been written
            raise DataError(str(error).replace(str(folder), str(out))) from error
        if source.meshes is not None:
            poses = {frame: _scaled(shots[cameras[0], frame].lens, scale) for frame in frames} if moving else {}
            write_meshes(source.meshes, folder, called[1], poses, progress)
        write_json(folder / "import.json", {"cameras": called[0], "frames": called[1], **record()})
    return notes


def write_meshes(
    meshes: Meshes,
    capture: Path,
    frames: Mapping[str, str],
    poses: Mapping[str, np.ndarray] | None = None,
    progress: Progress = lambda items, _: items,
) -> None:
    """Writes `meshes/` of a capture.

    Args:
        meshes: whose.
        capture: folder; it must have no `meshes` yet.
        frames: frame of the source -> frame of the capture.
        poses: frame of the source -> rigid transform float64 `[4, 4]` [m] to apply, if any.
        progress: wraps the loop over frames.

    Raises:
        DataError: a frame without any part, a damaged file, or `meshes` is taken.
    """
    _refuse_taken(capture / "meshes")
    with _whole_folder(capture / "meshes") as folder:
        arrays: dict[str, np.ndarray] = {}
        for part, (faces, rest) in meshes.topology().items():
            arrays[f"{part}_faces"] = faces
            if rest is not None:
                arrays[f"{part}_rest"] = _stored(rest)
        write_arrays(folder / "topology.npz", arrays, {"units": "m"})
        for theirs, ours in progress(list(frames.items()), "meshes"):
            parts = dict(meshes.vertices(theirs))
            if not parts:
                raise DataError.of(
                    capture, f"frame {theirs}", expected="a mesh of its name or number", found="none",
                    fix="if every picture is a moment of one moving camera, say --names '{frame}'",
                )  # fmt: skip
            if poses:
                pose = poses[theirs]
                parts = {part: verts @ pose[:3, :3].T + pose[:3, 3] for part, verts in parts.items()}
            stored = {part: _stored(verts) for part, verts in parts.items()}
            write_arrays(folder / f"{ours}.npz", stored, {"units": "m"})


def _stored(verts: np.ndarray) -> np.ndarray:
    """Single precision, unless the world's origin is so far away that it would cost a hundredth of a millimetre."""
    return verts if np.abs(verts).max(initial=0.0) > _FAR else verts.astype(np.float32)


def _refuse_taken(out: Path) -> None:
    if os.path.lexists(out) and not (out.is_dir() and not out.is_symlink() and not any(out.iterdir())):
        raise DataError.of(
            out,
            expected="no such folder yet, or an empty one",
            found="files",
            fix="name another, or remove it yourself",
        )


@contextlib.contextmanager
def _whole_folder(out: Path) -> Iterator[Path]:
    """A temporary folder that takes the name `out` if the block succeeds, and goes if it does not."""
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.parent / f".{out.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp"
    temporary.mkdir()
    try:
        yield temporary
        os.replace(temporary, out)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _place(shot: Shot, folder: Path, camera: str, frame: str, copy: bool) -> None:
    for kind, file in (("images", shot.image), ("masks", shot.mask)):
        if file is None:
            continue
        target = folder / kind / camera / f"{frame}{file.suffix.lower()}"
        target.parent.mkdir(parents=True, exist_ok=True)
        if copy:
            shutil.copyfile(file, target)
        else:
            target.symlink_to(file.resolve())


def _scaled(lens: Lens, scale: float) -> np.ndarray:
    """World to camera with the translation in metres."""
    pose = lens.cam_from_world.copy()
    pose[:3, 3] *= scale
    return pose


def _entry(lens: Lens, scale: float, moving: bool) -> dict[str, Any]:
    pose = np.eye(4) if moving else _scaled(lens, scale)
    entry: dict[str, Any] = {
        "width": lens.width, "height": lens.height, "K": lens.K.tolist(), "R": pose[:3, :3].tolist(),
        "t": pose[:3, 3].tolist(),
    }  # fmt: skip
    if lens.distortion is not None:
        entry["distortion"] = lens.distortion.tolist()
    return entry


def _splits(source: Source, cameras: Mapping[str, str], frames: Mapping[str, str]) -> dict[str, Any]:
    splits: dict[str, Any] = {"frames": list(frames.values())}
    if source.test:
        splits["train"] = [frames[frame] for frame in source.train if frame in frames]
        splits["test"] = [frames[frame] for frame in source.test if frame in frames]
    cuts = [[frames[a], frames[b]] for a, b in source.cuts if a in frames and b in frames]
    if cuts:
        splits["cuts"] = cuts
    if source.test_camera:
        splits["test_camera"] = cameras[source.test_camera]
    return splits
