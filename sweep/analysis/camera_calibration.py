"""Camera calibration as an experiment: sets of a board's views through OpenCV's calibration.

The views are the trials of a store whose scenes show boards. Their poses are drawn, so that sets
of views that have none in common are independent calibrations.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import xarray as xr

from sweep.analysis.dataset import DRAWS, axes_of, describes, of_cells, stored_pipeline
from sweep.analysis.estimator import DEVIATIONS, wilson
from sweep.errors import ArgumentError, DatasetError, check_positive
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import CalibrationStatus
from sweep.measure.intrinsics import FREE_COEFFICIENTS, INTRINSICS, MIN_VIEWS, Intrinsics, calibrate
from sweep.measure.solver import GuardedPoints
from sweep.model.camera import Cameras
from sweep.model.lens import pack
from sweep.model.pose import rotation_of_vector, transform_points
from sweep.model.scene import build_cameras
from sweep.typing import Floats

#: Where in the frame the target is whose position is estimated with the calibrated camera: share
#: of the way from the principal point to the frame's corner.
DIRECTIONS = {"centre": 0.0, "corner": 0.8}

#: The points of a calibration -> the variable that has their errors.
POINTS = {"chessboard": "chessboard_corner_error_px", "markers": "marker_corner_error_px"}

#: Variables of calibrations: dimensions of their own, meaning, units, flags.
OUTPUTS: dict[str, tuple[Any, ...]] = {
    "calibration": ((), "what became of the calibration", "", CalibrationStatus),
    "used_views": ((), "views with enough of the board"),
    "rms_px": ((), "root mean square of the residuals", "px"),
    "intrinsic_error": (("intrinsic",), "estimated minus true", "px, 1"),
    "intrinsic_std": (("intrinsic",), "standard deviation that OpenCV reports", "px, 1"),
    "position_error_m": (("direction", "xyz"), "error of a target's position, camera frame", "m"),
}


@describes
def camera_calibrations(
    results: xr.Dataset, views: Sequence[int], *, points: str | None = None, coefficients: int = 5,
    target_m: float = 3.0, offset_px: float = 0.0,
) -> xr.Dataset:
    """Return camera calibrations from sets of a board's views, and their errors.

    Parameters
    ----------
    results
        Results of a pipeline whose scenes show a board, with trials.
    views
        Numbers of views in a set. The trials are cut into sets of the largest number; smaller sets
        are the first views of those, so that numbers of views are compared on the same images.
    points
        "chessboard" or "markers": the points that are used; by default the chessboard's if there
        is one.
    coefficients
        Lens coefficients that are estimated: 0, 1 (k1), 2 (k2), 4 (p1, p2) or 5 (k3). The others
        are taken for 0.
    target_m
        Distance of a target whose position is estimated with each calibrated camera, m.
    offset_px
        Added to all pixels: 0.5 is the error of a program that takes the first pixel's corner for
        the origin, where OpenCV has its centre.

    Returns
    -------
    xr.Dataset
        Dimensions: the axes of scene and detector, without ``trial``; ``views``, ``set``.

        - ``calibration``: :class:`~sweep.measure.flags.CalibrationStatus`, and ``used_views``.
        - ``intrinsic_error``, ``intrinsic_std`` (..., intrinsic): estimated minus true, and the
          standard deviation that OpenCV reports; fx to cy in px, the coefficients as they are.
        - ``rms_px``: OpenCV's residual.
        - ``position_error_m`` (..., direction, xyz): of a target of 0.2 m, parallel to the image
          plane at ``target_m``, in the frame's centre and most of the way to its corner, from
          points without noise: what the calibration alone does to a pose, camera frame.

    Raises
    ------
    ArgumentError
        If an argument is not as expected.
    DatasetError
        If the results show no boards, or have too few trials.

    Notes
    -----
    ``cv2.calibrateCameraExtended`` (Zhang, "A flexible new technique for camera calibration",
    2000), started from OpenCV's own first guess. Its standard deviations are those of least
    squares with the residuals' variance: they know nothing of errors that all views share, such as
    a board that is bent or corners that are biased.

    Examples
    --------
    >>> from sweep.errors import DatasetError
    >>> try:
    ...     camera_calibrations(results, [20])
    ... except DatasetError as error:
    ...     print(error)
    no pipeline in the dataset's attributes: expected results as sweep.open returns them
    """
    pipeline = stored_pipeline(results)
    if pipeline is None:
        raise DatasetError(
            "no pipeline in the dataset's attributes: expected results as sweep.open returns them")
    if not pipeline.shows_boards:
        raise DatasetError("the scenes show no board: give kind = charuco or grid under [board]")
    counts = sorted({int(count) for count in views})
    if not counts or counts[0] < MIN_VIEWS:
        raise ArgumentError("views", list(views), f"expected numbers of at least {MIN_VIEWS}")
    if coefficients not in FREE_COEFFICIENTS:
        raise ArgumentError("coefficients", coefficients,
                            f"expected one of {', '.join(map(str, FREE_COEFFICIENTS))}")
    check_positive("target_m", target_m, "expected a distance above 0 m")
    there = [name for name, variable in POINTS.items() if variable in results]
    points = next(iter(there), "") if points is None else points
    if points not in there:
        raise ArgumentError("points", points, f"expected one of {', '.join(there)}")
    trials = results.sizes.get(DRAWS, 1)
    sets = trials // counts[-1]
    if sets == 0:
        raise DatasetError(
            f"{trials} trials: expected at least {counts[-1]}, the views of a set; run the "
            "pipeline with a longer axis trial")
    dims = [dim for dim in axes_of(results, Stage.scene, Stage.detection) if dim != DRAWS]
    shape = [results.sizes[dim] for dim in dims]
    rows = []
    for index in itertools.product(*map(range, shape)):
        objects, pixels, camera, frame = _views(
            results, pipeline, dict(zip(dims, index, strict=True)), points)
        truth = np.concatenate([camera.view[0], camera.lenses[0, :5]])  # as INTRINSICS
        for count, number in itertools.product(counts, range(sets)):
            chosen = slice(number * counts[-1], number * counts[-1] + count)
            one = calibrate(objects[chosen], [each + offset_px for each in pixels[chosen]],
                            frame, coefficients)
            rows.append(dict(zip(OUTPUTS, (
                np.uint8(one.status), one.views, one.rms_px, one.values - truth, one.std,
                _position_errors(one, camera, frame, target_m)), strict=True)))
    columns = of_cells(rows, [*shape, len(counts), sets])
    variables = {
        name: ((*dims, "views", "set", *inner), columns[name], cf_attributes(*described))
        for name, (inner, *described) in OUTPUTS.items()}
    return xr.Dataset(
        variables,
        coords={
            **{dim: results[dim] for dim in dims if dim in results.coords},
            "views": counts, "set": np.arange(sets), "intrinsic": list(INTRINSICS),
            "direction": list(DIRECTIONS), "xyz": ["x", "y", "z"],
        },
        attrs={"points": points, "coefficients": coefficients, "target_m": target_m},
    )


#: Variables of their summary: meaning, units.
SUMMARY = {
    "bias": ("mean error", "px, 1"), "rmse": ("root mean square error", "px, 1"),
    "mean_std": ("root mean square of the reported standard deviations", "px, 1"),
    "coverage": ("share of reported 95 % intervals that hold the truth", "1"),
    "position_rmse_m": ("root mean square error of a target's position", "m"),
}


@describes
def calibration_summary(calibrated: xr.Dataset) -> xr.Dataset:
    """Return how good calibrations are, over their sets.

    Parameters
    ----------
    calibrated
        As :func:`camera_calibrations` returns them.

    Returns
    -------
    xr.Dataset
        Without ``set``; of the n sets with a camera, ``calibrated`` of ``tried``:

        - ``bias``, ``rmse``, ``mean_std`` (..., intrinsic): mean error and root mean square error,
          and the root mean square of the reported standard deviations.
        - ``coverage`` (..., intrinsic): share of the 95 % intervals, the estimate plus or minus
          1.96 reported standard deviations, that hold the truth; ``coverage_low``,
          ``coverage_high``: its 95 % interval (Wilson). NaN for numbers that are not estimated.
        - ``position_rmse_m`` (..., direction, xyz).

    Raises
    ------
    DatasetError
        If the dataset is not one that `camera_calibrations` returns.

    Notes
    -----
    A coverage far below 0.95 says that OpenCV's standard deviations are too small: of a bias that
    is the same in all views, or of a camera that the views do not determine.

    Examples
    --------
    >>> one = xr.Dataset({
    ...     "calibration": ("set", [1, 1]), "intrinsic_error": (("set", "intrinsic"), [[1.], [3.]]),
    ...     "intrinsic_std": (("set", "intrinsic"), [[1.], [1.]]),
    ...     "position_error_m": ("set", [0.01, 0.02]),
    ... })
    >>> float(calibration_summary(one)["coverage"][0])
    0.5
    """
    def squared_mean(values: xr.DataArray) -> xr.DataArray:
        return (values**2).mean("set") ** 0.5

    if "calibration" not in calibrated:
        raise DatasetError("no variable calibration: expected what camera_calibrations returns")
    solved = calibrated["calibration"] == CalibrationStatus.calibrated
    error, std = (calibrated[name].where(solved) for name in ("intrinsic_error", "intrinsic_std"))
    free, count = (std > 0).any("set"), solved.sum("set")
    held = ((abs(error) <= DEVIATIONS * std) & solved).sum("set")
    low, high = xr.apply_ufunc(wilson, held, count, output_core_dims=[[], []])
    found = {
        "tried": (calibrated["calibration"] != CalibrationStatus.not_run).sum("set"),
        "calibrated": count, "bias": error.mean("set"), "rmse": squared_mean(error),
        "mean_std": squared_mean(std), "coverage": (held / count.where(count > 0)).where(free),
        "coverage_low": low.where(free), "coverage_high": high.where(free),
        "position_rmse_m": squared_mean(calibrated["position_error_m"])}
    return xr.Dataset({
        name: array.assign_attrs(cf_attributes(*SUMMARY[name]) if name in SUMMARY else {})
        for name, array in found.items()}, attrs=calibrated.attrs)


def _views(
    results: xr.Dataset, pipeline: Pipeline, at: dict[str, int], name: str
) -> tuple[list[Floats], list[Floats], Cameras, tuple[int, int]]:
    """Return the views of a condition, its camera, and the frame's width and height.

    Of each view there are the points (k, 3) of the board that were found, in metres, and their
    pixels (k, 2).
    """
    count = results.sizes[DRAWS]
    values = pipeline.experiment.scene_values([
        np.arange(count, dtype=np.intp) if axis.name == DRAWS
        else np.full(count, at[axis.name], dtype=np.intp)
        for axis in pipeline.experiment.scene_axes])
    cameras = build_cameras(values, count)
    width, height = (int(values[key].broadcast(count)[0]) for key in ("width_px", "height_px"))
    cell = results.isel({dim: k for dim, k in at.items() if dim in results.dims})
    rotation, translation, errors = (
        cell[each].transpose(DRAWS, ...).values
        for each in ("true_rvec", "true_tvec_m", POINTS[name]))
    errors = errors.reshape(count, -1, 2).astype(np.float64)
    objects, pixels = [], []
    for k, board in enumerate(values["board"].listed(count)):
        known = board.chessboard_m if name == "chessboard" else board.corners_m.reshape(-1, 3)
        found = np.flatnonzero(np.isfinite(errors[k, : len(known)]).all(axis=1))
        truth = cameras.take(np.array([k])).project(transform_points(
            known[None], rotation_of_vector(rotation[k : k + 1]), translation[k : k + 1]))[0]
        objects.append(known[found])
        pixels.append(truth[found] + errors[k, found])
    return objects, pixels, cameras.take(np.array([0])), (width, height)


def _position_errors(
    one: Intrinsics, camera: Cameras, frame: tuple[int, int], distance_m: float
) -> Floats:
    """Return the errors (2, 3) in m of the position of a target of 0.2 m at :data:`DIRECTIONS`.

    NaN without a calibration, and where the lens does not show the target or no pose fits it.
    """
    errors = np.full((len(DIRECTIONS), 3), np.nan)
    if one.status != CalibrationStatus.calibrated:
        return errors
    line = np.linspace(-0.1, 0.1, 5)
    target = np.array([(x, y, 0.0) for y in line for x in line])
    rotation = np.diag([1.0, -1.0, -1.0])[None]
    focal, centre = np.split(camera.view[0], 2)
    view, lens = np.split(one.values, [4])
    assumed = Cameras(view[None], np.array([pack(tuple(lens.tolist()))]), np.array([lens.any()]))
    for k, share in enumerate(DIRECTIONS.values()):
        bearing = share * (np.array(frame) - 1 - centre) / focal
        position = np.array([*(bearing * distance_m), distance_m])
        pixels = camera.project(transform_points(target[None], rotation, position[None]))[0]
        if np.isfinite(pixels).all() and (
                poses := GuardedPoints.of(target, pixels, assumed).poses(cv2.SOLVEPNP_IPPE)):
            errors[k] = poses[0][1] - position
    return errors
