"""Masks, crops, resizing and compositing of images."""
