"""Face frames: agreement with the textbook construction, equivariance, and behaviour on every kind of bad triangle."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nbavatar.mesh.frames import face_frames


def _sphere(n_lat: int = 12, n_lon: int = 17) -> tuple[torch.Tensor, torch.Tensor]:
    """A latitude/longitude sphere of radius 0.1 m with proper poles."""
    theta = np.linspace(0, np.pi, n_lat + 2)[1:-1]
    phi = np.arange(n_lon) * 2 * np.pi / n_lon
    grid = np.stack(
        (
            np.sin(theta)[:, None] * np.cos(phi),
            np.sin(theta)[:, None] * np.sin(phi),
            np.repeat(np.cos(theta)[:, None], n_lon, 1),
        ),
        -1,
    ).reshape(-1, 3)
    verts = np.concatenate((grid, [[0, 0, 1.0], [0, 0, -1.0]])) * 0.1
    faces = []
    for i in range(n_lat - 1):
        for j in range(n_lon):
            a, b = i * n_lon + j, i * n_lon + (j + 1) % n_lon
            faces += [[a, a + n_lon, b], [b, a + n_lon, b + n_lon]]
    north, south = n_lat * n_lon, n_lat * n_lon + 1
    for j in range(n_lon):
        k = (j + 1) % n_lon
        faces += [[north, j, k], [south, (n_lat - 1) * n_lon + k, (n_lat - 1) * n_lon + j]]
    return torch.from_numpy(verts), torch.tensor(faces)


def _rotation(seed: int) -> torch.Tensor:
    q, r = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))
    q = q * torch.sign(torch.diagonal(r))
    return q * torch.linalg.det(q)


def _assert_rotations(R: torch.Tensor, atol: float) -> None:
    eye = torch.eye(3, dtype=R.dtype).expand_as(R)
    torch.testing.assert_close(R.mT @ R, eye, atol=atol, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(R.shape[:-2], dtype=R.dtype), atol=atol, rtol=0)


def test_regular_faces_equal_the_edge_and_normal_construction():
    verts, faces = _sphere()
    T, R, k = face_frames(verts, faces)
    for f in range(0, len(faces), 7):
        a, b, c = verts[faces[f]].numpy()
        x = (b - a) / np.linalg.norm(b - a)
        z = np.cross(b - a, c - a)
        z /= np.linalg.norm(z)
        y = np.cross(z, x)
        np.testing.assert_allclose(R[f].numpy(), np.stack((x, y, z), 1), atol=1e-12)
        np.testing.assert_allclose(T[f].numpy(), (a + b + c) / 3, atol=1e-15)
        # The height over the first edge is twice the area over the edge's length.
        height = np.linalg.norm(np.cross(b - a, c - a)) / np.linalg.norm(b - a)
        np.testing.assert_allclose(float(k[f]), (np.linalg.norm(b - a) + height) / 2, rtol=1e-12)


def test_normal_axis_points_out_of_a_sphere():
    verts, faces = _sphere()
    T, R, _ = face_frames(verts, faces)
    assert bool(((R[..., 2] * T).sum(-1) > 0.09 * 0.9).all())


@pytest.mark.parametrize("kind", ["regular", "with_degenerate"])
def test_equivariant_under_rigid_motion_and_scale(kind):
    verts, faces = _sphere()
    if kind == "with_degenerate":
        verts[40] = verts[41]  # zero edges and zero areas around one vertex
    rotation, shift, scale = _rotation(3), torch.tensor([0.3, -2.0, 1.0], dtype=torch.float64), 7.0
    T, R, k = face_frames(verts, faces)
    T2, R2, k2 = face_frames(scale * verts @ rotation.T + shift, faces)
    torch.testing.assert_close(T2, scale * T @ rotation.T + shift, atol=1e-12, rtol=0)
    torch.testing.assert_close(R2, rotation @ R, atol=1e-7, rtol=0)
    torch.testing.assert_close(k2, scale * k, atol=1e-12, rtol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "corners",
    [
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],  # a point
        [[0, 0, 0], [0, 0, 0], [1, 0, 0]],  # zero first edge
        [[0, 0, 0], [1, 0, 0], [1, 0, 0]],  # zero second edge
        [[0, 0, 0], [1, 0, 0], [0.5, 0, 0]],  # needle
        [[0, 0, 0], [1, 0, 0], [2, 1e-9, 0]],  # almost a needle
        [[0, 0, 0], [1e-20, 0, 0], [0, 1e-20, 0]],  # underflowing area
        [[1e4, 0, 0], [1e4, 0, 0], [1e4, 0, 0]],  # far from the origin
    ],
)
def test_degenerate_faces_alone_still_get_a_rotation_and_finite_gradients(corners, dtype):
    verts = torch.tensor(corners, dtype=dtype, requires_grad=True)
    T, R, k = face_frames(verts, torch.tensor([[0, 1, 2]]))
    _assert_rotations(R.detach(), 1e-5 if dtype == torch.float32 else 1e-12)
    (T.sum() + (R * torch.arange(9.0, dtype=dtype).view(3, 3)).sum() + k.sum()).backward()
    assert verts.grad is not None and bool(verts.grad.isfinite().all())


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), log_squash=st.floats(-12, 0), collapse=st.sampled_from([0, 1, 2]))
def test_squashed_sphere_has_rotations_and_finite_gradients(seed, log_squash, collapse):
    verts, faces = _sphere(5, 6)
    verts = verts + 0.01 * torch.randn(verts.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    verts = verts * torch.tensor([1.0, 1.0, 10.0**log_squash], dtype=torch.float64)
    for i in range(collapse):
        verts[faces[i, 0]] = verts[faces[i, 1]]
    verts = verts.float().requires_grad_()
    T, R, k = face_frames(verts, faces)
    _assert_rotations(R.detach(), 2e-5)
    assert bool((k > 0).all())
    (R.square().sum() + R[..., 0].sum() + k.log().sum() + T.sum()).backward()
    assert verts.grad is not None and bool(verts.grad.isfinite().all())


def test_a_flat_face_takes_its_neighbours_normal():
    # A strip in the plane z = 0 with one needle inserted on an edge.
    verts = torch.tensor([[0, 0, 0], [1, 0, 0], [0.5, 0, 0], [0.5, 1, 0], [0.5, -1, 0]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 3], [0, 2, 1], [1, 0, 4]])
    # The needle 0-2-1 sits between the two; its normal must be the neighbours'.
    _, R, _ = face_frames(verts, faces)
    torch.testing.assert_close(R[1, :, 2], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def test_continuous_while_a_face_collapses():
    """Consecutive frames of a vertex moving on to its neighbour differ little, also across the thresholds."""
    verts, faces = _sphere(8, 11)
    # Collapse along the first edge of a face, through the blend zone in steps of 2 % of the remaining length.
    face = faces[60]
    start, target = verts[face[2]].clone(), (verts[face[0]] * 0.45 + verts[face[1]] * 0.55).clone()
    previous = None
    for step in np.concatenate((np.geomspace(1, 1e-6, 700), [0.0])):
        moved = verts.clone()
        moved[face[2]] = target + (start - target) * float(step)
        R = face_frames(moved, faces)[1][60]
        if previous is not None:
            assert float((R - previous).abs().max()) < 0.03
        previous = R


def test_gradcheck_including_the_blend_zone():
    verts = torch.tensor(
        [[0, 0, 0], [1, 0.1, 0], [0.4, 0.9, 0.2], [0.52, 0.0525, 0.0], [0.5, -0.8, 0.1]], dtype=torch.float64
    )
    verts[3] = 0.5 * (verts[0] + verts[1]) + torch.tensor([0.0, -2.4e-4, 1e-5], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 4, 3]])
    verts.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda v: torch.cat([t.flatten() for t in face_frames(v, faces)]), (verts,), eps=1e-9, atol=1e-3, rtol=1e-3
    )


def test_batched_equals_one_by_one():
    verts, faces = _sphere()
    batch = torch.stack([verts, verts * 2, verts @ _rotation(1)]).reshape(3, 1, -1, 3)
    T, R, k = face_frames(batch, faces)
    assert T.shape == (3, 1, len(faces), 3) and R.shape == (3, 1, len(faces), 3, 3) and k.shape == (3, 1, len(faces))
    for i in range(3):
        for whole, single in zip((T, R, k), face_frames(batch[i, 0], faces), strict=True):
            torch.testing.assert_close(whole[i, 0], single, rtol=0, atol=0)
