"""What error models depend on: distance, side and viewing angle, and their bins in a dataset."""

from __future__ import annotations

import math
from collections.abc import Sequence

import dask.array as da
import numpy as np
import xarray as xr

from sweep.analysis.error_model_sums import Bins, Moments
from sweep.analysis.sight_frame import viewing_angle_of
from sweep.analysis.stored_parameters import parameter_value
from sweep.errors import DatasetError
from sweep.measure.flags import DetectionStatus, uncounted_values
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.typing import Floats

PREDICTORS = {"distance_m": True, "side_px": True, "viewing_angle_deg": False}
"""Name of a predictor -> whether its logarithm is what the model is linear in."""

MAX_BINS = {"distance_m": 16, "side_px": 8, "viewing_angle_deg": 16}
"""Bins of the fit into which values are put that are not a few."""

MAX_CELLS = {"distance_m": 12, "side_px": 6, "viewing_angle_deg": 12}
"""The same of the cells in which the fit is judged."""

MAX_VALUES = 24
"""Distinct values up to which each has a bin of its own."""

SAME = 1e-6
"""Values that differ by less, relatively (angles: in degrees / 100), are the same."""

VARIES = {"distance_m": 1.02, "side_px": 1.02, "viewing_angle_deg": 1.0}
"""Ratio of the largest value to the smallest (angles: difference in degrees) from which on a
predictor varies."""

FRONTAL_DEG = 5.0
"""Smallest viewing angles up to here: the model begins at 0."""

POSES_A_CELL = 150
"""Poses that a cell should have, on average, where cells can be made wider."""


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


def bins_and_cells(results: xr.Dataset, focal_size: xr.DataArray) -> tuple[Bins, Bins]:
    """Return the bins that models are fitted to, and the wider cells in which they are judged.

    Few distinct values, of an axis, have a bin and a cell each; others, which were drawn, have some
    of about as many poses each.

    Raises
    ------
    DatasetError
        If no pose was looked for.
    """
    found = _values_of(results, focal_size)
    collinear = float(focal_size.max()) <= float(focal_size.min()) * VARIES["side_px"]
    # The side that follows from the distance has one bin, as what does not vary.
    single = {name for name, values in found.items() if not _varies(name, values)}
    if collinear and "distance_m" not in single:
        single.add("side_px")
    drawn = [name for name, values in found.items()
             if name not in single and len(values) > MAX_VALUES]
    poses = math.prod(results.sizes[name] for name in results["true_tvec_m"].dims if name != "xyz")
    others = math.prod(len(values) for name, values in found.items()
                       if name not in single and name not in drawn)
    many = max(2, int((poses / (POSES_A_CELL * others)) ** (1.0 / max(len(drawn), 1))))
    bins, cells = (
        Bins(**{
            name: _domain(name, values) if name in single
            else _with_margin(name, _edges(name, values, min(most, limits[name])))
            for name, values in found.items()
        }) for most, limits in ((max(MAX_BINS.values()), MAX_BINS), (many, MAX_CELLS)))
    return bins, cells


def _domain(name: str, values: Floats) -> Floats:
    """Return the ends of the domain of what does not vary: as wide as what counts as the same."""
    low, high = values[0], values[-1]
    if PREDICTORS[name]:
        return np.array([low / VARIES[name], high * VARIES[name]])
    return np.array([max(low - VARIES[name], 0.0), high + VARIES[name]])


def _with_margin(name: str, edges: Floats) -> Floats:
    """Return edges whose ends are so far out that rounding puts no pose outside.

    Viewing angles that begin near 0 begin at 0.
    """
    ends = edges[[0, -1]]
    margin = 2.0 * SAME * ends if PREDICTORS[name] else 100.0 * SAME
    low, high = ends + np.array([-1.0, 1.0]) * margin
    if name == "viewing_angle_deg" and low <= FRONTAL_DEG:
        low = 0.0
    return np.concatenate([[low], edges[1:-1], [high]])


def _values_of(results: xr.Dataset, focal_size: xr.DataArray) -> dict[str, Floats]:
    """Return the distinct values (n,) of each predictor among the poses looked for."""
    position = results["true_tvec_m"]
    distance = position.isel(xyz=2, drop=True).reset_coords(drop=True)
    angle = xr.apply_ufunc(
        viewing_angle_of, results["true_rvec"].reset_coords(drop=True),
        position.reset_coords(drop=True), input_core_dims=[["xyz"], ["xyz"]], dask="parallelized",
        output_dtypes=[np.float64], dask_gufunc_kwargs={"allow_rechunk": True})
    seen = results["detection"].reset_coords(drop=True)
    counted = ~seen.isin(uncounted_values(DetectionStatus)) & (distance > 0)
    counted = counted.any([dim for dim in counted.dims if dim not in position.dims])
    with np.errstate(divide="ignore", invalid="ignore"):
        side = focal_size / distance
    found = {
        "distance_m": _distinct(distance.where(counted)),
        "side_px": _distinct(side.where(counted)),
        "viewing_angle_deg": _distinct(angle.where(counted), absolute=True),
    }
    if not all(len(values) for values in found.values()):
        raise DatasetError("no pose was looked for: there are no errors to model")
    return found


def _distinct(values: xr.DataArray, *, absolute: bool = False) -> Floats:
    """Return the sorted values, those that are the same once."""
    flat = da.unique(da.asarray(values.data).ravel()).compute()
    flat = flat[np.isfinite(flat)]
    if not len(flat):
        return np.asarray(flat)
    step = np.diff(flat)
    return np.asarray(
        flat[np.concatenate([[True], step > (100 * SAME if absolute else SAME * flat[1:])])])


def _varies(name: str, values: Floats) -> bool:
    low, high = values[0], values[-1]
    least = VARIES[name]
    return bool(high - low > least if name == "viewing_angle_deg" else high > low * least)


def _edges(name: str, values: Floats, count: int) -> Floats:
    """Return edges of one bin a value, or of bins of about as many distinct values each."""
    if len(values) <= MAX_VALUES:
        middle = np.sqrt(values[:-1] * values[1:]) if PREDICTORS[name] else (
            (values[:-1] + values[1:]) / 2)
        return np.concatenate([values[:1], middle, values[-1:]])
    return np.unique(np.quantile(values, np.linspace(0.0, 1.0, count + 1)))


def knot_values(bins: Bins, moments: Sequence[Moments]) -> list[Floats]:
    """Return the values that may be knots: of each axis the means of its bins, and both ends.

    Where a bin is a single value that is the value itself.
    """
    knots = []
    for axis, (logarithmic, edges) in enumerate(
            zip(PREDICTORS.values(), bins.edges, strict=True)):
        count, total = np.sum([each.along(axis, bins.shape) for each in moments], axis=0)
        middle = total[count > 0] / count[count > 0]
        ends = np.log(edges[[0, -1]]) if logarithmic else edges[[0, -1]]
        if len(middle) > 1:
            middle = np.unique(np.concatenate([ends[:1], middle[1:-1], ends[1:]]))
        knots.append(middle)
    return knots
