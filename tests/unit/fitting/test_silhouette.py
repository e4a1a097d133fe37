"""Silhouette term: distance maps against analytic ones, derivatives, and what masks add to keypoints."""

import dataclasses

import numpy as np
import torch

from nbavatar.camera.distortion import distort_pixels
from nbavatar.config.geometry import FitConfig
from nbavatar.fitting.parts import HeadPart, retract
from nbavatar.fitting.silhouette import (
    Silhouettes,
    choose_rim,
    distance_map,
    ideal_mask,
    pull_to_silhouettes,
    signed_distance_map,
)
from nbavatar.fitting.stage import Masks, fit_sequence
from nbavatar.mesh.zbuffer import rasterize_mesh

from .scenes import DISTORTION, bodies, make_take


def _disc(size, centre, radius):
    y, x = np.mgrid[:size, :size] + 0.5
    return np.hypot(x - centre, y - centre) < radius


def _masks(distance, **options):
    settings = {"border": True, "band": 10.0, "deviation": 2.0, "weight": 1.0} | options
    return Silhouettes(torch.tensor([0]), torch.tensor(distance)[None, None], torch.ones(1).double(), **settings)


def test_distance_of_a_disc():
    found = signed_distance_map(_disc(100, 50, 20), 1.0)
    y, x = np.mgrid[:100, :100] + 0.5
    # A disc of pixels is a staircase: within about a pixel of the circle.
    np.testing.assert_allclose(found, np.hypot(x - 50, y - 50) - 20, atol=1.0)
    np.testing.assert_allclose(signed_distance_map(_disc(100, 50, 20), 4.0), 4 * found)


def test_empty_and_full_masks_pull_nothing():
    for mask in (np.zeros((8, 9), bool), np.ones((8, 9), bool)):
        assert not signed_distance_map(mask, 1.0).any()


def test_ideal_mask_undoes_distortion():
    K = np.array([[300.0, 0, 200], [0, 300, 150], [0, 0, 1]])
    strong = DISTORTION * 2
    y, x = np.mgrid[:300, :400] + 0.5
    ideal = np.hypot(x - 120, y - 110) < 60
    # Where a recorded pixel looks: the distorted image shows at distort(p) what the ideal one shows at p.
    recorded = np.zeros((300, 400), bool)
    fine = np.stack(np.meshgrid(np.arange(0, 400, 0.25) + 0.125, np.arange(0, 300, 0.25) + 0.125), -1)
    to = np.floor(distort_pixels(fine, K, strong)).astype(int)
    inside = np.hypot(fine[..., 0] - 120, fine[..., 1] - 110) < 60
    ok = (to >= 0).all(-1) & (to[..., 0] < 400) & (to[..., 1] < 300)
    recorded[to[ok & inside][:, 1], to[ok & inside][:, 0]] = True
    back, scale = ideal_mask(recorded, K, strong, 300)
    assert scale == 1.0 and (back != ideal).mean() < 0.004 < (recorded != ideal).mean()
    half, scale = ideal_mask(ideal, K, None, 150)
    assert half.shape == (150, 200) and scale == 0.5 and abs(half.mean() - ideal.mean()) < 2e-3


def test_pull_is_the_gradient_of_the_map():
    masks = _masks(signed_distance_map(_disc(64, 32, 15), 1.0))
    pixels = 32 + 10 * torch.randn(1, 1, 50, 2, generator=torch.Generator().manual_seed(0)).double()
    camera = torch.ones(1, 1, 50, 3).double()
    found = pull_to_silhouettes(masks, pixels, camera)
    step = 1e-6
    for axis in range(2):
        move = step * torch.eye(2).double()[axis]
        ahead, behind = (pull_to_silhouettes(masks, pixels + s * move, camera).residual for s in (1, -1))
        torch.testing.assert_close((ahead - behind) / (2 * step), found.gradient[..., axis], atol=1e-6, rtol=0)
    # Without a choice of rim only points outside are pulled.
    assert ((found.weight > 0) == (found.residual > 0)).all()


def test_rim_points_near_the_border_are_chosen():
    masks = _masks(signed_distance_map(_disc(64, 32, 15), 1.0), band=5.0)
    pixels = torch.tensor([[[[44.0, 32], [32, 32], [44, 32], [60, 32]]]]).double()
    camera = torch.tensor([0, 0, 1.0]).double().expand(1, 1, 4, 3)
    normals = torch.tensor([[[[1.0, 0, 0], [1, 0, 0], [0, 0, -1], [1, 0, 0]]]]).double()
    assert choose_rim(masks, pixels, camera, normals).drawn[0, 0].tolist() == [True, False, False, False]
    assert choose_rim(_masks(masks.distance[0, 0].numpy(), border=False), pixels, camera, normals).drawn is None


def test_rim_points_at_the_border_of_a_cover_are_kept_from_outside_only():
    """A neck, columns 20 to 40, goes on behind a collar that is wider and ends at row 60."""
    part, cover = np.zeros((80, 64), bool), np.zeros((80, 64), bool)
    part[:40, 20:40], cover[40:60, 12:48] = True, True
    distance = signed_distance_map(part | cover, 1.0)
    masks = _masks(distance)
    away = torch.from_numpy(distance_map(cover, 1.0))[None, None]
    pixels = torch.tensor(
        [[21.0, 10.0], [39.0, 20.0], [17.0, 20.0], [13.0, 50.0], [9.0, 50.0], [21.0, 50.0], [30.0, 58.0]]
    )
    pixels = pixels.double()[None, None]
    camera = torch.tensor([0.0, 0.0, 1.0]).double().expand(1, 1, 7, 3)
    normals = torch.tensor([1.0, 0.0, 0.0]).double().expand(1, 1, 7, 3)
    assert choose_rim(masks, pixels, camera, normals).drawn.all()
    covered = choose_rim(dataclasses.replace(masks, cover=away), pixels, camera, normals)
    assert covered.drawn[0, 0].tolist() == [True, True, True, False, False, False, False]
    weights = pull_to_silhouettes(covered, pixels, camera).weight[0, 0]
    assert (weights > 0).tolist() == [True, True, True, False, True, False, False], "outside is outside"


def test_surface_derivatives_equal_autograd():
    flame = bodies("tiny").flame
    part = HeadPart(flame, flame.landmarks)
    part.samples = part.samples[::40]
    generator = torch.Generator().manual_seed(0)
    r = lambda *size: 0.3 * torch.randn(*size, generator=generator, dtype=torch.float64)  # noqa: E731
    state = part.state(r(100), r(2, 50), r(2, 3), r(2, 3), r(2, 3))
    found = part.surface(state)
    torch.testing.assert_close(found.points, part.vertices(state)[:, part.samples], rtol=1e-10, atol=1e-12)
    zero, none = torch.zeros(2, 59).double(), torch.zeros(100).double()
    numeric = torch.autograd.functional.jacobian(
        lambda x: part.surface(retract(state, x, none)).points.flatten(1).sum(0), zero
    )
    torch.testing.assert_close(found.by_frame, numeric.permute(1, 0, 2), rtol=1e-9, atol=1e-11)


def _film_masks(take, frames, *, grow=0):
    from scipy.ndimage import binary_dilation

    human, images = bodies("tiny").human, {}
    for name in [n.split(".")[1] for n in take.extras if n.endswith(".K")]:
        K = take.extras[f"camera.{name}.K"].copy()
        K[:2] /= 4
        rows = []
        for n in frames:
            mask = np.zeros((270, 480), bool)
            for part, faces in (("head", human.head_faces), ("right_hand", human.hand_faces)):
                pose = take.extras[f"camera.{name}.cam_from_world"]
                mask |= rasterize_mesh(take.truth[part][n], faces, K, 480, 270, cam_from_world=pose)[0] >= 0
            mask = binary_dilation(mask, iterations=grow) if grow else mask
            rows.append(np.kron(mask, np.ones((4, 4), bool)))
        images[name] = np.stack(rows)
    return images


def test_masks_find_the_back_of_the_head():
    """Keypoints alone leave it to the prior; contours see it. A loose matte may help and must not harm."""
    take = make_take(frames=12, cameras=5, noise=2.0, outliers=0.2, missing=0.2)
    frames = [0, 3, 6, 9]
    cfg = FitConfig(check_handedness=False)
    errors = {}
    for name, masks in (
        ("none", None),
        ("labels", Masks(frames, _film_masks(take, frames), True)),
        ("matte", Masks(frames, _film_masks(take, frames, grow=3), False)),
    ):
        fitted, _ = fit_sequence(take.frames, {}, take.extras, take.bodies, cfg, masks=masks)
        distance = 1e3 * np.linalg.norm(fitted.parts["head"].verts - take.truth["head"], axis=-1)
        errors[name] = (np.median(distance), np.percentile(distance, 95))
    assert errors["labels"][1] < 0.6 * errors["none"][1]
    assert errors["matte"][1] < 1.05 * errors["none"][1] and errors["matte"][0] < 1.1 * errors["none"][0]
