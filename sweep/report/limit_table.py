"""Limits that requirements have along an axis, as a table for a terminal, a page, or JSON."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.farthest import Reach
from sweep.messages import label
from sweep.report.formatting import coordinate, number, plural, short_coordinate
from sweep.report.table import Table

UNITS = {"degree": "\u00b0", "1": "", "": ""}


def limit_table(limits: xr.Dataset) -> Table:
    """Return a row for each configuration and condition of `sweep.analysis.requirement_limits`."""
    along, dims = str(limits.attrs["along"]), dimensions(limits)
    rows = []
    for index in np.ndindex(*(limits.sizes[name] for name in dims)):
        one = limits.isel(dict(zip(dims, index, strict=True)))
        rows.append([*(coordinate(one[name].item()) for name in dims), limit_text(one),
                     interval_text(one), cause_text(one), beyond_text(one),
                     f"{int(one['poses']):,}"])
    required = " and ".join(map(str, limits.attrs["require"]))
    return Table(
        f"How far along {along}: {required}",
        [*dims, "met", "95 % interval", "fails first", "beyond", "poses"], rows,
        stub=len(dims), words=True)


def dimensions(limits: xr.Dataset) -> list[str]:
    """Return the dimensions of the limits: conditions, then configurations."""
    configurations = limits.attrs["configuration_dims"]
    return [*(name for name in limits["value"].dims if name not in configurations),
            *configurations]


def limit_text(one: xr.Dataset) -> str:
    """Return up to where requirements are met in one condition: ``up to 1.2 m``."""
    reach = Reach(int(one["reach"]))
    if reach is Reach.not_run:
        return "nothing to judge"
    if reach is Reach.never:
        return "at no value"
    upwards = one.attrs["harder"] == "upwards"
    bound = "up to" if upwards else "down to"
    value = with_unit(one, float(one["value"]))
    if reach is Reach.always:
        return f"at all values, {bound} {value}"
    start = float(one["start"])
    if reach is Reach.within and start == float(one["value"]):
        return f"only at {value}"
    if reach is Reach.within:
        low, high = sorted((start, float(one["value"])))
        return f"{_short(one, low)} to {with_unit(one, high)}"
    return f"{bound} {value}"


def interval_text(one: xr.Dataset) -> str:
    """Return the interval of the limit: ``1.1 to 1.3``; an open end is that of the grid."""
    low, high = float(one["low"]), float(one["high"])
    if math.isnan(low) or math.isnan(high):
        return "none"
    values = np.sort(one[one.attrs["along"]].values)
    least, most = _short(one, float(values[0])), _short(one, float(values[-1]))
    if low == high and math.isfinite(low):
        return f"{_short(one, low)}"
    ends = [f"below {least}" if low == -math.inf else
            f"beyond {most}" if low == math.inf else _short(one, low),
            f"beyond {most}" if high == math.inf else
            f"below {least}" if high == -math.inf else _short(one, high)]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def cause_text(one: xr.Dataset) -> str:
    """Return what fails first beyond: ``1.3 m: detection_rate 0.874 (tilt_deg = 60)``."""
    name = str(one["limited_by"].item())
    if not name:
        return ""
    where = str(one["fails_where"].item())
    return (f"{with_unit(one, float(one['fails_at']))}: {name.split(maxsplit=1)[0]} "
            f"{number(float(one['failing_value']))}{f' ({where})' if where else ''}")


def beyond_text(one: xr.Dataset) -> str:
    """Return whether all is met again beyond: then there is a dip."""
    count = int(np.nan_to_num(float(one["met_beyond"])))
    if not count:
        return ""
    return f"met again, farthest at {with_unit(one, float(one['farthest_beyond']))}"


def summary_lines(limits: xr.Dataset) -> list[str]:
    """Return sentences on all limits together."""
    reach, settled = limits["reach"].values, limits["settled"].values
    count = reach.size
    along, upwards = limits.attrs["along"], limits.attrs["harder"] == "upwards"
    lines = []
    for flag, words in ((Reach.always, f"met at every value of {along}: the limit may lie beyond"),
                        (Reach.never, f"met at no value of {along}"),
                        (Reach.not_run, "nothing to judge")):
        if number_of := int((reach == flag).sum()):
            lines.append(f"{plural(number_of, 'limit') if number_of < count else 'all'}: {words}")
    dips = int((limits["met_beyond"].values > 0).sum())
    if dips:
        lines.append(f"{plural(dips, 'condition')} with a dip: beyond it all is met again, which "
                     "the limit does not count")
    if wide := int((~settled).sum()):
        lines.append(f"{plural(wide, 'limit')} of {count:,} {'is' if wide == 1 else 'are'} not "
                     "known to one value of the grid: see the intervals; more --max-trials tell "
                     "more, unless a rate is all but the limit")
    easy = "small" if upwards else "large"
    lines.append(f"limits are read from {easy} to {'large' if upwards else 'small'} values of "
                 f"{along}")
    return lines


def with_unit(one: xr.Dataset, value: float) -> str:
    """Return a value of the axis with its unit."""
    units = str(one[one.attrs["along"]].attrs.get("units", ""))
    unit = UNITS.get(units, f" {units}")
    return f"{_short(one, value)}{unit}"


def _short(one: xr.Dataset, value: float) -> str:
    return short_coordinate(value, one[one.attrs["along"]].values.tolist())


def table_text(table: Table) -> str:
    """Return a table in columns, for a terminal."""
    rows = [list(table.headings), *([label(cell) for cell in row] for row in table.shown_rows)]
    used = [k for k in range(len(table.headings)) if any(row[k] for row in rows[1:])]
    widths = {k: max(len(row[k]) for row in rows) for k in used}
    return "\n".join("  ".join(row[k].ljust(widths[k]) for k in used).rstrip() for row in rows)


def as_json(limits: xr.Dataset) -> dict[str, Any]:
    """Return limits as JSON values: a list with the fields of each condition."""
    dims = dimensions(limits)
    names = ("value", "low", "high", "start", "fails_at", "failing_value", "limited_by",
             "fails_where", "met_beyond", "farthest_beyond", "settled", "poses")
    listed = []
    for index in np.ndindex(*(limits.sizes[name] for name in dims)):
        one = limits.isel(dict(zip(dims, index, strict=True)))
        listed.append({
            "condition": {name: one[name].item() for name in dims},
            "reach": Reach(int(one["reach"])).name,
            **{name: _plain(one[name].item()) for name in names}})
    return {"along": limits.attrs["along"], "harder": limits.attrs["harder"],
            "require": list(limits.attrs["require"]), "at_all": list(limits.attrs["at_all"]),
            "units": str(limits[limits.attrs["along"]].attrs.get("units", "")), "limits": listed}


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "infinite" if value > 0 else "-infinite"
    return value
