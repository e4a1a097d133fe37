"""What the values of masks mean: labels, mattes of any scale, and what is neither."""

import cv2
import numpy as np
import pytest

from nbavatar.errors import DataError
from nbavatar.preprocess.mask_values import Meaning, ValueSurvey

BOTH = ("head", "right_hand")


def scene(radius=30):
    """Labels of a large disc and a small one beside it."""
    y, x = np.mgrid[:96, :128]
    label = np.where((x - 50) ** 2 + (y - 45) ** 2 < radius**2, 1, 0)
    return np.where((x - 95) ** 2 + (y - 60) ** 2 < 14**2, 2, label).astype(np.uint8)


def soft(label, sigma=1.5):
    return cv2.GaussianBlur(np.where(label > 0, 255, 0).astype(np.uint8), (0, 0), sigma)


def meaning(*pictures, lossy=False, parts=BOTH):
    survey = ValueSurvey()
    for number, values in enumerate(pictures):
        survey.add(np.asarray(values), lossy, f"t{number}.png")
    return survey.masks("masks/left", parts)


EMPTY = np.zeros((96, 128), np.uint8)
PERSON = (scene() > 0).astype(np.uint8)


@pytest.mark.parametrize(
    ("pictures", "parts"),
    [
        ([scene()], BOTH),
        ([scene(), EMPTY], BOTH),
        ([EMPTY], BOTH),
        ([PERSON], ("head",)),
        ([PERSON * 2], ("right_hand",)),
        ([PERSON * 3, PERSON], BOTH),
        ([scene().astype(np.uint16)], BOTH),
    ],
)
def test_labels(pictures, parts):
    found = meaning(*pictures, parts=parts)
    assert found == Meaning("label", 0)
    np.testing.assert_array_equal(found.read(pictures[0], "x"), pictures[0])


COLLAR = np.where(np.arange(96)[:, None] > 60, np.uint8(255), scene())


@pytest.mark.parametrize(
    "pictures",
    [
        [COLLAR],
        [scene(), COLLAR],
        [COLLAR, EMPTY, np.where(COLLAR == 255, COLLAR, EMPTY)],
        [COLLAR.astype(np.uint16)],
        [np.where(soft(scene()) % 255, 255, scene()).astype(np.uint8)],  # along outlines, as in PASCAL VOC
        [np.array([0, 1, 255], np.uint8)[scene()]],
    ],
)
def test_among_labels_255_says_nothing(pictures):
    found = meaning(*pictures)
    assert found == Meaning("label", 0, unseen=True)
    np.testing.assert_array_equal(found.read(pictures[0], "x"), pictures[0])
    with pytest.raises(DataError, match=r"t9\.png: values: expected labels 0..3, found 254"):
        found.read(np.array([[0, 254, 255]], np.uint8), "t9.png")


def test_strays_in_a_hard_matte_make_it_no_labels():
    """A head that is small beside a garment is a part; a pixel or two are none."""
    large = np.zeros((600, 800), np.uint8)
    large[300:, 100:700] = 255
    small = large.copy()
    small[250:270, 400:415] = 1
    assert meaning(small).unseen and meaning(large, small).unseen
    stray = large.copy()
    stray[250, 400:402] = 1
    assert meaning(stray) == meaning(large) == Meaning("person", 255)


@pytest.mark.parametrize(
    ("picture", "white"),
    [
        (PERSON, 1),
        (PERSON * 100, 100),
        (PERSON * 15, 15),
        (PERSON * 128, 128),
        (PERSON * 200, 200),
        (PERSON * 255, 255),
        (PERSON.astype(np.uint16) * 65535, 65535),
        (PERSON.astype(np.uint16) * 1023, 1023),
        (PERSON.astype(np.uint16) * 255, 255),
        ((soft(scene()).astype(int) * 100 // 255).astype(np.uint8), 100),
        (soft(scene()), 255),
        (soft(scene(), 4), 255),
        (soft(scene()) // 16 * 16, 255),
        ((soft(scene()).astype(int) * 240 // 255).astype(np.uint8), 255),
        (soft(scene()).astype(np.uint16) * 257, 65535),
        (soft(scene()).astype(np.uint16) * 4, 1020),
        (cv2.resize(PERSON * 255, (64, 48), interpolation=cv2.INTER_AREA), 255),
    ],
)
def test_mattes_of_any_scale_become_the_same(picture, white):
    found = meaning(picture, np.zeros_like(picture))
    assert found == Meaning("person", white)
    scaled = found.read(picture, "x")
    exact = np.clip(np.rint(picture.astype(float) * 255 / white), 0, 255)
    assert scaled.dtype == np.uint8 and np.abs(scaled - exact).max() <= 1  # halves are rounded either way
    # The threshold at half way says the same of all of them, whatever they are stored as.
    np.testing.assert_array_equal(scaled > 127, picture > white * 127 / 255)


def test_a_matte_of_8_bits_is_left_as_it_is():
    picture = soft(scene())
    assert meaning(picture).read(picture, "x") is picture


def lossy(picture, quality=60):
    _, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)


def test_lossy_mattes():
    assert meaning(lossy(PERSON * 255), lossy(EMPTY), lossy=True) == Meaning("person", 255)
    assert meaning(EMPTY, EMPTY + (np.arange(128) % 9 == 0), lossy=True, parts=("head",)).kind == "person", "noise"


PARSING = np.array([0, 1, 10], np.uint8)[scene()]


@pytest.mark.parametrize(
    ("pictures", "was_lossy", "found"),
    [
        ([PARSING], False, "the values 0, 1, 10; store 0 background, 1 head"),
        (
            [np.arange(19, dtype=np.uint8).repeat(64).reshape(32, 38)],
            False,
            "the values 0, 1, 2, 3, 4, 5, 6, 7 and 11 ",
        ),
        ([scene() * 85], False, "the values 0, 85, 170; they look like labels times 85: divide"),
        ([scene() * 64], False, "the values 0, 64, 128; they look like labels times 64"),
        ([scene() * 127], False, "the values 0, 127, 254; they look like labels times 127"),
        ([scene() * 2], False, "the values 0, 2, 4; they look like labels times 2"),
        ([np.array([0, 255, 128], np.uint8)[scene()]], False, "the values 0, 128, 255"),
        ([np.array([0, 1, 255, 4], np.uint8)[scene() + (COLLAR == 255)]], False, "the values 0, 1, 4, 255"),
        ([np.pad(PARSING, 4, constant_values=255)], False, "the values 0, 1, 10, 255"),
        ([scene() + 2 * PERSON], False, "the values 0, 3, 4"),
        ([scene().astype(np.uint16) * 20000], False, "the values 0, 20000, 40000; they look like labels times 20000"),
        ([scene(), PERSON * 255], False, "1 of 2 masks with values above 3, and labels in t0.png"),
        ([PERSON, PERSON * 255], False, "1 of 2 masks with values above 3, and labels in t0.png"),
        ([lossy(scene() * 85)], True, "the values 0, .* others"),
        ([lossy(scene() * 4)], True, "the values 0, "),
        ([scene()], True, "the values 0, 1, 2 in a lossy format"),
        ([np.random.default_rng(0).integers(40, 210, (96, 128)).astype(np.uint8)], False, "the values .* others"),
        ([np.tile(np.arange(128, dtype=np.uint8), (96, 1)) * 2], False, "the values .* others"),
    ],
)
def test_what_is_neither_is_refused_with_the_values_found(pictures, was_lossy, found):
    with pytest.raises(DataError, match=f"masks/left.*{found}") as error:
        meaning(*pictures, lossy=was_lossy)
    assert "\n" not in str(error.value)


def test_a_hand_that_shows_in_a_few_frames_only_is_still_a_label():
    head = np.where(scene() == 1, 1, 0).astype(np.uint8)
    with pytest.raises(DataError, match="the values 0, 85, 170"):
        meaning(*[head * 85] * 40, scene() * 85)


def test_a_label_above_3_in_a_picture_that_was_not_looked_at_is_named():
    with pytest.raises(DataError, match=r"t9\.png: values: expected labels 0..3, found 7"):
        Meaning("label", 0).read(np.full((2, 2), 7, np.uint8), "t9.png")


@pytest.mark.parametrize(
    ("picture", "white"),
    [
        (PERSON, 1),
        (PERSON * 3, 3),
        (PERSON * 100, 100),
        (soft(scene(), 6), 255),
        (soft(scene()).astype(np.uint16) * 257, 65535),
        (np.where(np.arange(128) < 20, np.uint8(77), PERSON * 255), 255),  # a veil
        (EMPTY, 255),
    ],
)
def test_alpha_is_coverage_whatever_its_values(picture, white):
    survey = ValueSurvey()
    survey.add(picture, False, "t0.png")
    assert survey.coverage("alpha/left") == Meaning("person", white)


@pytest.mark.parametrize("picture", [scene(), scene() * 85, PARSING])
def test_labels_are_no_coverage(picture):
    survey = ValueSurvey()
    survey.add(picture, False, "t0.png")
    with pytest.raises(DataError, match=r"alpha/left: values: expected coverage.* found the values 0, "):
        survey.coverage("alpha/left")
