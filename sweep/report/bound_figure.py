"""The figure of errors relative to the accuracy bound."""

from __future__ import annotations

from typing import Any

import xarray as xr

from sweep.analysis import efficiency
from sweep.measure.flags import BoundStatus, present_values
from sweep.report.charts import draw_map, rows_height
from sweep.report.configuration_figures import SIZE_COLUMNS
from sweep.report.configurations import configurations
from sweep.report.figure import (
    FigureKind,
    RenderedFigure,
    interval_sentence,
    sentences,
    uncapitalised,
)
from sweep.report.grouping import (
    CONFIGURATION,
    Grouping,
    by_configuration,
    group_labels,
)
from sweep.report.report_data import ReportData
from sweep.report.svg import Panel
from sweep.report.table import Table, cells


def _has_bound(data: ReportData) -> bool:
    if "bound" not in data.results:
        return False
    summary = data.once("has bound", lambda: xr.Dataset(
        {"any": data.results["bound"].isin(present_values(BoundStatus)).any()}))
    return bool(summary["any"])


def _render(data: ReportData) -> RenderedFigure:
    grouping = configurations(data).settings.grouping
    along = data.size_axis or data.angle_axis
    sizes = data.along(along, SIZE_COLUMNS) if along else Grouping()
    settings, per = list(grouping.dims), list(sizes.dims)
    ratio = _over_bound(data.analysed(efficiency, grouping + sizes))
    names, summary = by_configuration(data.pipeline, ratio, settings)
    columns = group_labels(summary, along) if along else ["all"]
    label = data.label(along) if along else ""

    def panel(name: str, title: str) -> Panel:
        values = summary[name].transpose(CONFIGURATION, *per).values.reshape(len(names), -1)[::-1]
        return Panel(
            title,
            f"Map of {uncapitalised(title)} over {label or 'all poses'} and configuration.",
            lambda axes: draw_map(axes, names[::-1], columns, values, (label, "")),
            wide=len(columns) > 6, height=rows_height(len(names)) + 0.5,
        )

    rows = [
        [name, *(column,) * bool(along), *(
            cells(summary.isel({CONFIGURATION: k} | ({along: j} if along else {})), key)[0]
            for key in ("rotation_over_bound", "range_over_bound"))]
        for k, name in enumerate(names) for j, column in enumerate(columns)
    ]
    return RenderedFigure(
        "bound", "Errors relative to the accuracy bound",
        sentences(
            "RMSE divided by the Cram\u00e9r-Rao bound, over the solved poses that are not "
            "flipped and have a bound: 1 is the best that an unbiased estimator can reach.",
            interval_sentence(data, summary, "rotation_over_bound", marks="In the table there"),
            *grouping.notes, *sizes.notes, data.pooled(*per),
        ),
        Table("RMSE over the bound, with 95 % intervals",
              [CONFIGURATION, *([label] if along else []), "rotation", "range"], rows,
              stub=1 + bool(along)),
        [panel("rotation_over_bound", "Rotation RMSE over the bound"),
         panel("range_over_bound", "Range RMSE over the bound")],
    )


def _over_bound(summary: xr.Dataset) -> xr.Dataset:
    """Return RMSE over bound, the inverse of efficiency, with the ends of its intervals."""
    ratios: dict[str, Any] = {}
    for quantity in ("rotation", "range"):
        for end, other in (("", ""), ("_low", "_high"), ("_high", "_low")):
            ratios[f"{quantity}_over_bound{end}"] = 1 / summary[f"{quantity}_efficiency{other}"]
    return xr.Dataset(ratios, summary.coords)


BOUND = FigureKind("bound", _has_bound, _render)
