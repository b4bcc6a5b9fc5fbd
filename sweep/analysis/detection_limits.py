"""From how far a marker is still detected: the smallest side with a detection rate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.binning import Bins, image_sides, parameters_along, require_size_axes
from sweep.analysis.counts import scaled_to_draws
from sweep.analysis.dataset import (
    DRAWS,
    as_names,
    axes_of,
    describes,
    is_sampling_stopped,
    kept_dimensions,
    parameter_value,
    require_poses,
)
from sweep.analysis.draws import stopped_level, with_common_trials
from sweep.analysis.intervals import LEVEL, clopper_pearson, wilson
from sweep.analysis.rates import detection_rate
from sweep.errors import ArgumentError
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag
from sweep.model.marker import module_count
from sweep.typing import Floats, Integers, Masks

SIZE_AXES = ("side_px", "distance_m")
"""The usual axes along which the size in the image changes."""

SAME_SIDE = 1e-9
"""Sides that differ by less, relatively, are equal."""


class Limit(Flag):
    """Whether the rate is reached within the grid."""

    not_run = flag(0, "No pose was looked for.", counted=False)
    found = flag(1, "The rate is reached from a side of the grid on.", present=True)
    never = flag(2, "The rate is not reached at the largest side.")
    always = flag(
        3, "The rate is reached at the smallest side: the limit may lie below it.", present=True)


@describes
def detection_limit(
    results: xr.Dataset, rate: float = 0.9, per: Sequence[str] | None = None,
    bins: Bins | None = None,
) -> xr.Dataset:
    """Return the smallest side of the black square from which on the marker is detected.

    Parameters
    ----------
    results
        The dataset of a run with a dimension that changes the size in the image: ``side_px``,
        ``distance_m``, ``size_m``, a focal length or field of view, the resolution, parameters
        that go together, or several of these. What is no dimension or coordinate is read from the
        pipeline in its attributes.
    rate
        The detection rate that is asked for, above 0 and at most 1.
    per
        Dimensions that are kept; by default the tilt or viewing angle, if it varies. A
        dimension ``dictionary`` is always kept; all dimensions of the sides and the trials cannot
        be. Others are pooled: of the dimensions that change the side, what has the same side.
    bins
        Edges of bins of drawn parameters that change the side, such as ``distance_m``: a bin has
        the side of its middle.

    Returns
    -------
    xr.Dataset
        Dimensions (*per).

        - ``side_px``: side in pixels, if the square were parallel to the image, from which on, at
          all larger sides of the grid, the detection rate is at least ``rate``: so a dip at a
          larger side counts. Infinite for never. Its interval is in ``side_px_low`` and
          ``side_px_high``; ``side_px_below`` is the grid's next smaller side, at which the rate is
          not reached.
        - ``side_px_per_module``: the same per module of the marker, with its interval.
        - ``distance_m``, ``size_m`` and whatever else changes the side along the axis, if it is
          one axis: its value of that side, with its interval in ``distance_m_low`` and
          ``distance_m_high``. 0 or infinite: beyond the grid.
        - ``limit``: whether the rate is reached within the grid (`Limit`).

    Raises
    ------
    ArgumentError
        For a rate outside (0, 1], for ``per`` that names a dimension that cannot be kept, and for
        bins that cannot be.
    DatasetError
        If no axis changes the side, or it is drawn and not in bins; if the dataset lacks variables
        of results, or has no poses.

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
    axes = axes_of(results)
    require_poses(results)
    dictionaries = ["dictionary"] if "dictionary" in axes else []
    if per is None:
        per = [name for name in ("tilt_deg", "view_angle_deg") if name in axes]
    kept = kept_dimensions(results, (*as_names(per), *dictionaries))
    bins = bins or {}
    sides = image_sides(results, bins)
    require_size_axes(results, sides)
    along = [str(dim) for dim in sides.dims if dim not in kept]
    if DRAWS in kept or not along:
        name = DRAWS if DRAWS in kept else ", ".join(map(str, sides.dims))
        raise ArgumentError("per", name, "the limit is over this dimension; it cannot be kept")
    distinct = _distinct(sides, along)
    stopped = is_sampling_stopped(results)
    if stopped and distinct < math.prod(sides.sizes[name] for name in along):
        results = with_common_trials(results, kept)  # those of the same side are pooled
    table = detection_rate(results, (*kept, *(name for name in along if name not in bins)), bins)
    n, draws, hits = (table[name] for name in ("looked_for", "draws", "detected"))
    drawn = table["detection_rate_low"].notnull()
    *values, limit = xr.apply_ufunc(
        _limit, sides, hits, n, draws, drawn,
        kwargs={"rate": rate, "dims": len(along), "count": distinct, "stopped": stopped},
        input_core_dims=[along] * 5, output_core_dims=[[]] * 5,
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
    if len(along) == 1:
        out |= _in_units_of_the_axis(results, sides, along[0], bins, limits)
    out["limit"] = limit.astype(np.uint8).assign_attrs(
        cf_attributes("whether the rate is reached within the grid", flags=Limit))
    return xr.Dataset({name: array.transpose(*kept) for name, array in out.items()})


def _distinct(sides: xr.DataArray, along: Sequence[str]) -> int:
    """Return the largest number of distinct sides of a condition."""
    rows = sides.transpose(..., *along).values.reshape(
        -1, math.prod(sides.sizes[name] for name in along))
    return max(int(_is_next(np.sort(row)[::-1]).sum()) for row in rows)


def _is_next(sides: Floats) -> Masks:
    """Return which of some sides, from large to small, are not those before them."""
    return np.concatenate([[True], sides[1:] < sides[:-1] * (1.0 - SAME_SIDE)])


def _limit(
    sides: Floats, hits: Integers, n: Integers, draws: Integers, drawn: Masks, *, rate: float,
    dims: int, count: int, stopped: bool,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return side, low, high, next smaller side and flag; arrays are (..., *sides), ``dims`` these.

    Poses of the same side are pooled; ``count`` is the largest number of distinct sides.
    ``stopped`` says whether sampling was stopped (`sweep.analysis.draws`).
    """
    shape = (*n.shape[: n.ndim - dims], math.prod(n.shape[n.ndim - dims :]))
    sides = np.broadcast_to(sides, n.shape).reshape(shape)
    order = np.argsort(-sides, axis=-1, kind="stable")  # the largest first
    sides, hits, n, draws, drawn = (
        np.take_along_axis(each.reshape(shape), order, axis=-1)
        for each in (sides, hits, n, draws, drawn))
    pooled = _pooled(sides, hits, n, draws, drawn.astype(np.int64))
    hits, n, draws, drawn = (*pooled[:3], pooled[3] > 0)
    exists = n > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        reached = hits / n >= rate
    # Of draws, rounded outwards, as in `Rate`.
    fewest, most = scaled_to_draws(hits, n, draws)
    joint = 1.0 - (1.0 - LEVEL) / count
    interval: Callable[..., tuple[Floats, Floats]] = clopper_pearson if stopped else wilson
    levels = [stopped_level(level) if stopped else level for level in (LEVEL, joint)]
    surely = interval(fewest, draws, levels[0])[0] >= rate
    possibly = interval(most, draws, levels[1])[1] >= rate

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


def _pooled(sides: Floats, *counts: Integers) -> list[Integers]:
    """Return the counts with those of equal sides at the first of these, 0 at the others."""
    pooled = [np.zeros_like(each) for each in counts]
    for row in np.ndindex(*sides.shape[:-1]):
        first = np.nonzero(_is_next(sides[row]))[0]
        for sums, each in zip(pooled, counts, strict=True):
            sums[(*row, first)] = np.add.reduceat(each[row], first)
    return pooled


def _in_units_of_the_axis(
    results: xr.Dataset, sides: xr.DataArray, axis: str, bins: Bins,
    limits: Mapping[str, xr.DataArray],
) -> dict[str, xr.DataArray]:
    """Return the limit and its interval as values of the parameters along the axis."""
    out = {}
    for name in parameters_along(results, axis, bins):
        if name == "side_px":
            continue
        values = sides[axis].values if axis in bins else results[name].values
        order = np.argsort(values)
        ends = sides.isel({axis: order[[0, -1]]})
        smaller = bool((ends.isel({axis: 1}) < ends.isel({axis: 0})).all())
        low, high = ("high", "low") if smaller else ("low", "high")
        for ending, source, words in (
            ("", "side_px", "value of that side"),
            ("_low", f"side_px_{low}", "lower end of the 95 % interval: value of that side"),
            ("_high", f"side_px_{high}", "upper end of the 95 % interval: value of that side"),
        ):
            out[f"{name}{ending}"] = xr.apply_ufunc(
                _value_of_side, limits[source], sides.drop_vars(axis, errors="ignore"),
                kwargs={"values": values.astype(np.float64), "smaller": smaller},
                input_core_dims=[[], [axis]],
            ).assign_attrs(long_name=f"{name}: {words}",
                           units=str(results[name].attrs.get("units", "1")))
    return out


def _value_of_side(
    side: Floats, sides: Floats, values: Floats, *, smaller: bool
) -> Floats:
    """Return the values (...) at which sides (..., n) are those of (...); 0 or inf beyond all."""
    nearest = np.argmin(np.abs(sides - np.where(np.isfinite(side), side, 0.0)[..., None]), axis=-1)
    found = np.where(np.isnan(side), np.nan, values[nearest])
    found = np.where(side == 0.0, np.inf if smaller else 0.0, found)
    return np.where(np.isinf(side), 0.0 if smaller else np.inf, found)


def _modules(results: xr.Dataset) -> Any:
    """Return the modules along the black square's side, by dictionary."""
    names = parameter_value(results, "dictionary")
    if isinstance(names, xr.DataArray):
        counts = [module_count(str(name)) for name in np.atleast_1d(names.values)]
        return xr.DataArray(np.reshape(counts, names.shape), names.coords, names.dims)
    return module_count(names)
