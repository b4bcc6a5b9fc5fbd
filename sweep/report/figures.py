"""The kinds of figures of a report, in the order in which they stand."""

from __future__ import annotations

from collections.abc import Iterator

from sweep.report.ambiguity_figure import AMBIGUITY
from sweep.report.axis_effect import effect_of
from sweep.report.bound_figure import BOUND
from sweep.report.configuration_figures import COMPARED, CONFIGURATIONS
from sweep.report.failure_figure import FAILURES
from sweep.report.figure import FigureKind
from sweep.report.frame_figure import FRAME
from sweep.report.precision_figure import PRECISION
from sweep.report.ranking_figure import RANKING
from sweep.report.report_data import ReportData
from sweep.report.scene_figures import BIAS, DETECTION, ERRORS_BY_SIZE, FLIPS, MAPS
from sweep.report.tradeoff_figure import TRADE

KINDS: tuple[FigureKind, ...] = (
    DETECTION, ERRORS_BY_SIZE, BIAS, CONFIGURATIONS, COMPARED, TRADE, MAPS, FLIPS, AMBIGUITY,
    FAILURES, FRAME, RANKING, BOUND, PRECISION,
)
"""Add a kind of figure here; what no kind covers of axes and draws gets a figure of its effect."""


def figure_kinds(data: ReportData) -> Iterator[FigureKind]:
    """Yield the kinds of figures of a store, such that one shows each axis and drawn parameter."""
    covered: set[str] = set()
    for kind in KINDS:
        if kind.applies(data):
            covered.update(kind.covers(data))
            yield kind
    for name in (*data.scene_axes, *data.setting_axes, *data.drawn_parameters):
        if name not in covered:
            yield effect_of(name)
