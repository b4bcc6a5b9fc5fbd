"""The notebooks run, show their figures, and are stored with the outputs of their sources."""

import os
import runpy
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
FIGURES = {"choosing_a_marker": 6, "paper_reproduced": 4, "first_analysis": 5}
TIMEOUT_S = 300  # a cell, on a busy machine
COSTS = {"choosing_a_marker": "## The recommendation"}
"""The heading from which on a notebook prints times, which no two runs have alike."""

source_digest = runpy.run_path(str(NOTEBOOKS / "make.py"))["source_digest"]


def read(name):
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_all_notebooks_are_known():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(FIGURES)


@pytest.mark.parametrize("name", FIGURES)
def test_notebook_is_stored_with_the_outputs_of_its_sources(name):
    notebook = read(name)
    nbformat.validate(notebook)
    assert (notebook.nbformat, notebook.nbformat_minor) == (4, 5)
    assert notebook.metadata.kernelspec.name == "python3"
    assert len({cell.id for cell in notebook.cells}) == len(notebook.cells)
    assert all(cell.metadata == {} for cell in notebook.cells)
    assert notebook.metadata.sweep.source_digest == source_digest(notebook), (
        f"python notebooks/make.py {name}")
    numbers = [cell.execution_count for cell in code_cells(notebook)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert figures_of(notebook) == FIGURES[name]


def figures_of(notebook):
    """Return the number of figures, after checks of a notebook's outputs."""
    shown = 0
    for cell in code_cells(notebook):
        kinds = {output.output_type for output in cell.outputs}
        complaints = [output.text for output in cell.outputs
                      if output.output_type == "stream" and output.name == "stderr"
                      and "pipelines/half_pixel" not in output.text]  # a note on the pipeline
        images = [output for output in cell.outputs
                  if output.output_type == "display_data" and "image/png" in output.data]
        assert "error" not in kinds
        assert not complaints
        assert len(images) == cell.source.count("plt.show()"), cell.source
        shown += len(images)
    return shown


def printed(notebook, until):
    """Return what the cells before the one that starts with ``until`` print."""
    texts = []
    for cell in notebook.cells:
        if until and cell.source.startswith(until):
            break
        if cell.cell_type == "code" and 'group="cost"' not in cell.source:
            texts += [output.text for output in cell.outputs if output.output_type == "stream"]
            texts += [output.data["text/plain"] for output in cell.outputs
                      if output.output_type == "execute_result"
                      and "xarray.Dataset" not in output.data["text/plain"]]
    return texts


@pytest.mark.evidence
@pytest.mark.parametrize("name", FIGURES)
def test_notebook_runs_shows_its_figures_and_prints_again_what_is_stored(name, tmp_path):
    """With the same versions and processor features; times are left out."""
    notebook = read(name)
    client = NotebookClient(notebook, timeout=TIMEOUT_S, kernel_name="python3",
                            resources={"metadata": {"path": str(NOTEBOOKS)}})
    client.execute(env=os.environ | {"SWEEP_RUNS": str(tmp_path)})
    assert figures_of(notebook) == FIGURES[name]
    assert list(tmp_path.glob("*.zarr")), "stores go where SWEEP_RUNS says"
    until = COSTS.get(name)
    assert printed(notebook, until) == printed(read(name), until)
