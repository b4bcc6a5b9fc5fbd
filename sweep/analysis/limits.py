"""How far along an axis requirements are met."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.binning import image_sides
from sweep.analysis.dataset import (
    DRAWS,
    as_names,
    axes_of,
    configuration_axes,
    describes,
    stopping_rule,
)
from sweep.analysis.draws import computed_scenes
from sweep.analysis.intervals import looks_factor
from sweep.analysis.requirements import (
    Decision,
    ErrorShares,
    Requirement,
    combined_decision,
    decide,
    excess_of,
    kept_by,
    parse_requirements,
)
from sweep.errors import ArgumentError, DatasetError
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag

# --------------------------------------------------------------------------------------------------
# How far requirements are met along an axis: "up to 2.25 m (2.0 to 2.5)".

class Reach(Flag):
    """How far the requirements are met along the axis."""

    not_run = flag(0, "Nothing could be judged.", counted=False)
    found = flag(1, "They are met up to a value within the grid.", present=True)
    never = flag(2, "They are not met at the easiest value.")
    always = flag(3, "They are met at all values: the limit may lie beyond.", present=True)
    within = flag(4, "They are met between two values, but not at the easiest.", present=True)


@describes
def farthest_met(
    results: xr.Dataset, requirements: Iterable[Requirement | str], along: str,
    per: Sequence[str] = (), at_all: Sequence[str] = (), shares: ErrorShares | None = None,
) -> xr.Dataset:
    """Return how far along an axis all requirements are met.

    Parameters
    ----------
    results, requirements
        As in `sweep.analysis.check_requirements`.
    along
        An axis of the scene with numbers, such as ``distance_m``. It is read from easy to hard:
        one that changes the size in the image towards smaller markers; another from the end at
        which the requirements are met at more of the conditions, upwards if that is undecided.
    per
        Dimensions that are kept: a limit for each of their values.
    at_all
        Dimensions at all of whose values the requirements must hold for a value of ``along`` to
        count, such as ``tilt_deg`` for "up to 2.25 m at tilts up to 45 degrees".
    shares
        Shares of the error probability that single decisions may spend, if not those of
        `sweep.analysis.check_requirements`.

    Returns
    -------
    xr.Dataset
        Dimensions (*configuration, *per), computed.

        - ``value``: the last value of the axis up to which, without a gap, the values of all
          requirements keep their limits; NaN for never. ``start``: the value from which they do,
          which is the easiest, or the first of the longest run of values if they do not there:
          near 0 tilt poses flip, near the camera a marker is cut off.
        - ``low``, ``high``: ends of its interval, in the axis' unit. Up to the end nearer to the
          easy values they are decided to be met, beyond the other end a requirement is decided not
          to be met. -inf or inf: the limit may lie beyond the grid's end.
        - ``reach`` (`Reach`).
        - ``limited_by``: the requirement that first fails beyond ``value``, "" for none;
          ``fails_at`` the value of the axis there; ``fails_where``: the values of ``at_all`` at
          which it fails worst, as text "tilt_deg = 45"; ``failing_value``: the quantity's value
          there.
        - ``met_beyond``: at how many values beyond ``fails_at`` all requirements keep their limits
          again; ``farthest_beyond`` the farthest of them, NaN for none. Detection is not
          monotonic: above 0 there is a dip, which ends ``value``.

        With the dimension ``along``, for each of its values: ``decision`` (`Decision`) of all
        requirements together, and ``keeps``: whether all values keep their limits.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.check_requirements`; also for an axis without an order.

    Notes
    -----
    ``low`` (of a limit upwards) is too large with the error probability of one decision: only the
    first value at which a requirement fails could make it so. ``high`` is too small if any value
    up to the limit is falsely decided as not met: these decisions are at the error probability of
    all of them together.

    Examples
    --------
    >>> reach = farthest_met(results.sel(solver=["ippe"]), ["detection >= 0.6"], along="side_px")
    >>> reach["value"].item(), reach["limited_by"].item(), reach["fails_at"].item()
    (20.0, 'detection_rate >= 0.6', 10.0)
    """
    required = tuple(parse_requirements([
        each.text if isinstance(each, Requirement) else each
        for each in ([requirements] if isinstance(requirements, str | Requirement)
                     else requirements)]))
    values = axis_values(results, along)
    together = [name for name in as_names(at_all) if name != along]
    names = [name for name in as_names(per) if name != along]
    overlap = [name for name in together if name in names]
    if overlap:
        raise ArgumentError("at_all", ", ".join(overlap), "is in per, too; name it in one of them")
    table = decide(results, required, [*names, *together, along], shares=shares)
    keeps = kept_by(table, required)
    upwards = is_harder_upwards(results, along, keeps)
    order = np.argsort(values if upwards else -values, kind="stable")
    table, keeps = table.isel({along: order}), keeps.isel({along: order})
    values = values[order]
    inner = [*together, "requirement"]
    applicable = table["decision"] != Decision.not_applicable
    judged = applicable.any(inner)
    all_keep = (keeps | ~applicable).all(inner) & judged
    decision = xr.apply_ufunc(
        combined_decision, table["decision"], input_core_dims=[inner],
        kwargs={"axis": tuple(range(-len(inner), 0))}).assign_attrs(
        cf_attributes("whether all requirements are met", flags=Decision))
    kept = [dim for dim in decision.dims if dim != along]
    shape = decision.transpose(*kept, along)
    rows = []
    for index in np.ndindex(*shape.shape[:-1]):
        at = dict(zip(kept, index, strict=True))
        numbers, failing = _limit(
            values, upwards, keeps=all_keep.isel(at).values, judged=judged.isel(at).values,
            decision=decision.isel(at).values)
        if failing is not None:
            cell = {**at, along: failing}
            numbers |= _cause(table.isel(cell), keeps.isel(cell), together)
        rows.append(numbers)

    def column(name: str, missing: Any) -> NDArray[Any]:
        return np.array([row.get(name, missing) for row in rows]).reshape(shape.shape[:-1])

    units = str(results[along].attrs.get("units", ""))
    meanings = {
        "value": f"{along} up to which all requirements are met",
        "low": f"lower end of the interval: {along} up to which all are met",
        "high": f"upper end of the interval: {along} up to which all are met",
        "start": f"{along} from which all requirements are met",
        "fails_at": f"first {along} at which one is not",
        "farthest_beyond": f"farthest {along} beyond it at which all are met again",
        "failing_value": "value of the requirement that fails there",
        "met_beyond": "values beyond it at which all are met again",
    }
    variables: dict[str, Any] = {
        name: (kept, column(name, np.nan), {"long_name": meaning, "units": {
            "failing_value": "", "met_beyond": "1"}.get(name, units)})
        for name, meaning in meanings.items()}
    variables["reach"] = (kept, column("reach", Reach.not_run).astype(np.uint8), cf_attributes(
        "how far the requirements are met", flags=Reach))
    for name, meaning in (("limited_by", "requirement that fails"),
                          ("fails_where", "where it fails")):
        variables[name] = kept, column(name, ""), {"long_name": meaning}
    variables["decision"] = decision.transpose(*kept, along)
    variables["keeps"] = all_keep.transpose(*kept, along).assign_attrs(
        long_name="whether all values keep their limits", units="1")
    coordinates = {name: value for name, value in table.coords.items()
                   if set(value.dims) <= {*kept, along}}
    found = xr.Dataset(variables, coordinates).isel({along: np.argsort(order)})
    return found.assign_attrs(
        along=along, harder="upwards" if upwards else "downwards",
        configuration_dims=[name for name in configuration_axes(results) if name in kept])


def axis_values(results: xr.Dataset, along: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the values of an axis of the scene that has an order.

    Raises
    ------
    ArgumentError
        If there is no such axis, or its values are no numbers, or it is one of configurations.
    """
    axes = [name for name in axes_of(results)
            if name != DRAWS and name not in configuration_axes(results)
            and name in results.coords and results[name].dtype.kind in "fiu"]
    if along not in axes:
        raise ArgumentError("along", along, "expected an axis of the scene with numbers; there "
                            f"are {', '.join(axes) or 'none'}")
    values = results[along].to_numpy().astype(np.float64)
    if len(set(values.tolist())) < len(values) or not np.isfinite(values).all():
        raise DatasetError(f"{along}: has values that repeat or are not finite")
    return values


def is_harder_upwards(results: xr.Dataset, along: str, keeps: xr.DataArray) -> bool:
    """Return whether large values of an axis are the hard ones.

    ``keeps`` is large, or true, where the requirements are fulfilled: it decides for an axis that
    does not change the size in the image.
    """
    values = results[along].to_numpy()
    smaller = smaller_upwards(lambda: image_sides(results, {}), values, along)
    return easier_first(keeps.transpose(along, ...).to_numpy(), values) \
        if smaller is None else smaller


def smaller_upwards(
    sides: Callable[[], xr.DataArray], values: NDArray[Any], along: str
) -> bool | None:
    """Return whether markers are smaller at large values of an axis; None if nothing says it.

    ``sides`` returns the sides in pixels, or raises DatasetError, such as for a size that is drawn.
    """
    try:
        computed = sides()
    except DatasetError:
        return {"side_px": False, "distance_m": True, "size_m": False}.get(along)
    if along not in computed.dims:
        return None
    least, most = (computed.isel({along: int(k(values))}) for k in (np.argmin, np.argmax))
    return None if bool((least == most).all()) else bool((most <= least).all())


def easier_first(keeps: NDArray[Any], values: NDArray[Any]) -> bool:
    """Return whether requirements are kept at least as often at the least value as at the largest.

    ``keeps`` is (values, ...): true, or large, where they are kept.
    """
    least, most = int(np.argmin(values)), int(np.argmax(values))
    return float(np.sum(keeps[least])) >= float(np.sum(keeps[most]))


def _limit(
    values: np.ndarray[Any, Any], upwards: bool, *, keeps: np.ndarray[Any, Any],
    judged: np.ndarray[Any, Any], decision: np.ndarray[Any, Any],
) -> tuple[dict[str, Any], int | None]:
    """Return the limit along the axis, from easy to hard, and the index of the failure beyond."""
    if not judged.any():
        return {"reach": Reach.not_run}, None
    none, beyond = (-np.inf, np.inf) if upwards else (np.inf, -np.inf)
    run = met_run(keeps, judged)
    before_run = np.nonzero(~keeps & judged)[0]
    before_run = before_run[before_run < run[0]] if run else before_run[:0]
    if before_run.size:
        judged = judged & (np.arange(len(values)) > before_run[-1])
    failing = np.nonzero(~keeps & judged)[0]
    unsure = np.nonzero((decision != Decision.met) & judged)[0]
    failed = np.nonzero((decision == Decision.not_met) & judged)[0]

    def before(indices: np.ndarray[Any, Any], all_of_them: float) -> float:
        """Return the last judged value before the first of some indices."""
        if not len(indices):
            return all_of_them
        earlier = np.nonzero(judged[: indices[0]])[0]
        return float(values[earlier[-1]]) if len(earlier) else none

    last = float(values[np.nonzero(judged)[0][-1]])
    value = before(failing, last)
    ends = sorted((before(unsure, last), before(failed, beyond)))
    numbers = {"value": value if np.isfinite(value) else np.nan, "low": ends[0], "high": ends[1],
               "met_beyond": 0.0}
    if run:
        numbers["start"] = float(values[run[0]])
    if not len(failing):
        return {**numbers, "reach": Reach.within if before_run.size else Reach.always}, None
    first = int(failing[0])
    again = np.nonzero(keeps & judged)[0]
    again = again[again > first]
    numbers |= {"fails_at": float(values[first]), "met_beyond": float(len(again)),
                "farthest_beyond": float(values[again[-1]]) if len(again) else np.nan,
                "reach": Reach.never if run is None else
                Reach.within if before_run.size else Reach.found}
    return numbers, first


def met_run(
    keeps: np.ndarray[Any, Any], judged: np.ndarray[Any, Any]
) -> tuple[int, int] | None:
    """Return the first and the last index of the run of values that are kept, without a gap.

    It is that from the first judged value on, or, if that is not kept, the longest; of several the
    first. Values that are not judged (n,) neither count nor make a gap. None without any.

    >>> met_run(np.array([0, 1, 0, 1, 1], bool), np.ones(5, bool))
    (3, 4)
    """
    runs: list[list[int]] = []
    inside = False
    for index in np.nonzero(judged)[0]:
        if keeps[index]:
            runs = [*runs[:-1], [*runs[-1], int(index)]] if inside else [*runs, [int(index)]]
        inside = bool(keeps[index])
    if not runs:
        return None
    first = int(np.nonzero(judged)[0][0])
    run = runs[0] if runs[0][0] == first else max(runs, key=len)
    return run[0], run[-1]


def _cause(
    cell: xr.Dataset, keeps: xr.DataArray, together: Sequence[str]
) -> dict[str, Any]:
    """Return which requirement fails worst, where among ``together``, and its value there."""
    failing = ~keeps & (cell["decision"] != Decision.not_applicable)
    excess = excess_of(cell).where(failing)
    flat = excess.stack(all_dims=excess.dims)
    worst = flat.isel(all_dims=int(flat.argmax("all_dims")))
    at = {name: worst[name].item() for name in excess.dims}
    where = ", ".join(f"{name} = {at[name]:g}" if isinstance(at[name], float) else
                      f"{name} = {at[name]}" for name in together)
    return {"limited_by": str(at["requirement"]), "fails_where": where,
            "failing_value": float(cell["value"].sel(at))}


# --------------------------------------------------------------------------------------------------
# Limits that a search decided: how far along an axis requirements are met, per condition.

def error_shares(decisions: int, times: int) -> ErrorShares:
    """Return the shares of the error probability of each decision of a search.

    Parameters
    ----------
    decisions
        How many are made for one limit: a false "not met" of any shortens it.
    times
        How often each is made.
    """
    factor = looks_factor(times)
    return ErrorShares(met=1.0 / factor, not_met=1.0 / (factor * decisions))


@describes
def requirement_limits(
    results: xr.Dataset, require: Sequence[str] = (), along: str = "",
    per: Sequence[str] | None = None, at_all: Sequence[str] | None = None,
) -> xr.Dataset:
    """Return how far along an axis requirements are met, for each condition by itself.

    Parameters
    ----------
    results
        The dataset of a run, of `sweep.limit` or with equally many trials everywhere.
    require, along, per, at_all
        As `sweep.limit` takes them; by default those that the run was made for.

    Returns
    -------
    xr.Dataset
        As `sweep.analysis.farthest_met`, dimensions (*configuration, *per), whose interval
        ``low`` to ``high`` covers the limit of each condition with 95 %, however often it was
        decided anew. Also

        - ``settled``: whether the interval is a single value of the grid.
        - ``trials`` (*per, along): the most that a cell has there; ``poses`` (*per): how many
          scenes were computed for the condition, with those of all values.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.farthest_met`; also if nothing says what is searched.

    Notes
    -----
    Requirements must hold at all values of ``at_all`` and are judged at each value along the axis
    after each wave: an end of the interval is wrong with 0.025 at most, of all these decisions
    together (Bonferroni over values and requirements; `looks_factor` over waves).

    Examples
    --------
    >>> limit = requirement_limits(results, ["detection >= 0.6"], "side_px").sel(solver="ippe")
    >>> limit["value"].item(), limit["low"].item(), limit["high"].item()
    (20.0, 20.0, 40.0)
    """
    rule = stopping_rule(results)
    rule = rule if rule is not None and rule.kind == "along" else None
    require = [require] if isinstance(require, str) and require else require
    if not require or not along:
        if rule is None:
            raise ArgumentError("require" if not require else "along", along,
                                "this store was not made by sweep limit, so that nothing says it")
        require, along = require or rule.requirements, along or rule.along
    if rule is not None and along == rule.along:
        per = rule.per if per is None else per
        at_all = rule.at_all if at_all is None else at_all
    scene = [name for name in axes_of(results) if name not in configuration_axes(results)]
    at_all = [name for name in as_names(at_all or ()) if name != along]
    if per is None:
        per = [name for name in scene if name not in (DRAWS, along, *at_all)]
    per = as_names(per)
    count = len([*require]) * math.prod(results.sizes.get(name, 1) for name in (along, *at_all))
    found = farthest_met(
        results, require, along, per, at_all, error_shares(count, len(rule.ends) if rule else 1))
    found["settled"] = (found["low"] == found["high"]).assign_attrs(
        long_name="whether the interval is a single value of the grid", units="1")
    computed = computed_scenes(results)
    cells = [name for name in computed.dims if name not in (*per, along)]
    found["trials"] = computed.sum(DRAWS).max(
        [name for name in cells if name != DRAWS]).compute().assign_attrs(
        long_name="trials of a cell, the most at this value", units="1")
    found["poses"] = computed.sum([*cells, along]).compute().assign_attrs(
        long_name="scenes that were computed, of all values", units="1")
    return found.assign_attrs(per=[*per], at_all=at_all, require=[*require])
