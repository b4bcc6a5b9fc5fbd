"""The answer of a report: whether requirements are met, how far, and with which configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import xarray as xr

from sweep.analysis import requirements as judged
from sweep.analysis.dataset import each_cell, of_photographs
from sweep.analysis.requirements import Decision, Verdict, requirement_limits
from sweep.errors import DatasetError, StoreError
from sweep.report import decisions, figures
from sweep.report.comparison import CARDS, comparison
from sweep.report.figure import caption_of, sentences
from sweep.report.report_data import CONFIGURATION, ReportData, configurations, course_of, notes_of
from sweep.report.table import Column, Table, interval_text, number


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer that a reader wants first.

    Attributes
    ----------
    headline
        One line.
    paragraph
        Warnings, and what the numbers do not tell.
    of
        The configuration that is named, of the tiles; empty if there is only one.
    tiles
        Its numbers over the whole grid, as cards and as JSON have them: ``name``, ``text`` and
        ``detail``, ``value`` with ``low``, ``high`` and ``unit``, and what a share is of.
    tables
        By configuration, shown at once.
    details
        Tables that stand further below.
    numbers
        The numbers behind the line, for JSON.
    """

    headline: str
    paragraph: str
    of: str
    tiles: Sequence[Mapping[str, Any]]
    tables: Sequence[Table]
    details: Sequence[Table]
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON values: numbers, and tables of text as a page shows them."""
        return {
            "answer": self.headline, "text": self.paragraph, "configuration": self.of or None,
            "numbers": self.tiles, **self.numbers,
            "tables": [table.as_json() for table in (*self.tables, *self.details)],
        }


def answer(data: ReportData) -> Answer:
    """Return the answer: the decision on requirements, else the comparison of configurations.

    Raises
    ------
    ArgumentError
        For requirements, and conditions, that cannot be.
    StoreError
        If the store lacks what the requirements are of.
    """
    try:
        decided = required(data) if data.require else None
    except DatasetError as error:
        raise StoreError(f"{data.store}: {error}") from None
    compared = comparison(data, None if decided is None else (decided.best,))
    known = compared.known
    one = known.summary.isel({CONFIGURATION: compared.best})
    tiles = [_tile(one, card) for card in CARDS]
    name = compared.name if known.several else ""
    line = decided.line if decided else f"{compared.line}." if compared.line else _in_numbers(tiles)
    if not int(known.summary["looked_for"].sum()):
        line = (f"The {data.pipeline.target_word} was looked for in no pose: it was visible and "
                "modelled in none.")
    warnings = [f"{text.strip()[:1].upper()}{text.strip()[1:]}." for text in data.warnings]
    notes = sentences(
        *warnings,
        "A board counts as detected if at least one of its markers is."
        if data.pipeline.shows_boards else "",
        caption_of("intervals", photographs=of_photographs(data.results)),
        notes_of(data, {}), data.pooled(*known.axes))
    return Answer(
        line, notes, name, tiles,
        [*(decided.tables if decided else ()), compared.table()],
        [*(decided.details if decided else ()), *figures.tables_of(data, one, name)],
        {"comparison": compared.as_json(), **(decided.numbers if decided else {})})


# --------------------------------------------------------------------------------------------------
# Requirements on a report's store: the decision, how far it holds, with which configuration.

#: Decisions, the best first.
ORDER = (Decision.met, Decision.undecided, Decision.not_applicable, Decision.not_met)


class Required(NamedTuple):
    """The decisions on all requirements.

    Attributes
    ----------
    line
        The answer in one line.
    best
        Number of the configuration that is named.
    tables
        How far, and the decisions, by configuration.
    details
        The decisions at each condition, of the configuration that is named.
    numbers
        For JSON: the decision on all together of the configuration that is named, verdicts as
        `sweep require` and limits as `sweep limit` prints them.
    """

    line: str
    best: int
    tables: Sequence[Table]
    details: Sequence[Table]
    numbers: Mapping[str, Any]


def required(data: ReportData) -> Required:
    """Return the decisions on the requirements of a store.

    The configuration that is named meets all requirements, or else follows them farthest along the
    axis of the conditions; of equals it is the one that the comparison on the same images names.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`.
    """
    known = configurations(data, targets=False)
    results, positions = data.results.isel(known.axes), known.combinations
    table = data.once("required", lambda: judged.check_requirements(
        results, data.require, data.per))
    found = [judged.verdicts(table.isel({name: [k] for name, k in at.items()}))
             for at in positions]
    combined = [judged.combined(each) for each in found]
    along, others = course_of(data)
    # At all other conditions together, and at each of them.
    courses = [((), others), *([(others, ())] if others else [])] if along else []
    limits = [
        data.once(("limits", per), partial(
            requirement_limits, results, data.require, str(along), per=per, at_all=at_all))
        for per, at_all in courses]

    def rank(k: int) -> tuple[object, ...]:
        return (bool(known.wrong[k]), ORDER.index(combined[k]),
                *(-decisions.values_met(part.isel(positions[k])) for part in limits))

    first = min(map(rank, range(len(known.names))))
    equal = [k for k in range(len(known.names)) if rank(k) == first]
    best = comparison(data, tuple(equal)).best if len(equal) > 1 else equal[0]
    whose = f", with {known.names[best]}" if len(known.names) > 1 else ""
    line = f"{' and '.join(data.require)}: {_decided(found[best], combined[best])}"
    if limits:
        line += _reached([part.isel(positions[best]) for part in limits], others)
    every = judged.verdicts(table)
    return Required(
        f"{line}{whose}.", best,
        [*map(decisions.limit_table, limits), decisions.decision_table(every)],
        [decisions.condition_table(found[best], table, every=True)],
        {"decision": combined[best], "requirements": every,
         "limits": decisions.limits_as_json(limits[0]) if limits else None})


def _decided(found: Sequence[Verdict], decision: Decision) -> str:
    """Return the decision, at how many conditions, and the value that decides a single one."""
    one = next((each for each in found if each.decision is decision), found[0])
    words = decisions.WORDS[decision]
    if one.conditions > 1:
        words += " at all " if decision is Decision.met else (
            f" at {one.counts.get(one.decision, 0):,} of ")
        words += f"{one.conditions:,} conditions"
    elif one.decision is not Decision.not_applicable:
        words += f" ({decisions.valued(one.value, one.low, one.high, one.units)})"
    return "; ".join(filter(None, (words, decisions.needs(one))))


def _reached(limits: Sequence[xr.Dataset], others: Sequence[str]) -> str:
    """Return how far along the axis: at all conditions, else at the one that reaches farthest."""
    def met(one: xr.Dataset) -> str:
        interval = f" ({decisions.limit_interval(one)})" if decisions.values_met(one) else ""
        return f"{decisions.limit_text(one)}{interval}"

    one, *by_condition = limits
    together = f" at all values of {', '.join(others)}" if others else ""
    line = f"; along {one.attrs['along']}{together}: {met(one)}"
    if not by_condition or decisions.values_met(one):
        return line
    at, farthest = max(each_cell(by_condition[0], others),
                       key=lambda cell: decisions.values_met(cell[1]))
    return f"{line}; at {judged.described(at)}: {met(farthest)}" if (
        decisions.values_met(farthest)) else line


# --------------------------------------------------------------------------------------------------
# The numbers in the cards, and the line that they make where there is nothing to compare.

#: Share -> the number of poses that it is of.
COUNTED = {"detection_rate": ["looked_for"], "solved_rate": ["looked_for"], "flip_rate": ["solved"]}


def _in_numbers(tiles: Sequence[Mapping[str, Any]]) -> str:
    """Return the answer of a single configuration in one line."""
    detected, _, median, _, rmse, *_ = tiles
    errors = "".join(
        f"; {tile['name']} {tile['text']}{f' ({detail})' if (detail := tile['detail']) else ''}"
        for tile in (median, rmse) if not math.isnan(tile["value"]))
    return f"Detected in {detected['text']} ({detected['detail']}){errors}."


def _tile(one: xr.Dataset, column: Column) -> dict[str, Any]:
    """Return a number of one configuration, with its name and a detail."""
    name, _, unit = column.heading.rpartition(", ")
    unit = {"deg": "\u00b0"}.get(unit, f" {unit}")
    (found,) = column.cells(one)
    known = math.isfinite(found.low) and not math.isnan(found.high)
    details = [interval_text(found.low, found.high, unit)] if known else []
    counted = {name: int(one[name]) for name in COUNTED.get(column.variable, ())}
    details += [f"of {count:,} {of.replace('_', ' ')}" for of, count in counted.items()]
    text = number(found.value) + (unit if math.isfinite(found.value) else "")
    if math.isinf(found.value):
        details = ["more than half not solved"]
    return {"name": name, "text": text, "detail": ", ".join(details), **found._asdict(),
            "unit": unit.strip(), **counted}
