"""Figures that compare configurations: combinations of detector and estimator settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import xarray as xr

from sweep.analysis import compare, error_statistics
from sweep.report.charts import draw_dots, draw_map, rows_height
from sweep.report.configurations import configurations
from sweep.report.error_columns import ERRORS, LOOKED_FOR
from sweep.report.figure import (
    FigureKind,
    RenderedFigure,
    denominators,
    dots_of,
    interval_sentence,
    sentences,
    uncapitalised,
)
from sweep.report.grouping import (
    CONFIGURATION,
    Grouping,
    by_configuration,
    group_labels,
    is_numeric,
)
from sweep.report.report_data import ReportData
from sweep.report.scales import FLOOR_NOTE, below_floor
from sweep.report.svg import Panel
from sweep.report.table import Table, cells

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
        _table("Configurations, with 95 % intervals", names, summary,
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
    columns = group_labels(summary, axis)
    return Panel(
        "Rotation error, median, deg",
        f"Map of the median rotation error over {axis} and configuration.",
        lambda axes: draw_map(axes, names[::-1], columns, values[::-1], (data.label(axis), "")),
        wide=len(columns) > 6, height=rows_height(len(names)) + 0.3,
    ), sizes.notes


def _table(
    caption: str, names: list[str], summary: xr.Dataset,
    columns: Mapping[str, tuple[str, float]],
) -> Table:
    present = {heading: of for heading, of in columns.items() if of[0] in summary}
    texts = [cells(summary, name, scale) for name, scale in present.values()]
    rows = [[name, *(column[k] for column in texts)] for k, name in enumerate(names)]
    return Table(caption, [CONFIGURATION, *present], rows)


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
        _with_first_configuration(results, grouping.dims), results, grouping.dims))
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
        _table(f"Against {names[0]}, with 95 % intervals", names[1:], others, PAIRED),
        [_dot_panel(others, names[1:], "detection_difference", "Detection, difference",
                    "points", scale=100, level=0.0),
         _dot_panel(others, names[1:], "rotation_rmse_unflipped_ratio",
                    "Rotation RMSE without flips, ratio", "", level=1.0),
         _dot_panel(others, names[1:], "range_rmse_ratio", "Range RMSE, ratio", "", level=1.0)],
    )


def _with_first_configuration(results: xr.Dataset, settings: Sequence[str]) -> xr.Dataset:
    """Return results in which every configuration has the values of the first."""
    replaced = {}
    for name, variable in results.data_vars.items():
        dims = [dim for dim in settings if dim in variable.dims]
        if dims:
            first = variable.isel(dict.fromkeys(dims, 0), drop=True)
            replaced[name] = first.expand_dims({dim: results[dim] for dim in dims}).transpose(
                *variable.dims)
    return results.assign(replaced)


def _covered(data: ReportData) -> tuple[str, ...]:
    """Return the axes that need no figure of their own: those of words, and switches."""
    axes = {axis.name: axis for axis in data.pipeline.axes}
    return tuple(name for name in data.setting_axes
                 if len(configurations(data).settings.axes[name]) == data.length(name)
                 and (not is_numeric(axes[name]) or data.length(name) < MIN_DRAWN))


CONFIGURATIONS = FigureKind(
    "configurations", lambda data: bool(data.setting_axes), _configurations, _covered)
COMPARED = FigureKind("paired", lambda data: bool(data.setting_axes), _paired)
