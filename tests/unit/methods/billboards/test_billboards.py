"""Billboards: initial state, anchoring, equivariance."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.math.rotations import axis_angle_to_matrix, quaternion_to_matrix
from nbavatar.mesh.frames import face_frames
from nbavatar.methods.billboards.billboards import Billboards, gaussian_alpha_logits, initial_half_extents

VERTS = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 1, 0], [0.3, 0.2, 1.5]], dtype=torch.float64)
FACES = torch.tensor([[0, 1, 2], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def _billboards(seed: int = 0) -> Billboards:
    frames = face_frames(VERTS, FACES)
    size = initial_half_extents(VERTS, FACES, frames, margin=1.2)
    board = Billboards(size, torch.zeros(4, 2, 2, 1, dtype=torch.float64), torch.zeros(4, 2, 2, dtype=torch.float64))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        board.mu += 0.3 * torch.randn(4, 3, generator=generator, dtype=torch.float64)
        board.quat += 0.5 * torch.randn(4, 4, generator=generator, dtype=torch.float64)
    return board


@given(
    st.tuples(*[st.floats(-3.1, 3.1)] * 3), st.tuples(*[st.floats(-5, 5)] * 3), st.floats(0.1, 10.0), st.integers(0, 99)
)
def test_pose_is_equivariant_under_similarity(turn: tuple, shift: tuple, scale: float, seed: int) -> None:
    board = _billboards(seed)
    rotation = axis_angle_to_matrix(torch.tensor(turn, dtype=torch.float64))
    offset = torch.tensor(shift, dtype=torch.float64)
    before = board.pose(face_frames(VERTS, FACES))
    after = board.pose(face_frames(scale * VERTS @ rotation.T + offset, FACES))
    torch.testing.assert_close(after.means, scale * before.means @ rotation.T + offset, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(after.half_extents, scale * before.half_extents)
    turned = rotation @ quaternion_to_matrix(before.quats)
    torch.testing.assert_close(quaternion_to_matrix(after.quats), turned, atol=1e-9, rtol=0)


def test_pose_starts_on_the_triangles() -> None:
    frames = face_frames(VERTS, FACES)
    size = initial_half_extents(VERTS, FACES, frames, margin=1.0)
    posed = Billboards(size, torch.zeros(4, 1, 1, 1).double(), torch.zeros(4, 1, 1).double()).pose(frames)
    torch.testing.assert_close(posed.means, VERTS[FACES].mean(1))
    axes = quaternion_to_matrix(posed.quats)
    local = torch.einsum("fij,fci->fcj", axes, VERTS[FACES] - posed.means[:, None])
    assert local[..., 2].abs().max() < 1e-12  # the plane is the triangle's
    reach = local[..., :2].abs() / posed.half_extents[:, None]
    assert reach.max() <= 1 + 1e-9  # covered
    torch.testing.assert_close(reach.amax(1).amax(1), torch.ones(4).double())  # and no larger than needed


def test_initial_half_extents_of_a_sliver_stay_visible() -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-7, 0]])
    faces = torch.tensor([[0, 1, 2]])
    size = initial_half_extents(verts, faces, face_frames(verts, faces), margin=1.0)
    assert torch.isfinite(size).all() and size.min() >= 0.0999 * size.max()


def test_gaussian_alpha_logits_are_finite_symmetric_and_exact() -> None:
    alpha = torch.sigmoid(gaussian_alpha_logits(16, sigma=0.35, peak=0.9, floor=0.004).double())
    assert torch.isfinite(alpha).all()
    assert alpha.min() == pytest.approx(0.004, rel=1e-4)
    torch.testing.assert_close(alpha, alpha.T)
    torch.testing.assert_close(alpha, alpha.flip(0))
    u = 1 / 15
    assert alpha[8, 8].item() == pytest.approx(0.9 * math.exp(-0.5 * 2 * u * u / 0.35**2), rel=1e-5)


@pytest.mark.parametrize("texels", [1, 2, 5])
def test_gaussian_alpha_logits_of_small_textures(texels: int) -> None:
    logits = gaussian_alpha_logits(texels, sigma=0.4, peak=0.8, floor=0.01)
    assert logits.shape == (texels, texels) and torch.isfinite(logits).all()


def test_pose_survives_runaway_scales_and_zero_quaternions() -> None:
    board = _billboards()
    with torch.no_grad():
        board.log_scale.fill_(1e6)
        board.quat.zero_()
    posed = board.pose(face_frames(VERTS, FACES))
    assert all(torch.isfinite(value).all() for value in posed.planes)
    torch.testing.assert_close(posed.quats.norm(dim=1), torch.ones(4, dtype=torch.float64))


def test_pose_gradients_agree_with_finite_differences() -> None:
    board = _billboards()
    frames = face_frames(VERTS, FACES)

    def posed(mu, quat, log_scale):
        values = torch.func.functional_call(board, {"mu": mu, "quat": quat, "log_scale": log_scale}, (frames,))
        return values.planes

    board.forward = board.pose  # functional_call goes through forward
    assert torch.autograd.gradcheck(posed, (board.mu, board.quat, board.log_scale))
