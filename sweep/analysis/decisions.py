"""Decisions: how far along an axis, which choice, how precisely; each met, not met or open."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.dataset import (
    DRAWS,
    as_names,
    axes_of,
    computed_scenes,
    configuration_axes,
    describes,
    each_cell,
    image_sides,
    kept_dimensions,
    largest_cell,
    parameter_value,
    require_poses,
    stacked,
    stopping_rule,
)
from sweep.analysis.estimator import (
    INTERVAL,
    Count,
    Statistic,
    aggregate,
    draws_to_see,
    stopped_level,
)
from sweep.analysis.intervals import LEVEL, clopper_pearson, looks_factor
from sweep.analysis.poses import Poses
from sweep.analysis.requirements import (
    ERROR_PROBABILITY,
    MIN_DRAWS,
    Cause,
    Decision,
    ErrorShares,
    Requirable,
    Requirement,
    combined_decision,
    decide,
    draws_needed,
    excess_of,
    kept_by,
    named,
    parse_requirements,
    read_requirements,
    requirable_arrays,
    requirables,
    worst_cell,
)
from sweep.analysis.summaries import LOOKED_FOR
from sweep.errors import ArgumentError, DatasetError
from sweep.experiment.document import SEARCH
from sweep.experiment.grid import TRIAL
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag
from sweep.messages import shown
from sweep.model.marker import module_count
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# How far requirements are met along an axis: "up to 2.25 m (2.0 to 2.5)".

def last_steady(holds: Masks, judged: Masks) -> Integers:
    """Return the index (...) of the last judged value up to which all judged ones hold; -1 of none.

    ``holds`` and ``judged`` are (..., values), from easy to hard.

    >>> last_steady(np.array([True, False, True, False]), np.array([True, False, True, True]))
    array(2)
    """
    steady = np.logical_and.accumulate(holds | ~judged, axis=-1) & judged
    last = steady.shape[-1] - 1 - np.argmax(steady[..., ::-1], axis=-1)
    return np.asarray(np.where(steady.any(axis=-1), last, -1))


class Reach(Flag):
    """How far the requirements are met along the axis."""

    not_run = flag(0, "Nothing could be judged.", counted=False)
    found = flag(1, "They are met up to a value within the grid.", present=True)
    never = flag(2, "They are not met at the easiest value.")
    always = flag(3, "They are met at all values: the limit may lie beyond.", present=True)
    within = flag(4, "They are met between two values, but not at the easiest.", present=True)


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
    """Return how far along an axis all requirements are met, for each condition by itself.

    Parameters
    ----------
    results
        The dataset of a run, of `sweep.limit` or with equally many trials everywhere.
    require, along, per, at_all
        As `sweep.limit` takes them; by default those that the run was made for.

        ``along`` is an axis of the scene with numbers, such as ``distance_m``. It is read from easy
        to hard: one that changes the size in the image towards smaller markers; another from the
        end at which the requirements are met at more of the conditions, upwards if that is
        undecided. ``per`` are dimensions that are kept: a limit for each of their values; without a
        word all axes of the scene, while an empty list pools them. ``at_all`` are dimensions at all
        of whose values the requirements must hold for a value of ``along`` to count, such as
        ``tilt_deg`` for "up to 2.25 m at tilts up to 45 degrees".

    Returns
    -------
    xr.Dataset
        Dimensions (*configuration, *per), computed.

        - ``value``: the last value of the axis up to which, without a gap, the values of all
          requirements keep their limits; NaN for never. ``start``: the value from which they do,
          which is the easiest, or the first of the longest run of values if they do not there:
          near 0 tilt poses flip, near the camera a marker is cut off.
        - ``low``, ``high``: ends of its interval, in the axis' unit, which covers the limit of each
          condition with 95 %, however often it was decided anew. Up to the end nearer to the easy
          values they are decided to be met, beyond the other end a requirement is decided not to be
          met. -inf or inf: the limit may lie beyond the grid's end. ``settled``: whether the
          interval is a single value of the grid.
        - ``reach`` (`Reach`).
        - ``limited_by``: the requirement that first fails beyond ``value``, "" for none;
          ``fails_at`` the value of the axis there; ``fails_where``: the values of ``at_all`` at
          which it fails worst, as text "tilt_deg = 45"; ``failing_value``: the quantity's value
          there.
        - ``met_beyond``: at how many values beyond ``fails_at`` all requirements keep their limits
          again; ``farthest_beyond`` the farthest of them, NaN for none. Detection is not
          monotonic: above 0 there is a dip, which ends ``value``.
        - ``poses`` (*per): how many scenes were computed for the condition, of all values.

        With the dimension ``along``, for each of its values: ``decision`` (`Decision`) of all
        requirements together; ``keeps``: whether all values keep their limits; ``trials`` (*per,
        along): the most that a cell has there.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.check_requirements`; also if nothing says what is searched, and for an
        axis without an order.

    Notes
    -----
    Requirements must hold at all values of ``at_all`` and are judged at each value along the axis
    after each wave: an end of the interval is wrong with 0.025 at most, of all these decisions
    together (Bonferroni over values and requirements; `looks_factor` over waves). ``low`` (of a
    limit upwards) is too large with the error probability of one decision: only the first value at
    which a requirement fails could make it so.

    Examples
    --------
    >>> limit = requirement_limits(results, ["detection >= 0.6"], "side_px").sel(solver="ippe")
    >>> limit["value"].item(), limit["low"].item(), limit["high"].item()
    (20.0, 20.0, 40.0)
    >>> limit["limited_by"].item(), limit["fails_at"].item()
    ('detection_rate >= 0.6', 10.0)
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
    required = parse_requirements(require)
    values = axis_values(results, along)
    together = [name for name in as_names(at_all or ()) if name != along]
    names = [name for name in axes_of(results, Stage.scene)
             if name not in (DRAWS, *together)] if per is None else as_names(per)
    names = [name for name in names if name != along]
    overlap = [name for name in together if name in names]
    if overlap:
        raise ArgumentError("at_all", ", ".join(overlap), "is in per, too; name it in one of them")
    count = len(required) * math.prod(results.sizes.get(name, 1) for name in (along, *together))
    table = decide(results, required, [*names, *together, along],
                   shares=error_shares(count, len(rule.ends) if rule else 1))
    keeps = kept_by(table, required)
    upwards = is_harder_upwards(results, along, keeps)
    order = np.argsort(values if upwards else -values, kind="stable")
    table, keeps = table.isel({along: order}), keeps.isel({along: order})
    inner = [*together, "requirement"]
    applicable = table["decision"] != Decision.not_applicable
    judged = applicable.any(inner)
    all_keep = ((keeps | ~applicable).all(inner) & judged).assign_attrs(
        long_name="whether all values keep their limits", units="1")
    decision = xr.apply_ufunc(
        combined_decision, table["decision"], input_core_dims=[inner],
        kwargs={"axis": tuple(range(-len(inner), 0))}).assign_attrs(
        cf_attributes("whether all requirements are met", flags=Decision))
    kept = [dim for dim in decision.dims if dim != along]
    shape = [table.sizes[dim] for dim in kept]
    arrays = [array.transpose(*kept, along).values for array in (all_keep, judged, decision)]
    rows = []
    for index in np.ndindex(*shape):
        row = _reach(values[order], upwards, *(array[index] for array in arrays))
        if "fails" in row:
            cell = {**dict(zip(kept, index, strict=True)), along: row["fails"]}
            row |= _cause(table.isel(cell), keeps.isel(cell), together)
        rows.append(row)
    units = str(results[along].attrs.get("units", ""))
    meanings = {
        "value": (f"{along} up to which all requirements are met", units),
        "low": (f"lower end of the interval: {along} up to which all are met", units),
        "high": (f"upper end of the interval: {along} up to which all are met", units),
        "start": (f"{along} from which all requirements are met", units),
        "fails_at": (f"first {along} at which one is not", units),
        "farthest_beyond": (f"farthest {along} beyond it at which all are met again", units),
        "failing_value": ("value of the requirement that fails there", ""),
        "met_beyond": ("values beyond it at which all are met again", "1"),
        "limited_by": ("requirement that fails", None),
        "fails_where": ("where it fails", None),
    }
    variables: dict[str, Any] = {}
    for name, (meaning, unit) in meanings.items():
        column = np.array([row.get(name, np.nan if unit is not None else "") for row in rows])
        variables[name] = (kept, column.reshape(shape), {
            "long_name": meaning} | ({} if unit is None else {"units": unit}))
    reach = np.array([row["reach"] for row in rows], dtype=np.uint8).reshape(shape)
    variables["reach"] = kept, reach, cf_attributes("how far the requirements are met", flags=Reach)
    variables |= {name: array.transpose(*kept, along)
                  for name, array in (("decision", decision), ("keeps", all_keep))}
    coordinates = {name: value for name, value in table.coords.items()
                   if set(value.dims) <= {*kept, along}}
    found = xr.Dataset(variables, coordinates).isel({along: np.argsort(order)})
    found["settled"] = (found["low"] == found["high"]).assign_attrs(
        long_name="whether the interval is a single value of the grid", units="1")
    computed = computed_scenes(results)
    cells = [name for name in computed.dims if name not in (*names, along)]
    found["trials"] = computed.sum(DRAWS).max(
        [name for name in cells if name != DRAWS]).compute().assign_attrs(
        long_name="trials of a cell, the most at this value", units="1")
    found["poses"] = computed.sum([*cells, along]).compute().assign_attrs(
        long_name="scenes that were computed, of all values", units="1")
    return found.assign_attrs(
        along=along, harder="upwards" if upwards else "downwards",
        configuration_dims=[name for name in configuration_axes(results) if name in kept],
        per=[*names], at_all=together, require=[*require])


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
    smaller = smaller_upwards(lambda: image_sides(results), values, along)
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


def _reach(
    values: Floats, upwards: bool, keeps: Masks, judged: Masks, decision: Decisions
) -> dict[str, Any]:
    """Return the limit of one condition along the axis, from easy to hard.

    ``fails`` is the index of the first value beyond it that fails.
    """
    if not judged.any():
        return {"reach": Reach.not_run}
    none, beyond = (-np.inf, np.inf) if upwards else (np.inf, -np.inf)
    run, index = met_run(keeps, judged), np.arange(len(values))
    gaps = np.flatnonzero(judged & ~keeps & (index < (run[0] if run else 0)))
    if gaps.size:
        judged = judged & (index > gaps[-1])

    def up_to(holds: Masks) -> float:
        """Return the last judged value up to which it holds."""
        at = int(last_steady(holds, judged))
        return none if at < 0 else float(values[at])

    possible = decision != Decision.not_met
    ends = sorted((up_to(decision == Decision.met),
                   beyond if (possible | ~judged).all() else up_to(possible)))
    value = up_to(keeps)
    row = {"value": value if np.isfinite(value) else np.nan, "low": ends[0], "high": ends[1],
           "met_beyond": 0.0}
    if run:
        row["start"] = float(values[run[0]])
    failing = np.flatnonzero(judged & ~keeps)
    if not failing.size:
        return {**row, "reach": Reach.within if gaps.size else Reach.always}
    again = np.flatnonzero(judged & keeps & (index > failing[0]))
    return {**row, "fails": int(failing[0]), "fails_at": float(values[failing[0]]),
            "met_beyond": float(len(again)),
            "farthest_beyond": float(values[again[-1]]) if again.size else np.nan,
            "reach": Reach.never if run is None else Reach.within if gaps.size else Reach.found}


def met_run(
    keeps: np.ndarray[Any, Any], judged: np.ndarray[Any, Any]
) -> tuple[int, int] | None:
    """Return the first and the last index of the run of values that are kept, without a gap.

    It is that from the first judged value on, or, if that is not kept, the longest; of several the
    first. Values that are not judged (n,) neither count nor make a gap. None without any.

    >>> met_run(np.array([0, 1, 0, 1, 1], bool), np.ones(5, bool))
    (3, 4)
    """
    at = np.flatnonzero(judged)
    # Runs begin and end where the mask changes.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], keeps[at], [False]])))
    if not edges.size:
        return None
    runs = edges.reshape(-1, 2)
    first, end = runs[0] if runs[0, 0] == 0 else runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return int(at[first]), int(at[end - 1])


def _cause(
    cell: xr.Dataset, keeps: xr.DataArray, together: Sequence[str]
) -> dict[str, Any]:
    """Return which requirement fails worst, where among ``together``, and its value there."""
    failing = ~keeps & (cell["decision"] != Decision.not_applicable)
    worst = largest_cell(cell, excess_of(cell).where(failing, -np.inf))
    at = {name: worst[name].item() for name in together}
    where = ", ".join(f"{name} = {value:g}" if isinstance(value, float) else f"{name} = {value}"
                      for name, value in at.items())
    return {"limited_by": str(worst["requirement"].item()), "fails_where": where,
            "failing_value": float(worst["value"])}


@describes
def detection_limit(
    results: xr.Dataset, rate: float = 0.9, per: Sequence[str] | None = None
) -> xr.Dataset:
    """Return the smallest side of the black square from which on the marker is detected.

    Parameters
    ----------
    results
        The dataset of a run with an axis that changes the size in the image: ``side_px``,
        ``distance_m``, ``size_m``, or one of the camera. What is no coordinate is read from the
        pipeline in its attributes.
    rate
        The detection rate that is asked for, above 0 and below 1.
    per
        Dimensions that are kept; by default the tilt or viewing angle, if it varies. A dimension
        ``dictionary`` is always kept, the axis of the size and the trials cannot be. Others are
        pooled.

    Returns
    -------
    xr.Dataset
        Dimensions (*detector settings, *per): `requirement_limits` of ``detection >= rate``, as
        sides.

        - ``side_px``: side in pixels, if the square were parallel to the image, down to which the
          rate is reached without a gap; infinite for never. Its interval is in ``side_px_low`` and
          ``side_px_high``: 0 or infinite, the limit may lie beyond the grid.
        - ``side_px_per_module``: the same per module of the marker, with its interval.
        - the axis, such as ``distance_m``: its value there, with its interval in
          ``distance_m_low`` and ``distance_m_high``.
        - ``reach``: whether the rate is reached within the grid (`Reach`).

    Raises
    ------
    ArgumentError
        For a rate outside (0, 1), and for ``per`` that cannot be kept, or leaves several axes of
        the size.
    DatasetError
        If no axis changes the size, or it is drawn; if the dataset lacks variables of results, has
        no poses, or a single draw of each.

    Notes
    -----
    The interval is computed by `requirement_limits`, for each condition by itself.

    Examples
    --------
    >>> limit = detection_limit(results, rate=0.6)
    >>> limit["side_px"].item(), limit["side_px_high"].item(), Reach(limit["reach"].item()).name
    (20.0, 40.0, 'found')
    """
    require_poses(results)
    axes = axes_of(results)
    results = results.isel(  # what has several estimators has been detected once
        {name: 0 for name in axes if name not in results["detection"].dims}, drop=True)
    if per is None:
        per = [name for name in ("tilt_deg", "view_angle_deg") if name in axes]
    per = kept_dimensions(
        results, (*as_names(per), *(name for name in ("dictionary",) if name in axes)))
    sides = image_sides(results)
    if not sides.dims:
        raise DatasetError("side_px or distance_m: no axis changes the size in the image; there "
                           f"are {', '.join(axes) or 'none'}")
    along = [str(dim) for dim in sides.dims if dim not in per]
    if len(along) != 1:
        raise ArgumentError("per", ", ".join(per), "expected all axes of the size but one, which "
                            f"the limit is along; there are {', '.join(map(str, sides.dims))}")
    found = requirement_limits(results, [f"detection >= {rate:.12g}"], along[0], per)
    names = parameter_value(results, "dictionary")
    modules: Any = module_count(names) if isinstance(names, str) else xr.apply_ufunc(
        np.vectorize(module_count), names)
    smaller = found.attrs["harder"] == "upwards"
    # Ends of sides are the other ends of what makes markers small as it grows.
    ends = ("", "_high", "_low") if smaller else tuple(INTERVAL)
    out = {"reach": found["reach"]}
    for (end, words), other in zip(INTERVAL.items(), ends, strict=True):
        value, at = (found[each[1:] or "value"] for each in (end, other))
        nowhere = at.isnull()
        at = at.where(~nowhere, -np.inf if smaller else np.inf)
        known = sides.sel({along[0]: at.clip(float(sides[along[0]].min()),
                                             float(sides[along[0]].max()))}, method="nearest")
        beyond = at.copy(data=np.where((at > 0) == smaller, 0.0, np.inf))
        side = known.drop_vars(along).where(np.isfinite(at), beyond).where(
            found["reach"] != Reach.not_run)
        meaning = f"{words}smallest side from which on the detection rate is at least {rate:g}"
        out |= {
            f"side_px{end}": side.assign_attrs(long_name=meaning, units="px"),
            f"side_px_per_module{end}": (side / modules).assign_attrs(
                long_name=f"{meaning}, per module", units="px")}
        if along[0] != "side_px":
            out[f"{along[0]}{end}"] = value
    # Others along the axis, such as the distance of a side, do not belong to the answer.
    return xr.Dataset({name: each.drop_vars(along, errors="ignore").reset_coords(drop=True)
                       for name, each in out.items()})


# --------------------------------------------------------------------------------------------------
# Faults of a choice that show before anything is computed, a line each.

def choice_faults(pipeline: Pipeline, rule: StoppingRule, shares: ErrorShares) -> list[str]:
    """Return the reasons why a choice is impossible.

    Such are requirements that cannot hold, and ones that ``max_trials`` cannot show to be met even
    if no trial fails.
    """
    required, faults = read_requirements(rule.requirements)
    lines = [f"require.all = {shown(text)}: {problem}" for text, problem in faults]
    kept = {TRIAL, rule.along, *rule.among, *rule.at_all}
    pooled = math.prod(len(axis) for axis in pipeline.axes if axis.name not in kept)
    for each in required:
        least = math.ceil(least_draws(each, shares.met) / pooled)
        if least > rule.max_trials:
            lines.append(
                f"{SEARCH}.max_trials = {rule.max_trials}: expected at least {least:,}: fewer "
                f"cannot show {each.text} with {100 * CONFIDENCE:g} % confidence, even if all "
                "meet it")
    return lines


def least_draws(requirement: Requirement, share: float) -> int:
    """Return the draws below which a requirement cannot be decided as met.

    Of a rate, with no failure Clopper and Pearson's end is the tail's n-th root; a quantile needs
    an order statistic beyond; means are not decided below `MIN_DRAWS`.

    Examples
    --------
    >>> least_draws(parse_requirements("detection >= 0.99")[0], 1.0)
    368
    """
    what = requirement.requirable
    if what.is_rate:
        good = requirement.limit if requirement.at_least else 1.0 - requirement.limit
        return draws_to_see(1.0 - good, what.level(share)) if 0.0 < good < 1.0 else 1
    if what.percent is not None:
        below = what.percent / 100.0
        return draws_to_see(
            below if requirement.at_least else 1.0 - below, what.level(share))
    return MIN_DRAWS


# --------------------------------------------------------------------------------------------------
# The walk from the safe end of an axis to the wanted one: answers so far, and trials still needed.
#
# The values of the axis stand in the order of the walk: for the smallest size that will do, from
# the largest down. Each value's conditions are decided one by one. The answer is the last value
# of the walk that meets the requirements, as all values before it do that can be judged: so a
# value beyond one that fails, on the other side of a dip, is no answer. Values at which nothing
# can be judged, such as sizes that do not fit into the image, are left out.
#
# That makes the error of the answer that of a single decision: it is wrong only if, at the first
# value of the walk that truly fails, the condition at which it fails is decided as met. Neither
# the number of values nor that of conditions counts (Berger, "Multiparameter hypothesis testing
# and acceptance sampling", Technometrics 24, 1982: an intersection-union test; Marcus, Peritz and
# Gabriel, Biometrika 63, 1976: tests in a fixed order); the numbers of waves, after each of which
# a decision is made, and of alternatives do (Bonferroni).

Decisions = NDArray[np.uint8]

#: Probability with which an answer meets the requirements.
CONFIDENCE = 0.95


def shares_of_choice(
    confidence: float, *, waves: int, alternatives: int, values: int, conditions: int,
    requirements: int,
) -> ErrorShares:
    """Return the shares of the error probability that each decision of a search may spend.

    Parameters
    ----------
    confidence
        Probability with which no answer fails, and, again, with which no value that is told to
        fail meets all.
    waves
        How often a decision is made at most: once after each wave.
    alternatives, values, conditions, requirements
        How many there are. "Met" is corrected for waves and alternatives, "not met" for all.

    Examples
    --------
    >>> shares_of_choice(0.9, waves=10, alternatives=2, values=5, conditions=2, requirements=1)
    ErrorShares(met=0.1, not_met=0.01)
    """
    met = (1.0 - confidence) / ERROR_PROBABILITY / waves / alternatives
    not_met = met / (values * conditions * requirements)
    return ErrorShares(float(f"{met:.12g}"), float(f"{not_met:.12g}"))


def needed(decision: Decisions, keeps: Masks) -> Masks:
    """Return which cells need more trials, (..., values, conditions).

    Those are the undecided conditions of the values up to the first that fails, or seems to: of
    that one, only the conditions at which it seems to fail. What lies beyond it waits until it is
    decided, and is never needed if it does fail.

    Parameters
    ----------
    decision
        (..., values, conditions) of `sweep.analysis.requirements.Decision`, in the order of the
        walk.
    keeps
        Of the same shape: where the estimates keep all limits.
    """
    undecided = decision == Decision.undecided
    seems = undecided & ~keeps
    value = combined_decision(decision, -1)
    stops = (value == Decision.not_met) | seems.any(axis=-1)
    before = np.cumsum(stops, axis=-1) == 0
    first = stops & (np.cumsum(stops, axis=-1) == 1) & (value == Decision.undecided)
    return np.asarray((undecided & before[..., None]) | (seems & first[..., None]))


@dataclass(frozen=True, slots=True)
class Walk:
    """How far a walk came; indices along the walk.

    Attributes
    ----------
    answer
        The last value before which, and at which, all is met; -1 for none.
    next
        The first value that is not met or undecided; the number of values if there is none.
    isolated
        Values from ``next`` on that fail, or seem to, and beyond which another seems to meet all:
        failures that a search by halving would have stepped over.
    passing
        The values beyond that seem to meet all, or do.
    """

    answer: int
    next: int
    isolated: tuple[int, ...]
    passing: tuple[int, ...]


def walk(decision: Decisions, keeps: Masks) -> Walk:
    """Return how far a walk comes, of one alternative.

    Parameters
    ----------
    decision, keeps
        (values, conditions), as in `needed`.

    Examples
    --------
    >>> met, failed = Decision.met, Decision.not_met
    >>> decision = np.array([[met], [met], [failed], [met], [failed]], np.uint8)
    >>> walk(decision, decision == met)
    Walk(answer=1, next=2, isolated=(2,), passing=(3,))
    """
    value = combined_decision(decision, -1)
    judged = value != Decision.not_applicable
    stops = np.flatnonzero(judged & (value != Decision.met))
    after = int(stops[0]) if stops.size else len(value)
    met = np.flatnonzero(value[:after] == Decision.met)
    applicable = decision != Decision.not_applicable
    seems = (keeps | ~applicable).all(axis=-1) & judged & (value != Decision.not_met)
    passing = [k for k in range(after + 1, len(value)) if seems[k]]
    isolated = [k for k in range(after, passing[-1])
                if judged[k] and (not seems[k] or k == after)] if passing else []
    return Walk(int(met[-1]) if met.size else -1, after, tuple(isolated), tuple(passing))


# --------------------------------------------------------------------------------------------------
# The choice that meets requirements at all conditions: of a size, and among other settings.
#
# What a choice is stands in `sweep.experiment.sampling`. Every alternative, a combination of the
# values of the axes ``among``, has its own answer.

@dataclass(frozen=True, slots=True)
class Nearest:
    """The value that is nearest to meeting all, where none does.

    Attributes
    ----------
    value
        The value, None without an axis.
    excess
        How far it is beyond the limit of a requirement, relative to it.
    cause
        That requirement and its condition.
    """

    value: float | None
    excess: float
    cause: Cause


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer of one alternative.

    Attributes
    ----------
    alternative
        Values by axis, of the axes ``among``.
    met
        Whether any choice meets the requirements.
    value
        The smallest (largest) value of the axis from which on all larger (smaller) ones of the
        grid meet them; None if there is no such axis, or no such value.
    tightest
        The requirement and condition at which the answer is nearest to failing.
    next, next_cause
        The next value, which fails or is undecided, and by what; None if all values meet them.
        Without an axis ``next`` is None, and ``next_cause`` that of the alternative itself.
    isolated
        Values that fail, or seem to, with others beyond that seem to meet all: (value, cause).
    passing
        Those values beyond.
    nearest
        If none is met: the nearest alternative.
    is_open
        Whether it is undecided what the answer is: the next value may meet them, too.
    possible
        The last value that may do so: none before it is decided to fail.
    """

    alternative: Mapping[str, Any]
    met: bool
    value: float | None
    tightest: Cause | None = None
    next: float | None = None
    next_cause: Cause | None = None
    isolated: tuple[tuple[float, Cause], ...] = ()
    passing: tuple[float, ...] = ()
    nearest: Nearest | None = None
    is_open: bool = False
    possible: float | None = None


@dataclass(frozen=True, slots=True)
class ChoiceCells:
    """Decisions at each value and condition of each alternative.

    Attributes
    ----------
    table
        Of `sweep.analysis.requirements.decide`, dimensions (*among, along, *at_all, requirement),
        the values in the order of the walk; without the axis ``along`` if there is none.
    decision, keeps
        (alternatives, values, conditions): of all requirements together, and whether the estimates
        keep all limits.
    excess
        (alternatives, values): how far the worst value is beyond its limit, relative to it;
        negative on the right side of it, infinite for no number.
    hopeless
        (alternatives, values, conditions): undecided, and no number of trials will tell.
    rule, shares
        The search, and the shares of the error probability that a decision may spend.
    """

    table: xr.Dataset
    decision: Decisions
    keeps: Masks
    excess: Floats
    hopeless: Masks
    rule: StoppingRule
    shares: ErrorShares

    def needed(self) -> xr.DataArray:
        """Return which cells need more trials, dimensions (*among, along, *at_all)."""
        template = self.table["decision"].isel(requirement=0, drop=True)
        decision = np.where(self.hopeless, np.uint8(Decision.not_met), self.decision)
        return template.copy(data=needed(decision, self.keeps).reshape(template.shape))


def choice_shares(pipeline: Pipeline, rule: StoppingRule) -> ErrorShares:
    """Return the shares of the error probability that each decision of a search may spend."""
    def size(names: Sequence[str]) -> int:
        axes = [axis for name in names if (axis := pipeline.axis(name)) is not None]
        return math.prod(map(len, axes))

    return shares_of_choice(
        CONFIDENCE, waves=len(rule.ends), alternatives=size(rule.among),
        values=size([rule.along] if rule.along else []), conditions=size(rule.at_all),
        requirements=len(rule.requirements))


def choice_cells(results: xr.Dataset, rule: StoppingRule, shares: ErrorShares) -> ChoiceCells:
    """Return the decisions of a dataset, of a whole store or of some of its alternatives.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`.
    """
    required = parse_requirements(rule.requirements)
    kept = [*rule.among, *([rule.along] if rule.along else []), *rule.at_all]
    table = decide(results, required, kept, shares=shares)
    table = table.transpose(*kept, "requirement", missing_dims="ignore")
    if rule.along:
        values = table[rule.along].to_numpy()
        order = np.argsort(values, kind="stable")
        table = table.isel({rule.along: order if rule.largest else order[::-1]})
    conditions = math.prod(table.sizes[name] for name in rule.at_all)
    shape = (-1, table.sizes[rule.along] if rule.along else 1, conditions, len(required))

    def cells(name: str) -> NDArray[Any]:
        values = table[name].to_numpy().reshape((*table[name].shape[:len(kept)], -1))
        return np.broadcast_to(values, table["value"].shape).reshape(shape)

    # Where so few poses count that max_trials will not have enough, there is nothing to learn.
    poses = cells("looked_for").astype(np.float64)
    pooled = math.prod(results.sizes[str(name)] for name in results["true_tvec_m"].dims if
                       name not in (*kept, DRAWS, "xyz"))
    with np.errstate(invalid="ignore"):
        coming = cells("draws") / poses * rule.max_trials * pooled
    each = cells("decision").astype(np.uint8)
    hopeless = (poses >= MIN_DRAWS) & (coming < MIN_DRAWS) & (each == Decision.undecided)
    decision = combined_decision(each, -1)
    table = table.assign(excess=excess_of(table), keeps=kept_by(table, required))
    excess = np.where(each == Decision.not_applicable, -np.inf, cells("excess"))
    keeps = cells("keeps") | (each == Decision.not_applicable)
    return ChoiceCells(
        table, decision, np.asarray(keeps.all(-1)), excess.max(axis=(2, 3)),
        hopeless.any(-1) & (decision == Decision.undecided), rule, shares)


def answers(cells: ChoiceCells) -> list[Answer]:
    """Return the answer of each alternative, in the order of the table's dimensions."""
    return [_answer(cells, k, *alternative)
            for k, alternative in enumerate(each_cell(cells.table, cells.rule.among))]


def _answer(
    cells: ChoiceCells, k: int, alternative: Mapping[str, Any], table: xr.Dataset
) -> Answer:
    """Return the answer of alternative number ``k``, whose part of the cells is a table."""
    along = cells.rule.along
    values: list[Any] = table[along].to_numpy().tolist() if along else [None]

    def cause(at: int) -> Cause:
        """Return the requirement and condition by which a value fails worst, or is nearest."""
        cell = worst_cell(table.isel({along: at}) if along else table)
        needed = math.nan
        if cell["decision"] == Decision.undecided:
            required = parse_requirements(str(cell["requirement"].item()))[0]
            solved = float(cell["solved"]) / max(float(cell["looked_for"]), 1.0)
            needed = float(draws_needed(required, cell, solved, cells.shares.met))
        return Cause.at(cell, cells.rule.at_all, draws_needed=needed)

    came = walk(cells.decision[k], cells.keeps[k])
    value = combined_decision(cells.decision[k], -1)
    judged = value != Decision.not_applicable
    met, after = came.answer >= 0, came.next < len(values)
    nearest = None
    if not met:
        best = int(np.argmin(np.where(judged, cells.excess[k], np.inf)))
        nearest = Nearest(values[best], float(cells.excess[k, best]), cause(best))
    possible = int(last_steady(value != Decision.not_met, judged))
    return Answer(
        alternative, met, values[came.answer] if met else None,
        cause(came.answer) if met else None, values[came.next] if after else None,
        cause(came.next) if after else None,
        tuple((values[at], cause(at)) for at in came.isolated),
        tuple(values[at] for at in came.passing), nearest,
        bool((value[: possible + 1] == Decision.undecided).any()),
        None if possible < 0 else values[possible])


# --------------------------------------------------------------------------------------------------
# Half-widths of intervals, by which sampling stops, and whether they are as small as is wanted.
#
# Of rates they are as they are, of a bias relative to the root mean square error, of all else
# relative to the value. The intervals are those that the analysis shows of a store whose sampling
# was stopped (`sweep.analysis.estimator`).

#: Draws below which no interval of a mean or a root mean square is narrow enough.
#:
#: Their formulas need draws to tell how the errors spread: the interval of a lucky start is narrow.
MIN_MEAN_DRAWS = 450

#: Poses that count below which a rate is not worth waiting for.
MIN_OF_RATE = 50

#: Level of the interval that says that too few numbers will come.
NEVER_LEVEL = 0.999


class Reached(Flag):
    """Whether a quantity is known as well as was wanted."""

    not_run = flag(0, "Nothing was computed.", counted=False)
    reached = flag(1, "The interval is as narrow as was wanted.", present=True)
    not_reached = flag(2, "The interval is wider than was wanted.", present=True)
    too_rare = flag(
        3, "Poses that have such a number are too rare for an interval as narrow as was wanted.")
    not_applicable = flag(4, "No pose was looked for.", counted=False)


@dataclass(frozen=True)
class WantedPrecision:
    """The half-width that is wanted of the interval of a quantity.

    Attributes
    ----------
    requirable
        The quantity.
    half_width
        As the module says; above 0, below 1.
    """

    requirable: Requirable
    half_width: float

    @property
    def name(self) -> str:
        """Name of the quantity."""
        return self.requirable.name

    @property
    def relative_to(self) -> str:
        """Quantity of which the half-width is a share; empty for a rate."""
        return "" if self.requirable.is_rate else "RMSE" if self.spread else "value"

    @property
    def spread(self) -> Requirable | None:
        """Of a bias the standard deviation; else None."""
        return requirables().get(self.name.replace("_bias_", "_sd_")) \
            if "_bias_" in self.name else None

    def statistics(self, prefix: str) -> list[Statistic[Poses]]:
        """Return the statistics that must be computed, their variables' names with a prefix.

        Their intervals must hold for stores whose sampling was stopped.
        """
        parts = self.requirable.computed(prefix, LEVEL)
        return parts + self.spread.computed(f"{prefix}of ", LEVEL)[:1] if self.spread else parts

    @property
    def least_draws(self) -> int:
        """Draws with a number below which it is useless to go on.

        It does not depend on the half-width, so that a smaller one never needs fewer trials.
        """
        if self.requirable.is_rate:
            return MIN_OF_RATE
        if (percent := self.requirable.percent) is None:
            return MIN_MEAN_DRAWS
        return draws_to_see(1.0 - percent / 100.0, stopped_level(LEVEL))

    @property
    def fewest_draws(self) -> int:
        """Draws below which no interval is narrow enough, whatever the results are."""
        if not self.requirable.is_rate:
            return self.least_draws
        if self.half_width >= 0.5:
            return 1
        return draws_to_see(2.0 * self.half_width, stopped_level(LEVEL))

    def judged(self, table: xr.Dataset, prefix: str, total: xr.DataArray) -> xr.Dataset:
        """Return value, half-width, a flag of `Reached`, and the poses and draws that it is of.

        Parameters
        ----------
        table
            The variables of `statistics`; ``looked_for`` and ``run``: poses that were.
        prefix
            As there.
        total
            Poses that all trials would be.
        """
        what = self.requirable
        ends = [table[f"{prefix}{self.name}{end}"] for end in INTERVAL]
        # Of a bias with its sign.
        value, low, high = ends if what.signed else what.interval(table, prefix)
        used, draws = table[f"{prefix}used"], table[f"{prefix}draws"]
        with np.errstate(all="ignore"):
            half = (high - low) / 2.0
            if not what.is_rate:
                scale = abs(value) if self.spread is None else xr.apply_ufunc(
                    np.hypot, value, table[f"{prefix}of {self.spread.name}"])
                half = (half / scale).where(half != 0.0, 0.0)
        # Too many poses are lost for a quantile: it is infinite, which is all there is to know.
        half = half.where(low != np.inf, 0.0)
        reached = np.select(
            [table["run"] == 0, table["looked_for"] == 0,
             (half <= self.half_width) & (draws >= (1 if what.exact else MIN_MEAN_DRAWS)),
             self._too_rare(used, draws, table["run"], total)],
            [Reached.not_run, Reached.not_applicable, Reached.reached, Reached.too_rare],
            Reached.not_reached)
        return xr.Dataset({
            "value": value, "half_width": half, "used": used, "draws": draws,
            "reached": used.copy(data=reached.astype(np.uint8))})

    def _too_rare(
        self, used: xr.DataArray, draws: xr.DataArray, run: xr.DataArray, total: xr.DataArray
    ) -> xr.DataArray:
        """Return where even all trials give fewer draws with a number than `least_draws`.

        By the upper end of the share of poses that have one; ``used`` poses are worth ``draws``.
        """
        share = used.copy(data=clopper_pearson(used, np.maximum(run, used), NEVER_LEVEL)[1])
        worth = (draws / np.maximum(used, 1)).where(used > 0, 1.0)
        return (share * total * worth < self.least_draws) & (total >= self.least_draws)


def wanted_precisions(wanted: Mapping[str, float]) -> tuple[WantedPrecision, ...]:
    """Return the precisions that names and half-widths ask for.

    Names are as in requirements (`sweep.analysis.requirements.parse_requirements`).

    Raises
    ------
    ValueError
        One line for each name that does not exist, each half-width that cannot be, and each
        quantity that is named twice.

    Examples
    --------
    >>> [(each.name, each.half_width) for each in wanted_precisions({"detection": 0.02})]
    [('detection_rate', 0.02)]
    """
    precisions: dict[str, WantedPrecision] = {}
    faults = []
    for name, half_width in wanted.items():
        try:
            what = named(name)
        except ValueError as error:
            text = str(error)
            faults.append(text if text.startswith(f"{name}:") else f"{name}: {text}")
            continue
        if not 0.0 < half_width < 1.0:
            faults.append(f"{name}: expected the half-width of an interval, above 0 and below 1")
        elif what.name in precisions:
            faults.append(f"{name}: {what.name} has another half-width; delete one")
        else:
            precisions[what.name] = WantedPrecision(what, float(half_width))
    if faults:
        raise ValueError("\n".join(faults))
    return tuple(precisions.values())


# --------------------------------------------------------------------------------------------------
# How well each condition of a store is known, against the precision that was wanted.

@describes
def precision_reached(
    results: xr.Dataset, wanted: Mapping[str, float] | None = None,
    per: Sequence[str] | None = None,
) -> xr.Dataset:
    """Return how well each condition is known, against the precision that was wanted.

    Parameters
    ----------
    results
        The dataset of a run.
    wanted
        Half-widths of intervals by the name of the quantity, such as ``{"detection_rate": 0.02}``:
        of rates as they are, of a bias relative to the root mean square error, of all else
        relative to the value. By default as in the pipeline's [search].
    per
        Dimensions whose values are conditions; by default as in the pipeline's [search].
        Detector and estimator are always kept.

    Returns
    -------
    xr.Dataset
        Dimensions (*configuration, *per, quantity), computed.

        - ``value`` and ``half_width`` of its interval, in the terms of ``wanted``.
        - ``reached``: whether it is as narrow as was wanted (`Reached`).
        - ``used``: poses that the value is of; ``draws``: the random draws that these are worth.
        - ``run`` (*configuration, *per): poses that were run, of ``poses`` that all trials are.
        - ``settled`` (*per): whether no configuration and quantity of the condition needs more.
        - ``wanted`` (quantity).

    Raises
    ------
    ArgumentError
        For names and half-widths that cannot be, and a dimension that does not exist.
    DatasetError
        If the dataset lacks a variable, or has no poses.

    Notes
    -----
    The intervals are those by which sampling stops: at 97 % for 95 %, and 98 % for root mean
    squares and standard deviations (`sweep.analysis.estimator`), also of a store whose
    sampling was not stopped.

    Examples
    --------
    >>> table = precision_reached(results, {"detection_rate": 0.3}, per=["side_px"])
    >>> [Reached(flag).name for flag in table["reached"].isel(solver=0, quantity=0).values]
    ['reached', 'not_reached', 'reached']
    """
    rule = stopping_rule(results)
    if wanted is None:
        if rule is None or not rule.precision:
            raise ArgumentError("wanted", None, "this store's pipeline searches no precision; "
                                'give half-widths, such as {"detection_rate": 0.02}')
        wanted = dict(rule.precision)
    if per is None:
        per = rule.per if rule is not None and rule.precision else ()
    try:
        precisions = wanted_precisions(wanted)
    except ValueError as error:
        raise ArgumentError("wanted", wanted, str(error)) from None
    return precision_table(results, precisions, as_names(per))


def precision_table(
    results: xr.Dataset, precisions: Sequence[WantedPrecision], per: Sequence[str],
    trials: int | None = None,
) -> xr.Dataset:
    """Return the table of `precision_reached`.

    ``trials`` are the most that there may be; by default as many as there are.
    """
    configuration = configuration_axes(results)
    kept = kept_dimensions(results, tuple(dict.fromkeys((*configuration, *per))))
    configuration = [name for name in configuration if name in kept]
    statistics = [
        Count(*LOOKED_FOR, lambda poses: poses.looked_for),
        Count("run", "poses that were run", lambda poses: poses.run),
        Count("poses", "poses that all trials are", lambda poses: np.ones_like(poses.run)),
        *(each for number, precision in enumerate(precisions)
          for each in precision.statistics(f"{number} ")),
    ]
    inputs = requirable_arrays(results, [each.requirable for each in precisions])
    table = aggregate(results, inputs, kept, statistics, Poses, stopped=True)
    total = table["poses"]
    if trials is not None:
        total = total // results.sizes[DRAWS] * trials
    judged = [each.judged(table, f"{number} ", total) for number, each in enumerate(precisions)]
    out = stacked(judged, "quantity").reset_coords(drop=True)
    for name, meaning, units in (
        ("value", "value", ""), ("half_width", "half-width of the interval, as was wanted", ""),
        ("used", "poses that the value is of", "1"),
        ("draws", "random draws that these are worth", "1"),
    ):
        out[name].attrs = cf_attributes(meaning, units)
    out["reached"].attrs = cf_attributes(
        "whether the interval is as narrow as was wanted", flags=Reached)
    needs = out["reached"].isin((Reached.not_run, Reached.not_reached))
    out["settled"] = (~needs.any([*configuration, "quantity"])).assign_attrs(
        cf_attributes("whether no configuration and quantity needs more trials", "1"))
    out = out.assign(run=table["run"], poses=table["poses"]).assign_coords(
        {name: each for name, each in table.coords.items() if set(each.dims) <= {*kept}})
    return out.assign_coords(
        quantity=("quantity", [each.name for each in precisions]),
        wanted=("quantity", [each.half_width for each in precisions]),
        relative_to=("quantity", [each.relative_to for each in precisions]),
    ).assign_attrs(configuration_dims=list(configuration))
