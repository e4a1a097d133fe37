"""Files of the Decaf dataset and of the body models that the paper needs: which are missing, where to get them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from nbavatar.data.decaf import FOLDERS, KEYPOINTS, list_subjects

__all__ = ["SOURCES", "Missing", "missing_files", "missing_message"]

SOURCES = {
    "decaf": "Decaf dataset: https://vcai.mpi-inf.mpg.de/projects/Decaf (non-commercial; unpack DecafDataset.zip)",
    "flame": "FLAME 2020: https://flame.is.tue.mpg.de (register, download 'FLAME 2020', take generic_model.pkl)",
    "landmarks": "landmark_embedding.npy: part of DECA, https://github.com/yfeng95/DECA (folder data)",
    "mano": "MANO v1.2: https://mano.is.tue.mpg.de (register, download 'Models & Code', take models/MANO_RIGHT.pkl)",
}
_ASSETS = {
    "assets/generic_model.pkl": "flame",
    "assets/landmark_embedding.npy": "landmarks",
    "assets/mano_v1_2/models/MANO_RIGHT.pkl": "mano",
    "assets/FLAME_neck_idx.npy": "decaf",
    "assets/neck_idx.npy": "decaf",
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
    missing = [Missing(path, source) for path, source in _ASSETS.items() if not (root / path).is_file()]
    subjects = list_subjects(root)
    for subject, ids in cameras.items():
        folder = subjects.get(subject, "{" + ",".join(FOLDERS) + "}")
        wanted = [f"{folder}/{kind}/{subject}/{camera}.mp4" for kind in ("videos", "segmentations") for camera in ids]
        wanted += [
            f"{folder}/{part}_{kind}/{subject}/{camera}.npy"
            for part in KEYPOINTS
            for kind in ("keys", "bbs")
            for camera in ids
        ]
        wanted += [
            f"{folder}/cameras/{subject}/cameras.pkl",
            f"{folder}/params/{subject}/params_smoothed.pkl",
            f"{folder}/deformations/{subject}/deforms.npy",
            f"{folder}/contacts/{subject}/contacts_head.npy",
            f"{folder}/contacts/{subject}/contacts_rh.npy",
            f"{folder}/cutIDs/{subject}.pkl",
            f"assets/accurate_shapes/{subject}.pkl",
        ]
        missing += [Missing(path, "decaf") for path in wanted if not (root / path).is_file()]
    return missing


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
