"""The first sentence of a report: whether, and how far, with which configuration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis import detection_rate
from sweep.analysis.requirements import Decision, check_requirements
from sweep.plan.axes import TRIAL
from sweep.plan.boards import target_word
from sweep.plan.parameters import Stage
from sweep.report.configurations import (
    Settings,
    configurations,
    most_exact_first,
    settings_of,
)
from sweep.report.figure import sentences
from sweep.report.formatting import interval_text, number, plural
from sweep.report.grouping import CONFIGURATION, by_configuration
from sweep.report.question import Course, course_of
from sweep.report.reach import Limit, Reaches, reaches, reaches_without_draws
from sweep.report.reach_text import (
    angle_text,
    limit_text,
    limiting_text,
    quantity,
    reach_table,
    skipped_text,
)
from sweep.report.report_data import ReportData
from sweep.report.table import Table

RATES = (0.99, 0.9)
"""Detection rates that are asked for where nothing is required."""

STAR = " * too few draws to tell"


@dataclass(frozen=True)
class Verdict:
    """The answer to the question.

    Attributes
    ----------
    headline
        One sentence.
    reasons
        What limits it, and what else is to be known.
    tables
        By configuration; shown at once.
    details
        At each condition; shown further below.
    best
        Index of the configuration that it is about; None if it is about no single one.
    """

    headline: str
    reasons: str = ""
    tables: tuple[Table, ...] = ()
    details: tuple[Table, ...] = ()
    best: int | None = None


def verdict(data: ReportData) -> Verdict:
    """Return the answer: to what is required, or how far the marker is detected.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`, for what is required.
    """
    if not data.require:
        return _how_far(data)
    course = course_of(data, data.per)
    return _required(data, course) if course.along else _at_all_conditions(data, course)


# What is required, along an axis.

def _required(data: ReportData, course: Course) -> Verdict:
    known = configurations(data)
    reach = reaches(data, data.require, course, known.settings, known.names, known.wrong.tolist())
    order = reach.order(known.order)
    best = order[0]
    limits = reach.limits[best]
    limit = _farthest(limits)
    whose = f", with {known.spoken(best)}" if known.several else ""
    where = angle_text(data, course.angle, limit)
    together = f" {where}" if where else ""
    reached = limit_text(data, reach, limit)
    others = [known.spoken(k) for k in order[1:]
              if not known.wrong[k] and _same(reach.limits[k], limits)]
    if not limit.judged:
        headline = (f"There is nothing to judge: the {target_word(data.pipeline)} was looked "
                    "for in no pose.")
    elif limit.rank >= 0 and reach.decided(limit):
        headline = f"Yes {reached}{together}{whose}."
    elif limit.rank >= 0:
        headline = f"Perhaps {reached}{together}{whose}: too few draws to tell."
    elif reach.decided(limit):
        headline = f"No: {reached}{together}" + (
            ", with none of the configurations." if known.several else ".")
    else:
        headline = f"Probably not: {reached}{together}{whose}, but there are too few draws to tell."
    checked = _checked(data, course, best)
    reasons = sentences(
        _largest_angle(data, reach, course, limits, limit),
        skipped_text(data, reach, course.angle, limits),
        limiting_text(data, reach, course.angle, limits[-1]),
        _draws_needed(checked) if not reach.decided(limit) else "",
        f"As far with {', '.join(others)}." if others else "", *known.notes,
    )
    tables = []
    if known.several or course.angle:
        tables.append(reach_table(
            data, reach, course.angle, order,
            "How far all that is required is met (95 % interval);" + STAR))
    return Verdict(headline, reasons, tuple(tables), (_condition_table(data, checked, best),),
                   best)


def _farthest(limits: Sequence[Limit]) -> Limit:
    """Return the limit at all angles, or at as many as there is one."""
    return next((limit for limit in reversed(limits) if limit.rank >= 0), limits[-1])


def _same(first: Sequence[Limit], second: Sequence[Limit]) -> bool:
    return [(one.first, one.rank) for one in first] == [(one.first, one.rank) for one in second]


def _largest_angle(
    data: ReportData, reach: Reaches, course: Course, limits: Sequence[Limit], limit: Limit
) -> str:
    """Return a sentence on all angles, where what is required is met at fewer."""
    if limit is limits[-1]:
        return ""
    where = angle_text(data, course.angle, limits[-1])
    return f"{where[0].upper()}{where[1:]}: {limit_text(data, reach, limits[-1])}."


def _checked(data: ReportData, course: Course, best: int) -> xr.Dataset:
    """Return what is required at each condition, of one configuration."""
    at = configurations(data).settings.combinations[best]
    first = {name: [at.get(name, 0)] for name in data.setting_axes}
    per = [name for name in (course.angle, course.along, *course.at_all) if name]

    def compute() -> xr.Dataset:
        return check_requirements(data.results.isel(first), data.require, per=per)

    table = data.once(("required", best, tuple(per)), compute)
    others = {dim: 0 for dim in table.dims if dim not in (*per, "requirement")}
    return table.isel(others, drop=True).transpose(*per, "requirement")


def _draws_needed(checked: xr.Dataset) -> str:
    needed = checked["draws_needed"].values
    finite = needed[np.isfinite(needed)]
    if not finite.size:
        return ""
    largest = float(finite.max())
    rounded = float(f"{largest:.1e}")
    return (f"About {rounded:,.0f} draws of each pose would decide at every condition whose value "
            f"is not at the limit; there are {int(np.nanmax(checked['draws'].values)):,}.")


def _condition_table(data: ReportData, checked: xr.Dataset, best: int) -> Table:
    known = configurations(data)
    per = [str(dim) for dim in checked["decision"].dims if dim != "requirement"]
    rows = []
    for index in np.ndindex(*checked["decision"].shape):
        cell = checked.isel(dict(zip((*per, "requirement"), index, strict=True)))
        decision = Decision(int(cell["decision"]))
        low, high = float(cell["low"]), float(cell["high"])
        value = number(float(cell["value"]))
        if not (math.isnan(low) and math.isnan(high)):
            value += f" ({interval_text(low, high)})"
        rows.append([*(quantity(data, name, cell[name].item())
                       if checked[name].dtype.kind in "fi" else str(cell[name].item())
                       for name in per),
                     str(cell["requirement"].item()), decision.name.replace("_", " "), value,
                     f"{int(np.nan_to_num(cell['draws'])):,}"])
    whose = f", with {known.names[best]}" if known.several else ""
    return Table(
        f"What is required, at each condition{whose}",
        [*(data.label(name).split(",")[0] for name in per), "required", "decision",
         "value and interval", "draws"], rows, stub=len(per) + 1, words=True)


# What is required, without an axis along which there is a limit.

def _at_all_conditions(data: ReportData, course: Course) -> Verdict:
    known = configurations(data)
    counts = []
    for k in range(len(known.names)):
        decision = _checked(data, course, k)["decision"].values
        counts.append((int((decision == Decision.not_met).sum()),
                       int((decision == Decision.undecided).sum()), decision.size))
    order = sorted(range(len(known.names)), key=lambda k: (
        bool(known.wrong[k]), counts[k][0], counts[k][1], known.order.index(k)))
    best = order[0]
    failed, undecided, count = counts[best]
    checked = _checked(data, course, best)
    whose = f", with {known.spoken(best)}" if known.several else ""
    conditions = count // max(1, len(data.require))
    where = f" at all {conditions:,} conditions" if conditions > 1 else ""
    if failed:
        are = "is" if failed == 1 else "are"
        headline = (f"No: {failed:,} of {plural(count, 'decision')} {are}"
                    f" not met{whose}.")
    elif undecided:
        headline = (f"Too few draws to tell: {undecided:,} of {plural(count, 'decision')} "
                    f"{'is' if undecided == 1 else 'are'} open, the others are met{whose}.")
    else:
        headline = f"Yes{where}{whose}."
    table = Table(
        "Decisions on what is required", [CONFIGURATION, "met", "not met", "too few draws"],
        [[known.names[k], *(f"{n:,}" for n in (
            counts[k][2] - counts[k][0] - counts[k][1], *counts[k][:2]))] for k in order])
    return Verdict(
        headline, sentences(_worst(checked), _draws_needed(checked) if undecided else ""),
        (table,) if known.several else (), (_condition_table(data, checked, best),), best)


def _worst(checked: xr.Dataset) -> str:
    """Return each requirement with its values, as a sentence."""
    parts = []
    for cell in (checked.isel(requirement=k) for k in range(checked.sizes["requirement"])):
        values = cell["value"].values
        values = values[~np.isnan(values)]
        if values.size:
            worst = values.min() if ">" in str(cell["relation"].item()) else values.max()
            parts.append(f"{cell['requirement'].item()}: {number(float(worst))}"
                         + (" at the worst condition" if values.size > 1 else ""))
    return f"{'; '.join(parts)}." if parts else ""


# Nothing is required: how far the marker is detected.

def _how_far(data: ReportData) -> Verdict:
    course = course_of(data)
    settings = settings_of(data, (Stage.detection,))
    names, rates = _rates(data, settings)
    several = len(names) > 1
    if not np.nan_to_num(rates["looked_for"].values).sum():
        return Verdict(
            f"The {target_word(data.pipeline)} was looked for in no pose: it was visible and "
            "modelled in none.")
    if course.along is None:
        return _how_often(settings, names, rates, most_exact_first(data, settings))
    wrong = [False] * len(names)
    found = {rate: _detected(data, rate, course, settings, names, wrong) for rate in RATES}
    preferred = most_exact_first(data, settings)
    orders = {rate: reach.order(preferred) for rate, reach in found.items()}
    best = orders[RATES[0]][0] if found[RATES[0]].limits[orders[RATES[0]][0]][-1].rank >= 0 else (
        orders[RATES[1]][0])
    parts: list[str] = []
    doubts: list[str] = []
    for rate, reach in found.items():
        limit = reach.limits[best][-1]
        if parts and limit.rank == found[RATES[0]].limits[best][-1].rank and limit.rank >= 0:
            continue  # the higher rate is reached as far
        parts.append(f"in at least {100 * rate:g} % {limit_text(data, reach, limit)}")
        if not reach.decided(limit):
            doubts.append(f"{100 * rate:g} %")
    where = angle_text(data, course.angle, found[RATES[0]].limits[best][-1])
    headline = (f"{'With ' + _spoken(settings, names[best]) + ', d' if several else 'D'}etected "
                f"{' and '.join(parts)}{', ' + where if where else ''}.")
    if doubts:
        headline = f"{headline[:-1]}; too few draws to be sure of {' and '.join(doubts)}."
    first = found[RATES[0]]
    tables = []
    if several or course.angle:
        tables = [
            reach_table(data, found[rate], course.angle, orders[rate],
                        f"Detected in at least {100 * rate:g} % (95 % interval);{STAR}")
            for rate in RATES
        ]
    return Verdict(headline, limiting_text(data, first, course.angle, first.limits[best][-1])
                   if not several else "", tuple(tables[:1]), tuple(tables[1:]))


def _rates(data: ReportData, settings: Settings) -> tuple[list[str], xr.Dataset]:
    return by_configuration(
        data.pipeline, data.analysed(detection_rate, settings.grouping), settings.grouping.dims)


def _detected(
    data: ReportData, rate: float, course: Course, settings: Settings, names: Sequence[str],
    wrong: Sequence[bool],
) -> Reaches:
    if data.length(TRIAL) < 2:
        return reaches_without_draws(data, rate, course, settings, names, wrong)
    return reaches(data, [f"detection_rate >= {rate:g}"], course, settings, names, wrong)


def _spoken(settings: Settings, name: str) -> str:
    """Return a label as it stands in a sentence: ``none`` behind the name of its setting."""
    return f"{next(iter(settings.axes))} none" if name == "none" else name


def _how_often(
    settings: Settings, names: Sequence[str], rates: xr.Dataset, preferred: Sequence[int]
) -> Verdict:
    """Return the detection rate of the setting that detects most; of equals the most exact."""
    value = 100 * rates["detection_rate"].values
    best = max(preferred, key=lambda k: np.nan_to_num(float(value[k]), nan=-1.0))
    low, high = (100 * rates[f"detection_rate_{end}"].values[best] for end in ("low", "high"))
    interval = f" ({interval_text(low, high)})" if math.isfinite(low) else ""
    looked_for = int(rates["looked_for"].values[best])
    whose = f"With {_spoken(settings, names[best])}, d" if len(names) > 1 else "D"
    return Verdict(f"{whose}etected in {number(float(value[best]))} %{interval} of "
                   f"{plural(looked_for, 'pose')}.")
