"""Files that the user gave, in either layout: which of them a job reads, and digests of them.

The few files of a Decaf dataset, and the small ones of a capture, are inputs of jobs. The folders of a capture hold too
many files to be inputs one by one, and the times of folders do not tell of files that were changed in place: their
digests are parameters. So are those of files that are inputs, because times of inputs do not tell of a file whose place
an older one has taken.
"""

from collections.abc import Iterable
from pathlib import Path

from nbavatar.config.inputs import files_digest, given_digest, mesh_digest, rig_digest, supplied_digest
from nbavatar.data.decaf_files import Assets, expected_subject
from nbavatar.planning.run import Plan

__all__ = [
    "assets",
    "camera_files",
    "capture_digests",
    "data_digest",
    "dataset",
    "image_digest",
    "mask_digest",
    "meshes_digest",
    "track_files",
]


def assets(plan: Plan) -> Assets:
    """Body models of a Decaf dataset, supplied by the user."""
    return Assets(Path(plan.run.data_root) / "assets")


def _rig(plan: Plan, subject: str) -> list[Path]:
    base = Path(plan.subjects[subject].root)
    return [base / "cameras.json", base / "splits.json"]


def camera_files(plan: Plan, subject: str, camera: str) -> list[Path]:
    """Files that one camera's frames come from."""
    if plan.captured:
        return _rig(plan, subject)
    return expected_subject(plan.subjects[subject].root, subject).camera_files(camera)


def track_files(plan: Plan, subject: str) -> list[Path]:
    """Files that a subject's parameters and meshes come from."""
    if plan.captured:
        return _rig(plan, subject)
    return expected_subject(plan.subjects[subject].root, subject).track_files(plan.subjects[subject].cameras)


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
