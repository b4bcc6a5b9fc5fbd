"""What figures are made of: lines and dots with their intervals, maps with numbers, stacked bars.

Told apart by colour, shape and dash together, so that the colour-blind and those who print in
black can read them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from matplotlib.transforms import offset_copy
from numpy.typing import NDArray

from sweep.report.report_data import texts_of
from sweep.report.table import number
from sweep.report.theme import PAPER
from sweep.report.trade_figure import COLOURS, FAINT, INK, SHAPES
from sweep.typing import Floats

DASHES: tuple[Any, ...] = (
    "-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)), (0, (8, 3)), (0, (3, 1.5)), "-",
)
MANY_POINTS = 18
"""From so many points a line on, its intervals are a band."""

ASIDE = 2.2
"""Points by which the dots of lines stand beside each other."""

LINE_WIDTH_CHARS = 62
"""Characters of a legend's line across a panel."""

NUMBERED_COLUMNS = 14
MAX_LABELS = 40
FEW_TICKS = 7
"""Up to so many values of an axis have their own ticks."""


class Series(NamedTuple):
    """A line or a row of dots: values with the ends of their intervals, NaN where there is none."""

    label: str
    x: Floats
    y: Floats
    low: Floats
    high: Floats


def draw_lines(
    axes: Axes, series: Sequence[Series], labels: tuple[str, str], *, share: bool = False,
) -> None:
    """Draw lines with their intervals; infinite values stand at the upper edge.

    ``share``: y is a share, shown from 0 to 100 %.
    """
    x = np.concatenate([one.x for one in series])
    logarithmic_x = _spans(x, 5) and bool((x > 0).all())
    axes.set_xscale("log" if logarithmic_x else "linear")
    axes.set_xlim(*_limits(x, logarithmic=logarithmic_x, margin=0.05))
    _set_y(axes, series, share=share)
    bottom, top = axes.get_ylim()
    if not any(np.isfinite(one.y).any() for one in series):
        _say_nothing_finite(axes)
    many = max((len(one.y) for one in series), default=0) > MANY_POINTS
    for k, one in enumerate(series):
        colour, shape = COLOURS[k % len(COLOURS)], SHAPES[k % len(SHAPES)]
        finite = np.isfinite(one.y)
        # On a logarithmic scale 0 stands at the lower edge; a line has a gap where it is infinite.
        y = np.where(finite, np.maximum(one.y, bottom), np.nan)
        # Side by side, so that intervals do not hide each other.
        aside = 0.0 if many else ASIDE * (k - (len(series) - 1) / 2)
        place = offset_copy(axes.transData, axes.get_figure(root=True), aside, 0, "points")
        axes.plot(
            one.x, y, transform=place, color=colour, marker=shape, label=one.label,
            linestyle=DASHES[k % len(DASHES)], zorder=3,
            markersize=3.2 if many else 5, markeredgecolor=PAPER, markeredgewidth=0.4,
        )
        low, high = _inside(one, (bottom, top))
        known = finite & np.isfinite(low) & np.isfinite(high)
        if many:
            axes.fill_between(
                one.x, low, high, where=known, color=colour, alpha=0.2, linewidth=0, zorder=2,
            )
        elif known.any():
            axes.vlines(one.x[known], low[known], high[known], color=colour, linewidth=1,
                        alpha=0.8, zorder=2, transform=place)
        beyond = np.isposinf(one.y)
        axes.plot(
            one.x[beyond], np.full(beyond.sum(), top), linestyle="", marker=shape, color=colour,
            transform=place, clip_on=False,
            markerfacecolor=PAPER, markersize=3 if many else 5, zorder=4,
        )
    _plain(axes.xaxis, logarithmic=logarithmic_x)
    places = np.unique(x)
    if 0 < places.size <= FEW_TICKS:
        axes.set_xticks(places, texts_of(places.tolist()))
    axes.grid(visible=True)
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    _within(axes)
    if len(series) > 1:
        _legend(axes, [one.label for one in series])


def _within(axes: Axes) -> None:
    """Keep the room that is made for labels independent of what is drawn within the axes."""
    for artist in (*axes.lines, *axes.collections):
        artist.set_in_layout(False)


def draw_dots(
    axes: Axes, names: Sequence[str], one: Series, label: str, *, share: bool = False,
    level: float | None = None, marked: NDArray[np.bool_] | None = None,
    ticks: Floats | None = None,
) -> None:
    """Draw a row for each name: a dot and its interval along x; infinite ones at the right edge.

    ``marked`` rows have another colour and shape; ``ticks`` are small upright lines to compare
    with; ``level`` is a dashed line through all rows.
    """
    flat = [one._replace(y=np.asarray(one.y, dtype=np.float64))]
    if ticks is not None:
        flat.append(Series("", one.x, ticks, ticks * np.nan, ticks * np.nan))
    logarithmic, limits = _extent(flat, share=share, level=level)
    axes.set_xscale("log" if logarithmic else "linear")
    axes.set_xlim(*limits)
    rows = np.arange(len(names), dtype=np.float64)
    low, high = _inside(one, limits)
    if not np.isfinite(one.y).any():
        _say_nothing_finite(axes)
    chosen = np.zeros(len(names), dtype=bool) if marked is None else marked
    for mask, colour, shape in ((~chosen, COLOURS[0], "o"), (chosen, COLOURS[1], "D")):
        known = mask & np.isfinite(low) & np.isfinite(high)
        axes.hlines(rows[known], low[known], high[known], color=colour, linewidth=1.3, alpha=0.8)
        finite = mask & np.isfinite(one.y)
        axes.plot(np.clip(one.y[finite], *limits), rows[finite], shape, color=colour,
                  markersize=5.5, markeredgecolor=PAPER, markeredgewidth=0.5, zorder=3)
        beyond = mask & np.isposinf(one.y)
        axes.plot(np.full(beyond.sum(), limits[1]), rows[beyond], shape, color=colour,
                  markerfacecolor=PAPER, markersize=5.5, zorder=3, clip_on=False)
    if ticks is not None:
        axes.plot(ticks, rows, "|", color=INK, markersize=8, zorder=2.5)
    if level is not None:
        axes.axvline(level, color=INK, linewidth=0.9, linestyle=(0, (5, 3)), zorder=1.5)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_yticks(rows, [_short(name) for name in names])
    axes.tick_params(axis="y", length=0)
    if np.isfinite(one.y).any():
        _plain(axes.xaxis, logarithmic=logarithmic, share=share)
    axes.grid(visible=True, axis="x")
    _within(axes)
    axes.set_xlabel(label)


def rows_height(rows: int) -> float:
    """Return the inches that a panel of so many rows needs."""
    return max(1.6, 0.9 + 0.19 * rows)


def draw_map(
    axes: Axes, rows: Sequence[str], columns: Sequence[str], values: Floats,
    labels: tuple[str, str], *, share: bool = False,
) -> None:
    """Draw a map, the first row lowest, with numbers in the cells where there is room.

    Shares are in viridis, from 0 to 100 %; errors in cividis, dark for large, logarithmic where
    they span much. What is not a number has a dash, what is infinite the sign for it.
    """
    shown, norm = 100 * values if share else values, _norm(values, share=share)
    colours = mpl.colormaps["viridis" if share else "cividis_r"]
    finite = np.ma.masked_invalid(shown)
    mesh = axes.pcolormesh(finite, cmap=colours, norm=norm, edgecolors=PAPER, linewidth=0.8)
    few = len(columns) <= NUMBERED_COLUMNS
    for (row, column), value in np.ndenumerate(shown):
        if few or not np.isfinite(value):
            text = f"{value:.0f}" if share and np.isfinite(value) else _brief(value)
            axes.text(
                column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=7.5,
                color=_contrasting(colours, norm, value),
            )
    for axis, names, most, longest in (
        (axes.xaxis, columns, 14, 18), (axes.yaxis, rows, MAX_LABELS, 30)
    ):
        every = math.ceil(len(names) / most)
        axis.set_ticks(np.arange(0, len(names), every) + 0.5,
                       [_short(name, longest) for name in names[::every]])
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
            places = np.geomspace(*norm_limits(norm), 4)
            bar.set_ticks(list(places), labels=[_brief(value) for value in places])


def draw_stack(
    axes: Axes, names: Sequence[str], parts: dict[str, Floats], label: str
) -> None:
    """Draw a bar for each name, its shares upon each other in the order of ``parts``."""
    places = np.arange(len(names), dtype=np.float64)
    below = np.zeros(len(names))
    for part, share in parts.items():
        height = 100 * np.nan_to_num(share)
        axes.bar(places, height, 0.86 if len(names) < 30 else 1.0, below, label=part,
                 color=PART_COLOURS.get(part, FAINT), edgecolor=PAPER, linewidth=0.5)
        below += height
    every = math.ceil(len(names) / 14)
    axes.set_xticks(places[::every], [_short(name, 18) for name in names[::every]])
    if sum(len(name) for name in names[::every]) > LINE_WIDTH_CHARS:
        axes.tick_params(axis="x", rotation=60)
    axes.tick_params(axis="x", length=0)
    axes.set(ylim=(0, 100.001), xlim=(-0.6, max(len(names), 3) - 0.4), ylabel="share, %")
    axes.set_xlabel(label)
    axes.grid(visible=True, axis="y")
    if parts:
        _legend(axes, list(parts))


PART_COLOURS = {
    "solved": FAINT, "wrong_id": COLOURS[1], "rejected": COLOURS[5], "no_candidate": COLOURS[4],
    "solver_failed": COLOURS[3], "not_converged": COLOURS[0], "not_explained": COLOURS[2],
    "failed": INK, "crashed": COLOURS[6],
}


def _legend(axes: Axes, labels: list[str]) -> None:
    """Put the legend above the axes, in as few lines as it needs."""
    widest = max(map(len, labels)) + 6
    columns = max(1, min(len(labels), LINE_WIDTH_CHARS // widest))
    axes.legend(
        loc="lower left", bbox_to_anchor=(-0.02, 1.02), ncols=columns, borderaxespad=0,
        handlelength=2.2, columnspacing=1.1, handletextpad=0.5, labelspacing=0.25, borderpad=0.2,
    )


# Extents and ticks.

def _spans(values: Floats, ratio: float) -> bool:
    """Tell whether values are not below 0, and those above it span more than a ratio."""
    finite = values[np.isfinite(values)]
    positive = finite[finite > 0]
    return bool(positive.size and finite.min() >= 0 and positive.max() > ratio * positive.min())


def _limits(values: Floats, *, logarithmic: bool, margin: float) -> tuple[float, float]:
    finite = values[np.isfinite(values) & ((values > 0) | (not logarithmic))]
    if not finite.size:
        return 0.0, 1.0
    if logarithmic:
        low, high = np.log10(finite.min()), np.log10(finite.max())
        spare = margin * max(high - low, 0.3)
        return 10.0 ** (low - spare), 10.0 ** (high + spare)
    low, high = float(finite.min()), float(finite.max())
    spare = margin * (high - low) or 0.5 * abs(high) or 0.5
    return low - spare, high + spare


def _extent(
    series: Sequence[Series], *, share: bool, level: float | None = None
) -> tuple[bool, tuple[float, float]]:
    """Return whether a scale of values is logarithmic, and its ends."""
    if share:
        return False, (-3.0, 103.0)
    values = np.concatenate([one.y for one in series])
    ends = np.concatenate([one.low for one in series] + [one.high for one in series])
    if level is not None:
        values = np.append(values, level)
    positive = values[np.isfinite(values) & (values > 0)]
    logarithmic = _spans(values, 6)
    if logarithmic:
        # An interval that reaches to 0 or to infinity must not squeeze all the rest.
        held = ends[(ends > positive.min() / 10) & (ends < positive.max() * 10)]
    else:
        held = ends
    everything = np.concatenate([values, held])
    low, high = _limits(everything, logarithmic=logarithmic, margin=0.08)
    if not logarithmic and everything[np.isfinite(everything)].min(initial=0) >= 0:
        low = 0.0
    return logarithmic, (low, high)


def _set_y(axes: Axes, series: Sequence[Series], *, share: bool) -> None:
    logarithmic, limits = _extent(series, share=share)
    axes.set_yscale("log" if logarithmic else "linear")
    axes.set_ylim(*limits)
    _plain(axes.yaxis, logarithmic=logarithmic, share=share)


def _inside(one: Series, limits: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return the ends of intervals, cut off at the edges of the axes.

    An end that is not known beside one that is lies beyond all draws.
    """
    low = np.where(np.isnan(one.low) & ~np.isnan(one.high), -np.inf, one.low)
    high = np.where(np.isnan(one.high) & ~np.isnan(one.low), np.inf, one.high)
    return np.clip(low, *limits), np.clip(high, *limits)


def _say_nothing_finite(axes: Axes) -> None:
    axes.text(0.5, 0.5, "infinite, or nothing to tell", transform=axes.transAxes, ha="center",
              va="center", color=FAINT)


def _plain(axis: Axis, *, logarithmic: bool, share: bool = False) -> None:
    """Give an axis plain numbers at round places."""
    if share:
        axis.set_ticks([0, 25, 50, 75, 100])
    if not logarithmic:
        return
    low, high = axis.get_view_interval()
    subs = (1, 2, 5) if high < 60 * low else (1, 3) if high < 1000 * low else (1,)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_minor_locator(NullLocator())
    formatter: Callable[[float, Any], str] = lambda value, _: f"{value:g}"  # noqa: E731
    axis.set_major_formatter(FuncFormatter(formatter))


def _short(name: str, most: int = 30) -> str:
    return name if len(name) <= most else name[: most - 1] + "\u2026"


# Colours of maps.

def _norm(values: Floats, *, share: bool) -> Normalize:
    if share:
        return Normalize(0, 100)
    finite = values[np.isfinite(values)]
    if _spans(finite, 6):
        return LogNorm(finite[finite > 0].min(), finite.max(), clip=True)
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    return Normalize(min(low, 0.0), high if high > low else low + 1.0)


def norm_limits(norm: Normalize) -> tuple[float, float]:
    """Return the values at the ends of a map's colours."""
    return float(norm.vmin or 0.0), float(norm.vmax or 1.0)


def _brief(value: float) -> str:
    """Return a number as short as it can stand in a cell."""
    if not np.isfinite(value):
        return number(value)
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


def _contrasting(colours: Colormap, norm: Normalize, value: float) -> str:
    """Return black or white, whichever is read better on a cell; ink where there is no colour."""
    if not np.isfinite(value):
        return INK
    red, green, blue = colours(float(norm(value)))[:3]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
              for c in (red, green, blue)]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    # Near black and near white, but not the colours that a page replaces.
    return "#050505" if luminance > 0.18 else "#fefefe"
