"""How far requirements are met by each configuration, and up to each angle."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis import detection_rate
from sweep.analysis.farthest import Reach, farthest_met, is_harder_upwards, met_run
from sweep.report.configurations import Settings
from sweep.report.grouping import CONFIGURATION, by_configuration
from sweep.report.question import Course
from sweep.report.report_data import ReportData


@dataclass(frozen=True)
class Limit:
    """How far requirements are met, at angles up to one.

    Attributes
    ----------
    angle
        The largest of the angles; None if they are not told apart.
    rank, first
        Number of the last value of the axis, from easy to hard, up to which they are met, -1 for
        none; and of the first from which they are, 0 for the easiest.
    value, low, high
        That value, and the ends of its interval; infinite: the limit may lie beyond the grid; NaN:
        there is none, or without an interval.
    judged
        Whether there was anything to judge.
    limited_by, failing_value, fails_at, fails_at_angle, fails_where
        The requirement that fails first beyond; its quantity's value, and where that is.
    met_beyond, farthest_beyond
        At how many values beyond they are met again, and the farthest of these.
    start_limited_by, start_failing_value, start_fails_at
        The same of the value before the first, if that is not the easiest.
    smallest_angle
        The smallest of the angles; None if it is that of the grid.
    """

    angle: float | None
    rank: int
    value: float
    low: float
    high: float
    judged: bool
    limited_by: str = ""
    failing_value: float = math.nan
    fails_at: float = math.nan
    fails_at_angle: float | None = None
    fails_where: str = ""
    met_beyond: int = 0
    farthest_beyond: float = math.nan
    first: int = 0
    start_limited_by: str = ""
    start_failing_value: float = math.nan
    start_fails_at: float = math.nan
    smallest_angle: float | None = None

    @property
    def count(self) -> int:
        """How many values of the axis they are met at, without a gap."""
        return self.rank - self.first + 1 if self.rank >= 0 else 0


@dataclass(frozen=True)
class Reaches:
    """How far requirements are met along an axis.

    Attributes
    ----------
    along
        The axis.
    upwards
        Whether its large values are the hard ones.
    values
        Its values, from easy to hard.
    names, wrong
        The n configurations, and whether the estimator has a wrong belief.
    limits
        (n, angles): the smallest angle first; one without angles.
    """

    along: str
    upwards: bool
    values: tuple[float, ...]
    names: Sequence[str]
    wrong: Sequence[bool]
    limits: Sequence[Sequence[Limit]]

    def decided(self, limit: Limit) -> bool:
        """Return whether there are enough draws to say that it is met at the easiest value, or not.

        True without intervals.
        """
        none = -math.inf if self.upwards else math.inf
        near, far = (limit.low, limit.high) if self.upwards else (limit.high, limit.low)
        return near != none if limit.rank >= 0 else far == none or math.isnan(far)

    def order(self, preferred: Sequence[int]) -> list[int]:
        """Return the configurations, the farthest reaching first, no wrong belief before others.

        The reach at all angles counts first, then that at fewer of them, then the interval's
        nearer end, then the order ``preferred``.
        """
        def key(k: int) -> tuple[object, ...]:
            ranks = [-limit.count for limit in reversed(self.limits[k])]
            last = self.limits[k][-1]
            low = last.low if math.isfinite(last.low) else -math.inf if self.upwards else math.inf
            return (self.wrong[k], *ranks, -low if self.upwards else low,
                    list(preferred).index(k) if k in preferred else len(preferred))

        return sorted(range(len(self.names)), key=key)


def reaches(
    data: ReportData, requirements: Sequence[str], course: Course, settings: Settings,
    names: Sequence[str], wrong: Sequence[bool],
) -> Reaches:
    """Return how far requirements are met along the axis of a course, by configuration.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`.
    """
    along, angle = str(course.along), course.angle
    results = _of_settings(data, settings)
    table = data.once(("reach", tuple(requirements), course, settings.grouping), lambda: (
        farthest_met(results, requirements, along, per=[angle] if angle else [],
                     at_all=course.at_all)))
    upwards = table.attrs["harder"] == "upwards"
    rows = _rows(data, table.drop_dims([along]), settings, angle, along)
    values = _easy_first(data, along, upwards=upwards)
    limits = _cumulated(
        [[_limit(row, values, angle) for row in each] for each in rows], upwards=upwards)
    return Reaches(along, upwards, values, names, wrong, limits)


def reaches_without_draws(
    data: ReportData, rate: float, course: Course, settings: Settings, names: Sequence[str],
    wrong: Sequence[bool],
) -> Reaches:
    """Return how far the detection rate is at least ``rate`` in a store without draws."""
    along, angle = str(course.along), course.angle
    table = detection_rate(_of_settings(data, settings), [
        *settings.axes, *([angle] if angle else []), *course.at_all, along]).compute()
    upwards = is_harder_upwards(data.results, along, table["detection_rate"])
    values = _easy_first(data, along, upwards=upwards)
    lowest = table["detection_rate"].min(list(course.at_all)).sel({along: list(values)})
    limits = []
    for each in _rows(data, lowest.to_dataset(name="rate"), settings, angle, along):
        row = []
        for part in each:
            rates = part["rate"].values
            judged = ~np.isnan(rates)
            first, rank = met_run(rates >= rate, judged) or (0, -1)
            failing = np.flatnonzero(~(rates >= rate) & judged)
            beyond, before = failing[failing > rank], failing[(failing < first)]
            at = None if angle is None else float(part[angle])
            required = f"detection_rate >= {rate:g}"
            row.append(Limit(
                at, rank, values[rank] if rank >= 0 else math.nan, math.nan, math.nan,
                bool(judged.any()), required if beyond.size else "",
                float(rates[beyond[0]]) if beyond.size else math.nan,
                values[beyond[0]] if beyond.size else math.nan, at, first=first,
                start_limited_by=required if before.size else "",
                start_failing_value=float(rates[before[-1]]) if before.size else math.nan,
                start_fails_at=values[before[-1]] if before.size else math.nan))
        limits.append(row)
    return Reaches(along, upwards, values, names, wrong, _cumulated(limits, upwards=upwards))


def _of_settings(data: ReportData, settings: Settings) -> xr.Dataset:
    """Return the results of some settings; of all others the first value."""
    first = {name: 0 for name in data.setting_axes if name not in settings.axes}
    return data.results.isel(first | {name: list(some) for name, some in settings.axes.items()})


def _easy_first(data: ReportData, along: str, *, upwards: bool) -> tuple[float, ...]:
    return tuple(sorted(map(float, data.results[along].values.tolist()), reverse=not upwards))


def _rows(
    data: ReportData, table: xr.Dataset, settings: Settings, angle: str | None, along: str
) -> list[list[xr.Dataset]]:
    """Return the parts of a table for each configuration and, the smallest first, angle.

    A part may have the dimension ``along``.
    """
    kept = {angle, along, *settings.axes}
    others = {dim: 0 for dim in table.dims if dim not in kept}
    names, stacked = by_configuration(
        data.pipeline, table.isel(others, drop=True), list(settings.axes))
    parts = [stacked.isel({CONFIGURATION: k}) for k in range(len(names))]
    if angle is None:
        return [[part] for part in parts]
    order = np.argsort(table[angle].values, kind="stable")
    return [[part.isel({angle: j}) for j in order] for part in parts]


def _limit(row: xr.Dataset, values: Sequence[float], angle: str | None) -> Limit:
    value, start = float(row["value"]), float(row["start"])
    at = None if angle is None else float(row[angle])
    return Limit(
        at, values.index(value) if math.isfinite(value) else -1, value, float(row["low"]),
        float(row["high"]), judged=int(row["reach"]) != Reach.not_run,
        limited_by=str(row["limited_by"].item()), failing_value=float(row["failing_value"]),
        fails_at=float(row["fails_at"]), fails_at_angle=at,
        fails_where=str(row["fails_where"].item()),
        met_beyond=int(np.nan_to_num(float(row["met_beyond"]))),
        farthest_beyond=float(row["farthest_beyond"]),
        first=values.index(start) if int(row["reach"]) == Reach.within else 0,
        start_limited_by=str(row["start_limited_by"].item()),
        start_failing_value=float(row["start_failing_value"]),
        start_fails_at=float(row["start_fails_at"]),
    )


def _cumulated(rows: Sequence[Sequence[Limit]], *, upwards: bool) -> list[list[Limit]]:
    """Return the limits at all angles up to each, by configuration: of each the nearer one.

    They begin with the smallest angle at which any configuration meets what is required anywhere.
    """
    met = [k for k, limits in enumerate(zip(*rows, strict=True))
           if any(limit.rank >= 0 for limit in limits)]
    skipped = met[0] if met else 0
    out = []
    for row in rows:
        smallest = row[skipped].angle if skipped else None
        held = [dataclasses.replace(limit, smallest_angle=smallest) for limit in row[skipped:]]
        out.append([*row[:skipped], *_up_to_each(held, upwards=upwards)])
    return out


def _up_to_each(limits: Sequence[Limit], *, upwards: bool) -> list[Limit]:
    nearer = min if upwards else max

    def together(first: Limit, second: Limit) -> Limit:
        if not (first.judged and second.judged):
            return dataclasses.replace(second if second.judged else first, angle=second.angle)
        worse = second if second.rank <= first.rank else first
        later = second if second.first >= first.first else first
        both = dataclasses.replace(
            worse, angle=second.angle, low=nearer(first.low, second.low),
            high=nearer(first.high, second.high), first=later.first,
            start_limited_by=later.start_limited_by,
            start_failing_value=later.start_failing_value, start_fails_at=later.start_fails_at)
        if both.rank >= both.first or both.rank < 0:
            return both
        # No value of the axis is met at all of these angles.
        return dataclasses.replace(both, rank=-1, value=math.nan, low=math.nan, high=math.nan)

    return list(itertools.accumulate(limits, together))
