"""Public function of the Gaussian rasterizer: argument checks, projection, choice of the backend."""

import importlib.util
import os
from typing import NamedTuple

import torch
from torch import Tensor

from nbavatar.errors import DataError, DependencyError, DeviceError
from nbavatar.rendering.gaussians.projection import camera_centre, project_gaussians
from nbavatar.rendering.gaussians.reference import SplatSettings, blend_reference
from nbavatar.rendering.gaussians.spherical_harmonics import DEGREES, harmonic_colours, harmonic_count
from nbavatar.rendering.ordering import canonical_rank
from nbavatar.rendering.plain import announce_plain_torch

__all__ = ["SplatImage", "render_gaussians"]

_WHERE = "render_gaussians"
_BACKENDS = ("auto", "reference", "cpu", "cuda", "gsplat")
_LARGEST = 1e30  # of scales, whose fourth powers must stay finite


class SplatImage(NamedTuple):
    """What `render_gaussians` returns.

    Attributes:
        colour: (3, H, W) premultiplied by alpha.
        alpha: (H, W).
        radii: (N,) three standard deviations of each projected Gaussian along its longer axis [px];
            0 for one that is not before the camera or lies off the image. No gradient.
    """

    colour: Tensor
    alpha: Tensor
    radii: Tensor


def render_gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colours: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    screen_offsets: Tensor | None = None,
    near: float = 0.01,
    low_pass: float = 0.3,
    alpha_min: float = 1.0 / 255.0,
    alpha_max: float = 0.99,
    t_min: float = 1e-4,
    backend: str = "auto",
) -> SplatImage:
    """Renders 3D Gaussians by EWA splatting, front to back, differentiably.

    Gaussian i has the covariance `R(q) diag(scales)^2 R(q)^T`, is projected to a 2D Gaussian by the
    derivative of the pinhole projection at its mean, and is widened by the low-pass
    (`nbavatar.rendering.gaussians.projection` has the formulas, and the clamp of that derivative for means off the
    image). At a pixel centre it has `a_i = min(alpha_max, o_i exp(-d^T Sigma'^-1 d / 2))`. With the
    Gaussians in order of the depth of their means, T_1 = 1 and T_{k+1} = T_k (1 - a_k),

        colour = sum_k T_k a_k c_k,    alpha = sum_k T_k a_k,

    over those with `a_k >= alpha_min` and, after Kerbl et al. 2023 (appendix C), up to the last that
    leaves `T_{k+1} >= t_min`. Every pixel that a Gaussian reaches with `alpha_min` gets it; there is
    no cut at three standard deviations. Equal depths are put in order by the Gaussians' values, not by
    their places in the arrays (`nbavatar.rendering.ordering`), so a permutation changes nothing.

    Args:
        means: (N, 3) world [m]. N may be 0.
        quats: (N, 4) rotations Gaussian-to-world, wxyz; normalised here.
        scales: (N, 3) standard deviations along the Gaussian's axes [m], at least 0.
        opacities: (N,) in [0, 1].
        colours: (N, 3), taken as they are, or (N, K, 3) coefficients of spherical harmonics
            (`nbavatar.rendering.gaussians.spherical_harmonics`) for the direction from the camera to the mean.
        viewmat: (4, 4) `cam_from_world`, rigid, OpenCV axes.
        K: (3, 3) intrinsics [px], upper triangular; any principal point.
        width, height: image [px]; pixel (0, 0) has its centre at (0.5, 0.5).
        sh_degree: 0 to 3, highest degree of the harmonics that is used; None for all K = 1, 4, 9 or 16.
        screen_offsets: (N, 2) added to the projected means [px]; zeros that require a gradient give
            the gradient by the projected mean. Multiply it by (width / 2, height / 2) for the units of
            thresholds published for normalised device coordinates.
        near: a Gaussian whose mean is at smaller depth is left out [m].
        low_pass: added to the variances on screen [px^2].
        alpha_min: a smaller alpha is skipped.
        alpha_max: alpha is capped here; where it is, it passes no gradient on.
        t_min: a pixel is finished before its transmittance falls under this.
        backend: `cpu` and `cuda` blend with our kernels (tensors on a GPU are projected there and copied for
            `cpu`); `gsplat` takes that package, on a GPU, with the restrictions that
            `gsplat_backend.py` names; `auto` is `cpu`, and on a GPU `gsplat` where it is installed,
            else `cuda`; `reference` is the slow oracle, on any device, which also stands in, and says so, on a GPU
            for which no kernel can be compiled.

    Returns:
        A SplatImage in the widest dtype of the first five tensors, at least float32. Gradients reach
        means, quats, scales, opacities, colours and screen_offsets.

    Raises:
        DataError: a shape, dtype, device, option or value is wrong; one line says which.
        DeviceError: the backend asked for does not fit the tensors' device.
        DependencyError: the package of the backend that is asked for, gsplat or numba-cuda, is missing.
    """
    _check_tensors(means, quats, scales, opacities, colours, viewmat, K, screen_offsets)
    _check_options(width, height, near, low_pass, alpha_min, alpha_max, t_min)
    degree = _degree(colours, sh_degree)
    dtype = torch.float32
    for tensor in (means, quats, scales, opacities, colours):
        dtype = torch.promote_types(dtype, tensor.dtype)
    settings = SplatSettings(width, height, alpha_min, alpha_max, t_min)
    backend = _resolve(backend, means.device)
    project, shade, blend = project_gaussians, harmonic_colours, blend_reference
    if backend == "cpu":
        from nbavatar.rendering.gaussians.cpu import blend_cpu as blend  # Numba is loaded only when it is needed

        if means.device.type == "cpu":
            from nbavatar.rendering.gaussians.cpu_projection import harmonic_colours_cpu as shade
            from nbavatar.rendering.gaussians.cpu_projection import project_gaussians_cpu as project
    elif backend == "cuda":
        from nbavatar.rendering.gaussians.cuda import blend_cuda as blend  # a machine without CUDA never gets here
    rgb = colours
    if degree is not None:
        offsets = means.double() - camera_centre(viewmat.detach().double())
        rgb = shade(colours.to(dtype), offsets, degree)
    if backend == "gsplat":
        from nbavatar.rendering.gaussians.gsplat_backend import render_gsplat

        rendered = render_gsplat(
            means, quats, scales, opacities, rgb, viewmat, K, settings, near=near, low_pass=low_pass,
            screen_offsets=screen_offsets,
        )  # fmt: skip
        return SplatImage(*(tensor.to(dtype) for tensor in rendered))
    projection = project(
        means, quats, scales, viewmat, K, width, height, near=near, low_pass=low_pass, screen_offsets=screen_offsets
    )
    rank = canonical_rank(projection.depth, means, quats, scales, colours, opacities)
    image, alpha = blend(projection, rank, opacities.to(dtype), rgb.to(dtype), settings)
    return SplatImage(image.to(dtype), alpha.to(dtype), projection.radii.to(dtype))


def _resolve(name: str, device: torch.device) -> str:
    """The backend that a name stands for on a device."""
    if name not in _BACKENDS:
        raise DataError.of(_WHERE, "backend", expected=f"one of {', '.join(_BACKENDS)}", found=repr(name))
    on_gpu = device.type == "cuda"
    if name == "auto" and on_gpu and importlib.util.find_spec("gsplat") is None:
        try:
            import nbavatar.rendering.gaussians.cuda  # noqa: F401  (raises where it cannot be used)
        except DependencyError as error:
            announce_plain_torch("Gaussians", error)
            return "reference"
        return "cuda"
    if name == "auto":
        return "gsplat" if on_gpu else "cpu"
    simulated = name == "cuda" and os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"
    if name in ("gsplat", "cuda") and not (on_gpu or simulated):
        raise DeviceError.of(_WHERE, "backend", expected=f"tensors on cuda for '{name}'",
                             found=f"tensors on {device.type}")  # fmt: skip
    return name


def _degree(colours: Tensor, sh_degree: int | None) -> int | None:
    """Degree of the harmonics that is used, or None for plain colours."""
    if colours.ndim == 2:
        if sh_degree is not None:
            raise DataError.of(_WHERE, "sh_degree", expected="None with colours of shape (N, 3)", found=sh_degree)
        return None
    count = colours.shape[1]
    if sh_degree is None:
        for degree in DEGREES:
            if harmonic_count(degree) == count:
                return degree
        raise DataError.of(_WHERE, "colours", expected="1, 4, 9 or 16 coefficients", found=count,
                           fix="or say sh_degree")  # fmt: skip
    if sh_degree not in DEGREES or harmonic_count(sh_degree) > count:
        raise DataError.of(_WHERE, "sh_degree", expected=f"0 to 3 with at most {count} coefficients", found=sh_degree)
    return sh_degree


def _check_tensors(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colours: Tensor, viewmat: Tensor, K: Tensor,
    screen_offsets: Tensor | None,
) -> None:  # fmt: skip
    named = {
        "means": means, "quats": quats, "scales": scales, "opacities": opacities, "colours": colours,
        "viewmat": viewmat, "K": K,
    }  # fmt: skip
    if screen_offsets is not None:
        named["screen_offsets"] = screen_offsets
    for name, value in named.items():
        if not isinstance(value, Tensor) or not value.is_floating_point():
            found = f"{value.dtype} tensor" if isinstance(value, Tensor) else type(value).__name__
            raise DataError.of(_WHERE, name, expected="a floating-point tensor", found=found)
        if value.device != means.device:
            raise DataError.of(_WHERE, name, expected=f"device {means.device} as means", found=str(value.device))
    count = means.shape[0] if means.ndim else 0
    shapes = {"means": (count, 3), "quats": (count, 4), "scales": (count, 3), "opacities": (count,),
              "viewmat": (4, 4), "K": (3, 3), "screen_offsets": (count, 2)}  # fmt: skip
    for name, value in named.items():
        if name != "colours" and tuple(value.shape) != shapes[name]:
            raise DataError.of(_WHERE, name, expected=f"shape {shapes[name]}", found=f"shape {tuple(value.shape)}")
    if colours.ndim not in (2, 3) or colours.shape[0] != count or colours.shape[-1] != 3 or 0 in colours.shape[1:]:
        raise DataError.of(_WHERE, "colours", expected=f"shape ({count}, 3) or ({count}, K, 3)",
                           found=f"shape {tuple(colours.shape)}")  # fmt: skip
    if means.device.type == "cpu":  # on a GPU the check would stall the stream
        _check_values(named)


def _check_values(named: dict[str, Tensor]) -> None:
    for name, value in named.items():
        # a sum is finite only if all are; it may also overflow, so it only settles the good case
        if not bool(torch.isfinite(value.detach().sum())):
            _refuse_rows(name, ~torch.isfinite(value.detach()), "finite values", "NaN or infinity")
    _refuse_rows("quats", (named["quats"].detach() == 0).all(-1), "no zero quaternion", "one")
    scales, opacities = named["scales"].detach(), named["opacities"].detach()
    for name, value, largest in (("scales", scales, _LARGEST), ("opacities", opacities, 1.0)):
        if value.numel() and not 0 <= float(value.min()) <= float(value.max()) <= largest:
            _refuse_rows(name, (value < 0) | (value > largest), f"values in [0, {largest:g}]", "another")
    K = named["K"].detach()
    if bool((K[[1, 2, 2], [0, 0, 1]] != 0).any()) or float(K[2, 2]) != 1 or bool((K[[0, 1], [0, 1]] <= 0).any()):
        raise DataError.of(_WHERE, "K", expected="upper triangular, positive focal lengths, last row 0 0 1",
                           found=str(K.tolist()))  # fmt: skip


def _refuse_rows(name: str, bad: Tensor, expected: str, found: str) -> None:
    if bool(bad.any()):
        row = int(bad.nonzero()[0, 0])
        raise DataError.of(_WHERE, name, expected=expected, found=f"{found} in row {row}")


def _check_options(
    width: int, height: int, near: float, low_pass: float, alpha_min: float, alpha_max: float, t_min: float
) -> None:
    checks = {
        "width": (width >= 1, "at least 1", width),
        "height": (height >= 1, "at least 1", height),
        "near": (0 < near < float("inf"), "a positive distance", near),
        "low_pass": (0 <= low_pass < float("inf"), "a variance in square pixels, at least 0", low_pass),
        "alpha_min": (0 <= alpha_min < 1, "a number in [0, 1)", alpha_min),
        "alpha_max": (0 < alpha_max <= 1, "a number in (0, 1]", alpha_max),
        "t_min": (0 <= t_min < 1, "a number in [0, 1)", t_min),
    }
    for name, (good, expected, found) in checks.items():
        if not good:
            raise DataError.of(_WHERE, name, expected=expected, found=found)
