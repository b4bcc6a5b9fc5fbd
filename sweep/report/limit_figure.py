"""The figure of limits: each against the first axis of conditions, and which cells are met."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.patches import Patch

from sweep.analysis.farthest import Reach
from sweep.analysis.requirements import Decision
from sweep.report.charts import draw_dots, draw_lines, rows_height
from sweep.report.formatting import coordinate, coordinates
from sweep.report.grouping import axis_label
from sweep.report.limit_table import dimensions
from sweep.report.scales import Series, grow_by_factors, plain_ticks, spans
from sweep.report.svg import Panel, write_panels
from sweep.report.theme import COLOURS, INK, PAPER, REFERENCE_DASHES, STRIP
from sweep.typing import Floats

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
    axes.legend(
        handles=[Patch(facecolor=colour, alpha=alpha, label=word)
                 for colour, alpha, word in FILLS.values()],
        loc="lower left", bbox_to_anchor=(-0.02, 1.02), ncols=3, borderaxespad=0,
        columnspacing=1.1, handletextpad=0.5, borderpad=0.2)


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


def figure_bytes(limits: xr.Dataset, suffix: str) -> bytes:
    """Return the figure as a file of ".svg" or ".png"."""
    with tempfile.TemporaryDirectory() as folder:
        stem = Path(folder) / "limits"
        write_panels(limit_panels(limits), stem)
        return stem.with_suffix(suffix).read_bytes()
