"""Notebooks are stored without outputs and run from top to bottom."""

from pathlib import Path

import nbformat
import pytest
from conftest import slow
from nbclient import NotebookClient
from nbclient.exceptions import CellTimeoutError

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def read(path):
    return nbformat.read(path, as_version=4)


def executed(path, attempts=2):
    """The notebook with its outputs. Now and then a Jupyter kernel starts and never gets the first
    message: then another one is started."""
    for attempt in range(attempts):
        notebook = read(path)
        where = {"metadata": {"path": path.parent}}
        first = next(cell.source for cell in notebook.cells if cell.cell_type == "code")
        patience = {first: 120 if attempt else 30}
        client = NotebookClient(
            notebook,
            timeout_func=lambda cell, patience=patience: patience.get(cell.source, 60),
            resources=where,
        )
        try:
            client.execute()
        except CellTimeoutError:
            started = any(cell.get("execution_count") for cell in notebook.cells)
            if started or attempt + 1 == attempts:
                raise
        else:
            return notebook


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_stored_without_outputs(path):
    notebook = read(path)
    nbformat.validate(notebook)
    for cell in notebook.cells:
        assert not cell.get("outputs") and cell.get("execution_count") is None, cell.source


@pytest.mark.parametrize(
    "path",
    # What the others do is in the tests of the program, the report and scenes as well.
    [path if path.stem[:2] == "02" else slow(path)[0] for path in NOTEBOOKS],
    ids=lambda path: path.stem,
)
def test_notebooks_run_and_show_pictures(path):
    notebook = executed(path)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    # What widgets show, errors included, is in their own state.
    widgets = notebook.metadata.get("widgets", {})
    states = [s["state"] for part in widgets.values() for s in part["state"].values()]
    outputs += [output for state in states for output in state.get("outputs", [])]
    errors = [output for output in outputs if output["output_type"] == "error"]
    assert not errors
    assert any("image/png" in output.get("data", {}) for output in outputs)
    told = [o["text"] for o in outputs if o.get("name") == "stderr"]
    assert not any("Warning" in text for text in told), told
