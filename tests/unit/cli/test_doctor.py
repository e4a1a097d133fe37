import json
import subprocess
import sys

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
    _without(monkeypatch, cv2="libGL.so.1: cannot open shared object file")
    found = doctor.examine(tmp_path)
    assert found["broken"]["cv2"].startswith("libGL.so.1") and "masks" in [v for v, n in found["verbs"].items() if n]
    text = "\n".join(doctor._lines(found))
    assert (
        "MISSING    opencv-contrib-python-headless: libGL.so.1" in text
        and "pip install --force-reinstall opencv" in text
    )


def _without(monkeypatch, **reasons):
    """Imports of these modules fail with these reasons."""
    real = doctor.importlib.import_module

    def broken(name, *more):
        if name in reasons:
            raise ImportError(reasons[name])
        return real(name, *more)

    monkeypatch.setattr(doctor.importlib, "import_module", broken)


def test_brief_is_one_line_that_all_is_well(tmp_path, capsys):
    assert main(["doctor", "--brief", "--root", str(tmp_path)]) == 0
    line, *limits = capsys.readouterr().out.splitlines()
    assert line.startswith("doctor: ") and "a kernel compiles" in line
    assert all("tradeoff --offline" in limit for limit in limits), "more only where the system lacks libGL"


def test_brief_is_one_line_that_names_what_is_missing_and_what_to_do(tmp_path, capsys, monkeypatch):
    _without(monkeypatch, torch="libcudnn.so.9: cannot open shared object file")
    assert main(["doctor", "--brief", "--root", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().out.splitlines()
    assert line == (
        "doctor: torch cannot be imported: libcudnn.so.9: cannot open shared object file; "
        "run: python -m pip install --force-reinstall torch"
    )


def test_a_library_of_the_system_that_pymeshlab_lacks_limits_one_part_only(tmp_path, capsys, monkeypatch):
    _without(monkeypatch, pymeshlab="libGL.so.1: cannot open shared object file")
    assert main(["doctor", "--brief", "--root", str(tmp_path)]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert "a kernel compiles" in first and "tradeoff --offline" in second and "apt-get install libgl1" in second
    assert main(["doctor", "--json", "--root", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["limited"] and "tradeoff" not in [v for v, names in found["verbs"].items() if names]


def test_a_package_that_pip_has_not_installed_is_no_mere_limit(tmp_path, monkeypatch):
    _without(monkeypatch, pymeshlab="No module named 'pymeshlab'")
    monkeypatch.setattr(doctor, "installed", lambda name: False)
    found = doctor.examine(tmp_path)
    assert found["missing"] == ["pymeshlab"] and not found["limited"]


def test_a_compiler_that_does_not_work_counts(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(doctor, "_kernel_problem", lambda: "LLVM ERROR: no such target")
    assert main(["doctor", "--brief", "--root", str(tmp_path)]) == 2
    assert "LLVM ERROR" in capsys.readouterr().out


def test_needs_of_a_verb_are_read_from_its_code():
    assert {"cv2", "numpy", "numba"} <= doctor.third_party("masks")
    assert "cv2" not in doctor.third_party("train")


def test_the_plan_of_the_paper_says_hours_memory_and_disk_of_every_rule(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)  # no configuration here: that of the project
    assert main(["doctor", "--plan", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    rules = {part["rule"]: part for part in found["rules"]}
    assert rules["train"]["jobs"] == 36 and not rules["train"]["unmeasured"] and rules["train"]["core_hours"] > 0
    assert found["total"]["hours_here"] > found["total"]["hours_gpu"] > 0
    assert all(one["hours_here"] < found["total"]["hours_here"] and one["gives_up"] for one in found["budgets"])
    assert found["largest_memory_mb"] == max(part["memory"] for part in rules.values())
    assert main(["doctor", "--plan", "--frames", "163", "--gpu-ms", "2.9"]) == 0
    text = capsys.readouterr().out
    assert "163 frames a camera" in text and "one picture in 2.9 ms" in text and "gives up" in text
    assert main(["doctor", "--plan", "--frames", "0"]) == 2


def test_the_plan_imports_no_computing_packages():
    """Importing torch alone would take the seconds that the plan has."""
    code = "import sys; from nbavatar.cli import main; main(['doctor', '--plan']); "
    code += "print({'torch', 'numpy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"
