"""VHAP's export, the format of GaussianAvatars: frames of `transforms.json` with FLAME's parameters or its meshes.

    transforms.json, transforms_{train,val,test}.json    frames; the three are subsets
    images/<timestep>_<camera>.png, fg_masks/...         named by each frame's file_path and fg_mask_path
    flame_param/<timestep>.npz                           named by flame_param_path, or
    meshes/<timestep>.obj                                named by mesh_path
    canonical_flame_param.npz, canonical.obj             the subject at rest

Frames of `transforms_test` are held-out moments; cameras that only `transforms_val` has are held-out views.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nbavatar.data.foreign.flame_parameters import FlameSequence
from nbavatar.data.foreign.mesh_files import MeshFiles
from nbavatar.data.foreign.source import Meshes, Shot, Source, inside, natural, picture
from nbavatar.data.foreign.transforms import frame_lens, read_transforms
from nbavatar.errors import DataError
from nbavatar.io.pictures import picture_size

__all__ = ["read_vhap"]

_SUBSETS = ("train", "val", "test")


def read_vhap(
    root: Path, *, flame: Path | None = None, within: Path | None = None, pixel_center: float = 0.5
) -> Source:
    """Reads a folder in either of VHAP's modes.

    Args:
        root: folder with `transforms.json`, or with the subsets alone.
        flame: FLAME's model file, for folders with parameters.
        within: folder that the paths in the files may reach; `root` by default.
        pixel_center: where the files put the centre of pixel (0, 0) [px].

    Raises:
        DataError: damaged files, frames that disagree, parameters without `flame`.
    """
    allowed = within or root
    files = {name: root / f"transforms_{name}.json" for name in _SUBSETS}
    files = {name: path for name, path in files.items() if path.is_file()}
    whole = root / "transforms.json"
    read = {name: read_transforms(path) for name, path in files.items()}
    inputs = dict(files)
    if whole.is_file() or not read:
        lists = [(whole, *read_transforms(whole))]
        inputs["all"] = whole
    else:
        lists = [(files[name], *read[name]) for name in read]
    shots: dict[tuple[str, str], Shot] = {}
    models: dict[str, tuple[str, Path]] = {}
    original: dict[str, int] = {}
    for path, top, frames in lists:
        for number, frame in enumerate(frames):
            where = f"{path}: frames[{number}]"
            camera, moment = _identity(frame, where)
            image = picture(inside(root, frame.get("file_path"), allowed, f"{where}: file_path"), where)
            mask = frame.get("fg_mask_path")
            matte = None if mask is None else inside(root, mask, allowed, f"{where}: fg_mask_path")
            if matte is not None and not matte.is_file():
                raise DataError.of(where, "fg_mask_path", expected="a picture", found=f"no {matte}")
            lens = frame_lens(top, frame, where, picture_size(image), pixel_center=pixel_center)
            shots.setdefault((camera, moment), Shot(camera, moment, image, matte, lens))
            _note_model(models, frame, moment, root, allowed, where)
            if isinstance(frame.get("timestep_index_original"), int):
                original[moment] = frame["timestep_index_original"]
    if not shots:
        raise DataError.of(lists[0][0], "frames", expected="pictures with calibrations", found="none")
    source = Source(whole if whole.is_file() else root, list(shots.values()), inputs=inputs)
    source.meshes = _meshes(root, models, {moment for _, moment in shots}, flame, source)
    _split(source, {name: _identities(files[name], frames) for name, (_, frames) in read.items()})
    if set(original) == {moment for _, moment in shots}:
        source.cuts = _cuts(original)
    if not any(shot.mask for shot in source.shots):
        source.notes.append("there are no masks; `nbavatar segment` makes some")
    return source


def _identity(frame: Mapping[str, Any], where: str) -> tuple[str, str]:
    """Camera and moment, as text."""
    camera, moment = frame.get("camera_id", frame.get("camera_index")), frame.get("timestep_index")
    if not isinstance(camera, (str, int)) or isinstance(camera, bool):
        raise DataError.of(where, "camera_id", expected="text", found=repr(camera)[:60])
    if not isinstance(moment, int) or isinstance(moment, bool) or not 0 <= moment < 10**9:
        raise DataError.of(where, "timestep_index", expected="a whole number from 0", found=repr(moment)[:60])
    return str(camera), f"{moment:05d}"


def _identities(path: Path, frames: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    return [_identity(frame, f"{path}: frames[{number}]") for number, frame in enumerate(frames)]


def _note_model(
    models: dict[str, tuple[str, Path]], frame: Mapping[str, Any], moment: str, root: Path, allowed: Path, where: str
) -> None:
    """Notes the file of the head at a moment, which all cameras share."""
    keys = [key for key in ("flame_param_path", "mesh_path") if frame.get(key) is not None]
    if not keys:
        raise DataError.of(where, expected="flame_param_path or mesh_path", found="neither")
    found = (keys[0], inside(root, frame[keys[0]], allowed, f"{where}: {keys[0]}"))
    if models.setdefault(moment, found) != found:
        raise DataError.of(where, keys[0], expected=f"{models[moment][1]} as for other cameras", found=found[1])


def _meshes(
    root: Path, models: Mapping[str, tuple[str, Path]], moments: set[str], flame: Path | None, source: Source
) -> Meshes:
    kinds = {kind for kind, _ in models.values()}
    if len(kinds) > 1:
        raise DataError.of(source.path, "frames", expected="flame_param_path or mesh_path in all", found="both kinds")
    files = {moment: models[moment][1] for moment in sorted(moments, key=natural)}
    if kinds == {"mesh_path"}:
        rest = root / "canonical.obj"
        return MeshFiles({"head": files}, rest={"head": rest} if rest.is_file() else {})
    if flame is None:
        raise DataError.of(
            source.path, "flame_param_path", expected="FLAME's model file, which poses these parameters", found="none",
            fix="name it with --flame (generic_model.pkl of FLAME 2023, as VHAP has it by default), or export meshes",
        )  # fmt: skip
    source.inputs["flame"] = flame
    sequence = FlameSequence(flame, files)
    source.notes.extend(sequence.notes)
    return sequence


def _split(source: Source, subsets: Mapping[str, Sequence[tuple[str, str]]]) -> None:
    """Held-out moments and the held-out camera, from the pairs (camera, moment) of the subsets."""
    if not subsets.get("train"):
        return
    seen = {moment for name in ("train", "val") for _, moment in subsets.get(name, ())}
    held = {moment for _, moment in subsets.get("test", ())} - seen
    if held:
        source.train, source.test = sorted(seen, key=natural), sorted(held, key=natural)
    trained = {camera for camera, _ in subsets["train"]}
    views = sorted({camera for camera, _ in subsets.get("val", ())} - trained, key=natural)
    if views:
        source.test_camera = views[0]
        for extra in views[1:]:
            source.notes.append(f"camera {extra} is left out: one camera is held out, and that is {views[0]}")
        source.shots = [shot for shot in source.shots if shot.camera not in views[1:]]


def _cuts(original: Mapping[str, int]) -> list[tuple[str, str]]:
    """Where the numbers that the moments had in the recording do not go on in their usual step."""
    moments = sorted(original, key=natural)
    steps = [original[b] - original[a] for a, b in zip(moments, moments[1:])]
    usual = Counter(steps).most_common(1)[0][0] if steps else 0
    return [(a, b) for a, b, step in zip(moments, moments[1:], steps) if step != usual]
