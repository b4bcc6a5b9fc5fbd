"""Limits that requirements have along an axis: table, JSON, and figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.limits import Reach
from sweep.analysis.requirements import Decision
from sweep.messages import quoted
from sweep.report.charts import Panel, Series, draw_dots, draw_lines, rows_height
from sweep.report.figure import map_panel
from sweep.report.formatting import coordinate, coordinates, number, short_coordinate
from sweep.report.report_data import axis_label
from sweep.report.table import UNDECIDED, Findings, Table, each_cell
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# Limits that requirements have along an axis, as a table for a terminal, a page, or JSON.

UNITS = {"degree": "\u00b0", "1": "", "": ""}


def limit_table(limits: xr.Dataset) -> Table:
    """Return a row for each configuration and condition of `sweep.analysis.requirement_limits`."""
    along, dims = str(limits.attrs["along"]), dimensions(limits)
    rows = []
    for at, one in each_cell(limits, dims):
        rows.append([*map(coordinate, at.values()), limit_text(one),
                     interval_text(one), "yes" if one["settled"] else "no", cause_text(one),
                     beyond_text(one), f"{int(one['poses']):,}"])
    required = " and ".join(map(str, limits.attrs["require"]))
    at_all = ", ".join(limits.attrs["at_all"])
    return Table.of(
        f"How far along {along}: {required}" + (f", at all values of {at_all}" if at_all else ""),
        [*dims, "met", "95 % interval", "decided", "fails first", "beyond", "poses"], rows,
        stub=len(dims), words=True)


def dimensions(limits: xr.Dataset) -> list[str]:
    """Return the dimensions of the limits: conditions, then configurations."""
    configurations = limits.attrs["configuration_dims"]
    return [*(name for name in limits["value"].dims if name not in configurations),
            *configurations]


def limit_text(one: xr.Dataset) -> str:
    """Return up to where requirements are met in one condition: ``up to 1.2 m``.

    What is not decided is called so, whatever the estimates are.
    """
    text = _estimate_text(one)
    if bool(one["settled"]) or Reach(int(one["reach"])) is Reach.not_run:
        return text
    if not is_met_to_value(one):
        return f"not decided: {text}"
    return text if Reach(int(one["reach"])) is Reach.always else f"{text}, not decided beyond"


def is_met_to_value(one: xr.Dataset) -> bool:
    """Return whether all values up to the limit are decided to be met."""
    return float(one["value"]) == met_to(one)


def met_to(one: xr.Dataset) -> float:
    """Return the value up to which all is decided to be met; infinite for none."""
    return float(one["low" if one.attrs["harder"] == "upwards" else "high"])


def _estimate_text(one: xr.Dataset) -> str:
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
    """Return whether the estimates keep all limits again beyond: then there may be a dip."""
    count = int(np.nan_to_num(float(one["met_beyond"])))
    if not count:
        return ""
    return f"kept again by estimate, farthest at {with_unit(one, float(one['farthest_beyond']))}"


def values_met(one: xr.Dataset) -> int:
    """Return at how many values of the axis requirements are met, of all conditions."""
    along = one[one.attrs["along"]]
    low, high = np.minimum(one["start"], one["value"]), np.maximum(one["start"], one["value"])
    return int(((along >= low) & (along <= high)).sum())


def are_decided(limits: xr.Dataset) -> Masks:
    """Return which limits are decided: to one value of the grid, or to the grid's hard end.

    Where nothing could be judged there is nothing to decide, unless that is so everywhere.
    """
    reach = limits["reach"].values
    met = limits["value"].values == limits[
        "low" if limits.attrs["harder"] == "upwards" else "high"].values
    judged = reach != Reach.not_run
    decided = limits["settled"].values | ((reach == Reach.always) & met)
    return np.asarray(decided & judged | ~judged & judged.any())


def summary_line(limits: xr.Dataset) -> str:
    """Return how many limits are decided, and from which end they are read."""
    decided = are_decided(limits)
    open_limits, count = int((~decided).sum()), decided.size
    easy, hard = ("small", "large") if limits.attrs["harder"] == "upwards" else ("large", "small")
    return (f"{open_limits:,} limits of {count:,} are not decided to one value of the grid (more "
            f"--max-trials decide more); read from {easy} to {hard} values of "
            f"{limits.attrs['along']}")


def limit_findings(limits: xr.Dataset) -> Findings:
    """Return limits as findings, which print themselves; status 3 if one is not decided."""
    store = str(limits.attrs["store"])
    return Findings(
        [limit_table(limits), summary_line(limits)], as_json(limits) | {"store": store}, limits,
        0 if are_decided(limits).all() else UNDECIDED, (f"sweep report {quoted(store)}", ""))


def with_unit(one: xr.Dataset, value: float) -> str:
    """Return a value of the axis with its unit."""
    units = str(one[one.attrs["along"]].attrs.get("units", ""))
    unit = UNITS.get(units, f" {units}")
    return f"{_short(one, value)}{unit}"


def _short(one: xr.Dataset, value: float) -> str:
    return short_coordinate(value, one[one.attrs["along"]].values.tolist())


def as_json(limits: xr.Dataset) -> dict[str, Any]:
    """Return limits as JSON values: a list with the fields of each condition.

    ``value`` and ``reach`` are by the estimates; ``met_to`` is the value up to which all is decided
    to be met, ``decided`` whether the interval is that single value.
    """
    dims = dimensions(limits)
    names = ("value", "low", "high", "start", "fails_at", "failing_value", "limited_by",
             "fails_where", "met_beyond", "farthest_beyond", "settled", "poses")
    listed = [
        {"condition": at, "reach": Reach(int(one["reach"])).name,
         "decided": bool(one["settled"]), "met_to": met_to(one),
         **{name: one[name].item() for name in names}} for at, one in each_cell(limits, dims)]
    return {"along": limits.attrs["along"], "harder": limits.attrs["harder"],
            "require": list(limits.attrs["require"]), "at_all": list(limits.attrs["at_all"]),
            "units": str(limits[limits.attrs["along"]].attrs.get("units", "")), "limits": listed}


# --------------------------------------------------------------------------------------------------
# The figure of limits: each against the first axis of conditions, and which cells are met.

MAX_LINES = 6
"""Lines of one panel; more conditions have rows in place of lines. Also the most maps."""

CELLS = {Decision.met: 100.0, Decision.undecided: 50.0, Decision.not_met: 0.0}
"""Decision -> its number in the map of cells."""


def limit_panels(limits: xr.Dataset) -> list[Panel]:
    """Return the panels of limits, as `sweep.analysis.requirement_limits` returns them."""
    along, dims = str(limits.attrs["along"]), dimensions(limits)
    varying = [name for name in dims if limits.sizes[name] > 1]
    limits = limits.isel({name: 0 for name in dims if name not in varying})
    axis = next((name for name in varying if limits[name].dtype.kind in "fiu"), None)
    parts = list(_parts(limits, [name for name in varying if name != axis]))
    label = axis_label(limits, along)
    title = f"Limit of {' and '.join(map(str, limits.attrs['require']))}"
    if axis is None or len(parts) > MAX_LINES:
        rows = _parts(limits, varying)
        names = [name or "all" for name, _ in rows]
        ends = (np.array([float(part[key]) for _, part in rows])
                for key in ("value", "value", "low", "high"))
        panels = [Panel(title, f"Limits along {label}, a row for each condition.",
                        partial(draw_dots, names=names, dots=Series("", *ends), label=label),
                        wide=True, height=rows_height(len(names)))]
    else:
        lines = [_line(name, part, axis) for name, part in parts]
        panels = [Panel(
            title, f"Limits along {label} against {axis_label(limits, axis)}.",
            partial(draw_lines, series=lines, labels=(axis_label(limits, axis), label)))]
    if axis is not None:
        panels += [_cells(name, part, axis) for name, part in parts[:MAX_LINES]]
    return panels


def _parts(limits: xr.Dataset, others: Sequence[str]) -> list[tuple[str, xr.Dataset]]:
    """Return the limits at each combination of some dimensions, and its name."""
    return [
        (", ".join(f"{name.removesuffix('_deg')} {coordinate(value)}"
                   for name, value in at.items()), part)
        for at, part in each_cell(limits, others)]


def _line(name: str, part: xr.Dataset, axis: str) -> Series:
    part = part.isel({axis: np.argsort(part[axis].values, kind="stable")})
    value, low, high = (part[key].values for key in ("value", "low", "high"))
    # At no value: the line has a gap, and no interval is drawn.
    never = part["reach"].values == Reach.never
    return Series(name, part[axis].values.astype(np.float64), value,
                  np.where(never, np.nan, low), np.where(never, np.nan, high))


def _cells(name: str, part: xr.Dataset, axis: str) -> Panel:
    """Return the map of a grid's cells (along, axis): which are met."""
    along = str(part.attrs["along"])
    part = part.isel({each: np.argsort(part[each].values) for each in (axis, along)})
    decision = part["decision"].transpose(along, axis).values
    values = np.full(decision.shape, np.nan)
    for flag, percent in CELLS.items():
        values[decision == flag] = percent
    rows, columns = (coordinates(part[each].values.tolist()) for each in (along, axis))
    return map_panel(
        f"100: met, 50: not decided, 0: not met{f'; {name}' if name else ''}", rows, columns,
        values, (axis_label(part, axis), axis_label(part, along)), share=True, upwards=True)
