import cv2
import numpy as np

from nbavatar.preprocess.clean import clean_labels, repair_flicker, spread_labels, threshold_matte

OPTIONS = {"hole_fraction": 0.01, "island_fraction": 0.05}


def disc(size, x, y, radius):
    rows, columns = np.mgrid[:size, :size]
    return np.hypot(columns - x, rows - y) <= radius


def test_lossy_mattes_are_recovered():
    """JPEG stands for the codec: same ringing, same blocks."""
    truth = disc(128, 60, 64, 40)
    for quality in (20, 50, 90):
        _, coded = cv2.imencode(".jpg", np.where(truth, 255, 0).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
        found = threshold_matte(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), 127)
        assert (found & truth).sum() / (found | truth).sum() > 0.985


def test_threshold_is_exclusive():
    assert not threshold_matte(np.full((8, 8), 127, np.uint8), 127).any()
    assert threshold_matte(np.full((8, 8), 128, np.uint8), 127).all()


def test_small_holes_within_the_mesh_are_filled_and_others_stay():
    label = disc(128, 64, 64, 50).astype(np.uint8)
    support = label.copy()
    label[60:64, 60:64] = 0  # in the cheek: a fault
    label[90:94, 60:64] = 0  # mesh says nothing there: real
    support[88:96, 58:66] = 0
    label[30:50, 50:80] = 0  # large: not ours to judge
    clean = clean_labels(label, support, **OPTIONS)
    assert (clean[60:64, 60:64] == 1).all() and not clean[90:94, 60:64].any() and not clean[30:50, 50:80].any()


def test_holes_are_filled_with_the_part_the_mesh_shows():
    label = np.zeros((64, 64), np.uint8)
    label[8:56, 8:32], label[8:56, 32:56] = 1, 2
    support = label.copy()
    label[30:33, 30:34] = 0
    clean = clean_labels(label, support, **OPTIONS)
    np.testing.assert_array_equal(clean, support)


def test_islands_are_removed_unless_their_mesh_is_there():
    label = disc(128, 60, 64, 40).astype(np.uint8)
    support = label.copy()
    label[5:8, 100:104] = 1
    label[120:124, 100:104] = 1
    support[119:125, 99:105] = 1
    clean = clean_labels(label, support, **OPTIONS)
    assert not clean[5:8, 100:104].any() and (clean[120:124, 100:104] == 1).all()
    label[:] = 0
    assert not clean_labels(label, support, **OPTIONS).any()


def test_what_says_nothing_is_no_hole_and_cuts_nothing_off():
    """A tuft of hair beyond a headband, and a microphone in front of a mouth."""
    label = np.zeros((80, 80), np.uint8)
    label[20:70, 20:60] = 1
    label[15:20, 20:60] = 255
    label[8:15, 35:42] = 1
    label[50:53, 40:43] = 255
    support = np.where(label == 1, 1, 0).astype(np.uint8)
    support[:20] = 0
    support[50:53, 40:43] = 1
    found = clean_labels(label, support, hole_fraction=0.01, island_fraction=0.05)
    np.testing.assert_array_equal(found, label)
    label[15:20] = 0  # without the band the tuft is an island that no mesh explains
    assert not clean_labels(label, support, hole_fraction=0.01, island_fraction=0.05)[:20].any()


def test_flicker_of_one_frame_is_repaired_where_the_mesh_agrees():
    still = np.zeros((32, 32), np.uint8)
    still[4:28, 4:28] = 1
    support = still.copy()
    broken = still.copy()
    broken[10:14, 10:14] = 0  # a hole that flashes
    np.testing.assert_array_equal(repair_flicker(still, broken, still, support), still)
    moved = np.zeros_like(still)
    moved[4:28, 10:32] = 1
    np.testing.assert_array_equal(repair_flicker(still, moved, still, moved), moved)
    hair = still.copy()
    hair[0:4, 4:28] = 1  # no mesh there
    np.testing.assert_array_equal(repair_flicker(still, hair, still, support), hair)


def test_labels_spread_to_the_nearest():
    label = np.zeros((40, 60), np.uint8)
    label[20, 10], label[20, 50] = 1, 3
    spread = spread_labels(label)
    assert (spread[:, :29] == 1).all() and (spread[:, 32:] == 3).all()
    assert not spread_labels(np.zeros_like(label)).any()
