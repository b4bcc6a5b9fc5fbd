"""A figure: a table drawn as lines along a numeric column, or as dots with a row for each name.

Lines differ in colour, marker and dash at once, so that the colour-blind, and readers of a black
and white print, can distinguish them. A panel is drawn once, in the colours of light paper. On a
page these are replaced by the page's CSS variables, so that one drawing serves light, dark and
print; files keep them.
"""

from __future__ import annotations

import io
import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from matplotlib.transforms import offset_copy

from sweep.report.output_file import write_output_file
from sweep.report.table import Bin, Column, Coordinate, Table, Value, cell_text, coordinates
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The colours, shapes and matplotlib settings of all figures, and the colours of the page.

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
"""The palette of Okabe and Ito, distinguishable by the colour-blind; without its yellow, which is
too faint for a line."""

SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
INK, FAINT, RULE, STRIP, PAPER = "#282828", "#7a7a7a", "#e6e6e6", "#f3f3f3", "#ffffff"
"""Text; secondary text and lines; grid lines; shaded areas; background."""

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

_VARIABLES = {light.lower(): f"var(--{name})" for name, (light, _) in THEME.items()}


def css_variables(*, dark: bool) -> str:
    """Return the CSS declarations of the colours, on light paper or in dark mode.

    >>> css_variables(dark=False)[:29]
    '--ink: #282828; --faint: #7a7'
    """
    return " ".join(f"--{name}: {colours[dark]};" for name, colours in THEME.items())


# --------------------------------------------------------------------------------------------------
# A figure, and the panels that its table gives.

WIDTH, HEIGHT = 4.4, 3.2
"""Inches of a panel; a wide panel has twice the width."""

COLUMNS = 2
DOTS_PER_INCH = 150

WIDE_FROM = 8
"""A panel alone takes the whole width if it has more groups along x."""

MAX_LINES, MAX_PANELS, MAX_DOTS = 7, 4, 40
"""Lines of a panel, panels of a column, and rows of dots."""


class Panel(NamedTuple):
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


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure, drawn from its table.

    Attributes
    ----------
    name
        Its anchor on the page, and the name of its files.
    title, caption
        Text above and below it.
    table
        The numbers that it shows; the columns that name a row say to which line and panel it
        belongs.
    curves
        Columns that are drawn, a panel or more for each.
    x
        Column along which they are drawn. If it is empty, or holds names, each row of the table is
        a row of dots.
    by
        Column whose values have a line each; the other columns that name a row tell panels apart.
    shown
        Values of the columns that are drawn (default: all).
    marked
        Column whose rows that say yes are drawn as diamonds.
    labels
        Column whose texts stand beside the points of lines.
    covers
        Axes that need no figure of their own beside this one.
    """

    name: str
    title: str
    caption: str
    table: Table
    curves: Sequence[Column]
    x: str = ""
    by: str = ""
    shown: Sequence[str] = ()
    marked: str = ""
    labels: str = ""
    covers: Sequence[str] = ()

    @property
    def panels(self) -> list[Panel]:
        """Its drawings."""
        curves = [each for each in self.curves if each.heading in self.table.headings]
        rows: Sequence[int] = range(len(self.table.frame))
        if self.shown:
            rows_of = [{cell_text(cell) for cell in row} for row in
                       self.table.frame.iloc[:, : self.table.stub].to_numpy().tolist()]
            rows = [k for k in rows if rows_of[k] & set(self.shown)]
        x = [self.table.column(self.x)[k] for k in rows] if self.x else []
        if not x or any(isinstance(cell, str) for cell in x):
            return [self._dots(curve, rows[:MAX_DOTS]) for curve in curves]
        others = [name for name in self.table.headings[: self.table.stub]
                  if name not in (self.x, self.by, self.labels)]
        parts: dict[str, list[int]] = {}
        for k in rows:
            cells = self.table.frame.iloc[k]
            words = ", ".join(_named(name, cells[name]) for name in others)
            parts.setdefault(words, []).append(k)
        chosen = dict(itertools.islice(parts.items(), MAX_PANELS))
        alone = len(curves) * len(chosen) == 1
        return [self._lines(curve, words, part, alone=alone)
                for curve in curves for words, part in chosen.items()]

    def _lines(self, curve: Column, words: str, part: Sequence[int], *, alone: bool) -> Panel:
        cells = self.table.frame.iloc[list(part)]
        x = np.array([position(cell) for cell in cells[self.x]])
        groups: dict[str, list[int]] = {}
        for k in range(len(part)):
            name = _named(self.by, cells[self.by].iloc[k]) if self.by else ""
            groups.setdefault(name, []).append(k)
        lines = []
        for name, members in itertools.islice(groups.items(), MAX_LINES):
            order = sorted(members, key=lambda k: x[k])
            values = [value_of(cells[curve.heading].iloc[k]) for k in order]
            known = [k for k, value in zip(order, values, strict=True)
                     if not math.isnan(value.value)]
            y, low, high = np.array(
                [each for each in values if not math.isnan(each.value)]).reshape(-1, 3).T
            texts = [cell_text(cells[self.labels].iloc[k]) for k in known] if self.labels else []
            lines.append(Series(name, x[known], y, low, high, texts))
        title = heading_title(curve.heading) + (f", {words}" if words else "")
        return Panel(
            title, f"Lines of {curve.heading} against {self.x}{f', {words}' if words else ''}.",
            lambda axes: draw_lines(axes, lines, (self.x, curve.heading), share=curve.share,
                                    level=curve.level),
            wide=alone and np.unique(x).size > WIDE_FROM)

    def _dots(self, curve: Column, rows: Sequence[int]) -> Panel:
        cells = self.table.frame.iloc[list(rows)]
        stub = cells.iloc[:, : self.table.stub]
        names = [", ".join(map(cell_text, row)) for row in stub.to_numpy().tolist()]
        values = np.array([value_of(cell) for cell in cells[curve.heading]]).reshape(-1, 3)
        marked = np.array([cell_text(cell) == "yes" for cell in cells[self.marked]]
                          if self.marked else [False] * len(names), dtype=bool)
        return Panel(
            heading_title(curve.heading), f"Rows of {curve.heading} for each name.",
            lambda axes: draw_dots(axes, names, Series("", values[:, 0], *values.T), curve.heading,
                                   share=curve.share, level=curve.level, marked=marked),
            height=max(1.6, 0.9 + 0.19 * len(names)))


class Series(NamedTuple):
    """Values (n,) of a line, or of rows of dots, with the ends of their intervals or NaN."""

    label: str
    x: Floats
    y: Floats
    low: Floats
    high: Floats
    texts: Sequence[str] = ()


def position(cell: Any) -> float:
    """Return the place of a cell on a numeric axis: its value, or the middle of a bin."""
    if isinstance(cell, Bin):
        return cell.middle
    return float(cell.value if isinstance(cell, Coordinate | Value) else cell)


def value_of(cell: Any) -> Value:
    """Return a number of a table with its interval."""
    return cell if isinstance(cell, Value) else Value(math.nan if cell is None else float(cell))


def heading_title(heading: str) -> str:
    """Return a column's heading as the title of a panel: its words, without the unit."""
    words = heading.rpartition(", ")[0] or heading
    return words[:1].upper() + words[1:]


def _named(heading: str, cell: Any) -> str:
    """Return a cell as the name of a line or panel: numbers with their column's words."""
    text = cell_text(cell)
    if isinstance(cell, str):
        return text
    words, _, unit = heading.rpartition(", ")
    return f"{words} {text}\u00b0" if unit == "deg" else f"{words or heading} {text}"


def panel_svg(panel: Panel, prefix: str) -> Markup:
    """Return a panel as inline SVG; ``prefix`` makes its identifiers unique on the page."""
    encoded = io.StringIO()
    with mpl.rc_context(MATPLOTLIB_STYLE):
        canvas = Canvas((2 * WIDTH if panel.wide else WIDTH, panel.height))
        _draw(panel, canvas.add_subplot())
        metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        canvas.savefig(encoded, format="svg", transparent=True, metadata=metadata)
    return inline_svg(encoded.getvalue(), panel.alt, prefix)


def write_figure(figures: Sequence[Figure], path: Path) -> None:
    """Write the panels of figures into a file that a user asked for: PNG or SVG."""
    panels = [panel for figure in figures for panel in figure.panels]
    write_output_file(path, panels_file(panels, path.suffix.lower()))


def panels_file(panels: Sequence[Panel], suffix: str) -> bytes:
    """Return a picture of all panels as the content of a file: ".svg" or ".png"."""
    wide = any(panel.wide for panel in panels)
    columns = 1 if wide else min(len(panels), COLUMNS)
    rows = [panels[k : k + columns] for k in range(0, len(panels), columns)]
    heights = [max(panel.height for panel in row) for row in rows]
    with mpl.rc_context(MATPLOTLIB_STYLE):
        canvas = Canvas((columns * WIDTH * (2 if wide else 1), sum(heights)))
        grid = canvas.add_gridspec(len(rows), columns, height_ratios=heights)
        for k, panel in enumerate(panels):
            _draw(panel, canvas.add_subplot(grid[k // columns, k % columns]))
        encoded = io.BytesIO()
        metadata = {"Date": None} if suffix == ".svg" else {}
        canvas.savefig(encoded, format=suffix[1:], metadata=metadata, dpi=DOTS_PER_INCH)
    return encoded.getvalue()


def _draw(panel: Panel, axes: Axes) -> None:
    panel.draw(axes)
    legend = axes.get_legend()
    lines = 0 if legend is None else math.ceil(
        len(legend.get_texts()) / int(getattr(legend, "_ncols", 1)))
    axes.set_title(panel.title, pad=6 + (6 + 11.5 * lines if lines else 0))


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
    # Identifiers begin with the prefix; font and colours are the page's.
    svg = re.sub(r'\bid="([^"]*)"', rf'id="{prefix}-\1"', svg)
    svg = re.sub(r'href="#([^"]*)"', rf'href="#{prefix}-\1"', svg)
    svg = re.sub(r"url\(#([^)]*)\)", rf"url(#{prefix}-\1)", svg)
    svg = re.sub(r"font: ([\d.a-z ]*?)'[^;\"]*", r"font: \1var(--sans)", svg)
    svg = re.sub(r"font-family: [^;\"]*", "font-family: var(--sans)", svg)
    svg = re.sub(
        r"((?:fill|stroke|stop-color):\s*)(#[0-9a-fA-F]{6})",
        lambda match: match[1] + _VARIABLES.get(match[2].lower(), match[2]), svg)
    # Hundredths of a point are enough.
    svg = re.sub(
        r'\bd="[^"]*"', lambda match: re.sub(r"(\.\d\d)\d+", r"\1", match[0]), svg)
    svg = re.sub(r"\n\s*", "\n", svg)
    box = re.search(r'viewBox="[^"]*"', svg)
    opening = Markup(
        '<svg role="img" aria-label="{}" {} preserveAspectRatio="xMidYMid meet">'
    ).format(alt, Markup(box[0] if box else ""))  # noqa: S704  (matplotlib's)
    return opening + Markup(svg[svg.index(">") + 1 :])  # noqa: S704


# --------------------------------------------------------------------------------------------------
# Scales of charts: whether logarithmic, between which ends, with which ticks.

LOGARITHMIC_FROM = 6
"""Values that span a larger ratio are drawn on a logarithmic scale."""

FLOOR_RATIO = 1e-6
"""Values below this part of the largest are drawn at the lower edge of a logarithmic axis: errors
of rounding would compress all others."""


def spans(values: Floats, ratio: float) -> bool:
    """Return whether no value is below 0 and the positive ones span more than a ratio."""
    finite = values[np.isfinite(values)]
    positive = finite[finite > 0]
    return bool(positive.size and finite.min() >= 0 and positive.max() > ratio * positive.min())


def is_logarithmic(values: Floats) -> bool:
    """Return whether an axis is logarithmic: its values lie more evenly on such a scale."""
    if not (spans(values, 5) and (values > 0).all()):
        return False
    steps, factors = (np.diff(each) for each in (np.unique(values), np.log(np.unique(values))))
    return bool(np.std(factors) / np.mean(factors) <= np.std(steps) / np.mean(steps))


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
    values = np.concatenate([line.y for line in series] + [[] if level is None else [level]])
    ends = np.concatenate([end for line in series for end in (line.low, line.high)])
    logarithmic = spans(values, LOGARITHMIC_FROM) and (level is None or level > 0)
    if logarithmic:
        positive = values[np.isfinite(values) & (values > 0)]
        lowest = max(positive.min(), FLOOR_RATIO * positive.max())
        values = values[values >= lowest]
        # Long intervals are cut off, so that they do not compress everything else.
        ends = ends[(ends > lowest / 10) & (ends < positive.max() * 10)]
    everything = np.concatenate([values, ends])
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


# --------------------------------------------------------------------------------------------------
# Charts on matplotlib's axes: lines, and dots with intervals.

MANY_POINTS = 18
"""A line of more points has a band in place of bars for its intervals."""

DODGE = 2.2
"""Points by which neighbouring lines are shifted, so that their intervals do not overlap."""

LINE_WIDTH_CHARS = 62
"""Characters of a legend's line across a panel."""

MAX_OWN_TICKS = 7
"""Up to this many values of an axis have ticks of their own."""

MAX_NAMED = 8
"""Up to this many points that are not on the front have their names beside them."""

ROW_LABEL_CHARS = 30
REFERENCE: dict[str, Any] = {
    "color": INK, "linewidth": 0.9, "linestyle": (0, (5, 3)), "zorder": 1.5}
"""A line that marks a reference, such as a bound."""


NAME_PT = 8
"""Size of the names beside points; a letter is about 0.6 of it wide."""


def _told(line: Series) -> str:
    """Return what the legend says: of points with names, whether they are "on the front"."""
    if line.texts and line.label.endswith((" yes", " no")):
        words, _, answer = line.label.rpartition(" ")
        return words if answer == "yes" else f"not {words}"
    return line.label


def _name_points(axes: Axes, named: Sequence[tuple[float, float, str]]) -> None:
    """Write names beside points, below or above, as near as other names leave room."""
    written: list[tuple[float, float, float]] = []  # left end, right end, base line in points
    scale = 72 / axes.figure.dpi
    floor = axes.transAxes.transform((0, 0))[1] * scale
    for x, y, text in named:
        left, base = axes.transData.transform((x, y)) * scale + (5, 0)
        right = left + 0.6 * NAME_PT * len(text)
        offset = next(
            (each for each in (-11, 4, -22, 15, -33, 26)
             # The layout, which comes later, takes some of the height for legend and labels.
             if base + each > floor and all(
                 right < start or end < left or abs(base + each - line) > 1.6 * NAME_PT
                 for start, end, line in written)), 4)
        written.append((left, right, base + offset))
        axes.annotate(text, (x, y), (5, offset), textcoords="offset points", fontsize=NAME_PT,
                      color=INK)


def draw_lines(
    axes: Axes, series: Sequence[Series], labels: tuple[str, str], *, share: bool = False,
    level: float | None = None,
) -> None:
    """Draw lines with their intervals; infinite values stand at the upper edge.

    Parameters
    ----------
    series
        Values (n,) with their intervals, a line each; those with texts are points with names, of
        which those on a front ("yes") are joined by steps.
    labels
        Of the x and the y axis.
    share
        Whether y is a share, drawn from 0 to 100 %.
    level
        y of a dashed line, such as the 0 of signed errors.
    """
    x = np.concatenate([line.x for line in series])
    logarithmic_x = is_logarithmic(x)
    axes.set_xscale("log" if logarithmic_x else "linear")
    axes.set_xlim(*value_limits(x, logarithmic=logarithmic_x, margin=0.05))
    logarithmic_y, (bottom, top) = value_scale(series, share=share, level=level)
    axes.set_yscale("log" if logarithmic_y else "linear")
    axes.set_ylim(bottom, top)
    plain_ticks(axes.yaxis, logarithmic=logarithmic_y, share=share)
    many = max((len(line.y) for line in series), default=0) > MANY_POINTS
    named: list[tuple[float, float, str]] = []
    for k, line in enumerate(series):
        colour, shape = COLOURS[k % len(COLOURS)], SHAPES[k % len(SHAPES)]
        finite, front = np.isfinite(line.y), line.label.endswith(" yes")
        # On a logarithmic scale 0 is drawn at the lower edge; infinite values are gaps.
        y = np.where(finite, np.maximum(line.y, bottom), np.nan)
        shift = 0.0 if many or line.texts else DODGE * (k - (len(series) - 1) / 2)
        dodged = offset_copy(axes.transData, axes.get_figure(root=True), shift, 0, "points")
        axes.plot(
            line.x, y, transform=dodged, color=colour, marker=shape, label=_told(line), zorder=3,
            linestyle=DASHES[k % len(DASHES)] if front or not line.texts else "",
            markersize=3.2 if many else 5, markeredgecolor=PAPER, markeredgewidth=0.4,
            drawstyle="steps-post" if line.texts else "default")
        low, high = clipped_intervals(line, (bottom, top))
        known = finite & np.isfinite(low) & np.isfinite(high)
        if many:
            axes.fill_between(
                line.x, low, high, where=known, color=colour, alpha=0.2, linewidth=0, zorder=2)
        elif known.any():
            axes.vlines(line.x[known], low[known], high[known], color=colour, linewidth=1,
                        alpha=0.8, zorder=2, transform=dodged)
        beyond = np.isposinf(line.y)
        axes.plot(
            line.x[beyond], np.full(beyond.sum(), top), linestyle="", marker=shape, color=colour,
            transform=dodged, clip_on=False,
            markerfacecolor=PAPER, markersize=3 if many else 5, zorder=4)
        if front or len(line.texts) <= MAX_NAMED:
            named += zip(line.x, np.where(finite, y, top), line.texts, strict=False)
    if level is not None:
        axes.axhline(level, **REFERENCE)
    plain_ticks(axes.xaxis, logarithmic=logarithmic_x)
    values = np.unique(x)
    if 0 < values.size <= MAX_OWN_TICKS and not any(line.texts for line in series):
        axes.set_xticks(values, coordinates(values.tolist()))
    _name_points(axes, named)
    axes.grid(visible=True)
    axes.set(xlabel=labels[0], ylabel=labels[1])
    _finish(axes, any(np.isfinite(line.y).any() for line in series))
    if len(series) > 1:
        names = [_told(line) for line in series]
        columns = max(1, min(len(names), LINE_WIDTH_CHARS // (max(map(len, names)) + 6)))
        axes.legend(
            loc="lower left", bbox_to_anchor=(-0.02, 1.02), ncols=columns, borderaxespad=0,
            handlelength=2.2, columnspacing=1.1, handletextpad=0.5, labelspacing=0.25,
            borderpad=0.2)


def draw_dots(
    axes: Axes, names: Sequence[str], dots: Series, label: str, *, share: bool = False,
    level: float | None = None, marked: Sequence[bool] | np.ndarray[Any, Any] = (),
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
    """
    logarithmic, limits = value_scale([dots], share=share, level=level)
    axes.set_xscale("log" if logarithmic else "linear")
    axes.set_xlim(*limits)
    rows = np.arange(len(names), dtype=np.float64)
    low, high = clipped_intervals(dots, limits)
    finite = np.isfinite(dots.y)
    chosen = np.asarray(marked, dtype=bool) if len(marked) else np.zeros(len(names), dtype=bool)
    for mask, colour, shape in ((~chosen, COLOURS[0], "o"), (chosen, COLOURS[1], "D")):
        known = mask & np.isfinite(low) & np.isfinite(high)
        axes.hlines(rows[known], low[known], high[known], color=colour, linewidth=1.3, alpha=0.8)
        axes.plot(np.clip(dots.y[mask & finite], *limits), rows[mask & finite], shape,
                  color=colour, markersize=5.5, markeredgecolor=PAPER, markeredgewidth=0.5,
                  zorder=3)
        beyond = mask & np.isposinf(dots.y)
        axes.plot(np.full(beyond.sum(), limits[1]), rows[beyond], shape, color=colour,
                  markerfacecolor=PAPER, markersize=5.5, zorder=3, clip_on=False)
    if level is not None:
        axes.axvline(level, **REFERENCE)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_yticks(rows, [
        name if len(name) <= ROW_LABEL_CHARS else name[: ROW_LABEL_CHARS - 1] + "\u2026"
        for name in names])
    axes.tick_params(axis="y", length=0)
    if finite.any():
        plain_ticks(axes.xaxis, logarithmic=logarithmic, share=share)
    axes.grid(visible=True, axis="x")
    axes.set_xlabel(label)
    _finish(axes, bool(finite.any()))


def _finish(axes: Axes, any_finite: bool) -> None:
    """Say where there is nothing to draw; lay out the labels alone, not what is drawn within."""
    if not any_finite:
        axes.text(0.5, 0.5, "no finite values", transform=axes.transAxes, ha="center",
                  va="center", color=FAINT)
    for artist in (*axes.lines, *axes.collections):
        artist.set_in_layout(False)
