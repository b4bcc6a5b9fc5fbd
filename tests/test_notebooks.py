"""The notebooks run, show their figures, and are stored with the outputs of their sources."""

import ast
import asyncio
import os
import re
import runpy
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import pandas as pd
import pytest
from nbclient import NotebookClient

import sweep

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
FIGURES = {"choosing_a_marker": 6, "paper_reproduced": 4, "first_analysis": 5}
FEW_TRIALS = 2  # in place of what a reader gets
TIMEOUT_S = 300  # a cell, on a busy machine
MAX_BYTES = 1_000_000
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


@pytest.fixture
def kernel(no_child, tmp_path, monkeypatch):  # noqa: ARG001  (used by being there)
    """Run a cell in this process; return how many figures it shows.

    A kernel and workers of each notebook's own take longer to start than the cells to run.
    """
    run = sweep.run
    figures = []

    def run_here(*arguments, workers, **options):
        assert workers > 0
        return run(*arguments, **options)

    def show():
        figures.extend(plt.get_fignums())
        for number in plt.get_fignums():
            plt.figure(number).canvas.draw()
        plt.close("all")

    def display(*values):
        assert all(value is None or repr(value) for value in values)

    def run_cell(source):
        figures.clear()
        *statements, last = ast.parse(source).body
        if isinstance(last, ast.Expr):
            last = ast.parse(f"display({ast.unparse(last.value)})").body[0]
        exec(compile(ast.Module([*statements, last], []), "cell", "exec"), names)  # noqa: S102
        return len(figures)

    names = {"__name__": "__main__", "display": display}
    monkeypatch.setattr(sweep, "run", run_here)
    monkeypatch.setattr(plt, "show", show)
    monkeypatch.setenv("SWEEP_RUNS", str(tmp_path))
    monkeypatch.chdir(NOTEBOOKS)
    with plt.rc_context(), pd.option_context("display.float_format", None):
        yield run_cell


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


@pytest.mark.parametrize("name", FIGURES)
def test_stored_notebook_is_small_and_names_no_folder_of_a_machine(name):
    text = (NOTEBOOKS / f"{name}.ipynb").read_text()
    assert len(text.encode()) < MAX_BYTES
    assert not re.search(r"/(?:tmp|home|root|work)/", text)


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


@pytest.mark.long
@pytest.mark.parametrize("name", [
    name if name == "first_analysis" else pytest.param(name, marks=pytest.mark.long)
    for name in FIGURES
])
def test_notebook_runs_with_few_trials(name, kernel, tmp_path, capsys):
    sources = [cell.source for cell in code_cells(read(name))]
    few = [re.sub(r"^trials = \d+", f"trials = {FEW_TRIALS}", source, flags=re.MULTILINE)
           for source in sources]
    assert sum(source != other for source, other in zip(sources, few, strict=True)) == 1
    shown = 0
    for source in few:
        figures = kernel(source)
        assert figures == source.count("plt.show()"), source
        shown += figures
    assert shown == FIGURES[name]
    assert capsys.readouterr().err == ""
    assert list(tmp_path.glob("*.zarr")), "stores go where SWEEP_RUNS says"


@pytest.mark.long
@pytest.mark.parametrize("name", FIGURES)
def test_notebook_runs_and_shows_its_figures(name, outcomes):
    outcome, folder = outcomes[name]
    if isinstance(outcome, Exception):
        raise outcome
    assert figures_of(outcome) == FIGURES[name]
    assert list(folder.glob("*.zarr")), "stores go where SWEEP_RUNS says"


@pytest.mark.long
@pytest.mark.parametrize("name", FIGURES)
def test_notebook_prints_again_what_is_stored(name, outcomes):
    """With the same versions and processor features; times are left out."""
    outcome, _ = outcomes[name]
    until = COSTS.get(name)
    assert printed(outcome, until) == printed(read(name), until)
