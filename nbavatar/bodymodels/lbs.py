"""Linear blend skinning with shape and pose correctives (SMPL, Loper et al. 2015, eqs. 2-10).

    v_shaped = template + shape_dirs b                    J = joint_regressor v_shaped
    v_posed  = v_shaped + pose_dirs vec(R_1 - I, ...)     v = sum_j w_j (G_j [v_posed - J_j] + ...)

The joints depend linearly on the shape, so `J_regressor` is folded into a joint template and joint directions
once: a `SkinnedMesh` can then be cut to any subset of vertices and still poses them exactly. A refit that compares
68 landmarks poses the 204 vertices they need, not 5,023.

Everything is batched `[B, ...]`, differentiable, and runs in the dtype and on the device of the arrays.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

__all__ = ["Posed", "SkinnedMesh", "joint_transforms", "skinned_mesh"]


class Posed(NamedTuple):
    """Posed vertices `[B, V, 3]` and joints `[B, J, 3]` [m]."""

    verts: Tensor
    joints: Tensor


@dataclasses.dataclass(frozen=True)
class SkinnedMesh:
    """Arrays of a skinned mesh; `S` shape directions, `P = 9 (J - 1)` pose features.

    Attributes:
        template: `[V, 3]` [m].
        shape_dirs: `[V, 3, S]` [m].
        pose_dirs: `[V, 3, P]` [m].
        weights: `[V, J]`, rows sum to 1.
        joint_template: `[J, 3]` [m].
        joint_dirs: `[J, 3, S]` [m].
        parents: parent of each joint, -1 at the root; parents come first.
    """

    template: Tensor
    shape_dirs: Tensor
    pose_dirs: Tensor
    weights: Tensor
    joint_template: Tensor
    joint_dirs: Tensor
    parents: tuple[int, ...]

    def subset(self, vertices: Tensor) -> "SkinnedMesh":
        """The same mesh with these vertices only `[n]`; joints stay as they are."""
        return dataclasses.replace(
            self,
            template=self.template[vertices],
            shape_dirs=self.shape_dirs[vertices],
            pose_dirs=self.pose_dirs[vertices],
            weights=self.weights[vertices],
        )

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "SkinnedMesh":
        """The same mesh in another dtype or on another device."""
        moved = {
            field.name: getattr(self, field.name).to(dtype=dtype, device=device)
            for field in dataclasses.fields(self)
            if field.name != "parents"
        }
        return dataclasses.replace(self, **moved)

    def pose(self, coefficients: Tensor, rotations: Tensor) -> Posed:
        """Shapes and poses the mesh.

        Args:
            coefficients: shape coefficients `[B, S]`, or `[1, S]` for one shape in all poses.
            rotations: rotation matrix of every joint relative to its parent, `[B, J, 3, 3]`.

        Returns:
            Vertices and joints; the root joint stays where the shape puts it (no translation).
        """
        batch = rotations.shape[0]
        joints = self.joint_template + torch.einsum("bs,jcs->bjc", coefficients, self.joint_dirs)
        world, moved = joint_transforms(joints.expand(batch, -1, -1), rotations, self.parents)
        identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        feature = (rotations[:, 1:] - identity).reshape(batch, -1)
        count = self.template.shape[0]
        shaped = self.template.reshape(-1) + coefficients @ self.shape_dirs.reshape(3 * count, -1).mT
        posed = (shaped + feature @ self.pose_dirs.reshape(3 * count, -1).mT).reshape(batch, count, 3)
        # Blending the 3x4 transforms first costs V*J*12 and leaves one small product a vertex.
        blended = (self.weights @ world.reshape(batch, -1, 12)).reshape(batch, count, 3, 4)
        verts = (blended[..., :3] @ posed[..., None]).squeeze(-1) + blended[..., 3]
        return Posed(verts, moved)

    def mean(self, coefficients: Tensor, rotations: Tensor) -> Tensor:
        """Mean of all posed vertices `[B, 3]`, from per-joint moments (see `moments`)."""
        return self.moments().pose(coefficients, rotations)

    def moments(self) -> "_Moments":
        """Per-joint weighted means: the centroid of the posed mesh at the cost of a few vertices."""
        count = self.template.shape[0]

        def of(values: Tensor) -> Tensor:
            return (self.weights.mT @ values.reshape(count, -1) / count).reshape(-1, *values.shape[1:])

        return _Moments(self, self.weights.mean(0), of(self.template), of(self.shape_dirs), of(self.pose_dirs))


@dataclasses.dataclass(frozen=True)
class _Moments:
    """Skinning is linear in the vertices, so the mean vertex needs one weighted mean a joint only."""

    mesh: SkinnedMesh
    mass: Tensor
    template: Tensor
    shape_dirs: Tensor
    pose_dirs: Tensor

    def pose(self, coefficients: Tensor, rotations: Tensor) -> Tensor:
        """Mean of the posed vertices `[B, 3]` [m]; arguments as in `SkinnedMesh.pose`."""
        batch = rotations.shape[0]
        joints = self.mesh.joint_template + torch.einsum("bs,jcs->bjc", coefficients, self.mesh.joint_dirs)
        world, _ = joint_transforms(joints.expand(batch, -1, -1), rotations, self.mesh.parents)
        feature = (rotations[:, 1:] - torch.eye(3, dtype=rotations.dtype, device=rotations.device)).reshape(batch, -1)
        shaped = self.template + torch.einsum("bs,jcs->bjc", coefficients, self.shape_dirs)
        posed = shaped + torch.einsum("bp,jcp->bjc", feature, self.pose_dirs)
        turned = (world[..., :3] @ posed[..., None]).squeeze(-1)
        return (turned + world[..., 3] * self.mass[:, None]).sum(1)


def joint_transforms(joints: Tensor, rotations: Tensor, parents: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Composes the kinematic chain.

    Args:
        joints: rest positions `[B, J, 3]` [m].
        rotations: relative rotations `[B, J, 3, 3]`.
        parents: parent of each joint, -1 at the root.

    Returns:
        transforms `[B, J, 3, 4]` that take a rest point to its posed place, and posed joints `[B, J, 3]` [m].
    """
    turns: list[Tensor] = [rotations[:, 0]]
    places: list[Tensor] = [joints[:, 0]]
    for child, parent in enumerate(parents[1:], start=1):
        bone = (joints[:, child] - joints[:, parent])[..., None]
        turns.append(turns[parent] @ rotations[:, child])
        places.append((turns[parent] @ bone).squeeze(-1) + places[parent])
    turned, placed = torch.stack(turns, 1), torch.stack(places, 1)
    shift = placed - (turned @ joints[..., None]).squeeze(-1)
    return torch.cat([turned, shift[..., None]], dim=-1), placed


def skinned_mesh(
    template: np.ndarray,
    shape_dirs: np.ndarray,
    pose_dirs: np.ndarray,
    joint_regressor: np.ndarray,
    weights: np.ndarray,
    parents: tuple[int, ...],
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> SkinnedMesh:
    """Builds a `SkinnedMesh` from the arrays of a model file (shapes as there); the joints are folded in float64."""
    values = (
        template, shape_dirs, pose_dirs, weights, joint_regressor @ template,
        np.einsum("jv,vcs->jcs", joint_regressor, shape_dirs),
    )  # fmt: skip
    tensors = [torch.tensor(np.asarray(value, dtype=np.float64), device=device).to(dtype) for value in values]
    return SkinnedMesh(*tensors, parents=tuple(parents))
