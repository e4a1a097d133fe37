"""Compilation of this package's kernels: as the billboard rasterizer's, kept in a folder of its own."""

from functools import partial
from pathlib import Path

from nbavatar.kernels import keep_kernels
from nbavatar.raster.compile import SOURCES, inlined, kernel
from nbavatar.raster.compile import prepare as _prepare

__all__ = ["inlined", "kernel", "prepare"]

_HERE = Path(__file__).parent
_OWN = ("cpu_kernels.py", "geometry_kernels.py", "lanes.py", "projection.py", "spherical_harmonics.py")
keep_kernels(_HERE, (*SOURCES, *(_HERE / name for name in _OWN)))
prepare = partial(_prepare, package=_HERE)
