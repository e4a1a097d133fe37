import json

from nbavatar.cli import doctor, main


def test_findings_are_json_and_name_what_is_missing(decaf, capsys):
    assert main(["doctor", "--json", "--root", str(decaf)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["packages"]["torch"] and found["packages"]["cv2"] and found["machine"]["processors"] >= 1
    assert found["resources"]["flame"].endswith("generic_model.pkl") and "S2" in found["resources"]["dataset"]
    assert found["resources"]["landmarks"] and not found["get"]
    assert found["missing"] == [] and found["verbs"]["masks"] == []


def test_text_says_where_to_get_what_is_not_there(tmp_path, capsys):
    assert main(["doctor", "--root", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "flame.is.tue.mpg.de" in text and "landmark_embedding.npy" in text and "needed for the paper only" in text


def test_a_broken_package_is_named_with_the_verbs_that_need_it(tmp_path, capsys, monkeypatch):
    real = doctor.importlib.import_module

    def broken(name, *more):
        if name == "cv2":
            raise ImportError("libGL.so.1: cannot open shared object file")
        return real(name, *more)

    monkeypatch.setattr(doctor.importlib, "import_module", broken)
    monkeypatch.setattr(doctor, "examine", doctor.examine)
    found = doctor.examine(tmp_path)
    assert found["broken"]["cv2"].startswith("libGL.so.1") and "masks" in [v for v, n in found["verbs"].items() if n]
    text = "\n".join(doctor._lines(found))
    assert "MISSING    opencv-contrib-python-headless: libGL.so.1" in text and "pip install opencv" in text


def test_needs_of_a_verb_are_read_from_its_code():
    assert {"cv2", "numpy", "numba"} <= doctor.third_party("masks")
    assert "cv2" not in doctor.third_party("train")
