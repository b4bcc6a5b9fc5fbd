"""Limits that requirements have along an axis: table, JSON, and figure."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.dataset import each_cell
from sweep.analysis.decisions import Reach
from sweep.messages import quoted
from sweep.report.figure import Figure
from sweep.report.table import (
    UNDECIDED,
    Column,
    Findings,
    Table,
    axis_label,
    coordinate,
    coordinates,
    number,
    table_of,
)
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
                     interval_text(one), bool(one["settled"]), cause_text(one),
                     beyond_text(one), int(one["poses"])])
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
    decision = (
        f"{open_limits:,} limits of {count:,} are not decided to one value of the grid (more "
        "--max-trials decide more)") if open_limits else "all limits are decided"
    return f"{decision}; read from {easy} to {hard} values of {limits.attrs['along']}"


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
    values: list[float] = one[one.attrs["along"]].values.astype(float).tolist()
    return dict(zip(values, coordinates(values), strict=True)).get(value, coordinate(value))


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
# The figure of limits: against the first axis of conditions that has numbers.


def limit_figure(limits: xr.Dataset) -> Figure:
    """Return the figure of limits, as `sweep.analysis.requirement_limits` returns them."""
    along, dims = str(limits.attrs["along"]), dimensions(limits)
    varying = [name for name in dims if limits.sizes[name] > 1]
    limits = limits.isel({name: 0 for name in dims if name not in varying})
    axis = next((name for name in varying if limits[name].dtype.kind in "fiu"), None)
    ordered = [*(name for name in varying if name != axis), *([axis] if axis else [])]
    # At no value there is no limit, and no interval is drawn.
    never = limits["reach"] == Reach.never
    drawn = limits[["value", "low", "high"]].where(~never)
    drawn = drawn.rename({"low": "value_low", "high": "value_high"}).assign_coords(limits.coords)
    column = Column(f"limit of {axis_label(limits, along)}", "value")
    title = f"Limit of {' and '.join(map(str, limits.attrs['require']))}"
    return Figure(
        "limit", title, "", table_of(drawn.drop_vars(along), title, ordered, [column], limits),
        [column], axis_label(limits, axis) if axis else "",
        axis_label(limits, ordered[-2]) if axis and len(ordered) > 1 else "")
