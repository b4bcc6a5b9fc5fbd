"""Values of a parameter, from a dataset's coordinates or the pipeline in its attributes."""

from __future__ import annotations

from typing import Any

import xarray as xr

from sweep.analysis.dimensions import stored_pipeline
from sweep.errors import DatasetError, SweepError


def parameter_value(results: xr.Dataset, name: str) -> Any:
    """Return a parameter's value, or its values over the dimensions that it has.

    Raises
    ------
    DatasetError
        If the dataset has it neither as a coordinate nor in the pipeline of its attributes, or if
        it was drawn and the store is too old to have the draws.
    """
    if name in results.coords:
        return results[name].reset_coords(drop=True)
    try:
        pipeline = stored_pipeline(results)
    except (KeyError, SweepError):
        raise DatasetError(f"{name}: not a coordinate, and the attributes hold no pipeline "
                           "that has it") from None
    if pipeline.axis(name) is not None:
        raise DatasetError(f"{name}: varies in this store, but the dataset lacks its coordinate")
    value = pipeline.fixed.get(name, pipeline.parameters[name].default)
    if value is not None and not isinstance(value, (int, float, str)):
        raise DatasetError(f"{name}: is drawn, so that the side is not a number of the grid")
    return value
