"""What the tests of single stages share: billboards given by their planes, bins without binning, hits in plain NumPy.

Nothing here is computed by the package: a fault of one stage stays out of the tests of the others.
"""

import math
from unittest import mock

import numpy as np
import torch

from nbavatar.rendering.billboards import cpu
from nbavatar.rendering.billboards.cpu_scratch import Adjoints
from nbavatar.rendering.billboards.reference import BlendSettings
from nbavatar.rendering.binning import RECORD, TILE_HEIGHT, TILE_WIDTH, Bins
from nbavatar.rendering.patches import ProjectedPatches

WIDTH, HEIGHT = 37, 34  # four tiles, three of them not whole


def settings(queue=-1, texels=3, **changes):
    support = 1.0 if texels == 1 else 1.0 + 2.0 / (texels - 1)
    numbers = dict(near=0.01, alpha_min=1.0 / 255.0, alpha_max=0.99, t_min=1e-4, support=support) | changes
    return BlendSettings(WIDTH, HEIGHT, queue, **numbers)


def patches(seed, count, radius=(6.0, 25.0), depth=None, tilt=0.004):
    """Patches of random place, size [px], rotation, tilt and depth."""
    g = np.random.default_rng(seed)
    plane = np.zeros((count, 3, 3))
    depth = 1.0 + g.random(count) if depth is None else np.asarray(depth, float)
    for i in range(count):
        x, y = g.random() * WIDTH, g.random() * HEIGHT
        r, angle = radius[0] + (radius[1] - radius[0]) * g.random(), 6.3 * g.random()
        rows = np.array([[math.cos(angle), math.sin(angle), 0], [-math.sin(angle), math.cos(angle), 0]]) / r
        rows[:, 2] = -rows[:, :2] @ (x, y)
        slope = tilt * (g.random(2) - 0.5)
        plane[i] = [*rows, [*slope, 1.0 - slope @ (x, y)]] / depth[i]
    corners = [(x + 0.5, y + 0.5, 1.0) for x in (0, WIDTH - 1) for y in (0, HEIGHT - 1)]
    nearest = 1.0 / np.max(plane[:, 2] @ np.transpose(corners), axis=1)
    fade = 0.5 + 0.5 * g.random(count)
    box = np.tile([0.0, 0.0, WIDTH, HEIGHT], (count, 1))
    return ProjectedPatches(*(torch.from_numpy(a) for a in (plane, fade, depth, nearest, box)))


def textures(seed, count, texels, channels):
    g = torch.Generator().manual_seed(seed)
    features = torch.randn(count, texels, texels, channels, generator=g, dtype=torch.float64)
    return features, 0.1 + 0.8 * torch.rand(count, texels, texels, generator=g, dtype=torch.float64)


def plain_bins(projection, texels, order, rank):
    """Bins in which every billboard is in every tile and may cover all of the image."""
    plane, count = projection.plane.numpy(), len(order)
    x, y = WIDTH // 2 + 0.5, HEIGHT // 2 + 0.5
    scale, shift = (0.5 * (texels - 1), 0.5 * (texels - 1)) if texels > 1 else (1.0, 0.0)
    s, t = scale * plane[:, 0] + shift * plane[:, 2], scale * plane[:, 1] + shift * plane[:, 2]
    texel = np.stack([s, t, plane[:, 2]], 1)
    texel[:, :, 2] = texel @ (x, y, 1.0)
    record = np.zeros((count, RECORD))
    record[:, :9] = texel.reshape(count, 9)
    record[:, 9] = record[:, 8] - 0.5
    record[:, 10] = projection.fade.numpy()
    record[:, 11] = 1.000001 / projection.nearest.numpy() - 0.5
    box = np.tile(np.array([0, 0, WIDTH, HEIGHT], np.int32), (count, 1))
    tiles = -(-WIDTH // TILE_WIDTH) * -(-HEIGHT // TILE_HEIGHT)
    order = np.asarray(order, np.int32)
    ranks = np.zeros(count, np.int32)
    ranks[rank] = np.arange(count, dtype=np.int32)
    tile, place = np.meshgrid(np.arange(tiles), np.arange(count))
    return Bins(
        record, box, order, ranks, tiles * np.arange(count + 1), tile.ravel().astype(np.int32),
        (tile * count + place).ravel(), count * np.arange(tiles + 1), np.tile(order, tiles),
        np.full(tiles, count * TILE_WIDTH * TILE_HEIGHT // 8),
    )  # fmt: skip


def scene_of(projection, features, alpha, s, rank=None, uniform=None):
    """The CPU backend's scene on plain bins, in float64."""
    uniform = alpha.new_zeros((len(alpha), 0)) if uniform is None else uniform
    rank = np.argsort(projection.depth.numpy(), kind="stable") if rank is None else np.asarray(rank)
    order = rank[np.argsort(projection.nearest.numpy()[rank], kind="stable")] if s.queue < 0 else rank
    bins = plain_bins(projection, alpha.shape[-1], order, rank)
    with mock.patch.object(cpu, "bin_billboards", lambda *_, **__: bins):
        return cpu._Scene(projection, torch.from_numpy(rank), features, alpha, uniform, s)


def replayed(scene, grad_image, grad_opacity):
    """Adjoints as the kernels take them, and the tape that the replay leaves, after a forward pass."""
    adjoints = Adjoints(scene._rows(grad_image), grad_opacity.reshape(-1).numpy())
    tapes = []
    scene._gather = lambda part, adjoints, tape, gradients: tapes.append(tape)
    scene._replay(adjoints, None)
    (tape,) = tapes
    return adjoints, tape


def taped_hits(scene, tape):
    """The tape's hits as a dictionary: (x, y, billboard) -> (weight, dL/da)."""
    found = {}
    bins, across = scene.bins, -(-WIDTH // TILE_WIDTH)
    for tile in range(len(bins.tile_start) - 1):
        for position in range(bins.tile_start[tile], bins.tile_start[tile + 1]):
            first, end = tape.ranges[2 * position : 2 * position + 2] + tape.tile_bundle[tile]
            for bundle in range(first, end):
                values = tape.values[16 * bundle : 16 * bundle + 16].reshape(2, 8)
                for lane in np.flatnonzero(values.any(0)):
                    pixel = int(tape.pixels[8 * bundle + lane])
                    x, y = tile % across * TILE_WIDTH + pixel % 32, tile // across * TILE_HEIGHT + pixel // 32
                    found[x, y, int(bins.members[position])] = tuple(values[:, lane])
    return found


def sample(texture, u, v):
    """Four taps; zeros outside."""
    texels = len(texture)
    x, y = ((u + 1) / 2 * (texels - 1), (v + 1) / 2 * (texels - 1)) if texels > 1 else (u, v)
    total = 0.0 * texture[0, 0]
    for row in (math.floor(y), math.floor(y) + 1):
        for column in (math.floor(x), math.floor(x) + 1):
            if 0 <= row < texels and 0 <= column < texels:
                total = total + (1 - abs(x - column)) * (1 - abs(y - row)) * texture[row, column]
    return total


def hits_at(projection, features, alpha, s, x, y):
    """Hits of a pixel in the order of the billboards' numbers: billboard, inverse depth, alpha, feature."""
    hits = []
    for i, plane in enumerate(projection.plane.numpy()):
        u, v, w = plane @ (x + 0.5, y + 0.5, 1.0)
        if w <= 0 or w > 1 / s.near or max(abs(u), abs(v)) > s.support * w:
            continue
        a = sample(alpha[i].numpy(), u / w, v / w)
        if a >= s.alpha_min:
            capped = min(float(projection.fade[i]) * a, s.alpha_max)
            hits.append((i, w, capped, sample(features[i].numpy(), u / w, v / w)))
    return hits


def pixels():
    return [(x, y) for y in range(HEIGHT) for x in range(WIDTH)]
