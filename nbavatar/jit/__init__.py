"""Numba on the CPU: compiling kernels, keeping what was compiled, vectors of pixels, memory, threads."""
