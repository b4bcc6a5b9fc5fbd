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
    dims = dimensions(limits)
    rows = [[*map(coordinate, at.values()), limit_text(one), interval_text(one),
             bool(one["settled"]), *_failure_texts(one), int(one["poses"])]
            for at, one in each_cell(limits, dims)]
    required = " and ".join(map(str, limits.attrs["require"]))
    at_all = ", ".join(limits.attrs["at_all"])
    return Table.of(
        f"How far along {limits.attrs['along']}: {required}"
        + (f", at all values of {at_all}" if at_all else ""),
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
    reach, start, value = Reach(int(one["reach"])), float(one["start"]), float(one["value"])
    bound = f"{'up to' if one.attrs['harder'] == 'upwards' else 'down to'} {_place(one, value)}"
    low, high = sorted((start, value))
    text = {
        Reach.not_run: "nothing to judge", Reach.never: "at no value", Reach.found: bound,
        Reach.always: f"at all values, {bound}",
        Reach.within: f"only at {_place(one, value)}" if low == high else
                      f"{_place(one, low, unit=False)} to {_place(one, high)}"}[reach]
    if bool(one["settled"]) or reach is Reach.not_run:
        return text
    if value != met_to(one):
        return f"not decided: {text}"
    return text if reach is Reach.always else f"{text}, not decided beyond"


def met_to(one: xr.Dataset) -> float:
    """Return the value up to which all is decided to be met; infinite for none."""
    return float(one["low" if one.attrs["harder"] == "upwards" else "high"])


def interval_text(one: xr.Dataset) -> str:
    """Return the interval of the limit: ``1.1 to 1.3``; an open end is that of the grid."""
    low, high = float(one["low"]), float(one["high"])
    if math.isnan(low) or math.isnan(high):
        return "none"
    values = one[one.attrs["along"]].values
    beyond = {-math.inf: f"below {_place(one, float(values.min()), unit=False)}",
              math.inf: f"beyond {_place(one, float(values.max()), unit=False)}"}
    texts = [beyond.get(end) or _place(one, end, unit=False) for end in (low, high)]
    return " to ".join(dict.fromkeys(texts))


def _failure_texts(one: xr.Dataset) -> tuple[str, str]:
    """Return what fails first beyond, and whether estimates keep all limits again: perhaps a dip.

    ``1.3 m: detection_rate 0.874 (tilt_deg = 60)``
    """
    cause = beyond = ""
    if name := str(one["limited_by"].item()):
        where = str(one["fails_where"].item())
        cause = (f"{_place(one, float(one['fails_at']))}: {name.split(maxsplit=1)[0]} "
                 f"{number(float(one['failing_value']))}{f' ({where})' if where else ''}")
    if float(one["met_beyond"]) > 0:
        beyond = ("kept again by estimate, farthest at "
                  f"{_place(one, float(one['farthest_beyond']))}")
    return cause, beyond


def _place(one: xr.Dataset, value: float, *, unit: bool = True) -> str:
    """Return a value of the axis with its unit."""
    axis = one[one.attrs["along"]]
    values: list[float] = axis.values.astype(float).tolist()
    text = dict(zip(values, coordinates(values), strict=True)).get(value, coordinate(value))
    units = str(axis.attrs.get("units", ""))
    return text + UNITS.get(units, f" {units}") if unit else text


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


def limit_findings(limits: xr.Dataset) -> Findings:
    """Return limits as findings, which print themselves; status 3 if one is not decided."""
    store, decided = str(limits.attrs["store"]), are_decided(limits)
    easy, hard = ("small", "large") if limits.attrs["harder"] == "upwards" else ("large", "small")
    line = "all limits are decided" if decided.all() else (
        f"{int((~decided).sum()):,} limits of {decided.size:,} are not decided to one value of the "
        "grid (more --max-trials decide more)")
    line += f"; read from {easy} to {hard} values of {limits.attrs['along']}"
    return Findings(
        [limit_table(limits), line], as_json(limits) | {"store": store}, limits,
        0 if decided.all() else UNDECIDED, (f"sweep report {quoted(store)}", ""))


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
