"""From how far a marker is still detected: the smallest side with a detection rate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.counts import scaled_to_draws
from sweep.analysis.dimensions import (
    DRAWS,
    as_names,
    axes_of,
    kept_dimensions,
    require_dimension,
    without_fixed,
)
from sweep.analysis.intervals import LEVEL, wilson
from sweep.analysis.rates import detection_rate
from sweep.analysis.stored_parameters import parameter_value
from sweep.errors import ArgumentError, DatasetError
from sweep.measure.flags import Flag, flag
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.model.marker import module_count
from sweep.plan.schema import cf_attributes
from sweep.typing import Floats, Integers, Masks

SIZE_AXES = ("side_px", "distance_m")


class Limit(Flag):
    """Whether the rate is reached within the grid."""

    not_run = flag(0, "No pose was looked for.", counted=False)
    found = flag(1, "The rate is reached from a side of the grid on.", present=True)
    never = flag(2, "The rate is not reached at the largest side.")
    always = flag(
        3, "The rate is reached at the smallest side: the limit may lie below it.", present=True)


def detection_limit(
    results: xr.Dataset, rate: float = 0.9, per: Sequence[str] | None = None
) -> xr.Dataset:
    """Return the smallest side of the black square from which on the marker is detected.

    Parameters
    ----------
    results
        The dataset of a run with a dimension ``side_px`` or ``distance_m``. Parameters of the
        camera and the marker's size that are no dimension or coordinate are read from the pipeline
        in its attributes.
    rate
        The detection rate that is asked for, above 0 and at most 1.
    per
        Dimensions that are kept; by default the tilt or viewing angle, if it varies. A
        dimension ``dictionary`` is always kept; the sides and the trials cannot be.

    Returns
    -------
    xr.Dataset
        Dimensions (*per); lazy if ``results`` is.

        - ``side_px``: side in pixels, if the square were parallel to the image, from which on, at
          all larger sides of the grid, the detection rate is at least ``rate``: so a dip at a
          larger side counts. Infinite for never. Its interval is in ``side_px_low`` and
          ``side_px_high``; ``side_px_below`` is the grid's next smaller side, at which the rate is
          not reached.
        - ``side_px_per_module``: the same per module of the marker, with its interval.
        - ``distance_m``: the distance of that side, if that is the grid's axis.
        - ``limit``: whether the rate is reached within the grid (`Limit`).

    Raises
    ------
    ArgumentError
        For a rate outside (0, 1], and for ``per`` that names a dimension that cannot be kept, or
        misses one over which the sides differ.
    DatasetError
        If the dataset has no sides, lacks variables of results, or has no poses.

    Notes
    -----
    The interval is that of the limit on the grid, at 95 %: from ``side_px_high`` on Wilson's lower
    ends are at least ``rate``, and from ``side_px_low`` on all upper ends are. Only the one side
    below the limit can make the high end too small, any above it the low end too large: the upper
    ends are those of all sides together (Bonferroni). A low end of 0 says that the limit may lie
    below the grid, an infinite high end that it may lie above; both are NaN if no cell has two
    draws.

    Examples
    --------
    >>> limit = detection_limit(results, rate=0.6)
    >>> limit["side_px"].item(), limit["side_px_below"].item(), Limit(limit["limit"].item()).name
    (20.0, 10.0, 'found')
    """
    if not 0.0 < rate <= 1.0:
        raise ArgumentError("rate", rate, "expected a number above 0 and at most 1, such as 0.9")
    axis = require_dimension(results, *SIZE_AXES)
    axes = axes_of(results)
    dictionaries = ["dictionary"] if "dictionary" in axes else []
    if per is None:
        per = [name for name in ("tilt_deg", "view_angle_deg") if name in axes]
    kept = kept_dimensions(results, (*as_names(per), *dictionaries))
    for name in (axis, DRAWS):
        if name in kept:
            raise ArgumentError("per", name, "the limit is over this dimension; it cannot be kept")
    sides = _sides(results, axis)
    varied = [str(dim) for dim in sides.dims if dim not in (*kept, axis)]
    if varied:
        raise ArgumentError("per", ", ".join(kept) or "()",
                            f"the sides differ over {', '.join(varied)}; add it")
    table = detection_rate(results, (*kept, axis))
    n, draws, hits = (table[name] for name in ("looked_for", "draws", "detected"))
    drawn = table["detection_rate_low"].notnull()
    counts = [array.chunk({axis: -1}) if array.chunks else array
              for array in (hits, n, draws, drawn)]
    *values, limit = xr.apply_ufunc(
        _limit, sides, *counts, kwargs={"rate": rate}, dask="parallelized",
        input_core_dims=[[axis]] * 5, output_core_dims=[[]] * 5, output_dtypes=[np.float64] * 5,
    )
    limits = dict(zip(("side_px", "side_px_low", "side_px_high", "side_px_below"), values,
                      strict=True))
    words = {
        "side_px": f"smallest side from which on the detection rate is at least {rate:g}",
        "side_px_low": "lower end of the 95 % interval: smallest side",
        "side_px_high": "upper end of the 95 % interval: smallest side",
        "side_px_below": "the grid's next smaller side",
    }
    out = {name: array.assign_attrs(long_name=words[name], units="px")
           for name, array in limits.items()}
    count = _modules(results)
    out |= {
        name.replace("px", "px_per_module"): (limits[name] / count).assign_attrs(
            long_name=f"{words[name]}, per module", units="px")
        for name in ("side_px", "side_px_low", "side_px_high")
    }
    if axis == "distance_m":
        scale = (sides * without_fixed(results["distance_m"])).isel(distance_m=0, drop=True)
        out["distance_m"] = (scale / limits["side_px"]).assign_attrs(
            long_name="the distance of that side", units="m")
    out["limit"] = limit.astype(np.uint8).assign_attrs(
        cf_attributes("whether the rate is reached within the grid", flags=Limit))
    return xr.Dataset({name: array.transpose(*kept) for name, array in out.items()})


def _limit(
    sides: Floats, hits: Integers, n: Integers, draws: Integers, drawn: Masks, rate: float
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return side, low, high, next smaller side and flag; all arrays are (..., sides)."""
    sides = np.broadcast_to(sides, n.shape)
    order = np.argsort(-sides, axis=-1, kind="stable")  # the largest first
    sides = np.take_along_axis(sides, order, axis=-1)
    hits, n, draws = (np.take_along_axis(each, order, axis=-1) for each in (hits, n, draws))
    drawn = np.take_along_axis(drawn, order, axis=-1)
    exists = n > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        reached = hits / n >= rate
    # Of draws, rounded outwards, as in `Rate`.
    fewest, most = scaled_to_draws(hits, n, draws)
    joint = 1.0 - (1.0 - LEVEL) / sides.shape[-1]
    surely = wilson(fewest, draws)[0] >= rate
    possibly = wilson(most, draws, joint)[1] >= rate

    def smallest(holds: Masks, none: float) -> tuple[Floats, Masks]:
        """Return the smallest side down to which it holds, and whether it holds for all."""
        steady = np.logical_and.accumulate(holds | ~exists, axis=-1) & exists
        side = np.where(steady, sides, np.inf).min(axis=-1, initial=np.inf)
        return np.where(steady.any(axis=-1), side, none), (steady == exists).all(axis=-1)

    side, always = smallest(reached, np.inf)
    high, _ = smallest(surely, np.inf)
    low, everywhere = smallest(possibly, np.inf)
    low = np.where(everywhere, 0.0, low)
    smaller = np.where(exists & (sides < side[..., None]), sides, -np.inf).max(
        axis=-1, initial=-np.inf)
    empty = ~exists.any(axis=-1)
    flag = np.select([empty, always, np.isinf(side)], [Limit.not_run, Limit.always, Limit.never],
                     Limit.found)
    unknown = ~(drawn | ~exists).all(axis=-1) | empty
    return (np.where(empty, np.nan, side), np.where(unknown, np.nan, low),
            np.where(unknown, np.nan, high), np.where(np.isinf(smaller), np.nan, smaller),
            flag.astype(np.float64))


def _sides(results: xr.Dataset, axis: str) -> xr.DataArray:
    """Return the sides in pixels, over the axis and whatever else they depend on."""
    if axis not in results.coords:
        raise DatasetError(f"{axis}: has no coordinate, which the sides are computed from")
    if axis == "side_px":
        return _positive(results["side_px"].astype(np.float64))
    values = {name: parameter_value(results, name) for name in (*VIEW_PARAMETERS, "size_m")}
    fx = xr.DataArray(intrinsics(*(values[name] for name in VIEW_PARAMETERS))[0])
    sides: xr.DataArray = fx * values["size_m"] / results["distance_m"]
    return _positive(sides.astype(np.float64))


def _positive(sides: xr.DataArray) -> xr.DataArray:
    if not (np.isfinite(sides) & (sides > 0)).all():
        raise DatasetError("sides must be finite and above 0 px: see the coordinates of the size, "
                           "the distance and the camera")
    return without_fixed(sides)


def _modules(results: xr.Dataset) -> Any:
    """Return the modules along the black square's side, by dictionary."""
    names = parameter_value(results, "dictionary")
    if isinstance(names, xr.DataArray):
        counts = [module_count(str(name)) for name in np.atleast_1d(names.values)]
        return xr.DataArray(np.reshape(counts, names.shape), names.coords, names.dims)
    return module_count(names)
