"""Differentiable rasterizer of 3D Gaussians."""

from nbavatar.splat.functional import SplatImage, render_gaussians

__all__ = ["SplatImage", "render_gaussians"]
