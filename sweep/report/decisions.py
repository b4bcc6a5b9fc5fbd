"""Decisions on requirements, on a choice, and how far they hold, as lines, tables and JSON."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from sweep.analysis import requirements as judged
from sweep.analysis.comparisons import regressions
from sweep.analysis.dataset import DRAWS, axes_of, configuration_axes, each_cell, is_replicated
from sweep.analysis.requirements import CONFIDENCE, Cause, Decision, Reach, Verdict, described
from sweep.errors import ArgumentError
from sweep.experiment.draws import REPLICATES
from sweep.experiment.pipeline import parse_selection
from sweep.messages import label, nearest, quoted
from sweep.plugins.recording import is_recording
from sweep.report.figure import Figure
from sweep.report.table import (
    UNDECIDED,
    Column,
    Findings,
    Table,
    Value,
    axis_label,
    coordinate,
    coordinates,
    interval_text,
    number,
    table_of,
)
from sweep.store.lifecycle import open_dataset, open_finished, read_pipeline
from sweep.typing import Masks

if TYPE_CHECKING:
    from sweep.analysis.requirements import Answer
    from sweep.experiment.pipeline import Pipeline
    from sweep.tradeoff.choice_search import Choice

WORDS = {Decision.met: "met", Decision.not_met: "not met", Decision.undecided: "not decided",
         Decision.not_applicable: "nothing to judge"}

UNITS = {"": "", "1": "", "percent": " %", "degree": "\u00b0"}

#: Decision -> exit status of a command.
STATUS = {Decision.met: 0, Decision.not_met: 1, Decision.undecided: UNDECIDED,
          Decision.not_applicable: UNDECIDED}

#: Conditions that JSON lists.
MAX_ROWS = 500

# --------------------------------------------------------------------------------------------------
# Whether requirements are met: a row for each with its worst condition, and rows for conditions.


def require(
    store: str | PathLike[str], requirements: Sequence[str] = (), *,
    per: Sequence[str] | None = None, at: Sequence[str] = (), pipeline: str | None = None,
    against: str | PathLike[str] | None = None, every: bool = True,
) -> Findings:
    """Decide whether a store's results meet requirements.

    Parameters
    ----------
    store
        Path or URL of a finished store.
    requirements
        Such as "detection >= 0.95" (default: the section [require] of the store's pipeline).
    per
        Axes whose values are conditions, at each of which all must hold; others are pooled
        (default: those of [require], else the axes of size, angle and boards).
    at
        "name=value": only these values of axes.
    pipeline
        A TOML file whose section [require] is taken.
    against
        An older store, with which it is compared pose by pose: significantly worse is not met.
    every
        Whether the table of conditions has all of them, or those that fail.

    Returns
    -------
    Findings
        The decisions as tables and numbers; ``numbers["decision"]`` is that on all together, and
        ``data`` the dataset of `sweep.analysis.check_requirements`.

    Raises
    ------
    ArgumentError, StoreError, DatasetError
        For what cannot be required, and stores that cannot be read.

    Examples
    --------
    >>> found = sweep.require(folder / "two_sizes.zarr", ["detection >= 0.01"], per=[])
    >>> found.numbers["decision"].name
    'met'
    """
    results, stored = selected_store(store, at)
    if pipeline is not None:
        stored = read_pipeline(pipeline)
    texts = list(requirements) or list(stored.requirements)
    axes = list(judged.conditions(results, per, stored.require_per))
    if not texts and against is None:
        raise ArgumentError(
            "requirements", "[]", "the pipeline has no section [require]; give some, such as "
            "'detection >= 0.95' 'range_error_p95_percent <= 1'")
    required = judged.parse_requirements(texts) if texts else ()
    table = judged.check_requirements(results, required, axes) if required else None
    found = [] if table is None else judged.verdicts(table)
    worse = [] if against is None else regressions(
        selected_store(against, at)[0], results, [each.variable for each in required], axes)
    decision = Decision.not_met if any(each.worse for each in worse) else (
        judged.combined(found) if found else Decision.met)
    named = {*axes, DRAWS, *configuration_axes(results)}
    pooled = [name for name in axes_of(results) if name not in named and results.sizes[name] > 1]
    parts: list[Table | str] = [decision_table(found), Table.of(
        "Compared with the older store pose by pose, new minus old",
        ("", "quantity", "configuration", "difference", "condition"),
        [["worse" if each.worse else "not worse", each.quantity, described(each.configuration),
          valued(each.difference, each.low, each.high, each.units), described(each.condition)]
         for each in worse], words=True)]
    if table is not None:
        parts.append(condition_table(found, table, every=every))
    if per is None and list(stored.require_per) != axes and axes:
        parts.append(f"at each value of {', '.join(axes)}; --per '' pools all")
    if pooled:
        parts.append(f"pooled over {', '.join(pooled)}; --per keeps axes apart as conditions")
    return Findings(
        parts, {
            "decision": decision, "per": axes, "pooled": pooled, "against": worse,
            "requirements": [
                {**dataclasses.asdict(each), "failing": [] if table is None else
                 conditions_of(each, table)[:MAX_ROWS]} for each in found]},
        table, STATUS[decision], (more_draws(found, results, os.fspath(store)), ""))


def selected_store(
    url: str | PathLike[str], at: Sequence[str] = ()
) -> tuple[xr.Dataset, Pipeline]:
    """Return a finished store's results at some values of axes, and its pipeline."""
    store = open_finished(os.fspath(url))
    return selected(open_dataset(url), at, store.pipeline), store.pipeline


def selected(results: xr.Dataset, at: Sequence[str], pipeline: Pipeline) -> xr.Dataset:
    """Return results at some values of axes, or of parameters that go together along one.

    Raises
    ------
    ArgumentError
        For an axis or a value that the store does not have.
    """
    kept: dict[str, list[int]] = {}
    for name, value in parse_selection(",".join(at), pipeline).items() if at else ():
        axis, axes = pipeline.axis_of(name), axes_of(results)
        if axis is None or axis.name not in axes:
            raise ArgumentError("at", name, f"no such axis{nearest(name, axes)}; "
                                f"there are {', '.join(axes)}")
        values = axis.columns[name]
        kept[axis.name] = [
            k for k in kept.get(axis.name, range(len(axis))) if values[k] == value or (
                isinstance(values[k], float) and math.isclose(values[k], value, rel_tol=1e-9))]
        if not kept[axis.name]:
            shown = ", ".join(map(label, values[:20]))
            raise ArgumentError("at", f"{name}={label(value)}", f"no such value; there are {shown}")
    return results.isel(kept)


def conditions_of(
    each: Verdict, table: xr.Dataset, *, every: bool = False
) -> list[dict[str, Any]]:
    """Return the conditions at which a requirement is not met, or else undecided; worst first.

    ``table`` is returned by `sweep.analysis.check_requirements`. Each has its condition, decision,
    value, interval and draws. ``every``: all conditions.
    """
    if not every and each.decision not in (Decision.not_met, Decision.undecided):
        return []
    one = table.isel(requirement=table["requirement"].values.tolist().index(each.requirement))
    one = one.sel({name: value for name, value in each.configuration.items() if name in one.dims})
    found = [
        {"condition": at, "decision": Decision(int(cell["decision"])),
         **{name: cell[name].item() for name in ("value", "low", "high", "draws")}}
        for at, cell in each_cell(one, [str(dim) for dim in one["decision"].dims])
        if every or cell["decision"] == each.decision]
    sign = -1 if one["relation"].item() in (">=", ">") else 1
    return sorted(found, key=lambda row: -sign * np.nan_to_num(row["value"], nan=sign * np.inf))


def decision_table(found: Sequence[Verdict]) -> Table:
    """Return a row for each requirement and configuration, at its worst condition."""
    return Table.of(
        "Requirements, with the worst condition",
        ("", "requirement", "configuration", "value", "condition", "met at", "draws"),
        [[WORDS[each.decision], each.requirement, described(each.configuration),
          valued(each.value, each.low, each.high, each.units), described(each.condition),
          f"{each.counts.get(Decision.met, 0)} of {each.conditions}",
          needs(each) or f"{each.draws:,}"]
         for each in found], words=True)


def condition_table(found: Sequence[Verdict], table: xr.Dataset, *, every: bool) -> Table:
    """Return all conditions with ``every``, else those at which a requirement fails, if several."""
    listed = [(each, conditions_of(each, table, every=every)) for each in found]
    return Table.of(
        "All conditions" if every else "Conditions that fail, the worst first",
        ("", "requirement", "configuration", "condition", "value", "draws"),
        [[WORDS[row["decision"]], each.requirement, described(each.configuration),
          described(row["condition"]), valued(row["value"], row["low"], row["high"], each.units),
          f"{np.nan_to_num(row['draws']):,.0f}"]
         for each, rows in listed for row in rows if every or len(rows) > 1], words=True)


def valued(value: float, low: float, high: float, units: str) -> str:
    """Return a number with its interval and unit.

    >>> valued(1.0, 0.5, math.inf, "percent")
    '1.00 (0.500 to \u221e) %'
    """
    if math.isnan(value):
        return "no number"
    return f"{number(value)} ({interval_text(low, high)}){UNITS.get(units, f' {units}')}"


def needs(each: Cause) -> str:
    """Return the draws of an undecided requirement, and how many would decide it."""
    if each.decision is not Decision.undecided or math.isnan(each.draws_needed):
        return ""
    if math.isinf(each.draws_needed):
        return f"{each.draws:,} draws, no number would decide so small a difference"
    return f"{each.draws:,} draws, about {each.draws_needed:,.0f} would decide"


def more_draws(found: Sequence[Verdict], results: xr.Dataset, store: str) -> str:
    """Return the command that makes about as many draws as are needed, of simulated images."""
    given = "photograph" in results.coords or any(
        map(is_recording, np.ravel(results.get("detector", "")).tolist()))
    factor = max((each.draws_needed / each.draws for each in found
                  if each.draws > 0 and math.isfinite(each.draws_needed)), default=0.0)
    if factor <= 1.0 or given:
        return f"sweep report {quoted(store)}"
    unit = REPLICATES if is_replicated(results) else 1
    count = math.ceil(results.sizes.get(DRAWS, 1) * factor / unit) * unit
    return (f"sweep run {quoted(store)} --set trial={count} --store more.zarr "
            f"--reuse {quoted(store)}")


# --------------------------------------------------------------------------------------------------
# Output of ``sweep size``: the answer in a line, a table of the alternatives, JSON.

def headline(choice: Choice) -> str:
    """Return the decision on a choice in a line: the choice, or what comes nearest to one."""
    rule, best = choice.rule, choice.best
    if best is not None:
        name = described(_chosen(choice, choice.answers[best]))
        if not choice.is_undecided:
            wish = ("largest" if rule.largest else "smallest") if rule.along else "cheapest"
            return f"{name} is the {wish} choice"
        bound = f"{'at least' if rule.largest else 'at most'} " if rule.along else ""
        return f"not decided: {bound}{name}; a better choice may meet everything, too"
    line = ("not decided: no choice is known to meet" if choice.is_undecided else
            "no choice meets") + " everything"
    if choice.budget_ms is not None:
        line += f" within {choice.budget_ms:g} ms a frame"
    near = [(answer.nearest, answer) for answer in choice.answers if answer.nearest is not None]
    if not near or any(answer.met for answer in choice.answers):
        return line
    one, answer = min(near, key=lambda each: each[0].excess)
    chosen = _chosen(choice, dataclasses.replace(answer, value=one.value))
    return f"{line}; nearest is {described(chosen)}: {reason(one.cause)}"


def _chosen(choice: Choice, answer: Answer) -> dict[str, Any]:
    """Return the values by axis of an alternative, the axis that is searched first."""
    searched = {} if answer.value is None else {choice.rule.along: answer.value}
    return searched | dict(answer.alternative)


def reason(cause: Cause | None) -> str:
    """Return why a choice fails: the requirement, its value with interval, the condition."""
    if cause is None:
        return ""
    at = f" at {described(cause.condition)}" if cause.condition else ""
    draws = f"; {text}: raise search.max_trials" if (text := needs(cause)) else ""
    return (f"{cause.requirement} is {WORDS[cause.decision]}: "
            f"{valued(cause.value, cause.low, cause.high, cause.units)}{at}{draws}")


def alternatives(choice: Choice) -> Table:
    """Return a row for each alternative: those that meet all first, the best of them before."""
    along, budget = choice.rule.along, choice.budget_ms
    rows = []
    for k in sorted(range(len(choice.answers)), key=lambda k: (
            not choice.answers[k].met, choice.rank(k))):
        answer, cost = choice.answers[k], choice.costs[k]
        within = None if cost is None or budget is None else "yes" if choice.within_budget(k) else (
            "no" if cost.low > budget else "not decided")
        rows.append([
            *map(str, answer.alternative.values()),
            *(["none" if each is None else coordinate(each) for each in (answer.value, answer.next)]
              if along else [answer.met]),
            cost and Value(cost.ms, cost.low, cost.high), within,
            None if cost is None else k in choice.front,
            reason(answer.next_cause), ", ".join(map(coordinate, answer.passing))])
    return Table.of(
        headline(choice),
        [*choice.rule.among, *([along, "next"] if along else ["meets all"]), "ms a frame",
         "within the budget", "on the front", "why not better" if along else "why not",
         "kept beyond, by estimate"], rows, stub=len(choice.rule.among), words=True)


def choice_findings(choice: Choice) -> Findings:
    """Return a choice as findings, which print themselves.

    Exit status: 0 there is one, 1 none meets everything, 3 not decided.
    """
    factor = choice.grid_poses / max(choice.poses, 1)
    return Findings(
        [alternatives(choice),
         (f"{choice.poses:,} poses; {choice.most_trials:,} trials of every cell, which the hardest "
          f"one took, are {choice.grid_poses:,} poses ({factor:.1f} times as many)")],
        as_json(choice), None, STATUS[choice.decision],
        (f"sweep report {quoted(choice.store)}", ""))


def as_json(choice: Choice) -> dict[str, Any]:
    """Return the content of ``--json``.

    ``answer`` is the decided choice; ``known`` meets the requirements, though a better choice may,
    too.
    """
    listed = [
        {**dataclasses.asdict(answer), "cost": None if cost is None else dataclasses.asdict(cost),
         "on_front": k in choice.front, "within_budget": choice.within_budget(k)}
        for k, (answer, cost) in enumerate(zip(choice.answers, choice.costs, strict=True))]
    best = None if choice.best is None else choice.answers[choice.best]
    known = None if best is None else _chosen(choice, best)
    return {
        "answer": known if choice.decision is Decision.met else None, "known": known,
        "decision": choice.decision, "sentences": [headline(choice)],
        "best": choice.best, "along": choice.rule.along,
        "confidence": CONFIDENCE, "conditions": choice.conditions,
        "budget_ms": choice.budget_ms, "alternatives": listed,
        "poses": choice.poses, "grid_poses": choice.grid_poses,
        "most_trials": choice.most_trials, "store": choice.store,
        "warnings": list(choice.notes),
    }


# --------------------------------------------------------------------------------------------------
# Limits that requirements have along an axis, as a table for a terminal, a page, or JSON.

def limit_table(limits: xr.Dataset) -> Table:
    """Return a row for each configuration and condition of `sweep.analysis.requirement_limits`."""
    dims = dimensions(limits)
    rows = []
    for at, one in each_cell(limits, dims):
        fails = ""
        if name := str(one["limited_by"].item()):
            where = str(one["fails_where"].item())
            fails = (f"{_place(one, float(one['fails_at']))}: {name.split(maxsplit=1)[0]} "
                     f"{number(float(one['failing_value']))}{f' ({where})' if where else ''}")
        beyond = float(one["farthest_beyond"])
        rows.append([
            *map(coordinate, at.values()), limit_text(one), limit_interval(one),
            bool(one["settled"]), fails,
            "" if math.isnan(beyond) else _place(one, beyond), int(one["poses"])])
    at_all = ", ".join(limits.attrs["at_all"])
    return Table.of(
        f"How far along {limits.attrs['along']}: {' and '.join(map(str, limits.attrs['require']))}"
        + (f", at all values of {at_all}" if at_all else ""),
        [*dims, "met", "95 % interval", "decided", "fails first",
         "kept again by estimate, farthest at", "poses"], rows, stub=len(dims), words=True)


def dimensions(limits: xr.Dataset) -> list[str]:
    """Return the dimensions of the limits: conditions, then configurations."""
    settings = limits.attrs["configuration_dims"]
    return [*(name for name in limits["value"].dims if name not in settings), *settings]


def limit_text(one: xr.Dataset) -> str:
    """Return up to where requirements are met in one condition: ``up to 1.2 m``.

    An undecided limit is called so, whatever the estimates are.
    """
    start, value = float(one["start"]), float(one["value"])
    end = f"{'up to' if one.attrs['harder'] == 'upwards' else 'down to'} {_place(one, value)}"
    low, high = sorted((start, value))
    text = {
        Reach.not_run: "nothing to judge", Reach.never: "at no value",
        Reach.always: f"at all values, {end}",
        Reach.within: f"{_place(one, low, unit=False)} to {_place(one, high)}",
    }.get(Reach(int(one["reach"])), end)
    judged_here = one["reach"] != Reach.not_run
    return f"not decided: {text}" if judged_here and not are_decided(one) else text


def met_to(limits: xr.Dataset) -> xr.DataArray:
    """Return the values up to which all is decided to be met; infinite for none."""
    return limits["low" if limits.attrs["harder"] == "upwards" else "high"]


def limit_interval(one: xr.Dataset) -> str:
    """Return the interval of the limit: ``1.1 to 1.3``; an open end is the grid's."""
    values = one[one.attrs["along"]].values
    open_ends = {-math.inf: f"below {_place(one, float(values.min()), unit=False)}",
                 math.inf: f"beyond {_place(one, float(values.max()), unit=False)}"}
    ends = [float(one[name]) for name in ("low", "high")]
    if any(map(math.isnan, ends)):
        return "none"
    return " to ".join(dict.fromkeys(
        open_ends.get(end) or _place(one, end, unit=False) for end in ends))


def _place(one: xr.Dataset, value: float, *, unit: bool = True) -> str:
    """Return a value of the axis with its unit."""
    axis = one[one.attrs["along"]]
    values: list[float] = axis.values.astype(float).tolist()
    texts = dict(zip(values, coordinates(values), strict=True))
    units = str(axis.attrs.get("units", ""))
    return texts.get(value, coordinate(value)) + (UNITS.get(units, f" {units}") if unit else "")


def values_met(one: xr.Dataset) -> int:
    """Return at how many values of the axis requirements are met, of all conditions."""
    along = one[one.attrs["along"]]
    low, high = np.minimum(one["start"], one["value"]), np.maximum(one["start"], one["value"])
    return int(((along >= low) & (along <= high)).sum())


def are_decided(limits: xr.Dataset) -> Masks:
    """Return which limits are decided: to one value of the grid, or to the grid's hard end.

    Where nothing could be judged there is nothing to decide, unless that is so everywhere.
    """
    reach = limits["reach"].values
    judged = reach != Reach.not_run
    decided = limits["settled"].values | (
        (reach == Reach.always) & (limits["value"].values == met_to(limits).values))
    return np.asarray(decided & judged | ~judged & judged.any())


def limit_findings(limits: xr.Dataset) -> Findings:
    """Return limits as findings, which print themselves; status 3 if one is not decided."""
    store, decided = str(limits.attrs["store"]), are_decided(limits)
    easy, hard = ("small", "large") if limits.attrs["harder"] == "upwards" else ("large", "small")
    line = "all limits are decided" if decided.all() else (
        f"{int((~decided).sum()):,} limits of {decided.size:,} are not decided to one value of the "
        "grid (more --max-trials decide more)")
    line += f"; read from {easy} to {hard} values of {limits.attrs['along']}"
    return Findings(
        [limit_table(limits), line], limits_as_json(limits) | {"store": store}, limits,
        0 if decided.all() else UNDECIDED, (f"sweep report {quoted(store)}", ""))


def limits_as_json(limits: xr.Dataset) -> dict[str, Any]:
    """Return limits as JSON values: a list with the fields of each condition.

    ``value`` and ``reach`` are by the estimates; ``met_to`` is the value up to which all is decided
    to be met, ``decided`` whether the interval is that single value.
    """
    names = ("value", "low", "high", "start", "fails_at", "failing_value", "limited_by",
             "fails_where", "met_beyond", "farthest_beyond", "settled", "poses")
    listed = [
        {"condition": at, "reach": Reach(int(one["reach"])).name,
         "decided": bool(one["settled"]), "met_to": met_to(one).item(),
         **{name: one[name].item() for name in names}}
        for at, one in each_cell(limits, dimensions(limits))]
    return {**{name: limits.attrs[name] for name in ("along", "harder", "require", "at_all")},
            "units": str(limits[limits.attrs["along"]].attrs.get("units", "")), "limits": listed}


def limit_figure(limits: xr.Dataset) -> Figure:
    """Return the figure of limits, as `sweep.analysis.requirement_limits` returns them.

    They are drawn against the first axis of conditions that has numbers.
    """
    along, names = str(limits.attrs["along"]), dimensions(limits)
    dims = sorted((name for name in names if limits.sizes[name] > 1),
                  key=lambda name: limits[name].dtype.kind in "fiu")
    limits = limits.isel({name: 0 for name in names if name not in dims})
    # At no value there is no limit, and no interval is drawn.
    drawn = limits[["value", "low", "high"]].where(limits["reach"] != Reach.never)
    drawn = drawn.drop_vars(along, errors="ignore").rename(
        {"low": "value_low", "high": "value_high"})
    column = Column(f"limit of {axis_label(limits, along)}", "value")
    title = f"Limit of {' and '.join(map(str, limits.attrs['require']))}"
    *others, x = [axis_label(limits, name) for name in dims] or [""]
    return Figure("limit", title, "", table_of(drawn, title, dims, [column], limits), [column], x,
                  others[-1] if others else "")
