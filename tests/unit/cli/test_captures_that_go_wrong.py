"""Captures as they come: what is right in another form gives the same result, what is wrong is refused by every verb.

SAME, PERSON: `check` passes, and tracks, ingest and masks give what the sound capture gives. LOUD: `check` and the
first of those verbs that reads the fault end with exit code 2 and one line, and write nothing.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nbavatar.cli import main
from nbavatar.data.sequences import read_sequence
from nbavatar.io.framepack import FramePack

FRAMES = [f"t{i}" for i in range(5)]
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:%064d\nsize 9876\n" % 0


def chain(capture, out, camera="left"):
    """Runs the verbs that read a capture; the first that fails, and what they made."""
    common = ["--layout", "capture", "--root", str(capture), "--subject", "me"]
    tracks, frames, masks = out / "t.npz", out / f"{camera}.zip", out / f"m-{camera}.zip"
    for words in (
        ["tracks", *common, "--out", str(tracks)],
        ["ingest", *common, "--camera", camera, "--out", str(frames)],
        ["masks", "--frames", str(frames), "--meshes", str(tracks), "--out", str(masks)],
    ):
        if main(words):
            assert not Path(words[-1]).exists(), "no partial output"
            return words[0], None
    sequence, _ = read_sequence(tracks)
    with FramePack(frames) as pack, FramePack(masks) as cut:
        made = {
            frame: (pack.read("rgb", frame), cut.read("label", frame), cut.read("alpha", frame)) for frame in FRAMES
        }
    return None, (sequence, made)


def lines(capfd):
    return [line for line in capfd.readouterr().err.splitlines() if "error:" in line]


def rewrite(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def cameras(change):
    return lambda c: rewrite(c / "cameras.json", lambda d: [change(entry) for entry in d.values()])


def splits(**entries):
    return lambda c: rewrite(c / "splits.json", lambda d: d.update(entries))


def pictures(kind, change, suffix=None, **options):
    """Changes every picture of a kind; `change` makes the new one of the old one's values."""

    def damage(capture):
        for path in sorted((capture / kind).glob("*/*")):
            image = change(np.array(Image.open(path)))
            path.unlink()
            image = image if isinstance(image, Image.Image) else Image.fromarray(image)
            image.save(path.with_suffix(suffix or path.suffix), **options)

    return damage


def also_alpha(capture):
    """Alpha images beside the masks."""
    for path in capture.glob("masks/*/*.png"):
        target = capture / "alpha" / path.parent.name / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.where(np.array(Image.open(path)) > 0, 255, 0).astype(np.uint8)).save(target)


def after(*steps):
    return lambda capture: [step(capture) for step in steps]


def turned(quarter):
    exif = Image.Exif()
    exif[0x0112] = {1: 6, 2: 3, 3: 8}[quarter]
    return pictures("images", lambda v: np.ascontiguousarray(np.rot90(v, quarter)), exif=exif)


def paletted(values):
    image = Image.fromarray(values, "P")
    image.putpalette([0, 0, 0, 200, 10, 10, 10, 200, 10, 10, 10, 200])
    return image


def cutout(label):
    rng = np.random.default_rng(0)
    return np.dstack([rng.integers(0, 255, (*label.shape, 3)), np.where(label > 0, 255, 0)]).astype(np.uint8)


def far(capture):
    offset = np.array([3e6, -2e5, 60.0])
    cameras(lambda e: e.update(t=(np.array(e["t"]) - np.array(e["R"]) @ offset).tolist()))(capture)
    for path in capture.glob("meshes/t?.npz"):
        np.savez(path, **{key: v.astype(float) + offset for key, v in np.load(path).items()})


def mesh(change, frame="t3"):
    def damage(capture):
        path = capture / f"meshes/{frame}.npz"
        arrays = dict(np.load(path))
        change(arrays)
        np.savez(path, **arrays)

    return damage


def shuffled(arrays):
    order = np.random.default_rng(1).permutation(len(arrays["head"]))
    arrays.update(head=arrays["head"][order], head_rigid=arrays["head_rigid"][order])


def replaced(name, content):
    return lambda c: (c / name).write_bytes(content)


def rename(kind, suffix):
    return lambda c: [path.rename(path.with_suffix(suffix)) for path in (c / kind).glob("*/*")]


PERSON = {
    "0/1": pictures("masks", lambda v: (v > 0).astype(np.uint8)),
    "0/100": pictures("masks", lambda v: np.where(v > 0, 100, 0).astype(np.uint8)),
    "0/200": pictures("masks", lambda v: np.where(v > 0, 200, 0).astype(np.uint8)),
    "0/65535": pictures("masks", lambda v: np.where(v > 0, 65535, 0).astype(np.uint16)),
    "0/1 in 16 bits": pictures("masks", lambda v: (v > 0).astype(np.uint16)),
    "bits": pictures("masks", lambda v: Image.fromarray(np.where(v > 0, 255, 0).astype(np.uint8)).convert("1")),
    "three channels": pictures("masks", lambda v: np.dstack([np.where(v > 0, 255, 0).astype(np.uint8)] * 3)),
    "cutouts": pictures("masks", cutout),
    "cutouts in webp": pictures("masks", cutout, ".webp", lossless=True, exact=True),
    "as alpha": after(also_alpha, lambda c: shutil.rmtree(c / "masks")),
}
SAME = {
    "t as a column": cameras(lambda e: e.update(t=[[x] for x in e["t"]])),
    "byte-order marks": lambda c: [
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes()) for path in (c / "cameras.json", c / "splits.json")
    ],
    "model and lens said": cameras(lambda e: e.update(camera_model="OPENCV", distortion=[0, 0, 0, 0])),
    "upper-case suffixes": after(rename("images", ".PNG"), rename("masks", ".Png")),
    "orientation 3": turned(2),
    "orientation 6": turned(1),
    "orientation 8": turned(3),
    "colours in 16 bits": pictures("images", lambda v: Image.fromarray(v)),
    "colours with alpha": pictures("images", lambda v: np.dstack([v, np.full(v.shape[:2], 90, np.uint8)])),
    "colours by palette": pictures("images", lambda v: Image.fromarray(v).quantize(8)),
    "labels by palette": pictures("masks", paletted),
    "labels in 16 bits": pictures("masks", lambda v: v.astype(np.uint16)),
    "labels and full alpha": pictures("masks", lambda v: np.dstack([v, np.full_like(v, 255)])),
    "alpha in 16 bits": after(also_alpha, pictures("alpha", lambda v: v.astype(np.uint16) * 257)),
    "alpha of 0 and 1": after(also_alpha, pictures("alpha", lambda v: (v > 0).astype(np.uint8))),
    "far from the origin": far,
}
LOUD = {
    "parsing labels": (pictures("masks", lambda v: np.array([0, 1, 17], np.uint8)[v]), "ingest", "values 0, 1, 17;"),
    "labels times 85": (pictures("masks", lambda v: v * 85), "ingest", "values 0, 85, 170; they look like labels"),
    "labels times 64": (pictures("masks", lambda v: v * 64), "ingest", "values 0, 64, 128; they look like labels"),
    "labels times 127": (pictures("masks", lambda v: v * 127), "ingest", "values 0, 127, 254; they look like labels"),
    "a fourth label": (pictures("masks", lambda v: v * 2), "ingest", "values 0, 2, 4;"),
    "labels in jpg": (pictures("masks", lambda v: v, ".jpg"), "ingest", "masks/left: values: expected labels 0..3"),
    "stretched labels in jpg": (pictures("masks", lambda v: v * 85, ".jpg"), "ingest", "expected labels 0..3, or a"),
    "labels in red": (pictures("masks", lambda v: np.dstack([v, v * 0, v * 0])), "ingest", "colours: (1, 0, 0), (2"),
    "labels and a rim of another number": (
        pictures("masks", lambda v: np.pad(v[3:-3, 3:-3], 3, constant_values=254)), "ingest", "values 0, 1, 2, 254",
    ),
    "coloured labels": (pictures("masks", lambda v: np.eye(4, 3, -1, np.uint8)[v] * 255), "ingest", "found colours: ("),
    "alpha inverted": (
        after(also_alpha, pictures("alpha", lambda v: 255 - v)),
        "ingest", "alpha/left: expected coverage where the masks are, found 0%",
    ),
    "labels stretched in alpha": (
        lambda c: shutil.copytree(c / "masks", c / "alpha"), "ingest", "alpha/left: values: expected coverage",
    ),
    "one mask is a matte": (
        lambda c: Image.fromarray(np.full((80, 96), 255, np.uint8)).save(c / "masks/left/t3.png"),
        "ingest", "1 of 5 masks with values above 3",
    ),
    "one mask is missing": (lambda c: (c / "masks/left/t3.png").unlink(), "ingest", "t3.png: expected a mask as for"),
    "one alpha is missing": (
        after(also_alpha, lambda c: (c / "alpha/left/t3.png").unlink()), "ingest", "t3.png: expected an alpha image",
    ),
    "two pictures of a frame": (
        lambda c: Image.open(c / "images/left/t1.png").save(c / "images/left/t1.jpg"),
        "ingest", "expected one picture t1, found t1.jpg and t1.png",
    ),
    "tif": (rename("masks", ".tif"), "ingest", "expected an image (jpg, png or webp), found .tif; convert it to png"),
    "orientation of another size": (
        pictures("images", lambda v: v, exif=(lambda e: (e.__setitem__(0x0112, 6), e)[1])(Image.Exif())),
        "ingest", "found 80 x 96, turned by its EXIF orientation 6",
    ),
    "PostScript": (replaced("masks/left/t1.png", b"%!PS-Adobe-3.0 EPSF-3.0\n"), "ingest", "t1.png: expected a whole"),
    "an image is a pointer": (replaced("images/left/t1.png", POINTER), "ingest", "t1.png: expected a whole image"),
    "a mesh is a pointer": (replaced("meshes/t1.npz", POINTER), "tracks", "a pointer of Git LFS in its place; fetch"),
    "cameras are a pointer": (replaced("cameras.json", POINTER), "tracks", "a pointer of Git LFS in its place; fetch"),
    "splits are a pointer": (replaced("splits.json", POINTER), "tracks", "a pointer of Git LFS in its place; fetch"),
    "a damaged image": (replaced("images/left/t1.png", b"\x89PNG\r\n\x1a\n" + bytes(99)), "ingest", "does not decode"),
    "lens under another key": (cameras(lambda e: e.update(distCoef=[0.1, 0, 0, 0])), "tracks", "mean distortion?"),
    "fisheye": (cameras(lambda e: e.update(camera_model="OPENCV_FISHEYE")), "tracks", "found 'OPENCV_FISHEYE'"),
    "cuts of no frames": (splits(cuts=[["1", "2"]]), "tracks", "cuts: expected pairs of ids that are in frames"),
    "another key": (splits(val=["t3"]), "tracks", "unknown key 'val'"),
    "vertices in another order": (mesh(shuffled), "tracks", "t3.npz: head: expected edges as long as in the other"),
    "a mirrored frame": (
        mesh(lambda a: a.update({k: a[k] * np.array([-1, 1, 1]) for k in ("head", "head_rigid")})),
        "tracks", "t3.npz: head: expected a surface as in the other frames",
    ),
    "far from the origin in float32": (
        after(far, *(mesh(lambda a: a.update({k: v.astype(np.float32) for k, v in a.items()}), f) for f in FRAMES)),
        "tracks", "a world so far from its origin that float32 rounds to 0.25 m",
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def sound(capture_master, tmp_path_factory):
    """What the verbs make of labels, and of the same pictures as the person's matte."""
    root = tmp_path_factory.mktemp("sound")
    matte = shutil.copytree(capture_master, root / "matte")
    pictures("masks", lambda v: np.where(v > 0, 255, 0).astype(np.uint8))(matte)
    made = {}
    for name, capture in (("label", capture_master), ("matte", matte)):
        (root / f"{name}-out").mkdir()
        stopped, made[name] = chain(capture, root / f"{name}-out")
        assert stopped is None
    return made


def assert_same(found, expected, atol):
    sequence, made = found
    for part, one in expected[0].parts.items():
        other = sequence.parts[part]
        np.testing.assert_array_equal(other.faces, one.faces)
        verts = [mesh.verts.astype(np.float64) for mesh in (other, one)]
        ours, theirs = (v - v.mean((0, 1)) for v in verts)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=atol)
    for frame, layers in expected[1].items():
        for layer, picture in zip(layers, made[frame]):
            np.testing.assert_array_equal(layer, picture)


@pytest.mark.parametrize("name", SAME)
def test_the_same_in_another_form_gives_the_same(capture, tmp_path, sound, name):
    SAME[name](capture)
    assert main(["check", str(capture)]) == 0
    stopped, found = chain(capture, tmp_path)
    assert stopped is None
    # A world that was moved by whole metres is the same to float32's steps around a metre, and its masks to the pixel.
    assert_same(found, sound["label"], 1.2e-7)


@pytest.mark.parametrize("name", PERSON)
def test_mattes_in_any_form_give_the_same(capture, tmp_path, sound, name):
    PERSON[name](capture)
    assert main(["check", str(capture)]) == 0
    stopped, found = chain(capture, tmp_path)
    assert stopped is None
    assert_same(found, sound["matte"], 0)


def test_labels_with_an_unknown_rim_are_used(capture):
    """255 among labels is PASCAL VOC's void: nothing is known there (docs/decisions/016-what-hides-a-part.md)."""
    pictures("masks", lambda v: np.pad(v[3:-3, 3:-3], 3, constant_values=255))(capture)
    assert main(["check", str(capture)]) == 0


@pytest.mark.parametrize("name", LOUD)
def test_what_is_wrong_is_said_by_every_verb_that_reads_it(capture, tmp_path, capfd, name):
    damage, verb, line = LOUD[name]
    damage(capture)
    assert main(["check", str(capture)]) == 2
    assert any(line in found for found in lines(capfd))
    stopped, _ = chain(capture, tmp_path)
    found = lines(capfd)
    assert stopped == verb and len(found) == 1 and line in found[0], found
