"""Charts on matplotlib's axes: lines, dots with intervals, maps with numbers, stacked bars.

Lines differ in colour, marker and dash at once, so that the colour-blind, and readers of a black
and white print, can distinguish them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.ticker import NullLocator
from matplotlib.transforms import offset_copy
from numpy.typing import NDArray

from sweep.report.formatting import brief_number, coordinates, shortened
from sweep.report.scales import (
    Series,
    clipped_intervals,
    colour_ends,
    colour_scale,
    grow_by_factors,
    plain_ticks,
    readable_on,
    spans,
    value_limits,
    value_scale,
)
from sweep.report.theme import COLOURS, DASHES, FAINT, INK, PAPER, REFERENCE_DASHES, SHAPES
from sweep.typing import Floats

MANY_POINTS = 18
"""A line of more points has a band in place of bars for its intervals."""

DODGE = 2.2
"""Points by which neighbouring lines are shifted, so that their intervals do not overlap."""

LINE_WIDTH_CHARS = 62
"""Characters of a legend's line across a panel."""

NUMBERED_COLUMNS = 14
"""A map of more columns has a colour bar in place of numbers."""

MAX_COLUMN_LABELS, MAX_ROW_LABELS = 14, 40
COLUMN_LABEL_CHARS, ROW_LABEL_CHARS = 18, 30

MAX_OWN_TICKS = 7
"""Up to this many values of an axis have ticks of their own."""


def draw_lines(
    axes: Axes, series: Sequence[Series], labels: tuple[str, str], *, share: bool = False,
    level: float | None = None,
) -> None:
    """Draw lines with their intervals; infinite values stand at the upper edge.

    Parameters
    ----------
    series
        Values (n,) with their intervals, a line each.
    labels
        Of the x and the y axis.
    share
        Whether y is a share, drawn from 0 to 100 %.
    level
        y of a dashed line, such as the 0 of signed errors.
    """
    x = np.concatenate([line.x for line in series])
    logarithmic_x = spans(x, 5) and bool((x > 0).all()) and grow_by_factors(x)
    axes.set_xscale("log" if logarithmic_x else "linear")
    axes.set_xlim(*value_limits(x, logarithmic=logarithmic_x, margin=0.05))
    logarithmic_y, (bottom, top) = value_scale(series, share=share, level=level)
    axes.set_yscale("log" if logarithmic_y else "linear")
    axes.set_ylim(bottom, top)
    plain_ticks(axes.yaxis, logarithmic=logarithmic_y, share=share)
    if not any(np.isfinite(line.y).any() for line in series):
        _note_nothing_finite(axes)
    many = max((len(line.y) for line in series), default=0) > MANY_POINTS
    for k, line in enumerate(series):
        colour, shape = COLOURS[k % len(COLOURS)], SHAPES[k % len(SHAPES)]
        finite = np.isfinite(line.y)
        # On a logarithmic scale 0 is drawn at the lower edge; infinite values are gaps.
        y = np.where(finite, np.maximum(line.y, bottom), np.nan)
        shift = 0.0 if many else DODGE * (k - (len(series) - 1) / 2)
        dodged = offset_copy(axes.transData, axes.get_figure(root=True), shift, 0, "points")
        axes.plot(
            line.x, y, transform=dodged, color=colour, marker=shape, label=line.label,
            linestyle=DASHES[k % len(DASHES)], zorder=3,
            markersize=3.2 if many else 5, markeredgecolor=PAPER, markeredgewidth=0.4,
        )
        low, high = clipped_intervals(line, (bottom, top))
        known = finite & np.isfinite(low) & np.isfinite(high)
        if many:
            axes.fill_between(
                line.x, low, high, where=known, color=colour, alpha=0.2, linewidth=0, zorder=2,
            )
        elif known.any():
            axes.vlines(line.x[known], low[known], high[known], color=colour, linewidth=1,
                        alpha=0.8, zorder=2, transform=dodged)
        beyond = np.isposinf(line.y)
        axes.plot(
            line.x[beyond], np.full(beyond.sum(), top), linestyle="", marker=shape, color=colour,
            transform=dodged, clip_on=False,
            markerfacecolor=PAPER, markersize=3 if many else 5, zorder=4,
        )
    if level is not None:
        axes.axhline(level, color=INK, linewidth=0.9, linestyle=REFERENCE_DASHES, zorder=1.5)
    plain_ticks(axes.xaxis, logarithmic=logarithmic_x)
    values = np.unique(x)
    if 0 < values.size <= MAX_OWN_TICKS:
        axes.set_xticks(values, coordinates(values.tolist()))
    axes.grid(visible=True)
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    _exclude_from_layout(axes)
    if len(series) > 1:
        _legend(axes, [line.label for line in series])


def _exclude_from_layout(axes: Axes) -> None:
    """Leave what is drawn within the axes out of the layout, which is that of the labels alone."""
    for artist in (*axes.lines, *axes.collections):
        artist.set_in_layout(False)


def draw_dots(
    axes: Axes, names: Sequence[str], dots: Series, label: str, *, share: bool = False,
    level: float | None = None, marked: NDArray[np.bool_] | None = None,
    ticks: Floats | None = None,
) -> None:
    """Draw a row for each name: a dot with its interval along x.

    Parameters
    ----------
    names
        Of the rows, the first at the top.
    dots
        Values (n,) with their intervals; infinite ones are drawn at the right edge.
    label
        Of the x axis.
    share
        Whether x is a share, drawn from 0 to 100 %.
    level
        x of a dashed line through all rows.
    marked
        (n,) rows with another colour and shape.
    ticks
        (n,) values to compare with, drawn as small upright lines.
    """
    flat = [dots._replace(y=np.asarray(dots.y, dtype=np.float64))]
    if ticks is not None:
        flat.append(Series("", dots.x, ticks, ticks * np.nan, ticks * np.nan))
    logarithmic, limits = value_scale(flat, share=share, level=level)
    axes.set_xscale("log" if logarithmic else "linear")
    axes.set_xlim(*limits)
    rows = np.arange(len(names), dtype=np.float64)
    low, high = clipped_intervals(dots, limits)
    if not np.isfinite(dots.y).any():
        _note_nothing_finite(axes)
    chosen = np.zeros(len(names), dtype=bool) if marked is None else marked
    for mask, colour, shape in ((~chosen, COLOURS[0], "o"), (chosen, COLOURS[1], "D")):
        known = mask & np.isfinite(low) & np.isfinite(high)
        axes.hlines(rows[known], low[known], high[known], color=colour, linewidth=1.3, alpha=0.8)
        finite = mask & np.isfinite(dots.y)
        axes.plot(np.clip(dots.y[finite], *limits), rows[finite], shape, color=colour,
                  markersize=5.5, markeredgecolor=PAPER, markeredgewidth=0.5, zorder=3)
        beyond = mask & np.isposinf(dots.y)
        axes.plot(np.full(beyond.sum(), limits[1]), rows[beyond], shape, color=colour,
                  markerfacecolor=PAPER, markersize=5.5, zorder=3, clip_on=False)
    if ticks is not None:
        axes.plot(ticks, rows, "|", color=INK, markersize=8, zorder=2.5)
    if level is not None:
        axes.axvline(level, color=INK, linewidth=0.9, linestyle=REFERENCE_DASHES, zorder=1.5)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_yticks(rows, [shortened(name, ROW_LABEL_CHARS) for name in names])
    axes.tick_params(axis="y", length=0)
    if np.isfinite(dots.y).any():
        plain_ticks(axes.xaxis, logarithmic=logarithmic, share=share)
    axes.grid(visible=True, axis="x")
    _exclude_from_layout(axes)
    axes.set_xlabel(label)


def rows_height(rows: int) -> float:
    """Return the height in inches of a panel with this many rows."""
    return max(1.6, 0.9 + 0.19 * rows)


def draw_map(
    axes: Axes, rows: Sequence[str], columns: Sequence[str], values: Floats,
    labels: tuple[str, str], *, share: bool = False,
) -> None:
    """Draw a map of values (rows, columns), the first row lowest, with numbers in the cells.

    Shares are in viridis, from 0 to 100 %; errors in cividis, dark for large, on a logarithmic
    scale if they span a wide range. NaN is a dash. Maps of many columns have a colour bar in place
    of the numbers.
    """
    shown, norm = (
        100 * values if share else values, colour_scale(values, share=share))
    colours = mpl.colormaps["viridis" if share else "cividis_r"]
    finite = np.ma.masked_invalid(shown)
    mesh = axes.pcolormesh(finite, cmap=colours, norm=norm, edgecolors=PAPER, linewidth=0.8)
    few = len(columns) <= NUMBERED_COLUMNS
    for (row, column), value in np.ndenumerate(shown):
        if few or not np.isfinite(value):
            text = f"{value:.0f}" if share and np.isfinite(value) else brief_number(value)
            axes.text(
                column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=7.5,
                color=readable_on(colours, norm, value),
            )
    for axis, names, most, longest in (
        (axes.xaxis, columns, MAX_COLUMN_LABELS, COLUMN_LABEL_CHARS),
        (axes.yaxis, rows, MAX_ROW_LABELS, ROW_LABEL_CHARS),
    ):
        every = math.ceil(len(names) / most)
        axis.set_ticks(np.arange(0, len(names), every) + 0.5,
                       [shortened(name, longest) for name in names[::every]])
    if sum(len(name) for name in columns) > LINE_WIDTH_CHARS:
        axes.tick_params(axis="x", rotation=60)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    if not few:
        bar = axes.figure.colorbar(mesh, ax=axes, pad=0.015, aspect=30)
        bar.outline.set_visible(False)
        if isinstance(norm, LogNorm):
            bar.ax.yaxis.set_minor_locator(NullLocator())
            values_at = np.geomspace(*colour_ends(norm), 4)
            bar.set_ticks(list(values_at), labels=[brief_number(value) for value in values_at])


def draw_stack(
    axes: Axes, names: Sequence[str], parts: Mapping[str, Floats], label: str
) -> None:
    """Draw a bar for each name, the shares (n,) of ``parts`` stacked in their order."""
    positions = np.arange(len(names), dtype=np.float64)
    below = np.zeros(len(names))
    for part, share in parts.items():
        colour, hatch = _outcome_style(part, list(parts))
        height = 100 * np.nan_to_num(share)
        axes.bar(positions, height, 0.86 if len(names) < 30 else 1.0, below, label=part,
                 color=colour, hatch=hatch, edgecolor=PAPER, linewidth=0.5)
        below += height
    every = math.ceil(len(names) / MAX_COLUMN_LABELS)
    axes.set_xticks(
        positions[::every], [shortened(name, COLUMN_LABEL_CHARS) for name in names[::every]])
    if sum(len(name) for name in names[::every]) > LINE_WIDTH_CHARS:
        axes.tick_params(axis="x", rotation=60)
    axes.tick_params(axis="x", length=0)
    axes.set(ylim=(0, 100.001), xlim=(-0.6, max(len(names), 3) - 0.4), ylabel="share, %")
    axes.set_xlabel(label)
    axes.grid(visible=True, axis="y")
    if parts:
        _legend(axes, list(parts))


OUTCOME_COLOURS = {
    "solved": FAINT, "wrong_id": COLOURS[1], "rejected": COLOURS[5], "no_candidate": COLOURS[4],
    "solver_failed": COLOURS[3], "not_converged": COLOURS[0], "not_explained": COLOURS[2],
    "failed": INK, "crashed": COLOURS[6],
}
"""Colours that are the same in every report; other outcomes are hatched in the palette's order."""


def _outcome_style(outcome: str, outcomes: Sequence[str]) -> tuple[str, str | None]:
    """Return the colour of an outcome's bars, and their hatch or None."""
    if outcome in OUTCOME_COLOURS:
        return OUTCOME_COLOURS[outcome], None
    others = [name for name in outcomes if name not in OUTCOME_COLOURS]
    return COLOURS[others.index(outcome) % len(COLOURS)], "////"


def _legend(axes: Axes, labels: list[str]) -> None:
    """Put the legend above the axes, in as few lines as it needs."""
    widest = max(map(len, labels)) + 6
    columns = max(1, min(len(labels), LINE_WIDTH_CHARS // widest))
    axes.legend(
        loc="lower left", bbox_to_anchor=(-0.02, 1.02), ncols=columns, borderaxespad=0,
        handlelength=2.2, columnspacing=1.1, handletextpad=0.5, labelspacing=0.25, borderpad=0.2,
    )


def _note_nothing_finite(axes: Axes) -> None:
    axes.text(0.5, 0.5, "no finite values", transform=axes.transAxes, ha="center",
              va="center", color=FAINT)
