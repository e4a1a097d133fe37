"""Differentiable rasterizer of 3D Gaussians."""

from nbavatar.rendering.gaussians.functional import SplatImage, render_gaussians

__all__ = ["SplatImage", "render_gaussians"]
