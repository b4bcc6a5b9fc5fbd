"""A figure: a table drawn as lines along a numeric column, or as dots with a row for each name.

Lines differ in colour, marker and dash at once, so that the colour-blind, and readers of a black
and white print, can distinguish them.
"""

from __future__ import annotations

import io
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import LogLocator, NullLocator
from matplotlib.transforms import offset_copy

from sweep.report.output_file import write_output_file
from sweep.report.table import Bin, Column, Table, Value, cell_text, coordinate, coordinates
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The colours, shapes and matplotlib settings of all figures.

#: The palette of Okabe and Ito, distinguishable by the colour-blind; without its yellow, which is
#: too faint for a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")

SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
#: Text and lines; background.
INK, PAPER = "#282828", "#ffffff"

DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))

#: Settings of matplotlib in which every panel is drawn, whatever the user's own are.
STYLE = Path(__file__).parent / "templates" / "figure.mplstyle"

#: Inches of a panel, and of a line of its legend.
WIDTH, HEIGHT, LINE_HEIGHT = 4.4, 3.2, 0.15

COLUMNS = 2
DOTS_PER_INCH = 150

#: Lines of a panel, panels of a column, and rows of dots.
MAX_LINES, MAX_PANELS, MAX_DOTS = 7, 4, 40

#: Points by which neighbouring lines are shifted, so that their intervals do not overlap.
DODGE = 2.2

#: Characters of a legend's line across a panel, and of the name of a row.
LEGEND_CHARS, ROW_CHARS = 62, 30

#: Up to this many values of an axis have ticks of their own.
MAX_OWN_TICKS = 7

#: Up to this many points that are not on the front have their names beside them.
MAX_NAMED = 8

#: Size of the names beside points.
NAME_PT = 8

#: Ends of an axis of shares, %.
SHARES = (-3.0, 103.0)

#: A line that marks a reference, such as a bound.
REFERENCE: dict[str, Any] = {
    "color": INK, "linewidth": 0.9, "linestyle": (0, (5, 3)), "zorder": 1.5}


# --------------------------------------------------------------------------------------------------
# A figure, and the panels that its table gives.


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
        Rows of dots differ by it if it names no row.
    labels
        Column whose texts stand beside points; those are joined of which ``by`` says yes.
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
    labels: str = ""
    covers: Sequence[str] = ()

    @property
    def panels(self) -> list[Panel]:
        """Its drawings with a finite value; if there is none, the first."""
        curves = [each for each in self.curves if each.heading in self.table.headings]
        stub = self.table.headings[: self.table.stub]
        rows, x, names = self.table.frame.to_dict("records"), self.x, []
        apart = [name for name in stub if name not in (x, self.by, self.labels)]
        by = [self.by] if self.by else []
        if not x or any(isinstance(row[x], str) for row in rows):
            rows, x, apart = [{**row, PLACE: k} for k, row in enumerate(rows[:MAX_DOTS])], PLACE, []
            names = [", ".join(coordinate(row[name]) for name in stub) for row in rows]
            by = [] if self.by in stub else by
        parts = list(_groups(rows, apart).items())[:MAX_PANELS]
        panels = [Panel(", ".join(filter(None, (heading_title(curve), words))),
                        self._lines(curve, part, x, by), "" if names else x, curve, names)
                  for curve in curves for words, part in parts]
        return [panel for panel in panels if any(
            np.isfinite(line.values).any() for line in panel.lines)] or panels[:1]

    def _lines(
        self, curve: Column, rows: Sequence[dict[str, Any]], x: str, by: Sequence[str]
    ) -> list[Line]:
        """Return a line for each value of ``by``, of the rows with a number."""
        lines = []
        for label, part in itertools.islice(_groups(rows, by).items(), MAX_LINES):
            known = sorted((row for row in part if not math.isnan(value_of(row[curve.heading])[0])),
                           key=lambda row: position(row[x]))
            numbers = np.array([(position(row[x]), *value_of(row[curve.heading])) for row in known])
            at, values, low, high = numbers.reshape(-1, 4).T
            texts = [cell_text(row[self.labels]) for row in known] if self.labels else []
            lines.append(Line(label, at, values, low, high, texts, joined=(
                x != PLACE and (not self.labels or label == self.by))))
        return lines


#: Of rows of dots: their number.
PLACE = "place"


class Line(NamedTuple):
    """Values (n,) along a line, or in rows of dots, with the ends of their intervals or NaN.

    ``texts`` are the names of the points; of a line whose points have names the joins are steps.
    """

    label: str
    at: Floats
    values: Floats
    low: Floats
    high: Floats
    texts: Sequence[str]
    joined: bool


def _groups(
    rows: Sequence[dict[str, Any]], names: Sequence[str]
) -> dict[str, list[dict[str, Any]]]:
    """Return rows by the words of some of their cells: numbers with their column's name."""
    parts: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        words = ", ".join(_named(name, row[name]) for name in names)
        parts.setdefault(words, []).append(row)
    return parts


def _named(heading: str, cell: Any) -> str:
    """Return a cell as the name of a line or panel: what is no word with its column's words."""
    if isinstance(cell, bool):
        return heading if cell else f"not {heading}"
    if isinstance(cell, str):
        return cell
    words, _, unit = heading.rpartition(", ")
    return f"{words or heading} {coordinate(cell)}" + "\u00b0" * (unit == "deg")


def position(cell: Any) -> float:
    """Return the place of a cell on a numeric axis: its value, or the middle of a bin."""
    return float(cell.middle if isinstance(cell, Bin) else getattr(cell, "value", cell))


def value_of(cell: Any) -> Value:
    """Return a number of a table with its interval."""
    return cell if isinstance(cell, Value) else Value(math.nan if cell is None else float(cell))


def heading_title(column: Column) -> str:
    """Return a column's heading as the title of a panel: its words, without the unit."""
    words = column.heading.rpartition(", ")[0] or column.heading
    return words[:1].upper() + words[1:]


# --------------------------------------------------------------------------------------------------
# One drawing function, and files of panels.


@dataclass(frozen=True, slots=True)
class Panel:
    """One panel of a figure.

    Attributes
    ----------
    title
        Stands above it.
    lines
        The lines and points.
    place
        Name of the axis along which values stand.
    curve
        Name, scale and reference of the values' axis.
    names
        Of rows of dots, the first at the top; without any, lines go along x.
    """

    title: str
    lines: Sequence[Line]
    place: str
    curve: Column
    names: Sequence[str] = ()

    @property
    def height(self) -> float:
        """Its height in inches; the legend takes none of the room of few lines."""
        if self.names:
            return max(1.6, 0.9 + 0.19 * len(self.names))
        lines = math.ceil(len(self.lines) / self.legend_columns)
        return HEIGHT + LINE_HEIGHT * max(0, lines - 2)

    @property
    def legend_columns(self) -> int:
        """Entries of the legend that stand side by side."""
        longest = max((len(line.label) for line in self.lines), default=0)
        return max(1, min(len(self.lines), LEGEND_CHARS // (longest + 6)))

    @property
    def svg(self) -> bytes:
        """It as SVG; hundredths of a point are enough, but not of a number in a text."""
        return re.sub(rb"(\.\d\d)\d+(?=[^<>]*>)", rb"\1", panels_file([self], ".svg"))

    @property
    def alt(self) -> str:
        """Its content in words, for readers who cannot see it."""
        against = f"against {self.place}" if self.place else "of each name"
        return f"{self.title}: {self.curve.heading} {against}."

    def draw(self, axes: Axes) -> None:
        """Draw it on empty axes; infinite values stand at the edge."""
        rows, curve = bool(self.names), self.curve
        limits = set_scale(axes, "x" if rows else "y", self.lines, curve)
        if rows:
            axes.set_ylim(len(self.names) - 0.4, -0.6)
            axes.set_yticks(range(len(self.names)), [
                name if len(name) <= ROW_CHARS else name[: ROW_CHARS - 1] + "\u2026"
                for name in self.names])
            axes.tick_params(axis="y", length=0)
        else:
            x = np.unique(np.concatenate([line.at for line in self.lines]))
            factors = is_logarithmic(x) and x[0] > 0 and not self.place.endswith(", deg")
            set_ends(axes, "x", x, margin=0.05, logarithmic=factors)
            axes.set_xlabel(self.place)
            if 0 < x.size <= MAX_OWN_TICKS and not any(line.texts for line in self.lines):
                axes.set_xticks(x, coordinates(x.tolist()))
        axes.grid(visible=True, axis="x" if rows else "both")
        for k, line in enumerate(self.lines):
            shift = 0.0 if rows or line.texts else DODGE * (k - (len(self.lines) - 1) / 2)
            _draw_line(axes, line, k, limits, shift, rows=rows)
        if curve.level is not None:
            (axes.axvline if rows else axes.axhline)(curve.level, **REFERENCE)
        for artist in (*axes.lines, *axes.collections):
            artist.set_in_layout(False)  # the labels alone are laid out
        for line in self.lines:
            if line.joined or len(line.texts) <= MAX_NAMED:
                for k, (x, y, text) in enumerate(zip(
                        line.at, line.values, line.texts, strict=False)):
                    # Names of neighbours stand on either side of their points.
                    axes.annotate(text, (x, min(y, limits[1])), (5, (-11, 4)[k % 2]),
                                  textcoords="offset points", fontsize=NAME_PT, color=INK)
        if len(self.lines) < 2:
            axes.set_title(self.title)
            return
        axes.legend(
            title=self.title, title_fontproperties={"weight": "bold", "size": 9.5},
            alignment="left", loc="lower left", bbox_to_anchor=(-0.02, 1.0),
            ncols=self.legend_columns)


def _draw_line(
    axes: Axes, line: Line, number: int, limits: tuple[float, float], shift: float, *, rows: bool
) -> None:
    """Draw one line with its intervals, moved by some points; ``rows`` exchanges x and y."""
    shape = "oD"[number % 2] if rows else SHAPES[number % len(SHAPES)]
    look: dict[str, Any] = {
        "color": COLOURS[number % len(COLOURS)],
        "transform": offset_copy(
            axes.transData, axes.get_figure(root=True), shift, 0, "points")}
    finite = np.isfinite(line.values)
    # If only one end is known, the other lies beyond all draws, at the edge.
    low = np.where(np.isnan(line.low) & ~np.isnan(line.high), -np.inf, line.low)
    high = np.where(np.isnan(line.high) & ~np.isnan(line.low), np.inf, line.high)
    (axes.hlines if rows else axes.vlines)(
        line.at[finite], np.clip(low, *limits)[finite], np.clip(high, *limits)[finite],
        linewidth=1, alpha=0.8, zorder=2, **look)
    # Infinite values are gaps of a line, and hollow points at the edge.
    for part, values, options in (
        (finite | line.joined, np.where(finite, np.clip(line.values, *limits), np.nan), {
            "label": line.label, "markeredgecolor": PAPER, "markeredgewidth": 0.4, "zorder": 3,
            "linestyle": DASHES[number % len(DASHES)] if line.joined else "",
            "drawstyle": "steps-post" if line.joined and line.texts else "default"}),
        (np.isposinf(line.values), np.full_like(line.values, limits[1]), {
            "linestyle": "", "markerfacecolor": PAPER, "clip_on": False, "zorder": 4}),
    ):
        points = line.at[part], values[part]
        axes.plot(*points[:: -1 if rows else 1], marker=shape, markersize=5, **look, **options)


def write_figure(figures: Sequence[Figure], path: Path) -> None:
    """Write the panels of figures into a file that a user asked for: PNG or SVG."""
    panels = [panel for figure in figures for panel in figure.panels]
    write_output_file(path, panels_file(panels, path.suffix.lower()))


def panels_file(panels: Sequence[Panel], suffix: str) -> bytes:
    """Return a picture of all panels as the content of a file: ".svg" or ".png"."""
    columns = min(len(panels), COLUMNS)
    heights = [max(panel.height for panel in panels[k : k + columns])
               for k in range(0, len(panels), columns)]
    with mpl.rc_context(fname=STYLE):
        canvas = Canvas((columns * WIDTH, sum(heights)))
        grid = canvas.add_gridspec(len(heights), columns, height_ratios=heights)
        for k, panel in enumerate(panels):
            panel.draw(canvas.add_subplot(grid[k // columns, k % columns]))
        encoded = io.BytesIO()
        metadata = {"Date": None} if suffix == ".svg" else {}
        canvas.savefig(encoded, format=suffix[1:], metadata=metadata, dpi=DOTS_PER_INCH)
    return encoded.getvalue()


# --------------------------------------------------------------------------------------------------
# Scales of charts: whether logarithmic, between which ends, with which ticks.

#: Values that span a larger ratio are drawn on a logarithmic scale.
LOGARITHMIC_FROM = 6

#: Values below this part of the largest are drawn at the lower edge of a logarithmic axis: errors
#: of rounding would compress all others.
FLOOR_RATIO = 1e-6


def is_logarithmic(values: Floats) -> bool:
    """Return whether no value is below 0 and the positive ones span a large ratio."""
    finite = values[np.isfinite(values)]
    positive = finite[finite > 0]
    return bool(positive.size and finite.min() >= 0
                and positive.max() > LOGARITHMIC_FROM * positive.min())


def set_scale(
    axes: Axes, name: str, lines: Sequence[Line], curve: Column
) -> tuple[float, float]:
    """Set the axis of a chart's values, with their intervals and the reference; return its ends.

    ``name``: "x" or "y".

    One with a reference at 0 is linear.
    """
    axes.set(**{f"{name}label": curve.heading})
    if curve.scale == 100:  # shares have always the same axis
        axes.set(**{f"{name}lim": SHARES, f"{name}ticks": [0, 25, 50, 75, 100]})
        return SHARES
    level = [] if curve.level is None else [curve.level]
    values = np.concatenate([*(line.values for line in lines), level])
    ends = np.concatenate([end for line in lines for end in (line.low, line.high)])
    logarithmic = is_logarithmic(values) and level != [0]
    if logarithmic:
        positive = values[np.isfinite(values) & (values > 0)]
        lowest = max(positive.min(), FLOOR_RATIO * positive.max())
        values = values[values >= lowest]
        # Long intervals are cut off, so that they do not compress everything else.
        ends = ends[(ends > lowest / 10) & (ends < positive.max() * 10)]
    return set_ends(axes, name, np.concatenate([values, ends]), margin=0.08,
                    logarithmic=logarithmic, from_zero=True)


def set_ends(
    axes: Axes, name: str, values: Floats, *, margin: float, logarithmic: bool,
    from_zero: bool = False,
) -> tuple[float, float]:
    """Set the scale of an axis, its ends around the finite values, and few plain ticks.

    ``margin`` is a share of its length. ``from_zero``: a linear axis without negative values begins
    there.
    """
    finite = values[np.isfinite(values)]
    if not finite.size:
        low, high = 0.0, 1.0
    elif logarithmic:
        spare = max(finite.max() / finite.min(), 2.0) ** margin
        low, high = float(finite.min() / spare), float(finite.max() * spare)
    else:
        low, high = float(finite.min()), float(finite.max())
        spare = margin * (high - low) or 0.5 * abs(high) or 0.5
        low, high = 0.0 if from_zero and low >= 0 else low - spare, high + spare
    axes.set(**{f"{name}scale": "log" if logarithmic else "linear", f"{name}lim": (low, high)})
    if logarithmic:
        axis = axes.xaxis if name == "x" else axes.yaxis
        subs = (1, 2, 5) if high < 60 * low else (1, 3) if high < 1000 * low else (1,)
        axis.set_major_locator(LogLocator(subs=subs))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter("{x:g}")
    return low, high
