"""The notebook runs from top to bottom, and finds what it hides."""

import re
from pathlib import Path

import jax
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "diagnosis.ipynb"


def test_what_the_notebook_imports_is_there():
    first = next(cell.source for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code")
    exec(first.replace("%matplotlib inline", ""), {})


# The messages of the kernel's own machinery are not ours.
@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_the_notebook_finds_the_friction_that_it_hides(monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", jax.config.jax_compilation_cache_dir)
    assert NOTEBOOK.stat().st_size < 200_000
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    NotebookClient(notebook, timeout=500, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    texts = "\n".join(output.get("text", "") for output in outputs)
    assert "Diagnosis: named" in texts and "Coulomb friction at y1" in texts
    rows = re.findall(r"^(?:mass|damping|stiffness|friction) +([\d.]+) +([\d.]+)$", texts, flags=re.MULTILINE)
    hidden, found = np.array(rows, float).T
    np.testing.assert_allclose(found, hidden, rtol=0.01)
    assert len(hidden) == 4
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
