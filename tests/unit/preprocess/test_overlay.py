import numpy as np

from nbavatar.preprocess.overlay import PART_COLORS, contact_sheet, mask_outline, shade


def test_a_mesh_is_laid_over_its_pixels_only():
    image = np.full((40, 60, 3), 100, np.uint8)
    face = np.full((40, 60), -1)
    face[10:20, 10:30] = 1
    over = shade(image, face, np.array([[0, 0, 1.0], [0, 0, -1.0]]), np.array([1, 2], np.uint8), strength=1.0)
    np.testing.assert_array_equal(over[face < 0], 100)
    np.testing.assert_array_equal(over[face == 1], np.broadcast_to(PART_COLORS[2].astype(np.uint8), (200, 3)))
    assert (shade(image, face, np.eye(3)[:2], np.array([1, 1], np.uint8), strength=0.0) == 100).all()


def test_edges_between_faces_show():
    face = np.zeros((10, 10), int)
    face[:, 5:] = 1
    over = shade(np.zeros((10, 10, 3), np.uint8), face, np.array([[0, 0, 1.0]] * 2), np.ones(2, np.uint8))
    assert (over[:, 5] < over[:, 6]).any() and (over[:, 4] == over[:, 6]).all()


def test_outlines_run_along_each_part():
    label = np.zeros((40, 60), np.uint8)
    label[5:30, 5:30], label[5:30, 30:50] = 1, 2
    drawn = (mask_outline(np.zeros((40, 60, 3), np.uint8), label) > 0).any(-1)
    assert drawn[5, 5:50].all() and drawn[5:30, 29].all() and drawn[5:30, 30].all() and not drawn[15, 15]


def test_sheets_hold_every_picture_at_its_shape():
    wide, tall = np.full((20, 40, 3), 200, np.uint8), np.full((40, 20, 3), 90, np.uint8)
    sheet = contact_sheet([[("wide", wide), ("wide", wide)], [("tall", tall)]], cell=80)
    assert sheet.shape == (18 + 40 + 18 + 80, 160, 3)
    assert (sheet[18:58] == 200).all() and (sheet[76:, 20:60] == 90).all() and (sheet[76:, 80:] == 24).all()
    assert contact_sheet([], cell=10).size > 0
