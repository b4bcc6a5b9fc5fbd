"""Whether, how far and with which configuration the requirements on a store are met."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis.limits import requirement_limits
from sweep.analysis.requirements import (
    Decision,
    Verdict,
    check_requirements,
    combined,
    described,
    verdicts,
)
from sweep.report.comparison import comparison
from sweep.report.formatting import interval_text, number
from sweep.report.limit_figure import interval_text as limit_interval
from sweep.report.limit_figure import limit_table, limit_text
from sweep.report.report_data import CONFIGURATION, ReportData, configurations
from sweep.report.scene_figures import course_of
from sweep.report.table import Table

WORDS = {Decision.met: "met", Decision.not_met: "not met", Decision.undecided: "not decided",
         Decision.not_applicable: "nothing to judge"}

ORDER = (Decision.met, Decision.undecided, Decision.not_applicable, Decision.not_met)
"""Decisions, the best first."""


@dataclass(frozen=True, eq=False)
class Required:
    """The decisions on all requirements.

    Attributes
    ----------
    line
        The answer in one line.
    tables
        How far, and the decisions, by configuration.
    details
        The decisions at each condition, of the configuration that is named.
    best
        Number of the configuration that is named.
    decision
        Its decision on all requirements at all conditions.
    verdicts
        As `sweep require` prints them, of all configurations.
    limits
        As `sweep limit` prints them, at all conditions together; None without an axis.
    """

    line: str
    tables: tuple[Table, ...]
    details: tuple[Table, ...]
    best: int
    decision: Decision
    verdicts: tuple[Verdict, ...]
    limits: xr.Dataset | None


def required(data: ReportData) -> Required:
    """Return the decisions on what is required of a store.

    The configuration that is named meets all requirements, or else follows them farthest along the
    axis of the conditions; of equals it is the one that the comparison on the same images names.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`.
    """
    known = configurations(data)
    axes = known.settings.axes
    results = data.results.isel({name: list(some) for name, some in axes.items()})
    table = data.once("required", lambda: check_requirements(results, data.require, data.per))
    positions = [{name: axes[name].index(index) for name, index in each.items()}
                 for each in known.settings.combinations]
    found = [verdicts(table.isel({name: [k] for name, k in at.items()})) for at in positions]
    decisions = [combined(each) for each in found]
    course = course_of(data, data.per)
    others = tuple(name for name in (course.angle, *course.at_all) if name)
    limits = by_condition = None
    if course.along:
        along = course.along
        limits = data.once("limits", lambda: requirement_limits(
            results, data.require, along, per=(), at_all=others))
        if others:
            by_condition = data.once("limits by condition", lambda: requirement_limits(
                results, data.require, along, per=others, at_all=()))

    def rank(k: int) -> tuple[object, ...]:
        reached = [-_values_met(part.isel(positions[k])) for part in (limits, by_condition)
                   if part is not None]
        return (bool(known.wrong[k]), ORDER.index(decisions[k]), *reached)

    first = min(map(rank, range(len(known.names))))
    equal = [k for k in range(len(known.names)) if rank(k) == first]
    best = comparison(data, tuple(equal)).best if len(equal) > 1 else equal[0]
    several = len(known.names) > 1
    whose = f", with {known.names[best]}" if several else ""
    line = f"{' and '.join(data.require)}: {_decided(found[best], decisions[best])}"
    if limits is not None:
        line += _reached(limits.isel(positions[best]), None if by_condition is None else
                         by_condition.isel(positions[best]), others)
    tables = [limits_table(part) for part in (limits, by_condition) if part is not None]
    tables.append(_decision_table(known.names, found))
    return Required(
        f"{line}{whose}.", tuple(tables), (_condition_table(table, positions[best], whose),),
        best, decisions[best], tuple(each for part in found for each in part), limits)


def _values_met(one: xr.Dataset) -> int:
    """Return at how many values of the axis requirements are met, of all conditions."""
    along = one[one.attrs["along"]]
    low, high = np.minimum(one["start"], one["value"]), np.maximum(one["start"], one["value"])
    return int(((along >= low) & (along <= high)).sum())


def _decided(found: Sequence[Verdict], decision: Decision) -> str:
    """Return the decision, at how many conditions, and the value that decides a single one."""
    one = next((each for each in found if each.decision is decision), found[0])
    words = WORDS[decision]
    if one.conditions > 1:
        all_met = decision is Decision.met
        words += (f" at all {one.conditions:,} conditions" if all_met else
                  f" at {one.counts.get(one.decision, 0):,} of {one.conditions:,} conditions")
    elif one.decision is not Decision.not_applicable:
        words += f" ({_value(one)})"
    if math.isinf(one.draws_needed):
        words += "; no number of draws would tell"
    elif math.isfinite(one.draws_needed):
        words += f"; {one.draws:,} draws, about {one.draws_needed:,.0f} would tell"
    return words


def _reached(one: xr.Dataset, by_condition: xr.Dataset | None, others: Sequence[str]) -> str:
    """Return how far along the axis: at all conditions, else at the one that reaches farthest."""
    along = one.attrs["along"]
    together = f" at all values of {', '.join(others)}" if others else ""
    line = f"; along {along}{together}: {_met(one)}"
    if by_condition is None or _values_met(one):
        return line
    cells = [by_condition.isel(dict(zip(others, index, strict=True)))
             for index in np.ndindex(*(by_condition.sizes[name] for name in others))]
    farthest = max(cells, key=_values_met)
    if not _values_met(farthest):
        return line
    where = described({name: farthest[name].item() for name in others})
    return f"{line}; at {where}: {_met(farthest)}"


def _met(one: xr.Dataset) -> str:
    text = limit_text(one)
    if not _values_met(one):
        return text
    return f"{text} ({limit_interval(one)})"


def limits_table(limits: xr.Dataset) -> Table:
    """Return the table of `sweep limit`, with whether each limit is decided."""
    table = limit_table(limits)
    frame = table.frame.copy()
    dims = [name for name in frame.columns if name in limits.dims]
    order = [*(name for name in limits["value"].dims if name in dims and
               name not in limits.attrs["configuration_dims"]),
             *limits.attrs["configuration_dims"]]
    settled = limits["settled"].transpose(*order).values.ravel()
    frame.insert(len(dims) + 2, "decided", ["yes" if each else "no" for each in settled])
    caption = table.caption
    if limits.attrs["at_all"]:
        caption += f", at all values of {', '.join(limits.attrs['at_all'])}"
    return Table(caption, frame, table.stub, table.words)


def _decision_table(names: Sequence[str], found: Sequence[Sequence[Verdict]]) -> Table:
    """Return a row for each requirement and configuration, at its worst condition."""
    rows = [[name, each.requirement, WORDS[each.decision], _value(each),
             described(each.condition),
             f"{each.counts.get(Decision.met, 0):,} of {each.conditions:,}", f"{each.draws:,}",
             "" if math.isnan(each.draws_needed) else number(each.draws_needed)]
            for name, part in zip(names, found, strict=True) for each in part]
    return Table.of(
        "Decisions on what is required, at the worst condition",
        [CONFIGURATION, "required", "decision", "value (interval)", "condition",
         "conditions met", "draws", "draws that would decide"], rows, stub=2, words=True)


def _value(each: Verdict) -> str:
    unit = {"1": "", "percent": " %", "degree": "\u00b0"}.get(each.units, f" {each.units}")
    text = number(each.value)
    if not (math.isnan(each.low) and math.isnan(each.high)):
        text += f" ({interval_text(each.low, each.high)})"
    return f"{text}{unit}"


def _condition_table(table: xr.Dataset, at: dict[str, int], whose: str) -> Table:
    """Return the decisions of one configuration at each condition."""
    one = table.isel(at)
    one = one.isel({name: 0 for name in table.attrs["configuration_dims"] if name in one.dims})
    dims = [str(dim) for dim in one["decision"].dims if dim != "requirement"]
    rows = []
    for index in np.ndindex(*(one.sizes[name] for name in dims)):
        cell = one.isel(dict(zip(dims, index, strict=True)))
        for k in range(one.sizes["requirement"]):
            part = cell.isel(requirement=k)
            low, high = float(part["low"]), float(part["high"])
            value = number(float(part["value"]))
            if not (math.isnan(low) and math.isnan(high)):
                value += f" ({interval_text(low, high)})"
            condition = described({name: part[name].item() for name in dims})
            rows.append([condition, str(part["requirement"].item()),
                         WORDS[Decision(int(part["decision"]))], value,
                         f"{int(np.nan_to_num(part['draws'])):,}"])
    return Table.of(
        f"What is required, at each condition{whose}",
        ["condition", "required", "decision", "value and interval", "draws"], rows, stub=2,
        words=True)
