"""What analyses read of a dataset: axes, draws, parameters, poses and their errors, flags."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, ParamSpec, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.errors import ArgumentError, DatasetError, SweepError, texts_of
from sweep.experiment.document import SEARCH, read_document
from sweep.experiment.draws import REPLICATES
from sweep.experiment.parameters import GEOMETRY_SECTIONS, PARAMETERS, PHOTOGRAPHS, Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule
from sweep.experiment.schema import FIXED, LABELS, SCHEMA, VARIABLES, XYZ, with_descriptions
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped, uncounted_values
from sweep.messages import nearest, shown
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.model.pose import angle_between, rotation_of_vector
from sweep.plugins.loading import recorded_plugins
from sweep.typing import Floats, Masks

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


def sections_of(name: object, results: xr.Dataset) -> set[str]:
    """Return the sections of a dimension's parameters: one, or those that go together."""
    attributes = results[name].attrs if name in results.coords else {}
    return {PARAMETERS[each].section for each in str(attributes.get("zip", name)).split()
            if each in PARAMETERS}


def is_grid_axis(name: object, results: xr.Dataset) -> bool:
    """Return whether a dimension is of the camera, the marker or the pose: it makes cells.

    Of parameters that go together one such suffices. Photographs have no cells: what is seen in
    one photograph together counts as one draw, for its errors are correlated.
    """
    return not of_photographs(results) and not sections_of(name, results).isdisjoint(
        GEOMETRY_SECTIONS)


def is_fixed(coordinate: xr.DataArray) -> bool:
    """Return whether a coordinate is a parameter with one value on the whole grid."""
    return not coordinate.dims and FIXED in coordinate.attrs


def fingerprint_of(results: xr.Dataset) -> Mapping[str, Any]:
    """Return the fingerprint in a dataset's attributes; empty if they have none."""
    fingerprint = _run_metadata(results).get("fingerprint")
    return fingerprint if isinstance(fingerprint, Mapping) else {}


def stored_pipeline(results: xr.Dataset) -> Pipeline | None:
    """Return the pipeline in a dataset's attributes, without files and plug-ins; None without."""
    try:
        return Pipeline.from_text(
            str(results.attrs["pipeline"]), files=fingerprint_of(results).get("files", {}),
            plugins=recorded_plugins(_run_metadata(results)))
    except (KeyError, SweepError):
        return None


def stopping_rule(results: xr.Dataset) -> StoppingRule | None:
    """Return the rule by which a dataset's sampling was stopped; None if it was not."""
    # To read a pipeline takes milliseconds.
    if SEARCH not in str(results.attrs.get("pipeline")):
        return None
    pipeline = stored_pipeline(results)
    return None if pipeline is None else pipeline.stopping


def _run_metadata(results: xr.Dataset) -> Mapping[str, Any]:
    """Return the record of its run in a dataset's attributes.

    It is JSON as `sweep.open` returns it, a mapping as Zarr has it; empty if there is none.
    """
    metadata = results.attrs.get("sweep")
    if isinstance(metadata, str) and metadata.startswith("{"):  # else it is somebody else's
        metadata = json.loads(metadata)
    return metadata if isinstance(metadata, Mapping) else {}


def as_names(per: Sequence[str]) -> tuple[str, ...]:
    """Return names of dimensions as a tuple: several, or a single one as a string.

    Raises
    ------
    ArgumentError
        If ``per`` is not a list of names.
    """
    return tuple(texts_of("per", per, "names of dimensions"))


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
    pose_arrays(results, DETECTION_INPUTS if AXIS in results.dims else ERROR_INPUTS)
    empty = [name for name in axes_of(results) if results.sizes[name] == 0]
    if empty:
        raise DatasetError(f"there are no poses: {', '.join(empty)} has no values")


def require_draws(results: xr.Dataset, kept: Sequence[str]) -> None:
    """Raise unless there are draws to make intervals of."""
    if DRAWS in kept:
        raise ArgumentError("per", DRAWS, "intervals are over the draws; they cannot be kept")
    if results.sizes.get(DRAWS, 1) < 2:
        raise DatasetError(
            "trial: this store has a single draw of each pose, so that nothing tells how far its "
            "numbers are chance; give the pipeline something drawn (jitter_px = 0.5, noise_grey) "
            "and trial = 100 under [axes], and run it again")


def each_cell(
    table: xr.Dataset, dims: Sequence[str]
) -> Iterator[tuple[dict[str, Any], xr.Dataset]]:
    """Yield the coordinates along some dimensions, and the part of a table, of each cell."""
    for index in np.ndindex(*(table.sizes[dim] for dim in dims)):
        cell = table.isel(dict(zip(dims, index, strict=True)))
        yield {dim: cell[dim].item() for dim in dims}, cell


def of_cells(
    rows: Sequence[Mapping[str, Any]], sizes: Sequence[int]
) -> dict[str, NDArray[Any]]:
    """Return arrays (*sizes, ...) by name, of a row of values for each cell, the last one fastest.

    >>> of_cells([{"end": [1, 2]}, {"end": [3, 4]}], [2, 1])["end"].shape
    (2, 1, 2)
    """
    columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return {name: column.reshape([*sizes, *column.shape[1:]]) for name, column in columns.items()}


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
        If the dataset has it neither as a coordinate nor in the pipeline of its attributes.
    """
    if name in results.coords:
        return results[name].reset_coords(drop=True)
    pipeline = stored_pipeline(results)
    if pipeline is None:
        raise DatasetError(
            f"{name}: not a coordinate, and the attributes hold no pipeline that has it")
    if pipeline.axis_of(name) is not None or name in pipeline.distributions:
        raise DatasetError(f"{name}: varies in this store, but the dataset lacks its coordinate")
    return pipeline.fixed.get(name, pipeline.parameters[name].default)


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
        one = one.fillna(0)
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
# The size in the image.

#: The usual axes along which the size in the image changes.
SIZE_AXES = ("side_px", "distance_m")


def focal_size_of(results: xr.Dataset) -> xr.DataArray:
    """Return fx times the side of the black square, px · m, over the dimensions that it has.

    Raises
    ------
    DatasetError
        If a parameter is not known.
    """
    try:
        values = {name: parameter_value(results, name) for name in (*VIEW_PARAMETERS, "size_m")}
    except DatasetError:
        if "side_px" not in results.coords:
            raise
        product = results["side_px"] * results["true_tvec_m"].isel(xyz=2, drop=True)
    else:
        fx = intrinsics(*(values[name] for name in VIEW_PARAMETERS))[0]
        product = xr.DataArray(fx) * values["size_m"]
    return product.astype(np.float64).reset_coords(drop=True)


# --------------------------------------------------------------------------------------------------
# The markers of boards as poses of their own: for rates and corners of each marker.

#: The dimension of a board's markers where they are an axis.
AXIS = "board_marker"

#: Variable of boards -> its name where the markers are an axis.
OF_MARKERS = {"marker_detection": "detection", "marker_corner_error_px": "corner_error_px"}


def per_marker(results: xr.Dataset) -> xr.Dataset:
    """Return the detections of a board's markers, each marker on its own.

    Parameters
    ----------
    results
        The dataset of a run whose scenes show boards.

    Returns
    -------
    xr.Dataset
        The markers are the axis ``board_marker``, a marker's number on its board from 0 on: in
        reading order, of an aprilgrid from the bottom left upwards, of ``[[board.markers]]`` as
        listed. It is no ID: that is ``board_marker_id``. Lazy if ``results`` is.

        - ``detection``: the flags of each marker, ``not_on_board`` (which no rate counts) where a
          scene's board has fewer markers than another's.
        - ``corner_error_px``: found corner minus true corner of the detected ones.
        - ``board_marker_id``, and ``true_rvec`` and ``true_tvec_m`` of the board.

        Estimates are the board's and are left out, as are bounds and the area.

    Raises
    ------
    DatasetError
        If the scenes show no boards.

    Notes
    -----
    Markers of one image see the same draws. Where they are pooled they count as one draw, as
    settings do (`sweep.analysis.estimator`), so that intervals of rates over all markers are right
    however much neighbours fail together.

    Examples
    --------
    >>> twice = xr.concat([results["detection"]] * 2, dim="marker").transpose(..., "marker")
    >>> markers = per_marker(results.assign(marker_detection=twice))
    >>> markers["detection"].dims[-1], markers["detection"].sizes["board_marker"]
    ('board_marker', 2)
    """
    if "marker_detection" not in results:
        raise DatasetError("no variable marker_detection: the scenes show no boards")
    # The pose of the whole board holds for each of its markers, too.
    kept = [name for name in ("true_rvec", "true_tvec_m", "board_marker_id", *OF_MARKERS)
            if name in results]
    markers = results[kept].rename({
        "marker": AXIS, **{name: new for name, new in OF_MARKERS.items() if name in kept}
    })
    return markers.transpose(..., *(
        dim for dim in ("corner", "xy", "xyz") if dim in markers.dims))


# --------------------------------------------------------------------------------------------------
# Angles of rotations.

def _angles(rotation: Floats) -> Floats:
    """Return yaw, pitch and roll (..., 3) in radians, of R = Ry · Rx · Rz · Rx(180°)."""
    across, down, along = rotation[..., 0, 2], rotation[..., 1, 2], rotation[..., 2, 2]
    return np.stack([
        np.arctan2(-across, -along), np.arctan2(down, np.hypot(across, along)),
        np.arctan2(rotation[..., 1, 0], -rotation[..., 1, 1])], axis=-1)


def wrapped_deg(angle: Floats) -> Floats:
    """Return angles in radians as degrees in [-180, 180].

    Examples
    --------
    >>> wrapped_deg(np.radians([-350.0, 180.0, 179.0])).round(9).tolist()
    [10.0, 180.0, 179.0]
    """
    return np.degrees(angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi)))


# --------------------------------------------------------------------------------------------------
# The sight frame: the camera's frame, turned by the shortest way so that z is the line of sight.
#
# On the optical axis it is the camera's frame. Elsewhere the error along the line of sight, which
# is by far the largest, would be in x and y of the camera in proportion to the bearing.

def sight_rotation(position_m: Floats) -> Floats:
    """Return the rotations Q (..., 3, 3) whose columns are the sight frame's axes in the camera's.

    With the direction w = (a, b, c) to the marker and k = 1 / (1 + c) they are (1 - k a², -k a b,
    -a), (-k a b, 1 - k b², -b) and w: the rotation of z to w about their cross product (Rodrigues).

    Examples
    --------
    >>> sight_rotation(np.array([0.0, 3.0, 4.0])).round(3).tolist()
    [[1.0, -0.0, 0.0], [-0.0, 0.8, 0.6], [-0.0, -0.6, 0.8]]
    """
    position_m = np.asarray(position_m, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        w = position_m / np.linalg.norm(position_m, axis=-1, keepdims=True)
        a, b, c = w[..., 0], w[..., 1], w[..., 2]
        k = 1.0 / (1.0 + c)
        rows = [[1.0 - k * a * a, -k * a * b, a], [-k * a * b, 1.0 - k * b * b, b], [-a, -b, c]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def in_sight_frame(vectors: Floats, position_m: Floats) -> Floats:
    """Return vectors (..., 3) of the camera's frame as Qᵀ v in the sight frame of positions."""
    return np.asarray(
        np.einsum("...ij,...i->...j", sight_rotation(position_m), np.asarray(vectors, dtype=float)))


def viewing_angle_of(rvec: Floats, position_m: Floats) -> Floats:
    """Return the angles (...) in degrees between the marker's normal and the line of sight."""
    normal = rotation_of_vector(np.asarray(rvec, dtype=np.float64))[..., 2]
    return np.degrees(angle_between(normal, -np.asarray(position_m, dtype=np.float64)))


def bearing_of(position_m: Floats) -> Floats:
    """Return the angles (...) in degrees between the lines of sight and the optical axis."""
    x, y, z = np.moveaxis(np.asarray(position_m, dtype=np.float64), -1, 0)
    return np.asarray(np.degrees(np.arctan2(np.hypot(x, y), z)))


# --------------------------------------------------------------------------------------------------
# Poses of a block as statistics read them: which are counted, and their errors.

#: Flags of detection of the poses that are in no denominator.
NOT_LOOKED_FOR = tuple(uncounted_values(DetectionStatus))

#: Flags of detection of the poses that were not run.
NOT_AVAILABLE = (DetectionStatus.not_run, DetectionStatus.not_needed)

#: Name of the mask of the poses that count at all, if not all do.
INSIDE = "inside"

#: Name of the mask of the trials that all pooled cells have, where sampling was stopped.
COMMON = "common"

#: Names of the variables that a statistic of detections, of estimates, of errors reads, one of
#: errors along axes and about angles, and one of errors and their bounds.
DETECTION_INPUTS = ("detection",)
ESTIMATE_INPUTS = (*DETECTION_INPUTS, "estimate", "flipped")
ERROR_INPUTS = (*ESTIMATE_INPUTS, "rotation_error_rad", "translation_error_m", "true_tvec_m")
SIGNED_INPUTS = (*ERROR_INPUTS, "true_rvec")
BOUND_INPUTS = (*ERROR_INPUTS, "bound_std")


def pose_arrays(results: xr.Dataset, names: Sequence[str]) -> dict[str, xr.DataArray]:
    """Return a dataset's variables by name; of true positions without rotations z alone.

    Raises
    ------
    DatasetError
        If the dataset lacks some.
    """
    lacking = ", ".join(name for name in dict.fromkeys(names) if name not in results)
    if lacking and AXIS in results.dims:
        raise DatasetError(
            f"no variable {lacking}: a board's markers have detections alone; estimates "
            "are the board's: give the dataset that per_marker was given")
    if lacking:
        raise DatasetError(f"no variable {lacking}; "
                           f"there are {', '.join(map(str, results.data_vars)) or 'none'}")
    arrays = {name: results[name] for name in names}
    if "true_tvec_m" in arrays and "true_rvec" not in arrays:  # `Poses.percent_of_depth`
        arrays["true_tvec_m"] = arrays["true_tvec_m"].isel(xyz=slice(2, None))
    return arrays


class Poses:
    """Poses of a block: arrays (groups, cells, draws, settings, ...), by name.

    Those outside the mask `INSIDE` count as not run, those outside `COMMON` as not needed. The
    masks and errors have the shape (groups, cells, draws, settings).

    Parameters
    ----------
    arrays
        The arrays, by the names of `pose_arrays` with ``prefix`` in front, `INSIDE` and `COMMON`.
    prefix
        What stands before the names of these poses' arrays in ``arrays``, if it has others too.

    Examples
    --------
    >>> poses = Poses({"true_rvec": np.array([np.pi, 0.0, 0.0]), "true_tvec_m": np.eye(3)[2] * 2,
    ...                "rotation_error_rad": np.array([0.0, 0.0, np.pi / 2]),
    ...                "translation_error_m": np.array([0.0, 0.0, 0.5])})
    >>> poses.yaw_pitch_roll_deg.round(9) + 0.0, poses.in_plane_deg.round(9)
    (array([ 0.,  0., 90.]), np.float64(-90.0))
    >>> poses.of_camera_m.round(9) + 0.0
    array([0. , 0. , 0.5])
    """

    def __init__(self, arrays: dict[str, NDArray[Any]], prefix: str = "") -> None:
        self._arrays = arrays
        self._prefix = prefix
        #: Squared absolute errors (..., 1) by the name of their `Quantity`, once computed.
        self.squares: dict[str, Floats] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return an array, of flags 0 (not run) for the poses that do not count."""
        array = self._arrays[self._prefix + name]
        if name in VARIABLES and VARIABLES[name].flags is not None:
            if array.dtype.kind == "f":
                # A dataset that was cut or joined has NaN where nothing was run.
                array = np.nan_to_num(array, nan=0.0)
            if INSIDE in self._arrays:
                array = np.where(self.inside, array, 0)
            if COMMON in self._arrays:
                array = np.where(
                    self._arrays[COMMON] | (array == 0), array, VARIABLES[name].not_needed)
        return array

    @property
    def inside(self) -> Masks:
        """Poses that count at all."""
        return self._arrays.get(INSIDE, np.ones((), dtype=bool))

    @functools.cached_property
    def detection(self) -> NDArray[np.uint8]:
        """Flags of `DetectionStatus`."""
        return self["detection"]

    @functools.cached_property
    def estimate(self) -> NDArray[np.uint8]:
        """Flags of `EstimateStatus`."""
        return self["estimate"]

    @functools.cached_property
    def run(self) -> Masks:
        """Poses that were run."""
        return is_none_of(self.detection, NOT_AVAILABLE)

    @functools.cached_property
    def looked_for(self) -> Masks:
        """Poses whose detection is counted: run, visible and modelled."""
        return is_none_of(self.detection, NOT_LOOKED_FOR)

    @functools.cached_property
    def detected(self) -> Masks:
        """Detected poses."""
        return np.asarray(self.detection == DetectionStatus.detected)

    @functools.cached_property
    def solved(self) -> Masks:
        """Solved poses."""
        return np.asarray(self.estimate == EstimateStatus.solved)

    @functools.cached_property
    def flipped(self) -> Masks:
        """Solved poses that are nearer to the mirror of the truth."""
        return np.asarray(self.solved & (self["flipped"] == Flipped.flipped))

    @functools.cached_property
    def unflipped(self) -> Masks:
        """Solved poses that are not flipped."""
        return self.solved & ~self.flipped

    @functools.cached_property
    def range_percent(self) -> Floats:
        """Depth error in percent of the true depth, (..., 1)."""
        return self.percent_of_depth(self["translation_error_m"][..., 2])[..., None]

    def percent_of_depth(self, length: NDArray[Any]) -> Floats:
        """Return lengths (...) in percent of the true z."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return 100.0 * np.asarray(length / self["true_tvec_m"][..., -1], dtype=np.float64)

    # Errors along axes and about angles, signed: estimated minus true.
    #
    # R and t are the true rotation and position of the marker in the camera's frame, E the rotation
    # of the error and d the error of position as stored: the estimated pose is E · R, t + d.
    # Nothing cancels for small errors but the last digit of the true angle, and angles near 180
    # degrees are as exact as others (atan2). NaN if any input is.

    @functools.cached_property
    def in_camera_m(self) -> Floats:
        """d, (..., xyz): the position's error along the axes of the camera."""
        return np.asarray(self["translation_error_m"], dtype=np.float64)

    @functools.cached_property
    def along_marker_m(self) -> Floats:
        """Rᵀ d, (..., xyz): the position's error along the axes of the true marker."""
        return self._in_marker_frame(self.in_camera_m)

    @functools.cached_property
    def of_camera_m(self) -> Floats:
        """Error (..., xyz) of the camera's position in the marker's frame.

        The camera is at -Rᵀ t, a robot that knows the marker's place believes to be at
        -(E R)ᵀ (t + d): the error is -Rᵀ (Eᵀ (t + d) - t).
        """
        moved = self.in_camera_m + self._turned(self["true_tvec_m"] + self.in_camera_m, -1.0)
        return -self._in_marker_frame(moved)

    @functools.cached_property
    def yaw_pitch_roll_deg(self) -> Floats:
        """Differences (..., 3) of the angles of R = Ry(yaw) · Rx(pitch) · Rz(roll) · Rx(180°).

        In [-180, 180]; yaw and roll are not defined at a pitch of 90 degrees.
        """
        return wrapped_deg(_angles(self._estimated) - _angles(self._rotation))

    @functools.cached_property
    def tilt_deg(self) -> Floats:
        """Difference (...) of the angles between the marker's plane and the image plane."""
        optical_axis = np.array([0.0, 0.0, 1.0])
        return self._difference(optical_axis, optical_axis)

    @functools.cached_property
    def viewing_angle_deg(self) -> Floats:
        """Difference (...) of the angles between the normal and the line of sight to the centre."""
        return self._difference(self["true_tvec_m"] + self.in_camera_m, self["true_tvec_m"])

    @functools.cached_property
    def in_plane_deg(self) -> Floats:
        """The part of E (...) about the true normal, in [-180, 180]: its twist.

        With the quaternion (w, v) of E and the normal n it is 2 atan2(v · n, w), which is what is
        left of E if the shortest rotation that moves the normal as E does comes after it:
        Dobrowolski, "Swing-twist decomposition in Clifford algebra", arXiv:1506.05481, 2015.
        """
        error = np.asarray(self["rotation_error_rad"], dtype=np.float64)
        half = np.linalg.norm(error, axis=-1) / 2.0
        along = (error * self._rotation[..., 2]).sum(axis=-1)
        sine = along * np.sinc(half / np.pi) / 2.0  # sin(half) / angle is sinc / 2
        return np.asarray(np.degrees(2.0 * np.arctan2(sine, np.cos(half))))

    @functools.cached_property
    def _rotation(self) -> Floats:
        """R, (..., 3, 3)."""
        return rotation_of_vector(np.asarray(self["true_rvec"], dtype=np.float64))

    @functools.cached_property
    def _estimated(self) -> Floats:
        """E · R, (..., 3, 3)."""
        columns = np.swapaxes(self._rotation, -1, -2)
        return np.swapaxes(columns + self._turned(columns, 1.0, inner=1), -1, -2)

    def _in_marker_frame(self, vectors: Floats) -> Floats:
        return np.asarray(np.einsum("...ij,...i->...j", self._rotation, vectors))

    def _turned(self, vectors: Floats, sign: float, inner: int = 0) -> Floats:
        """Return (E - 1) v, or (Eᵀ - 1) v for a sign of -1: Rodrigues' formula.

        ``inner`` axes stand before the last of ``vectors``.
        """
        error = sign * np.asarray(self["rotation_error_rad"], dtype=np.float64)
        error = error.reshape(*error.shape[:-1], *[1] * inner, 3)
        angle = np.linalg.norm(error, axis=-1, keepdims=True)
        across = np.cross(error, vectors)
        # sin(a) / a, and (1 - cos(a)) / a² without a difference
        return np.asarray(np.sinc(angle / np.pi) * across
                          + 0.5 * np.sinc(angle / (2.0 * np.pi))**2 * np.cross(error, across))

    def _difference(self, estimated: Floats, true: Floats) -> Floats:
        """Return the angle of the estimated normal to a direction minus the true normal's."""
        return np.asarray(np.degrees(angle_between(self._estimated[..., 2], -estimated)
                                     - angle_between(self._rotation[..., 2], -true)))


def is_none_of(flags: NDArray[np.uint8], values: Sequence[int]) -> Masks:
    """Return where flags (..., settings) have none of some values.

    `numpy.isin` takes five times as long.
    """
    # Flags of detection are the same for all solvers, repeated without having memory of their own.
    once = flags if flags.strides[-1:] != (0,) else flags[..., :1]
    # NumPy compares with a plain number as bytes, with an enumeration's member as int64.
    none = functools.reduce(np.logical_and, (once != int(value) for value in values))
    return np.broadcast_to(none, flags.shape)


def norm_squared(vectors: NDArray[Any]) -> Floats:
    """Return the squared norms of (..., components), bit for bit as NumPy's sum of squares.

    NumPy's loop along a short last axis takes three times as long.
    """
    return functools.reduce(np.add, (
        np.square(vectors[..., k], dtype=np.float64) for k in range(vectors.shape[-1])))


# --------------------------------------------------------------------------------------------------
# Kinds of errors of poses: what statistics are computed of, by name.

@dataclass(frozen=True)
class Quantity:
    """A kind of error of poses.

    Attributes
    ----------
    name
        In the names of variables.
    unit
        As in names, such as ``deg``.
    units
        As in attributes, such as ``degree``.
    words
        As in meanings.
    vector
        The error vectors (..., components) of poses.
    bound
        The largest absolute error that exists; None if there is none.
    signed
        Whether it has a sign, and one component.
    inputs
        Names of the arrays that it reads, as in `sweep.analysis.dataset.pose_arrays`.
    """

    name: str
    unit: str
    units: str
    words: str
    vector: Callable[[Poses], Floats]
    bound: float | None = None
    signed: bool = False
    inputs: tuple[str, ...] = ERROR_INPUTS

    def norm(self, poses: Poses) -> Floats:
        """Return the absolute errors (...)."""
        return np.sqrt(self.squares(poses)[..., 0])

    def squares(self, poses: Poses) -> Floats:
        """Return the squared absolute errors (..., 1)."""
        if self.name not in poses.squares:
            poses.squares[self.name] = norm_squared(self.vector(poses))[..., None]
        return poses.squares[self.name]

    def named(self, statistic: str) -> str:
        """Return a variable's name, such as ``rotation_p95_deg``."""
        return f"{self.name}_{statistic}_{self.unit}"


#: Kinds of error in `sweep.analysis.error_statistics` unless others are asked for.
QUANTITIES = (
    Quantity("rotation", "deg", "degree", "rotation error",
             lambda poses: np.degrees(poses["rotation_error_rad"], dtype=np.float64), bound=180.0),
    Quantity("range", "percent", "percent", "depth error of the true depth",
             lambda poses: poses.range_percent, signed=True),
    Quantity("position", "m", "m", "position error",
             lambda poses: poses["translation_error_m"].astype(np.float64)),
)


def _signed(source: str, unit: str, units: str, **words: str) -> tuple[Quantity, ...]:
    """Return the components of an attribute of `Poses`, or the attribute itself, by their names."""
    errors = attrgetter(source)

    def component(k: int, poses: Poses) -> Floats:
        values = errors(poses)
        return np.asarray(values[..., None] if len(words) == 1 else values[..., k : k + 1])

    return tuple(
        Quantity(name, unit, units, text, functools.partial(component, k), signed=True,
                 inputs=SIGNED_INPUTS)
        for k, (name, text) in enumerate(words.items()))


_IN_METRES, _IN_DEGREES = ("m", "m"), ("deg", "degree")

#: Errors with a sign, by groups: of these bias and standard deviation are computed.
SIGNED: dict[str, tuple[Quantity, ...]] = {
    "camera_frame": _signed("in_camera_m", *_IN_METRES, **{
        axis: f"position error along {axis} of the camera" for axis in XYZ}),
    "marker_frame": _signed("along_marker_m", *_IN_METRES, **{
        f"marker_frame_{axis}": f"position error along {axis} of the true marker"
        for axis in XYZ}),
    "camera_in_marker": _signed("of_camera_m", *_IN_METRES, **{
        f"camera_in_marker_{axis}": f"error of the camera's {axis} in the marker's frame"
        for axis in XYZ}),
    "yaw_pitch_roll": _signed("yaw_pitch_roll_deg", *_IN_DEGREES, **{
        name: f"{name} error" for name in ("yaw", "pitch", "roll")}),
    "angles": (
        *_signed("tilt_deg", *_IN_DEGREES, tilt="error of the angle to the image plane"),
        *_signed("viewing_angle_deg", *_IN_DEGREES,
                 viewing_angle="error of the angle between normal and line of sight"),
        *_signed("in_plane_deg", *_IN_DEGREES,
                 in_plane="rotation error about the true normal"),
    ),
}


#: Kinds of error by name.
ALL_QUANTITIES = {each.name: each for group in (QUANTITIES, *SIGNED.values()) for each in group}


def chosen_quantities(names: Iterable[str] | None) -> list[Quantity]:
    """Return the quantities of some names of quantities or groups, each once; default `QUANTITIES`.

    Raises
    ------
    ArgumentError
        For a name that is neither, or none at all.

    Examples
    --------
    >>> [quantity.name for quantity in chosen_quantities(["range", "yaw_pitch_roll", "yaw"])]
    ['range', 'yaw', 'pitch', 'roll']
    """
    if names is None:
        return list(QUANTITIES)
    known = {name: (each,) for name, each in ALL_QUANTITIES.items()} | SIGNED
    wanted = [names] if isinstance(names, str) else [*names] if isinstance(names, Iterable) else []
    if not wanted:
        raise ArgumentError("quantities", names, f"expected some of {', '.join(known)}")
    for name in wanted:
        if name not in known:
            raise ArgumentError(
                "quantities", name,
                f"no such error{nearest(str(name), [*known])}; there are {', '.join(known)}")
    return list({each.name: each for name in wanted for each in known[name]}.values())


# --------------------------------------------------------------------------------------------------
# Words for readers: short names of tables, and the rule by which sampling was stopped.

P = ParamSpec("P")


def require_dataset(name: str, given: object) -> None:
    """Raise ArgumentError unless what is given as an argument is a dataset."""
    if not isinstance(given, xr.Dataset):
        raise ArgumentError(name, type(given).__name__, "expected a dataset of sweep.open")


def describes(analysis: Callable[P, xr.Dataset]) -> Callable[P, xr.Dataset]:
    """Return an analysis that refuses other things than datasets; its result has short names.

    Examples
    --------
    >>> describes(axes_of)("runs/smoke.zarr")
    Traceback (most recent call last):
    sweep.errors.ArgumentError: results = str: expected a dataset of sweep.open
    """
    @functools.wraps(analysis)
    def described(*args: P.args, **kwargs: P.kwargs) -> xr.Dataset:
        for (name, kind), given in zip(analysis.__annotations__.items(), args, strict=False):
            if kind == "xr.Dataset":
                require_dataset(name, given)
        return with_descriptions(analysis(*args, **kwargs))

    return described


def sampling_text(results: xr.Dataset) -> str:
    """Return the rule by which a dataset's sampling was stopped; empty if it was not.

    An example is ``stopped by [search]: along = distance_m, max_trials = 240``.
    """
    if stopping_rule(results) is None:
        return ""
    table = read_document(str(results.attrs["pipeline"]))[SEARCH]
    keys = ", ".join(f"{key} = {shown(value)}" for key, value in table.items())
    return f"stopped by [{SEARCH}]: {keys}"


# --------------------------------------------------------------------------------------------------
# Flags in words: the labels that a dataset's attributes give to the values of its flags.


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
    require_dataset("results", results)
    return results.assign({  # without its coordinates, which the results have
        name: _decoded(variable).variable for name, variable in results.data_vars.items()
    })


def _decoded(variable: xr.DataArray) -> xr.DataArray:
    attributes = dict(variable.attrs)
    meanings = str(attributes.pop("flag_meanings", "")).split()
    values = np.atleast_1d(np.asarray(attributes.pop("flag_values", [])))
    if not meanings or len(meanings) != len(values) or variable.dtype.kind not in "uif":
        return variable
    labels, ascending = np.array([*meanings, "unknown"]), np.argsort(values)

    def look_up(flags: NDArray[Any]) -> NDArray[Any]:
        flags = np.nan_to_num(flags, nan=0.0)
        at = ascending[np.searchsorted(values, flags, sorter=ascending).clip(max=len(values) - 1)]
        return labels[np.where(values[at] == flags, at, -1)]

    words: xr.DataArray = xr.apply_ufunc(
        look_up, variable, dask="parallelized", output_dtypes=[labels.dtype], keep_attrs=False)
    return words.assign_attrs(attributes)
