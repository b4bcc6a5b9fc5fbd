"""The figure of an axis or a drawn parameter that no other shows: rates and errors along it."""

from __future__ import annotations

from sweep.analysis import error_statistics
from sweep.report.charts import draw_dots, draw_lines, rows_height
from sweep.report.error_columns import ERRORS, INFINITE_ERRORS, RATES
from sweep.report.figure import (
    FigureKind,
    RenderedFigure,
    denominators,
    dots_of,
    interval_sentence,
    lines_of,
    sentences,
    uncapitalised,
)
from sweep.report.grouping import group_labels, is_numeric
from sweep.report.report_data import ReportData
from sweep.report.svg import Panel
from sweep.report.table import table_of

MAX_BINS, MAX_ROWS = 40, 24
"""Groups of a numeric axis, and of any other."""


def effect_of(name: str) -> FigureKind:
    """Return the kind of figure that shows the effect of one axis, or of a drawn parameter."""
    return FigureKind(f"effect-{name}",
                      lambda data: data.length(name) > 1 or name in data.drawn_parameters,
                      lambda data: _render(data, name), lambda _: (name,))


def _render(data: ReportData, name: str) -> RenderedFigure:
    axis = data.pipeline.axis(name)
    meaning = data.pipeline.parameters[name].declaration.meaning if axis is None else axis.meaning
    numeric = axis is None or is_numeric(axis)
    grouping = data.along(name, MAX_BINS if numeric else MAX_ROWS)
    summary = data.analysed(error_statistics, grouping)
    label = data.label(name)

    def panel(variable: str, title: str, unit: str, scale: float = 1.0) -> Panel:
        share = scale != 1
        quantity = f"{uncapitalised(title)}, {unit}"
        if numeric:
            lines = lines_of(summary, name, variable, None, scale)
            return Panel(title, f"Line of {uncapitalised(title)} in {unit} against {label}.",
                         lambda axes: draw_lines(axes, lines, (label, quantity), share=share))
        names = group_labels(summary, name)
        dots = dots_of(summary, variable, scale)
        return Panel(title, f"Rows of {uncapitalised(title)} in {unit} for each {name}.",
                     lambda axes: draw_dots(axes, names, dots, quantity, share=share),
                     height=rows_height(len(names)))

    return RenderedFigure(
        f"effect-{name}", f"The effect of {name}",
        sentences(
            f"Detection rate, and median and 95 % quantile of the rotation error, by {name} "
            f"({meaning}).",
            interval_sentence(summary, "detection_rate", marks="Bars and bands"), INFINITE_ERRORS,
            denominators(summary),
            *grouping.notes, data.pooled(*grouping.dims),
        ),
        table_of(summary, f"By {name}, with 95 % intervals", grouping.dims, RATES | ERRORS,
                 data.results),
        [panel("detection_rate", "Detected", "%", 100),
         panel("rotation_median_deg", "Rotation error, median", "deg"),
         panel("rotation_p95_deg", "Rotation error, p95", "deg"),
         panel("range_median_percent", "Range error, median", "%")],
    )
