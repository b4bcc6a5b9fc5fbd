"""Limits along an axis: their table and figure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

from sweep.analysis.limits import Reach
from sweep.analysis.requirements import Decision
from sweep.report.charts import (
    COLOURS,
    INK,
    PAPER,
    REFERENCE_DASHES,
    STRIP,
    Panel,
    Series,
    draw_dots,
    draw_lines,
    grow_by_factors,
    legend_above,
    plain_ticks,
    rows_height,
    spans,
)
from sweep.report.formatting import coordinate, coordinates, number, plural, short_coordinate
from sweep.report.report_data import axis_label
from sweep.report.table import Table
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# Limits that requirements have along an axis, as a table for a terminal, a page, or JSON.

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
    return Table.of(
        f"How far along {along}: {required}",
        [*dims, "met", "95 % interval", "fails first", "beyond", "poses"], rows,
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


def summary_lines(limits: xr.Dataset) -> list[str]:
    """Return sentences on all limits together."""
    reach, decided = limits["reach"].values, are_decided(limits)
    count = reach.size
    along, upwards = limits.attrs["along"], limits.attrs["harder"] == "upwards"
    lines = []
    for flag, words in ((Reach.always, f"met at every value of {along}: the limit may lie beyond"),
                        (Reach.never, f"met at no value of {along}"),
                        (Reach.not_run, "nothing to judge")):
        if number_of := int(((reach == flag) & (decided | (reach == Reach.not_run))).sum()):
            lines.append(f"{plural(number_of, 'limit') if number_of < count else 'all'}: {words}")
    dips = int((limits["met_beyond"].values > 0).sum())
    if dips:
        lines.append(f"{plural(dips, 'condition')} with a dip: beyond it the estimates keep all "
                     "limits again, which the limit does not count")
    if wide := int((~decided & (reach != Reach.not_run)).sum()):
        lines.append(f"{plural(wide, 'limit')} of {count:,} {'is' if wide == 1 else 'are'} not "
                     "decided to one value of the grid: see the intervals; more --max-trials "
                     "decide more, unless a rate is all but the limit")
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


def as_json(limits: xr.Dataset) -> dict[str, Any]:
    """Return limits as JSON values: a list with the fields of each condition.

    ``value`` and ``reach`` are by the estimates; ``met_to`` is the value up to which all is decided
    to be met, ``decided`` whether the interval is that single value.
    """
    dims = dimensions(limits)
    names = ("value", "low", "high", "start", "fails_at", "failing_value", "limited_by",
             "fails_where", "met_beyond", "farthest_beyond", "settled", "poses")
    listed = []
    for index in np.ndindex(*(limits.sizes[name] for name in dims)):
        one = limits.isel(dict(zip(dims, index, strict=True)))
        listed.append({
            "condition": {name: one[name].item() for name in dims},
            "reach": Reach(int(one["reach"])).name,
            "decided": bool(one["settled"]), "met_to": met_to(one),
            **{name: one[name].item() for name in names}})
    return {"along": limits.attrs["along"], "harder": limits.attrs["harder"],
            "require": list(limits.attrs["require"]), "at_all": list(limits.attrs["at_all"]),
            "units": str(limits[limits.attrs["along"]].attrs.get("units", "")), "limits": listed}


# --------------------------------------------------------------------------------------------------
# The figure of limits: each against the first axis of conditions, and which cells are met.

MAX_LINES = 6
"""Lines of one panel; more conditions have rows in place of lines."""

MAX_MAPS = 6
"""Panels of cells."""

FILLS = {Decision.met: (COLOURS[0], 0.42, "met"), Decision.undecided: (STRIP, 1.0, "undecided"),
         Decision.not_met: (COLOURS[1], 0.42, "not met")}
"""Decision -> colour, opacity and word of its cells."""


def limit_panels(limits: xr.Dataset) -> list[Panel]:
    """Return the panels of limits, as `sweep.analysis.requirement_limits` returns them."""
    along, dims = str(limits.attrs["along"]), dimensions(limits)
    varying = [name for name in dims if limits.sizes[name] > 1]
    axis = next((name for name in varying if limits[name].dtype.kind in "fiu"), None)
    others = [name for name in varying if name != axis]
    parts = list(_parts(limits, others))
    label = axis_label(limits, along)
    title = f"Limit of {' and '.join(map(str, limits.attrs['require']))}"
    if axis is None or len(parts) > MAX_LINES:
        names, dots = _rows(limits, varying)
        panels = [Panel(title, f"Limits along {label}, a row for each condition.",
                        partial(draw_dots, names=names, dots=dots, label=label), wide=True,
                        height=rows_height(len(names)))]
    else:
        lines = [_line(name, part, axis) for name, part in parts]
        panels = [Panel(
            title, f"Limits along {label} against {axis_label(limits, axis)}.",
            partial(draw_lines, series=lines, labels=(axis_label(limits, axis), label)))]
    if axis is not None:
        panels += [
            Panel(name or "Cells of the grid", f"Cells that are met, undecided and not met: "
                  f"{label} against {axis_label(limits, axis)}.",
                  partial(draw_cells, limits=part, axis=axis))
            for name, part in parts[:MAX_MAPS]]
    return panels


def _parts(limits: xr.Dataset, others: Sequence[str]) -> list[tuple[str, xr.Dataset]]:
    """Return the limits at each combination of some dimensions, and its name."""
    limits = limits.isel({name: 0 for name in dimensions(limits) if limits.sizes[name] == 1})
    found = []
    for index in itertools.product(*(range(limits.sizes[name]) for name in others)):
        part = limits.isel(dict(zip(others, index, strict=True)))
        found.append((", ".join(
            f"{name.removesuffix('_deg')} {coordinate(part[name].item())}" for name in others),
            part))
    return found


def _line(name: str, part: xr.Dataset, axis: str) -> Series:
    order = np.argsort(part[axis].values, kind="stable")
    part = part.isel({axis: order})
    value, low, high = (part[key].values for key in ("value", "low", "high"))
    # At no value: the line has a gap, and no interval is drawn.
    never = part["reach"].values == Reach.never
    return Series(name, part[axis].values.astype(np.float64), value,
                  np.where(never, np.nan, low), np.where(never, np.nan, high))


def _rows(limits: xr.Dataset, varying: Sequence[str]) -> tuple[list[str], Series]:
    parts = _parts(limits, varying)
    value, low, high = (np.array([float(part[key]) for _, part in parts])
                        for key in ("value", "low", "high"))
    return [name or "all" for name, _ in parts], Series("", value, value, low, high)


def draw_cells(axes: Axes, limits: xr.Dataset, axis: str) -> None:
    """Draw the cells of the grid, filled by decision, with the limit and its interval's ends.

    Parameters
    ----------
    axes
        Empty axes.
    limits
        Dimensions (axis, along).
    axis
        The axis of conditions, along x.
    """
    along = str(limits.attrs["along"])
    limits = limits.isel({name: np.argsort(limits[name].values) for name in (axis, along)})
    x, y = (limits[name].values.astype(np.float64) for name in (axis, along))
    decision = limits["decision"].transpose(along, axis).values
    scales = [_is_logarithmic(values) for values in (x, y)]
    (edges_x, edges_y) = (
        _edges(values, logarithmic=log) for values, log in zip((x, y), scales, strict=True))
    for each, (colour, alpha, _) in FILLS.items():
        cells = np.ma.masked_where(decision != each, np.ones(decision.shape))
        axes.pcolor(edges_x, edges_y, cells, cmap=ListedColormap([colour]), alpha=alpha,
                    edgecolors=PAPER, linewidth=0.6)
    upwards = limits.attrs["harder"] == "upwards"
    for key, style in (("low", REFERENCE_DASHES), ("high", REFERENCE_DASHES), ("value", "-")):
        heights = [_edge(edges_y, y, float(value), upwards=upwards)
                   for value in limits[key].values]
        if key == "value":
            never = edges_y[0 if upwards else -1]
            heights = [never if np.isnan(height) else height for height in heights]
        axes.stairs(heights, edges_x, baseline=None, color=INK, linestyle=style,
                    linewidth=2.0 if key == "value" else 0.9, zorder=4)
    for k, set_scale in enumerate((axes.set_xscale, axes.set_yscale)):
        set_scale("log" if scales[k] else "linear")
    axes.set(xlim=(edges_x[0], edges_x[-1]), ylim=(edges_y[0], edges_y[-1]))
    for k, (values, matplotlib_axis) in enumerate(((x, axes.xaxis), (y, axes.yaxis))):
        plain_ticks(matplotlib_axis, logarithmic=scales[k])
        if len(values) <= 8:
            matplotlib_axis.set_ticks(list(values), labels=coordinates(values.tolist()))
    axes.set_xlabel(axis_label(limits, axis))
    axes.set_ylabel(axis_label(limits, along))
    legend_above(axes, columns=3, handles=[Patch(facecolor=colour, alpha=alpha, label=word)
                 for colour, alpha, word in FILLS.values()])


def _is_logarithmic(values: Floats) -> bool:
    return len(values) > 2 and spans(values, 5) and bool((values > 0).all()) and (
        grow_by_factors(values))


def _edges(values: Floats, *, logarithmic: bool) -> Floats:
    """Return the edges (n + 1,) of cells around increasing values (n,)."""
    if len(values) == 1:
        return np.array([values[0] - 0.5, values[0] + 0.5])
    given = np.log(values) if logarithmic else values
    middles = (given[1:] + given[:-1]) / 2.0
    edges = np.concatenate([[2 * given[0] - middles[0]], middles, [2 * given[-1] - middles[-1]]])
    return np.exp(edges) if logarithmic else edges


def _edge(edges: Floats, values: Floats, limit: float, *, upwards: bool) -> float:
    """Return the edge of the cell of a limit on its hard side; NaN without one."""
    if np.isnan(limit):
        return np.nan
    if np.isinf(limit):
        return float(edges[-1 if limit > 0 else 0])
    return float(edges[int(np.argmin(np.abs(values - limit))) + (1 if upwards else 0)])
