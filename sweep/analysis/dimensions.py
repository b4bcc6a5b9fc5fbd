"""What the dimensions of a dataset are, and which of them the caller keeps."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import xarray as xr

from sweep.analysis.board_markers import AXIS
from sweep.analysis.pose_view import DETECTION_INPUTS, REQUIRED_VARIABLES
from sweep.errors import ArgumentError, DatasetError, SweepError
from sweep.plan.alternatives import PHOTOGRAPHS
from sweep.plan.camera_values import SQUARE_FORMAT, stored_text
from sweep.plan.coordinates import FIXED
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import GEOMETRY_SECTIONS, PARAMETERS, Stage
from sweep.plan.schema import SCHEMA
from sweep.plan.stopping import SECTIONS
from sweep.plan.variable import LABELS
from sweep.plugins.declared import recorded_plugins

DRAWS = "trial"
"""The dimension of random draws."""


def axes_of(results: xr.Dataset, *stages: Stage) -> list[str]:
    """Return the axes of the schema's variables (of some stages, or of all), in their order."""
    dims = [str(dim) for variable in SCHEMA if variable.name in results
            and (not stages or variable.stage in stages)
            for dim in results[variable.name].dims]
    return [dim for dim in dict.fromkeys(dims) if dim not in LABELS]


def configuration_axes(results: xr.Dataset) -> list[str]:
    """Return the axes of the detector's and the estimator's settings."""
    scene = axes_of(results, Stage.scene)
    return [name for name in axes_of(results) if name not in scene]


def of_photographs(results: xr.Dataset) -> bool:
    """Return whether the poses are those of photographs: the draws are then photographs."""
    return PHOTOGRAPHS in results.coords


def is_grid_axis(name: object, results: xr.Dataset) -> bool:
    """Return whether a dimension is of the camera, the marker or the pose: it makes cells.

    Of parameters that go together one such suffices. Photographs have no cells: what is seen in
    one photograph together counts as one draw, for its errors are correlated.
    """
    if of_photographs(results):
        return False
    attributes = results[name].attrs if name in results.coords else {}
    return any(
        each in PARAMETERS and PARAMETERS[each].section in GEOMETRY_SECTIONS
        for each in str(attributes.get("zip", name)).split()
    )


def is_fixed(coordinate: xr.DataArray) -> bool:
    """Return whether a coordinate is a parameter with one value on the whole grid."""
    return not coordinate.dims and FIXED in coordinate.attrs


def without_fixed(array: xr.DataArray) -> xr.DataArray:
    """Return an array without the coordinates of fixed parameters."""
    return array.drop_vars([name for name, each in array.coords.items() if is_fixed(each)])


def fingerprint_of(results: xr.Dataset) -> Mapping[str, Any]:
    """Return the fingerprint in a dataset's attributes; empty if they have none."""
    fingerprint = _run_metadata(results).get("fingerprint")
    return fingerprint if isinstance(fingerprint, Mapping) else {}


def pipeline_text(results: xr.Dataset) -> str:
    """Return the text of the pipeline in a dataset's attributes; KeyError if they have none."""
    store_format = _run_metadata(results).get("format")
    return stored_text(
        results.attrs["pipeline"], SQUARE_FORMAT if store_format is None else store_format
    )


def stored_pipeline(results: xr.Dataset) -> Pipeline:
    """Return the pipeline in a dataset's attributes, without its files and plug-ins.

    Raises
    ------
    KeyError, SweepError
        If they have none.
    """
    metadata = _run_metadata(results)
    return Pipeline.from_text(
        pipeline_text(results), files=fingerprint_of(results).get("files", {}),
        plugins=recorded_plugins(metadata),
    )


def is_sampling_stopped(results: xr.Dataset) -> bool:
    """Return whether a dataset is of a pipeline whose sampling stops when results suffice."""
    try:
        text = pipeline_text(results)
        return any(name in text for name in SECTIONS) and (  # to read it takes milliseconds
            stored_pipeline(results).stopping is not None)
    except (KeyError, SweepError):
        return False


def _run_metadata(results: xr.Dataset) -> Mapping[str, Any]:
    """Return what a dataset's attributes record of its run.

    It is JSON as `sweep.open` returns it, a mapping as Zarr has it; empty if there is none.
    """
    metadata = results.attrs.get("sweep")
    if isinstance(metadata, str):
        with contextlib.suppress(ValueError, RecursionError):
            metadata = json.loads(metadata)
    return metadata if isinstance(metadata, Mapping) else {}


def as_names(per: Sequence[str]) -> tuple[str, ...]:
    """Return names of dimensions as a tuple: several, or a single one as a string.

    Raises
    ------
    ArgumentError
        If ``per`` is not a list of names.
    """
    if isinstance(per, str):
        return (per,)
    if not isinstance(per, Iterable) or not all(isinstance(name, str) for name in per):
        raise ArgumentError("per", per, "expected names of dimensions")
    return tuple(per)


def kept_dimensions(results: xr.Dataset, per: Sequence[str]) -> tuple[str, ...]:
    """Return the dimensions to keep, each once.

    Raises
    ------
    ArgumentError
        If the dataset does not have one of them.
    DatasetError
        If the dataset lacks variables, or has no poses.
    """
    names = as_names(per)
    require_poses(results)
    axes = axes_of(results)
    missing = [name for name in dict.fromkeys(names) if name not in axes]
    drawn = [name for name in missing
             if name in results.coords and DRAWS in results[name].dims and name != DRAWS]
    if drawn:
        raise ArgumentError(
            "per", ", ".join(drawn), "is drawn in this store, which has no axis of it: run it with "
            f'{drawn[0]} = [...] under [axes], or, in Python, give bins={{"{drawn[0]}": [...]}}')
    for name in missing:
        along = results[name].dims if name in results.coords else ()
        if len(along) == 1 and along[0] in axes:
            raise ArgumentError("per", name, f"goes with the axis {along[0]}: name that")
    if missing:
        raise ArgumentError("per", ", ".join(missing),
                            f"no such dimension; there are {', '.join(axes) or 'none'}")
    return tuple(dict.fromkeys(names))


def require_poses(results: xr.Dataset) -> None:
    """Raise DatasetError unless a dataset has the variables of results, and poses.

    Of boards' markers (`sweep.analysis.per_marker`) it has detections alone.
    """
    required = DETECTION_INPUTS if AXIS in results.dims else REQUIRED_VARIABLES
    lacking = [name for name in required if name not in results]
    if lacking:
        present = ", ".join(map(str, results.data_vars)) or "none"
        raise DatasetError(f"no variable {', '.join(lacking)}; there are {present}")
    empty = [name for name in axes_of(results) if results.sizes[name] == 0]
    if empty:
        raise DatasetError(f"there are no poses: {', '.join(empty)} has no values")


def require_dimension(results: xr.Dataset, *names: str) -> str:
    """Return the first of the names that is a dimension of the dataset.

    Raises
    ------
    DatasetError
        If none is.
    """
    require_poses(results)
    axes = axes_of(results)
    for name in names:
        if name in axes:
            return name
    raise DatasetError(f"{' or '.join(names)}: no such dimension; "
                       f"there are {', '.join(axes) or 'none'}")
