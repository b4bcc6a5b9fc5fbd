"""Cost and accuracy of every configuration: chart, figure and tables."""

from __future__ import annotations

import math
import os
import tempfile
import textwrap
from collections.abc import Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import IO, Any, NamedTuple

import matplotlib as mpl
import numpy as np
import xarray as xr
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.path import Path as Polyline
from matplotlib.patheffects import withStroke
from matplotlib.textpath import text_to_path
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from matplotlib.transforms import Bbox

from sweep.report.charts import (
    COLOURS,
    FAINT,
    INK,
    MATPLOTLIB_STYLE,
    REFERENCE_DASHES,
    RULE,
    SHAPES,
    STRIP,
    inline_svg,
)
from sweep.report.figure import FigureKind, RenderedFigure, sentences
from sweep.report.report_data import ReportData
from sweep.report.table import Table, column_texts
from sweep.tradeoff.pareto import (
    CRITERIA,
    UNITS,
    Booleans,
    advice,
    budget_advice,
    by_condition,
    configuration_label,
    digits,
    heading_of,
    interval,
    mark_front,
)
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The chart of cost against error of every configuration, with a panel for each condition.

WIDTH = 12.0
"""Inches; a point is 1.4 pixels if the figure is shown 1200 pixels wide."""
PANEL_HEIGHT = 4.6
PANEL_COLUMNS = 3
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

BUDGET_REACH = 10.0
"""A budget beyond the costs by a larger factor is named in the legend, not drawn."""

KEY_LINE_INCHES = 0.15
"""Height of a line of the legend."""


BUDGET_COLOUR, BUDGET_DASHES = COLOURS[1], (0, (1.5, 1.5))


class Encoding(NamedTuple):
    """How the values of a setting are drawn: value -> colour, or value -> shape."""

    setting: str
    styles: dict[str, str]


def draw_trade(
    trade: xr.Dataset, criterion: str, path: str | os.PathLike[str] | IO[bytes],
    form: str | None = None, budget_ms: float | None = None,
) -> None:
    """Write a chart of cost, ms a frame, against the criterion, both logarithmic.

    There is a panel for each condition in which any configuration has a finite criterion; the
    others are named below. Of the settings that ``trade`` has as coordinates of ``treatment`` the
    first is the colour and the last the shape. Every point has its configuration's number in the
    legend beside it, those of the Pareto front (filled, on the stepped line) also its name. Bars
    are 95 % intervals. Configurations without a finite criterion stand in a strip at the top;
    ``bound_rotation_deg`` or ``bound_range_percent``, if ``trade`` has it, is a dashed line, and so
    is the budget, what lies beyond it shaded. Costs and errors of 0 cannot be drawn.

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
    budget_ms
        Most milliseconds a frame; None for no budget.

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
    drawn = [each for each in conditions if np.isfinite(each[1][criterion]).any()]
    left_out = [label or "all" for label, condition in conditions
                if not np.isfinite(condition[criterion]).any()]
    drawn = drawn or conditions[:1]
    colours, shapes = _encodings(trade)
    columns = min(len(drawn), PANEL_COLUMNS)
    rows = math.ceil(len(drawn) / columns)
    width = WIDTH if columns > 1 else WIDTH * 2 / 3
    figure = Figure((width, rows * PANEL_HEIGHT), layout="constrained")
    panels = [figure.add_subplot(rows, columns, k + 1) for k in range(len(drawn))]
    costs = trade["cost_ms"].to_numpy()
    if budget_ms is not None and _within_reach(budget_ms, costs):
        costs = np.append(costs, budget_ms)
    cost_limits = _limits(costs)
    for panel, (label, condition) in zip(panels, drawn, strict=True):
        _draw_condition(panel, condition, criterion, cost_limits, colours, shapes)
        _draw_budget(panel, budget_ms)
        panel.set_title(label, loc="left", fontsize=10, color=INK)
    for panel in panels[::columns]:
        panel.set_ylabel(heading_of(criterion), color=INK)
    for panel in panels[-columns:]:
        panel.set_xlabel("cost, ms a frame", color=INK)
    if trade.attrs.get("title"):
        figure.suptitle(trade.attrs["title"], x=0.008, ha="left", fontsize=12, color=INK)
    if left_out:
        figure.supxlabel(_left_out_text(left_out, criterion), x=0.008, ha="left",
                         fontsize=LABEL_SIZE, color=FAINT)
    has_bound = any(np.isfinite(_bound(condition, criterion)) for _, condition in drawn)
    _draw_legend(figure, trade, colours, shapes, has_bound=has_bound,
                 budget=_budget_text(budget_ms, cost_limits))
    # Labels avoid the points and lines, whose final positions the layout decides.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for panel, (_, condition) in zip(panels, drawn, strict=True):
        _label_points(panel, condition, criterion, figure.dpi / 72)
    figure.savefig(path, dpi=DOTS_PER_INCH, format=form)


def _left_out_text(labels: list[str], criterion: str) -> str:
    """Return which conditions are not drawn, in lines that fit the figure."""
    text = f"not drawn, since no configuration has a finite {criterion}: {'; '.join(labels)}"
    return textwrap.fill(text, 130)


def _within_reach(budget_ms: float, costs: Floats) -> bool:
    """Return whether a budget is near enough to the costs to be drawn beside them."""
    known = costs[np.isfinite(costs) & (costs > 0)]
    if not known.size:
        return False
    return bool(known.min() / BUDGET_REACH <= budget_ms <= known.max() * BUDGET_REACH)


def _budget_text(budget_ms: float | None, cost_limits: tuple[float, float]) -> str:
    """Return the budget's entry in the legend; empty without one."""
    if budget_ms is None:
        return ""
    low, high = cost_limits
    where = "" if low < budget_ms < high else " (all within)" if budget_ms >= high else (
        " (none within)")
    return f"budget {budget_ms:g} ms{where}"


def _draw_budget(panel: Axes, budget_ms: float | None) -> None:
    """Draw the budget as a line, and shade what lies beyond it."""
    low, high = panel.get_xlim()
    if budget_ms is None or not low < budget_ms < high:
        return
    panel.axvspan(budget_ms, high, color=STRIP, lw=0, zorder=0.5)
    panel.axvline(budget_ms, color=BUDGET_COLOUR, linewidth=1.3, linestyle=BUDGET_DASHES,
                  zorder=1.6)


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
        numbers = [n for n, known in zip(_numbers(condition), finite, strict=True) if not known]
        panel.text(
            0.98, STRIP_BASE - 0.01, textwrap.fill(f"not finite: {ranges_text(numbers)}", 44),
            transform=panel.transAxes, ha="right", va="top", fontsize=LABEL_SIZE, color=FAINT,
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


def _draw_legend(
    figure: Figure, trade: xr.Dataset, colours: Encoding, shapes: Encoding, *, has_bound: bool,
    budget: str,
) -> None:
    """Draw the legend at the right: the numbered configurations, then the lines."""
    def entry(label: str, shape: str = "", **style: Any) -> Line2D:
        return Line2D([], [], marker=shape, label=label, **{"linestyle": ""} | style)

    entries = [
        entry(f"{number}  {name}", shapes.styles[shape],
              **_mark(colours.styles[colour], filled=True))
        for number, name, colour, shape in zip(
            _numbers(trade), _texts(trade, "treatment"), _texts(trade, colours.setting),
            _texts(trade, shapes.setting), strict=True)
    ]
    entries += [entry(" "), entry("best for its cost (filled)", "o", linestyle="-",
                                  **_mark(FAINT, filled=True))]
    if has_bound:
        entries.append(entry("bound of RMSE", color=INK, linewidth=0.9, linestyle=REFERENCE_DASHES))
    if budget:
        entries.append(entry(budget, color=BUDGET_COLOUR, linewidth=1.3, linestyle=BUDGET_DASHES))
    lines = max(8, int(figure.get_figheight() / KEY_LINE_INCHES) - 3)
    figure.legend(
        handles=entries, loc="outside right center", frameon=False, fontsize=LABEL_SIZE,
        labelcolor=INK, handlelength=1.8, labelspacing=0.25, ncols=math.ceil(len(entries) / lines),
    )


def _numbers(trade: xr.Dataset) -> range:
    """Return the numbers of the configurations, from 1, in their order."""
    return range(1, trade.sizes["treatment"] + 1)


def ranges_text(numbers: Sequence[int]) -> str:
    """Return increasing numbers as text, runs of three or more by their ends.

    >>> ranges_text([1, 2, 3, 4, 7, 8])
    '1\u20134, 7, 8'
    """
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(
        f"{run[0]}\u2013{run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs)


def _label_points(panel: Axes, condition: xr.Dataset, criterion: str, scale: float) -> None:
    """Label all points, those of the front first, each where its label covers the least.

    ``scale`` is the number of pixels in a typographic point.
    """
    cost, error = condition["cost_ms"].to_numpy(), condition[criterion].to_numpy()
    drawn = np.isfinite(cost) & (cost > 0) & np.isfinite(error) & (error > 0)
    points = panel.transData.transform(np.column_stack([cost, error]))
    on_front = condition["on_front"].to_numpy()
    # The stepped line goes along each point's error to the next point's cost, then down to it.
    x, y, _ = _front(condition, criterion)
    line = panel.transData.transform(np.column_stack([np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]]))
    texts = [f"{number} {name}" if front else f"{number}" for number, name, front in zip(
        _numbers(condition), _texts(condition, "treatment"), on_front, strict=True)]
    occupied = [text.get_window_extent() for text in panel.texts]
    for k in sorted(np.flatnonzero(drawn).tolist(), key=lambda k: (not on_front[k], cost[k])):
        size = scale * np.array(
            text_to_path.get_text_width_height_descent(texts[k], FONT, False)[:2])
        # The corner of the label, or the middle of its side, that is nearest to the point.
        nearest = points[k] + scale * LABEL_OFFSETS
        lowest = nearest - np.multiply(size, 1 - np.sign(LABEL_OFFSETS)) / 2
        boxes = [Bbox([corner, corner + size]) for corner in lowest]
        penalties = [
            # In increasing weight: order of preference, on the line, connector across another
            # label, on points, outside the panel, on another label.
            rank + 12 * (len(line) > 1 and Polyline(line).intersects_bbox(box, filled=False))
            + 20 * sum(Polyline([points[k], near]).intersects_bbox(other) for other in occupied)
            + 40 * box.padded(4 * scale).count_contains(points[drawn])
            + 1e3 * (panel.bbox.count_contains(box.get_points()) < 2)
            + 1e4 * box.padded(2 * scale).count_overlaps(occupied)
            for rank, (box, near) in enumerate(zip(boxes, nearest, strict=True))
        ]
        best = int(np.argmin(penalties))
        occupied.append(boxes[best])
        panel.annotate(
            texts[k], tuple(panel.transData.inverted().transform(points[k]).tolist()),
            (lowest[best] - points[k]) / scale,
            textcoords="offset points", va="bottom", fontsize=LABEL_SIZE,
            color=INK if on_front[k] else FAINT, zorder=6,
            path_effects=[withStroke(linewidth=2.5, foreground="white")], parse_math=False,
            arrowprops={
                "arrowstyle": "-", "color": FAINT, "linewidth": 0.7, "shrinkA": 0, "shrinkB": 4,
                "relpos": tuple((1 - np.sign(LABEL_OFFSETS[best])) / 2),
            },
        )


# --------------------------------------------------------------------------------------------------
# Tables of cost and accuracy of every configuration, and of the renderers' cost.

STATISTICS = ("bias", "rmse", "rmse_unflipped", "median", "p95", "p99")
"""Statistics in the names of the variables of rotation and range."""

COSTS = {"ms a frame": ("cost_ms", 1.0), "x baseline": ("cost_ratio", 1.0),
         "detected, %": ("detection_rate", 100.0), "flips, %": ("flip_rate", 100.0)}
"""Heading -> variable, and the factor that it is multiplied by."""

WINDOWS = {
    "auto": "searched: the marker's surroundings",
    "full": "searched: the whole frame",
    "mixed": "searched: the whole frame or the marker's surroundings, as each setting needs",
}


def tradeoff_table(
    trade: xr.Dataset, criterion: str, columns: dict[str, tuple[str, float]] | None = None
) -> Table:
    """Return a row for each condition and configuration, the cheapest first.

    Times are in ms a frame, rotations in degrees, ranges in percent; values have their 95 %
    intervals. Columns, by default all, whose variables ``trade`` lacks are left out.

    Raises
    ------
    KeyError
        If ``trade`` lacks ``cost_ms``, ``cost_ratio`` or the criterion.
    """
    wanted = _all_columns(criterion) if columns is None else columns
    found: dict[str, list[str]] = {"configuration": [], "condition": [], "on the front": []}
    for label, condition in by_condition(mark_front(trade, criterion), criterion):
        ordered = condition.isel(
            treatment=np.argsort(condition["cost_ms"].to_numpy(), kind="stable"))
        names = [str(name) for name in ordered["treatment"].values]
        texts = {
            "configuration": names, "condition": [label] * len(names),
            "on the front": ["yes" if front else "" for front in ordered["on_front"].values],
        } | column_texts(ordered, wanted)
        if columns is None:
            texts |= _covariance_columns(ordered)
        for heading, values in texts.items():
            found.setdefault(heading, []).extend(values)
    if not any(found["condition"]):
        del found["condition"]
    return Table.of(
        "Cost and accuracy, the cheapest first, with 95 % intervals", list(found),
        list(zip(*found.values(), strict=True)), stub=len(found) - len(set(found) - STUB))


STUB = {"configuration", "condition", "on the front"}
"""Headings of the columns that name a row."""


def _all_columns(criterion: str) -> dict[str, tuple[str, float]]:
    columns = COSTS | {heading_of(criterion): (criterion, 1.0)}
    for quantity, unit in UNITS.items():
        names = [f"{quantity}_{statistic}_{unit}" for statistic in STATISTICS]
        columns |= {heading_of(name): (name, 1.0) for name in names}
        columns[f"{quantity} efficiency"] = f"{quantity}_efficiency", 1.0
    return columns | {"NEES": ("nees_mean", 1.0)}


def _covariance_columns(condition: xr.Dataset) -> dict[str, list[str]]:
    """Return how much each level of the predicted covariance covers, and whether to trust it."""
    found = {}
    if "covariance_coverage" in condition:
        for level in condition["level"].to_numpy().tolist():
            covered = 100 * condition["covariance_coverage"].sel(level=level)
            found[f"in {100 * level:g} % ellipsoid, %"] = list(map(digits, covered.to_numpy()))
    if "covariance_trusted" in condition:
        found["covariance"] = [
            ("trusted" if trusted else "not trusted") if count else "-" for trusted, count in zip(
                condition["covariance_trusted"].to_numpy(), condition["nees_count"].to_numpy(),
                strict=True)]
    return found


def headlines(trade: xr.Dataset) -> list[str]:
    """Return the title and the facts of the measurement."""
    attrs = trade.attrs
    facts = {
        "poses": f"{attrs.get('poses')} poses",
        "window": WINDOWS.get(str(attrs.get("window")), f"searched: {attrs.get('window')}"),
        "baseline": f"baseline: {attrs.get('baseline')}",
    }
    return [
        str(attrs.get("title", "")),
        "ms a frame: detection and estimation",
        *(text for name, text in facts.items() if name in attrs),
    ]


def legend(criterion: str) -> list[str]:
    """Return what the table's words mean."""
    return [
        f"on the front: no other configuration is both cheaper and better in {criterion}",
        "RMSE and bias: of the solved poses",
        "median, p95, p99: a pose that is not solved counts as an infinite error",
    ]


IMAGES = {"ms an image": "render_ms", "x exact": "render_ratio", "grey RMS": "grey_rms",
          "grey max": "grey_max"}
CHANGES = {
    "detection differs, %": ("detection_disagreement", 100.0),
    "corner RMS px": ("corner_shift_rms_px", 1.0),
    "range bias %": ("range_bias_percent", 1.0),
    "rotation RMS deg": ("rotation_shift_deg", 1.0),
}
"""Heading -> variable of the images; heading -> variable of a configuration, and its factor."""


def renderer_table(renderers: xr.Dataset) -> Table:
    """Return a table of the renderers in ``cost/renderers``.

    First the images: cost, and difference from the exact image. Then for each configuration the
    share of scenes in which the marker is detected in only one of the two images, and the change
    of corners, range and rotation, paired on the scenes that both solve.
    """
    return Table.of(
        "Other renderers against exact images", ["renderer", *IMAGES, "configuration", *CHANGES],
        list(_renderer_rows(renderers)), words=True)


def _renderer_rows(renderers: xr.Dataset) -> Iterator[list[str]]:
    pose = renderers["range_bias_percent"]
    settings = [str(dim) for dim in pose.dims if dim != "renderer"]
    for name in renderers["renderer"].values.tolist():
        one = renderers.sel(renderer=name)
        images = [digits(float(one[variable])) for variable in IMAGES.values()]
        if name == renderers.attrs["reference"]:
            yield [name, *images, "", *[""] * len(CHANGES)]
            continue
        for index in np.ndindex(*(one.sizes[dim] for dim in settings)):
            configuration = one.isel(dict(zip(settings, index, strict=True)))
            label = configuration_label({dim: configuration[dim].item() for dim in settings})
            changes = [
                digits(float(configuration[variable]) * factor)
                for variable, factor in CHANGES.values()
            ]
            first = not any(index)
            yield [name if first else "", *(images if first else [""] * len(images)), label,
                   *changes]


# --------------------------------------------------------------------------------------------------
# The figure of cost against accuracy of every configuration.

CRITERION = "rotation_p95_deg"
OTHER_CRITERION = "rotation_median_deg"
"""Used if the first is infinite or NaN for every configuration of some condition."""

COLUMNS = {
    "ms a frame": ("cost_ms", 1.0), "detected, %": ("detection_rate", 100.0),
    "flipped, %": ("flip_rate", 100.0), "rotation median, deg": ("rotation_median_deg", 1.0),
    "rotation p95, deg": ("rotation_p95_deg", 1.0),
    "range RMSE, %": ("range_rmse_percent", 1.0),
}
"""Heading -> variable, and the factor that it is multiplied by."""

CHART_STYLE: Any = {
    name: MATPLOTLIB_STYLE[name] for name in ("svg.fonttype", "svg.hashsalt", "text.parse_math")
} | {"savefig.transparent": True}


def trade_criterion(trade: xr.Dataset) -> str:
    """Return the error that ranks configurations: that asked for, if it is finite everywhere."""
    asked = str(trade.attrs.get("criterion", CRITERION))
    names = [name for name in (asked, CRITERION, OTHER_CRITERION)
             if name in CRITERIA and name in trade]
    return next(
        (name for name in names
         if np.isfinite(trade[name].values).any(axis=trade[name].dims.index("treatment")).all()),
        names[0],
    )


def _render(data: ReportData) -> RenderedFigure:
    if data.trade is None:
        raise KeyError("cost/tradeoff")
    trade = data.trade.drop_attrs(deep=False)  # the figure has a title of its own
    criterion, budget_ms = trade_criterion(data.trade), budget_of(data.trade)
    poses = int(data.trade.attrs.get("poses", 0))
    alt = f"Cost in milliseconds a frame against {criterion}, a panel for each condition."

    def write(path: str) -> None:
        with mpl.rc_context({"text.parse_math": False, "svg.hashsalt": "sweep"}):
            draw_trade(trade, criterion, path, budget_ms=budget_ms)

    def svg(prefix: str) -> Markup:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "trade.svg"
            with mpl.rc_context(CHART_STYLE):
                draw_trade(trade, criterion, path, budget_ms=budget_ms)
            return inline_svg(path.read_text(encoding="utf-8"), alt, prefix, clipped=True)

    return RenderedFigure(
        "trade", "Cost and accuracy",
        sentences(
            f"Cost of detection and estimation, ms a frame, against {criterion}, of each "
            "configuration on the same images, both logarithmic; bars are 95 % intervals; filled "
            "points form the Pareto front: no other configuration is both cheaper and better. "
            "Numbers are those of the legend.",
            f"The dotted line is the budget of {budget_ms:g} ms." if budget_ms else "",
            f"Of {poses:,} poses." if poses else "",
            *(f"{sentence}." for sentence in (
                budget_advice(trade, criterion, budget_ms) if budget_ms else [])),
            *(f"{sentence}." for sentence in advice(trade, criterion)),
        ),
        tradeoff_table(trade, criterion, COLUMNS), svg=svg, write=write,
    )


def budget_of(trade: xr.Dataset) -> float | None:
    """Return the budget, ms a frame, that the tradeoff was asked for; None for none."""
    budget = trade.attrs.get("budget_ms")
    return None if budget is None else float(budget)


TRADE = FigureKind("trade", lambda data: data.trade is not None, _render)
