"""Public function of the rasterizer: argument checks, projection, choice of the backend."""

import math
import os
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from nbavatar.errors import DataError, DependencyError, DeviceError
from nbavatar.rendering.billboards.projection import project_billboards, texture_support
from nbavatar.rendering.billboards.reference import BlendSettings, blend_reference
from nbavatar.rendering.ordering import canonical_rank, parse_order
from nbavatar.rendering.patches import ProjectedPatches
from nbavatar.rendering.plain import announce_plain_torch

__all__ = ["render_billboards"]

_WHERE = "render_billboards"
_BACKENDS = ("auto", "reference", "cpu", "cuda")
_Project = Callable[..., ProjectedPatches]
_Blend = Callable[[ProjectedPatches, Tensor, Tensor, Tensor, BlendSettings, Tensor | None], tuple[Tensor, Tensor]]


def render_billboards(
    means: Tensor,
    quats: Tensor,
    half_extents: Tensor,
    features: Tensor | None,
    alpha: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    order: str = "ray",
    near: float = 0.01,
    alpha_min: float = 1.0 / 255.0,
    alpha_max: float = 0.99,
    t_min: float = 1e-4,
    low_pass: float = 1.0,
    backend: str = "auto",
    uniform: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Renders textured billboards, front to back, differentiably.

    Billboard i is the plane patch `mean + R(q) (u su, v sv, 0)`; both faces are visible. Texel
    (row 0, column 0) lies at (u, v) = (-1, -1), rows grow with v and columns with u; sampling is
    bilinear, the outer texel centres lie at -1 and 1, and beyond them the texture fades to zero
    within one texel (`grid_sample(align_corners=True, padding_mode="zeros")`). A 1x1 texture is a
    tent over [-1, 1]. With the hits of a pixel in order, T_1 = 1 and T_{k+1} = T_k (1 - a_k),

        features = sum_k T_k a_k f_k,    alpha = sum_k T_k a_k.

    Hits closer than `near` are clipped pixel by pixel. Hits of equal depth are blended in an
    order that depends on the billboards' values, not on their places in the arrays
    (`nbavatar.rendering.ordering`), so a permutation of the billboards changes nothing.

    Args:
        means: (F, 3) centres, world [m]. F may be 0.
        quats: (F, 4) rotations billboard-to-world, wxyz; normalised here.
        half_extents: (F, 2) distance from the centre to u = 1 and to v = 1 [m].
        features: (F, T, T, C) channels last, or None to render alpha only (C = 0).
        alpha: (F, T, T) in [0, 1].
        viewmat: (4, 4) or (B, 4, 4) `cam_from_world`, OpenCV axes.
        K: (3, 3) or (B, 3, 3) intrinsics [px], upper triangular; any principal point.
        width, height: image [px]; pixel (0, 0) has its centre at (0.5, 0.5).
        order: `ray` sorts the hits of each pixel by their depth, exactly; `center` takes the
            billboards by the depth of their centre; `kbuffer(n)` is `center` corrected by a queue
            of n hits a pixel, which gives up its nearest when one more arrives.
        near: hits at smaller depth are clipped [m].
        alpha_min: a texture sample under this is skipped.
        alpha_max: a hit's alpha is capped here; a capped hit passes no gradient to its alpha.
        t_min: a pixel is finished once its transmittance is under this.
        low_pass: least half-extent of a billboard on screen [px]. A smaller one is widened to it
            and dimmed so that its alpha summed over the image stays; 0 turns this off.
        backend: `auto` takes the kernels for the tensors' device; `reference` is the slow oracle, which also stands in,
            and says so, on a GPU for which no kernel can be compiled.
        uniform: (F, D), further features that all texels of a billboard have in common, or None. As if they
            stood behind the C of `features` in every texel, which on a CPU they need not.

    Returns:
        Premultiplied features (C + D, H, W) and alpha (H, W), each with a leading B where `viewmat` or
        `K` has one; dtype of `alpha`. Gradients reach means, quats, half_extents, features, alpha, uniform.

    Raises:
        DataError: a shape, dtype, device, option or value is wrong; one line says which.
        DeviceError: the backend asked for does not fit the tensors' device.
        DependencyError: `cuda` is asked for and the package numba-cuda is missing.
    """
    if features is None and isinstance(alpha, Tensor):
        features = alpha.new_zeros(*alpha.shape, 0)
    assert features is not None
    _check_tensors(means, quats, half_extents, features, alpha, viewmat, K, uniform)
    _check_options(width, height, near, alpha_min, alpha_max, t_min, low_pass)
    queue = parse_order(order)
    project, blend = _backend(backend, means.device)
    settings = BlendSettings(width, height, queue, near, alpha_min, alpha_max, t_min, texture_support(alpha.shape[-1]))
    batched = viewmat.ndim == 3 or K.ndim == 3
    cameras = max(viewmat.shape[0] if viewmat.ndim == 3 else 1, K.shape[0] if K.ndim == 3 else 1)
    views, intrinsics = viewmat.expand(cameras, 4, 4), K.expand(cameras, 3, 3)
    images = []
    for view, intrinsic in zip(views, intrinsics, strict=True):
        projection = project(
            means, quats, half_extents, view, intrinsic, near=near, low_pass=low_pass, support=settings.support
        )
        rank = canonical_rank(projection.depth, means, quats, half_extents, features, alpha, uniform)
        image, opacity = blend(projection, rank, features, alpha, settings, uniform)
        images.append((image.to(alpha.dtype), opacity.to(alpha.dtype)))
    if not batched:
        return images[0]
    return torch.stack([image for image, _ in images]), torch.stack([opacity for _, opacity in images])


def _backend(name: str, device: torch.device) -> tuple[_Project, _Blend]:
    """Projection and blending on a device."""
    if name not in _BACKENDS:
        raise DataError.of(_WHERE, "backend", expected=f"one of {', '.join(_BACKENDS)}", found=repr(name))
    if name == "auto" and device.type == "cuda":
        try:
            return _backend("cuda", device)
        except DependencyError as error:
            announce_plain_torch("billboards", error)
    if name == "auto":
        name = "cpu" if device.type == "cpu" else "reference"
    if name == "reference":
        return project_billboards, partial(_in_texels, blend_reference)
    if name == "cpu" and device.type == "cpu":
        from nbavatar.rendering.billboards.cpu import blend_cpu  # Numba is loaded only when it is needed
        from nbavatar.rendering.billboards.cpu_projection import project_billboards_cpu

        return project_billboards_cpu, blend_cpu
    if name == "cuda" and (device.type == "cuda" or os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"):
        from nbavatar.rendering.billboards.cuda import blend_cuda  # a machine without CUDA never gets here

        return project_billboards, partial(_in_texels, blend_cuda)
    raise DeviceError.of(_WHERE, "backend", expected=f"tensors on {name}", found=f"tensors on {device.type}")


def _in_texels(
    blend: Callable[..., tuple[Tensor, Tensor]],
    projection: ProjectedPatches,
    rank: Tensor,
    features: Tensor,
    alpha: Tensor,
    settings: BlendSettings,
    uniform: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Blending that knows textures only: what the texels of a billboard have in common is written to each."""
    if uniform is not None and uniform.shape[-1]:
        features = torch.cat((features, uniform[:, None, None].expand(*alpha.shape, -1)), dim=-1)  # the wider type
    return blend(projection, rank, features, alpha, settings)


def _check_tensors(
    means: Tensor, quats: Tensor, half_extents: Tensor, features: Tensor, alpha: Tensor, viewmat: Tensor, K: Tensor,
    uniform: Tensor | None,
) -> None:  # fmt: skip
    named = {
        "means": means, "quats": quats, "half_extents": half_extents, "features": features, "alpha": alpha,
        "viewmat": viewmat, "K": K,
    }  # fmt: skip
    if uniform is not None:
        named["uniform"] = uniform
    for name, value in named.items():
        if not isinstance(value, Tensor) or not value.is_floating_point():
            found = f"{value.dtype} tensor" if isinstance(value, Tensor) else type(value).__name__
            raise DataError.of(_WHERE, name, expected="a floating-point tensor", found=found)
        if value.device != alpha.device:
            raise DataError.of(_WHERE, name, expected=f"device {alpha.device} as alpha", found=str(value.device))
    count = means.shape[0] if means.ndim else 0
    texels = alpha.shape[-1] if alpha.ndim else 0
    shapes = {"means": (count, 3), "quats": (count, 4), "half_extents": (count, 2), "alpha": (count, texels, texels)}
    for name, shape in shapes.items():
        _check_shape(name, named[name], shape)
    if texels < 1:
        raise DataError.of(_WHERE, "alpha", expected="at least one texel a side", found=f"shape {tuple(alpha.shape)}")
    channels = features.shape[-1] if features.ndim == 4 else -1
    _check_shape("features", features, (count, texels, texels, channels))
    if uniform is not None:
        _check_shape("uniform", uniform, (count, uniform.shape[-1] if uniform.ndim == 2 else -1))
    for name, value, side in (("viewmat", viewmat, 4), ("K", K, 3)):
        if value.ndim not in (2, 3) or value.shape[-2:] != (side, side) or value.shape[0] == 0:
            raise DataError.of(_WHERE, name, expected=f"({side}, {side}) or (B, {side}, {side})",
                               found=f"shape {tuple(value.shape)}")  # fmt: skip
    if viewmat.ndim == 3 and K.ndim == 3 and len(viewmat) != len(K) and 1 not in (len(viewmat), len(K)):
        raise DataError.of(_WHERE, "K", expected=f"{len(viewmat)} cameras as viewmat", found=str(len(K)))
    if alpha.device.type == "cpu":  # on a GPU the check would stall the stream
        _check_values(means, quats, half_extents, viewmat, K)


def _check_shape(name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise DataError.of(_WHERE, name, expected=f"shape {shape}", found=f"shape {tuple(value.shape)}")


def _check_values(means: Tensor, quats: Tensor, half_extents: Tensor, viewmat: Tensor, K: Tensor) -> None:
    values = {"means": means, "quats": quats, "half_extents": half_extents, "viewmat": viewmat, "K": K}
    for name, value in values.items():
        value = value.detach().double()
        if math.isfinite(value.sum()):
            continue
        finite = np.isfinite(value.numpy())
        if not finite.all():  # if not, the sum was too large for a number
            row = int(np.argwhere(~finite)[0, 0])
            raise DataError.of(_WHERE, name, expected="finite values", found=f"NaN or infinity in row {row}")
    zero = (quats.detach() == 0).all(-1)
    if bool(zero.any()):
        raise DataError.of(_WHERE, "quats", expected="no zero quaternion", found=f"one in row {int(zero.nonzero()[0])}")
    K = K.detach()
    lower = K[..., [1, 2, 2], [0, 0, 1]]
    if bool((lower != 0).any()) or bool((K[..., 2, 2] != 1).any()) or bool((K[..., [0, 1], [0, 1]] <= 0).any()):
        raise DataError.of(_WHERE, "K", expected="upper triangular, positive focal lengths, last row 0 0 1",
                           found=str(K.reshape(-1, 3, 3)[0].tolist()))  # fmt: skip


def _check_options(
    width: int, height: int, near: float, alpha_min: float, alpha_max: float, t_min: float, low_pass: float
) -> None:
    checks = {
        "width": (width >= 1, "at least 1", width),
        "height": (height >= 1, "at least 1", height),
        "near": (0 < near < float("inf"), "a positive distance", near),
        "alpha_min": (0 <= alpha_min < 1, "a number in [0, 1)", alpha_min),
        "alpha_max": (0 < alpha_max <= 1, "a number in (0, 1]", alpha_max),
        "t_min": (0 <= t_min < 1, "a number in [0, 1)", t_min),
        "low_pass": (0 <= low_pass < float("inf"), "a distance in pixels, at least 0", low_pass),
    }
    for name, (good, expected, found) in checks.items():
        if not good:
            raise DataError.of(_WHERE, name, expected=expected, found=found)
