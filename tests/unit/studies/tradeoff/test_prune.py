"""Pruning for good: pictures stay the same up to rounding, the file opens, meshes still fit."""

import math

import numpy as np
import pytest
import torch

from nbavatar.data.sequences import MeshSequence, Part
from nbavatar.data.views import View
from nbavatar.errors import DataError
from nbavatar.evaluation.render import check_parts
from nbavatar.math.rotations import axis_angle_to_matrix
from nbavatar.methods.billboards.compression.prune import prune, seen_billboards, turned_cameras
from nbavatar.methods.billboards.initial import initial_avatar
from nbavatar.methods.storage import load_avatar, save_avatar
from tests.scenes.toy import OCTAHEDRON, OCTAHEDRON_FACES, camera
from tests.scenes.training import train_config

SIZE = 48
CENTRES = [torch.zeros(3), torch.tensor([0.1, -0.2, 0.3])]


@pytest.fixture
def nested():
    """A head of three shells (one lets 3% through), a small one inside, a small one behind; views of three cameras."""
    shells = [size * OCTAHEDRON for size in (0.15, 0.148, 0.146, 0.03, 0.01)]
    shells[4] = shells[4] + np.array([0.0, 0.0, 0.35])
    # Turned a little, so that no two billboards are equally far along a ray: ties may go either way.
    turn = axis_angle_to_matrix(torch.tensor([0.3, -0.2, 0.1])).numpy()
    rest = (np.concatenate(shells) @ turn.T).astype(np.float32)
    faces = np.concatenate([OCTAHEDRON_FACES + shell * len(OCTAHEDRON) for shell in range(5)])
    sequence = MeshSequence(["f0"], {"head": Part(faces, rest, rest[None])}, {})
    config = train_config(
        texels=4, init="random", extent_margin=1.2, alpha_floor=0.97, alpha_peak=0.975,
        unet={"width": 4, "depth": 3, "max_width": 8, "convs": 1},
    )  # fmt: skip
    avatar = initial_avatar(sequence, {}, ["f0"], config).eval()
    K = torch.tensor([[1.9 * SIZE, 0, 0.5 * SIZE], [0, 1.9 * SIZE, 0.5 * SIZE], [0, 0, 1]])
    views = [View(i, f"c{i}", "f0", 0, SIZE, SIZE, K, torch.tensor(camera(i), dtype=torch.float32)) for i in range(3)]
    return avatar, sequence, {"head": torch.from_numpy(rest[None])}, views


def test_hidden_billboards_go_and_no_pixel_changes(nested, tmp_path) -> None:
    avatar, sequence, meshes, views = nested
    small = prune(avatar, meshes, views, margin=0.0, most_views=10)
    outside = seen_billboards(avatar, meshes, views, margin=0.0, most_views=10)
    assert not outside[24:32].any() and small.primitives == int(outside.sum())
    verts = {"head": meshes["head"][0]}
    for view in views:
        with torch.no_grad():
            a, b = (x.window(*x.pose(verts), view.viewmat, view.K, SIZE, SIZE, roi=False) for x in (avatar, small))
        # Posing fewer faces rounds differently in the last digit, which shows where two billboards meet on a ray.
        torch.testing.assert_close(a.nb_alpha, b.nb_alpha, atol=1e-5, rtol=0)
        assert ((a.features - b.features).abs().amax(0) > 1e-5).float().mean() < 0.002
        torch.testing.assert_close(a.colour, b.colour, atol=1e-3, rtol=0)
    save_avatar(tmp_path / "model.pt", small)
    again = load_avatar(tmp_path / "model.pt")
    assert again.primitives == small.primitives
    check_parts(again, sequence)


def test_a_margin_keeps_more_and_a_sample_of_views_no_more(nested) -> None:
    avatar, _, meshes, views = nested
    one, turned = (seen_billboards(avatar, meshes, views[1:2], margin=m, most_views=1) for m in (0.0, 40.0))
    assert (one <= turned).all() and not one[32:].any() and turned[32:].all()
    sample = seen_billboards(avatar, meshes, views, margin=0.0, most_views=1)
    assert torch.equal(sample, seen_billboards(avatar, meshes, views[:1], margin=0.0, most_views=9))


def test_check_parts_refuses_faces_of_another_mesh(nested) -> None:
    avatar, sequence, meshes, views = nested
    small = prune(avatar, meshes, views, margin=0.0, most_views=10)
    part = sequence.parts["head"]
    other = MeshSequence(["f0"], {"head": Part(part.faces[:, [1, 2, 0]].copy(), part.rest, part.verts)}, {})
    with pytest.raises(DataError, match="other faces"):
        check_parts(small, other)


def test_nothing_seen_is_refused(nested) -> None:
    avatar, _, meshes, views = nested
    behind = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(DataError, match="a view that shows the avatar"):
        prune(avatar, meshes, [views[1]._replace(viewmat=behind @ views[1].viewmat)], margin=0.0, most_views=1)


@pytest.mark.parametrize("centre", CENTRES)
def test_turned_cameras_keep_the_centre_and_turn_by_the_margin(centre) -> None:
    viewmat = torch.tensor(camera(2), dtype=torch.float64)
    cameras = turned_cameras(viewmat, centre.double(), 20.0)
    assert len(cameras) == 5 and cameras[0] is viewmat
    place = viewmat[:3, :3] @ centre.double() + viewmat[:3, 3]
    for turned in cameras[1:]:
        torch.testing.assert_close(turned[:3, :3] @ centre.double() + turned[:3, 3], place, atol=1e-12, rtol=0)
        between = turned[:3, :3] @ viewmat[:3, :3].T
        angle = math.degrees(math.acos((float(between.trace()) - 1) / 2))
        assert angle == pytest.approx(20.0, abs=1e-9) and float(torch.linalg.det(between)) == pytest.approx(1.0)
