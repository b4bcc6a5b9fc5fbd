"""The results of a group of scenes as a dataset, as the analysis reads them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.pose_view import REQUIRED_VARIABLES
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage
from sweep.plan.schema import VARIABLES
from sweep.plan.variable import LABELS, Variable
from sweep.sampling.stopping import GroupResults, condition_axes


def with_flags(names: Iterable[str]) -> tuple[str, ...]:
    """Return the variables that are read for some: themselves, and the flags of every result.

    >>> with_flags(["rotation_error_rad"])
    ('detection', 'estimate', 'flipped', 'rotation_error_rad')
    """
    flags = [name for name in REQUIRED_VARIABLES if VARIABLES[name].flags is not None]
    return tuple(dict.fromkeys([*flags, *names]))


def group_dataset(results: GroupResults) -> xr.Dataset:
    """Return the results of a group as a dataset with coordinates of its axes.

    Variables that every dataset of results has, and the group has not, are NaN.
    """
    pipeline = results.pipeline
    scene = condition_axes(pipeline)
    starts = dict(zip((axis.name for axis in scene), results.starts, strict=True))
    stops = dict(zip((axis.name for axis in scene), results.stops, strict=True))
    coordinates = {
        axis.name: (axis.name, axis.coordinates(starts.get(axis.name, 0), stops.get(axis.name)),
                    _attributes(axis))
        for axis in pipeline.axes if axis.name != TRIAL
    }
    coordinates[TRIAL] = (TRIAL, np.arange(results.trials), {})
    sizes = {name: len(values) for name, (_, values, _) in coordinates.items()}
    arrays: dict[str, Any] = {}
    for name in dict.fromkeys([*REQUIRED_VARIABLES, *results.values]):
        variable = VARIABLES[name]
        dims = _dimensions(pipeline, variable)
        if name in results.values:
            arrays[name] = (dims, results.values[name])
        else:
            shape = [sizes[dim] if dim in sizes else len(LABELS[dim]) for dim in dims]
            arrays[name] = (dims, np.broadcast_to(np.float32(np.nan), shape))
    return xr.Dataset(arrays, coordinates)


def _attributes(axis: Axis) -> dict[str, str]:
    return {"zip": " ".join(axis.columns)} if axis.zipped else {}


def _dimensions(pipeline: Pipeline, variable: Variable) -> list[str]:
    """Return the dimensions of a variable's values in a group, in their order."""
    names = variable.dimensions(pipeline)
    order = [
        *(axis.name for axis in condition_axes(pipeline)), TRIAL,
        *(axis.name for stage in (Stage.detection, Stage.estimation)
          for axis in pipeline.axes_of(stage)), *variable.inner,
    ]
    return [name for name in order if name in names]
