"""How well will I know the pose? Experiments with fiducial markers, against the truth."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from sweep.errors import PipelineError, RunError, StoreError, SweepError
from sweep.plan.experiment import Pipeline
from sweep.version import __version__

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "Pipeline", "PipelineError", "RunError", "StoreError", "SweepError", "__version__", "open",
    "run",
]


def run(pipeline: Pipeline, store: str | os.PathLike[str] | None = None, **options: Any) -> Any:
    """Run a pipeline into a store and return its results, an ``xarray.Dataset``, lazily.

    ``options`` are those of :func:`sweep.execution.runner.execute`. Call it under
    ``if __name__ == "__main__":`` in a script: the workers are processes that import it.
    """
    from sweep.execution.runner import execute  # noqa: PLC0415  (dask is slow to import)

    return open(execute(pipeline, store, **options).store)


def open(store: str | os.PathLike[str]) -> xr.Dataset:  # noqa: A001  (as xarray and zarr have it)
    """Open a store's results, lazily; also those of an unfinished run.

    Raises
    ------
    StoreError
        Where there is no store of sweep.
    """
    from sweep.store.lifecycle import open_dataset  # noqa: PLC0415  (xarray is slow to import)

    return open_dataset(store)
