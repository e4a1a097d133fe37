"""Datasets: readers of the two layouts, sequences of meshes, splits, synthetic subjects."""
