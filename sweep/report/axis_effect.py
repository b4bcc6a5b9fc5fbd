"""The figure of an axis or a drawn parameter that no other shows: rates and errors along it."""

from __future__ import annotations

from sweep.analysis import error_statistics
from sweep.report.curves import curves_of
from sweep.report.error_columns import (
    DETECTED,
    ERROR_CURVES,
    ERRORS,
    INFINITE_ERRORS,
    RANGE_BIAS,
    RATES,
)
from sweep.report.figure import FigureKind, RenderedFigure, interval_sentence, sentences
from sweep.report.report_data import ReportData


def effect_of(name: str) -> FigureKind:
    """Return the kind of figure that shows the effect of one axis, or of a drawn parameter."""
    return FigureKind(f"effect-{name}",
                      lambda data: data.length(name) > 1 or name in data.drawn_parameters,
                      lambda data: _render(data, name), lambda _: (name,))


def _render(data: ReportData, name: str) -> RenderedFigure:
    axis = data.pipeline.axis(name)
    meaning = data.pipeline.parameters[name].declaration.meaning if axis is None else axis.meaning
    curves = curves_of(data, error_statistics, name, angles=False)
    return RenderedFigure(
        f"effect-{name}", f"The effect of {name}",
        sentences(
            "Detection rate, median and 95 % quantile (p95) of rotation and range error, and "
            f"signed mean of the range error (bias), by {name} ({meaning}).",
            interval_sentence(data, curves.summary, "detection_rate", marks="Bars and bands"),
            INFINITE_ERRORS, curves.remarks(),
        ),
        curves.table(f"By {name}, with 95 % intervals", RATES | ERRORS),
        curves.panels([DETECTED, *ERROR_CURVES, RANGE_BIAS]),
    )
