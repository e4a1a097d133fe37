"""Files of the Decaf dataset and of the body models that the paper needs: which are missing, where to get them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from nbavatar.data.decaf_files import FOLDERS, PARTS, Assets, DecafSubject, list_subjects

__all__ = ["SOURCES", "Missing", "missing_files", "missing_message"]

SOURCES = {
    "decaf": "Decaf dataset: https://vcai.mpi-inf.mpg.de/projects/Decaf (non-commercial; unpack DecafDataset.zip)",
    "flame": "FLAME 2020: https://flame.is.tue.mpg.de (register, download 'FLAME 2020', take generic_model.pkl)",
    "landmarks": "landmark_embedding.npy: part of DECA, https://github.com/yfeng95/DECA (folder data)",
    "mano": "MANO v1.2: https://mano.is.tue.mpg.de (register, download 'Models & Code', take models/MANO_RIGHT.pkl)",
}


@dataclasses.dataclass(frozen=True)
class Missing:
    """One file that is not there: its path below the root, and the key of `SOURCES` it comes from."""

    path: str
    source: str


def missing_files(root: Path, cameras: Mapping[str, Sequence[str]]) -> list[Missing]:
    """Files that the paper's run reads and that are not below `root`.

    Args:
        root: folder of the dataset, which need not exist.
        cameras: subject -> its cameras. A subject that is in neither folder is reported with `{train,test}`.
    """
    assets, subjects = Assets(Path("assets")), list_subjects(root)
    wanted = dict(zip(assets.body_models, ("flame", "landmarks", "mano"), strict=True))
    wanted |= dict.fromkeys((assets.neck_of_dents, assets.neck_of_contacts), "decaf")
    for name, ids in cameras.items():
        subject = DecafSubject(Path(), subjects.get(name, "{" + ",".join(FOLDERS) + "}"), name)
        files = [file(camera) for file in (subject.video, subject.matte) for camera in ids]
        files += [*subject.detections(ids), subject.calibration, subject.parameters, subject.deformations]
        files += [*map(subject.contacts, PARTS), subject.cut_file, subject.own_shape]
        wanted |= dict.fromkeys(files, "decaf")
    return [Missing(path.as_posix(), source) for path, source in wanted.items() if not (root / path).is_file()]


def missing_message(root: Path, missing: Sequence[Missing]) -> str:
    """One message: what is missing, by source, where to get it and where to put it.

    Files of one folder that differ in their last part only are written as one line with braces.
    """
    lines = [f"{len(missing)} files that the paper's run reads are missing below {root}/"]
    for source, where in SOURCES.items():
        paths = [item.path for item in missing if item.source == source]
        if paths:
            lines.append(f"\n{where}\n  put below {root}/:")
            lines += [f"    {line}" for line in _folded(paths)]
    return "\n".join(lines)


def _folded(paths: Sequence[str]) -> list[str]:
    groups: dict[tuple[str, str], list[str]] = {}
    for path in paths:
        folder, _, name = path.rpartition("/")
        stem, dot, suffix = name.rpartition(".")
        groups.setdefault((folder, dot + suffix), []).append(stem)
    lines = []
    for (folder, suffix), stems in groups.items():
        name = stems[0] if len(stems) == 1 else "{" + ",".join(stems) + "}"
        lines.append(f"{folder}/{name}{suffix}")
    return lines
