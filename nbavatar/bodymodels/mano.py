"""MANO hand model (Romero et al. 2017), right, left, and one mirrored from the other.

Pose is 45 axis-angle values relative to the flat template (zero mean pose), rotation is about the wrist joint, then
comes the translation. The 21 joints are the 16 of the model and 5 fingertip vertices, in this order:
wrist, index 1-3, middle 1-3, little 1-3, ring 1-3, thumb 1-3, then the tips of thumb, index, middle, ring, little.

Detectors put the fingertip on the pad, not on the outermost vertex: `shorten_tips` moves the tips to 0.7 of the
last bone, as the Decaf release does before it compares keypoints. It never touches the mesh.
"""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from nbavatar.bodymodels.files import MANO_TIP_VERTICES, ModelArrays
from nbavatar.bodymodels.lbs import Posed, SkinnedMesh, skinned_mesh
from nbavatar.math.rotations import axis_angle_to_matrix

__all__ = ["JOINT_NAMES", "TIP_PAIRS", "Mano", "mirror_axis_angle", "mirror_model", "shorten_tips"]

JOINT_NAMES = (
    "wrist",
    *(f"{finger}{i}" for finger in ("index", "middle", "little", "ring", "thumb") for i in (1, 2, 3)),
    *(f"{finger}_tip" for finger in ("thumb", "index", "middle", "ring", "little")),
)
TIP_PAIRS = ((15, 16), (3, 17), (6, 18), (12, 19), (9, 20))
"""Last joint and tip of each finger, as rows of the 21 joints."""


@dataclasses.dataclass(frozen=True)
class Mano:
    """The hand model of one side.

    Attributes:
        mesh: skinned mesh, 16 joints.
        faces: int64 `[F, 3]`.
        tips: vertex ids of the five fingertips, int64 `[5]`, thumb to little finger.
        mean_pose: mean hand pose of the file `[45]` [rad] (a prior; poses are NOT relative to it), zero if absent.
        pose_basis: principal poses of the file `[n, 45]`, orthonormal rows, or None.
        pose_deviation: standard deviation along each row of `pose_basis` `[n]` [rad], or None.
        side: `right` or `left`.
    """

    mesh: SkinnedMesh
    faces: np.ndarray
    tips: Tensor
    mean_pose: Tensor
    pose_basis: Tensor | None
    pose_deviation: Tensor | None
    side: str

    @classmethod
    def build(
        cls,
        arrays: ModelArrays,
        side: str = "right",
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> "Mano":
        """Builds the model from file contents (`files.read_mano`, or `mirror_model` of the other side's)."""
        mesh = skinned_mesh(
            arrays.template, arrays.shape_dirs, arrays.pose_dirs, arrays.joint_regressor, arrays.weights,
            arrays.parents, dtype, device,
        )  # fmt: skip

        def tensor(value: np.ndarray | None) -> Tensor | None:
            return None if value is None else torch.tensor(np.asarray(value), device=device).to(dtype)

        mean = np.zeros(45) if arrays.hand_mean is None else arrays.hand_mean
        basis, deviation = _pose_statistics(arrays)
        tips = torch.tensor(arrays.tip_vertices or MANO_TIP_VERTICES, dtype=torch.int64, device=device)
        mean_pose = torch.tensor(mean, device=device).to(dtype)
        return cls(mesh, arrays.faces, tips, mean_pose, tensor(basis), tensor(deviation), side)

    def forward(self, betas: Tensor, hand_pose: Tensor, global_orient: Tensor, transl: Tensor | None = None) -> Posed:
        """Vertices and the 21 joints.

        Args:
            betas: `[B, 10]` or `[1, 10]`.
            hand_pose: axis-angle `[B, 45]` [rad].
            global_orient: axis-angle `[B, 3]` [rad], about the wrist joint.
            transl: `[B, 3]` [m], added last; zero when absent.

        Returns:
            verts `[B, V, 3]`, joints `[B, 21, 3]` [m].
        """
        pose = torch.cat([global_orient, hand_pose], dim=-1).reshape(-1, 16, 3)
        verts, joints = self.mesh.pose(betas, axis_angle_to_matrix(pose))
        joints = torch.cat([joints, verts[:, self.tips]], dim=1)
        if transl is not None:
            verts, joints = verts + transl[:, None], joints + transl[:, None]
        return Posed(verts, joints)


def shorten_tips(joints: Tensor, ratio: float = 0.7) -> Tensor:
    """Moves each fingertip to `ratio` of its last bone.

    Args:
        joints: `[B, 21, C]`, in any space where bones are straight.
        ratio: 1 leaves the joints as they are.
    """
    last, tips = [a for a, _ in TIP_PAIRS], [b for _, b in TIP_PAIRS]
    moved = joints[:, last] + ratio * (joints[:, tips] - joints[:, last])
    return torch.cat([joints[:, :16], moved], dim=1)


def mirror_axis_angle(pose: Tensor) -> Tensor:
    """Axis-angle `[..., 3 n]` of the pose seen in the mirror x -> -x: y and z change sign."""
    signs = torch.tensor([1.0, -1.0, -1.0], dtype=pose.dtype, device=pose.device)
    return (pose.reshape(*pose.shape[:-1], -1, 3) * signs).reshape(pose.shape)


def mirror_model(arrays: ModelArrays) -> ModelArrays:
    """The other hand: the model mirrored in x, with outward normals.

    Posing the mirrored model by `mirror_axis_angle(pose)` gives the mirror image of the original's pose.
    """
    flip = np.array([-1.0, 1.0, 1.0])
    # Pose features are entries of R - I; in the mirror, R[a, b] changes sign when exactly one of a, b is x.
    feature_signs = np.tile(np.outer(flip, flip).reshape(-1), len(arrays.parents) - 1)
    angle_signs = np.tile(-flip, 15)
    return dataclasses.replace(
        arrays,
        name=f"{arrays.name} (mirrored)",
        template=arrays.template * flip,
        faces=arrays.faces[:, ::-1].copy(),
        shape_dirs=arrays.shape_dirs * flip[:, None],
        pose_dirs=arrays.pose_dirs * flip[:, None] * feature_signs,
        hand_mean=None if arrays.hand_mean is None else arrays.hand_mean * angle_signs,
        hand_components=None if arrays.hand_components is None else arrays.hand_components * angle_signs,
    )


def _pose_statistics(arrays: ModelArrays) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Orthonormal principal poses and their deviations, from the file's components and sample coefficients."""
    if arrays.hand_components is None:
        return None, None
    components, samples = arrays.hand_components, arrays.hand_coefficients
    if samples is None or samples.shape[1] != len(components) or len(samples) < 2:
        return None, None
    poses = (samples - samples.mean(0)) @ components
    _, values, rows = np.linalg.svd(poses / np.sqrt(len(samples) - 1), full_matrices=False)
    return rows, values
