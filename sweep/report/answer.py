"""The answer in numbers: how often the marker is seen, how well its pose is known, from how far."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr

from sweep.analysis import detection_limit, detection_rate, error_statistics
from sweep.analysis.limits import Limit
from sweep.errors import StoreError
from sweep.plan.parameters import Stage
from sweep.report.figure import ends_of, sentences
from sweep.report.subject import TILT, Subject, stacked, text_of
from sweep.report.table import Table, cells, number
from sweep.report.treatment_figures import treatment_grouping

SEEN = 0.9
"""The detection rate that counts as seen."""

MOST_LIMITS = 3
"""Limits that the paragraph names."""


NEVER = "never"


class Limits(NamedTuple):
    """From which side on the marker is seen, and how far away that is, as text."""

    where: str
    side: str
    distance: str


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
    looked_for = int(rates["looked_for"])
    limits = _limits(subject)
    tiles = [
        Tile("poses", f"{poses:,}", _results(subject, poses)),
        _share_tile("detected", rates, "detection_rate"),
        _share_tile("solved", errors, "solved_rate"),
        _error_tile("rotation error, median", errors, "rotation_median_deg", "\u00b0"),
        _error_tile("rotation error, p95", errors, "rotation_p95_deg", "\u00b0"),
    ]
    if limits:
        where, side, distance = limits[0]
        tiles.append(Tile(f"{100 * SEEN:.0f} % found from a side of", side,
                          ", ".join(filter(None, (distance, where)))))
    tables = (_errors_table(errors), *_limits_table(limits))
    return Answer(_paragraph(subject, looked_for, limits), tuple(tiles), tables)


def _results(subject: Subject, poses: int) -> str:
    results = poses * subject.pipeline.size(Stage.detection, Stage.estimation)
    if results == poses:
        return ""
    return f"{results:,} results, {results // poses:,} treatments each"


def _share_tile(heading: str, found: xr.Dataset, name: str) -> Tile:
    value, low, high = (float(end) for end in ends_of(found, name, 100))
    between = f"{number(low)} to {number(high)} %" if math.isfinite(low) else ""
    return Tile(heading, "\u2013" if math.isnan(value) else f"{number(value)} %", between)


def _error_tile(heading: str, found: xr.Dataset, name: str, unit: str) -> Tile:
    value, low, high = (float(end) for end in ends_of(found, name))
    if math.isinf(value):
        missed = "half" if "median" in name else "5 %"
        return Tile(heading, "\u221e", f"more than {missed} not solved")
    shown = f"{number(value)}{unit}" if math.isfinite(value) else "\u2013"
    known = math.isfinite(low) and not math.isnan(high)
    return Tile(heading, shown, f"{number(low)} to {number(high)}{unit}" if known else "")


def _paragraph(
    subject: Subject, looked_for: int, limits: list[Limits]
) -> str:
    rates, errors = subject.of(detection_rate), subject.of(error_statistics)
    if looked_for == 0:
        return "In no pose was the marker looked for: none was visible and modelled."
    treatments = subject.pipeline.size(Stage.detection, Stage.estimation)
    over = f", with {treatments:,} treatments together," if treatments > 1 else ""
    found, solved = float(rates["detection_rate"]), float(errors["solved_rate"])
    looked = (
        f"The marker was looked for {looked_for:,} times{over} and found in "
        f"{number(100 * found)} %; a pose was solved in {number(100 * solved)} %."
    )
    parts = [looked]
    if solved > 0:
        median, p95 = (float(errors[f"rotation_{name}_deg"]) for name in ("median", "p95"))
        ranges = float(errors["range_rmse_unflipped_percent"])
        parts.append(
            f"The rotation error's median is {_degrees(median)}, its 95 % quantile "
            f"{_degrees(p95)}, counting what was not solved as infinite; without flips and "
            f"misses the range is off by {number(ranges)} % (RMS)."
        )
        parts.append(_best(subject))
    parts.append(_seen(limits))
    return sentences(*parts)


def _best(subject: Subject) -> str:
    """Return which treatment has the smallest median rotation error, as a sentence."""
    grouping = treatment_grouping(subject)
    if not grouping.dims:
        return ""
    names, found = stacked(subject.of(error_statistics, grouping), grouping.dims)
    median = found["rotation_median_deg"].values
    if not np.isfinite(median).any():
        return ""
    best = int(np.nanargmin(median))
    return (
        f"Of the treatments {names[best]} has the smallest median rotation error, "
        f"{_degrees(float(median[best]))}, and solves "
        f"{number(100 * float(found['solved_rate'].values[best]))} %."
    )


def _degrees(value: float) -> str:
    return f"{number(value)}\u00b0" if math.isfinite(value) else "infinite"


def _seen(limits: list[Limits]) -> str:
    """Return from how far the marker is seen, as a sentence: all limits, or the first and last."""
    if not limits:
        return ""
    if all(limit.side == NEVER for limit in limits):
        return f"There is no side from which on at least {100 * SEEN:.0f} % are found."
    listed = [
        f"{f'{where}: ' if where else ''}{side}{f' ({distance})' if distance else ''}"
        for where, side, distance in limits
    ]
    told = "; ".join(listed) if len(listed) <= MOST_LIMITS else (
        f"{listed[0]}, to {listed[-1]} (the table below has all)")
    return f"At least {100 * SEEN:.0f} % are found from this side in the image on: {told}."


def _limits(subject: Subject) -> list[Limits]:
    """Return where, the side from which on the marker is seen, and its distance, as text."""
    if subject.size_axis is None:
        return []
    per = (TILT,) if subject.tilted else ()
    try:
        found = subject.once(
            "detection_limit", lambda: detection_limit(subject.results, rate=SEEN, per=per))
    except StoreError:  # the side is not the same over what is pooled, or not known
        return []
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
            limits.append(Limits(where, NEVER, ""))
            continue
        least = "\u2264 " if limit == Limit.always else ""
        distance = ""
        if "distance_m" in one.variables and math.isfinite(float(one["distance_m"])):
            distance = f"{number(float(one['distance_m']))} m"
        limits.append(Limits(where, f"{least}{number(float(one['side_px']))} px", distance))
    return limits


QUANTITIES = {"rotation": ("rotation", "deg"), "range": ("range (depth)", "percent"),
              "position": ("position", "m")}
STATISTICS = {
    "median (not solved: infinite)": "median", "95 % quantile (p95)": "p95",
    "99 % quantile (p99)": "p99", "RMSE of the solved": "rmse",
    "RMSE without flips": "rmse_unflipped", "bias without flips": "bias",
    "standard deviation without flips": "sd",
}


def _errors_table(errors: xr.Dataset) -> Table:
    quantities = {
        f"{words}, {'%' if unit == 'percent' else unit}": f"{quantity}_{{}}_{unit}"
        for quantity, (words, unit) in QUANTITIES.items()
    }
    rows = [
        [heading, *(
            cells(errors, name.format(statistic))[0] if name.format(statistic) in errors else ""
            for name in quantities.values())]
        for heading, statistic in STATISTICS.items()
    ]
    return Table(
        "Errors over the whole store, with 95 % intervals", ["statistic", *quantities], rows)


def _limits_table(limits: list[Limits]) -> list[Table]:
    if len(limits) <= MOST_LIMITS:
        return []
    wide = 3 if any(limit.distance for limit in limits) else 2
    return [Table(
        f"At least {100 * SEEN:.0f} % are found from this side on",
        ["of", "side", "distance"][:wide], [list(limit)[:wide] for limit in limits],
    )]
