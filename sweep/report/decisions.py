"""Decisions on requirements, on a choice, and how far they hold, as lines, tables and JSON."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from sweep.analysis.dataset import DRAWS, axes_of, configuration_axes, each_cell, is_replicated
from sweep.analysis.decisions import CONFIDENCE, Reach
from sweep.analysis.requirements import Cause, Decision, Verdict, described
from sweep.errors import ArgumentError
from sweep.experiment.draws import REPLICATES
from sweep.experiment.pipeline import parse_selection
from sweep.messages import label, nearest, quoted
from sweep.report.figure import Figure
from sweep.report.table import (
    UNDECIDED,
    Column,
    Findings,
    Table,
    axis_label,
    coordinate,
    coordinates,
    interval_text,
    number,
    plural,
    table_of,
)
from sweep.typing import Masks

if TYPE_CHECKING:
    from sweep.analysis.comparisons import Regression
    from sweep.analysis.decisions import Answer
    from sweep.experiment.pipeline import Pipeline
    from sweep.tradeoff.choice_search import Choice

WORDS = {Decision.met: "met", Decision.not_met: "not met", Decision.undecided: "not decided",
         Decision.not_applicable: "nothing to judge"}

UNITS = {"": "", "1": "", "percent": " %", "degree": "\u00b0"}

#: Conditions that JSON lists.
MAX_ROWS = 500


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
        kept[axis.name] = [k for k in kept.get(axis.name, range(len(axis)))
                           if _is_same(values[k], value)]
        if not kept[axis.name]:
            shown = ", ".join(map(label, values[:20]))
            raise ArgumentError("at", f"{name}={label(value)}", f"no such value; there are {shown}")
    return results.isel(kept)


def _is_same(one: Any, other: Any) -> bool:
    """Return whether two values are equal, numbers but for rounding."""
    numbers = isinstance(one, int | float) and isinstance(other, int | float)
    return math.isclose(one, other, rel_tol=1e-9) if numbers else bool(one == other)


def pooled_axes(results: xr.Dataset, per: Sequence[str]) -> list[str]:
    """Return the axes of the scene that are pooled."""
    named = {*per, DRAWS, *configuration_axes(results)}
    return [name for name in axes_of(results) if name not in named and results.sizes[name] > 1]


# --------------------------------------------------------------------------------------------------
# Requirements: a row for each, with its worst condition, and rows for conditions.

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
    dims = [str(dim) for dim in one["decision"].dims]
    found = [
        {"condition": at, "decision": Decision(int(cell["decision"])),
         **{name: cell[name].item() for name in ("value", "low", "high", "draws")}}
        for at, cell in each_cell(one, dims) if every or cell["decision"] == each.decision]
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
          described(row["condition"]),
          valued(row["value"], row["low"], row["high"], each.units),
          f"{np.nan_to_num(row['draws']):,.0f}"]
         for each, rows in listed for row in rows if every or len(rows) > 1], words=True)


def regression_table(worse: Sequence[Regression]) -> Table:
    """Return how results differ from an older store's, pose by pose."""
    return Table.of(
        "Compared with the older store pose by pose, new minus old",
        ("", "quantity", "configuration", "difference", "condition"),
        [["worse" if one.worse else "not worse", one.quantity, described(one.configuration),
          valued(one.difference, one.low, one.high, one.units), described(one.condition)]
         for one in worse], words=True)


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
    """Return the command that makes about as many draws as are needed."""
    trials = results.sizes.get(DRAWS, 1)
    factors = [each.draws_needed / each.draws for each in found
               if each.draws > 0 and math.isfinite(each.draws_needed)]
    if not factors or max(factors) <= 1.0:
        return f"sweep report {quoted(store)}"
    count = math.ceil(trials * max(factors))
    if is_replicated(results):
        count = math.ceil(count / REPLICATES) * REPLICATES
    return (f"sweep run {quoted(store)} --set trial={count} --store more.zarr "
            f"--reuse {quoted(store)}")


# --------------------------------------------------------------------------------------------------
# Output of ``sweep size``: the answer in a line, a table of the alternatives, JSON.

def headline(choice: Choice) -> str:
    """Return the line on the choice; without one, on the nearest alternative."""
    rule = choice.rule
    wish = ("largest" if rule.largest else "smallest") if rule.along else "cheapest"
    what = (f"{plural(len(rule.requirements), 'requirement')} at "
            f"{plural(choice.conditions, 'condition')}, with {100 * CONFIDENCE:g} % "
            "confidence")
    if choice.best is not None:
        answer, cost = choice.answers[choice.best], choice.costs[choice.best]
        ms = "" if cost is None else f", {number(cost.ms)} ms a frame"
        name = _name(choice, answer, answer.value)
        if not choice.is_undecided:
            return f"{name} is the {wish} choice{ms}: it meets {what}"
        bound = f"{'at least' if rule.largest else 'at most'} " if rule.along else ""
        return f"not decided: {bound}{name}{ms}: it meets {what}; a better one may, too"
    start = f"no choice meets {what}" if not choice.is_undecided else (
        f"not decided: no choice is known to meet {what}")
    if any(answer.met for answer in choice.answers):
        return f"{start}, within {choice.budget_ms:g} ms a frame"
    near = [(answer.nearest, answer) for answer in choice.answers if answer.nearest is not None]
    if not near:
        return start
    nearest, answer = min(near, key=lambda each: each[0].excess)
    return f"{start}; nearest is {_name(choice, answer, nearest.value)}: {reason(nearest.cause)}"


def _why(choice: Choice, k: int) -> str:
    """Return why no better value of an alternative is chosen, or why the alternative is not."""
    answer, cost = choice.answers[k], choice.costs[k]
    out = []
    if answer.next_cause is not None:
        out.append(reason(answer.next_cause))
    if answer.passing:
        beyond = ", ".join(map(coordinate, answer.passing))
        out.append(f"beyond {coordinate(answer.next)}, {beyond} keep all limits by estimate")
    if answer.met and cost is not None and not choice.within_budget(k):
        at = f" at {described(cost.condition)}" if cost.condition else ""
        state = "not within" if cost.low > (choice.budget_ms or 0.0) else "not decided: within"
        out.append(f"takes {number(cost.ms)} ms ({number(cost.low)} to {number(cost.high)}){at}: "
                   f"{state} {choice.budget_ms:g} ms")
    return "; ".join(out)


def _name(choice: Choice, answer: Answer, value: float | None) -> str:
    """Return a choice as text."""
    along = {} if value is None else {choice.rule.along: value}
    return described({**along, **answer.alternative})


def reason(cause: Cause) -> str:
    """Return why a choice fails: the requirement, its value with interval, the condition."""
    at = f" at {described(cause.condition)}" if cause.condition else ""
    draws = f"; {text}: raise search.max_trials" if (text := needs(cause)) else ""
    return (f"{cause.requirement} is {WORDS[cause.decision]}: "
            f"{valued(cause.value, cause.low, cause.high, cause.units)}{at}{draws}")


def alternatives(choice: Choice) -> Table:
    """Return a row for each alternative: those that meet all first, the best of them before."""
    def rank(k: int) -> tuple[bool, float, float]:
        answer, cost = choice.answers[k], choice.costs[k]
        value = 0.0 if answer.value is None else answer.value
        return (not answer.met, -value if choice.rule.largest else value,
                math.inf if cost is None else cost.ms)

    along = choice.rule.along
    rows = []
    for k in sorted(range(len(choice.answers)), key=rank):
        answer, cost = choice.answers[k], choice.costs[k]
        value = ["none" if each is None else coordinate(each)
                 for each in (answer.value, answer.next)] if along else [
                     "yes" if answer.met else "no"]
        ms = "" if cost is None else f"{number(cost.ms)}{'*' * (k in choice.front)}"
        rows.append([*map(str, answer.alternative.values()), *value, ms, _why(choice, k)])
    front = "; * no other is as good and cheaper" if choice.front else ""
    return Table.of(
        headline(choice) + front,
        [*choice.rule.among, *([along, "next"] if along else ["meets all"]), "ms a frame",
         "why not better" if along else "why not"], rows, stub=len(choice.rule.among), words=True)


def choice_findings(choice: Choice) -> Findings:
    """Return a choice as findings, which print themselves.

    Exit status: 0 there is one, 1 none meets everything, 3 not decided.
    """
    factor = choice.grid_poses / max(choice.poses, 1)
    return Findings(
        [alternatives(choice),
         (f"{choice.poses:,} poses; {choice.most_trials:,} trials of every cell, which the hardest "
          f"one took, are {choice.grid_poses:,} poses ({factor:.1f} times as many)")],
        as_json(choice), None, {Decision.met: 0, Decision.undecided: 3}.get(choice.decision, 1),
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
    known = None if best is None else {**best.alternative, **(
        {choice.rule.along: best.value} if choice.rule.along else {})}
    return {
        "answer": known if choice.decision is Decision.met else None, "known": known,
        "decision": choice.decision,
        "sentences": [headline(choice), *filter(None, (
            _why(choice, k) for k in range(len(choice.answers))))],
        "best": choice.best, "next": choice.next, "along": choice.rule.along,
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
    rows = [[*map(coordinate, at.values()), limit_text(one), limit_interval(one),
             bool(one["settled"]), *_failure_texts(one), int(one["poses"])]
            for at, one in each_cell(limits, dims)]
    required = " and ".join(map(str, limits.attrs["require"]))
    at_all = ", ".join(limits.attrs["at_all"])
    return Table.of(
        f"How far along {limits.attrs['along']}: {required}"
        + (f", at all values of {at_all}" if at_all else ""),
        [*dims, "met", "95 % interval", "decided", "fails first", "beyond", "poses"], rows,
        stub=len(dims), words=True)


def dimensions(limits: xr.Dataset) -> list[str]:
    """Return the dimensions of the limits: conditions, then configurations."""
    configurations = limits.attrs["configuration_dims"]
    return [*(name for name in limits["value"].dims if name not in configurations),
            *configurations]


def limit_text(one: xr.Dataset) -> str:
    """Return up to where requirements are met in one condition: ``up to 1.2 m``.

    An undecided limit is called so, whatever the estimates are.
    """
    reach, start, value = Reach(int(one["reach"])), float(one["start"]), float(one["value"])
    bound = f"{'up to' if one.attrs['harder'] == 'upwards' else 'down to'} {_place(one, value)}"
    low, high = sorted((start, value))
    text = {
        Reach.not_run: "nothing to judge", Reach.never: "at no value", Reach.found: bound,
        Reach.always: f"at all values, {bound}",
        Reach.within: f"only at {_place(one, value)}" if low == high else
                      f"{_place(one, low, unit=False)} to {_place(one, high)}"}[reach]
    if bool(one["settled"]) or reach is Reach.not_run:
        return text
    if value != met_to(one):
        return f"not decided: {text}"
    return text if reach is Reach.always else f"{text}, not decided beyond"


def met_to(one: xr.Dataset) -> float:
    """Return the value up to which all is decided to be met; infinite for none."""
    return float(one["low" if one.attrs["harder"] == "upwards" else "high"])


def limit_interval(one: xr.Dataset) -> str:
    """Return the interval of the limit: ``1.1 to 1.3``; an open end is the grid's."""
    low, high = float(one["low"]), float(one["high"])
    if math.isnan(low) or math.isnan(high):
        return "none"
    values = one[one.attrs["along"]].values
    beyond = {-math.inf: f"below {_place(one, float(values.min()), unit=False)}",
              math.inf: f"beyond {_place(one, float(values.max()), unit=False)}"}
    texts = [beyond.get(end) or _place(one, end, unit=False) for end in (low, high)]
    return " to ".join(dict.fromkeys(texts))


def _failure_texts(one: xr.Dataset) -> tuple[str, str]:
    """Return the requirement that fails first beyond, and where estimates keep all again, if so.

    ``1.3 m: detection_rate 0.874 (tilt_deg = 60)``
    """
    cause = beyond = ""
    if name := str(one["limited_by"].item()):
        where = str(one["fails_where"].item())
        cause = (f"{_place(one, float(one['fails_at']))}: {name.split(maxsplit=1)[0]} "
                 f"{number(float(one['failing_value']))}{f' ({where})' if where else ''}")
    if float(one["met_beyond"]) > 0:
        beyond = ("kept again by estimate, farthest at "
                  f"{_place(one, float(one['farthest_beyond']))}")
    return cause, beyond


def _place(one: xr.Dataset, value: float, *, unit: bool = True) -> str:
    """Return a value of the axis with its unit."""
    axis = one[one.attrs["along"]]
    values: list[float] = axis.values.astype(float).tolist()
    text = dict(zip(values, coordinates(values), strict=True)).get(value, coordinate(value))
    units = str(axis.attrs.get("units", ""))
    return text + UNITS.get(units, f" {units}") if unit else text


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
    met = limits["value"].values == limits[
        "low" if limits.attrs["harder"] == "upwards" else "high"].values
    judged = reach != Reach.not_run
    decided = limits["settled"].values | ((reach == Reach.always) & met)
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
    dims = dimensions(limits)
    names = ("value", "low", "high", "start", "fails_at", "failing_value", "limited_by",
             "fails_where", "met_beyond", "farthest_beyond", "settled", "poses")
    listed = [
        {"condition": at, "reach": Reach(int(one["reach"])).name,
         "decided": bool(one["settled"]), "met_to": met_to(one),
         **{name: one[name].item() for name in names}} for at, one in each_cell(limits, dims)]
    return {"along": limits.attrs["along"], "harder": limits.attrs["harder"],
            "require": list(limits.attrs["require"]), "at_all": list(limits.attrs["at_all"]),
            "units": str(limits[limits.attrs["along"]].attrs.get("units", "")), "limits": listed}


# --------------------------------------------------------------------------------------------------
# The figure of limits: against the first axis of conditions that has numbers.


def limit_figure(limits: xr.Dataset) -> Figure:
    """Return the figure of limits, as `sweep.analysis.requirement_limits` returns them."""
    along, dims = str(limits.attrs["along"]), dimensions(limits)
    varying = [name for name in dims if limits.sizes[name] > 1]
    limits = limits.isel({name: 0 for name in dims if name not in varying})
    axis = next((name for name in varying if limits[name].dtype.kind in "fiu"), None)
    ordered = [*(name for name in varying if name != axis), *([axis] if axis else [])]
    # At no value there is no limit, and no interval is drawn.
    never = limits["reach"] == Reach.never
    drawn = limits[["value", "low", "high"]].where(~never)
    drawn = drawn.rename({"low": "value_low", "high": "value_high"}).assign_coords(limits.coords)
    column = Column(f"limit of {axis_label(limits, along)}", "value")
    title = f"Limit of {' and '.join(map(str, limits.attrs['require']))}"
    return Figure(
        "limit", title, "", table_of(drawn.drop_vars(along), title, ordered, [column], limits),
        [column], axis_label(limits, axis) if axis else "",
        axis_label(limits, ordered[-2]) if axis and len(ordered) > 1 else "")
