"""What an importer hands over, whatever the format: pictures with calibrations, meshes, who is held out.

A source is a list of shots, one picture each. `grid` sorts them into the cameras and frames of a capture. Paths that
a source's files name are followed within one folder only (`inside`), and names that become file names follow the
project's rule (`safe_names`): nothing in a source decides where a file is written.
"""

import dataclasses
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from nbavatar.errors import DataError
from nbavatar.io.pictures import PICTURE_TYPES
from nbavatar.names import check_name, name_like

__all__ = ["Lens", "Meshes", "Shot", "Source", "grid", "inside", "natural", "one_lens", "picture", "safe_names"]


@dataclasses.dataclass(frozen=True)
class Lens:
    """A calibration in this project's conventions.

    Attributes:
        width, height: [px].
        K: float64 `[3, 3]` [px], pixel centres at +0.5.
        cam_from_world: float64 `[4, 4]`, OpenCV axes, the source's unit of length.
        distortion: OpenCV's coefficients, or None.
    """

    width: int
    height: int
    K: np.ndarray
    cam_from_world: np.ndarray
    distortion: np.ndarray | None = None

    def same(self, other: "Lens", *, pose: bool = True) -> bool:
        """Whether both are one calibration, but for rounding; without `pose`, the intrinsics alone are compared."""
        ours, theirs = (np.concatenate([lens.K.ravel(), lens._coefficients()]) for lens in (self, other))
        if (self.width, self.height) != (other.width, other.height) or not np.allclose(ours, theirs, 1e-10, 1e-12):
            return False
        return not pose or np.allclose(self.cam_from_world, other.cam_from_world, 1e-10, 1e-12)

    def _coefficients(self) -> np.ndarray:
        values = np.zeros(12) if self.distortion is None else np.asarray(self.distortion, dtype=np.float64)
        return np.pad(values, (0, 12 - len(values)))


@dataclasses.dataclass(frozen=True)
class Shot:
    """One picture: camera and frame as the source calls them, its files (None where there is none), its calibration."""

    camera: str
    frame: str
    image: Path | None
    mask: Path | None
    lens: Lens


class Meshes(Protocol):
    """Posed meshes of a source."""

    def topology(self) -> Mapping[str, tuple[np.ndarray, np.ndarray | None]]:
        """Part -> faces int64 `[F, 3]`, rest vertices float64 `[V, 3]` [m] or None."""
        ...

    def vertices(self, frame: str) -> Mapping[str, np.ndarray]:
        """Part -> float64 `[V, 3]` [m, world] of the parts that are in a frame (as the source calls it)."""
        ...


@dataclasses.dataclass
class Source:
    """Everything that a format says.

    Attributes:
        path: file that is named in errors about the whole.
        shots: all pictures.
        meshes: posed meshes, if the format has any.
        train, test: frames of the two sides of the held-out poses; both empty where the source does not say.
        test_camera: camera held out for novel views, or empty.
        cuts: pairs (last frame before a cut, first frame after it).
        notes: lines for the user.
        inputs: name -> file, for the record.
    """

    path: Path
    shots: list[Shot]
    meshes: Meshes | None = None
    train: list[str] = dataclasses.field(default_factory=list)
    test: list[str] = dataclasses.field(default_factory=list)
    test_camera: str = ""
    cuts: list[tuple[str, str]] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    inputs: dict[str, Path] = dataclasses.field(default_factory=dict)


def grid(source: Source) -> tuple[list[str], list[str], dict[tuple[str, str], Shot]]:
    """Cameras and frames, both in natural order, and the shot of each pair.

    Frames that some camera did not take are left out, with a note.

    Raises:
        DataError: no shot at all, two of one camera at one time, or no frame that all cameras took.
    """
    if not source.shots:
        raise DataError.of(source.path, expected="pictures with calibrations", found="none")
    shots: dict[tuple[str, str], Shot] = {}
    for shot in source.shots:
        key = (shot.camera, shot.frame)
        if key in shots:
            raise DataError.of(
                source.path, f"camera {shot.camera}, frame {shot.frame}", expected="one picture",
                found=f"{shots[key].image} and {shot.image}",
            )  # fmt: skip
        shots[key] = shot
    cameras = sorted({camera for camera, _ in shots}, key=natural)
    frames = sorted({frame for _, frame in shots}, key=natural)
    whole = [frame for frame in frames if all((camera, frame) in shots for camera in cameras)]
    if not whole:
        raise DataError.of(
            source.path, expected="a frame that all cameras took", found=f"none ({len(cameras)} cameras: "
            f"{', '.join(cameras[:4])}{', ...' if len(cameras) > 4 else ''}; {len(frames)} frames)",
            fix="say with --names what in a picture's name is the camera and what the frame",
        )  # fmt: skip
    if len(whole) < len(frames):
        kept = set(whole)
        lost = next(frame for frame in frames if frame not in kept)
        source.notes.append(
            f"{len(frames) - len(whole)} of {len(frames)} frames left out: not all cameras took them (first: {lost})"
        )
    return cameras, whole, shots


def one_lens(source: Source, camera: str, shots: Sequence[Shot], *, moving: bool) -> Lens:
    """The calibration that a camera has in all its shots; of a moving one, that of the first.

    Raises:
        DataError: it has several.
    """
    first = shots[0]
    for shot in shots[1:]:
        if not first.lens.same(shot.lens, pose=not moving):
            moved = float(np.abs(first.lens.cam_from_world - shot.lens.cam_from_world).max())
            what = (
                f"another pose (by {moved:.2g})" if first.lens.same(shot.lens, pose=False) else "another lens or size"
            )
            fix = "calibrate with one shared lens" if moving else "one moving camera is imported with --names '{frame}'"
            raise DataError.of(
                source.path, f"camera {camera}", expected=f"one calibration, that of frame {first.frame}",
                found=f"{what} in frame {shot.frame}", fix=fix,
            )  # fmt: skip
    return first.lens


def natural(name: str) -> tuple[Any, ...]:
    """Sorting key that takes runs of digits as numbers."""
    return tuple((0, int(word), word) if word.isdigit() else (1, 0, word) for word in re.findall(r"\d+|\D+", name))


def safe_names(names: Iterable[str], where: object, kind: str) -> dict[str, str]:
    """What the source's names are called in a capture (see `nbavatar.names`).

    Raises:
        DataError: two names become one, or nothing is left of one.
    """
    result: dict[str, str] = {}
    taken: dict[str, str] = {}
    for name in names:
        safe = name_like(name)
        if not safe.strip("_.-"):
            found = "none"
            raise DataError.of(where, f"{kind} {name!r}", expected="a name with letters or digits", found=found)
        if safe in taken:
            raise DataError.of(where, f"{kind} {name!r}", expected="another name", found=f"that of {taken[safe]!r}")
        taken[safe] = name
        result[name] = check_name(safe, where, kind, error=DataError)
    return result


def inside(folder: Path, text: object, allowed: Path, where: str) -> Path:
    """The path that a file of the source names, relative to `folder`; it has to stay in `allowed`, links resolved.

    Raises:
        DataError: no text, or a path that leaves `allowed`.
    """
    if not isinstance(text, str) or not _is_path(text):
        raise DataError.of(where, expected="a path", found=repr(text)[:60])
    path = folder / text
    if "\\" in text and not path.exists():
        path = folder / text.replace("\\", "/")
    if not path.resolve().is_relative_to(allowed.resolve()):
        raise DataError.of(
            where, expected=f"a path inside {allowed}", found=repr(text)[:120],
            fix="if the files are yours, name the folder that holds them all with --within",
        )  # fmt: skip
    return path


def _is_path(text: str) -> bool:
    """Whether a file system can be asked for it at all."""
    try:
        encoded = os.fsencode(text)
    except UnicodeEncodeError:
        return False
    return 0 < len(encoded) < 4000 and b"\0" not in encoded and max(map(len, encoded.split(b"/"))) < 250


def picture(path: Path, where: str) -> Path:
    """The picture of this path, whose suffix may have been left out.

    Raises:
        DataError: there is none.
    """
    for candidate in (path, *(path.with_name(path.name + suffix) for suffix in PICTURE_TYPES)):
        if candidate.suffix.lower() in PICTURE_TYPES and candidate.is_file():
            return candidate
    raise DataError.of(where, expected=f"a picture ({', '.join(PICTURE_TYPES)})", found=f"no {path}")
