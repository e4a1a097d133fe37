"""The notebook runs from its first cell to its last, as Jupyter runs it, at sizes that take a minute."""

import base64
import io
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]
NOTEBOOK = ROOT / "docs/notebook.ipynb"
# In place of the cell that is tagged `parameters`.
SMALL = 'SIZE, FRAMES, STEPS = 64, 8, 4\nMESH = "tiny"\nWORK = "work"'

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")


def _pictures(notebook, kind):
    outputs = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", [])]
    return [Image.open(io.BytesIO(base64.b64decode(data[kind]))) for data in outputs if kind in data]


@pytest.mark.slow  # a whole capture, in processes of their own
def test_the_notebook_goes_from_a_capture_to_a_film(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(NOTEBOOK, 4)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    parameters.source = SMALL
    nbclient.NotebookClient(
        notebook, timeout=1200, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    (film,) = _pictures(notebook, "image/gif")
    assert film.size == (64, 64) and film.n_frames == 14, "there and back, without the ends twice"
    assert len(_pictures(notebook, "image/png")) == 3
    assert (tmp_path / "work/results/quick/train/S2/full/model.pt").is_file()


def test_the_notebook_holds_its_pictures_and_no_trace_of_a_machine():
    notebook = nbformat.read(NOTEBOOK, 4)
    nbformat.validate(notebook)
    assert _pictures(notebook, "image/gif") and len(_pictures(notebook, "image/png")) == 3
    assert NOTEBOOK.stat().st_size < 1.5e6
    texts = [str(output.get("text", "")) for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not any(word in text for text in texts for word in ("Traceback", "/home/", "/tmp/", "/root/"))
