"""The parts of a dataset that analyses read: axes, draws, stored parameters, labels of flags."""

from __future__ import annotations

import contextlib
import functools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.poses import (
    AXIS,
    DETECTION_INPUTS,
    ERROR_INPUTS,
    NOT_AVAILABLE,
    NOT_LOOKED_FOR,
)
from sweep.errors import ArgumentError, DatasetError, SweepError
from sweep.experiment.document import SEARCH, read_document
from sweep.experiment.draws import REPLICATES
from sweep.experiment.parameters import GEOMETRY_SECTIONS, PARAMETERS, PHOTOGRAPHS, Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule
from sweep.experiment.schema import FIXED, LABELS, SCHEMA, with_descriptions
from sweep.messages import shown
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.plugins.declared import recorded_plugins

# --------------------------------------------------------------------------------------------------
# The kinds of a dataset's dimensions, and which of them the caller keeps.

#: The dimension of random draws.
DRAWS = "trial"

Labelled = TypeVar("Labelled", xr.Dataset, xr.DataArray)


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
    """Return whether the scenes are photographs: the draws are then photographs."""
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
    """Return the record of its run in a dataset's attributes.

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
    names = tuple(dict.fromkeys(as_names(per)))
    require_poses(results)
    axes = axes_of(results)
    for name in names:
        if name in axes:
            continue
        along = results[name].dims if name in results.coords else ()
        problem = f"no such dimension; there are {', '.join(axes) or 'none'}"
        if DRAWS in along:
            problem = ("is drawn in this store, which has no axis of it: run it with "
                       f'{name} = [...] under [axes], or, in Python, give bins={{"{name}": [...]}}')
        elif len(along) == 1:
            problem = f"goes with the axis {along[0]}: name that"
        raise ArgumentError("per", name, problem)
    return names


def require_poses(results: xr.Dataset) -> None:
    """Raise DatasetError unless a dataset has the variables of results, and poses.

    Of boards' markers (`sweep.analysis.per_marker`) it has detections alone.
    """
    required = DETECTION_INPUTS if AXIS in results.dims else ERROR_INPUTS
    lacking = [name for name in required if name not in results]
    if lacking:
        present = ", ".join(map(str, results.data_vars)) or "none"
        raise DatasetError(f"no variable {', '.join(lacking)}; there are {present}")
    empty = [name for name in axes_of(results) if results.sizes[name] == 0]
    if empty:
        raise DatasetError(f"there are no poses: {', '.join(empty)} has no values")


def require_dimension(results: xr.Dataset, name: str) -> None:
    """Raise DatasetError unless a dataset has a dimension, the variables of results, and poses."""
    require_poses(results)
    axes = axes_of(results)
    if name not in axes:
        raise DatasetError(f"{name}: no such dimension; there are {', '.join(axes) or 'none'}")


def each_cell(
    table: xr.Dataset, dims: Sequence[str]
) -> Iterator[tuple[dict[str, Any], xr.Dataset]]:
    """Yield the coordinates along some dimensions, and the part of a table, of each cell."""
    for index in np.ndindex(*(table.sizes[dim] for dim in dims)):
        cell = table.isel(dict(zip(dims, index, strict=True)))
        yield {dim: cell[dim].item() for dim in dims}, cell


def largest_cell(table: xr.Dataset, values: xr.DataArray) -> xr.Dataset:
    """Return the cell of a table at which values over some of its dimensions are largest."""
    index = np.unravel_index(int(np.argmax(values.to_numpy())), values.shape)
    return table.isel(dict(zip(values.dims, map(int, index), strict=True)))


def stacked(parts: Sequence[Labelled], dim: str) -> Labelled:
    """Return arrays, or tables, of the same coordinates as one, whose last dimension is new."""
    options: Any = {"data_vars": "all"} if isinstance(parts[0], xr.Dataset) else {}
    return xr.concat(
        parts, dim=dim, coords="minimal", compat="override", join="exact", **options,
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
# Replicates of Sobol' points.

def is_replicated(results: xr.Dataset) -> bool:
    """Return whether the draws of a dataset are Sobol' points."""
    return fingerprint_of(results).get("sampling") == "sobol"


def replicate_order(results: xr.Dataset, draws: Sequence[str]) -> NDArray[np.intp] | None:
    """Return the indices of the trials, replicate by replicate; None if not replicated.

    ``draws`` are the pooled dimensions of draws.

    Raises
    ------
    DatasetError
        If the dataset does not have equally many trials of each replicate.
    """
    if not is_replicated(results) or DRAWS not in draws:
        return None
    trials = results[DRAWS].to_numpy().astype(np.int64)
    replicate = trials % REPLICATES
    counts = np.bincount(replicate, minlength=REPLICATES)
    if np.ptp(counts):
        raise DatasetError(
            f"{DRAWS}: not equally many of each of the {REPLICATES} replicates of Sobol' points "
            f"(sampling = sobol); keep a multiple of {REPLICATES} in a row, from a multiple of "
            f"{REPLICATES} on"
        )
    return np.argsort(replicate, kind="stable")


# --------------------------------------------------------------------------------------------------
# Trials that all pooled cells have, where sampling was stopped, and scenes that were computed.
#
# Conditions that are hard to judge have more trials. A rate over conditions that counts all of
# them would be one of mostly hard ones. So what is pooled is pooled over the trials that all
# pooled cells have: each counts as it does in a store of equally many trials. Cells in which no
# pose was looked for have nothing to count, and do not lessen these trials.

def common_trials(
    results: xr.Dataset, inputs: Mapping[str, xr.DataArray], kept: Sequence[str]
) -> xr.DataArray:
    """Return which trials all pooled cells have, computed.

    Parameters
    ----------
    results
        The dataset that names the axes.
    inputs
        Arrays by name; those whose name ends with ``detection`` hold flags of detection, and a
        trial must be in each.
    kept
        The dimensions that are not pooled.
    """
    scene = [name for name in axes_of(results, Stage.scene) if name != DRAWS]
    pooled = [name for name in scene if name not in kept]
    common = xr.DataArray(True)
    for name, array in inputs.items():
        if name.split()[-1] != "detection" or DRAWS not in array.dims or not pooled:
            continue
        # All configurations of a scene that is needed are computed.
        one = array.isel({dim: 0 for dim in array.dims if dim not in (*scene, DRAWS)}, drop=True)
        one = one.fillna(0) if one.dtype.kind == "f" else one
        counted = (~one.isin(NOT_LOOKED_FOR)).any(DRAWS)
        common = common & (~one.isin(NOT_AVAILABLE) | ~counted).all(
            [name for name in pooled if name in one.dims])
    return common.reset_coords(drop=True).compute()


def computed_scenes(results: xr.Dataset) -> xr.DataArray:
    """Return which scenes are computed (bool, over the axes of the scene).

    All configurations of a scene are computed, or none.
    """
    flags = results["detection"]
    first = {name: 0 for name in configuration_axes(results) if name in flags.dims}
    return ~flags.isel(first, drop=True).isin(NOT_AVAILABLE)


# --------------------------------------------------------------------------------------------------
# The side of the black square in pixels, over the axes that change it.

#: The usual axes along which the size in the image changes.
SIZE_AXES = ("side_px", "distance_m")

#: Parameters that determine the side: itself, or distance, size and camera.
SIZE_PARAMETERS = ("side_px", "distance_m", "size_m", *VIEW_PARAMETERS)


def image_sides(results: xr.Dataset) -> xr.DataArray:
    """Return the sides as if the square were parallel to the image plane: fx · size / distance.

    Parameters
    ----------
    results
        The dataset of a run.

    Returns
    -------
    xr.DataArray
        Sides in pixels over the dimensions that change them.

    Raises
    ------
    DatasetError
        If they cannot be computed, or are drawn.
    """
    by_side = "side_px" in results.coords
    for name in SIZE_PARAMETERS:
        if name in results.coords and DRAWS in results[name].dims and not (
                by_side and name == "distance_m"):
            raise DatasetError(f"{name}: is drawn, so that the side is no number of the grid")
    if by_side:
        return _checked(results["side_px"])
    return sides_of(functools.partial(parameter_value, results))


def sides_of(value: Callable[[str], Any]) -> xr.DataArray:
    """Return the sides in pixels from distance, size and camera.

    Parameters
    ----------
    value
        Returns the value of a parameter, or its values over the dimensions that it has.

    Raises
    ------
    DatasetError
        If they cannot be computed.
    """
    distance = value("distance_m")
    if distance is None:
        raise DatasetError(
            "distance_m: is no number of this store, whose poses are given in the world; a "
            "limit needs an axis distance_m or side_px (per= takes any axis for rates)")
    fx = xr.DataArray(intrinsics(*map(value, VIEW_PARAMETERS))[0])
    return _checked(fx * value("size_m") / distance)


def _checked(sides: xr.DataArray) -> xr.DataArray:
    """Return sides without coordinates of fixed parameters, if all can be."""
    sides = sides.astype(np.float64)
    if not (np.isfinite(sides) & (sides > 0)).all():
        raise DatasetError("sides must be finite and above 0 px: see the coordinates of the size, "
                           "the distance and the camera")
    return without_fixed(sides)


# --------------------------------------------------------------------------------------------------
# Attributes of tables for readers: short names, and the rule by which sampling was stopped.

P = ParamSpec("P")

#: The attribute of tables of datasets whose sampling was stopped.
SAMPLING = "sampling"


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

    An example is ``stopped by [search]: along = distance_m, max_trials = 240``.
    """
    if not is_sampling_stopped(results):
        return ""
    table = read_document(pipeline_text(results))[SEARCH]
    keys = ", ".join(f"{key} = {shown(value)}" for key, value in table.items())
    return f"stopped by [{SEARCH}]: {keys}"


# --------------------------------------------------------------------------------------------------
# Flags in words: the labels that a dataset's attributes give to the values of its flags.

#: Label of a value that the attributes do not name.
UNKNOWN = "unknown"


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
        For an object that is neither a dataset nor a variable of one.

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
    return results.assign({  # without its coordinates, which the results have
        name: _decoded(variable).variable for name, variable in results.data_vars.items()
    })


def _decoded(variable: xr.DataArray) -> xr.DataArray:
    attributes = dict(variable.attrs)
    meanings = str(attributes.pop("flag_meanings", "")).split()
    values = np.atleast_1d(np.asarray(attributes.pop("flag_values", [])))
    if not meanings or len(meanings) != len(values) or variable.dtype.kind not in "uif":
        return variable
    labels, ascending = np.array([*meanings, UNKNOWN]), np.argsort(values)

    def look_up(flags: NDArray[Any]) -> NDArray[Any]:
        flags = np.nan_to_num(flags, nan=0.0)
        at = ascending[np.searchsorted(values, flags, sorter=ascending).clip(max=len(values) - 1)]
        return labels[np.where(values[at] == flags, at, -1)]

    words: xr.DataArray = xr.apply_ufunc(
        look_up, variable, dask="parallelized", output_dtypes=[labels.dtype]
    )
    words.attrs = attributes
    return words
