"""Compilation of this package's kernels: as the billboard rasterizer's, kept in a folder of its own."""

from functools import partial
from pathlib import Path

from nbavatar.raster.compile import inlined, keep_kernels, kernel
from nbavatar.raster.compile import prepare as _prepare

__all__ = ["inlined", "kernel", "prepare"]

_HERE = Path(__file__).parent
keep_kernels(_HERE, ("cpu_kernels.py", "geometry_kernels.py", "lanes.py", "projection.py", "spherical_harmonics.py"))
prepare = partial(_prepare, package=_HERE)
