"""Poses read off meshes: what a linear model's parameters would say, whatever the rigid motion."""

import numpy as np
import pytest
import torch

from nbavatar.math.rotations import axis_angle_to_matrix
from nbavatar.methods.interact_avatar.posture import learn_posture
from tests.scenes.toy import OCTAHEDRON

RANDOM = np.random.default_rng(0)
REST = RANDOM.normal(size=(60, 3)).astype(np.float32)
MODES = RANDOM.normal(size=(3, 60, 3)) * np.array([0.05, 0.02, 0.01])[:, None, None]


def moved(points: np.ndarray, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    turn = axis_angle_to_matrix(torch.from_numpy(random.normal(size=3))).numpy()
    return (points @ turn.T + random.normal(size=3)).astype(np.float32)


def test_it_is_unchanged_by_rigid_motions_and_is_the_parameters_up_to_a_linear_map() -> None:
    parameters = np.random.default_rng(1).normal(size=(40, 3))
    meshes = REST + np.einsum("nk,kvi->nvi", parameters, MODES)
    posed = np.stack([moved(mesh, seed) for seed, mesh in enumerate(meshes)])
    posture = learn_posture(REST, posed[:30], 5)
    codes = torch.stack([posture.describe(torch.from_numpy(mesh)) for mesh in posed]).double().numpy()
    for mesh, code in zip(meshes, codes, strict=True):
        still = posture.describe(torch.from_numpy(mesh.astype(np.float32)))
        # Rounding of vertices some metres from the origin, in a pose's range of decimetres.
        np.testing.assert_allclose(still.numpy(), code, atol=2e-5)
    assert np.abs(codes[:30]).max() == pytest.approx(1.0, abs=1e-5)
    basis = np.concatenate((codes, np.ones((40, 1))), 1)
    weights = np.linalg.lstsq(basis[:30], parameters[:30], rcond=None)[0]
    error = parameters[30:] - basis[30:] @ weights
    # Laying a mesh onto another is not linear, hence a few per cent and not rounding.
    assert np.abs(error).max() < 0.05 * np.abs(parameters).max()


def test_the_same_meshes_give_the_same_bits_and_frames_without_the_part_count_for_nothing() -> None:
    posed = np.stack([moved(REST + 0.1 * row * MODES[0], row) for row in range(6)]).astype(np.float32)
    holed = np.concatenate((np.full_like(posed[:1], np.nan), posed))
    one, two, three = (learn_posture(REST, verts, 4) for verts in (posed, posed, holed))
    for name, value in one.state_dict().items():
        assert torch.equal(value, two.state_dict()[name]) and torch.equal(value, three.state_dict()[name]), name
    assert torch.isfinite(one.basis).all() and one.components == 4


@pytest.mark.parametrize("frames", [0, 1, 3])
def test_a_part_that_never_moves_has_no_pose(frames) -> None:
    rest = OCTAHEDRON * 0.1
    posed = np.stack([rest] * frames) if frames else np.full((2, 6, 3), np.nan, np.float32)
    posture = learn_posture(rest, posed, 2)
    code = posture.describe(torch.from_numpy(moved(rest, 3)))
    assert torch.isfinite(code).all() and code.abs().max() < 1e-5


def test_a_pose_far_outside_the_training_is_held_within_twice_its_range() -> None:
    posed = np.stack([REST + t * MODES[0] for t in (-1.0, 0.0, 1.0)]).astype(np.float32)
    posture = learn_posture(REST, posed, 2)
    assert float(posture.describe(torch.from_numpy((REST + 9 * MODES[0]).astype(np.float32))).abs().max()) == 2.0


def test_points_are_moved_with_the_part_that_they_stand_beside() -> None:
    rest, beside = REST.astype(np.float32), np.float32([[0.0, 0.5, 3.0], [1.0, 0.0, 0.0]])
    posture = learn_posture(rest, rest[None], 1)
    both = moved(np.concatenate((rest, beside)), 5)
    laid, (found,) = posture.laid(torch.from_numpy(both[: len(rest)]), torch.from_numpy(both[len(rest) :]))
    torch.testing.assert_close(laid, torch.from_numpy(rest), atol=1e-5, rtol=0)
    torch.testing.assert_close(found, torch.from_numpy(beside), atol=1e-5, rtol=0)
