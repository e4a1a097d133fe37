import json
import shutil

import numpy as np
import pytest
from PIL import Image

from nbavatar.cli import main
from nbavatar.io.images import decode_image


def errors(capfd):
    printed = capfd.readouterr()
    return [line for line in printed.err.splitlines() if "error:" in line]


def test_a_good_capture_passes_and_is_drawn(capture, tmp_path, capfd):
    assert main(["check", str(capture), "--out", str(tmp_path / "o")]) == 0
    printed = capfd.readouterr()
    assert "5 frames, 0 defects" in printed.out and "camera left: meshes and masks overlap by" in printed.out
    assert sorted(path.name for path in (tmp_path / "o").iterdir()) == ["left.png", "overview.png", "right.png"]
    sheet = decode_image(tmp_path / "o" / "left.png")
    yellow = (sheet == [255, 255, 0]).all(-1).sum()
    assert yellow > 100, "outlines of the masks are drawn"


def write_json(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def damage_mesh(capture, **arrays):
    path = capture / "meshes/t1.npz"
    np.savez(path, **{**np.load(path), **arrays})


DAMAGES = {
    "camera": (lambda c: write_json(c / "cameras.json", lambda d: d["left"].pop("K")), "camera left: K: expected this"),
    "image gone": (lambda c: (c / "images/left/t1.png").unlink(), "t1.jpg: expected an image"),
    "image cut short": (lambda c: (c / "images/left/t1.png").write_bytes(b"\x89PNG"), "t1.png: expected a whole image"),
    "mask gone": (
        lambda c: (c / "masks/right/t3.png").unlink(),
        "t3.png: expected a mask as for the other frames, found none",
    ),
    "mask size": (
        lambda c: Image.fromarray(np.ones((4, 4), np.uint8)).save(c / "masks/right/t3.png"),
        "t3.png: size: expected 96 x 80",
    ),
    "label of no mesh": (
        lambda c: Image.fromarray(np.full((80, 96), 3, np.uint8)).save(c / "masks/right/t3.png"),
        "left_hand_faces: expected a mesh for label 3",
    ),
    "mixed masks": (
        lambda c: Image.fromarray(np.full((80, 96), 255, np.uint8)).save(c / "masks/right/t3.png"),
        "expected labels 0..3 in all masks, or 0..255 in all",
    ),
    "alpha in one frame only": (
        lambda c: (
            (c / "alpha/left").mkdir(parents=True),
            shutil.copy(c / "masks/left/t0.png", c / "alpha/left/t0.png"),
        ),
        "t1.png: expected an alpha image as for the other frames",
    ),
    "NaN": (lambda c: damage_mesh(c, head=np.full((337, 3), np.nan, np.float32)), "head: expected finite coordinates"),
    "mesh gone": (lambda c: (c / "meshes/t4.npz").unlink(), "t4.npz: expected an array file"),
    "split": (lambda c: write_json(c / "splits.json", lambda d: d.update(test=["x"])), "found 'x'"),
    "no topology": (lambda c: (c / "meshes/topology.npz").unlink(), "topology.npz: expected an array file"),
    "millimetres": (
        lambda c: [np.savez(p, **{k: v * 1000 for k, v in np.load(p).items()}) for p in c.glob("meshes/t*[0-9].npz")],
        "lengths look like millimetres: divide vertices by 1000",
    ),
    "moved camera": (
        lambda c: write_json(
            c / "cameras.json",
            lambda d: d["left"].update(t=[0.15, 0, 0.6]),
        ),
        "expected meshes that project onto the masks",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_every_defect_is_one_line_and_exit_code_2(capture, capfd, name):
    damage, line = DAMAGES[name]
    damage(capture)
    assert main(["check", str(capture)]) == 2
    lines = errors(capfd)
    assert any(line in found for found in lines), lines
    assert len(lines) <= 3


def test_inside_out_faces_are_a_defect(capture, capfd):
    path = capture / "meshes/topology.npz"
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "head_faces": arrays["head_faces"][:, ::-1]})
    assert main(["check", str(capture)]) == 2
    assert "head_faces: expected corners counter-clockwise seen from outside" in errors(capfd)[0]


def test_many_alike_are_one_line_with_a_count(capture, capfd):
    for path in (capture / "images/left").iterdir():
        path.unlink()
    (capture / "images/right/t1.png").unlink()
    assert main(["check", str(capture)]) == 2
    lines = errors(capfd)
    assert len(lines) == 1 and lines[0].endswith("(and 5 more like it, in left, right)")


def test_what_is_unusual_is_noted(capture, capfd):
    write_json(capture / "splits.json", lambda d: d.update(frames=["t0", "t10", "t2", "t3"]))
    for path in capture.glob("*/*/t1.png"):
        path.rename(path.with_name("t10.png"))
    (capture / "meshes/t1.npz").rename(capture / "meshes/t10.npz")
    for path in capture.glob("masks/*/*"):
        Image.fromarray(np.where(np.array(Image.open(path)) > 0, 40, 0).astype(np.uint8)).save(path)
    assert main(["check", str(capture)]) == 0
    notes = [line for line in capfd.readouterr().out.splitlines() if line.startswith("note: ")]
    assert "splits.json: frames: t10 comes before t2" in notes[0]
    assert "masks/left: a matte in which 40 is full coverage" in notes[1] and len(notes) == 3


def test_no_capture(tmp_path, capfd):
    assert main(["check", str(tmp_path / "none")]) == 2
    assert "expected the folder of a capture, found no such folder" in errors(capfd)[0]


def test_decaf_inventory_names_all_that_is_missing_and_where_to_get_it(decaf, tmp_path, capfd):
    here = ["--subjects", "S2", "--cameras", "084", "100"]
    whole = decaf / "assets/landmark_embedding.npy"
    content = whole.read_bytes()
    whole.unlink()
    assert main(["check", "--layout", "decaf", str(decaf), *here]) == 2
    message = capfd.readouterr().err
    assert "1 files" in message and "assets/landmark_embedding.npy" in message and "DECA" in message
    whole.write_bytes(content)
    assert main(["check", "--layout", "decaf", str(decaf), *here]) == 0
    assert main(["check", "--layout", "decaf", str(tmp_path / "none")]) == 2
    message = capfd.readouterr().err
    for word in (
        "flame.is.tue.mpg.de",
        "mano.is.tue.mpg.de",
        "vcai.mpi-inf.mpg.de/projects/Decaf",
        "generic_model.pkl",
    ):
        assert word in message
    for subject in ("S1", "S2", "S3", "S4"):
        assert f"{{train,test}}/videos/{subject}/{{084,100,102,108,110,111,121,122}}.mp4" in message
    assert f"below {tmp_path / 'none'}/" in message


def test_the_inventory_asks_for_nothing_that_the_release_lacks(capfd, tmp_path):
    assert main(["check", "--layout", "decaf", str(tmp_path), "--subjects", "S5"]) == 2
    assert "111" not in capfd.readouterr().err


def test_a_complete_decaf_is_read_and_its_conventions_are_measured(decaf, tmp_path, capfd):
    here = ["--subjects", "S2", "--cameras", "084", "100", "--out", str(tmp_path / "o")]
    assert main(["check", "--layout", "decaf", str(decaf), *here]) == 0
    text = capfd.readouterr().out
    assert "S2 camera 100: distortion under 'dist_coeffs'" in text and "12 frames in 2 uncut runs" in text
    assert text.count("landmarks to projected model") == 4 and "0 defects" in text
    assert decode_image(tmp_path / "o" / "S2.png").shape[0] > 600
    np.save(decaf / "train/head_keys/S2/084.npy", np.zeros((11, 68, 3)))
    assert main(["check", "--layout", "decaf", str(decaf), *here[:5]]) == 2
    assert "head_keys/S2/084.npy: frames: expected 12" in errors(capfd)[0]


def test_masks_supplied_elsewhere_are_checked_in_place_of_the_capture_s(capture, tmp_path, capfd):
    shutil.move(capture / "masks", tmp_path / "own")
    assert main(["check", str(capture)]) == 2
    assert "expected a mask (or an alpha image) for each frame" in errors(capfd)[0]
    words = ["check", str(capture), "--supplied", str(tmp_path / "own"), "--subject", "me"]
    assert main([*words, "--overview", str(tmp_path / "o.png"), "--record", str(tmp_path / "r.json")]) == 0
    yellow = (decode_image(tmp_path / "o.png") == [255, 255, 0]).all(-1).sum()
    assert yellow > 50, "outlines of the supplied masks are drawn"
    record = json.loads((tmp_path / "r.json").read_text())
    assert record["defects"] == [] and set(record["overlap"]) == {"left", "right"} and record["frames"] == 5
    (tmp_path / "own/right/t3.png").unlink()
    assert main(words) == 2
    assert "right: frame t3: expected a mask" in errors(capfd)[0]


def relabel(capture, change):
    for path in capture.glob("masks/*/*.png"):
        label = np.array(Image.open(path))
        change(label)
        Image.fromarray(label).save(path)


def test_what_says_nothing_in_masks_is_no_defect(capture, tmp_path, capfd):
    """A collar over the lower third of the picture, and a frame of one camera where nothing else is to be seen."""
    assert main(["check", str(capture), "--record", str(tmp_path / "before.json")]) == 0
    relabel(capture, lambda label: label.__setitem__(slice(50, None), 255))
    path = capture / "masks/left/t1.png"
    Image.fromarray(np.where(np.array(Image.open(path)) == 255, np.uint8(255), np.uint8(0))).save(path)
    assert main(["check", str(capture), "--record", str(tmp_path / "after.json")]) == 0
    before, after = (json.loads((tmp_path / f"{name}.json").read_text())["overlap"] for name in ("before", "after"))
    for camera in before:
        assert after[camera] > before[camera] - 0.05, "pixels that say nothing neither agree nor disagree"


def test_a_part_that_is_255_wherever_it_should_be_seen_is_a_defect(capture, capfd):
    relabel(capture, lambda label: label.__setitem__(label == 2, 255))
    assert main(["check", str(capture)]) == 2
    line = "masks: right_hand: expected label 2 in a mask, as it has a mesh, found none, and 255 (something in front)"
    assert any(line in found for found in errors(capfd))


def test_defects_may_be_said_only(capture, tmp_path, capfd):
    (capture / "images/left/t1.png").unlink()
    record = tmp_path / "r.json"
    assert main(["check", str(capture), "--record", str(record)]) == 2 and not record.exists()
    assert main(["check", str(capture), "--record", str(record), "--cfg", '{"stop": false}']) == 0
    assert "t1.jpg: expected an image" in json.loads(record.read_text())["defects"][0]
    assert len(errors(capfd)) == 2


def _packed(decaf):
    shutil.make_archive(str(decaf), "zip", decaf.parent, decaf.name)
    shutil.rmtree(decaf)


def _deeper(decaf):
    shutil.move(decaf, decaf.parent / "unpacked")
    decaf.mkdir()
    shutil.move(decaf.parent / "unpacked", decaf / "DecafDataset")


def _without_camera(decaf):
    for path in [*decaf.glob("train/*/S2/100.mp4"), *decaf.glob("train/*/S2/100.npy")]:
        path.unlink()


# What was done to a dataset of which S2 is whole -> what the one line says of it, and whom it was asked for.
STATES = {
    "one subject of two": (lambda d: None, ["S2", "S4"], "without S4; what is whole can be run: nbavatar run paper"),
    "train without test": (lambda d: None, ["S1", "S2"], "without S1 (test/ is not there); what is whole can be run"),
    "a camera missing": (_without_camera, ["S2"], "S2 lacks camera 100 (a camera that you do not have is left out in"),
    "a file missing": (lambda d: (d / "train/cutIDs/S2.pkl").unlink(), ["S2"], "found it S2 lacks train/cutIDs/S2.pkl"),
    "no body models": (lambda d: (d / "assets/generic_model.pkl").unlink(), ["S2"], "it body models missing: FLAME"),
    "moved": (lambda d: shutil.move(d, d.parent / "elsewhere"), ["S2"], "elsewhere; move it: mv "),
    "a folder deeper": (_deeper, ["S2"], "found it a folder deeper, in "),
    "packed": (_packed, ["S2"], "found it still packed; unpack it: unzip "),
    "nothing": (shutil.rmtree, ["S2"], "found no such folder"),
}  # fmt: skip


@pytest.mark.parametrize("name", STATES)
def test_the_state_of_a_decaf_is_said_in_one_line_before_any_list(decaf, capfd, name):
    change, subjects, line = STATES[name]
    shutil.rmtree(decaf / "test", ignore_errors=True)
    for other in set(path.name for path in decaf.glob("train/videos/*")) - {"S2"}:
        for path in decaf.glob(f"train/*/{other}"):
            shutil.rmtree(path)
    change(decaf)
    words = ["check", "--layout", "decaf", str(decaf), "--cameras", "084", "100", "--subjects", *subjects]
    assert main(words) == 2
    text = capfd.readouterr().err
    found = [one for one in text.splitlines() if "error:" in one]
    assert len(found) == 1 and text.startswith(found[0])
    assert f"{decaf}: expected" in found[0] and line in found[0]
    assert len(found[0].replace(str(decaf.parent), "")) < 300, "a line that is read"


def _cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    "name",
    ["train/videos/S2/084.mp4", "train/segmentations/S2/084.mp4", "train/params/S2/params_smoothed.pkl",
     "train/cameras/S2/cameras.pkl", "train/deformations/S2/deforms.npy", "train/head_keys/S2/084.npy",
     "train/right_hand_bbs/S2/084.npy", "train/contacts/S2/contacts_rh.npy", "train/cutIDs/S2.pkl",
     "assets/generic_model.pkl", "assets/landmark_embedding.npy", "assets/mano_v1_2/models/MANO_RIGHT.pkl",
     "assets/accurate_shapes/S2.pkl"],
)  # fmt: skip
def test_a_damaged_file_of_a_decaf_is_named_in_one_line(decaf, capfd, name):
    _cut(decaf / name)
    assert main(["check", "--layout", "decaf", str(decaf), "--subjects", "S2", "--cameras", "084", "100"]) == 2
    found = errors(capfd)
    assert any(name in line for line in found), found
    assert len({line for line in found if "frames" not in line}) <= 3


def test_a_decaf_is_asked_for_what_the_sheet_names(decaf, tmp_path, capfd):
    sheet = tmp_path / "subjects.tsv"
    sheet.write_text("subject\ttrain_cameras\ttest_camera\nS2\t084\t100\nS1\t084,110\t100\n")
    words = ["check", "--layout", "decaf", str(decaf), "--sheet", str(sheet)]
    assert main([*words, "--subjects", "S2"]) == 0
    assert main([*words, "--subjects", "S9"]) == 2
    assert "unknown subject 'S9'" in errors(capfd)[0]
