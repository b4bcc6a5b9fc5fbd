"""The notebooks run, show their figures, and are stored with the outputs of their sources."""

import asyncio
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


async def executed(notebook, runs, turn):
    """Return a notebook after it ran in its folder, its stores in ``runs``."""
    client = NotebookClient(notebook, timeout=TIMEOUT_S, kernel_name="python3",
                            resources={"metadata": {"path": str(NOTEBOOKS)}})
    async with turn:
        return await client.async_execute(env=os.environ | {"SWEEP_RUNS": str(runs)})


async def all_executed(folders):
    """Run the notebooks two at a time: what starts up leaves processors idle."""
    turn = asyncio.Semaphore(2)
    running = [executed(read(name), runs, turn) for name, runs in folders.items()]
    return await asyncio.gather(*running, return_exceptions=True)


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """Each notebook as it ran, or what it raised, and the folder of its stores."""
    folders = {name: tmp_path_factory.mktemp(name) for name in FIGURES}
    ended = asyncio.run(all_executed(folders))
    return dict(zip(folders, zip(ended, folders.values(), strict=True), strict=True))


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
                      if output.output_type == "stream" and output.name == "stderr"]
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
def test_notebook_runs_and_shows_its_figures(name, outcomes):
    outcome, folder = outcomes[name]
    if isinstance(outcome, Exception):
        raise outcome
    assert figures_of(outcome) == FIGURES[name]
    assert list(folder.glob("*.zarr")), "stores go where SWEEP_RUNS says"


@pytest.mark.evidence
@pytest.mark.parametrize("name", FIGURES)
def test_notebook_prints_again_what_is_stored(name, outcomes):
    """With the same versions and processor features; times are left out."""
    outcome, _ = outcomes[name]
    until = COSTS.get(name)
    assert printed(outcome, until) == printed(read(name), until)
