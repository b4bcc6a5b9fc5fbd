"""How far requirements are met, in words and as a table."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sweep.report.figure import sentences
from sweep.report.formatting import number, short_coordinate
from sweep.report.grouping import ANGLES, CONFIGURATION, is_numeric
from sweep.report.reach import Limit, Reaches
from sweep.report.report_data import ReportData
from sweep.report.table import Table

SIZES = {
    "distance_m": ("up to {}", "at no distance", "at all distances, up to {}"),
    "side_px": ("down to a side of {}", "at no size", "at all sizes, down to a side of {}"),
    "size_m": ("with markers of {} and larger", "with no size of the marker",
               "with all markers, from {} on"),
}
"""Axis -> words for a limit along it, for none, and for one that may lie beyond the grid."""


def quantity(data: ReportData, name: str, value: float) -> str:
    """Return a value of an axis with its unit: ``2.25 m``, ``45°``."""
    unit = str(data.results[name].attrs.get("units", "")) if name in data.results.variables else ""
    unit = {"degree": "\u00b0", "px2": "px²", "1": ""}.get(unit, unit)
    axis = data.pipeline.axis(name)
    text = short_coordinate(float(value), axis.values if axis and is_numeric(axis) else ())
    return f"{text}{'' if unit in ('', '°') else ' '}{unit}"


BETWEEN = {"distance_m": "from {}", "side_px": "at sides of {}", "size_m": "with markers of {}"}
"""Axis -> words for values between two."""


def _words(data: ReportData, reach: Reaches) -> tuple[str, str, str]:
    known = SIZES.get(reach.along)
    if known is not None:
        return known
    if reach.along in ANGLES:
        name = ANGLES[reach.along]
        return f"up to a {name} of {{}}", f"at no {name}", f"at every {name}, up to {{}}"
    bound = "up to" if reach.upwards else "down to"
    words = data.label(reach.along).split(",")[0]
    return (f"{bound} a {words} of {{}}", f"at no {words}", f"at every {words}, {bound} {{}}")


def limit_text(data: ReportData, reach: Reaches, limit: Limit) -> str:
    """Return a limit with its interval: ``up to 2.25 m (2 m to 2.5 m)``."""
    to, none, everywhere = _words(data, reach)
    if not limit.judged:
        return "nothing was looked for"
    if limit.rank < 0:
        return none
    if limit.first > 0 or (reach.along in ANGLES and not reach.upwards):
        name = ANGLES.get(reach.along)
        if limit.count == 1:
            values = _between(data, reach, limit)
            return f"only at {f'a {name} of ' if name else ''}{values}"
        words = BETWEEN.get(reach.along, f"at {name}s of {{}}" if name else
                            f"at a {data.label(reach.along).split(',')[0]} of {{}}")
        return words.format(_between(data, reach, limit))
    text = everywhere if limit.rank == len(reach.values) - 1 else to
    return text.format(quantity(data, reach.along, limit.value)) + interval_of(reach, limit)


def _between(data: ReportData, reach: Reaches, limit: Limit) -> str:
    """Return the values from the first to the last, the smaller first: ``20° to 60° (55 to 65)``.

    The interval stands behind the limit that it is of.
    """
    start = quantity(data, reach.along, reach.values[limit.first])
    end = quantity(data, reach.along, limit.value) + interval_of(reach, limit)
    if limit.count == 1:
        return end
    return f"{start} to {end}" if reach.upwards else f"{end} to {start}"


def interval_of(reach: Reaches, limit: Limit) -> str:
    """Return the interval of a limit in brackets, or nothing without one."""
    near, far = (limit.low, limit.high) if reach.upwards else (limit.high, limit.low)
    if math.isnan(near) or (near == far and near == limit.value):
        return ""
    low, high = (short_coordinate(float(end), reach.values) if math.isfinite(end) else ""
                 for end in (near, far))
    if low and high:
        return f" ({low} to {high})" if reach.upwards else f" ({high} to {low})"
    more = "more" if reach.upwards else "less"
    if low:
        return f" ({low} or {more})"
    return f" (at {'most' if reach.upwards else 'least'} {high})" if high else ""


def angle_text(data: ReportData, angle: str | None, limit: Limit) -> str:
    """Return up to which angle a limit holds: ``at tilts up to 45°``."""
    if angle is None or limit.angle is None:
        return ""
    return f"at {_angles(data, angle, limit)}"


def _angles(data: ReportData, angle: str, limit: Limit) -> str:
    """Return the angles of a limit: ``tilts up to 45°``, ``tilts of 20° to 45°``."""
    largest, smallest = (None if each is None else quantity(data, angle, each)
                         for each in (limit.angle, limit.smallest_angle))
    if smallest is None:
        return f"{ANGLES[angle]}s up to {largest}"
    return (f"a {ANGLES[angle]} of {largest}" if smallest == largest else
            f"{ANGLES[angle]}s of {smallest} to {largest}")


def limiting_text(data: ReportData, reach: Reaches, angle: str | None, limit: Limit) -> str:
    """Return what limits the reach: which requirement fails first, at which condition."""
    if not limit.limited_by:
        return _start_text(data, reach, limit)
    where = [f"at {quantity(data, reach.along, limit.fails_at)}" if reach.along in SIZES else
             f"at a {data.label(reach.along).split(',')[0]} of "
             f"{quantity(data, reach.along, limit.fails_at)}"]
    if angle is not None and limit.fails_at_angle is not None:
        where.append(f"a {ANGLES[angle]} of {quantity(data, angle, limit.fails_at_angle)}")
    if limit.fails_where:
        where.append(limit.fails_where)
    again = "" if not limit.met_beyond else (
        f"Beyond, at {quantity(data, reach.along, limit.farthest_beyond)}"
        + (f" and {limit.met_beyond - 1:,} nearer" if limit.met_beyond > 1 else "")
        + ", all are met again: the limit is that of the first dip.")
    value = "" if math.isnan(limit.failing_value) else f", which is {number(limit.failing_value)}"
    return sentences(f"It is limited by {limit.limited_by}{value} {' and '.join(where)}.", again,
                     _start_text(data, reach, limit))


def _start_text(data: ReportData, reach: Reaches, limit: Limit) -> str:
    """Return which requirement fails before the first value, as a sentence; or nothing."""
    if limit.first == 0 or limit.rank < 0:
        return ""
    return (f"Not at {quantity(data, reach.along, limit.start_fails_at)}: there "
            f"{limit.start_limited_by} is not met, it is {number(limit.start_failing_value)}.")


def skipped_text(
    data: ReportData, reach: Reaches, angle: str | None, limits: Sequence[Limit]
) -> str:
    """Return at which angles what is required is met nowhere, before those at which it is."""
    first = limits[-1].smallest_angle
    if angle is None or first is None:
        return ""
    before = [limit for limit in limits if limit.angle is not None and limit.angle < first]
    none = "nothing was looked for" if not before[-1].judged else (
        f"{_words(data, reach)[1]} ({_short_cause(data, reach, angle, before[-1])})")
    return f"At {ANGLES[angle]}s below {quantity(data, angle, first)}: {none}."


def reach_table(
    data: ReportData, reach: Reaches, angle: str | None, order: Sequence[int], caption: str
) -> Table:
    """Return how far requirements are met: a row for each configuration, a column for each angle.

    A star stands behind what too few draws were made for.
    """
    first = reach.limits[0]
    headings = [_angles(data, angle, limit) if angle and limit.angle is not None else "limit"
                for limit in first]
    rows = [[reach.names[k], *(short_limit(data, reach, limit) for limit in reach.limits[k]),
             _short_cause(data, reach, angle, reach.limits[k][-1])]
            for k in order]
    return Table(caption, [CONFIGURATION, *headings, "limited by"], rows, words=True)


def _short_cause(data: ReportData, reach: Reaches, angle: str | None, limit: Limit) -> str:
    """Return what limits the reach as a cell of a table: ``detection_rate 0.75 at 3 m, 60°``."""
    if not limit.limited_by:
        return ""
    where = [quantity(data, reach.along, limit.fails_at)]
    if angle is not None and limit.fails_at_angle is not None:
        where.append(quantity(data, angle, limit.fails_at_angle))
    if limit.fails_where:
        where.append(limit.fails_where)
    return (f"{limit.limited_by.split()[0]} {number(limit.failing_value)} at "
            f"{', '.join(where)}")


def short_limit(data: ReportData, reach: Reaches, limit: Limit) -> str:
    """Return a limit as a cell of a table."""
    if not limit.judged:
        return "\u2013"
    star = "" if reach.decided(limit) else " *"
    if limit.rank < 0:
        return f"none{star}"
    if limit.first > 0:
        return _between(data, reach, limit) + star
    beyond = ("\u2265 " if reach.upwards else "\u2264 ") if (
        limit.rank == len(reach.values) - 1) else ""
    return beyond + quantity(data, reach.along, limit.value) + interval_of(
        reach, limit) + star
