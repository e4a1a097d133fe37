"""A few points of a skinned mesh, with analytic derivatives.

A landmark is a weighted mean of vertices. Skinning is linear in the vertices, so such a point is posed from one
weighted sum a joint (its moments) without the vertices themselves:

    x_p = sum_j  W_j (m_pj + M_pj b + N_pj f - mu_pj J_j(b)) + mu_pj t_j

with world rotations W and places t of the joints, shape coefficients b and pose features f. A head refit needs 69
such points instead of 5,023 vertices. Derivatives are written out: with respect to b they are the same sums over the
basis, with respect to a turn `R_k exp(d)` of joint k the lever arms of everything below it, plus the pose correctives.
"""

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from nbavatar.bodymodels.lbs import SkinnedMesh

__all__ = ["PointBatch", "SkinnedPoints", "concatenate", "skew", "skinned_points"]


class PointBatch(NamedTuple):
    """Posed points, and their derivatives.

    Attributes:
        points: `[B, P, 3]` [m].
        by_shape: `[B, P, 3, S]`.
        by_turn: `[B, P, 3, 3 A]`, A active joints, each a right perturbation of its local rotation [m/rad].
    """

    points: Tensor
    by_shape: Tensor
    by_turn: Tensor


@dataclasses.dataclass(frozen=True)
class SkinnedPoints:
    """P points of a skinned mesh, as moments, followed by some of its joints.

    Attributes:
        mesh: the mesh (its joints and parents are used, not its vertices).
        active: joints that may turn; all others stay at the identity.
        mass: `[P, J]`.
        template: `[P, J, 3]`.
        shape_dirs: `[P, J, 3, S]`.
        pose_dirs: `[P, J, 3, 9 A']` for the A' active joints that have pose features (all but the root).
        joints: ids of joints that are appended as points.
    """

    mesh: SkinnedMesh
    active: tuple[int, ...]
    mass: Tensor
    template: Tensor
    shape_dirs: Tensor
    pose_dirs: Tensor
    joints: tuple[int, ...]

    def pose(self, coefficients: Tensor, turns: Tensor) -> PointBatch:
        """Poses the points and differentiates them.

        Args:
            coefficients: `[B, S]` or `[1, S]`.
            turns: local rotations of the active joints `[B, A, 3, 3]`.
        """
        batch, dtype, device = turns.shape[0], turns.dtype, turns.device
        mesh = self.mesh
        eye = torch.eye(3, dtype=dtype, device=device)
        local = {joint: turns[:, i] for i, joint in enumerate(self.active)}
        rest = (mesh.joint_template + torch.einsum("bs,jcs->bjc", coefficients, mesh.joint_dirs)).expand(batch, -1, -1)
        rotation, place, place_by_shape = _chain(rest, local, mesh.joint_dirs, mesh.parents, eye)

        feature = [(local[j] - eye).reshape(batch, 9) for j in self.active if j > 0]
        arm = self.template + torch.einsum("bs,pjcs->bpjc", coefficients, self.shape_dirs)
        if feature:
            arm = arm + torch.einsum("bf,pjcf->bpjc", torch.cat(feature, 1), self.pose_dirs)
        arm = arm - self.mass[..., None] * rest[:, None]
        share = torch.einsum("bjac,bpjc->bpja", rotation, arm) + self.mass[..., None] * place[:, None]

        # A joint that nothing above turns stays at rest: its share of a derivative is the constant basis.
        below_any = torch.tensor(_descendants(mesh.parents))[list(self.active)].any(0)
        moving, still = torch.nonzero(below_any)[:, 0], torch.nonzero(~below_any)[:, 0]
        turns_of, mass = rotation[:, moving], self.mass[:, moving]
        lever_dirs = self.shape_dirs[:, moving] - mass[..., None, None] * mesh.joint_dirs[moving]
        by_shape = _turned(turns_of, lever_dirs) + torch.einsum("pj,bjas->bpas", mass, place_by_shape[:, moving])
        by_shape = by_shape + self.shape_dirs[:, still].sum(1)
        correctives = None
        if feature:
            correctives = _turned(turns_of, self.pose_dirs[:, moving]) + self.pose_dirs[:, still].sum(1)
        points = torch.cat([share.sum(2), place[:, list(self.joints)]], 1)
        by_shape = torch.cat([by_shape, place_by_shape[:, list(self.joints)]], 1)

        active, hung = list(self.active), list(self.joints)
        under = torch.tensor(_descendants(mesh.parents), dtype=dtype, device=device)[active]
        pivot = place[:, None, active]
        lever = torch.einsum("bpja,kj->bpka", share, under) - (self.mass @ under.mT)[..., None] * pivot
        below = (place[:, hung, None] - pivot) * under[:, hung].mT[..., None]
        by_turn = -skew(torch.cat([lever, below], 1)) @ rotation[:, None, active]
        if correctives is not None:
            bending = [i for i, joint in enumerate(active) if joint > 0]
            generators = torch.stack([skew(axis) for axis in eye])
            turned = torch.einsum("bkij,cjl->bkilc", turns[:, bending], generators).flatten(2, 3)
            blocks = correctives.reshape(batch, -1, 3, len(bending), 9)
            by_turn[:, : share.shape[1], bending] += torch.einsum("bpakf,bkfc->bpkac", blocks, turned)
        return PointBatch(points, by_shape, by_turn.transpose(2, 3).flatten(3))


def skinned_points(
    mesh: SkinnedMesh, vertices: Tensor, weights: Tensor, active: tuple[int, ...], joints: tuple[int, ...] = ()
) -> SkinnedPoints:
    """Moments of points that are weighted sums of vertices.

    Args:
        mesh: the mesh.
        vertices: vertex ids int64 `[P, k]`.
        weights: their weights `[P, k]`, rows sum to 1.
        active: joints that may turn.
        joints: joints to append as points.
    """
    joint_count = len(mesh.parents)
    featured = [9 * (j - 1) + i for j in active if j > 0 for i in range(9)]

    def moments(values: Tensor) -> Tensor:
        flat = values.reshape(values.shape[0], -1)
        # One point at a time: the centroid alone has as many corners as the mesh has vertices.
        rows = [(weights[p, :, None] * mesh.weights[vertices[p]]).mT @ flat[vertices[p]] for p in range(len(vertices))]
        return torch.stack(rows).reshape(len(vertices), joint_count, *values.shape[1:])

    mass = moments(torch.ones_like(mesh.template[:, :1]))[..., 0]
    pose_dirs = mesh.pose_dirs[..., featured]
    return SkinnedPoints(
        mesh, tuple(active), mass, moments(mesh.template), moments(mesh.shape_dirs), moments(pose_dirs), tuple(joints)
    )


def concatenate(first: SkinnedPoints, second: SkinnedPoints) -> SkinnedPoints:
    """Points of both, of the same mesh and active joints; joints are those of the first."""
    return dataclasses.replace(
        first,
        mass=torch.cat([first.mass, second.mass]),
        template=torch.cat([first.template, second.template]),
        shape_dirs=torch.cat([first.shape_dirs, second.shape_dirs]),
        pose_dirs=torch.cat([first.pose_dirs, second.pose_dirs]),
    )


def skew(vectors: Tensor) -> Tensor:
    """Matrices `[..., 3, 3]` of the cross products with `[..., 3]`: `skew(a) b = a x b`."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vectors.shape, 3)


def _turned(rotation: Tensor, basis: Tensor) -> Tensor:
    """Sum over joints of `rotation [B, J, 3, 3]` times `basis [P, J, 3, S]`: `[B, P, 3, S]`, as one matrix product."""
    batch, joints = rotation.shape[:2]
    points, size = basis.shape[0], basis.shape[3]
    columns = basis.permute(1, 2, 0, 3).reshape(3 * joints, points * size)
    rows = rotation.transpose(1, 2).reshape(batch * 3, 3 * joints)
    return (rows @ columns).reshape(batch, 3, points, size).transpose(1, 2)


def _chain(
    rest: Tensor, local: dict[int, Tensor], joint_dirs: Tensor, parents: tuple[int, ...], eye: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """World rotations `[B, J, 3, 3]`, places `[B, J, 3]` and places by shape `[B, J, 3, S]` of the joints."""
    batch = rest.shape[0]
    identity = eye.expand(batch, 3, 3)
    rotation, place = [local.get(0, identity)], [rest[:, 0]]
    by_shape = [joint_dirs[0].expand(batch, -1, -1)]
    for child, parent in enumerate(parents[1:], start=1):
        bone = (rest[:, child] - rest[:, parent])[..., None]
        place.append(place[parent] + (rotation[parent] @ bone).squeeze(-1))
        by_shape.append(by_shape[parent] + rotation[parent] @ (joint_dirs[child] - joint_dirs[parent]))
        rotation.append(rotation[parent] @ local[child] if child in local else rotation[parent])
    return torch.stack(rotation, 1), torch.stack(place, 1), torch.stack(by_shape, 1)


def _descendants(parents: tuple[int, ...]) -> list[list[bool]]:
    """Row k marks joint k and everything below it."""
    count = len(parents)
    below = [[row == column for column in range(count)] for row in range(count)]
    for child in range(count - 1, 0, -1):
        for joint in range(count):
            below[parents[child]][joint] |= below[child][joint]
    return below
