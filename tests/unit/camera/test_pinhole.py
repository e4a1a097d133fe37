import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nbavatar.camera.pinhole import crop_intrinsics, project, scale_intrinsics

K = np.array([[500.0, 0.3, 210.5], [0, 480.0, 160.25], [0, 0, 1]])


def _pose(rng):
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng.integers(1 << 30)).as_matrix()
    pose[:3, 3] = rng.normal(size=3)
    return pose


def test_project_agrees_with_opencv(rng):
    cv2 = pytest.importorskip("cv2")
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]
    pose[:3, 3] = [0.02, -0.1, 1.5]
    points = rng.normal(scale=0.1, size=(20, 3))
    plain = K.copy()
    plain[0, 1] = 0  # OpenCV has no skew
    pixels, depth = project(points, plain, pose)
    expected = cv2.projectPoints(points, pose[:3, :3], pose[:3, 3], plain, None)[0][:, 0]
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(depth, (points @ pose[:3, :3].T + pose[:3, 3])[:, 2])


def test_project_is_the_same_for_torch_and_for_batches(rng):
    points = rng.normal(scale=0.1, size=(4, 7, 3)) + [0, 0, 2]
    poses = np.stack([np.eye(4)] * 4)
    pixels, depth = project(torch.tensor(points), torch.tensor(K), torch.tensor(poses))
    for i in range(4):
        expected, expected_depth = project(points[i], K, poses[i])
        np.testing.assert_allclose(pixels[i].numpy(), expected)
        np.testing.assert_allclose(depth[i].numpy(), expected_depth)


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.1, 4), st.floats(0.1, 4))
def test_crop_and_scale_move_projected_points_like_the_pixels(x0, y0, sx, sy):
    points = np.array([[0.1, -0.05, 1.0], [-0.3, 0.2, 2.0]])
    pixels, _ = project(points, K, np.eye(4))
    moved, _ = project(points, scale_intrinsics(crop_intrinsics(K, x0, y0), sx, sy), np.eye(4))
    np.testing.assert_allclose(moved, (pixels - [x0, y0]) * [sx, sy], atol=1e-9)


def test_scale_agrees_with_where_area_averaging_puts_a_block():
    # A 2x2 block of pixels at columns 4..5, rows 6..7 has its centre at (5, 7); halved, it is pixel (2, 3), whose
    # centre is (2.5, 3.5).
    ray = np.linalg.inv(K) @ [5.0, 7.0, 1.0]
    pixels, _ = project(ray[None], scale_intrinsics(K, 0.5, 0.5), np.eye(4))
    np.testing.assert_allclose(pixels[0], [2.5, 3.5], atol=1e-12)
