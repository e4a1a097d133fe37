"""Rotations and rigid transforms in torch."""
