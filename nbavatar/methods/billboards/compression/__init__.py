"""Smaller models of trained billboards: fewer of them, smaller textures."""
