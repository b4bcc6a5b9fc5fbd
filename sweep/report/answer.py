"""The answer in numbers: detection rate, accuracy of the pose, and the detection limit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis import detection_rate, error_statistics
from sweep.analysis.quantiles import IntervalOf
from sweep.analysis.registry import error_headings
from sweep.plan.parameters import Stage
from sweep.report.configurations import configurations
from sweep.report.figure import sentences, values_with_ends
from sweep.report.formatting import degrees, interval_text, number
from sweep.report.grouping import by_configuration
from sweep.report.limits import Limits, limits_of, limits_sentence, limits_table, limits_tile
from sweep.report.report_data import ReportData
from sweep.report.signed_errors_table import signed_errors_table
from sweep.report.table import Table, cells
from sweep.report.tile import Tile

MAX_RIVALS = 3
"""Configurations that the paragraph names as indistinguishable from the best."""


@dataclass(frozen=True, slots=True)
class Answer:
    """The numbers that a reader wants first: a paragraph, tiles and tables."""

    paragraph: str
    tiles: tuple[Tile, ...]
    tables: tuple[Table, ...]


def answer(data: ReportData) -> Answer:
    """Return the answer in numbers over the whole store."""
    rates, errors = data.analysed(detection_rate), data.analysed(error_statistics)
    poses = data.pipeline.size(Stage.scene)
    limits = limits_of(data)
    tiles = (
        Tile("poses", f"{poses:,}", _results(data, poses)),
        _share_tile("detected", rates, "detection_rate"),
        _share_tile("solved", errors, "solved_rate"),
        _error_tile("rotation error, median", errors, "rotation_median_deg"),
        _error_tile("rotation error, p95", errors, "rotation_p95_deg"),
        *limits_tile(limits),
    )
    warnings = "".join(f"{line.strip()[:1].upper()}{line.strip()[1:]}. " for line in data.warnings)
    paragraph = warnings + _paragraph(data, limits)
    tables = (_errors_table(errors), signed_errors_table(data), *limits_table(limits))
    return Answer(paragraph, tiles, tables)


def _results(data: ReportData, poses: int) -> str:
    results = poses * data.pipeline.size(Stage.detection, Stage.estimation)
    if results == poses:
        return ""
    return f"{results:,} results, {results // poses:,} configurations each"


def _share_tile(heading: str, summary: xr.Dataset, name: str) -> Tile:
    value, low, high = (float(end) for end in values_with_ends(summary, name, 100))
    interval = f"{interval_text(low, high, ' %')}, " if math.isfinite(low) else ""
    return Tile(heading, "\u2013" if math.isnan(value) else f"{number(value)} %",
                f"{interval}of {int(summary['looked_for']):,}")


def _error_tile(heading: str, summary: xr.Dataset, name: str) -> Tile:
    value, low, high = (float(end) for end in values_with_ends(summary, name))
    if math.isinf(value):
        missed = "half" if "median" in name else "5 %"
        return Tile(heading, "\u221e", f"more than {missed} not solved")
    text = f"{number(value)}\u00b0" if math.isfinite(value) else "\u2013"
    known = math.isfinite(low) and not math.isnan(high)
    return Tile(heading, text, interval_text(low, high, "\u00b0") if known else "")


def _paragraph(data: ReportData, limits: Limits) -> str:
    rates, errors = data.analysed(detection_rate), data.analysed(error_statistics)
    if int(rates["looked_for"]) == 0:
        return "The marker was looked for in no pose: it was visible and modelled in none."
    parts = [_rates_sentence(data, rates, errors)]
    if float(errors["solved_rate"]) > 0:
        median, p95 = (float(errors[f"rotation_{name}_deg"]) for name in ("median", "p95"))
        ranges = float(errors["range_rmse_unflipped_percent"])
        parts.append(
            f"The rotation error's median is {degrees(median)}, its 95 % quantile "
            f"{degrees(p95)}, where a pose that is not solved counts as an infinite error; the "
            f"range error of the solved poses without flips is {number(ranges)} % (RMS)."
        )
        parts.append(_best_sentence(data))
    parts.append(limits_sentence(limits))
    return sentences(*parts)


def _rates_sentence(data: ReportData, rates: xr.Dataset, errors: xr.Dataset) -> str:
    """Return the rates of detection and solution, each with its denominator, as a sentence.

    Every setting of the detector searches each image once; every estimator makes a result of each
    search.
    """
    detectors = data.pipeline.size(Stage.detection)
    configurations = data.pipeline.size(Stage.detection, Stage.estimation)
    searches, results = int(rates["looked_for"]), int(errors["looked_for"])
    times = "once" if searches == 1 else f"{searches:,} times"
    pooled = f", pooled over {detectors:,} detector settings," if detectors > 1 else ""
    of = f" of {results:,} results, pooled over {configurations:,} configurations" if (
        results != searches) else ""
    return (
        f"The marker was looked for {times}{pooled} and detected in "
        f"{number(100 * float(rates['detection_rate']))} %; a pose was solved in "
        f"{number(100 * float(errors['solved_rate']))} %{of}."
    )


def _best_sentence(data: ReportData) -> str:
    """Return which configuration has the smallest median rotation error, as a sentence."""
    grouping = configurations(data).settings.grouping
    if not grouping.dims:
        return ""
    names, summary = by_configuration(data.analysed(error_statistics, grouping), grouping.dims)
    median, low, high = values_with_ends(summary, "rotation_median_deg")
    if not np.isfinite(median).any():
        return ""
    best = int(np.nanargmin(median))
    exact = summary["median_interval"].values == IntervalOf.nothing_drawn
    interval = "" if math.isnan(low[best]) and math.isnan(high[best]) else (
        f" ({interval_text(low[best], high[best])})")
    # Without draws a median is exact; an unknown end otherwise lies beyond all draws.
    low = np.where(np.isnan(low), np.where(exact, median, -np.inf), low)
    high = np.where(np.isnan(high), np.where(exact, median, np.inf), high)
    rivals = [
        name for k, name in enumerate(names)
        if k != best and not math.isnan(median[k]) and low[k] <= high[best]
    ]
    listed = ", ".join(rivals[:MAX_RIVALS])
    if len(rivals) > MAX_RIVALS:
        listed += f" and {len(rivals) - MAX_RIVALS:,} more"
    return sentences(
        f"Of the configurations, {names[best]} has the smallest median rotation error, "
        f"{degrees(float(median[best]))}{interval}, and solves "
        f"{number(100 * float(summary['solved_rate'].values[best]))} %"
        + (f"; it is indistinguishable from {listed}." if rivals else "."),
        *grouping.notes,
    )


QUANTITIES = {"rotation": ("rotation", "deg"), "range": ("range (depth)", "percent"),
              "position": ("position", "m")}
"""Quantity in the names of errors -> its name in words, and its unit in those names."""


def _errors_table(errors: xr.Dataset) -> Table:
    quantities = {
        f"{words}, {'%' if unit == 'percent' else unit}": f"{quantity}_{{}}_{unit}"
        for quantity, (words, unit) in QUANTITIES.items()
    }
    rows = [
        [heading, *(
            cells(errors, name.format(statistic))[0] if name.format(statistic) in errors else ""
            for name in quantities.values())]
        for heading, statistic in error_headings().items()
    ]
    return Table(
        "Errors over the whole store, with 95 % intervals", ["statistic", *quantities], rows)
