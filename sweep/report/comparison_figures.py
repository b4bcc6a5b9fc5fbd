"""Figures that compare configurations, marker IDs, the bound, thresholds and trials."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from sweep.analysis import (
    ambiguity,
    compare,
    efficiency,
    error_statistics,
    marker_ranking,
    precision_reached,
)
from sweep.analysis.ambiguities import ThresholdChoice
from sweep.analysis.detection_limits import SIZE_AXES
from sweep.analysis.precision import Reached
from sweep.measure.flags import BoundStatus, present_values
from sweep.plan.sampling import PrecisionRule
from sweep.report.charts import (
    COLOURS,
    DASHES,
    FLOOR_NOTE,
    INK,
    PAPER,
    SHAPES,
    Panel,
    Series,
    below_floor,
    draw_dots,
    draw_lines,
    legend_above,
    rows_height,
)
from sweep.report.comparison import with_configuration
from sweep.report.figure import (
    ERRORS,
    LOOKED_FOR,
    FigureKind,
    RenderedFigure,
    denominators,
    dots_of,
    interval_sentence,
    map_panel,
    sentences,
    uncapitalised,
)
from sweep.report.formatting import number
from sweep.report.report_data import (
    AREA,
    AREA_BINS,
    CONFIGURATION,
    IDS,
    Grouping,
    ReportData,
    axis_label,
    by_configuration,
    configurations,
    drawn_bins,
    first_detector,
    group_labels,
    is_numeric,
)
from sweep.report.table import Table, cells, table_of

# --------------------------------------------------------------------------------------------------
# Figures that compare configurations: combinations of detector and estimator settings.

SIZE_COLUMNS = 12
MIN_DRAWN = 3
"""From this many values on, an axis of numbers has a figure along it, too."""



def _dot_panel(
    summary: xr.Dataset, names: list[str], name: str, title: str, unit: str, *,
    scale: float = 1.0, share: bool = False, level: float | None = None,
) -> Panel:
    dots = dots_of(summary, name, scale)
    label = f"{uncapitalised(title)}, {unit}" if unit else uncapitalised(title)
    return Panel(
        title, f"Rows of {label}, for each configuration.",
        lambda axes: draw_dots(axes, names, dots, label, share=share, level=level),
        height=rows_height(len(names)),
    )


def _configurations(data: ReportData) -> RenderedFigure:
    known = configurations(data)
    grouping, names, summary = known.settings.grouping, known.names, known.summary
    panels = [
        _dot_panel(summary, names, "solved_rate", "Solved", "%", scale=100, share=True),
        _dot_panel(summary, names, "rotation_median_deg", "Rotation error, median", "deg"),
        _dot_panel(summary, names, "range_median_percent", "Range error, median", "%"),
    ]
    if summary["solved"].sum() > 0:
        panels.append(
            _dot_panel(summary, names, "flip_rate", "Flipped", "%", scale=100, share=True))
    notes = list(grouping.notes)
    if data.size_axis is not None:
        panel, note = _map_by_size(data, grouping)
        panels.append(panel)
        notes += note
    return RenderedFigure(
        "configurations", f"Configurations compared: {', '.join(grouping.dims)}",
        sentences(
            "Share of the poses looked for that are solved, and the median errors, of each "
            "configuration on the same images; a pose that is not solved counts as an infinite "
            "error (right edge, \u221e).",
            FLOOR_NOTE.replace("lower", "left") if any(
                below_floor(summary[name].values) for name in (
                    "rotation_median_deg", "range_median_percent")) else "",
            interval_sentence(data, summary, "solved_rate"), denominators(summary), *notes,
            data.pooled(),
        ),
        table_of(summary, "Configurations, with 95 % intervals", [CONFIGURATION],
                 LOOKED_FOR | ERRORS | {"flipped, %": ("flip_rate", 100.0)}),
        panels,
    )


def _map_by_size(data: ReportData, grouping: Grouping) -> tuple[Panel, tuple[str, ...]]:
    """Return a map of the median rotation error over size and configuration, with notes."""
    axis = str(data.size_axis)
    sizes = data.along(axis, SIZE_COLUMNS)
    names, summary = by_configuration(
        data.pipeline, data.analysed(error_statistics, grouping + sizes), grouping.dims)
    values = summary["rotation_median_deg"].transpose(CONFIGURATION, axis).values
    return map_panel("Rotation error, median, deg", names, group_labels(summary, axis), values,
                     (data.label(axis), "")), sizes.notes


# Paired with the first configuration.

PAIRED = {
    "compared": ("compared", 1.0),
    "detected by it only": ("only_second_detected", 1.0),
    "detected by the first only": ("only_first_detected", 1.0),
    "detection difference, points": ("detection_difference", 100.0),
    "p (McNemar)": ("detection_p_value", 1.0),
    "both solved": ("both_solved", 1.0),
    "rotation difference, deg": ("rotation_difference_deg", 1.0),
    "rotation RMSE ratio": ("rotation_rmse_ratio", 1.0),
    "rotation RMSE ratio without flips": ("rotation_rmse_unflipped_ratio", 1.0),
    "flipped by it only": ("only_second_flipped", 1.0),
    "flipped by the first only": ("only_first_flipped", 1.0),
    "range difference, %": ("range_difference_percent", 1.0),
    "range RMSE ratio": ("range_rmse_ratio", 1.0),
}
"""Heading -> variable of `sweep.analysis.compare`, and the factor that it is multiplied by."""


def _paired(data: ReportData) -> RenderedFigure:
    grouping = configurations(data).settings.grouping
    results = data.results.isel({name: list(some) for name, some in grouping.chosen})
    summary = data.once("paired", lambda: compare(
        with_configuration(results, dict.fromkeys(grouping.dims, 0)), results, grouping.dims))
    names, differences = by_configuration(data.pipeline, summary, grouping.dims)
    others = differences.isel({CONFIGURATION: slice(1, None)})
    return RenderedFigure(
        "paired", f"Each configuration against the first: {names[0]}",
        sentences(
            f"Differences from {names[0]}, on the same scenes: detection rate in percentage "
            "points (to the right: detected more often), and the ratio of the RMSE of rotation "
            "(where neither is flipped) and range over the scenes that both solve (below 1: "
            "smaller errors).",
            interval_sentence(data, others, "detection_difference"),
            denominators(others, "compared", "pairs"), *grouping.notes,
            data.pooled(),
        ),
        table_of(others, f"Against {names[0]}, with 95 % intervals", [CONFIGURATION], PAIRED),
        [_dot_panel(others, names[1:], "detection_difference", "Detection, difference",
                    "points", scale=100, level=0.0),
         _dot_panel(others, names[1:], "rotation_rmse_unflipped_ratio",
                    "Rotation RMSE without flips, ratio", "", level=1.0),
         _dot_panel(others, names[1:], "range_rmse_ratio", "Range RMSE, ratio", "", level=1.0)],
    )


def _covered(data: ReportData) -> tuple[str, ...]:
    """Return the axes that need no figure of their own: those of words, and switches."""
    axes = {axis.name: axis for axis in data.pipeline.axes}
    return tuple(name for name in data.setting_axes
                 if len(configurations(data).settings.axes[name]) == data.length(name)
                 and (not is_numeric(axes[name]) or data.length(name) < MIN_DRAWN))


CONFIGURATIONS = FigureKind(
    "configurations", lambda data: bool(data.setting_axes), _configurations, _covered)
COMPARED = FigureKind("paired", lambda data: bool(data.setting_axes), _paired)


# --------------------------------------------------------------------------------------------------
# The figure of marker IDs, ordered by their detection rates.

WEAKEST = 24
"""Marker IDs that have a row of their own in the chart."""


def _render(data: ReportData) -> RenderedFigure:
    first, whose = first_detector(data)
    summary = data.once("marker_ranking", lambda: marker_ranking(data.results.isel(first)))
    dims = [name for name in ("dictionary", IDS) if name in summary["detection_rate"].dims]
    ranked = _weakest_first(summary, dims)
    names = [
        " ".join(str(ranked[dim].values[k]) for dim in dims) for k in range(ranked.sizes["marker"])
    ]
    count = int(ranked["weak"].sum())
    return RenderedFigure(
        "ranking", "Marker IDs, the weakest first" + (f": {whose}" if whose else ""),
        sentences(
            f"Detection rate of each ID{' of each dictionary' if len(dims) > 1 else ''}; the small "
            "upright line is the rate expected from its scenes if all IDs were alike.",
            f"{count:,} of {len(names):,} IDs are weak (diamonds): below the expected rate, "
            "with an adjusted p-value under 0.05." if count else
            f"None of {len(names):,} IDs is weak (adjusted p-value under 0.05).",
            interval_sentence(data, summary, "detection_rate"), denominators(summary),
            data.pooled(*dims),
        ),
        Table.of(
            "IDs by detection rate, with 95 % intervals",
            [*(axis_label(summary, dim) for dim in dims), "looked for", "detected, %",
             "expected, %", "p, adjusted", "weak"],
            [list(row) for row in zip(
                *([str(value) for value in ranked[dim].values.tolist()] for dim in dims),
                cells(ranked, "looked_for"), cells(ranked, "detection_rate", 100),
                cells(ranked, "expected_rate", 100), cells(ranked, "p_adjusted"),
                cells(ranked, "weak"), strict=True)],
            stub=len(dims),
        ),
        _panels(ranked, names),
    )


def _weakest_first(summary: xr.Dataset, dims: list[str]) -> xr.Dataset:
    """Return the IDs that were looked for, along ``marker``: weak ones first, then by rate."""
    ranked = summary.stack(marker=dims, create_index=False)
    ranked = ranked.isel(marker=np.flatnonzero(ranked["looked_for"].values > 0))
    order = np.lexsort(
        (ranked[IDS].values, ranked["detection_rate"].values, ~ranked["weak"].values))
    return ranked.isel(marker=order)


def _panels(ranked: xr.Dataset, names: list[str]) -> list[Panel]:
    weakest = ranked.isel(marker=slice(0, WEAKEST))
    dots = dots_of(weakest, "detection_rate", 100)
    expected = 100 * weakest["expected_rate"].values.astype(np.float64)
    weak = weakest["weak"].values.astype(bool)
    panels = [Panel(
        "Weakest IDs", "Rows of the weakest IDs with their detection rates in percent.",
        lambda axes: draw_dots(axes, names[:WEAKEST], dots, "detected, %", share=True,
                               marked=weak, ticks=expected),
        height=rows_height(len(names[:WEAKEST])),
    )]
    if len(names) > WEAKEST:
        rates = np.sort(100 * ranked["detection_rate"].values.astype(np.float64))
        rank = np.arange(1, len(rates) + 1, dtype=np.float64)
        line = Series("", rank, rates, rates * np.nan, rates * np.nan)
        panels.append(Panel(
            "All IDs", "Line of the detection rates of all IDs, in increasing order.",
            lambda axes: draw_lines(axes, [line], ("rank", "detected, %"), share=True)))
    return panels


RANKING = FigureKind("ranking", lambda data: data.length(IDS) > 1, _render, lambda _: (IDS,))


# --------------------------------------------------------------------------------------------------
# The figure of errors relative to the accuracy bound.

def _has_bound(data: ReportData) -> bool:
    if "bound" not in data.results:
        return False
    summary = data.once("has bound", lambda: xr.Dataset(
        {"any": data.results["bound"].isin(present_values(BoundStatus)).any()}))
    return bool(summary["any"])


def _render_bound_figure(data: ReportData) -> RenderedFigure:
    grouping = configurations(data).settings.grouping
    along = data.size_axis or data.angle_axis
    sizes = data.along(along, SIZE_COLUMNS) if along else Grouping()
    settings, per = list(grouping.dims), list(sizes.dims)
    ratio = _over_bound(data.analysed(efficiency, grouping + sizes))
    names, summary = by_configuration(data.pipeline, ratio, settings)
    columns = group_labels(summary, along) if along else ["all"]
    label = data.label(along) if along else ""

    return RenderedFigure(
        "bound", "Errors relative to the accuracy bound",
        sentences(
            "RMSE divided by the Cram\u00e9r-Rao bound, over the solved poses that are not "
            "flipped and have a bound: 1 is the best that an unbiased estimator can reach.",
            interval_sentence(data, summary, "rotation_over_bound", marks="In the table there"),
            *grouping.notes, *sizes.notes, data.pooled(*per),
        ),
        table_of(summary, "RMSE over the bound, with 95 % intervals", [CONFIGURATION, *per], {
            "rotation": ("rotation_over_bound", 1.0), "range": ("range_over_bound", 1.0),
        }, data.results),
        [map_panel(f"{quantity.capitalize()} RMSE over the bound", names, columns,
                   summary[f"{quantity}_over_bound"].transpose(CONFIGURATION, *per).values,
                   (label, "")) for quantity in ("rotation", "range")],
    )


def _over_bound(summary: xr.Dataset) -> xr.Dataset:
    """Return RMSE over bound, the inverse of efficiency, with the ends of its intervals."""
    ratios: dict[str, Any] = {}
    for quantity in ("rotation", "range"):
        for end, other in (("", ""), ("_low", "_high"), ("_high", "_low")):
            ratios[f"{quantity}_over_bound{end}"] = 1 / summary[f"{quantity}_efficiency{other}"]
    return xr.Dataset(ratios, summary.coords)


BOUND = FigureKind("bound", _has_bound, _render_bound_figure)


# --------------------------------------------------------------------------------------------------
# The figure of what thresholds on the ambiguity keep: of the poses, and of the flips.

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


def _render_ambiguity_figure(data: ReportData) -> RenderedFigure:
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
    legend_above(axes, columns=3)


def _map(
    data: ReportData, names: list[str], table: xr.Dataset, along: str, name: str, title: str,
    share: bool,
) -> Panel:
    part = table[name]
    part = part.sel(threshold=USUAL) if "threshold" in part.dims else part
    return map_panel(
        title, names[:MAX_ROWS], group_labels(table, along),
        part.transpose(CONFIGURATION, along).values[:MAX_ROWS], (data.label(along), ""),
        share=share)


def _table(
    data: ReportData, names: list[str], table: xr.Dataset, along: str | None, wanted: float
) -> Table:
    at_usual = table[["kept_rate", "kept_flipped", "rejected_right_rate"]]
    parts = {f"{name}{end}": table[f"{name}{end}"].sel(threshold=USUAL, drop=True)
             for name in at_usual for end in ("", "_low", "_high") if f"{name}{end}" in table}
    words = xr.apply_ufunc(np.vectorize(
        lambda flag: ANSWERS[ThresholdChoice(int(flag))], otypes=[object]), table["choice"])
    wanted_dims = [CONFIGURATION, *([along] if along else [])]
    return table_of(
        table.assign(parts).assign(choice=words).assign_coords({CONFIGURATION: names}),
        f"Thresholds on the ambiguity, with 95 % intervals; wanted: {wanted:g} % flips",
        wanted_dims, {
            "solved": ("solved", 1.0), "flips": ("flipped", 1.0),
            f"kept at {USUAL:g}, %": ("kept_rate", 100.0),
            f"flips kept at {USUAL:g}": ("kept_flipped", 1.0),
            f"right of the rejected at {USUAL:g}, %": ("rejected_right_rate", 100.0),
            f"{wanted:g} % by a threshold?": ("choice", 1.0),
            "threshold": ("chosen_threshold", 1.0), "kept there, %": ("chosen_kept_rate", 100.0),
            "flips there, %": ("chosen_flip_rate", 100.0),
            "right poses rejected there, %": ("chosen_right_rejected_rate", 100.0),
        }, data.results)


AMBIGUITY = FigureKind("ambiguity", _has_ratios, _render_ambiguity_figure)


# --------------------------------------------------------------------------------------------------
# The figure of the trials that conditions needed for a wanted precision, and what was reached.

def _applies(data: ReportData) -> bool:
    return isinstance(data.pipeline.stopping, PrecisionRule)


def _render_precision_figure(data: ReportData) -> RenderedFigure:
    table = data.once("precision_reached", lambda: precision_reached(data.results))
    run = _poses_of_conditions(table)
    most = int(table["poses"].max())
    settled = table["settled"].values
    return RenderedFigure(
        "precision", "Poses that the wanted precision needed",
        sentences(
            f"{int(settled.sum()):,} of {settled.size:,} conditions are settled: every quantity of "
            "every configuration is known as well as was wanted, or cannot be.",
            f"Of {most:,} poses each, {number(100 * float(run.sum()) / (most * run.size))} % were "
            f"computed: {int(run.min()):,} to {int(run.max()):,} a condition, median "
            f"{int(np.median(run)):,}.",
            "What is pooled over conditions is pooled over the trials that all of them have.",
        ),
        Table.of(
            "Conditions by what was reached; of rates the half-width of the interval, of others "
            "relative to the value (bias: to the RMSE)",
            ["quantity", "configuration", "wanted", "widest", *(
                f"{each.name.replace('_', ' ')}" for each in Reached)],
            _rows(table), stub=2),
        [_panel(run)] if run.size > 1 else [],
    )


def _poses_of_conditions(table: xr.Dataset) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Return the poses that were run of each condition, increasing."""
    configuration = table.attrs["configuration_dims"]
    first = table["run"].isel(dict.fromkeys(configuration, 0))
    return np.sort(first.values.ravel())


def _rows(table: xr.Dataset) -> list[list[str]]:
    configuration = table.attrs["configuration_dims"]
    rows = []
    for k, name in enumerate(table["quantity"].values):
        one = table.isel(quantity=k)
        for at in np.ndindex(*(table.sizes[dim] for dim in configuration)):
            part = one.isel(dict(zip(configuration, at, strict=True)))
            label = " · ".join(str(part[dim].values) for dim in configuration) or "all"
            half = part["half_width"].where(part["reached"].isin(
                (Reached.reached, Reached.not_reached)))
            rows.append([
                str(name), label, number(float(one["wanted"])), number(float(half.max())),
                *(f"{int((part['reached'] == flag).sum()):,}" for flag in Reached)])
    return rows


def _panel(run: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> Panel:
    rank = np.arange(1, run.size + 1, dtype=np.float64)
    poses = run.astype(np.float64)
    line = Series("", rank, poses, poses * np.nan, poses * np.nan)
    return Panel(
        "Poses by condition", "Line of the poses of all conditions, in increasing order.",
        lambda axes: draw_lines(axes, [line], ("condition, by poses", "poses")))


PRECISION = FigureKind("precision", _applies, _render_precision_figure)
