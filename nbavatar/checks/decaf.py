"""A Decaf subject looked over: everything read once, and the open questions of the release answered by reprojection.

The release does not say whether its videos are still distorted, nor where its camera matrices put pixel centres.
Landmarks of the posed models, projected with and without the lens, against the stored 2D landmarks tell.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import Camera, project
from nbavatar.data.decaf import check_counts, frame_counts, read_camera, read_cuts
from nbavatar.data.decaf_files import DecafSubject
from nbavatar.data.decaf_tracks import build_tracks
from nbavatar.data.sequences import MeshSequence
from nbavatar.data.splits import runs_from_cuts
from nbavatar.errors import DataError

__all__ = ["Reprojection", "SubjectReport", "check_subject"]

_SAMPLES = 40


@dataclasses.dataclass(frozen=True)
class Reprojection:
    """Median distance of stored landmarks to projected ones [px], and of the former to the latter as a mean vector.

    Attributes:
        camera, part: which.
        with_lens: with the camera's distortion, or as without where it has none.
        without_lens: with the camera matrix alone.
        offset: median of stored minus projected x and y, with the lens [px].
    """

    camera: str
    part: str
    with_lens: float
    without_lens: float
    offset: tuple[float, float]


@dataclasses.dataclass
class SubjectReport:
    """What was found; the subject is usable if `defects` is empty."""

    defects: list[str] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    reprojection: list[Reprojection] = dataclasses.field(default_factory=list)
    cameras: dict[str, Camera] = dataclasses.field(default_factory=dict)
    sequence: MeshSequence | None = None


def check_subject(subject: DecafSubject, cameras: Sequence[str]) -> SubjectReport:
    """Reads one subject as the pipeline will, on a sample of its frames."""
    report = SubjectReport()
    for name in cameras:
        try:
            report.cameras[name], found = read_camera(subject, name)
        except DataError as error:
            report.defects.append(str(error))
            continue
        extra = sorted(set(found["keys"]) - {"intrinsic", "extrinsic", found["distortion_key"]})
        if extra:
            report.notes.append(f"{subject.name} camera {name}: keys that are not used: {', '.join(extra)}")
        report.notes.append(f"{subject.name} camera {name}: distortion under '{found['distortion_key']}'")
    try:
        count = check_counts(frame_counts(subject, list(report.cameras)))
        runs = runs_from_cuts(read_cuts(subject), count, str(subject.cut_file))
        frames = np.unique(np.linspace(0, count - 1, min(count, _SAMPLES)).astype(int)).tolist()
        report.sequence, found = build_tracks(
            subject, report.cameras, frames, count, shape_tolerance=1e-3, rotation_tolerance=1e-3
        )
    except DataError as error:
        report.defects.append(str(error))
        return report
    report.notes.append(f"{subject.name}: {count} frames in {len(runs)} uncut runs, folder {subject.folder}")
    report.notes.append(
        f"{subject.name}: largest root rotation in pose_params {found['pose_params_root_max_rad']:.3g} rad"
    )
    report.notes += [f"{subject.name}: {name} is absent" for name in found["absent"]]
    if report.cameras:
        try:
            report.reprojection = _reprojection(subject, report.sequence, report.cameras)
        except DataError as error:
            report.defects.append(str(error))
    return report


def _reprojection(subject: DecafSubject, sequence: MeshSequence, cameras: dict[str, Camera]) -> list[Reprojection]:
    result = []
    for part, points in _landmarks(subject, sequence).items():
        for name, camera in cameras.items():
            stored = sequence.extras[f"keypoints.{part}.{name}"].astype(np.float64)
            sure = stored[..., 2] > 0.5
            if not sure.any():
                continue
            ideal, _ = project(points, camera.K, camera.cam_from_world)
            bent = distort_pixels(ideal, camera.K, camera.distortion)
            away = [np.linalg.norm(stored[..., :2] - seen, axis=-1)[sure] for seen in (bent, ideal)]
            offset = np.median((stored[..., :2] - bent)[sure], axis=0)
            lens, plain = (float(np.median(distance)) for distance in away)
            result.append(Reprojection(name, part, lens, plain, (float(offset[0]), float(offset[1]))))
    return result


def _landmarks(subject: DecafSubject, sequence: MeshSequence) -> dict[str, np.ndarray]:
    """68 head landmarks and 21 hand joints with shortened tips, float64 `[N, L, 3]` [m, world]."""
    import torch

    from nbavatar.bodymodels.files import read_landmarks, read_mano
    from nbavatar.bodymodels.mano import Mano, shorten_tips

    head = sequence.parts["head"]
    embedding = read_landmarks(subject.assets.landmarks, len(head.faces))
    corners = head.verts[:, head.faces[embedding.full_faces]].astype(np.float64)
    mano = Mano.build(read_mano(subject.assets.mano()))
    names = ("betas", "hand_pose", "global_orient", "transl")
    with torch.inference_mode():
        values = [torch.from_numpy(sequence.extras[f"param.right_hand.{name}"]) for name in names]
        joints = shorten_tips(mano.forward(*values).joints).numpy().astype(np.float64)
    return {"head": np.einsum("nlkc,lk->nlc", corners, embedding.full_weights), "right_hand": joints}
