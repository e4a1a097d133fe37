"""Directions: evenness by what a face gets of equal lights, axes by what a rotation is."""

import numpy as np

from nbavatar.math.directions import axes_along, sphere_directions
from tests.unit.mesh.shapes import sphere


def test_directions_are_even() -> None:
    directions = sphere_directions(256)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    # A face gets a quarter of a light that comes equally from everywhere, however it is turned.
    normals = sphere(2)[0]
    np.testing.assert_allclose(np.maximum(directions @ normals.T, 0).mean(0), 0.25, atol=2e-3)


def test_axes_are_rotations_whose_third_row_is_the_direction() -> None:
    poles = np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0], [0.6, -0.8, 0.0]]])
    directions = np.concatenate([poles, sphere_directions(500)])
    axes = axes_along(directions)
    np.testing.assert_array_equal(axes[:, 2], directions)
    # A few roundings.
    np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), np.broadcast_to(np.eye(3), axes.shape), atol=4e-15)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=4e-15)
