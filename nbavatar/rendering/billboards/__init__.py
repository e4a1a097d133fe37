"""Differentiable rasterizer of textured billboards."""

from nbavatar.rendering.billboards.functional import render_billboards

__all__ = ["render_billboards"]
