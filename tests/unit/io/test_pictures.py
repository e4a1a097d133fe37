"""Pictures as users bring them: kinds of files, depths, palettes, alpha, orientation."""

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from nbavatar.errors import DataError
from nbavatar.io import pictures
from nbavatar.io.pictures import read_colours, read_plane

LABELS = np.array([[0, 1, 2, 3, 0, 1, 1], [2, 2, 2, 0, 0, 1, 3]], np.uint8)


@pytest.fixture
def colours(rng):
    return rng.integers(0, 256, (6, 9, 3)).astype(np.uint8)


@pytest.mark.parametrize("orientation", range(10))
def test_exif_orientation_is_applied(tmp_path, colours, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(colours).save(tmp_path / "a.png", exif=exif)
    expected = np.array(ImageOps.exif_transpose(Image.open(tmp_path / "a.png")))
    height, width = expected.shape[:2]
    np.testing.assert_array_equal(read_colours(tmp_path / "a.png", (width, height)), expected)
    if 4 < orientation < 9:
        with pytest.raises(DataError, match=rf"expected 9 x 6 .* 6 x 9, turned by its EXIF orientation {orientation}"):
            read_colours(tmp_path / "a.png", (9, 6))


def test_sixteen_bits_are_scaled_and_not_cut_off(tmp_path, colours):
    cv2.imwrite(str(tmp_path / "rgb.png"), colours[..., ::-1].astype(np.uint16) * 257)
    np.testing.assert_array_equal(read_colours(tmp_path / "rgb.png"), colours)
    grey = colours[..., 0].astype(np.uint16) * 257
    Image.fromarray(grey).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_colours(tmp_path / "grey.png"), np.repeat(colours[..., :1], 3, axis=2))
    np.testing.assert_array_equal(read_plane(tmp_path / "grey.png").values, grey)


def test_palettes_are_colours_or_labels_or_greys(tmp_path):
    palette = np.array([[0, 0, 0], [200, 30, 30], [30, 200, 30], [30, 30, 200]], np.uint8)
    image = Image.fromarray(LABELS, "P")
    image.putpalette(palette.tobytes())
    image.save(tmp_path / "colours.png")
    np.testing.assert_array_equal(read_colours(tmp_path / "colours.png"), palette[LABELS])
    np.testing.assert_array_equal(read_plane(tmp_path / "colours.png").values, LABELS)
    # A matte with a palette that puts white first, as programs that make files small write it.
    image = Image.fromarray((LABELS > 0).astype(np.uint8), "P")
    image.putpalette(bytes([255, 255, 255, 0, 0, 0]))
    image.save(tmp_path / "greys.png")
    np.testing.assert_array_equal(read_plane(tmp_path / "greys.png").values, np.where(LABELS > 0, 0, 255))


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P"])
def test_an_alpha_channel_that_varies_is_the_matte(tmp_path, colours, mode):
    alpha = np.arange(54, dtype=np.uint8).reshape(6, 9) * 4
    image = Image.fromarray(np.dstack([colours, alpha]))
    if mode == "P":  # one index is transparent
        image = Image.fromarray((alpha > 100).astype(np.uint8), "P")
        image.putpalette(bytes([10, 200, 30, 200, 10, 30]))
        image.save(tmp_path / "a.png", transparency=0)
        expected = np.where(alpha > 100, 255, 0)
    else:
        image.convert(mode).save(tmp_path / "a.png")
        expected = alpha
    np.testing.assert_array_equal(read_plane(tmp_path / "a.png").values, expected)
    if mode == "RGBA":
        np.testing.assert_array_equal(read_colours(tmp_path / "a.png"), colours)


def test_an_alpha_channel_that_is_full_everywhere_says_nothing(tmp_path):
    Image.fromarray(np.dstack([LABELS, np.full_like(LABELS, 255)]), "LA").save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_plane(tmp_path / "a.png").values, LABELS)


def test_colours_are_no_plane_and_greys_in_three_channels_are(tmp_path, colours):
    Image.fromarray(colours).save(tmp_path / "a.png")
    with pytest.raises(DataError, match="expected one value a pixel, found colours: "):
        read_plane(tmp_path / "a.png")
    Image.fromarray(np.dstack([LABELS, 0 * LABELS, 0 * LABELS])).save(tmp_path / "a.png")
    with pytest.raises(DataError, match=r"found colours: \(1, 0, 0\), \(2, 0, 0\), \(3, 0, 0\)"):
        read_plane(tmp_path / "a.png")
    Image.fromarray(np.dstack([LABELS] * 3)).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_plane(tmp_path / "a.png").values, LABELS)
    matte = np.zeros((32, 32), np.uint8)
    matte[8:24, 8:24] = 255
    Image.fromarray(np.dstack([matte] * 3)).save(tmp_path / "a.jpg", quality=60)
    plane = read_plane(tmp_path / "a.jpg")
    assert plane.lossy and np.abs(plane.values.astype(int) - matte).max() < 40


@pytest.mark.parametrize(
    ("name", "lossy", "options"),
    [("a.png", False, {}), ("a.jpg", True, {}), ("a.webp", True, {}), ("a.webp", False, {"lossless": True})],
)
def test_formats_that_change_values_are_known(tmp_path, name, lossy, options):
    Image.fromarray(np.dstack([LABELS] * 3)).save(tmp_path / name, **options)
    assert read_plane(tmp_path / name).lossy is lossy


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 6\nshowpage\n", "PostScript"),
        (
            b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n",
            "a pointer of Git LFS in its place; .* git lfs pull",
        ),
        (b"", "an empty file"),
        (b"<html>404</html>", "text"),
        (b"II*\x00 and so on", "a TIFF; convert it to png"),
        (b"\x00\x00\x00\x1cftypheic", "an AVIF or HEIC picture"),
        (b"garbage", "another kind of file"),
        (b"\x89PNG\r\n\x1a\n", "one that does not decode"),
    ],
)
@pytest.mark.parametrize("read", [read_colours, read_plane])
def test_what_is_no_picture_is_not_handed_to_another_program(tmp_path, monkeypatch, content, found, read):
    def refuse(*_, **__):
        raise AssertionError("a program was started")

    monkeypatch.setattr("subprocess.Popen", refuse)
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(DataError, match=rf"a\.png: expected a whole image.*, found {found}") as error:
        read(tmp_path / "a.png")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["png", "jpg", "webp"])
def test_a_picture_that_ends_early_is_named(tmp_path, colours, kind):
    path = tmp_path / f"a.{kind}"
    Image.fromarray(np.tile(colours, (20, 20, 1))).save(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(DataError, match=rf"a\.{kind}: expected a whole image"):
        read_colours(path)


def test_sizes_are_bounded_before_anything_is_decoded(tmp_path, monkeypatch, colours):
    Image.fromarray(colours).save(tmp_path / "a.png")
    monkeypatch.setattr(pictures, "MOST_PIXELS", 53)
    monkeypatch.setattr(Image.Image, "convert", None)
    with pytest.raises(DataError, match="size: expected at most 53 pixels, found 9 x 6"):
        read_colours(tmp_path / "a.png")


def test_moving_pictures_are_refused(tmp_path, colours):
    first = Image.fromarray(colours)
    first.save(tmp_path / "a.png", save_all=True, append_images=[first.rotate(180)])
    with pytest.raises(DataError, match="expected a still image, found a moving one"):
        read_colours(tmp_path / "a.png")
