"""Differentiable rasterizer of textured billboards."""

from nbavatar.raster.functional import render_billboards

__all__ = ["render_billboards"]
