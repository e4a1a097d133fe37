"""FLAME head model (Li et al. 2017), and the conventions of the Decaf release around it.

Of the 300 shape and 100 expression directions of the file, the first `shape_count` and columns
300:300 + `expression_count` are used (Decaf: 100 and 50). Neck and eyeballs stay at zero unless given.

The Decaf release poses a head in two steps: the model first (expression, jaw), then a rigid motion ABOUT THE
CENTROID OF THE POSED VERTICES, `v' = R (v - mean(v)) + mean(v) + transl`. The first three of its
six `pose_params` are the same rotation once more and are never applied: `jaw_of_pose_params` drops them.
"""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from nbavatar.bodymodels.files import LandmarkArrays, ModelArrays
from nbavatar.bodymodels.lbs import Posed, SkinnedMesh, skinned_mesh
from nbavatar.errors import DataError
from nbavatar.math.rotations import axis_angle_to_matrix

__all__ = ["Flame", "Landmarks", "contour_rows", "jaw_of_pose_params", "rotate_about_centroid"]

_SHAPE_COLUMNS = 300
_YAW_STEPS = 39


@dataclasses.dataclass(frozen=True)
class Landmarks:
    """Landmarks as points on triangles: vertex ids int64 `[..., L, 3]`, barycentric weights `[..., L, 3]`."""

    vertices: Tensor
    weights: Tensor

    def __call__(self, verts: Tensor) -> Tensor:
        """Landmark positions `[B, L, 3]` on posed vertices `[B, V, 3]`."""
        return torch.einsum("blkc,lk->blc", verts[:, self.vertices], self.weights.to(verts.dtype))


@dataclasses.dataclass(frozen=True)
class Flame:
    """The head model.

    Attributes:
        mesh: skinned mesh whose shape directions are the used shape, then the used expression directions.
        faces: int64 `[F, 3]`.
        shape_count, expression_count: how many of each.
        landmarks: the fixed set of 68, or None when built without a landmark file.
        contour: 17 contour landmarks for each of 79 yaw steps, or None.
    """

    mesh: SkinnedMesh
    faces: np.ndarray
    shape_count: int
    expression_count: int
    landmarks: Landmarks | None = None
    contour: Landmarks | None = None

    @classmethod
    def build(
        cls,
        arrays: ModelArrays,
        landmarks: LandmarkArrays | None = None,
        *,
        shape_count: int = 100,
        expression_count: int = 50,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> "Flame":
        """Builds the model from file contents (`files.read_flame`, `files.read_landmarks`).

        Raises:
            DataError: the file has fewer directions than asked for.
        """
        total = arrays.shape_dirs.shape[2]
        if shape_count > _SHAPE_COLUMNS or total < _SHAPE_COLUMNS + expression_count:
            raise DataError.of(
                arrays.name, "shapedirs", expected=f"300 shape and at least {expression_count} expression directions",
                found=f"{total} in all", fix="give the full FLAME 2020 or 2023 file",
            )  # fmt: skip
        columns = [*range(shape_count), *range(_SHAPE_COLUMNS, _SHAPE_COLUMNS + expression_count)]
        mesh = skinned_mesh(
            arrays.template, arrays.shape_dirs[:, :, columns], arrays.pose_dirs, arrays.joint_regressor,
            arrays.weights, arrays.parents, dtype, device,
        )  # fmt: skip
        fixed = contour = None
        if landmarks is not None:
            fixed = _landmarks(arrays.faces, landmarks.full_faces, landmarks.full_weights, dtype, device)
            if landmarks.contour_faces is not None and landmarks.contour_weights is not None:
                contour = _landmarks(arrays.faces, landmarks.contour_faces, landmarks.contour_weights, dtype, device)
        return cls(mesh, arrays.faces, shape_count, expression_count, fixed, contour)

    def forward(
        self,
        shape: Tensor,
        expression: Tensor,
        jaw: Tensor,
        *,
        root: Tensor | None = None,
        neck: Tensor | None = None,
        eyes: Tensor | None = None,
    ) -> Posed:
        """Vertices and joints in the model's own frame.

        Args:
            shape: `[B, shape_count]` or `[1, shape_count]`.
            expression: `[B, expression_count]`.
            jaw: axis-angle `[B, 3]` [rad].
            root, neck: axis-angle `[B, 3]` [rad]; zero when absent.
            eyes: axis-angle of left and right eyeball `[B, 6]` [rad]; zero when absent.

        Returns:
            verts `[B, V, 3]`, joints `[B, 5, 3]` (root, neck, jaw, left eye, right eye) [m].
        """
        return self.mesh.pose(self.coefficients(shape, expression), self.rotations(jaw, root, neck, eyes))

    def coefficients(self, shape: Tensor, expression: Tensor) -> Tensor:
        """Shape and expression as coefficients of `mesh`, `[B, shape_count + expression_count]`."""
        return torch.cat([shape.expand(expression.shape[0], -1), expression], dim=-1)

    def rotations(
        self, jaw: Tensor, root: Tensor | None = None, neck: Tensor | None = None, eyes: Tensor | None = None
    ) -> Tensor:
        """Rotation matrices of the five joints, `[B, 5, 3, 3]`."""
        zero = torch.zeros_like(jaw)
        both = torch.cat([zero, zero], -1) if eyes is None else eyes
        pose = torch.cat([zero if root is None else root, zero if neck is None else neck, jaw, both], dim=-1)
        return axis_angle_to_matrix(pose.reshape(-1, 5, 3))

    def forward_decaf(
        self, shape: Tensor, expression: Tensor, jaw: Tensor, global_orient: Tensor, transl: Tensor
    ) -> Tensor:
        """World vertices `[B, V, 3]` [m] from the parameters of the Decaf release (see the module).

        Args:
            shape, expression, jaw: as in `forward`.
            global_orient: axis-angle `[B, 3]` [rad].
            transl: `[B, 3]` [m].
        """
        verts = self.forward(shape, expression, jaw).verts
        return rotate_about_centroid(verts, axis_angle_to_matrix(global_orient), transl)

    def contour_landmarks(self, verts: Tensor, rows: Tensor) -> Tensor:
        """Contour landmarks `[B, 17, 3]` for the yaw step of each pose (`contour_rows`, int64 `[B]`).

        Raises:
            DataError: the landmark file had no contour.
        """
        if self.contour is None:
            raise DataError.of("landmarks", "dynamic_lmk_faces_idx", expected="a yaw-dependent contour", found="none")
        batch = torch.arange(verts.shape[0], device=verts.device)[:, None, None]
        corners = verts[batch, self.contour.vertices[rows]]
        return torch.einsum("blkc,blk->blc", corners, self.contour.weights[rows].to(verts.dtype))


def rotate_about_centroid(verts: Tensor, rotation: Tensor, transl: Tensor) -> Tensor:
    """The Decaf release's rigid motion: `v' = R (v - mean(v)) + mean(v) + transl`.

    Args:
        verts: `[B, V, 3]` [m], model frame.
        rotation: `[B, 3, 3]`.
        transl: `[B, 3]` [m].

    Returns:
        World vertices `[B, V, 3]` [m]. The equivalent rigid motion is `(R, c - R c + transl)` with the
        centroid c, and changes with shape, expression and jaw.
    """
    centre = verts.mean(1, keepdim=True)
    return (verts - centre) @ rotation.mT + centre + transl[:, None]


def jaw_of_pose_params(pose_params: Tensor) -> Tensor:
    """Jaw rotation `[..., 3]` from `pose_params` `[..., 6]`; the first three repeat `global_orient` and are dropped."""
    return pose_params[..., 3:6]


def contour_rows(rotation: Tensor) -> Tensor:
    """Row of the contour table for a head rotation (the yaw steps of the FLAME landmark files).

    Rows 0 to 39 are yaw 0 to 39 degrees to one side, rows 40 to 78 are 1 to 39 degrees to the other; beyond,
    the last row holds. The contour is the silhouette's side of the jaw as seen from +z.

    Args:
        rotation: head rotation relative to the viewer `[B, 3, 3]`.

    Returns:
        int64 `[B]`.
    """
    flat = torch.sqrt(rotation[:, 0, 0] ** 2 + rotation[:, 1, 0] ** 2)
    yaw = torch.rad2deg(torch.atan2(-rotation[:, 2, 0], flat))
    steps = torch.round((-yaw).clamp(-_YAW_STEPS, _YAW_STEPS)).long()
    return torch.where(steps < 0, _YAW_STEPS - steps, steps)


def _landmarks(
    faces: np.ndarray, ids: np.ndarray, weights: np.ndarray, dtype: torch.dtype, device: torch.device | str
) -> Landmarks:
    corners = torch.tensor(faces[ids], dtype=torch.int64, device=device)
    return Landmarks(corners, torch.tensor(weights, device=device).to(dtype))
