"""The notebooks run as they are, show their figures, and are kept without outputs."""

import asyncio
import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
FIGURES = {"choosing_a_marker": 6, "paper_reproduced": 4, "first_analysis": 5}
TIMEOUT_S = 300  # a cell, on a busy machine


def read(name):
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


async def executed(name, runs, turn):
    """Return a notebook after it ran in its folder, its stores in ``runs``."""
    client = NotebookClient(read(name), timeout=TIMEOUT_S, kernel_name="python3",
                            resources={"metadata": {"path": str(NOTEBOOKS)}})
    async with turn:
        return await client.async_execute(env=os.environ | {"SWEEP_RUNS": str(runs)})


async def all_executed(folders):
    """Run the notebooks two at a time: what starts up leaves processors idle."""
    turn = asyncio.Semaphore(2)
    running = [executed(name, runs, turn) for name, runs in folders.items()]
    return await asyncio.gather(*running, return_exceptions=True)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return {name: tmp_path_factory.mktemp(name) for name in FIGURES}


@pytest.fixture(scope="module")
def outcomes(folders):
    """Each notebook as it ran, or what it raised."""
    return dict(zip(folders, asyncio.run(all_executed(folders)), strict=True))


def test_all_notebooks_are_known():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(FIGURES)


@pytest.mark.parametrize("name", FIGURES)
def test_notebook_is_kept_without_outputs(name):
    notebook = read(name)
    nbformat.validate(notebook)
    assert (notebook.nbformat, notebook.nbformat_minor) == (4, 5)
    assert notebook.metadata.kernelspec.name == "python3"
    assert len({cell.id for cell in notebook.cells}) == len(notebook.cells)
    assert all(cell.metadata == {} for cell in notebook.cells)
    for cell in code_cells(notebook):
        assert cell.outputs == []
        assert cell.execution_count is None


@pytest.mark.parametrize("name", FIGURES)
def test_notebook_runs_and_shows_its_figures(name, outcomes, folders):
    if isinstance(outcomes[name], Exception):
        raise outcomes[name]
    shown = 0
    for cell in code_cells(outcomes[name]):
        kinds = {output.output_type for output in cell.outputs}
        complaints = [output.text for output in cell.outputs
                      if output.output_type == "stream" and output.name == "stderr"]
        images = [output for output in cell.outputs
                  if output.output_type == "display_data" and "image/png" in output.data]
        assert "error" not in kinds
        assert not complaints
        assert len(images) == cell.source.count("plt.show()"), cell.source
        shown += len(images)
    assert shown == FIGURES[name]
    assert list(folders[name].glob("*.zarr")), "stores go where SWEEP_RUNS says"
