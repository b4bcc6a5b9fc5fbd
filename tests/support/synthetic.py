"""A kernel that computes nothing, put in place of the real one to test the engine's scale.

As a preload of Dask workers (``dask_setup``), and in the client by :func:`install`.
"""

import numpy as np

from sweep.evaluation.results import CellsResult


def synthetic_cells(experiment, indices, need=None):  # noqa: ARG001
    """Return plausible columns for the scenes at ``indices``: their linear index, all solved."""
    count = len(indices[0])
    ramp = np.zeros(count)
    for axis, index in zip(experiment.grid.axes, indices, strict=True):
        ramp = ramp * len(axis) + index
    columns = {}
    for variable in experiment.variables:
        values = np.ones((count, *variable.inner_shape), dtype=variable.dtype)
        if variable.flags is None:
            values *= (ramp % 1000).reshape(-1, *[1] * len(variable.inner_shape))
        columns[variable.name] = values.astype(variable.dtype)[None]
    seconds = {"scene": [1e-6], "detection": [1e-6], "estimation": [1e-6]}
    return CellsResult(columns, seconds, np.full(count, 1e-7))


def install():
    import sweep.execution.block_task  # noqa: PLC0415
    import sweep.execution.forecast  # noqa: PLC0415

    sweep.execution.forecast.run_cells = synthetic_cells
    sweep.execution.block_task.run_cells = synthetic_cells


def dask_setup(worker):  # noqa: ARG001
    install()
