"""The chart of cost against error of every configuration, with a panel for each condition."""

from __future__ import annotations

import math
import os
from itertools import cycle
from typing import IO, Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from matplotlib.textpath import text_to_path
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from matplotlib.transforms import Bbox

from sweep.report.theme import COLOURS, FAINT, INK, REFERENCE_DASHES, RULE, SHAPES, STRIP
from sweep.tradeoff.labels import heading_of
from sweep.tradeoff.pareto import UNITS, Booleans, by_condition, interval, mark_front
from sweep.typing import Floats

WIDTH = 12.0
"""Inches; a point is 1.4 pixels if the figure is shown 1200 pixels wide."""
PANEL_HEIGHT = 4.6
COLUMNS = 3
DOTS_PER_INCH = 150
STRIP_BASE = 0.93
"""Share of a panel's height above which configurations without a finite criterion stand."""

LABEL_SIZE = 8.5
FONT = FontProperties(size=LABEL_SIZE)
LABEL_OFFSETS = np.concatenate([
    distance * np.array([(-1, -1), (1, 1), (1, 0), (-1, 0), (0, -1), (0, 1), (1, -1), (-1, 1)])
    for distance in (5, 12, 20, 30, 42, 56, 75)
])
"""Positions of a label, in points right of and above its point, in order of preference."""


class Encoding(NamedTuple):
    """How the values of a setting are drawn: value -> colour, or value -> shape."""

    setting: str
    styles: dict[str, str]


def draw_trade(
    trade: xr.Dataset, criterion: str, path: str | os.PathLike[str] | IO[bytes],
    form: str | None = None,
) -> None:
    """Write a chart of cost, ms a frame, against the criterion, both logarithmic.

    There is a panel for each condition. Of the settings that ``trade`` has as coordinates of
    ``treatment`` the first is the colour and the last the shape. Bars are 95 % intervals; the
    stepped line is the Pareto front, whose points are filled and labelled. Configurations without
    a finite criterion stand in a strip at the top; ``bound_rotation_deg`` or
    ``bound_range_percent``, if ``trade`` has it, is a dashed line. Costs and errors of 0 cannot be
    drawn.

    Parameters
    ----------
    trade
        As measured by `sweep.tradeoff`.
    criterion
        An error of ``trade``.
    path
        File to write, or an open one.
    form
        ``png``, ``svg`` or another of matplotlib's formats (default: by the file's suffix).

    Raises
    ------
    KeyError
        If ``trade`` lacks ``cost_ms`` or the criterion.
    ValueError
        If the format is unknown.
    OSError
        If the file cannot be written.
    """
    conditions = list(by_condition(mark_front(trade, criterion), criterion))
    colours, shapes = _encodings(trade)
    columns = min(len(conditions), COLUMNS)
    rows = math.ceil(len(conditions) / columns)
    width = WIDTH if columns > 1 else WIDTH * 2 / 3
    figure = Figure((width, rows * PANEL_HEIGHT), layout="constrained")
    panels = [figure.add_subplot(rows, columns, k + 1) for k in range(len(conditions))]
    cost_limits = _limits(trade["cost_ms"].to_numpy())
    for panel, (label, condition) in zip(panels, conditions, strict=True):
        _draw_condition(panel, condition, criterion, cost_limits, colours, shapes)
        panel.set_title(label, loc="left", fontsize=10, color=INK)
    for panel in panels[::columns]:
        panel.set_ylabel(heading_of(criterion), color=INK)
    for panel in panels[-columns:]:
        panel.set_xlabel("cost, ms a frame", color=INK)
    if trade.attrs.get("title"):
        figure.suptitle(trade.attrs["title"], x=0.008, ha="left", fontsize=12, color=INK)
    has_bound = any(np.isfinite(_bound(condition, criterion)) for _, condition in conditions)
    _draw_legend(figure, colours, shapes, has_bound=has_bound)
    # Labels avoid the points and lines, whose final positions the layout decides.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for panel, (_, condition) in zip(panels, conditions, strict=True):
        _label_front(panel, condition, criterion, figure.dpi / 72)
    figure.savefig(path, dpi=DOTS_PER_INCH, format=form)


def _encodings(trade: xr.Dataset) -> tuple[Encoding, Encoding]:
    """Return the colours of the first setting's values and the shapes of the last setting's."""
    settings = [
        str(name) for name, values in trade.coords.items()
        if values.dims == ("treatment",) and name != "treatment"
    ] or ["treatment"]
    colours, shapes = (
        Encoding(name, dict(zip(dict.fromkeys(_texts(trade, name)), cycle(choices), strict=False)))
        for name, choices in ((settings[0], COLOURS), (settings[-1], SHAPES))
    )
    return colours, shapes


def _texts(condition: xr.Dataset, name: str) -> list[str]:
    return [str(value) for value in condition[name].to_numpy()]


def _draw_condition(
    panel: Axes, condition: xr.Dataset, criterion: str, cost_limits: tuple[float, float],
    colours: Encoding, shapes: Encoding,
) -> None:
    cost, error = condition["cost_ms"].to_numpy(), condition[criterion].to_numpy()
    on_front, finite = condition["on_front"].to_numpy(), np.isfinite(error)
    bound = _bound(condition, criterion)
    top = 1.0 if finite.all() else STRIP_BASE
    panel.set(
        xscale="log", xlim=cost_limits, yscale="log", ylim=_limits(np.append(error, bound), top)
    )
    _set_ticks_and_grid(panel)
    if not finite.any() and not np.isfinite(bound):
        panel.set_yticks([])
    if not finite.all():
        panel.fill_between([0, 1], STRIP_BASE, 1, transform=panel.transAxes, color=STRIP, lw=0)
        panel.set_title(
            f"{np.count_nonzero(~finite)} of {finite.size} not finite", loc="right",
            fontsize=LABEL_SIZE, color=FAINT,
        )
    if on_front.any():
        x, y = _front(condition, criterion)[:2]
        panel.step(
            [*x, cost_limits[1]], [*y, y[-1]], where="post",
            color=FAINT, linewidth=1.1, zorder=1.5,
        )
    if np.isfinite(bound):
        panel.axhline(bound, color=INK, linewidth=0.9, linestyle=REFERENCE_DASHES, zorder=1.5)
    shades = np.array([colours.styles[text] for text in _texts(condition, colours.setting)])
    panel.errorbar(
        cost[finite], error[finite], fmt="none", ecolor=shades[finite], elinewidth=0.8, alpha=0.55,
        xerr=_bars(condition, "cost_ms", finite), yerr=_bars(condition, criterion, finite),
        zorder=2,
    )
    for k, text in enumerate(_texts(condition, shapes.setting)):
        panel.plot(
            cost[k], error[k] if finite[k] else (STRIP_BASE + 1) / 2, shapes.styles[text],
            transform=panel.transData if finite[k] else panel.get_xaxis_transform(),
            linestyle="", zorder=3 + on_front[k],
            **_mark(shades[k], filled=bool(on_front[k])),
        )


def _mark(colour: str, *, filled: bool) -> dict[str, Any]:
    """Return the style of a point: filled on the front, open elsewhere."""
    if filled:
        style = {"markeredgecolor": "white", "markeredgewidth": 0.6, "markersize": 7.5}
    else:
        style = {"markerfacecolor": "white", "markersize": 5.5}
    return {"color": colour, **style}


def _bound(condition: xr.Dataset, criterion: str) -> float:
    """Return the bound of the criterion's quantity, in its unit; infinite without a bound."""
    quantity = criterion.partition("_")[0]
    name = f"bound_{quantity}_{UNITS[quantity]}"
    values = np.ravel(condition[name]) if name in condition else np.empty(0)
    return float(values[np.isfinite(values)].min(initial=np.inf))


def _limits(values: Floats, top: float = 1.0) -> tuple[float, float]:
    """Return the ends of an axis on which the values lie below the share ``top`` of its length."""
    logarithms = np.log10(values[np.isfinite(values) & (values > 0)])
    low, high = (logarithms.min(), logarithms.max()) if logarithms.size else (-0.3, 0.3)
    margin = max(0.15 * (high - low), (0.75 - (high - low)) / 2)  # a factor of 5 at least
    low, high = low - margin, high + margin
    return 10**low, 10 ** (low + (high - low) / top)


def _set_ticks_and_grid(panel: Axes) -> None:
    """Give a panel few ticks at round values, a faint grid and no box."""
    for axis in (panel.xaxis, panel.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 300 * low else (1,)))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.set_axisbelow(True)
    panel.grid(color=RULE, linewidth=0.7)
    panel.spines[["top", "right"]].set_visible(False)
    panel.spines[["left", "bottom"]].set_color(FAINT)
    panel.tick_params(labelsize=LABEL_SIZE, color=FAINT, labelcolor=INK, length=3)


def _front(condition: xr.Dataset, criterion: str) -> tuple[Floats, Floats, list[str]]:
    """Return costs, errors and labels of the configurations on the front, cheapest first."""
    front = condition.isel(treatment=np.flatnonzero(condition["on_front"])).sortby("cost_ms")
    return front["cost_ms"].to_numpy(), front[criterion].to_numpy(), _texts(front, "treatment")


def _bars(condition: xr.Dataset, name: str, chosen: Booleans) -> Floats:
    """Return the lengths (2, n) of the bars below and above; 0 if an end is unknown."""
    value = condition[name].to_numpy()[chosen]
    low, high = (end[chosen] for end in interval(condition, name))
    return np.asarray(np.nan_to_num(np.clip([value - low, high - value], 0, 1e3 * value)))


def _draw_legend(figure: Figure, colours: Encoding, shapes: Encoding, *, has_bound: bool) -> None:
    """Draw the legend at the right: the settings, then the elements of every such chart."""
    def entry(label: str, shape: str = "", **style: Any) -> Line2D:
        return Line2D([], [], marker=shape, label=label, **{"linestyle": ""} | style)

    if colours.setting == shapes.setting:
        groups = {colours.setting: [
            entry(text, shapes.styles[text], **_mark(colour, filled=True))
            for text, colour in colours.styles.items()
        ]}
    else:
        groups = {
            colours.setting: [
                entry(text, "o", **_mark(colour, filled=True))
                for text, colour in colours.styles.items()
            ],
            shapes.setting: [
                entry(text, shape, **_mark(FAINT, filled=False))
                for text, shape in shapes.styles.items()
            ],
        }
    entries = []
    for heading, group in groups.items():
        entries += [entry(heading), *group, entry(" ")]
    entries.append(entry("best for its cost", "o", linestyle="-", **_mark(FAINT, filled=True)))
    if has_bound:
        entries.append(entry("bound of RMSE", color=INK, linewidth=0.9, linestyle=REFERENCE_DASHES))
    legend = figure.legend(
        handles=entries, loc="outside right center", frameon=False, fontsize=LABEL_SIZE,
        labelcolor=INK, handlelength=1.8,
    )
    for text in legend.get_texts():
        if text.get_text() in groups:
            text.set_fontweight("bold")


def _label_front(panel: Axes, condition: xr.Dataset, criterion: str, scale: float) -> None:
    """Label the points of the front, each where its label covers the least.

    ``scale`` is the number of pixels in a typographic point.
    """
    x, y, labels = _front(condition, criterion)
    finite = np.isfinite(condition[criterion].to_numpy())
    points = panel.transData.transform(
        np.column_stack([condition[name].to_numpy()[finite] for name in ("cost_ms", criterion)])
    )
    # The stepped line goes along each point's error to the next point's cost, then down to it.
    line = panel.transData.transform(np.column_stack([np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]]))
    occupied: list[Bbox] = []
    for k, label in enumerate(labels):
        size = scale * np.array(text_to_path.get_text_width_height_descent(label, FONT, False)[:2])
        # The corner of the label, or the middle of its side, that is nearest to the point.
        nearest = line[2 * k] + scale * LABEL_OFFSETS
        lowest = nearest - np.multiply(size, 1 - np.sign(LABEL_OFFSETS)) / 2
        boxes = [Bbox([corner, corner + size]) for corner in lowest]
        penalties = [
            # In increasing weight: order of preference, on the line, connector across another
            # label, on points, outside the panel, on another label.
            rank + 12 * Path(line).intersects_bbox(box, filled=False)
            + 20 * sum(Path([line[2 * k], near]).intersects_bbox(other) for other in occupied)
            + 40 * box.padded(4 * scale).count_contains(points)
            + 1e3 * (panel.bbox.count_contains(box.get_points()) < 2)
            + 1e4 * box.padded(2 * scale).count_overlaps(occupied)
            for rank, (box, near) in enumerate(zip(boxes, nearest, strict=True))
        ]
        best = int(np.argmin(penalties))
        occupied.append(boxes[best])
        panel.annotate(
            label, (x[k], y[k]), (lowest[best] - line[2 * k]) / scale,
            textcoords="offset points", va="bottom", fontsize=LABEL_SIZE, color=INK, zorder=6,
            path_effects=[withStroke(linewidth=2.5, foreground="white")], parse_math=False,
            arrowprops={
                "arrowstyle": "-", "color": FAINT, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 4,
                "relpos": tuple((1 - np.sign(LABEL_OFFSETS[best])) / 2),
            },
        )
