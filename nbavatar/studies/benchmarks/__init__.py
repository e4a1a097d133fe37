"""Benchmarks of single kernels on realistic scenes; each module has `add_arguments` and `run`."""
