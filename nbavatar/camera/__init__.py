"""Pinhole cameras, intrinsics and distortion."""
