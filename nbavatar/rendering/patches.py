"""Planar patches seen from one camera: what binning and blending take, whatever was projected."""

from dataclasses import dataclass

from torch import Tensor

__all__ = ["ProjectedPatches"]


@dataclass(frozen=True)
class ProjectedPatches:
    """F patches in one camera; how u, v and depth at a pixel follow from `plane` is said in `billboards/projection.py`.

    Attributes:
        plane: (F, 3, 3) float64, the matrix P; differentiable.
        fade: (F,) float64 factor on alpha from the low-pass, in (0, 1]; differentiable.
        depth: (F,) float64 depth of the centre [m].
        nearest: (F,) float64 lower bound of the depth of any hit [m], at least `near`.
        bounds: (F, 4) float64 tight box `x0, y0, x1, y1` of the support [px]; `x0 > x1` where the
            patch cannot be seen.
    """

    plane: Tensor
    fade: Tensor
    depth: Tensor
    nearest: Tensor
    bounds: Tensor
