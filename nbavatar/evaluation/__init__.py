"""Rendering of protocols, image metrics per frame, and timing of a trained avatar."""
