"""Smooth offsets: what they span, that they follow the gradient of mu, and that the paper's training has none."""

import numpy as np
import pytest
import torch

from nbavatar.errors import DataError
from nbavatar.mesh.frames import face_frames
from nbavatar.mesh.topology import vertex_components
from nbavatar.methods.billboards.initial import initial_avatar
from nbavatar.methods.billboards.offsets import SmoothOffsets, _components, offset_basis
from nbavatar.methods.billboards.options import RatesConfig
from nbavatar.optimization.adam import Adam
from tests.scenes.toy import OCTAHEDRON, OCTAHEDRON_FACES, TETRAHEDRON, TETRAHEDRON_FACES, sequence
from tests.scenes.training import train_config
from tests.unit.training.test_loop import CONFIG, run, same

REST = np.concatenate([OCTAHEDRON, TETRAHEDRON]).astype(np.float32)
FACES = np.concatenate([OCTAHEDRON_FACES, TETRAHEDRON_FACES + len(OCTAHEDRON)])


@pytest.fixture
def made():
    """Avatar of the toy scene, its meshes, and one coordinate per vertex and axis."""
    meshes = sequence()
    coords = {name: 6 * part.rest for name, part in meshes.parts.items()}
    return initial_avatar(meshes, coords, meshes.frames, CONFIG), meshes, coords


def test_components_equal_scipys() -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        faces = random.integers(0, 60, (int(random.integers(5, 40)), 3))
        ours, theirs = _components(faces, 60), vertex_components(faces, 60)
        used = np.unique(faces)
        assert np.array_equal(ours[used][:, None] == ours[used], theirs[used][:, None] == theirs[used])


def test_basis_is_constant_first_and_zero_off_the_largest_component() -> None:
    basis = offset_basis(REST, FACES, REST)
    assert basis.shape == (12, 4)
    np.testing.assert_array_equal(basis[8:], 0.0)
    np.testing.assert_allclose(basis[:8, 0], 1.0)
    # An octahedron's x over its vertices has mean square 2/6; a face's centroid lies at a third.
    np.testing.assert_allclose(np.abs(basis[:8, 1:]), np.sqrt(3) / 3, rtol=1e-6)


def test_a_step_moves_all_billboards_along_their_normals_by_the_rate(made) -> None:
    avatar, meshes, coords = made
    fields = SmoothOffsets(avatar, meshes, coords)
    mu = avatar.billboards.mu
    optimizer = Adam([{"name": "offset", "params": [fields.coefficients], "lr": 1e-3}])
    verts = {name: torch.from_numpy(part.rest) for name, part in meshes.parts.items()}
    before, _ = avatar.pose(verts)
    # Outwards for the head only, as a loss on the offsets asks for.
    (-(mu[:8, 2] * avatar.anchor(verts).frames.k[:8]).sum()).backward()
    optimizer.step()
    constant = float(fields.coefficients[0].detach())
    assert constant == pytest.approx(1e-3, rel=1e-4)  # Adam's first step is the rate [m]
    moved = torch.from_numpy(offset_basis(meshes.parts["head"].rest, meshes.parts["head"].faces, coords["head"]))
    distance = (moved @ fields.coefficients[:4]).detach()
    fields.apply()
    after, _ = avatar.pose(verts)
    assert not fields.coefficients.any() and not mu[8:].any() and not mu[:, :2].any()
    normals = face_frames(verts["head"], torch.from_numpy(meshes.parts["head"].faces)).R[..., 2]
    torch.testing.assert_close((after.means - before.means)[:8], distance[:, None] * normals, atol=1e-7, rtol=0)


def test_training_with_offsets_resumes_bit_for_bit_and_differs_from_the_papers(scene, tmp_path) -> None:
    assert RatesConfig().offset == 0.0
    config = train_config(CONFIG, rates={"offset": 1e-3})
    whole, _ = run(scene, config, tmp_path / "whole")
    steps = iter(range(100))
    run(scene, config, tmp_path / "cut", should_stop=lambda: next(steps) == 5)
    again, summary = run(scene, config, tmp_path / "cut")
    assert summary["finished"] and same(whole, again)
    assert not same(whole, run(scene, CONFIG, tmp_path / "paper")[0])


def test_a_part_without_coordinates_is_named(made) -> None:
    avatar, meshes, coords = made
    with pytest.raises(DataError, match=r"head\.coords"):
        SmoothOffsets(avatar, meshes, {"right_hand": coords["right_hand"]})
