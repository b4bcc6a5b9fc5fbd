"""What accuracy costs, as a figure: cost and error of every treatment, a panel for each regime."""

from __future__ import annotations

import math
import os
from itertools import cycle
from typing import Any, NamedTuple

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

from sweep.tradeoff.pareto import (
    UNITS,
    Booleans,
    by_regime,
    heading_of,
    interval,
    mark_front,
)
from sweep.typing import Floats

# Okabe and Ito's palette, told apart by the colour-blind; without yellow, too faint for a line.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
SHAPES = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
INK, FAINT, RULE, STRIP_COLOUR = "#282828", "#7a7a7a", "#e6e6e6", "#f3f3f3"
DASHES = (0, (5, 3))

WIDTH = 12.0
"""Inches; a point is 1.4 pixels where the figure is 1200 pixels wide."""
PANEL_HEIGHT = 4.6
COLUMNS = 3
DOTS_PER_INCH = 150
STRIP = 0.93
"""Height in a panel above which the treatments stand whose criterion is not finite."""

LABEL_SIZE = 8.5
FONT = FontProperties(size=LABEL_SIZE)
# Where a name may stand: points right of and above its point, the best place first.
PLACES = np.concatenate([
    distance * np.array([(-1, -1), (1, 1), (1, 0), (-1, 0), (0, -1), (0, 1), (1, -1), (-1, 1)])
    for distance in (5, 12, 20, 30, 42, 56, 75)
])


class Looks(NamedTuple):
    """What stands for the values of a setting: a colour or a shape each."""

    setting: str
    of: dict[str, str]


def draw_trade(trade: xr.Dataset, criterion: str, path: str | os.PathLike[str]) -> None:
    """Write a figure of cost, ms a frame, against the criterion, both logarithmic.

    A panel a regime. Of the settings that ``trade`` has as coordinates of ``treatment`` the first
    is the colour and the last the shape. Bars are 95 % intervals; the stepped line is the front,
    its points are filled and labelled. Treatments whose criterion is not finite stand in a strip
    at the top; ``bound_rotation_deg`` or ``bound_range_percent``, where ``trade`` has it, is a
    dashed line. Costs and errors of 0 cannot be shown.

    The path's suffix chooses the format: ``.png``, ``.svg`` or another of matplotlib's. Raises
    ``KeyError`` if ``trade`` lacks ``cost_ms`` or the criterion, ``ValueError`` for an unknown
    suffix and ``OSError`` if the file cannot be written.
    """
    regimes = list(by_regime(mark_front(trade, criterion), criterion))
    colours, shapes = _looks(trade)
    columns = min(len(regimes), COLUMNS)
    rows = math.ceil(len(regimes) / columns)
    width = WIDTH if columns > 1 else WIDTH * 2 / 3
    figure = Figure((width, rows * PANEL_HEIGHT), layout="constrained")
    panels = [figure.add_subplot(rows, columns, k + 1) for k in range(len(regimes))]
    cost_limits = _limits(trade["cost_ms"].to_numpy())
    for panel, (label, regime) in zip(panels, regimes, strict=True):
        _draw_regime(panel, regime, criterion, cost_limits, colours, shapes)
        panel.set_title(label, loc="left", fontsize=10, color=INK)
    for panel in panels[::columns]:
        panel.set_ylabel(heading_of(criterion), color=INK)
    for panel in panels[-columns:]:
        panel.set_xlabel("cost, ms a frame", color=INK)
    if trade.attrs.get("title"):
        figure.suptitle(trade.attrs["title"], x=0.008, ha="left", fontsize=12, color=INK)
    has_bound = any(np.isfinite(_bound(regime, criterion)) for _, regime in regimes)
    _draw_legend(figure, colours, shapes, has_bound=has_bound)
    # A label is placed among what is there, so that has to be where it will be.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for panel, (_, regime) in zip(panels, regimes, strict=True):
        _label_front(panel, regime, criterion, figure.dpi / 72)
    figure.savefig(path, dpi=DOTS_PER_INCH)


def _looks(trade: xr.Dataset) -> tuple[Looks, Looks]:
    """Return the colours of the first setting's values and the shapes of the last's."""
    settings = [
        str(name) for name, values in trade.coords.items()
        if values.dims == ("treatment",) and name != "treatment"
    ] or ["treatment"]
    colours, shapes = (
        Looks(name, dict(zip(dict.fromkeys(_texts(trade, name)), cycle(choices), strict=False)))
        for name, choices in ((settings[0], COLOURS), (settings[-1], SHAPES))
    )
    return colours, shapes


def _texts(regime: xr.Dataset, name: str) -> list[str]:
    return [str(value) for value in regime[name].to_numpy()]


def _draw_regime(
    panel: Axes, regime: xr.Dataset, criterion: str, cost_limits: tuple[float, float],
    colours: Looks, shapes: Looks,
) -> None:
    cost, error = regime["cost_ms"].to_numpy(), regime[criterion].to_numpy()
    on_front, finite = regime["on_front"].to_numpy(), np.isfinite(error)
    bound = _bound(regime, criterion)
    top = 1.0 if finite.all() else STRIP
    panel.set(
        xscale="log", xlim=cost_limits, yscale="log", ylim=_limits(np.append(error, bound), top)
    )
    _restrain(panel)
    if not finite.any() and not np.isfinite(bound):
        panel.set_yticks([])
    if not finite.all():
        panel.fill_between([0, 1], STRIP, 1, transform=panel.transAxes, color=STRIP_COLOUR, lw=0)
        panel.set_title(
            f"{np.count_nonzero(~finite)} of {finite.size} not finite", loc="right",
            fontsize=LABEL_SIZE, color=FAINT,
        )
    if on_front.any():
        x, y = _front(regime, criterion)[:2]
        panel.step(
            [*x, cost_limits[1]], [*y, y[-1]], where="post",
            color=FAINT, linewidth=1.1, zorder=1.5,
        )
    if np.isfinite(bound):
        panel.axhline(bound, color=INK, linewidth=0.9, linestyle=DASHES, zorder=1.5)
    shades = np.array([colours.of[text] for text in _texts(regime, colours.setting)])
    panel.errorbar(
        cost[finite], error[finite], fmt="none", ecolor=shades[finite], elinewidth=0.8, alpha=0.55,
        xerr=_bars(regime, "cost_ms", finite), yerr=_bars(regime, criterion, finite), zorder=2,
    )
    for k, text in enumerate(_texts(regime, shapes.setting)):
        panel.plot(
            cost[k], error[k] if finite[k] else (STRIP + 1) / 2, shapes.of[text],
            transform=panel.transData if finite[k] else panel.get_xaxis_transform(),
            linestyle="", zorder=3 + on_front[k],
            **_mark(shades[k], filled=bool(on_front[k])),
        )


def _mark(colour: str, *, filled: bool) -> dict[str, Any]:
    """Return how a point is drawn: filled on the front, open elsewhere."""
    if filled:
        look = {"markeredgecolor": "white", "markeredgewidth": 0.6, "markersize": 7.5}
    else:
        look = {"markerfacecolor": "white", "markersize": 5.5}
    return {"color": colour, **look}


def _bound(regime: xr.Dataset, criterion: str) -> float:
    """Return the bound of the criterion's quantity, in its unit; not finite if there is none."""
    quantity = criterion.partition("_")[0]
    name = f"bound_{quantity}_{UNITS[quantity]}"
    values = np.ravel(regime[name]) if name in regime else np.empty(0)
    return float(values[np.isfinite(values)].min(initial=np.inf))


def _limits(values: Floats, top: float = 1.0) -> tuple[float, float]:
    """Return an axis's ends such that the values lie below the share ``top`` of its length."""
    logarithms = np.log10(values[np.isfinite(values) & (values > 0)])
    low, high = (logarithms.min(), logarithms.max()) if logarithms.size else (-0.3, 0.3)
    margin = max(0.15 * (high - low), (0.75 - (high - low)) / 2)  # a factor of 5 at least
    low, high = low - margin, high + margin
    return 10**low, 10 ** (low + (high - low) / top)


def _restrain(panel: Axes) -> None:
    """Give a panel plain numbers at round places, a faint grid and no box."""
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


def _front(regime: xr.Dataset, criterion: str) -> tuple[Floats, Floats, list[str]]:
    """Return the costs, errors and labels of the treatments on the front, cheapest first."""
    front = regime.isel(treatment=np.flatnonzero(regime["on_front"])).sortby("cost_ms")
    return front["cost_ms"].to_numpy(), front[criterion].to_numpy(), _texts(front, "treatment")


def _bars(regime: xr.Dataset, name: str, chosen: Booleans) -> Floats:
    """Return the lengths (2, n) of the bars below and above; 0 where an end is not known."""
    value = regime[name].to_numpy()[chosen]
    low, high = (end[chosen] for end in interval(regime, name))
    return np.asarray(np.nan_to_num(np.clip([value - low, high - value], 0, 1e3 * value)))


def _draw_legend(figure: Figure, colours: Looks, shapes: Looks, *, has_bound: bool) -> None:
    """Draw the one legend, at the right: settings, then what is the same in all figures."""
    def entry(label: str, shape: str = "", **look: Any) -> Line2D:
        return Line2D([], [], marker=shape, label=label, **{"linestyle": ""} | look)

    if colours.setting == shapes.setting:
        groups = {colours.setting: [
            entry(text, shapes.of[text], **_mark(colour, filled=True))
            for text, colour in colours.of.items()
        ]}
    else:
        groups = {
            colours.setting: [
                entry(text, "o", **_mark(colour, filled=True))
                for text, colour in colours.of.items()
            ],
            shapes.setting: [
                entry(text, shape, **_mark(FAINT, filled=False))
                for text, shape in shapes.of.items()
            ],
        }
    entries = []
    for heading, group in groups.items():
        entries += [entry(heading), *group, entry(" ")]
    entries.append(entry("best for its cost", "o", linestyle="-", **_mark(FAINT, filled=True)))
    if has_bound:
        entries.append(entry("bound of RMSE", color=INK, linewidth=0.9, linestyle=DASHES))
    legend = figure.legend(
        handles=entries, loc="outside right center", frameon=False, fontsize=LABEL_SIZE,
        labelcolor=INK, handlelength=1.8,
    )
    for text in legend.get_texts():
        if text.get_text() in groups:
            text.set_fontweight("bold")


def _label_front(panel: Axes, regime: xr.Dataset, criterion: str, scale: float) -> None:
    """Name the points of the front, each where its name hides the least.

    ``scale`` is the number of pixels of a point.
    """
    x, y, labels = _front(regime, criterion)
    finite = np.isfinite(regime[criterion].to_numpy())
    points = panel.transData.transform(
        np.column_stack([regime[name].to_numpy()[finite] for name in ("cost_ms", criterion)])
    )
    # The stepped line goes along each point's error to the next one's cost, then down to it.
    line = panel.transData.transform(np.column_stack([np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]]))
    names: list[Bbox] = []
    for k, label in enumerate(labels):
        size = scale * np.array(text_to_path.get_text_width_height_descent(label, FONT, False)[:2])
        nearest = line[2 * k] + scale * PLACES  # the corner, or middle of a side, nearest to it
        lowest = nearest - np.multiply(size, 1 - np.sign(PLACES)) / 2
        boxes = [Bbox([corner, corner + size]) for corner in lowest]
        hidden = [
            # In this order: nearest, off the line, reached past no name, off the points, in the
            # panel, off other names.
            rank + 12 * Path(line).intersects_bbox(box, filled=False)
            + 20 * sum(Path([line[2 * k], near]).intersects_bbox(name) for name in names)
            + 40 * box.padded(4 * scale).count_contains(points)
            + 1e3 * (panel.bbox.count_contains(box.get_points()) < 2)
            + 1e4 * box.padded(2 * scale).count_overlaps(names)
            for rank, (box, near) in enumerate(zip(boxes, nearest, strict=True))
        ]
        place = int(np.argmin(hidden))
        names.append(boxes[place])
        panel.annotate(
            label, (x[k], y[k]), (lowest[place] - line[2 * k]) / scale,
            textcoords="offset points", va="bottom", fontsize=LABEL_SIZE, color=INK, zorder=6,
            path_effects=[withStroke(linewidth=2.5, foreground="white")], parse_math=False,
            arrowprops={
                "arrowstyle": "-", "color": FAINT, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 4,
                "relpos": tuple((1 - np.sign(PLACES[place])) / 2),
            },
        )
