"""Every notebook is committed clean, runs from top to bottom, and draws what it says."""

import base64
import io
import json
import os
from pathlib import Path

import matplotlib.image
import nbformat
import numpy as np
import pytest
from ipykernel.kernelspec import write_kernel_spec
from nbclient import NotebookClient

# The models and the solver that they show have tests of their own.
SLOW = {"02_theories", "03_feedback", "04_senses"}
FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Make "python3" this very Python, and keep Jupyter and IPython out of the user's folders."""
    for name in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path / "jupyter"))  # looked at before all others
    write_kernel_spec(tmp_path / "jupyter" / "kernels" / "python3")
    return "python3"


def outputs(cell, kind):
    return [output for output in cell.outputs if output.output_type == kind]


def pictures(cell):
    shown = outputs(cell, "execute_result") + outputs(cell, "display_data")
    return [base64.b64decode(o.data["image/png"]) for o in shown if "image/png" in o.data]


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_committed_clean(path):
    raw = json.loads(path.read_text(encoding="utf-8"))
    nbformat.validate(raw)
    assert (raw["nbformat"], raw["nbformat_minor"]) == (4, 5)
    ids = [cell["id"] for cell in raw["cells"]]
    assert len(set(ids)) == len(ids)
    for cell in raw["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None, cell["id"]
    assert raw["metadata"]["kernelspec"]["name"] == "python3"


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=pytest.mark.slow if path.stem in SLOW else ())
        for path in NOTEBOOKS
    ],
)
def test_notebook_runs_and_draws(path, kernel, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXCTRL_QUICK", "1")
    work = tmp_path / "work"
    work.mkdir()
    before = set(os.listdir(FOLDER))
    notebook = nbformat.read(path, as_version=4)
    where = {"metadata": {"path": str(work)}}
    NotebookClient(notebook, kernel_name=kernel, timeout=600, resources=where).execute()
    assert set(os.listdir(FOLDER)) == before

    drawn = 0
    for cell in code_cells(notebook):
        said = "".join(o.text for o in outputs(cell, "stream") if o.name == "stderr")
        assert "Warning" not in said, f"{cell.id}: {said}"
        images = [matplotlib.image.imread(io.BytesIO(png)) for png in pictures(cell)]
        assert all(np.ptp(image[..., :3]) > 0.5 for image in images), f"{cell.id}: a blank figure"
        assert images or "jc.plot." not in cell.source, f"{cell.id}: no figure was shown"
        drawn += len(images)
    assert drawn, "no figure at all"
