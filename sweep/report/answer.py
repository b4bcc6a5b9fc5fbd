"""The answer in numbers: how often the marker is seen, how well its pose is known, from how far."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr

from sweep.analysis import detection_limit, detection_rate, error_statistics
from sweep.analysis.detection_limits import Limit
from sweep.analysis.quantiles import IntervalOf
from sweep.analysis.registry import error_headings
from sweep.errors import ArgumentError, DatasetError
from sweep.plan.parameters import Stage
from sweep.report.figure import ends_of, sentences
from sweep.report.report_data import TILT, Subject, stacked, text_of
from sweep.report.table import Table, cells, number
from sweep.report.treatment_figures import treatment_grouping

SEEN = 0.9
"""The detection rate that counts as seen."""

MAX_LIMITS = 3
"""Limits that the paragraph names."""


MAX_RIVALS = 3
"""Treatments that the paragraph names as not told apart from the best."""

NEVER = "never"


class SeenFrom(NamedTuple):
    """From which side on the marker is seen, and how far away that is, as text."""

    where: str
    side: str
    distance: str


@dataclass(frozen=True, slots=True)
class Seen:
    """From which side on the marker is seen, by tilt and dictionary; with which ``settings``."""

    limits: tuple[SeenFrom, ...] = ()
    settings: str = ""


@dataclass(frozen=True, slots=True)
class Tile:
    """One number with what it is, and what stands below it."""

    heading: str
    value: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Answer:
    """The numbers that a reader wants first."""

    paragraph: str
    tiles: tuple[Tile, ...]
    tables: tuple[Table, ...]


def answer(subject: Subject) -> Answer:
    """Return the answer in numbers over the whole store."""
    rates, errors = subject.of(detection_rate), subject.of(error_statistics)
    poses = subject.pipeline.size(Stage.scene)
    seen = _seen(subject)
    tiles = [
        Tile("poses", f"{poses:,}", _results(subject, poses)),
        _share_tile("detected", rates, "detection_rate"),
        _share_tile("solved", errors, "solved_rate"),
        _error_tile("rotation error, median", errors, "rotation_median_deg", "\u00b0"),
        _error_tile("rotation error, p95", errors, "rotation_p95_deg", "\u00b0"),
    ]
    if seen.limits:
        where, side, distance = seen.limits[0]
        tiles.append(Tile(f"{100 * SEEN:.0f} % found from a side of", side,
                          ", ".join(filter(None, (distance, where, seen.settings)))))
    tables = (_errors_table(errors), *_limits_table(seen))
    return Answer(_paragraph(subject, seen), tuple(tiles), tables)


def _results(subject: Subject, poses: int) -> str:
    results = poses * subject.pipeline.size(Stage.detection, Stage.estimation)
    if results == poses:
        return ""
    return f"{results:,} results, {results // poses:,} treatments each"


def _share_tile(heading: str, found: xr.Dataset, name: str) -> Tile:
    value, low, high = (float(end) for end in ends_of(found, name, 100))
    between = f"{number(low)} to {number(high)} %, " if math.isfinite(low) else ""
    return Tile(heading, "\u2013" if math.isnan(value) else f"{number(value)} %",
                f"{between}of {int(found['looked_for']):,}")


def _error_tile(heading: str, found: xr.Dataset, name: str, unit: str) -> Tile:
    value, low, high = (float(end) for end in ends_of(found, name))
    if math.isinf(value):
        missed = "half" if "median" in name else "5 %"
        return Tile(heading, "\u221e", f"more than {missed} not solved")
    shown = f"{number(value)}{unit}" if math.isfinite(value) else "\u2013"
    known = math.isfinite(low) and not math.isnan(high)
    return Tile(heading, shown, f"{number(low)} to {number(high)}{unit}" if known else "")


def _paragraph(subject: Subject, seen: Seen) -> str:
    rates, errors = subject.of(detection_rate), subject.of(error_statistics)
    if int(rates["looked_for"]) == 0:
        return "In no pose was the marker looked for: none was visible and modelled."
    solved = float(errors["solved_rate"])
    parts = [_counted(subject, rates, errors)]
    if solved > 0:
        median, p95 = (float(errors[f"rotation_{name}_deg"]) for name in ("median", "p95"))
        ranges = float(errors["range_rmse_unflipped_percent"])
        parts.append(
            f"The rotation error's median is {_degrees(median)}, its 95 % quantile "
            f"{_degrees(p95)}, counting what was not solved as infinite; without flips and "
            f"misses the range is off by {number(ranges)} % (RMS)."
        )
        parts.append(_best(subject))
    parts.append(_seen_sentence(seen))
    return sentences(*parts)


def _counted(subject: Subject, rates: xr.Dataset, errors: xr.Dataset) -> str:
    """Return how many were found and solved, each of how many, as a sentence.

    Each setting of the detector looks once, and of each look every estimator makes a result.
    """
    detectors = subject.pipeline.size(Stage.detection)
    treatments = subject.pipeline.size(Stage.detection, Stage.estimation)
    looks, results = int(rates["looked_for"]), int(errors["looked_for"])
    times = "once" if looks == 1 else f"{looks:,} times"
    over = f", with {detectors:,} settings of the detector together," if detectors > 1 else ""
    of = f" of {results:,} results, with {treatments:,} treatments together" if (
        results != looks) else ""
    return (
        f"The marker was looked for {times}{over} and found in "
        f"{number(100 * float(rates['detection_rate']))} %; a pose was solved in "
        f"{number(100 * float(errors['solved_rate']))} %{of}."
    )


def _best(subject: Subject) -> str:
    """Return which treatment has the smallest median rotation error, as a sentence."""
    grouping = treatment_grouping(subject)
    if not grouping.dims:
        return ""
    names, found = stacked(subject.of(error_statistics, grouping), grouping.dims)
    median, low, high = ends_of(found, "rotation_median_deg")
    if not np.isfinite(median).any():
        return ""
    best = int(np.nanargmin(median))
    known = found["median_interval"].values == IntervalOf.nothing_drawn
    between = "" if math.isnan(low[best]) and math.isnan(high[best]) else (
        f" ({number(low[best])} to {number(high[best])})")
    # Without draws a median is what it is; an end that is missing else lies beyond all draws.
    low = np.where(np.isnan(low), np.where(known, median, -np.inf), low)
    high = np.where(np.isnan(high), np.where(known, median, np.inf), high)
    rivals = [
        name for k, name in enumerate(names)
        if k != best and not math.isnan(median[k]) and low[k] <= high[best]
    ]
    listed = ", ".join(rivals[:MAX_RIVALS])
    if len(rivals) > MAX_RIVALS:
        listed += f" and {len(rivals) - MAX_RIVALS:,} more"
    return sentences(
        f"Of the treatments {names[best]} has the smallest median rotation error, "
        f"{_degrees(float(median[best]))}{between}, and solves "
        f"{number(100 * float(found['solved_rate'].values[best]))} %"
        + (f"; it is not told apart from {listed}." if rivals else "."),
        *grouping.notes,
    )


def _degrees(value: float) -> str:
    return f"{number(value)}\u00b0" if math.isfinite(value) else "infinite"


def _seen_sentence(seen: Seen) -> str:
    """Return from how far the marker is seen, as a sentence: all limits, or the first and last."""
    limits = seen.limits
    if not limits:
        return ""
    share = f"at least {100 * SEEN:.0f} % are found"
    start = f"{seen.settings}, " if seen.settings else ""
    if all(limit.side == NEVER for limit in limits):
        told = f"{start}there is no side from which on {share}."
        return told[0].upper() + told[1:]
    listed = [
        f"{f'{where}: ' if where else ''}{side}{f' ({distance})' if distance else ''}"
        for where, side, distance in limits
    ]
    text = "; ".join(listed) if len(listed) <= MAX_LIMITS else (
        f"{listed[0]}, to {listed[-1]} (the table below has all)")
    told = f"{start}{share} from this side in the image on: {text}."
    return told[0].upper() + told[1:]


def _seen(subject: Subject) -> Seen:
    """Return from which side on the marker is seen with the first setting of the detector."""
    if subject.size_axis is None:
        return Seen()
    axes = subject.pipeline.axes_of(Stage.detection)
    first = subject.results.isel({axis.name: 0 for axis in axes})
    settings = ", ".join(
        f"{axis.name} {text_of(first[axis.name].item())}" for axis in axes if len(axis) > 1
    )
    per = (TILT,) if subject.tilted else ()
    try:
        limit_of = detection_limit(first, rate=SEEN, per=per)
    except (ArgumentError, DatasetError):  # the side varies over what is pooled, or is unknown
        return Seen()
    found = subject.once("detection_limit", lambda: limit_of)
    dims = [str(dim) for dim in found["side_px"].dims]
    limits = []
    for index in np.ndindex(*(found.sizes[name] for name in dims)):
        one = found.isel(dict(zip(dims, index, strict=True)))
        where = ", ".join(
            f"tilt {text_of(one[name].item())}\u00b0" if name == TILT else str(one[name].item())
            for name in dims
        )
        limit = int(one["limit"])
        if limit == Limit.never:
            limits.append(SeenFrom(where, NEVER, ""))
            continue
        least = "\u2264 " if limit == Limit.always else ""
        distance = ""
        if "distance_m" in one.variables and math.isfinite(float(one["distance_m"])):
            distance = f"{number(float(one['distance_m']))} m"
        limits.append(SeenFrom(where, f"{least}{number(float(one['side_px']))} px", distance))
    return Seen(tuple(limits), f"with {settings}" if settings else "")


QUANTITIES = {"rotation": ("rotation", "deg"), "range": ("range (depth)", "percent"),
              "position": ("position", "m")}


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


def _limits_table(seen: Seen) -> list[Table]:
    limits = seen.limits
    if len(limits) <= MAX_LIMITS:
        return []
    wide = 3 if any(limit.distance for limit in limits) else 2
    settings = f", {seen.settings}" if seen.settings else ""
    return [Table(
        f"At least {100 * SEEN:.0f} % are found from this side on{settings}",
        ["of", "side", "distance"][:wide], [list(limit)[:wide] for limit in limits],
    )]
