"""Figures of detection, errors and flips by the marker's size and tilt, or viewing angle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from sweep.analysis import detection_rate, error_statistics, flip_rate
from sweep.analysis.binning import Bins
from sweep.plan.boards import target_word
from sweep.plan.parameters import Stage
from sweep.report.board_text import detected_words
from sweep.report.charts import draw_map
from sweep.report.configurations import BOTH, settings_of, shown_lines, shown_note
from sweep.report.curves import WIDE_FROM, curves_of
from sweep.report.error_columns import (
    DETECTED,
    ERROR_CURVES,
    ERRORS,
    INFINITE_ERRORS,
    LOOKED_FOR,
    RATES,
    SIGNED,
    SIGNED_CURVES,
    SIGNED_GROUPS,
)
from sweep.report.figure import (
    FigureKind,
    RenderedFigure,
    denominators,
    interval_sentence,
    sentences,
    uncapitalised,
)
from sweep.report.grouping import AREA, CONFIGURATION, Grouping, by_configuration, group_labels
from sweep.report.question import course_of
from sweep.report.report_data import Analysis, ReportData
from sweep.report.scales import FLOOR_NOTE, below_floor
from sweep.report.svg import Panel
from sweep.report.table import Table, table_of

MIN_BINNED_SIZES = 20
"""From this many sizes on, the detection rate is drawn against bins of the area."""

MAP_COLUMNS, MAP_ROWS = 24, 20
MAX_MAPPED = 3
"""Configurations that have maps of their own."""

SHORT_NAMES = {AREA: "area", "side_px": "size", "distance_m": "distance", "size_m": "marker size"}
LONG_NAMES = {AREA: "area in the image", "side_px": "side in the image",
              "distance_m": "distance", "size_m": "size"}
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
    curves = curves_of(data, detection_rate, along, (Stage.detection,))
    return RenderedFigure(
        "detection", f"Detection rate by {_short_name(along)}",
        sentences(
            f"Share of the poses looked for in which {detected_words(data)}, against its "
            f"{long_name(along)}{_by_angle(data)}.",
            interval_sentence(
                data, curves.summary, "detection_rate", marks="Bands and bars"
            ).replace("intervals over", "intervals (Wilson's) over"),
            curves.remarks(),
        ),
        curves.table("Detection rate, with 95 % intervals", RATES | {"draws": ("draws", 1)}),
        curves.panels([DETECTED]),
    )


# Errors against size.

def _errors(data: ReportData) -> RenderedFigure:
    along = str(data.size)
    curves = curves_of(data, error_statistics, along)
    return RenderedFigure(
        "errors", f"Errors of the pose by {_short_name(along)}",
        sentences(
            f"Error of the estimated pose against the {target_word(data.pipeline)}'s "
            f"{long_name(along)}{_by_angle(data)}: median and 95 % quantile (p95) of "
            "the rotation error and of the range error (depth, relative to the true depth).",
            FLOOR_NOTE if any(below_floor(curves.summary[each.variable].values)
                              for each in ERROR_CURVES) else "",
            interval_sentence(data, curves.summary, "rotation_median_deg", "range_p95_percent",
                              marks="Bars and bands"), INFINITE_ERRORS, curves.remarks(),
        ),
        curves.table("Errors, with 95 % intervals", LOOKED_FOR | ERRORS),
        curves.panels(ERROR_CURVES),
    )


# Bias along the axes.

def signed_error_statistics(
    results: xr.Dataset, per: Sequence[str], bins: Bins
) -> xr.Dataset:
    """Return bias and spread of the range, of x, y and z in the camera's frame, and of angles."""
    return error_statistics(results, per, bins, SIGNED_GROUPS)


def signed_axis(data: ReportData) -> str | None:
    """Return the axis along which bias is shown: of sizes, other numbers, or angles."""
    along = course_of(data, data.per).along
    return along if along not in (None, data.angle_axis) else data.size or data.angle_axis


def _signed(data: ReportData) -> RenderedFigure:
    along = str(signed_axis(data))
    curves = curves_of(data, signed_error_statistics, along, angles=False)
    return RenderedFigure(
        "bias", f"Bias by {_short_name(along)}",
        sentences(
            f"Mean error of the solved poses that are not flipped, estimated minus true, against "
            f"the {long_name(along)}: the range in percent of the true depth; x (right), y (down) "
            f"and z (forward) of the {target_word(data.pipeline)}'s position in the camera's "
            "frame; yaw. The table also has the standard deviations, and pitch and roll.",
            interval_sentence(
                data, curves.summary, "z_bias_m", "yaw_bias_deg", marks="Bars and bands"
            ),
            curves.remarks("solved", "solved poses"),
        ),
        curves.table("Bias and standard deviation, with 95 % intervals", SIGNED),
        curves.panels(SIGNED_CURVES),
    )


# Maps over size and angle.

def _over(data: ReportData) -> str:
    return f"{_short_name(str(data.size_axis))} and {data.angle}"


def _has_map(data: ReportData) -> bool:
    return data.size_axis is not None and data.angle_axis is not None


class _Maps:
    """An analysis over size and angle, by configuration."""

    def __init__(
        self, data: ReportData, analysis: Analysis, stages: Sequence[Stage] = BOTH
    ) -> None:
        self.data = data
        self.along, self.angle = str(data.size_axis), str(data.angle_axis)
        settings = settings_of(data, stages)
        grouping: Grouping = settings.grouping + data.along(self.angle, MAP_ROWS) + data.along(
            self.along, MAP_COLUMNS)
        self.names, self.summary = by_configuration(
            data.pipeline, data.analysed(analysis, grouping), settings.grouping.dims)
        self.several = len(self.names) > 1
        self.shown = shown_lines(data, settings, MAX_MAPPED)
        self.notes = (shown_note(self.shown, len(self.names)), *grouping.notes,
                      data.pooled(self.along, self.angle))

    def panels(self, name: str, title: str, *, share: bool = False) -> list[Panel]:
        """Return a map of a variable for each configuration that is shown."""
        return [self._panel(k, name, title, share=share) for k in self.shown]

    def _panel(self, k: int, name: str, title: str, *, share: bool) -> Panel:
        part = self.summary.isel({CONFIGURATION: k})
        rows, columns = group_labels(part, self.angle), group_labels(part, self.along)
        values = part[name].transpose(self.angle, self.along).values.astype(np.float64)
        labels = (self.data.label(self.along), self.data.label(self.angle))
        whose = f", {self.names[k]}" if self.several else ""
        return Panel(
            title + whose,
            f"Map of {uncapitalised(title)}{whose} over {labels[0]} and {labels[1]}.",
            lambda axes: draw_map(axes, rows, columns, values, labels, share=share),
            wide=len(columns) > WIDE_FROM, height=max(2.6, 1.3 + 0.22 * len(rows)),
        )

    def table(self, caption: str, columns: dict[str, tuple[str, float]]) -> Table:
        """Return the table of all configurations."""
        dims = [self.angle, self.along]
        if self.several:
            return table_of(
                self.summary, caption, [CONFIGURATION, *dims], columns, self.data.results)
        return table_of(
            self.summary.isel({CONFIGURATION: 0}), caption, dims, columns, self.data.results)


def _maps(data: ReportData) -> RenderedFigure:
    maps = _Maps(data, error_statistics)
    detected = maps if not maps.several else _Maps(data, detection_rate, (Stage.detection,))
    return RenderedFigure(
        "maps", f"Detection and rotation error over {_over(data)}",
        sentences(
            "Detection rate in percent, and 95 % quantile of the rotation error in degrees; "
            "a pose that is not solved counts as an infinite error (\u221e).",
            denominators(maps.summary), *maps.notes,
        ),
        maps.table("Detection rate and rotation error, with 95 % intervals",
                   RATES | {"rotation p95, deg": ("rotation_p95_deg", 1.0)}),
        [*detected.panels("detection_rate", "Detected, %", share=True),
         *maps.panels("rotation_p95_deg", "Rotation error, p95, deg")],
    )


def _has_flips(data: ReportData) -> bool:
    return _has_map(data) and bool(data.analysed(flip_rate)["solved"] > 0)


def _flips(data: ReportData) -> RenderedFigure:
    maps = _Maps(data, flip_rate)
    return RenderedFigure(
        "flips", f"Flips to the mirrored pose over {_over(data)}",
        sentences(
            "Share of the solved poses that are nearer to the mirror of the truth than to the "
            f"truth, in percent. At a {data.angle} near 0 the mirror hardly differs from the "
            "truth.",
            denominators(maps.summary, "solved", "solved poses"), *maps.notes,
        ),
        maps.table("Flip rate, with 95 % intervals",
                   {"solved": ("solved", 1.0), "flipped, %": ("flip_rate", 100.0)}),
        maps.panels("flip_rate", "Flipped, % of the solved", share=True),
    )


DETECTION = FigureKind("detection", lambda data: data.size is not None, _detection, _size_axes)
ERRORS_BY_SIZE = FigureKind("errors", lambda data: data.size is not None, _errors, _size_axes)
BIAS = FigureKind("bias", lambda data: signed_axis(data) is not None, _signed)
MAPS = FigureKind("maps", _has_map, _maps)
FLIPS = FigureKind("flips", _has_flips, _flips)
