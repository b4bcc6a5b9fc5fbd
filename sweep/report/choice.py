"""Which configuration: the best of them for each question, and what is as good."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sweep.analysis.quantiles import IntervalOf
from sweep.report.configurations import Configurations, configurations
from sweep.report.figure import values_with_ends
from sweep.report.formatting import interval_text, number, plural
from sweep.report.report_data import ReportData
from sweep.report.table import Table, cells
from sweep.tradeoff.labels import WRONG

MAX_RIVALS = 3
"""Configurations that are named as indistinguishable from the best."""


class Criterion(NamedTuple):
    """What configurations are compared by.

    Attributes
    ----------
    words, variable, unit, scale
        What it is, the variable of `sweep.analysis.error_statistics`, its unit and factor.
    largest
        Whether large values are good.
    absolute
        Whether its absolute value counts.
    """

    words: str
    variable: str
    unit: str
    scale: float = 1.0
    largest: bool = False
    absolute: bool = False


CRITERIA = (
    Criterion("detected most often", "detection_rate", " %", 100.0, largest=True),
    Criterion("smallest rotation error, median", "rotation_median_deg", "\u00b0"),
    Criterion("smallest rotation error, p95", "rotation_p95_deg", "\u00b0"),
    Criterion("smallest range error, median", "range_median_percent", " %"),
    Criterion("smallest range error, p95", "range_p95_percent", " %"),
    Criterion("smallest range bias", "range_bias_percent", " %", absolute=True),
    Criterion("fewest flips", "flip_rate", " %", 100.0),
)
ACCURACY = CRITERIA[1]


class Best(NamedTuple):
    """The best configuration by a criterion: its number, value, interval, and what is as good."""

    which: int
    value: float
    interval: str
    rivals: list[int]


def best_by(known: Configurations, criterion: Criterion) -> Best | None:
    """Return the best configuration by a criterion, of those without a wrong belief.

    What is as good has an interval that overlaps the best one's; of equals the more exact is
    named. None if no value is finite.
    """
    value, low, high = values_with_ends(known.summary, criterion.variable, criterion.scale)
    shown = value
    if criterion.absolute:
        low, high = (np.where((low <= 0) & (high >= 0), 0.0, np.minimum(abs(low), abs(high))),
                     np.maximum(abs(low), abs(high)))
        value = abs(value)
    usable = np.isfinite(value) & ~known.wrong
    if not usable.any():
        return None
    sign = -1.0 if criterion.largest else 1.0
    best = min((k for k in known.order if usable[k]), key=lambda k: float(sign * value[k]))
    interval = "" if math.isnan(low[best]) and math.isnan(high[best]) else (
        f" ({interval_text(low[best], high[best], criterion.unit)})")
    exact = known.summary["median_interval"].values == IntervalOf.nothing_drawn
    # Without draws a value is exact; an unknown end otherwise lies beyond all draws.
    low = np.where(np.isnan(low), np.where(exact, value, -np.inf), low)
    high = np.where(np.isnan(high), np.where(exact, value, np.inf), high)
    rivals = [
        k for k in range(len(value)) if k != best and usable[k]
        and low[k] <= high[best] and low[best] <= high[k]
    ]
    return Best(best, float(shown[best]), interval, rivals)


def choice_sentence(data: ReportData) -> str:
    """Return which configuration has the smallest median rotation error, as a sentence."""
    known = configurations(data)
    best = best_by(known, ACCURACY) if known.choices > 1 else None
    if best is None:
        return ""
    solved = 100 * float(known.summary["solved_rate"].values[best.which])
    text = (f"Of the configurations, {known.spoken(best.which)} has the smallest median rotation "
            f"error, {number(best.value)}\u00b0{best.interval}, and solves {number(solved)} %")
    if best.rivals:
        text += f"; it is indistinguishable from {_rivals(known, best)}"
    return f"{text}."


def belief_sentence(data: ReportData, best: int) -> str:
    """Return what the wrong beliefs of a store cost, beside one configuration."""
    known = configurations(data)
    beside = _believing_otherwise(known, best)
    if not beside:
        return ""
    bias = known.summary["range_bias_percent"].values
    changed = "; ".join(
        f"{known.spoken(k).removesuffix(WRONG)}: {number(float(bias[k]))} %"
        for k in beside[:MAX_RIVALS])
    count = int(known.wrong.sum())
    return (f"{plural(count, 'configuration')} with a wrong belief {'is' if count == 1 else 'are'} "
            f"no choice; the range bias is {number(float(bias[best]))} % with the truth, with "
            f"{changed}.")


def belief_table(data: ReportData, best: int) -> list[Table]:
    """Return the errors with the truth, and with each wrong belief in its place."""
    known = configurations(data)
    beside = _believing_otherwise(known, best)
    if not beside:
        return []
    columns = [criterion for criterion in CRITERIA[1:] if criterion.variable in known.summary]
    texts = [cells(known.summary, criterion.variable, criterion.scale) for criterion in columns]
    return [Table(
        "What a wrong belief costs, with 95 % intervals",
        ["configuration", *(f"{each.words.removeprefix('smallest ').removeprefix('fewest ')},"
                            f"{each.unit if each.unit.startswith(' ') else ' ' + each.unit}"
                            for each in columns)],
        [[known.names[k], *(text[k] for text in texts)] for k in (best, *beside)])]


def _believing_otherwise(known: Configurations, best: int) -> list[int]:
    """Return the configurations with a wrong belief that are else those of one without."""
    if known.wrong[best]:
        return []
    combinations = known.settings.combinations
    beliefs = {name for k in np.flatnonzero(known.wrong) for name, index in
               combinations[k].items() if all(
                   combinations[k][name] != combinations[j][name]
                   for j in np.flatnonzero(~known.wrong))}
    return [
        int(k) for k in np.flatnonzero(known.wrong)
        if all(combinations[k][name] == index for name, index in combinations[best].items()
               if name not in beliefs)
    ]


def _rivals(known: Configurations, best: Best) -> str:
    listed = ", ".join(known.spoken(k) for k in best.rivals[:MAX_RIVALS])
    if len(best.rivals) > MAX_RIVALS:
        listed += f" and {len(best.rivals) - MAX_RIVALS:,} more"
    return listed


def choice_table(data: ReportData) -> list[Table]:
    """Return the best configuration by each criterion; no table for a single one."""
    known = configurations(data)
    if known.choices < 2:
        return []
    rows = []
    for criterion in CRITERIA:
        best = best_by(known, criterion) if criterion.variable in known.summary else None
        if best is not None:
            rows.append([
                criterion.words, known.names[best.which],
                f"{number(best.value)}{criterion.unit}{best.interval}", _rivals(known, best)])
    return [Table("Which configuration, over the whole grid, with 95 % intervals",
                  ["question", "configuration", "value", "indistinguishable"], rows, words=True)]
