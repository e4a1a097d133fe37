"""Scenes for the rasterizer's tests, and an oracle that shares no code with the package."""

import math

import numpy as np
import torch

OPTIONS = {"near": 0.01, "alpha_min": 1.0 / 255.0, "alpha_max": 0.99, "t_min": 1e-4, "low_pass": 1.0}


def camera(width=40, height=30, focal=35.0, dtype=torch.float64, off_centre=True):
    """A camera at the origin that looks along +z, with its principal point off the centre."""
    cx, cy = (0.6 * width, 0.35 * height) if off_centre else (width / 2, height / 2)
    K = torch.tensor([[focal, 0.0, cx], [0.0, 1.1 * focal, cy], [0.0, 0.0, 1.0]], dtype=dtype)
    return torch.eye(4, dtype=dtype), K


def random_billboards(seed, count=30, texels=4, channels=3, dtype=torch.float64, spread=0.4, size=(0.05, 0.3)):
    """Billboards of random pose in a ball before the camera, random textures."""
    g = torch.Generator().manual_seed(seed)
    means = spread * torch.randn(count, 3, generator=g, dtype=torch.float64)
    means[:, 2] += 2.0
    quats = torch.randn(count, 4, generator=g, dtype=torch.float64)
    extents = size[0] + (size[1] - size[0]) * torch.rand(count, 2, generator=g, dtype=torch.float64)
    features = torch.randn(count, texels, texels, channels, generator=g, dtype=torch.float64)
    alpha = torch.rand(count, texels, texels, generator=g, dtype=torch.float64)
    return [tensor.to(dtype) for tensor in (means, quats, extents, features, alpha)]


def facing(z, extent=0.5, alpha=0.5, feature=1.0, texels=4, dtype=torch.float64):
    """One billboard that faces the camera at depth z, of constant alpha and feature."""
    return [
        torch.tensor([[0.0, 0.0, z]], dtype=dtype),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=dtype),
        torch.full((1, 2), extent, dtype=dtype),
        torch.full((1, texels, texels, 1), feature, dtype=dtype),
        torch.full((1, texels, texels), alpha, dtype=dtype),
    ]


def stack(*scenes):
    return [torch.cat(tensors) for tensors in zip(*scenes, strict=True)]


def render_by_hand(scene, viewmat, K, width, height, *, near, alpha_min, alpha_max, t_min, low_pass=0.0):
    """Ray by ray in numpy: solves u a + v b - z d = -c by 3x3 systems, samples by four taps, sorts, blends.

    Only without low-pass; features (C, H, W) and alpha (H, W).
    """
    assert low_pass == 0
    means, quats, extents, features, alpha = (tensor.detach().double().numpy() for tensor in scene)
    view, K = viewmat.double().numpy(), K.double().numpy()
    texels, channels = alpha.shape[-1], features.shape[-1]
    image, opacity = np.zeros((channels, height, width)), np.zeros((height, width))
    frames = []
    for q in quats / np.linalg.norm(quats, axis=1, keepdims=True):
        w, v = q[0], q[1:]
        cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
        frames.append(view[:3, :3] @ (np.eye(3) + 2 * w * cross + 2 * cross @ cross))
    centres = means @ view[:3, :3].T + view[:3, 3]

    def taps(texture, u, v):
        x, y = (u + 1) / 2 * (texels - 1), (v + 1) / 2 * (texels - 1)
        if texels == 1:
            x, y = u, v
        total = 0.0
        for row in range(math.floor(y), math.floor(y) + 2):
            for column in range(math.floor(x), math.floor(x) + 2):
                if 0 <= row < texels and 0 <= column < texels:
                    total = total + (1 - abs(x - column)) * (1 - abs(y - row)) * texture[row, column]
        return total

    for i in range(height):
        for j in range(width):
            ray = np.linalg.solve(K, np.array([j + 0.5, i + 0.5, 1.0]))
            hits = []
            for f, (frame, centre) in enumerate(zip(frames, centres, strict=True)):
                system = np.stack([frame[:, 0] * extents[f, 0], frame[:, 1] * extents[f, 1], -ray], 1)
                if abs(np.linalg.det(system)) < 1e-14:
                    continue
                u, v, z = np.linalg.solve(system, -centre)
                a = taps(alpha[f], u, v)
                if z >= near and a >= alpha_min and a > 0:
                    hits.append((z, f, min(a, alpha_max), u, v))
            through = 1.0
            for _, f, a, u, v in sorted(hits):
                image[:, i, j] += through * a * taps(features[f], u, v)
                opacity[i, j] += through * a
                through *= 1 - a
                if through < t_min:
                    break
    return image, opacity
