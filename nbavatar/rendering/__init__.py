"""Differentiable rasterizers of billboards and of 3D Gaussians, and what they share: tiles, binning, order, sorting."""
