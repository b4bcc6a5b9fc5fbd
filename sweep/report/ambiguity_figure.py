"""The figure of what thresholds on the ambiguity keep: of the poses, and of the flips."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from sweep.analysis import ambiguity
from sweep.analysis.ambiguities import ThresholdChoice
from sweep.analysis.detection_limits import SIZE_AXES
from sweep.report.charts import draw_map, rows_height
from sweep.report.figure import FigureKind, RenderedFigure, sentences, uncapitalised
from sweep.report.formatting import number
from sweep.report.grouping import (
    AREA,
    AREA_BINS,
    CONFIGURATION,
    Grouping,
    by_configuration,
    drawn_bins,
    group_labels,
)
from sweep.report.report_data import ReportData
from sweep.report.svg import Panel
from sweep.report.table import Table, cells
from sweep.report.theme import COLOURS, DASHES, INK, PAPER, SHAPES

USUAL = 0.2
"""The threshold that many programs use."""

FRONTAL_DEG = 5.0
"""Viewing angle up to which a pose hardly differs from its mirror."""

CONDITIONS = 10
"""The most sizes, or angles, that are told apart."""

AREA_CONDITIONS = 8
"""Bins of the area."""

MAX_LINES, MAX_ROWS = len(COLOURS), 30

ANSWERS = {
    ThresholdChoice.not_run: "no pose",
    ThresholdChoice.found: "yes",
    ThresholdChoice.not_needed: "not needed",
    ThresholdChoice.too_few_draws: "too few draws to tell",
    ThresholdChoice.none: "no threshold does",
    ThresholdChoice.nothing_drawn: "nothing was drawn",
}
"""What the choice says, in the table."""


def _has_ratios(data: ReportData) -> bool:
    """Return whether any pose has another solution, any is a flip, and not all are frontal."""
    names = ("reprojection_error_px", "alternative_reprojection_error_px")
    if not all(name in data.results for name in names):
        return False
    if "viewing_angle_deg" in data.results:
        largest = data.once("largest angle", data.results[["viewing_angle_deg"]].max)
        if not largest["viewing_angle_deg"] > FRONTAL_DEG:
            return False
    table = data.analysed(ambiguity)
    return bool(((table["without_alternative"] < table["solved"]) & (table["flipped"] > 0)).any())


def _conditions(data: ReportData) -> Grouping:
    """Return the grouping by the marker's size, of few groups; by the angle if sizes are equal."""
    drawn = [name for name in SIZE_AXES if name in data.pipeline.distributions]
    if data.size_axis is None and drawn and drawn[0] in data.results.variables:
        return drawn_bins(drawn[0], data.pipeline.distributions[drawn[0]])
    along = data.size or data.angle_axis
    if along != AREA:
        return data.along(along, CONDITIONS) if along else Grouping()
    (name, edges), = data.along(AREA).bins
    few = (*edges[:-1:AREA_BINS // AREA_CONDITIONS], edges[-1])
    return Grouping(bins=((name, few),), notes=(
        f"Areas are grouped into {AREA_CONDITIONS} bins of equal ratio.",))


def by_configurations(data: ReportData, grouping: Grouping) -> tuple[list[str], xr.Dataset]:
    """Return the labels of all configurations, and `ambiguity` by them (configuration, ...)."""
    table = data.analysed(ambiguity, grouping)
    single = [str(name) for name in table.dims
              if name not in (*grouping.dims, *data.setting_axes, "threshold")]
    table = table.isel(dict.fromkeys(single, 0), drop=True)
    if not data.setting_axes:
        return ["all"], table.expand_dims(CONFIGURATION)
    names, stacked = by_configuration(data.pipeline, table, data.setting_axes)
    return names, stacked.transpose(CONFIGURATION, ...)


def _render(data: ReportData) -> RenderedFigure:
    conditions = _conditions(data)
    names, pooled = by_configurations(data, Grouping())
    _, table = by_configurations(data, conditions)
    curved = np.flatnonzero((pooled["without_alternative"] < pooled["solved"]).values
                            & (pooled["flipped"] > 0).values)
    wanted = 100 * float(table.attrs["flip_rate"])
    along = conditions.dims[0] if conditions.dims else None
    panels = [Panel(
        "Flips kept against poses kept",
        "Lines of the share of flips that is kept against that of poses, over the threshold.",
        lambda axes: _draw_curves(axes, [names[k] for k in curved[:MAX_LINES]],
                                  pooled.isel({CONFIGURATION: curved[:MAX_LINES]})),
        wide=True, height=4.2,
    )]
    if along:
        shown = [("kept_flip_rate", f"Flips of the poses that {USUAL:g} keeps, %", True),
                 ("right_rejected_rate", f"Right poses that {USUAL:g} rejects, %", True)]
        if table["chosen_threshold"].notnull().any():
            shown.append(("chosen_threshold", f"Threshold for {wanted:g} % flips", False))
        panels += [_map(data, names, table, along, *each) for each in shown]
    hidden = len(curved) - MAX_LINES
    return RenderedFigure(
        "ambiguity", "A threshold on the ambiguity: flips and poses that it keeps",
        sentences(
            "A pose is kept if its reprojection error is at most the threshold times that of the "
            f"other planar solution. Rings stand at {USUAL:g}, stars at the largest threshold "
            f"that is shown to keep the flips at {wanted:g} % of the kept poses at most (the "
            "95 % bound of all thresholds tried together); without a star there is none. Poses "
            "without another solution are always kept.",
            "\u221e: no threshold is needed; a dash: no pose, or no threshold is shown to do it; "
            "the table says why." if along else "",
            f"{hidden} more configurations are in the table alone." if hidden > 0 else "",
            *conditions.notes,
        ),
        _table(data, names, table, along, wanted), panels,
    )


def _draw_curves(axes: Axes, names: list[str], table: xr.Dataset) -> None:
    """Draw a line for each configuration; every threshold is a point."""
    thresholds = table["threshold"].values
    for k, name in enumerate(names):
        one = table.isel({CONFIGURATION: k})
        kept, flips = 100 * one["kept_rate"].values, 100 * one["flips_kept_rate"].values
        colour = COLOURS[k % len(COLOURS)]
        axes.plot(kept, flips, color=colour, linestyle=DASHES[k % len(DASHES)], label=name,
                  marker=SHAPES[k % len(SHAPES)], markersize=3.5, zorder=3)
        for at, shape, size, face in (
            (USUAL, "o", 11, "none"), (float(one["chosen_threshold"]), "*", 13, colour),
        ):
            index = np.flatnonzero(thresholds == at)
            axes.plot(kept[index], flips[index], shape, markersize=size, color=colour,
                      markerfacecolor=face, markeredgecolor=INK if shape == "*" else colour,
                      markeredgewidth=0.7 if shape == "*" else 1.6, zorder=4)
    axes.plot([], [], "o", markersize=9, markerfacecolor="none", markeredgecolor=INK,
              label=f"threshold {USUAL:g}")
    axes.plot([], [], "*", markersize=11, color=PAPER, markeredgecolor=INK,
              label="threshold for the wanted flips")
    axes.set(xlim=(-2, 102), ylim=(-2, 104), xlabel="poses kept, % of the solved",
             ylabel="flips kept, % of the flips")
    axes.grid(visible=True)
    axes.legend(
        loc="lower left", bbox_to_anchor=(-0.02, 1.02), ncols=3, borderaxespad=0,
        columnspacing=1.1, handletextpad=0.5, labelspacing=0.25, borderpad=0.2)


def _map(
    data: ReportData, names: list[str], table: xr.Dataset, along: str, name: str, title: str,
    share: bool,
) -> Panel:
    columns = group_labels(table, along)
    rows = names[:MAX_ROWS]
    part = table[name]
    part = part.sel(threshold=USUAL) if "threshold" in part.dims else part
    values = part.transpose(CONFIGURATION, along).values[:MAX_ROWS][::-1]
    label = data.label(along)
    return Panel(
        title, f"Map of {uncapitalised(title)} over {label} and configuration.",
        lambda axes: draw_map(axes, rows[::-1], columns, values, (label, ""), share=share),
        wide=len(columns) > 6, height=rows_height(len(rows)) + 0.5,
    )


def _table(
    data: ReportData, names: list[str], table: xr.Dataset, along: str | None, wanted: float
) -> Table:
    columns = group_labels(table, along) if along else ["all"]
    usual = table.sel(threshold=USUAL)
    of_usual = {
        f"kept at {USUAL:g}, %": ("kept_rate", 100.0),
        f"flips kept at {USUAL:g}": ("kept_flipped", 1.0),
        f"right of the rejected at {USUAL:g}, %": ("rejected_right_rate", 100.0),
    }
    of_chosen = {
        "threshold": ("chosen_threshold", 1.0), "kept there, %": ("chosen_kept_rate", 100.0),
        "flips there, %": ("chosen_flip_rate", 100.0),
        "right poses rejected there, %": ("chosen_right_rejected_rate", 100.0),
    }
    rows = []
    for k, name in enumerate(names):
        for j, column in enumerate(columns):
            at = {CONFIGURATION: k} | ({along: j} if along else {})
            one = table.isel(at)
            rows.append([
                name, *((column,) * bool(along)), *cells(one, "solved"), *cells(one, "flipped"),
                *(cells(usual.isel(at), key, scale)[0] for key, scale in of_usual.values()),
                ANSWERS[ThresholdChoice(int(one["choice"]))],
                *(number(scale * float(one[key])) for key, scale in of_chosen.values()),
            ])
    return Table(
        f"Thresholds on the ambiguity, with 95 % intervals; wanted: {wanted:g} % flips",
        [CONFIGURATION, *([data.label(along)] if along else []), "solved", "flips", *of_usual,
         f"{wanted:g} % by a threshold?", *of_chosen],
        rows, stub=1 + bool(along),
    )


AMBIGUITY = FigureKind("ambiguity", _has_ratios, _render)
