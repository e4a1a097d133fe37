"""Scenes for the tests of Gaussian splatting, and an oracle that shares no code with the package."""

import numpy as np
import torch

OPTIONS = {"near": 0.01, "low_pass": 0.3, "alpha_min": 1.0 / 255.0, "alpha_max": 0.99, "t_min": 1e-4}
NAMES = ("means", "quats", "scales", "opacities", "colours")


def camera(width=40, height=30, focal=35.0, dtype=torch.float64, off_centre=True):
    """A camera at the origin that looks along +z, with its principal point off the centre."""
    cx, cy = (0.6 * width, 0.35 * height) if off_centre else (width / 2, height / 2)
    K = torch.tensor([[focal, 0.0, cx], [0.0, 1.1 * focal, cy], [0.0, 0.0, 1.0]], dtype=dtype)
    return torch.eye(4, dtype=dtype), K


def turned_camera(width=40, height=30, focal=35.0, dtype=torch.float64):
    """A camera with a rotation and a shift that still sees the scenes below."""
    view, K = camera(width, height, focal, dtype)
    angle, tilt = 0.3, -0.2
    yaw = torch.tensor([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    pitch = torch.tensor([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    view[:3, :3] = (pitch @ yaw).to(dtype)
    view[:3, 3] = torch.tensor([-0.5, 0.35, 0.2], dtype=dtype)
    return view, K


def random_gaussians(seed, count=30, degree=None, dtype=torch.float64, spread=0.4, size=(0.02, 0.2), coefficients=0):
    """Gaussians of random pose in a ball before the camera; harmonics of a degree, or plain colours."""
    g = torch.Generator().manual_seed(seed)
    means = spread * torch.randn(count, 3, generator=g, dtype=torch.float64)
    means[:, 2] += 2.0
    quats = torch.randn(count, 4, generator=g, dtype=torch.float64)
    scales = size[0] * (size[1] / size[0]) ** torch.rand(count, 3, generator=g, dtype=torch.float64)
    opacities = torch.rand(count, generator=g, dtype=torch.float64)
    if degree is None:
        colours = torch.rand(count, 3, generator=g, dtype=torch.float64)
    else:
        terms = max(coefficients, (degree + 1) ** 2)
        colours = 0.5 * torch.randn(count, terms, 3, generator=g, dtype=torch.float64)
    return [tensor.to(dtype) for tensor in (means, quats, scales, opacities, colours)]


def single(z=2.0, scale=0.1, opacity=0.5, colour=(1.0, 0.5, 0.25), x=0.0, y=0.0, dtype=torch.float64):
    """One ball-shaped Gaussian."""
    return [
        torch.tensor([[x, y, z]], dtype=dtype),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=dtype),
        torch.full((1, 3), scale, dtype=dtype),
        torch.full((1,), opacity, dtype=dtype),
        torch.tensor([colour], dtype=dtype),
    ]


def stack(*scenes):
    return [torch.cat(tensors) for tensors in zip(*scenes, strict=True)]


def rotation(q):
    """Rotation matrix of a wxyz quaternion by Rodrigues' formula."""
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def pixel_of(point, view, K):
    """Pinhole projection of one world point, by matrices."""
    local = K @ (view[:3, :3] @ point + view[:3, 3])
    return local[:2] / local[2]


def covariance_by_differences(mean, q, scale, view, K, low_pass):
    """Covariance on screen with the projection's Jacobian from central differences."""
    step = 1e-5
    J = np.stack(
        [(pixel_of(mean + d, view, K) - pixel_of(mean - d, view, K)) / (2 * step) for d in step * np.eye(3)], 1
    )
    spread = rotation(q / np.linalg.norm(q)) @ np.diag(scale)
    return J @ spread @ spread.T @ J.T + low_pass * np.eye(2)


def render_by_hand(scene, view, K, width, height, *, near, low_pass, alpha_min, alpha_max, t_min):
    """Pixel by pixel in numpy, with inverted 2x2 matrices: plain colours only; (3, H, W) and (H, W).

    No mean may lie off the image by more than the margin of the Jacobian's clamp.
    """
    means, quats, scales, opacities, colours = (tensor.detach().double().numpy() for tensor in scene)
    view, K = view.double().numpy(), K.double().numpy()
    image, alpha = np.zeros((3, height, width)), np.zeros((height, width))
    seen = []
    for i in range(len(means)):
        depth = (view[:3, :3] @ means[i] + view[:3, 3])[2]
        if depth >= near:
            inverse = np.linalg.inv(covariance_by_differences(means[i], quats[i], scales[i], view, K, low_pass))
            seen.append((depth, i, pixel_of(means[i], view, K), inverse))
    seen.sort(key=lambda entry: entry[0])
    for row in range(height):
        for column in range(width):
            through = 1.0
            for _, i, centre, inverse in seen:
                d = np.array([column + 0.5, row + 0.5]) - centre
                a = min(opacities[i] * np.exp(-0.5 * d @ inverse @ d), alpha_max)
                if a < alpha_min:
                    continue
                if through * (1 - a) < t_min:
                    break
                image[:, row, column] += through * a * colours[i]
                alpha[row, column] += through * a
                through *= 1 - a
    return image, alpha
