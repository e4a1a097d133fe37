"""The gather alone, the adjoint of sampling: a tape of random numbers against torch's own gradients."""

import numpy as np
import pytest
import torch
from torch.nn.functional import grid_sample

from nbavatar.rendering.billboards.cpu_gather import Gradients, Part
from nbavatar.rendering.billboards.cpu_scratch import Adjoints, Tape
from tests.unit.rendering.billboards.stages import HEIGHT, WIDTH, patches, pixels, scene_of, settings, textures


def sampled(texture, u, v):
    """A texture (T, T, C) at points (P,): (P, C)."""
    single = len(texture) == 1  # a single texel is a tent that ends at -1 and 1
    grid = torch.stack([u, v], -1)[None, None] * (2.0 if single else 1.0)
    return grid_sample(texture.permute(2, 0, 1)[None], grid, padding_mode="zeros", align_corners=not single)[0, :, 0].T


def random_tape(seed, scene, seen):
    """A tape with random numbers for all `seen[i]` (x, y) of billboard i, and these numbers, by billboard (P, 2)."""
    g = np.random.default_rng(seed)
    bins = scene.bins
    values, places, ranges, numbers = [], [], np.zeros(2 * len(bins.members), np.int32), [[] for _ in seen]
    tile_bundle = [0]
    for tile in range(len(bins.tile_start) - 1):
        left, top = tile % 2 * 32, tile // 2 * 32
        for position in range(bins.tile_start[tile], bins.tile_start[tile + 1]):
            i = bins.members[position]
            mine = [
                (k, x - left, y - top)
                for k, (x, y) in enumerate(seen[i])
                if x // 32 == tile % 2 and y // 32 == tile // 2
            ]
            ranges[2 * position] = len(values) - tile_bundle[-1]
            for first in range(0, len(mine), 8):
                bundle, pixel = np.zeros((2, 8)), np.zeros(8, np.int32)
                for lane, (k, x, y) in enumerate(mine[first : first + 8]):
                    bundle[:, lane] = 0.1 + g.random(), g.standard_normal()
                    pixel[lane] = y << 5 | x
                    numbers[i].append((k, *bundle[:, lane]))
                values.append(bundle)
                places.append(pixel)
            ranges[2 * position + 1] = len(values) - tile_bundle[-1]
        tile_bundle.append(len(values))
    tape = Tape(np.ravel(values), np.ravel(places).astype(np.int32), ranges, np.array(tile_bundle), 0)
    return tape, [torch.tensor([row[1:] for row in sorted(rows)]).double().reshape(-1, 2) for rows in numbers]


@pytest.mark.parametrize(("texels", "channels", "uniform"), [(1, 2, 0), (2, 3, 0), (5, 10, 0), (1, 2, 7), (5, 8, 3)])
def test_gradients_of_textures_planes_and_fades(texels, channels, uniform):
    """L = sum over hits of w (f . dL/dC) + dL/da a, with the tape's w and dL/da as constants."""
    count, s = 5, settings(0, texels, alpha_max=0.6)
    projection = patches(7, count, radius=(4.0, 15.0), tilt=0.02)
    features, alpha = textures(7, count, texels, channels)
    told = torch.randn(count, uniform, generator=torch.Generator().manual_seed(10), dtype=torch.float64)
    scene = scene_of(projection, features, alpha, s, uniform=told)
    grad_image = torch.randn(
        channels + uniform, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(8), dtype=torch.float64
    )
    leaves = [t.clone().requires_grad_() for t in (features, alpha, projection.plane, projection.fade, told)]
    points = torch.tensor([(x + 0.5, y + 0.5, 1.0) for x, y in pixels()]).double()
    inside = (projection.plane.detach() @ points.T).permute(0, 2, 1)
    covered = (inside[..., :2].abs() < 0.999 * s.support * inside[..., 2:]).all(-1)
    tape, numbers = random_tape(9, scene, [[pixels()[k] for k in row.nonzero().ravel()] for row in covered])
    loss = torch.zeros((), dtype=torch.float64)
    for i in range(count):
        u, v, w = (leaves[2][i] @ points[covered[i]].T).unbind(0)
        raw = leaves[3][i] * sampled(leaves[1][i, ..., None], u / w, v / w)[:, 0]
        a = torch.where(raw <= s.alpha_max, raw, s.alpha_max)
        everywhere = torch.cat((leaves[0][i], leaves[4][i].expand(texels, texels, -1)), -1)
        feature = sampled(everywhere, u / w, v / w)
        dL_dcolour = grad_image.reshape(channels + uniform, -1).T[covered[i]]
        loss = loss + (numbers[i][:, 0] * (feature * dL_dcolour).sum(-1)).sum() + (numbers[i][:, 1] * a).sum()
    expected = torch.autograd.grad(loss, leaves)
    found = [torch.full_like(leaf, torch.nan).detach() for leaf in leaves]  # uninitialised memory
    rows = torch.full((count, scene.stride), torch.nan, dtype=torch.float64)
    flat = Gradients(*(values.view(-1).numpy() for values in (*found[:2], rows)), found[2].numpy(), found[3].numpy())
    adjoints = Adjoints(scene._rows(grad_image), np.zeros(WIDTH * HEIGHT))
    scene._gather(Part(2, 0, 3, 1, True), adjoints, tape, flat)  # in two parts: the second adds to the first
    scene._gather(Part(2, 3, 4, 1, False), adjoints, tape, flat)
    found[4] = rows[:, channels : channels + uniform]
    for name, a, b in zip(("features", "alpha", "plane", "fade", "uniform"), found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9, msg=name)
