"""What an analysis reads of a dataset: axes, draws, stored parameters, labels of flags."""

from __future__ import annotations

import contextlib
import functools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.poses import AXIS, DETECTION_INPUTS, REQUIRED_VARIABLES
from sweep.errors import ArgumentError, DatasetError, SweepError
from sweep.experiment.parameters import GEOMETRY_SECTIONS, PARAMETERS, PHOTOGRAPHS, Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import FIXED, LABELS, SCHEMA, with_descriptions
from sweep.experiment.stopping import SEARCH, StoppingRule
from sweep.experiment.toml_text import read_document
from sweep.messages import shown
from sweep.plugins.declared import recorded_plugins

# --------------------------------------------------------------------------------------------------
# What the dimensions of a dataset are, and which of them the caller keeps.

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
    return str(results.attrs["pipeline"])


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


def stopping_rule(results: xr.Dataset) -> StoppingRule | None:
    """Return the rule by which a dataset's sampling was stopped; None if it was not."""
    try:
        # To read a pipeline takes milliseconds.
        if SEARCH not in pipeline_text(results):
            return None
        return stored_pipeline(results).stopping
    except (KeyError, SweepError):
        return None


def is_sampling_stopped(results: xr.Dataset) -> bool:
    """Return whether a dataset is of a pipeline whose sampling stops when results suffice."""
    return stopping_rule(results) is not None


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


def stacked(arrays: Sequence[xr.DataArray], dim: str) -> xr.DataArray:
    """Return arrays of the same coordinates as one, whose last dimension is a new one."""
    return xr.concat(
        arrays, dim=dim, coords="minimal", compat="override", join="exact",
    ).transpose(..., dim)


# --------------------------------------------------------------------------------------------------
# Values of a parameter, from a dataset's coordinates or the pipeline in its attributes.

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


# --------------------------------------------------------------------------------------------------
# Attributes of tables for readers: short names, and the rule by which sampling was stopped.

P = ParamSpec("P")

SAMPLING = "sampling"
"""The attribute of tables of datasets whose sampling was stopped."""


def describes(analysis: Callable[P, xr.Dataset]) -> Callable[P, xr.Dataset]:
    """Return an analysis whose result has short names, and says whether sampling was stopped."""
    @functools.wraps(analysis)
    def described(*args: P.args, **kwargs: P.kwargs) -> xr.Dataset:
        table = with_descriptions(analysis(*args, **kwargs))
        return with_sampling(table, *(
            each for each in (*args, *kwargs.values()) if isinstance(each, xr.Dataset)))

    return described


def with_sampling(table: xr.Dataset, *datasets: xr.Dataset) -> xr.Dataset:
    """Return a table with the attribute :data:`SAMPLING`, if sampling of a dataset was stopped."""
    texts = dict.fromkeys(text for each in datasets if (text := sampling_text(each)))
    return table.assign_attrs({SAMPLING: "; ".join(texts)}) if texts else table


def sampling_text(results: xr.Dataset) -> str:
    """Return the rule by which a dataset's sampling was stopped; empty if it was not.

    That is ``stopped by [search]: along = distance_m, max_trials = 240``.
    """
    if not is_sampling_stopped(results):
        return ""
    table = read_document(pipeline_text(results))[SEARCH]
    keys = ", ".join(f"{key} = {shown(value)}" for key, value in table.items())
    return f"stopped by [{SEARCH}]: {keys}"


# --------------------------------------------------------------------------------------------------
# Flags in words: the labels that a dataset's attributes give to the values of its flags.

UNKNOWN = "unknown"
"""Label of a value that the attributes do not name."""

UNNAMED = 255
"""Where a table of labels has :data:`UNKNOWN`: flags are stored as uint8, and none has so many."""

Labelled = TypeVar("Labelled", xr.Dataset, xr.DataArray)


def decode_flags(results: Labelled) -> Labelled:
    """Return results with every flag in words: ``"detected"`` in place of 1.

    Parameters
    ----------
    results
        A dataset or one of its variables, or any part of them. Variables without the attributes
        ``flag_values`` and ``flag_meanings`` (CF conventions, 3.5) stay as they are.

    Returns
    -------
    The same, lazy where it was. Flags are strings; cells without a value (NaN, as after ``where``)
    are ``not_run``, the meaning of the fill value 0; what is no flag's value, such as a mean of
    flags, is ``unknown``.

    Raises
    ------
    ArgumentError
        For what is no dataset and no variable of one.

    Examples
    --------
    >>> flags = xr.DataArray([1, 0], attrs={
    ...     "flag_values": [0, 1], "flag_meanings": "not_run detected"})
    >>> decode_flags(flags).values.tolist()
    ['detected', 'not_run']
    """
    if isinstance(results, xr.DataArray):
        return _decoded(results)
    if not isinstance(results, xr.Dataset):
        raise ArgumentError(
            "results", type(results).__name__,
            "expected a dataset, as sweep.open returns it, or a variable of one",
        )
    return results.assign({  # without its coordinates, which are those of the results
        name: _decoded(variable).variable for name, variable in results.data_vars.items()
    })


def _decoded(variable: xr.DataArray) -> xr.DataArray:
    attributes = dict(variable.attrs)
    meanings = str(attributes.pop("flag_meanings", "")).split()
    values = np.atleast_1d(np.asarray(attributes.pop("flag_values", [])))
    if not meanings or len(meanings) != len(values) or variable.dtype.kind not in "uif":
        return variable
    labels = np.full(256, UNKNOWN, dtype=f"U{max(map(len, (*meanings, UNKNOWN)))}")
    labels[values.astype(np.intp)] = meanings

    def look_up(flags: NDArray[Any]) -> NDArray[Any]:
        known = np.nan_to_num(flags, nan=0.0) if flags.dtype.kind == "f" else np.asarray(flags)
        index = np.clip(known, 0, UNNAMED).astype(np.uint8)
        return labels[np.where(index == known, index, UNNAMED)]

    words: xr.DataArray = xr.apply_ufunc(
        look_up, variable, dask="parallelized", output_dtypes=[labels.dtype]
    )
    words.attrs = attributes
    return words
