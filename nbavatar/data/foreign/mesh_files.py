"""Sequences of mesh files: one OBJ or PLY a frame and part, the same faces in all of them.

DIR/<frame>.obj                     the head
DIR/<part>/<frame>.obj              head, right_hand, left_hand: whichever there are
DIR/[<part>/]rest.obj               optional: the part at rest
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from nbavatar.data.foreign.source import Meshes, natural
from nbavatar.data.sequences import PARTS, read_sequence
from nbavatar.errors import DataError
from nbavatar.io.meshfiles import MESH_TYPES, read_mesh_file
from nbavatar.mesh.bvh import surface_points
from nbavatar.mesh.decimation import decimate_mesh
from nbavatar.mesh.repair import repair_faces

__all__ = ["FrameFiles", "JoinedMeshes", "MeshFiles", "SequenceMeshes", "find_mesh_files", "open_meshes"]

_REST = "rest"


class FrameFiles:
    """Files by frame: of its name, or of the same number with other zero padding."""

    def __init__(self, files: Mapping[str, Path]) -> None:
        self._names = dict(files)
        self._numbers = {int(name): path for name, path in files.items() if name.isdecimal()}

    def get(self, frame: str) -> Path | None:
        """The file of a frame, if there is one."""
        return self._names.get(frame) or (self._numbers.get(int(frame)) if frame.isdecimal() else None)


class MeshFiles:
    """The meshes of some files.

    Args:
        files: part -> frame -> file.
        rest: part -> file of the part at rest.
        scale: metres per unit of the files.
        repair: mend the faces of the first frame (see `repair_faces`), for all frames alike.
        max_faces: faces of a part; a mesh with more is made coarser in its first frame (see `decimate_mesh`), and the
            coarse vertices ride on the surface of all frames.

    Raises:
        DataError: a file is damaged, or its faces are not those of the part's first frame.
    """

    def __init__(
        self, files: Mapping[str, Mapping[str, Path]], *, rest: Mapping[str, Path] | None = None, scale: float = 1.0,
        repair: bool = False, max_faces: int | None = None,
    ) -> None:  # fmt: skip
        self._files, self._scale = {part: dict(frames) for part, frames in files.items()}, scale
        self._by_frame = {part: FrameFiles(frames) for part, frames in self._files.items()}
        self._rest: dict[str, np.ndarray | None] = {}
        self._stored: dict[str, np.ndarray] = {}  # faces as they are in the files
        self._faces: dict[str, np.ndarray] = {}
        self._counts: dict[str, int] = {}
        # Faces before they were made fewer, and where on them the vertices that were kept ride.
        self._rides: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        self.notes: list[str] = []
        for part, frames in self._files.items():
            first = next(iter(frames.values()))
            verts, faces = read_mesh_file(first)
            self._stored[part] = self._faces[part] = faces
            self._counts[part] = len(verts)
            if repair:
                self._faces[part], said = repair_faces(verts, faces)
                self.notes.extend(f"{first}: {line}" for line in said)
            if max_faces is not None and len(self._faces[part]) > max_faces:
                fine, coarse = self._faces[part], decimate_mesh(verts, self._faces[part], max_faces)
                if not len(coarse.faces) or (coarse.face < 0).any():
                    raise DataError.of(
                        first, expected="a surface that fewer faces can have", found="one that collapses"
                    )
                self._rides[part], self._faces[part] = (fine, coarse.face, coarse.weight), coarse.faces
                self.notes.append(f"{first}: {len(fine)} faces made {len(coarse.faces)}, for all frames alike")
            path = (rest or {}).get(part)
            self._rest[part] = None if path is None else self._read(part, path)

    def topology(self) -> Mapping[str, tuple[np.ndarray, np.ndarray | None]]:
        """See `Meshes`."""
        return {part: (self._faces[part], self._rest[part]) for part in self._files}

    def vertices(self, frame: str) -> Mapping[str, np.ndarray]:
        """See `Meshes`."""
        result = {}
        for part, files in self._by_frame.items():
            path = files.get(frame)
            if path is not None:
                result[part] = self._read(part, path)
        return result

    def _read(self, part: str, path: Path) -> np.ndarray:
        verts, faces = read_mesh_file(path)
        first = next(iter(self._files[part].values()))
        if len(verts) != self._counts[part]:
            raise DataError.of(path, "vertices", expected=f"{self._counts[part]} as in {first}", found=len(verts))
        if not np.array_equal(faces, self._stored[part]):
            raise DataError.of(
                path, "faces", expected=f"those of {first}, in their order", found="others",
                fix="all frames need one topology; remesh none of them on its own",
            )  # fmt: skip
        return (surface_points(verts, *self._rides[part]) if part in self._rides else verts) * self._scale


class JoinedMeshes:
    """Meshes of several sources, such as a tracked head and hands from files."""

    def __init__(self, sources: Sequence[Meshes]) -> None:
        self._sources = sources

    def topology(self) -> Mapping[str, tuple[np.ndarray, np.ndarray | None]]:
        """See `Meshes`."""
        result: dict[str, tuple[np.ndarray, np.ndarray | None]] = {}
        for source in self._sources:
            result |= source.topology()
        return {part: result[part] for part in PARTS if part in result}

    def vertices(self, frame: str) -> Mapping[str, np.ndarray]:
        """See `Meshes`."""
        return {part: verts for source in self._sources for part, verts in source.vertices(frame).items()}


class SequenceMeshes:
    """The meshes of a mesh sequence (`nbavatar.data.sequences`), such as `nbavatar fit` writes; metres."""

    def __init__(self, path: Path) -> None:
        self._sequence, _ = read_sequence(path)
        self._rows = {frame: row for row, frame in enumerate(self._sequence.frames)}
        self.notes: list[str] = []

    def topology(self) -> Mapping[str, tuple[np.ndarray, np.ndarray | None]]:
        """See `Meshes`."""
        return {name: (part.faces, part.rest) for name, part in self._sequence.parts.items()}

    def vertices(self, frame: str) -> Mapping[str, np.ndarray]:
        """See `Meshes`; a part whose vertices are NaN is not in the frame."""
        row = self._rows.get(frame)
        if row is None:
            return {}
        verts = {name: part.verts[row].astype(np.float64) for name, part in self._sequence.parts.items()}
        return {name: values for name, values in verts.items() if np.isfinite(values).all()}


def open_meshes(
    path: Path, *, scale: float = 1.0, repair: bool = False, max_faces: int | None = None
) -> MeshFiles | SequenceMeshes:
    """The meshes of a folder of files (`find_mesh_files`), or of a mesh sequence (.npz), which is in metres already."""
    if path.is_file():
        if max_faces is not None:
            raise DataError.of(path, expected="a folder of mesh files, where faces are to be fewer", found="a file")
        return SequenceMeshes(path)
    return find_mesh_files(path, scale=scale, repair=repair, max_faces=max_faces)


def find_mesh_files(
    folder: Path, *, scale: float = 1.0, repair: bool = False, max_faces: int | None = None
) -> MeshFiles:
    """The sequences of a folder; see the module for its layout.

    Raises:
        DataError: no mesh there, or a damaged one.
    """
    if not folder.is_dir():
        raise DataError.of(folder, expected="a folder of meshes", found="no such folder")
    files = {part: _listed(folder / part) for part in PARTS if (folder / part).is_dir()}
    direct = _listed(folder)
    if direct and "head" in files:
        raise DataError.of(folder, expected="heads here or in head/", found="meshes in both")
    if direct:
        files["head"] = direct
    rest = {part: frames.pop(_REST) for part, frames in files.items() if _REST in frames}
    files = {part: files[part] for part in PARTS if files.get(part)}
    if not files:
        raise DataError.of(
            folder, expected=f"<frame>{' or <frame>'.join(MESH_TYPES)}, here or in {', '.join(PARTS)}", found="none"
        )
    return MeshFiles(files, rest=rest, scale=scale, repair=repair, max_faces=max_faces)


def _listed(folder: Path) -> dict[str, Path]:
    """Stem -> mesh of a folder, in natural order."""
    found = sorted((p for p in folder.iterdir() if p.suffix.lower() in MESH_TYPES), key=lambda path: natural(path.stem))
    files: dict[str, Path] = {}
    for path in found:
        if path.stem in files:
            raise DataError.of(path, expected="one mesh a frame", found=f"{files[path.stem].name} too")
        files[path.stem] = path
    return files
