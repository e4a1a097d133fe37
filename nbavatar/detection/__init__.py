"""Keypoints of faces and hands found in images, for captures that bring none."""
