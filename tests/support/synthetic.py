"""A kernel that computes nothing, in place of the real one: as a preload of Dask workers too."""

from sweep.evaluation.results import CellsResult
from sweep.execution import block_task, forecast


def synthetic_cells(experiment, indices, need=None):  # noqa: ARG001
    """Return columns of scenes that are all solved."""
    cells = CellsResult.not_run(experiment, len(indices[0]))
    for flags in ("detection", "estimate"):
        cells.columns[flags][:] = 1
    return cells


def dask_setup(worker=None):  # noqa: ARG001
    forecast.run_cells = block_task.run_cells = synthetic_cells
