"""Questions about stores, and their findings: the lines, tables, figures and JSON of decisions.

`require`, `size`, `limit`, `compare`, error models, calibrations, `tradeoff`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from functools import partial, wraps
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from sweep.analysis import comparisons, dataset, error_models, simulation_gap
from sweep.analysis import requirements as judged
from sweep.analysis.error_models import CONDITIONS, PREDICTORS, QUANTITIES, Use, cell_edges
from sweep.analysis.estimator import INTERVAL
from sweep.analysis.requirements import CONFIDENCE, Cause, Decision, Reach, Verdict, described
from sweep.errors import ArgumentError, check_positive, path_of, texts_of
from sweep.execution import runner
from sweep.execution.progress import progress_display, stage_display
from sweep.experiment.draws import REPLICATES
from sweep.experiment.pipeline import parse_selection
from sweep.messages import label, nearest, notice, quoted
from sweep.plugins.loading import is_recording
from sweep.report import table as tables
from sweep.report.figure import Figure, write_figure
from sweep.report.output_file import check_output_file, figure_file, write_output_file
from sweep.report.report_data import ReportData, read_report_data, trade_lines
from sweep.report.table import Column, Findings, Table, Value, coordinate, number, table_of
from sweep.store.lifecycle import open_dataset, open_finished, read_pipeline
from sweep.tradeoff import choice_search
from sweep.tradeoff.measurement import measure_trade
from sweep.tradeoff.pareto import CRITERIA, mark_front
from sweep.tradeoff.pareto import UNITS as ERRORS
from sweep.typing import Integers
from sweep.version import __version__

if TYPE_CHECKING:
    from sweep.analysis.requirements import Answer
    from sweep.experiment.pipeline import Pipeline

WORDS = {Decision.met: "met", Decision.not_met: "not met", Decision.undecided: "not decided",
         Decision.not_applicable: "nothing to judge"}

UNITS = {"": "", "1": "", "percent": " %", "degree": "\u00b0"}

#: Decision -> exit status of a command; of the others `UNDECIDED`.
STATUS = {Decision.met: 0, Decision.not_met: 1}

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
        (default: those of [require], else the axes of size, angle, dictionaries and boards).
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
    texts = texts_of("requirements", requirements) or list(stored.requirements)
    axes = list(judged.conditions(results, per, stored.require_per))
    if not texts and against is None:
        raise ArgumentError(
            "requirements", "[]", "the pipeline has no section [require]; give some, such as "
            "'detection >= 0.95' 'range_error_p95_percent <= 1'")
    required = judged.parse_requirements(texts) if texts else ()
    table = judged.check_requirements(results, required, axes) if required else None
    found = [] if table is None else judged.verdicts(table)
    worse = [] if against is None else comparisons.regressions(
        selected_store(against, at)[0], results, [each.what.name for each in required], axes)
    decisions = np.array([each.decision for each in found] or [Decision.met], np.uint8)
    decision = Decision.not_met if any(each["worse"] for each in worse) else Decision(int(
        judged.combined_decision(decisions)))
    named = {*axes, dataset.DRAWS, *dataset.configuration_axes(results)}
    pooled = [name for name in dataset.axes_of(results)
              if name not in named and results.sizes[name] > 1]
    parts: list[Table | str] = [decision_table(found), Table.of(
        "Compared with the older store pose by pose, new minus old",
        ("", "quantity", "configuration", "difference", "condition"),
        [["worse" if each["worse"] else "not worse", each["quantity"],
          described(each["configuration"]),
          valued(each["difference"], each["low"], each["high"], each["units"]),
          described(each["condition"])] for each in worse], words=True)]
    if table is not None:
        parts.append(condition_table(found, table, every=every))
    parts.append(f"conditions (--per): {'each value of ' if axes else 'none'}{', '.join(axes)}; "
                 f"pooled over {', '.join(pooled) or 'none'}")
    return Findings(
        parts, {
            "decision": decision, "per": axes, "pooled": pooled, "against": worse,
            "requirements": [
                {**dataclasses.asdict(each),
                 "failing": [] if table is None else conditions_of(each, table)}
                for each in found]},
        table, STATUS.get(decision, tables.UNDECIDED),
        (more_draws(found, results, path_of("store", store)), ""))


def selected_store(
    url: str | PathLike[str], at: Sequence[str] = ()
) -> tuple[xr.Dataset, Pipeline]:
    """Return a finished store's results at some values of axes, and its pipeline."""
    store = open_finished(path_of("store", url))
    return selected(open_dataset(url), at, store.pipeline), store.pipeline


def selected(results: xr.Dataset, at: Sequence[str], pipeline: Pipeline) -> xr.Dataset:
    """Return results at some values of axes, or of parameters that go together along one.

    Raises
    ------
    ArgumentError
        For an axis or a value that the store does not have.
    """
    kept: dict[str, list[int]] = {}
    chosen = ",".join(texts_of("at", at))
    for name, value in parse_selection(chosen, pipeline).items() if chosen else ():
        axis, axes = pipeline.axis_of(name), dataset.axes_of(results)
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
        for at, cell in dataset.each_cell(one, [str(dim) for dim in one["decision"].dims])
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
    return f"{number(value)} ({tables.interval_text(low, high)}){UNITS.get(units, f' {units}')}"


def needs(each: Cause) -> str:
    """Return the draws of an undecided requirement, and how many would decide it."""
    if each.decision is not Decision.undecided or math.isnan(each.draws_needed):
        return ""
    return tables.draws_text(each.draws, each.draws_needed)


def more_draws(found: Sequence[Verdict], results: xr.Dataset, store: str) -> str:
    """Return the command that makes about as many draws as are needed, of simulated images."""
    given = "photograph" in results.coords or any(
        map(is_recording, np.ravel(results.get("detector", "")).tolist()))
    factor = max((each.draws_needed / each.draws for each in found
                  if each.draws > 0 and math.isfinite(each.draws_needed)), default=0.0)
    if factor <= 1.0 or given:
        return f"sweep report {quoted(store)}"
    unit = REPLICATES if dataset.is_replicated(results) else 1
    count = math.ceil(results.sizes.get(dataset.DRAWS, 1) * factor / unit) * unit
    return (f"sweep run {quoted(store)} --set trial={count} --store more.zarr "
            f"--reuse {quoted(store)}")


# --------------------------------------------------------------------------------------------------
# Output of ``sweep size``: the answer in a line, a table of the alternatives, JSON.

def headline(choice: choice_search.Choice) -> str:
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


def _chosen(choice: choice_search.Choice, answer: Answer) -> dict[str, Any]:
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


def alternatives(choice: choice_search.Choice) -> Table:
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


def choice_findings(choice: choice_search.Choice) -> Findings:
    """Return a choice as findings, which print themselves.

    Exit status: 0 there is one, 1 none meets everything, 3 not decided.
    """
    factor = choice.grid_poses / max(choice.poses, 1)
    return Findings(
        [alternatives(choice),
         (f"{choice.poses:,} poses; {choice.most_trials:,} trials of every cell, which the hardest "
          f"one took, are {choice.grid_poses:,} poses ({factor:.1f} times as many)")],
        as_json(choice), None, STATUS.get(choice.decision, tables.UNDECIDED),
        (f"sweep report {quoted(choice.store)}", ""))


class PrintedChoice(choice_search.Choice):
    """A choice that prints itself as ``sweep size`` does."""

    def __str__(self) -> str:
        return str(choice_findings(self))

    def _repr_html_(self) -> str:
        return choice_findings(self)._repr_html_()


@wraps(choice_search.size)
def size(*given: Any, **options: Any) -> PrintedChoice:
    """Return the choice of `sweep.tradeoff.choice_search.size`, which prints itself."""
    return PrintedChoice(**vars(choice_search.size(*given, **options)))


def as_json(choice: choice_search.Choice) -> dict[str, Any]:
    """Return the content of ``--json``.

    ``answer`` is the decided choice; ``known`` meets the requirements, though a better choice may,
    too.
    """
    listed = [
        {**dataclasses.asdict(answer), "cost": None if cost is None else dataclasses.asdict(cost),
         "on_front": k in choice.front, "within_budget": choice.within_budget(k)}
        for k, (answer, cost) in enumerate(zip(choice.answers, choice.costs, strict=True))]
    known = None if choice.best is None else _chosen(choice, choice.answers[choice.best])
    names = ("decision", "best", "conditions", "budget_ms", "poses", "grid_poses", "most_trials",
             "store")
    return {
        "answer": known if choice.decision is Decision.met else None, "known": known,
        "sentences": [headline(choice)], "along": choice.rule.along, "confidence": CONFIDENCE,
        **{name: getattr(choice, name) for name in names},
        "alternatives": listed, "warnings": list(choice.notes)}


# --------------------------------------------------------------------------------------------------
# Limits that requirements have along an axis, as a table for a terminal, a page, or JSON.

#: Numbers of each limit.
LIMIT = ("value", "low", "high", "start", "fails_at", "failing_value", "limited_by", "fails_where",
         "met_beyond", "farthest_beyond", "settled", "poses")


def dimensions(limits: xr.Dataset) -> list[str]:
    """Return the dimensions of the limits: conditions, then configurations."""
    settings = limits.attrs["configuration_dims"]
    return [*(name for name in limits["value"].dims if name not in settings), *settings]


def limit_rows(limits: xr.Dataset) -> list[dict[str, Any]]:
    """Return each limit of `sweep.analysis.requirement_limits` as numbers and words.

    Returns
    -------
    Beside the variables of the limits: ``condition``; ``reach`` and ``value`` by the estimates;
    ``met_to``, up to which all is decided to be met; ``decided``, whether that is the limit, or the
    grid's hard end;
    ``text``, such as ``up to 1.2 m``, and ``interval``, whose open ends are the grid's; ``count``,
    at how many values of the axis the requirements are met.
    """
    along, upwards = limits[limits.attrs["along"]], limits.attrs["harder"] == "upwards"
    grid: list[float] = along.values.astype(float).tolist()
    texts = dict(zip(grid, tables.coordinates(grid), strict=True))
    texts |= {-math.inf: f"below {texts[min(grid)]}", math.inf: f"beyond {texts[max(grid)]}"}
    units = str(along.attrs.get("units", ""))
    unit = UNITS.get(units, f" {units}")
    rows = []
    for at, one in dataset.each_cell(limits, dimensions(limits)):
        row: dict[str, Any] = {name: one[name].item() for name in LIMIT}
        place = {name: texts.get(row[name], coordinate(row[name])) for name in (
            "value", "low", "high", "start", "fails_at", "farthest_beyond")}
        reach, met_to = Reach(int(one["reach"])), row["low" if upwards else "high"]
        low, high = sorted(("start", "value"), key=row.__getitem__)
        end = f"{'up to' if upwards else 'down to'} {place['value']}{unit}"
        text = {
            Reach.not_run: "nothing to judge", Reach.never: "at no value",
            Reach.always: f"at all values, {end}",
            Reach.within: f"{place[low]} to {place[high]}{unit}"}.get(reach, end)
        # To one value of the grid, or to the grid's hard end.
        decided = bool(row["settled"]) or (reach is Reach.always and row["value"] == met_to)
        is_open = not decided and reach is not Reach.not_run
        where = f" ({row['fails_where']})" if row["fails_where"] else ""
        rows.append({
            "condition": at, "reach": reach.name, "decided": decided,
            "met_to": met_to, **row, "is_open": is_open,
            "text": f"not decided: {text}" if is_open else text,
            "interval": "none" if math.isnan(row["low"]) or math.isnan(row["high"]) else
                        " to ".join(dict.fromkeys((place["low"], place["high"]))),
            "fails": f"{place['fails_at']}{unit}: {row['limited_by'].split(maxsplit=1)[0]} "
                     f"{number(row['failing_value'])}{where}" if row["limited_by"] else "",
            "beyond": "" if math.isnan(row["farthest_beyond"]) else
                      f"{place['farthest_beyond']}{unit}",
            "count": sum(row[low] <= value <= row[high] for value in grid)})
    return rows


def limit_table(limits: xr.Dataset) -> Table:
    """Return a row for each configuration and condition of `sweep.analysis.requirement_limits`."""
    attrs, dims = limits.attrs, dimensions(limits)
    at_all = f", at all values of {', '.join(attrs['at_all'])}" if attrs["at_all"] else ""
    return Table.of(
        f"How far along {attrs['along']}: {' and '.join(map(str, attrs['require']))}{at_all}",
        [*dims, "met", "95 % interval", "decided", "fails first",
         "kept again by estimate, farthest at", "poses"],
        [[*map(coordinate, row["condition"].values()), row["text"], row["interval"],
          row["decided"], row["fails"], row["beyond"], int(row["poses"])]
         for row in limit_rows(limits)], stub=len(dims), words=True)


def limit_findings(limits: xr.Dataset) -> Findings:
    """Return limits as findings, which print themselves; status 3 if one is not decided."""
    store, rows = str(limits.attrs["store"]), limit_rows(limits)
    judged_any = any(row["reach"] != Reach.not_run.name for row in rows)
    undecided = sum(row["is_open"] for row in rows) if judged_any else len(rows)
    easy, hard = ("small", "large") if limits.attrs["harder"] == "upwards" else ("large", "small")
    line = "all limits are decided" if not undecided else (
        f"{undecided:,} limits of {len(rows):,} are not decided to one value of the grid (more "
        "--max-trials decide more)")
    line += f"; read from {easy} to {hard} values of {limits.attrs['along']}"
    return Findings(
        [limit_table(limits), line], limits_as_json(limits) | {"store": store}, limits,
        tables.UNDECIDED if undecided else 0, (f"sweep report {quoted(store)}", ""))


class PrintedLimits(xr.Dataset):  # type: ignore[no-untyped-call]
    """Limits that print themselves as ``sweep limit`` does; what is derived from them does not.

    xarray makes parts, copies and results of this class, too, without what `limit` has set.
    """

    __slots__ = ("_printed",)

    def __str__(self) -> str:
        return str(getattr(self, "_printed", repr(self)))

    def _repr_html_(self) -> str:
        return str(getattr(self, "_printed", super())._repr_html_())  # type: ignore[union-attr]


@wraps(runner.limit)
def limit(*given: Any, **options: Any) -> PrintedLimits:
    """Return the limits of `sweep.execution.runner.limit`, which print themselves."""
    found = runner.limit(*given, **options)
    limits = PrintedLimits(found.data_vars, found.coords, found.attrs)
    limits._printed = limit_findings(found)  # noqa: SLF001  (its own)
    return limits


def limits_as_json(limits: xr.Dataset) -> dict[str, Any]:
    """Return limits as JSON values: a list with the numbers of each condition."""
    names = ("condition", "reach", "decided", "met_to", *LIMIT)
    return {**{name: limits.attrs[name] for name in ("along", "harder", "require", "at_all")},
            "units": str(limits[limits.attrs["along"]].attrs.get("units", "")),
            "limits": [{name: row[name] for name in names} for row in limit_rows(limits)]}


def limit_figure(limits: xr.Dataset) -> Figure:
    """Return the figure of limits, as `sweep.analysis.requirement_limits` returns them.

    They are drawn against the first axis of conditions that has numbers.
    """
    heading = f"limit of {tables.axis_label(limits, str(limits.attrs['along']))}"
    title = f"Limit of {' and '.join(map(str, limits.attrs['require']))}"
    dims = sorted((name for name in dimensions(limits) if limits.sizes[name] > 1),
                  key=lambda name: limits[name].dtype.kind in "fiu")
    labels = [tables.axis_label(limits, name) for name in dims]
    # At no value there is no limit, and no interval is drawn.
    rows = [[*map(row["condition"].get, dims), None if row["reach"] == Reach.never.name else
             Value(row["value"], row["low"], row["high"])] for row in limit_rows(limits)]
    *others, x = labels or [""]
    return Figure("limit", title, "", Table.of(title, [*labels, heading], rows, stub=len(dims)),
                  [Column(heading, "value")], x, others[-1] if others else "")


# --------------------------------------------------------------------------------------------------
# How two stores differ: photographs and their simulation, or two versions.


def compare(
    first: str, second: str, *, bins: Mapping[str, Sequence[float]] | None = None,
    output: str | PathLike[str] | None = None,
) -> Findings:
    """Compare photographs with a simulation, or two stores of one pipeline; as `sweep.compare`."""
    figure = figure_file(output)
    one, other = (selected_store(url)[0] for url in (first, second))
    then = (f"sweep report {quoted(second)}", "")
    if comparisons.is_measured(one) == comparisons.is_measured(other):
        for name, value in (("bins", bins), ("output", output)):
            if value:
                raise ArgumentError(name, "", "expected a store of photographs and a simulation")
        table = comparisons.store_differences(one, other)
        parts = store_difference_tables(table)
        return Findings([*parts.values()], {
            "first": first, "second": second,
            **{name: each.as_json()["rows"] for name, each in parts.items()}}, table, 0, then)
    gap = simulation_gap(one, other, bins).load()
    if figure is not None:
        write_figure([gap_figure(gap)], figure)
    found = gap_table(gap)
    return Findings(
        [found, *gap_lines(gap)],
        {"photographs": first, "simulated": second, "paired": bool(gap.attrs["paired"]),
         **found.as_json()}, gap, 0, then)


# --------------------------------------------------------------------------------------------------
# Photographs beside their simulation.


def gap_table(gap: xr.Dataset) -> Table:
    """Return a row for each statistic, configuration and bin of `sweep.analysis.simulation_gap`."""
    dims = [str(dim) for dim in gap["detection_rate_gap"].dims]
    groups = list(itertools.product(*(tables.group_cells(gap, dim) for dim in dims)))
    rows: list[list[Any]] = []
    for each in comparisons.GAP_STATISTICS:
        of_both = tables.column(each.name)
        difference = Column("", f"{each.name}_gap", 1.0 if each.ratio else of_both.scale)
        rows += [
            [of_both.heading, *group, *(
                Value(of_both.scale * value) for value in one[each.name].values.tolist()),
             "ratio" if each.ratio else "difference", *difference.cells(one)]
            for group, (_, one) in zip(groups, dataset.each_cell(gap, dims), strict=True)]
    return Table.of(
        "Photographs and simulation, with 95 % intervals of the gap: the difference, or the ratio",
        ["statistic", *dims, *gap["source"].data, "compared by", "gap"], rows, stub=1 + len(dims))


def gap_lines(gap: xr.Dataset) -> list[str]:
    """Return lines on the compared poses, and on the meaning of intervals."""
    photographs, scenes = (int(gap["units"].isel(source=k).max()) for k in (0, 1))
    markers, solved = (int(gap[name].max()) for name in ("looked_for", "solved"))
    first = tables.plural(photographs, "photograph")
    lines = [
        f"{first} and their twins, pairs of markers" if gap.attrs["paired"]
        else f"{first} and {tables.plural(scenes, 'simulated scene')}, bin by bin",
    ]
    if not markers or not solved:
        lines.append("nothing to compare: no marker is in both, or none is solved")
    elif photographs < 5:
        lines.append("fewer than 5 photographs: errors without intervals")
    return lines


def gap_figure(gap: xr.Dataset) -> Figure:
    """Return the figure of `sweep.analysis.simulation_gap`: rates and errors of both sources.

    They are drawn along the bins, if there are any.
    """
    dims = [str(dim) for dim in gap["detection_rate"].dims if dim != "source"]
    columns = [tables.column(each.name) for each in comparisons.GAP_STATISTICS]
    binned = [tables.axis_label(gap, dim) for dim in dims if f"{dim}_low" in gap.coords]
    title = "Photographs and simulation, with 95 % intervals"
    return Figure("gap", title, "", table_of(gap, title, [*dims, "source"], columns), columns,
                  binned[-1] if binned else "", "source")


# --------------------------------------------------------------------------------------------------
# Error models of a store: their table and their JSON.

#: Variables of the models that the file has of each quantity.
OF_QUANTITIES = (
    *(f"{name}{end}" for name in ("sigma", "bias") for end in INTERVAL), "knots",
    "coverage")

#: Warnings of every model.
ALWAYS = (
    "sigma is of poses that are not flipped: where flips are not rejected, flip_rate counts too",
    "azimuth, roll and direction of the bearing are pooled; other cameras, markers, light differ",
)


def error_model_files(paths: Sequence[str]) -> list[Path]:
    """Return the paths of JSON files, checked before there is a model.

    Raises
    ------
    ArgumentError, StoreError
        If a name ends in another suffix; as `sweep.report.output_file.check_output_file`.
    """
    for path in paths:
        if Path(path).suffix.lower() != ".json":
            raise ArgumentError(
                "error_model", path, "expected a file that ends in .json; pipelines/pose_errors.py "
                "reads it, and sweep.analysis.model_covariance gives covariances for ROS")
        check_output_file(Path(path))
    return [*map(Path, paths)]


def error_model_document(models: xr.Dataset, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a file; NaN and infinities are null.

    Parameters
    ----------
    models
        As `sweep.analysis.error_models` returns them.
    facts
        Source of the models: ``store``, ``title``, ``fingerprint``, ``camera``, ``pipeline``.
    """
    edges = {name: cell_edges(models, name).tolist() for name in PREDICTORS}
    knots = {name: models[name].values.tolist() for name in PREDICTORS}
    return {
        # Schema, frame, formula, and the errors' meanings, which every file has.
        **json.loads(tables.template("error_model.json").render()), "sweep": __version__, **facts,
        "units": {name: each.units for name, each in CONDITIONS.items()},
        "conditions": {name: each.words for name, each in CONDITIONS.items()},
        "flags": {each.name: each.meaning for each in Use},
        "warnings": warnings_of(models),
        "models": [
            {
                "configuration": configuration,
                "side_px_times_distance_m": None if models.attrs["focal_size_varies"] else
                models.attrs["focal_size_px_m"],
                "region": [dict(zip(("weights", "low", "high"), each, strict=True))
                           for each in zip(*(model[name].values.tolist() for name in (
                               "direction_weight", "region_low", "region_high")), strict=True)],
                "knots": knots,
                "knots_u": [CONDITIONS[name].scaled(values).tolist()
                            for name, values in knots.items()],
                "cells": edges,
                "cells_u": [CONDITIONS[name].scaled(ends[1:-1]).tolist()
                            for name, ends in edges.items()],
                **{name: model[name].values.tolist()
                   for name in ("looked_for", "solved_rate", "flip_rate", "judged")},
                "quantities": {name: _quantity(model.sel(quantity=name)) for name in QUANTITIES},
            }
            for configuration, _, model in models_apart(models)
        ],
    }


def _quantity(model: xr.Dataset) -> dict[str, Any]:
    """Return the numbers for a reader's formula, and all variables, of one quantity."""
    metres = str(model["quantity"].item()) in QUANTITIES[:3]
    scale = model["distance_m"].values[:, None, None] if metres else 1.0
    names = np.array([Use(flag).name for flag in model["use"].values.ravel()], dtype=object)
    return {
        "unit": "m" if metres else "radian",
        "ln_sigma": np.log(model["sigma"].values).tolist(),
        "bias_u": (model["bias"].values / scale).tolist(),
        **{name: model[name].values.tolist() for name in OF_QUANTITIES},
        "use": names.reshape(model["use"].shape).tolist(),
    }


def models_apart(models: xr.Dataset) -> list[tuple[dict[str, Any], str, xr.Dataset]]:
    """Return the values of the axes by which models are kept apart, these in words, and each."""
    dims = [str(dim) for dim in models["knots"].dims if dim not in ("quantity", "predictor")]
    return [(at, described(at, " = ") or "the configuration", model)
            for at, model in dataset.each_cell(models, dims)]


def warnings_of(models: xr.Dataset) -> list[str]:
    """Return sentences on where the models must not be used, beside the flags of the cells."""
    lines = []
    for _, name, model in models_apart(models):
        use = model["use"].values
        counted = use[:, (use != Use.no_poses).any(axis=0)]
        parts = [f"{100 * float((counted == flag).mean()):.0f} % {flag.name}" for flag in Use
                 if flag != Use.no_poses and (counted == flag).any()]
        lines.append(f"{name}: of {counted.size:,} cells (times errors): {', '.join(parts)}")
    for name in PREDICTORS:
        if models.sizes[name] == 1 and not (
            name == "side_px" and models.sizes["distance_m"] > 1
            and not models.attrs["focal_size_varies"]):
            value = float(models[name][0])
            lines.append(f"{name} did not vary ({value:.4g} {CONDITIONS[name].units}): the models "
                         "hold there alone")
    bearing = models["direction_weight"].values[:, list(CONDITIONS).index("bearing_deg")] == 1
    low, high = (float(extreme(models[f"region_{end}"].values[..., bearing]))
                 for end, extreme in (("low", np.min), ("high", np.max)))
    lines.append(f"bearings from {low:.4g} to {high:.4g} degree: the models hold there alone")
    return [*lines, *ALWAYS]


def model_findings(data: ReportData, files: Sequence[Path]) -> Findings:
    """Write the error models of a store; return their table and warnings.

    Parameters
    ----------
    data
        The store.
    files
        As :func:`error_model_files` returns them.

    Raises
    ------
    StoreError
        If a file cannot be written.
    DatasetError
        As `sweep.analysis.error_models`.
    """
    models = error_models(data.results)
    content = error_model_document(models, {
        "store": data.store, "title": data.pipeline.heading,
        "camera": data.pipeline.facts.camera_line,
        "fingerprint": dict(data.run_metadata.get("fingerprint", {})),
        "pipeline": data.pipeline.text,
    })
    for file in files:
        write_output_file(file, f"{tables.to_json(content, indent=1)}\n".encode())
    return Findings(
        [error_model_table(models), *(f"- {line}" for line in warnings_of(models))],
        content, models, 0,
        (f"look at {', '.join(map(str, files))}", "sigma and bias anywhere in the store's domain"))


def error_model_table(models: xr.Dataset) -> Table:
    """Return a table with a row for some knots at which each configuration has poses."""
    # Most knots of each condition that are shown: 4, 3 and 3.
    places = {name: np.unique(np.linspace(0, models.sizes[name] - 1, most).round().astype(int))
              for name, most in zip(PREDICTORS, (4, 3, 3), strict=True)}
    some = models.isel(places)
    cells = {f"cell_{name}": (name, np.searchsorted(
        cell_edges(models, name)[1:-1], some[name].values, side="right")) for name in PREDICTORS}
    use = some["use"].isel({name: xr.DataArray(at, dims=dim) for name, (dim, at) in cells.items()})
    # Positions in mm, rotations in degrees.
    scale = xr.DataArray([1e3] * 3 + [float(np.degrees(1.0))] * 3, dims="quantity")
    columns = {f"{quantity}{end}": (scale * some[f"sigma{end}"]).sel(quantity=quantity, drop=True)
               for quantity in QUANTITIES for end in INTERVAL}
    sigma_z, bias_z = (some[name].sel(quantity="z", drop=True) for name in ("sigma", "bias"))
    # The usual rule for one tag: sigma = 0.02 d² metres.
    table = xr.Dataset(columns).assign(
        bias=1e3 * bias_z, rule=0.02 * some["distance_m"]**2 / sigma_z,
        seen=(use != Use.no_poses).any("quantity").astype(int),
        use=xr.apply_ufunc(_use, use, input_core_dims=[["quantity"]], vectorize=True,
                           output_dtypes=[object]))
    kept = [str(dim) for dim in models["knots"].dims if dim not in ("quantity", "predictor")]
    return table_of(
        table, "Standard deviation (95 % interval) and bias of the error of poses without flips, "
        "in the sight frame: z along the line of sight", [*kept, *PREDICTORS],
        [Column("held-out check", "use"), *(
            Column(f"{quantity.replace('_', ' ')}, {'deg' if 'rotation' in quantity else 'mm'}",
                   quantity) for quantity in QUANTITIES),
         Column("bias of z, mm", "bias"), Column("0.02 d² / sigma z", "rule")],
        models, counted="seen")


def _use(flags: Integers) -> str:
    """Return the flags of the six errors in words."""
    return ", ".join(Use(int(flag)).name.replace("_", " ") for flag in np.unique(flags))


# --------------------------------------------------------------------------------------------------
# Camera calibrations: errors beside what OpenCV reports of them.

INNER = ("views", "intrinsic", "direction", "xyz")


def calibration_table(summary: xr.Dataset) -> Table:
    """Return a row for each condition, number of views and number of a `calibration_summary`."""
    dims = [str(dim) for dim in summary["calibrated"].dims if dim not in INNER]
    numbers = [str(each) for each in summary["intrinsic"].values
               if np.isfinite(summary["coverage"].sel(intrinsic=each)).any()]
    depth = 1e3 * summary["position_rmse_m"].sel(xyz="z", drop=True)
    depths = {f"z in the {where}, mm": depth.sel(direction=where, drop=True)
              for where in summary["direction"].values.tolist()}
    columns = [Column("calibrated", "calibrated"), Column("tried", "tried"), Column("bias", "bias"),
               Column("RMSE", "rmse"), Column("reported sd", "mean_std"),
               Column("coverage", "coverage"), *map(Column, depths, depths)]
    caption = (
        f"Calibrations from the {summary.attrs['points']} points of a board: estimated minus "
        "true, px or 1; share of reported 95 % intervals that hold the truth; error of the depth "
        f"of a target at {summary.attrs['target_m']:g} m"
    )
    shown = summary.sel(intrinsic=numbers).assign(depths).rename(intrinsic="number")
    return table_of(shown, caption, [*dims, "views", "number"], columns)


def calibration_findings(summary: xr.Dataset, store: str) -> Findings:
    """Return a `calibration_summary` as findings, which print themselves."""
    table = calibration_table(summary)
    return Findings(
        [table], {"points": summary.attrs["points"], "target_m": summary.attrs["target_m"],
                  **table.as_json()}, summary, 0,
        (f"sweep.analysis.camera_calibrations(sweep.open({store!r}), [20]) in Python",
         "the errors of each calibration"))


# --------------------------------------------------------------------------------------------------
# Differences between two stores of one pipeline.


#: Table of differences -> its caption, its counts by heading, and its shifts by unit: variable, and
#: factor to the unit.
DIFFERENCES: Mapping[str, tuple[str, Mapping[str, str], Mapping[str, tuple[str, float]]]] = {
    "detection": ("Detections, on the same images", {
        "compared": "detections_compared", "another flag": "detections_differing",
        "computed once": "computed_once"}, {}),
    "corners": ("Corners that both found; shifts of those that differ", {
        "compared": "corners_compared", "differ": "corners_differing",
        "found once": "corners_found_once"}, {"px": ("corner_shift_px", 1.0)}),
    "estimation": ("Poses that both solved; shifts of those that differ", {
        "compared": "poses_compared", "differ": "poses_differing",
        "another flag": "estimates_differing"},
        {"mm": ("position_shift_m", 1e3), "\u00b0": ("rotation_shift_deg", 1.0)}),
}


def store_difference_tables(table: xr.Dataset) -> dict[str, Table]:
    """Return tables of detections, corners, poses and versions that differ, by name."""
    pairs = {stage: xr.apply_ufunc(
        partial(_pairs, table[f"first_{stage}"].values.tolist()), table[f"{stage}s"],
        input_core_dims=[[f"first_{stage}", f"second_{stage}"]], vectorize=True,
        output_dtypes=[object]) for stage in ("detection", "estimate")}
    shown = table.assign({"detection": pairs["detection"], "estimation": pairs["estimate"]})
    parts = {}
    for name, (caption, counts, shifts) in DIFFERENCES.items():
        columns = [Column(heading, variable) for heading, variable in counts.items()]
        for unit, (variable, scale) in shifts.items():
            for statistic in table["statistic"].values.tolist():
                heading = f"{statistic}, {unit}"
                shown[heading] = table[variable].sel(statistic=statistic, drop=True)
                columns.append(Column(heading, heading, scale))
        dims = [str(dim) for dim in table[columns[0].variable].dims]
        parts[name] = table_of(
            shown, caption, dims, [*columns, Column("first \u2192 second", name)])
    versions = table["fingerprint"].to_series().unstack().reset_index().astype(object)
    return {**parts, "fingerprint": Table("Versions and files that differ", versions, words=True)}


def _pairs(flags: Sequence[str], counts: Integers) -> str:
    """Return the pairs of two different flags that occur (i, j), the most frequent first."""
    different = sorted(((i, j) for i, j in np.argwhere(counts).tolist() if i != j),
                       key=lambda pair: -int(counts[pair]))
    return ", ".join(f"{flags[i]} \u2192 {flags[j]} {int(counts[i, j]):,}" for i, j in different)


# --------------------------------------------------------------------------------------------------
# What each configuration costs, beside its accuracy.

#: The error that ranks configurations.
CRITERION = "rotation_p95_deg"

MS = Column("ms a frame", "cost_ms")
FRONT = Column("on the front", "on_front")


def measure_tradeoff(
    store: str | PathLike[str], *, per: Sequence[str] = (), criterion: str = CRITERION,
    limit_s: float = 60.0, budget_ms: float | None = None,
    output: str | PathLike[str] | None = None, progress: bool = False,
) -> Findings:
    """Measure what each configuration of a store costs, beside its accuracy on the same images.

    Parameters
    ----------
    store
        Path or URL of a finished store, or a TOML file, which is run first.
    per
        Axes of the scene whose values are conditions of their own.
    criterion
        The error that ranks configurations.
    limit_s
        Seconds of the measurement.
    budget_ms
        Most milliseconds a frame: the most accurate configuration within them is named.
    output
        PNG or SVG file of a figure.
    progress
        Whether progress is told on stderr.

    Returns
    -------
    Findings
        A row for each configuration and condition; ``data`` is the dataset that the store keeps in
        its group ``cost/tradeoff``.

    Raises
    ------
    ArgumentError, PipelineError, StoreError, RunError
        As for :func:`run`; also if costs cannot be measured here.

    Examples
    --------
    >>> found = sweep.measure_tradeoff(folder / "two_sizes.zarr", limit_s=0.5)
    >>> found.data.detection_ms.item() > 0  # milliseconds a frame
    True
    """
    if criterion not in CRITERIA:
        raise ArgumentError("criterion", criterion, f"expected one of {', '.join(CRITERIA)}"
                            + nearest(criterion, CRITERIA))
    for name, value in (
            # Only a budget may be None.
            ("budget_ms", budget_ms), ("limit_s", "" if limit_s is None else limit_s)):
        check_positive(name, value, "expected a finite number above 0")
    figure = figure_file(output)
    store = path_of("store", store)
    if store.lower().endswith(".toml"):
        pipeline = read_pipeline(store)
        with progress_display() if progress else contextlib.nullcontext() as display:
            summary = runner.execute(pipeline, None, progress=display)
        notice(*summary.warnings)
        store = str(summary.store)
    question = {"criterion": criterion} | ({} if budget_ms is None else {"budget_ms": budget_ms})
    with stage_display() if progress else contextlib.nullcontext() as stage:
        trade, renderers = measure_trade(store, per, limit_s, stage, question=question)
    if figure is not None:
        write_figure([trade_figure(trade, criterion)], figure)
    found = trade_lines(read_report_data(store), trade, budget_ms)
    frames, sampled = trade.attrs["frames"], trade.attrs["sampled"]
    few = [] if frames >= sampled else [
        (f"costs are those of {frames:,} of {sampled:,} sampled images; more --seconds, or markers "
         "that are seen, give more")]
    return Findings(
        [*headlines(trade, criterion), tradeoff_table(trade, criterion),
         *([] if renderers is None else [renderer_table(renderers)]), *few, *found],
        trade.to_dict() | {"advice": found} | (
            {} if renderers is None else {"renderers": renderers.to_dict()}),
        trade, 0, (f"sweep report {quoted(store)}", "with these costs and a figure of them"))


def tradeoff_table(trade: xr.Dataset, criterion: str) -> Table:
    """Return a row for each condition and configuration, the cheapest first.

    Times are in ms a frame, rotations in degrees, ranges in percent; values have their 95 %
    intervals. Columns without any value are left out, but for the cost and the criterion.

    Raises
    ------
    KeyError
        If ``trade`` lacks ``cost_ms`` or the criterion.
    """
    errors = (f"{quantity}_{statistic}_{unit}" for quantity, unit in ERRORS.items()
              for statistic in ("bias", "rmse", "rmse_unflipped", "median", "p95", "p99"))
    names = dict.fromkeys((
        "detection_rate", "flip_rate", criterion, *errors,
        *(f"{quantity}_efficiency" for quantity in ERRORS)))
    columns = [FRONT, MS, Column("x baseline", "cost_ratio"), *map(tables.column, names),
               Column("NEES", "nees_mean")]
    marked = mark_front(trade, criterion).rename(treatment="configuration")
    for level in marked["level"].values.tolist() if "covariance_coverage" in marked else ():
        name = f"covered_{level:g}"
        marked[name] = marked["covariance_coverage"].sel(level=level, drop=True)
        columns.append(Column(f"in {100 * level:g} % ellipsoid, %", name, 100))
    if "covariance_trusted" in marked:
        marked["covariance_trusted"] = marked["covariance_trusted"].astype(object).where(
            marked["nees_count"] > 0, None)
        columns.append(tables.column("covariance_trusted"))
    dims = [*(str(dim) for dim in marked["cost_ms"].dims if dim != "configuration"),
            "configuration"]
    table = table_of(
        marked, "Cost and accuracy, the cheapest first, with 95 % intervals", dims,
        [each for each in columns if each.variable in (MS.variable, criterion) or (
            each.variable in marked and bool(marked[each.variable].notnull().any()))])
    cost = np.ravel(marked["cost_ms"].transpose(*dims))
    order = np.lexsort((cost, np.arange(cost.size) // marked.sizes["configuration"]))
    return dataclasses.replace(table, frame=table.frame.iloc[order])


def trade_figure(trade: xr.Dataset, criterion: str = "", lines: Sequence[str] = ()) -> Figure:
    """Return cost, ms a frame, against an error, a panel for each condition.

    Parameters
    ----------
    trade
        As measured by `sweep.tradeoff`.
    criterion
        An error of ``trade`` (default: the one that the measurement was asked for).
    lines
        The recommendation.
    """
    criterion = criterion or str(trade.attrs.get("criterion", CRITERION))
    shown = tables.column(criterion)
    return Figure(
        "trade", "Cost and accuracy", tables.sentences(
            tables.caption_of("trade", heading=shown.heading, poses=trade.attrs.get("poses", 0)),
            *(f"{line}." for line in lines)),
        tradeoff_table(trade, criterion), [shown], MS.heading, FRONT.heading,
        labels="configuration")


def headlines(trade: xr.Dataset, criterion: str) -> list[str]:
    """Return the title, the facts of the measurement, and what the table's words mean."""
    attrs = trade.attrs
    return [
        str(attrs.get("title", "")),
        (f"{attrs.get('poses')} poses; window: {attrs.get('window', 'by setting')}; baseline: "
         f"{attrs.get('baseline')}; ms a frame: detection and estimation"),
        (f"on the front: no other configuration is both cheaper and better in {criterion}; RMSE "
         "and bias: of the solved poses, upper ends wide enough for rare errors that no draw "
         "showed; median, p95, p99: a pose that is not solved counts as an infinite error"),
    ]


#: Columns of the images, then of a configuration on them, paired on scenes that both solve.
RENDERERS = (
    Column("ms an image", "render_ms"), Column("x exact", "render_ratio"),
    Column("grey RMS", "grey_rms"), Column("grey max", "grey_max"),
    Column("detection differs, %", "detection_disagreement", 100),
    Column("corner RMS px", "corner_shift_rms_px"), Column("range bias %", "range_bias_percent"),
    Column("rotation RMS deg", "rotation_shift_deg"))


def renderer_table(renderers: xr.Dataset) -> Table:
    """Return a table of the renderers in ``cost/renderers``.

    Cost of the images and difference from the exact image; then for each configuration the share
    of scenes in which the marker is detected in only one of the two images, and the change of
    corners, range and rotation, paired on the scenes that both solve.
    """
    settings = [str(dim) for dim in renderers["range_bias_percent"].dims if dim != "renderer"]
    return table_of(renderers, "Other renderers against exact images", ["renderer", *settings],
                    RENDERERS)
