"""Rates and errors along one axis, a line for each configuration: none of them is pooled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import xarray as xr

from sweep.plan.parameters import Stage
from sweep.report.charts import draw_dots, draw_lines, rows_height
from sweep.report.configurations import (
    BOTH,
    Settings,
    settings_of,
    shown_lines,
    shown_note,
)
from sweep.report.curve import Curve
from sweep.report.error_columns import Columns
from sweep.report.figure import denominators, dots_of, lines_of, sentences, uncapitalised
from sweep.report.grouping import (
    CONFIGURATION,
    Grouping,
    by_configuration,
    group_labels,
    is_numeric,
)
from sweep.report.report_data import Analysis, ReportData
from sweep.report.svg import Panel
from sweep.report.table import Table, table_of

MAX_BINS, MAX_ROWS = 40, 24
"""Groups of a numeric axis, and of any other."""

MAX_ANGLES, MAX_ANGLE_PANELS = 6, 2
"""Angles that are lines of one configuration, and panels of several."""

WIDE_FROM = 8
"""A figure of one panel takes the whole width if it has more groups."""


@dataclass(frozen=True, eq=False)
class Curves:
    """An analysis along an axis.

    Attributes
    ----------
    data
        The store.
    along
        The axis, the area, or a drawn parameter.
    by
        The axis of angles that are told apart, or None.
    settings
        The configurations.
    summary
        The analysis (configuration, by, along).
    notes
        Sentences for the reader on bins and chosen values.
    """

    data: ReportData
    along: str
    by: str | None
    settings: Settings
    summary: xr.Dataset
    notes: tuple[str, ...]

    @property
    def numeric(self) -> bool:
        """Whether the axis is one of numbers."""
        axis = self.data.pipeline.axis(self.along)
        return axis is None or is_numeric(axis)

    @property
    def several(self) -> bool:
        """Whether there is more than one configuration."""
        return self.summary.sizes[CONFIGURATION] > 1

    @property
    def dims(self) -> tuple[str, ...]:
        """The dimensions that tell rows of a table apart."""
        return tuple(name for name in (CONFIGURATION, self.by, self.along)
                     if name and (name != CONFIGURATION or self.several))

    def panels(self, curves: Sequence[Curve]) -> list[Panel]:
        """Return the charts of some variables; those of several configurations by angle."""
        if not self.numeric:
            return [self._rows(curve) for curve in curves if curve.variable in self.summary]
        parts: list[tuple[str, xr.Dataset, str | None]] = [("", self.summary, CONFIGURATION)]
        if not self.several:
            parts = [("", self.summary.isel({CONFIGURATION: 0}), self.by)]
        elif self.by is not None:
            parts = [
                (f", {self.by.removesuffix('_deg').replace('_', ' ')} {label}\u00b0",
                 self.summary.isel({self.by: k}), CONFIGURATION)
                for k, label in enumerate(group_labels(self.summary, self.by))
            ]
        if self.several:
            shown = shown_lines(self.data, self.settings)
            parts = [(label, part.isel({CONFIGURATION: shown}), by) for label, part, by in parts]
        alone = len(curves) * len(parts) == 1
        return [self._lines(curve, *part, alone=alone) for curve in curves for part in parts
                if curve.variable in self.summary]

    def _lines(
        self, curve: Curve, suffix: str, part: xr.Dataset, by: str | None, *, alone: bool
    ) -> Panel:
        lines = lines_of(part, self.along, curve.variable, by, curve.scale)
        label = self.data.label(self.along)
        quantity = f"{uncapitalised(curve.title)}, {curve.unit}"
        return Panel(
            curve.title + suffix,
            f"Lines of {uncapitalised(curve.title)}{suffix} in {curve.unit} against {label}.",
            lambda axes: draw_lines(axes, lines, (label, quantity), share=curve.share,
                                    level=0.0 if curve.signed else None),
            wide=alone and self.summary.sizes[self.along] > WIDE_FROM,
        )

    def _rows(self, curve: Curve) -> Panel:
        """Return the chart of an axis of words: a row for each value and configuration."""
        shown = shown_lines(self.data, self.settings)
        part = self.summary.isel({CONFIGURATION: shown})
        rows = part.stack(row=[self.along, CONFIGURATION], create_index=False)
        values = group_labels(self.summary, self.along)
        names = [f"{value}, {name}" if self.several else value
                 for value in values for name in part[CONFIGURATION].values.tolist()]
        dots = dots_of(rows, curve.variable, curve.scale)
        quantity = f"{uncapitalised(curve.title)}, {curve.unit}"
        return Panel(
            curve.title, f"Rows of {uncapitalised(curve.title)} in {curve.unit} for each "
                         f"{self.along}.",
            lambda axes: draw_dots(axes, names, dots, quantity, share=curve.share,
                                   level=0.0 if curve.signed else None),
            height=rows_height(len(names)),
        )

    def table(self, caption: str, columns: Columns) -> Table:
        """Return the table of all configurations."""
        summary = self.summary if self.several else self.summary.isel({CONFIGURATION: 0})
        return table_of(summary, caption, self.dims, columns, self.data.results)

    def remarks(self, counted: str = "looked_for", what: str = "poses looked for") -> str:
        """Return sentences on denominators, what is shown, and what is pooled."""
        count = self.summary.sizes[CONFIGURATION]
        note = shown_note(shown_lines(self.data, self.settings), count)
        return sentences(
            denominators(self.summary, counted, what), note, *self.notes,
            self.data.pooled(self.along, *self.dims))


def curves_of(
    data: ReportData, analysis: Analysis, along: str, stages: Sequence[Stage] = BOTH, *,
    angles: bool = True,
) -> Curves:
    """Return an analysis along an axis by configuration and, if ``angles``, by angle.

    ``stages`` are those whose settings make a difference: of the detection rate the detector's.
    """
    settings = settings_of(data, stages, without=(along,))
    several = len(settings.combinations) > 1
    axis = data.pipeline.axis(along)
    groups = data.along(along, MAX_BINS if axis is None or is_numeric(axis) else MAX_ROWS)
    by = Grouping()
    if angles and along != data.angle_axis:
        by = data.by_angle(MAX_ANGLE_PANELS if several else MAX_ANGLES, binned=not several)
    grouping = settings.grouping + by + groups
    _, summary = by_configuration(
        data.pipeline, data.analysed(analysis, grouping), settings.grouping.dims)
    return Curves(data, along, by.dims[0] if by.dims else None, settings, summary, grouping.notes)


