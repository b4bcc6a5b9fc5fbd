"""Figures of detection, errors and flips by the marker's size and tilt, or viewing angle."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis import detection_rate, error_statistics, flip_rate
from sweep.report.charts import draw_lines, draw_map
from sweep.report.error_columns import ERRORS, INFINITE_ERRORS, LOOKED_FOR, RATES
from sweep.report.figure import (
    FigureKind,
    RenderedFigure,
    denominators,
    interval_sentence,
    lines_of,
    sentences,
    uncapitalised,
)
from sweep.report.grouping import AREA, Grouping, group_labels
from sweep.report.report_data import ReportData
from sweep.report.svg import Panel
from sweep.report.table import table_of

MIN_BINNED_SIZES = 20
"""From this many sizes on, the detection rate is drawn against bins of the area."""

MAP_COLUMNS, MAP_ROWS = 24, 20
WIDE_FROM = 8
"""Panels with more groups take the whole width."""

SHORT_NAMES = {AREA: "area", "side_px": "size", "distance_m": "distance"}
LONG_NAMES = {AREA: "area in the image", "side_px": "side in the image", "distance_m": "distance"}
"""Names of the measures of size, in titles and in sentences."""


def long_name(name: str) -> str:
    """Return the name of an axis as it stands in sentences."""
    return LONG_NAMES.get(name, name)


def _short_name(name: str) -> str:
    return SHORT_NAMES.get(name, name)


def _by_angle(data: ReportData) -> str:
    return f", by {data.angle}" if data.angle else ""


def _size_axes(data: ReportData) -> list[str]:
    return [name for name in (data.size_axis, data.angle_axis) if name]


# Detection against size.

def _detection(data: ReportData) -> RenderedFigure:
    axis = data.size_axis
    areas = axis is None or data.length(axis) >= MIN_BINNED_SIZES
    along = AREA if areas else str(axis)
    grouping = data.by_angle() + data.along(along)
    summary = data.analysed(detection_rate, grouping)
    lines = lines_of(summary, along, "detection_rate", data.angle_axis, 100)
    label = data.label(along)
    return RenderedFigure(
        "detection", f"Detection rate by {_short_name(along)}",
        sentences(
            f"Share of the poses looked for in which the marker is detected, against its "
            f"{long_name(along)}{_by_angle(data)}.",
            interval_sentence(summary, "detection_rate", marks="Bands and bars").replace(
                "intervals over", "intervals (Wilson's) over"),
            denominators(summary), *grouping.notes, data.pooled(along, *grouping.dims),
        ),
        table_of(summary, "Detection rate, with 95 % intervals", grouping.dims,
                 RATES | {"draws": ("draws", 1)}, data.results),
        [Panel("Detected", f"Lines of the detection rate in percent against {label}.",
               lambda axes: draw_lines(axes, lines, (label, "detected, %"), share=True),
               wide=max((len(line.x) for line in lines), default=0) > WIDE_FROM)],
    )


# Errors against size.

def _errors(data: ReportData) -> RenderedFigure:
    along = str(data.size)
    grouping = data.by_angle() + data.along(along)
    summary = data.analysed(error_statistics, grouping)
    by = data.angle_axis
    label = data.label(along)

    def panel(name: str, title: str, unit: str) -> Panel:
        lines = lines_of(summary, along, name, by)
        return Panel(
            title, f"Lines of {uncapitalised(title)} in {unit} against {label}.",
            lambda axes: draw_lines(axes, lines, (label, f"{uncapitalised(title)}, {unit}")),
        )

    return RenderedFigure(
        "errors", f"Errors of the pose by {_short_name(along)}",
        sentences(
            f"Error of the estimated pose against the marker's {long_name(along)}"
            f"{_by_angle(data)}: median and 95 % quantile (p95) of the rotation error, median of "
            "the range error (depth, relative to the true depth), RMSE of range without flips.",
            "An error of 0 is drawn at the lower edge."
            if (summary["rotation_median_deg"] == 0).any() else "",
            interval_sentence(summary, "rotation_median_deg", "range_rmse_unflipped_percent",
                              marks="Bars and bands"), INFINITE_ERRORS,
            denominators(summary), *grouping.notes, data.pooled(along, *grouping.dims),
        ),
        table_of(summary, "Errors, with 95 % intervals", grouping.dims, LOOKED_FOR | ERRORS,
                 data.results),
        [panel("rotation_median_deg", "Rotation error, median", "deg"),
         panel("rotation_p95_deg", "Rotation error, p95", "deg"),
         panel("range_median_percent", "Range error, median", "%"),
         panel("range_rmse_unflipped_percent", "Range RMSE without flips", "%")],
    )


# Maps over size and angle.

def _over(data: ReportData) -> str:
    return f"{_short_name(str(data.size_axis))} and {data.angle}"


def _has_map(data: ReportData) -> bool:
    return data.size_axis is not None and data.angle_axis is not None


def _map_grouping(data: ReportData) -> Grouping:
    return data.along(str(data.angle_axis), MAP_ROWS) + data.along(str(data.size_axis), MAP_COLUMNS)


def _map_panel(
    data: ReportData, summary: xr.Dataset, name: str, title: str, *, share: bool = False
) -> Panel:
    along, angle = str(data.size_axis), str(data.angle_axis)
    rows, columns = group_labels(summary, angle), group_labels(summary, along)
    values = summary[name].transpose(angle, along).values.astype(np.float64)
    labels = (data.label(along), data.label(angle))
    return Panel(
        title, f"Map of {uncapitalised(title)} over {labels[0]} and {labels[1]}.",
        lambda axes: draw_map(axes, rows, columns, values, labels, share=share),
        wide=len(columns) > WIDE_FROM, height=max(2.6, 1.3 + 0.22 * len(rows)),
    )


def _maps(data: ReportData) -> RenderedFigure:
    grouping = _map_grouping(data)
    summary = data.analysed(error_statistics, grouping)
    return RenderedFigure(
        "maps", f"Detection and rotation error over {_over(data)}",
        sentences(
            "Detection rate in percent, and 95 % quantile of the rotation error in degrees; "
            "a pose that is not solved counts as an infinite error (\u221e).",
            denominators(summary), *grouping.notes, data.pooled(*grouping.dims),
        ),
        table_of(summary, "Detection rate and rotation error, with 95 % intervals", grouping.dims,
                 RATES | {"rotation p95, deg": ("rotation_p95_deg", 1.0)}, data.results),
        [_map_panel(data, summary, "detection_rate", "Detected, %", share=True),
         _map_panel(data, summary, "rotation_p95_deg", "Rotation error, p95, deg")],
    )


def _has_flips(data: ReportData) -> bool:
    return _has_map(data) and bool(data.analysed(flip_rate)["solved"] > 0)


def _flips(data: ReportData) -> RenderedFigure:
    grouping = _map_grouping(data)
    summary = data.analysed(flip_rate, grouping)
    return RenderedFigure(
        "flips", f"Flips to the mirrored pose over {_over(data)}",
        sentences(
            "Share of the solved poses that are nearer to the mirror of the truth than to the "
            f"truth, in percent. At a {data.angle} near 0 the mirror hardly differs from the "
            "truth.",
            denominators(summary, "solved", "solved poses"), *grouping.notes,
            data.pooled(*grouping.dims),
        ),
        table_of(summary, "Flip rate, with 95 % intervals", grouping.dims,
                 {"solved": ("solved", 1.0), "flipped, %": ("flip_rate", 100.0)}, data.results),
        [_map_panel(data, summary, "flip_rate", "Flipped, % of the solved", share=True)],
    )


DETECTION = FigureKind("detection", lambda data: data.size is not None, _detection, _size_axes)
ERRORS_BY_SIZE = FigureKind("errors", lambda data: data.size is not None, _errors, _size_axes)
MAPS = FigureKind("maps", _has_map, _maps)
FLIPS = FigureKind("flips", _has_flips, _flips)
