"""Head and hand as unknowns of a refit: state, keypoints with derivatives, meshes.

Both parts have the same form, so one solver serves both:

    rotation [N, 3, 3], transl [N, 3]   rigid pose per frame, the head about its centroid, the hand about its wrist
    local    [N, D]                     head: jaw (3, axis-angle) and expression; hand: pose (45, axis-angle)
    shape    [S]                        shared by all frames

A step is a right perturbation of the rotation (3), then a change of translation (3), then of `local` (D).
Everything is float64.
"""

import dataclasses
import functools
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from nbavatar.bodymodels.flame import Flame, Landmarks
from nbavatar.bodymodels.lbs import SkinnedMesh
from nbavatar.bodymodels.mano import TIP_PAIRS, Mano
from nbavatar.fitting.points import SkinnedPoints, concatenate, skew, skinned_points
from nbavatar.math.rotations import axis_angle_to_matrix, matrix_to_axis_angle

__all__ = ["HandPart", "HeadPart", "Keypoints", "PartModel", "State", "retract", "right_jacobian"]

HAND_TIP_RATIO = 0.7
_JAW = 2
_SAMPLES = 200


@dataclasses.dataclass(frozen=True)
class State:
    """Unknowns of one part; see the module."""

    rotation: Tensor
    transl: Tensor
    local: Tensor
    shape: Tensor

    def rows(self, rows: slice | Tensor) -> "State":
        """The same shape in some of the frames."""
        return State(self.rotation[rows], self.transl[rows], self.local[rows], self.shape)


class Keypoints(NamedTuple):
    """Keypoints `[n, L, 3]` [m], derivatives by the frame's step `[n, 3 L, 6 + D]` and by shape `[n, 3 L, S]`."""

    points: Tensor
    by_frame: Tensor
    by_shape: Tensor


class PartModel(Protocol):
    """What the solver asks of a part."""

    local_count: int
    shape_count: int
    faces: np.ndarray
    samples: Tensor

    def keypoints(self, state: State) -> Keypoints:
        """Keypoints of all frames of `state`, with derivatives."""
        ...

    def surface(self, state: State) -> Keypoints:
        """Sample vertices of the surface, with derivatives."""
        ...

    def vertices(self, state: State) -> Tensor:
        """World vertices `[n, V, 3]` [m]."""
        ...

    def rest(self, state: State) -> Tensor:
        """The shape in the canonical pose `[V, 3]` [m]."""
        ...

    def parameters(self, state: State) -> dict[str, Tensor]:
        """Parameters under the names of the tracks."""
        ...


class HeadPart:
    """FLAME with the fixed set of 68 landmarks, posed as the Decaf release does."""

    def __init__(self, flame: Flame, landmarks: Landmarks) -> None:
        self.flame = flame
        self.shape_count = flame.shape_count
        self.local_count = 3 + flame.expression_count
        count = flame.mesh.template.shape[0]
        everything = torch.arange(count)[None]
        uniform = torch.full((1, count), 1 / count, dtype=flame.mesh.template.dtype)
        centroid = skinned_points(flame.mesh, everything, uniform, (_JAW,))
        weights = landmarks.weights.to(uniform.dtype)
        self._points = concatenate(skinned_points(flame.mesh, landmarks.vertices, weights, (_JAW,)), centroid)
        self.faces, self.samples = flame.faces, _spread(count)
        self._centroid = centroid

    @functools.cached_property
    def _surface(self) -> SkinnedPoints:
        return concatenate(_vertices(self.flame.mesh, self.samples, (_JAW,)), self._centroid)

    @classmethod
    def state(cls, shape: Tensor, expression: Tensor, jaw: Tensor, global_orient: Tensor, transl: Tensor) -> State:
        """State from parameters: `[S]`, then `[N, E]`, `[N, 3]`, `[N, 3]`, `[N, 3]`."""
        return State(axis_angle_to_matrix(global_orient), transl, torch.cat([jaw, expression], 1), shape)

    def keypoints(self, state: State) -> Keypoints:
        """68 landmarks."""
        return self._pose(self._points, state)

    def surface(self, state: State) -> Keypoints:
        """Sample vertices."""
        return self._pose(self._surface, state)

    def _pose(self, which: SkinnedPoints, state: State) -> Keypoints:
        jaw, expression = state.local[:, :3], state.local[:, 3:]
        coefficients = torch.cat([state.shape.expand(len(jaw), -1), expression], 1)
        points, by_shape, by_turn = which.pose(coefficients, axis_angle_to_matrix(jaw)[:, None])
        by_jaw = by_turn @ right_jacobian(jaw)[:, None]
        by_local = torch.cat([by_jaw, by_shape[..., self.shape_count :]], -1)
        return _rigid(points, by_local, by_shape[..., : self.shape_count], state)

    def vertices(self, state: State) -> Tensor:
        """World vertices."""
        jaw, expression = state.local[:, :3], state.local[:, 3:]
        orient = matrix_to_axis_angle(state.rotation)
        return self.flame.forward_decaf(state.shape[None], expression, jaw, orient, state.transl)

    def rest(self, state: State) -> Tensor:
        """Neutral expression, closed jaw, the model's own frame."""
        zero = state.local.new_zeros(1, self.local_count)
        return self.flame.forward(state.shape[None], zero[:, 3:], zero[:, :3]).verts[0]

    def parameters(self, state: State) -> dict[str, Tensor]:
        """Parameters of every frame."""
        count = len(state.transl)
        return {
            "shape": state.shape.expand(count, -1),
            "expression": state.local[:, 3:],
            "jaw": state.local[:, :3],
            "global_orient": matrix_to_axis_angle(state.rotation),
            "transl": state.transl,
        }


class HandPart:
    """MANO with 21 keypoints, the fingertips shortened as detectors see them."""

    def __init__(self, mano: Mano) -> None:
        self.mano = mano
        self.shape_count = mano.mesh.shape_dirs.shape[-1]
        self.local_count = 45
        one = torch.ones(5, 1, dtype=mano.mesh.template.dtype)
        joints = tuple(range(16))
        self._points: SkinnedPoints = skinned_points(mano.mesh, mano.tips[:, None], one, joints, joints)
        # Rows: keypoints; columns: the points as they come, tips first.
        mix = torch.zeros(21, 21, dtype=one.dtype)
        for row in range(16):
            mix[row, 5 + row] = 1.0
        for last, tip in TIP_PAIRS:
            mix[tip, tip - 16] = HAND_TIP_RATIO
            mix[tip, 5 + last] = 1 - HAND_TIP_RATIO
        self._mix = mix
        self.faces, self.samples = mano.faces, _spread(mano.mesh.template.shape[0])

    @functools.cached_property
    def _surface(self) -> SkinnedPoints:
        return _vertices(self.mano.mesh, self.samples, tuple(range(16)))

    @classmethod
    def state(cls, betas: Tensor, hand_pose: Tensor, global_orient: Tensor, transl: Tensor) -> State:
        """State from parameters: `[S]`, then `[N, 45]`, `[N, 3]`, `[N, 3]`."""
        return State(axis_angle_to_matrix(global_orient), transl, hand_pose, betas)

    def keypoints(self, state: State) -> Keypoints:
        """21 keypoints."""
        points, by_frame, by_shape = self._pose(self._points, state)
        count = len(points)
        mixed = [torch.einsum("lp,npx->nlx", self._mix, v.flatten(2)) for v in (points, by_frame, by_shape)]
        return Keypoints(mixed[0], mixed[1].reshape(count, 63, -1), mixed[2].reshape(count, 63, -1))

    def surface(self, state: State) -> Keypoints:
        """Sample vertices."""
        points, by_frame, by_shape = self._pose(self._surface, state)
        return Keypoints(points, by_frame.flatten(1, 2), by_shape.flatten(1, 2))

    def _pose(self, which: SkinnedPoints, state: State) -> tuple[Tensor, Tensor, Tensor]:
        count = len(state.local)
        angles = state.local.reshape(count, 15, 3)
        turns = torch.cat([state.rotation[:, None], axis_angle_to_matrix(angles)], 1)
        points, by_shape, by_turn = which.pose(state.shape[None], turns)
        by_turn = by_turn.reshape(*points.shape, 16, 3)
        by_local = torch.einsum("npajc,njcd->npajd", by_turn[..., 1:, :], right_jacobian(angles)).flatten(3)
        eye = torch.eye(3, dtype=points.dtype, device=points.device).expand(*points.shape, 3)
        by_frame = torch.cat([by_turn[..., 0, :], eye, by_local], -1)
        return points + state.transl[:, None], by_frame, by_shape

    def vertices(self, state: State) -> Tensor:
        """World vertices."""
        orient = matrix_to_axis_angle(state.rotation)
        return self.mano.forward(state.shape[None], state.local, orient, state.transl).verts

    def rest(self, state: State) -> Tensor:
        """Flat hand, the model's own frame."""
        zero = state.local.new_zeros(1, 45)
        return self.mano.forward(state.shape[None], zero, zero[:, :3]).verts[0]

    def parameters(self, state: State) -> dict[str, Tensor]:
        """Parameters of every frame."""
        return {
            "betas": state.shape.expand(len(state.transl), -1),
            "hand_pose": state.local,
            "global_orient": matrix_to_axis_angle(state.rotation),
            "transl": state.transl,
        }


def retract(state: State, frame_step: Tensor, shape_step: Tensor) -> State:
    """Applies a step: `[N, 6 + D]` for the frames, `[S]` for the shape."""
    return State(
        state.rotation @ axis_angle_to_matrix(frame_step[:, :3]),
        state.transl + frame_step[:, 3:6],
        state.local + frame_step[:, 6:],
        state.shape + shape_step,
    )


def right_jacobian(angles: Tensor) -> Tensor:
    """Right Jacobian of the rotation group: `exp(a + da) = exp(a) exp(J_r(a) da)` to first order.

    Chirikjian, "Stochastic Models, Information Theory, and Lie Groups" 2 (2012), section 10.7.

    Args:
        angles: axis-angle `[..., 3]` [rad].

    Returns:
        `[..., 3, 3]`.
    """
    squared = (angles * angles).sum(-1)[..., None, None]
    small = squared < 1e-8
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    first = torch.where(small, 0.5 - squared / 24, (1 - torch.cos(angle)) / angle**2)
    second = torch.where(small, 1 / 6 - squared / 120, (angle - torch.sin(angle)) / angle**3)
    cross = skew(angles)
    eye = torch.eye(3, dtype=angles.dtype, device=angles.device)
    return eye - first * cross + second * cross @ cross


def _spread(count: int) -> Tensor:
    """Ids of at most `_SAMPLES` vertices, spread over the numbering."""
    return torch.linspace(0, count - 1, min(count, _SAMPLES)).round().long()


def _vertices(mesh: SkinnedMesh, ids: Tensor, active: tuple[int, ...]) -> SkinnedPoints:
    return skinned_points(mesh, ids[:, None], torch.ones(len(ids), 1, dtype=mesh.template.dtype), active)


def _rigid(points: Tensor, by_local: Tensor, by_shape: Tensor, state: State) -> Keypoints:
    """Turns all points but the last about the last one, the centroid, and shifts them."""
    count, centre = len(points), points[:, -1:]
    arm = points[:, :-1] - centre
    turn = state.rotation[:, None]
    placed = (turn @ arm[..., None]).squeeze(-1) + centre + state.transl[:, None]
    by_rotation = -turn @ skew(arm)
    eye = torch.eye(3, dtype=points.dtype, device=points.device).expand_as(by_rotation)

    def carried(derivative: Tensor) -> Tensor:
        middle = derivative[:, -1:]
        return turn @ (derivative[:, :-1] - middle) + middle

    by_frame = torch.cat([by_rotation, eye, carried(by_local)], -1)
    size = 3 * arm.shape[1]
    return Keypoints(placed, by_frame.reshape(count, size, -1), carried(by_shape).reshape(count, size, -1))
