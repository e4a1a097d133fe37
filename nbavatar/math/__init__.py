"""Rotations and windows over pictures in torch, directions in numpy."""
