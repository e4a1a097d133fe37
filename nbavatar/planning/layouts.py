"""Files that the user gave, in either layout: which of them a job reads, and digests of them.

The few files of a Decaf dataset, and the small ones of a capture, are inputs of jobs. The folders of a capture hold too
many files to be inputs one by one, and the times of folders do not tell of files that were changed in place: their
digests are parameters. So are those of files that are inputs, because times of inputs do not tell of a file whose place
an older one has taken.
"""

from collections.abc import Iterable
from pathlib import Path

from nbavatar.config.inputs import files_digest, given_digest, mesh_digest, rig_digest, supplied_digest
from nbavatar.planning.run import Plan

__all__ = [
    "assets_folder",
    "body_models",
    "camera_files",
    "capture_digests",
    "data_digest",
    "dataset",
    "image_digest",
    "mask_digest",
    "meshes_digest",
    "track_files",
]

# Where the release keeps its subjects; a dataset that is yet to be made follows it.
_TEST_SUBJECTS = ("S1", "S3", "S6")


def assets_folder(plan: Plan) -> Path:
    """Folder of the body models that a Decaf dataset needs."""
    return Path(plan.run.data_root) / "assets"


def body_models(plan: Plan) -> list[Path]:
    """Body models, supplied by the user."""
    base = assets_folder(plan)
    return [
        base / "generic_model.pkl",
        base / "landmark_embedding.npy",
        base / "mano_v1_2" / "models" / "MANO_RIGHT.pkl",
    ]


def _rig(plan: Plan, subject: str) -> list[Path]:
    base = Path(plan.subjects[subject].root)
    return [base / "cameras.json", base / "splits.json"]


def _split_folder(plan: Plan, subject: str) -> Path:
    """`train` or `test`: Decaf splits its release by subject."""
    base = Path(plan.subjects[subject].root)
    found = [name for name in ("train", "test") if (base / name / "params" / subject).is_dir()]
    return base / (found[0] if found else "test" if subject in _TEST_SUBJECTS else "train")


def camera_files(plan: Plan, subject: str, camera: str) -> list[Path]:
    """Files that one camera's frames come from."""
    if plan.captured:
        return _rig(plan, subject)
    base = _split_folder(plan, subject)
    return [
        base / "videos" / subject / f"{camera}.mp4",
        base / "segmentations" / subject / f"{camera}.mp4",
        base / "cameras" / subject / "cameras.pkl",
        base / "cutIDs" / f"{subject}.pkl",
    ]


def track_files(plan: Plan, subject: str) -> list[Path]:
    """Files that a subject's parameters and meshes come from."""
    if plan.captured:
        return _rig(plan, subject)
    base = _split_folder(plan, subject)
    keyed = ("head_keys", "right_hand_keys", "head_bbs", "right_hand_bbs")
    return [
        base / "params" / subject / "params_smoothed.pkl",
        base / "cameras" / subject / "cameras.pkl",
        base / "cutIDs" / f"{subject}.pkl",
        base / "deformations" / subject / "deforms.npy",
        base / "contacts" / subject / "contacts_head.npy",
        base / "contacts" / subject / "contacts_rh.npy",
        *(base / name / subject / f"{camera}.npy" for name in keyed for camera in plan.subjects[subject].cameras),
        *body_models(plan),
    ]


def dataset(plan: Plan) -> list[Path]:
    """All files of the dataset that jobs read, in the order in which a synthetic one is declared."""
    found: dict[Path, None] = {}
    for subject in plan.subjects.values():
        found |= dict.fromkeys(track_files(plan, subject.name))
        for camera in subject.cameras:
            found |= dict.fromkeys(camera_files(plan, subject.name, camera))
    return list(found)


def data_digest(plan: Plan, files: Iterable[Path]) -> str:
    """Digest of files of the dataset; empty where it is synthetic, and so the run's own."""
    return "" if plan.run.synthetic else given_digest([str(path) for path in files])


def image_digest(plan: Plan, subject: str, camera: str) -> str:
    """Digest of the images of one camera of a capture."""
    return files_digest(plan.subjects[subject].root, camera, ["images"]) if plan.captured else ""


def mask_digest(plan: Plan, subject: str, camera: str) -> str:
    """Digest of one camera's masks, of a capture or supplied by the user."""
    supplied = plan.run.stages.masks.supplied
    if supplied:
        return supplied_digest(supplied, subject, camera)
    return files_digest(plan.subjects[subject].root, camera, ["masks", "alpha"]) if plan.captured else ""


def meshes_digest(plan: Plan, subject: str) -> str:
    """Digest of the meshes of a capture."""
    return mesh_digest(plan.subjects[subject].root) if plan.captured else ""


def capture_digests(plan: Plan, subject: str) -> list[str]:
    """Digests of all files of a capture that `check` reads."""
    folder, supplied = plan.subjects[subject].root, plan.run.stages.masks.supplied
    found = [rig_digest(folder), mesh_digest(folder)]
    for camera in plan.subjects[subject].cameras:
        found.append(files_digest(folder, camera, ["images", "masks", "alpha"]))
        found.append(supplied_digest(supplied, subject, camera))
    return found
