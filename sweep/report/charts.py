"""Charts on matplotlib's axes: scales, colours, lines with intervals, maps; as inline SVG."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import Colormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from matplotlib.transforms import offset_copy
from numpy.typing import NDArray

from sweep.report.formatting import brief_number, coordinates, shortened
from sweep.report.output_file import write_output_file
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The colours, shapes and matplotlib settings of all figures, and the colours of the page.

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
"""The palette of Okabe and Ito, distinguishable by the colour-blind; without its yellow, which is
too faint for a line."""

SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
INK, FAINT, RULE, STRIP, PAPER = "#282828", "#7a7a7a", "#e6e6e6", "#f3f3f3", "#ffffff"
"""Text; secondary text and lines; grid lines; shaded areas; background."""

REFERENCE_DASHES = (0, (5, 3))
"""Of lines that mark a reference, such as a bound."""

DASHES: tuple[Any, ...] = (
    "-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)), (0, (8, 3)), (0, (3, 1.5)), "-",
)
"""Of the lines of a figure; the last stands with black."""

MATPLOTLIB_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "sweep",
    "text.parse_math": False,
    "axes.edgecolor": FAINT, "axes.labelcolor": INK, "axes.titlecolor": INK,
    "axes.titlesize": 9.5, "axes.titlelocation": "left", "axes.titleweight": "bold",
    "axes.labelsize": 8.5, "axes.linewidth": 0.7, "axes.axisbelow": True,
    "axes.spines.top": False, "axes.spines.right": False,
    "xtick.labelsize": 8.5, "ytick.labelsize": 8.5, "xtick.color": FAINT, "ytick.color": FAINT,
    "xtick.labelcolor": INK, "ytick.labelcolor": INK,
    "grid.color": RULE, "grid.linewidth": 0.7, "text.color": INK,
    "legend.frameon": False, "legend.fontsize": 8.5, "legend.labelcolor": INK,
    "font.size": 8.5, "lines.linewidth": 1.5, "figure.constrained_layout.use": True,
}
"""Settings of matplotlib in which every panel is drawn."""

THEME: dict[str, tuple[str, str]] = {
    "ink": (INK, "#e4e2dd"), "faint": (FAINT, "#99968f"), "rule": (RULE, "#34363a"),
    "strip": (STRIP, "#26282c"), "paper": (PAPER, "#17181b"),
    "c1": (COLOURS[0], "#4ba3e3"), "c2": (COLOURS[1], "#f08a45"), "c3": (COLOURS[2], "#2fc196"),
    "c4": (COLOURS[3], "#e0a3c6"), "c5": (COLOURS[4], "#8ed0f7"), "c6": (COLOURS[5], "#f2bd4c"),
    "c7": (COLOURS[6], "#ffffff"),
}
"""CSS variable -> its colour on light paper and in dark mode."""


def css_variables(*, dark: bool) -> str:
    """Return the CSS declarations of the colours, on light paper or in dark mode.

    >>> css_variables(dark=False)[:29]
    '--ink: #282828; --faint: #7a7'
    """
    return " ".join(f"--{name}: {colours[dark]};" for name, colours in THEME.items())


# --------------------------------------------------------------------------------------------------
# Scales of charts: whether logarithmic, between which ends, with which ticks and colours.

LOGARITHMIC_FROM = 6
"""Values that span a larger ratio are drawn on a logarithmic scale."""


FLOOR_RATIO = 1e-6
"""Values below this part of the largest are drawn at the lower edge of a logarithmic axis: errors
of rounding would compress all others."""

FLOOR_NOTE = "Errors below a millionth of the largest are drawn at the lower edge."


class Series(NamedTuple):
    """Values (n,) of a line, or of rows of dots, with the ends of their intervals or NaN."""

    label: str
    x: Floats
    y: Floats
    low: Floats
    high: Floats


# Values.

def spans(values: Floats, ratio: float) -> bool:
    """Return whether no value is below 0 and the positive ones span more than a ratio."""
    finite = values[np.isfinite(values)]
    positive = finite[finite > 0]
    return bool(positive.size and finite.min() >= 0 and positive.max() > ratio * positive.min())


def below_floor(values: Floats) -> bool:
    """Return whether any value is too small, or 0, to be drawn at its place beside the largest."""
    finite = values[np.isfinite(values)]
    return bool(finite.size and finite.min() < FLOOR_RATIO * finite.max())


def grow_by_factors(values: Floats) -> bool:
    """Return whether distinct positive values lie more evenly on a logarithmic scale."""
    steps, factors = (np.diff(each) for each in (np.unique(values), np.log(np.unique(values))))
    return bool(np.std(factors) / np.mean(factors) <= np.std(steps) / np.mean(steps))


def is_logarithmic(values: Floats) -> bool:
    """Return whether the values of an axis are drawn on a logarithmic scale."""
    return spans(values, 5) and bool((values > 0).all()) and grow_by_factors(values)


def value_limits(values: Floats, *, logarithmic: bool, margin: float) -> tuple[float, float]:
    """Return the ends of an axis with the finite values on it, and a margin (share of its length).

    On a logarithmic axis, values that are not positive are left out.
    """
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


def value_scale(
    series: Sequence[Series], *, share: bool, level: float | None = None
) -> tuple[bool, tuple[float, float]]:
    """Return whether the axis of a chart's values is logarithmic, and its ends.

    Parameters
    ----------
    series
        Values with their intervals.
    share
        Whether the values are shares in percent, whose axis is always the same.
    level
        A reference that must lie on the axis, too; with 0 the axis is linear.
    """
    if share:
        return False, (-3.0, 103.0)
    values = np.concatenate([line.y for line in series])
    ends = np.concatenate([line.low for line in series] + [line.high for line in series])
    if level is not None:
        values = np.append(values, level)
    positive = values[np.isfinite(values) & (values > 0)]
    logarithmic = spans(values, LOGARITHMIC_FROM) and (level is None or level > 0)
    if logarithmic:
        values = values[values >= FLOOR_RATIO * positive.max()]
        # Long intervals are cut off, so that they do not compress everything else.
        lowest = max(positive.min(), FLOOR_RATIO * positive.max())
        held = ends[(ends > lowest / 10) & (ends < positive.max() * 10)]
    else:
        held = ends
    everything = np.concatenate([values, held])
    low, high = value_limits(everything, logarithmic=logarithmic, margin=0.08)
    if not logarithmic and everything[np.isfinite(everything)].min(initial=0) >= 0:
        low = 0.0
    return logarithmic, (low, high)


def clipped_intervals(line: Series, limits: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return the ends (n,) and (n,) of intervals, clipped to the ends of the axis.

    If only one end is known, the other lies beyond all draws: it is clipped, too.
    """
    low = np.where(np.isnan(line.low) & ~np.isnan(line.high), -np.inf, line.low)
    high = np.where(np.isnan(line.high) & ~np.isnan(line.low), np.inf, line.high)
    return np.clip(low, *limits), np.clip(high, *limits)


def plain_ticks(axis: Axis, *, logarithmic: bool, share: bool = False) -> None:
    """Give an axis few ticks at round values, written without powers of ten."""
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


# Colours of maps.

def colour_scale(values: Floats, *, share: bool) -> Normalize:
    """Return the scale of a map's colours; ``share``: values are shown from 0 to 100 %."""
    if share:
        return Normalize(0, 100)
    finite = values[np.isfinite(values)]
    if spans(finite, LOGARITHMIC_FROM):
        return LogNorm(finite[finite > 0].min(), finite.max(), clip=True)
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    return Normalize(min(low, 0.0), high if high > low else low + 1.0)


def colour_ends(norm: Normalize) -> tuple[float, float]:
    """Return the values at the two ends of a colour scale."""
    return float(norm.vmin or 0.0), float(norm.vmax or 1.0)


def readable_on(colours: Colormap, norm: Normalize, value: float) -> str:
    """Return black or white, whichever has more contrast with a cell; ink on an empty cell.

    The luminance is that of sRGB (IEC 61966-2-1).
    """
    if not np.isfinite(value):
        return INK
    red, green, blue = colours(float(norm(value)))[:3]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4
              for c in (red, green, blue)]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    # Near black and near white: black and white themselves are replaced on a page.
    return "#050505" if luminance > 0.18 else "#fefefe"


# --------------------------------------------------------------------------------------------------
# Panels of figures as inline SVG, whose colours the page chooses, and as files.
#
# A panel is drawn once, in the colours of light paper. On a page these are replaced by the page's
# CSS variables, so that one drawing serves light, dark and print; files keep them.

WIDTH, HEIGHT = 4.4, 3.2
"""Inches of a panel; a wide panel has twice the width."""

COLUMNS = 2
DOTS_PER_INCH = 150

_VARIABLES = {light.lower(): f"var(--{name})" for name, (light, _) in THEME.items()}


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel of a figure.

    Attributes
    ----------
    title
        Stands above it.
    alt
        Its content in words, for readers who cannot see it.
    draw
        Draws it on empty axes.
    wide
        Whether it takes the whole width of the page.
    height
        In inches.
    """

    title: str
    alt: str
    draw: Callable[[Axes], None]
    wide: bool = False
    height: float = HEIGHT


def panel_svg(panel: Panel, prefix: str) -> Markup:
    """Return a panel as inline SVG; ``prefix`` makes its identifiers unique on the page."""
    with mpl.rc_context(MATPLOTLIB_STYLE):
        figure = Figure((2 * WIDTH if panel.wide else WIDTH, panel.height))
        _draw(panel, figure.add_subplot())
        return inline_svg(_svg(figure), panel.alt, prefix)


def write_figure(panels: Sequence[Panel], path: Path) -> None:
    """Write a figure of all panels into a file that a user asked for: PNG or SVG."""
    write_output_file(path, panels_file(panels, path.suffix.lower()))


def panels_file(panels: Sequence[Panel], suffix: str) -> bytes:
    """Return a figure of all panels as the content of a file: ".svg" or ".png"."""
    columns = 1 if any(panel.wide for panel in panels) else min(len(panels), COLUMNS)
    rows = math.ceil(len(panels) / columns)
    heights = [
        max(panel.height for panel in panels[row * columns : (row + 1) * columns])
        for row in range(rows)
    ]
    width = columns * WIDTH * (2 if any(panel.wide for panel in panels) else 1)
    with mpl.rc_context(MATPLOTLIB_STYLE):
        figure = Figure((width, sum(heights)))
        grid = figure.add_gridspec(rows, columns, height_ratios=heights)
        for k, panel in enumerate(panels):
            _draw(panel, figure.add_subplot(grid[k // columns, k % columns]))
        encoded = io.BytesIO()
        metadata = {"Date": None} if suffix == ".svg" else {}
        figure.savefig(encoded, format=suffix[1:], metadata=metadata, dpi=DOTS_PER_INCH)
        return encoded.getvalue()


def _draw(panel: Panel, axes: Axes) -> None:
    panel.draw(axes)
    axes.set_title(panel.title, pad=6 + _legend_height(axes))


def _legend_height(axes: Axes) -> float:
    """Return the height in points of a legend between the axes and the title."""
    legend = axes.get_legend()
    if legend is None:
        return 0.0
    entries, columns = len(legend.get_texts()), int(getattr(legend, "_ncols", 1))
    return 8 + 12.5 * math.ceil(entries / columns)


def _svg(figure: Figure) -> str:
    encoded = io.StringIO()
    metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(encoded, format="svg", transparent=True, metadata=metadata)
    return encoded.getvalue()


def inline_svg(svg: str, alt: str, prefix: str) -> Markup:
    """Return matplotlib's SVG as a self-contained part of a page.

    ``alt`` is the drawing in words; ``prefix`` makes its identifiers unique on the page.
    """
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", svg, flags=re.DOTALL)
    svg = svg.replace("xlink:href", "href")
    # Nothing leaves its axes, and clip paths are large.
    svg = re.sub(r'\s*clip-path="url\(#[^"]*\)"', "", svg)
    svg = re.sub(r"<defs>\s*<clipPath.*?</defs>", "", svg, flags=re.DOTALL)
    svg = _with_theme(_with_prefix(svg, prefix))
    # Hundredths of a point are enough.
    svg = re.sub(
        r'\bd="[^"]*"', lambda match: re.sub(r"(\.\d\d)\d+", r"\1", match[0]), svg)
    svg = re.sub(r"\n\s*", "\n", svg)
    box = re.search(r'viewBox="[^"]*"', svg)
    opening = Markup(
        '<svg role="img" aria-label="{}" {} preserveAspectRatio="xMidYMid meet">'
    ).format(alt, Markup(box[0] if box else ""))  # noqa: S704  (matplotlib's)
    return opening + Markup(svg[svg.index(">") + 1 :])  # noqa: S704


def _with_prefix(svg: str, prefix: str) -> str:
    """Return SVG whose identifiers, and the references to them, begin with ``prefix``."""
    svg = re.sub(r'\bid="([^"]*)"', rf'id="{prefix}-\1"', svg)
    svg = re.sub(r'href="#([^"]*)"', rf'href="#{prefix}-\1"', svg)
    return re.sub(r"url\(#([^)]*)\)", rf"url(#{prefix}-\1)", svg)


def _with_theme(svg: str) -> str:
    """Return SVG with the page's font and CSS variables in place of matplotlib's."""
    svg = re.sub(r"font: ([\d.a-z ]*?)'[^;\"]*", r"font: \1var(--sans)", svg)
    svg = re.sub(r"font-family: [^;\"]*", "font-family: var(--sans)", svg)
    return re.sub(
        r"((?:fill|stroke|stop-color):\s*)(#[0-9a-fA-F]{6})",
        lambda match: match[1] + _VARIABLES.get(match[2].lower(), match[2]), svg,
    )


# --------------------------------------------------------------------------------------------------
# Charts on matplotlib's axes: lines, dots with intervals, maps with numbers, stacked bars.
#
# Lines differ in colour, marker and dash at once, so that the colour-blind, and readers of a
# black and white print, can distinguish them.

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
    level: float | None = None, linear: bool = False,
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
    linear
        Whether x is linear in any case.
    """
    x = np.concatenate([line.x for line in series])
    logarithmic_x = not linear and is_logarithmic(x)
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
        legend_above(axes, [line.label for line in series])


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
    norm = colour_scale(values, share=share)
    colours = mpl.colormaps["viridis" if share else "cividis_r"]
    finite = np.ma.masked_invalid(values)
    mesh = axes.pcolormesh(finite, cmap=colours, norm=norm, edgecolors=PAPER, linewidth=0.8)
    few = len(columns) <= NUMBERED_COLUMNS
    for (row, column), value in np.ndenumerate(values):
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


def draw_points(
    axes: Axes, names: Sequence[str], x: Series, y: Series, labels: tuple[str, str], *,
    marked: NDArray[np.bool_], level: float | None = None, limit: float | None = None,
) -> None:
    """Draw numbered points with intervals along both axes, which are logarithmic.

    Parameters
    ----------
    names
        (n,) of the points, which are numbered from 1.
    x, y
        (n,) values; points whose y is infinite or NaN stand open at the upper edge.
    labels
        Of the x and the y axis.
    marked
        (n,) points that are filled, named, and joined by steps, such as a Pareto front.
    level
        y of a dashed line.
    limit
        x of a dotted line, beyond which the panel is shaded.
    """
    known = [values[np.isfinite(values) & (values > 0)] for values in (
        x.y, np.append(y.y, np.nan if level is None else level))]
    (left, right), (bottom, top) = (
        value_limits(values, logarithmic=True, margin=0.15) if values.size else (0.1, 1.0)
        for values in known)
    axes.set(xscale="log", yscale="log", xlim=(left, right), ylim=(bottom, top))
    if not known[1].size:
        _note_nothing_finite(axes)
    for k in np.flatnonzero(np.isfinite(x.y) & (x.y > 0)).tolist():
        finite = bool(np.isfinite(y.y[k]) and y.y[k] > 0)
        at, colour = (y.y[k] if finite else top), COLOURS[k % len(COLOURS)]
        axes.plot(x.y[k], at, SHAPES[k % len(SHAPES)], color=colour, clip_on=finite,
                  markersize=7 if marked[k] else 5, zorder=3 + marked[k],
                  markerfacecolor=colour if marked[k] else PAPER)
        for line, draw in ((x, axes.hlines), (y, axes.vlines)):
            ends = clipped_intervals(line, (left, right) if line is x else (bottom, top))
            if finite and np.isfinite(line.low[k]) and np.isfinite(line.high[k]):
                draw(at if line is x else x.y[k], ends[0][k], ends[1][k], color=colour,
                     linewidth=0.9, alpha=0.6, zorder=2)
        axes.annotate(f"{k + 1} {names[k]}" if marked[k] else f"{k + 1}", (x.y[k], at),
                      (5, 4 if k % 2 else -11), textcoords="offset points", fontsize=8,
                      color=INK if marked[k] else FAINT)
    front = np.flatnonzero(marked)[np.argsort(x.y[marked])]
    if front.size:
        axes.step([*x.y[front], right], [*y.y[front], y.y[front[-1]]], where="post", color=FAINT,
                  linewidth=1.1, zorder=1.5)
    if level is not None:
        axes.axhline(level, color=INK, linewidth=0.9, linestyle=REFERENCE_DASHES, zorder=1.5)
    if limit is not None and left < limit < right:
        axes.axvspan(limit, right, color=STRIP, linewidth=0, zorder=0.5)
        axes.axvline(limit, color=COLOURS[1], linewidth=1.3, linestyle=DASHES[2], zorder=1.6)
    for axis in (axes.xaxis, axes.yaxis):
        plain_ticks(axis, logarithmic=True)
    axes.grid(visible=True)
    _exclude_from_layout(axes)
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])


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
        legend_above(axes, list(parts))


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


def legend_above(axes: Axes, labels: Sequence[str]) -> None:
    """Put the legend above the axes, in as few lines as the labels need."""
    columns = max(1, min(len(labels), LINE_WIDTH_CHARS // (max(map(len, labels)) + 6)))
    axes.legend(
        loc="lower left", bbox_to_anchor=(-0.02, 1.02), ncols=columns, borderaxespad=0,
        handlelength=2.2, columnspacing=1.1, handletextpad=0.5, labelspacing=0.25, borderpad=0.2,
    )


def _note_nothing_finite(axes: Axes) -> None:
    axes.text(0.5, 0.5, "no finite values", transform=axes.transAxes, ha="center",
              va="center", color=FAINT)
