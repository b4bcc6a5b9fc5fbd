"""Figures of a report: for which stores they are made, their tables, panels, curves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr
from markupsafe import Markup

from sweep.analysis.dataset import of_photographs
from sweep.analysis.quantiles import IntervalOf
from sweep.plan.parameters import Stage
from sweep.report.charts import Panel, Series, draw_dots, draw_lines, draw_map, rows_height
from sweep.report.report_data import (
    BOTH,
    CONFIGURATION,
    Analysis,
    Grouping,
    ReportData,
    Settings,
    by_configuration,
    group_labels,
    is_numeric,
    settings_of,
    shown_lines,
    shown_note,
)
from sweep.report.table import Table, table_of
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Columns of rates and errors that several figures' tables share, and the curves of errors.

class Curve(NamedTuple):
    """A variable of an analysis that is drawn along an axis.

    Attributes
    ----------
    variable
        Its name.
    title, unit
        As they stand on the chart.
    scale
        What it is multiplied by.
    share
        Whether it is drawn from 0 to 100 %.
    signed
        Whether a line is drawn at 0.
    """

    variable: str
    title: str
    unit: str
    scale: float = 1.0
    share: bool = False
    signed: bool = False


Columns = dict[str, tuple[str, float]]
"""Heading -> variable of an analysis, and the factor that it is multiplied by."""

LOOKED_FOR: Columns = {"looked for": ("looked_for", 1.0)}
RATES: Columns = LOOKED_FOR | {"detected, %": ("detection_rate", 100.0)}
ERRORS: Columns = {
    "solved, %": ("solved_rate", 100.0),
    "rotation median, deg": ("rotation_median_deg", 1.0),
    "rotation p95, deg": ("rotation_p95_deg", 1.0),
    "rotation RMSE without flips, deg": ("rotation_rmse_unflipped_deg", 1.0),
    "range median, %": ("range_median_percent", 1.0),
    "range p95, %": ("range_p95_percent", 1.0),
    "range RMSE without flips, %": ("range_rmse_unflipped_percent", 1.0),
    "range bias, %": ("range_bias_percent", 1.0),
}
SIGNED_GROUPS = ("range", "camera_frame", "yaw_pitch_roll")
"""Kinds of errors, as `sweep.analysis.error_statistics` takes them."""

IN_MM, IN_DEG = ("x", "y", "z"), ("yaw", "pitch", "roll")
SIGNED_COLUMNS: Columns = {"solved": ("solved", 1.0)} | {
    f"{name} {words}, {unit}": (f"{name}_{statistic}_{stored}", scale)
    for names, unit, stored, scale in ((IN_MM, "mm", "m", 1000.0), (IN_DEG, "deg", "deg", 1.0))
    for name in names for words, statistic in (("bias", "bias"), ("SD", "sd"))
}
"""Bias and standard deviation along the camera's axes and about the angles."""

DETECTED = Curve("detection_rate", "Detected", "%", 100.0, share=True)
ERROR_CURVES = (
    Curve("rotation_median_deg", "Rotation error, median", "deg"),
    Curve("rotation_p95_deg", "Rotation error, p95", "deg"),
    Curve("range_median_percent", "Range error, median", "%"),
    Curve("range_p95_percent", "Range error, p95", "%"),
)
RANGE_BIAS = Curve("range_bias_percent", "Range bias", "%", signed=True)
SIGNED_CURVES = (
    RANGE_BIAS,
    *(Curve(f"{name}_bias_m", f"{name} bias", "mm", 1000.0, signed=True) for name in IN_MM),
    Curve("yaw_bias_deg", "Yaw bias", "deg", signed=True),
)
INFINITE_ERRORS = (
    "In median and p95 a pose that is not solved counts as an infinite error (drawn at the edge); "
    "an interval that reaches the edge ends beyond all draws."
)
"""Sentence of captions."""


# --------------------------------------------------------------------------------------------------
# Figures of a report: for which stores they are made, their tables, panels and captions.

@dataclass(frozen=True, slots=True)
class RenderedFigure:
    """A figure of one store.

    Attributes
    ----------
    name
        Its anchor on the page, and the name of its files.
    title, caption
        Text above and below it.
    table
        The numbers that it shows.
    panels
        Its drawings.
    svg
        Returns one drawing in place of panels as inline SVG; takes a prefix for its identifiers.
    write
        Writes that drawing into a file; the suffix of the path is the format.
    """

    name: str
    title: str
    caption: str
    table: Table
    panels: Sequence[Panel] = ()
    svg: Callable[[str], Markup] | None = None
    write: Callable[[str], None] | None = None


@dataclass(frozen=True, slots=True)
class FigureKind:
    """A kind of figure.

    Attributes
    ----------
    name
        Name of its figures.
    applies
        Whether a store has such a figure.
    render
        Makes the figure of a store to which the kind applies.
    covers
        The axes that need no figure of their own if the kind applies.
    """

    name: str
    applies: Callable[[ReportData], bool]
    render: Callable[[ReportData], RenderedFigure]
    covers: Callable[[ReportData], Sequence[str]] = lambda _: ()


def group_positions(summary: xr.Dataset, name: str) -> Floats:
    """Return the positions (n,) of groups on a numeric axis: values, or the middles of bins.

    The middle of a bin is the geometric mean of its ends if both are positive.
    """
    if f"{name}_low" in summary.coords:
        low, high = (
            np.asarray(summary[f"{name}_{end}"], dtype=np.float64) for end in ("low", "high")
        )
        return np.asarray(np.where(low > 0, np.sqrt(np.abs(low * high)), (low + high) / 2))
    return np.asarray(summary[name].values, dtype=np.float64)


def values_with_ends(
    summary: xr.Dataset, name: str, scale: float = 1.0
) -> tuple[Floats, Floats, Floats]:
    """Return a variable's values and the ends of its intervals, NaN without an interval."""
    value = np.asarray(summary[name].values, dtype=np.float64)
    low, high = (
        np.asarray(summary[f"{name}_{end}"].values, dtype=np.float64)
        if f"{name}_{end}" in summary else np.full(value.shape, np.nan)
        for end in ("low", "high")
    )
    return scale * value, scale * low, scale * high


def map_panel(
    title: str, rows: Sequence[str], columns: Sequence[str], values: Floats,
    labels: tuple[str, str], *, share: bool = False, upwards: bool = False,
    most_columns: int = 6, height: float | None = None,
) -> Panel:
    """Return a map of values (rows, columns), the first row at the top or, ``upwards``, lowest.

    ``labels`` are those of columns and rows; rows without one are configurations. A map of more
    columns than ``most_columns`` takes the whole width.
    """
    step = 1 if upwards else -1
    shown = np.asarray(values, dtype=np.float64).reshape(len(rows), -1)[::step]
    over = f"{labels[0] or 'all poses'} and {labels[1] or CONFIGURATION}"
    return Panel(
        title, f"Map of {uncapitalised(title)} over {over}.",
        lambda axes: draw_map(axes, rows[::step], columns, shown, labels, share=share),
        wide=len(columns) > most_columns,
        height=rows_height(len(rows)) + 0.5 if height is None else height,
    )


def dots_of(summary: xr.Dataset, name: str, scale: float = 1.0) -> Series:
    """Return a variable (n,) and its intervals as the dots of n rows."""
    value, low, high = values_with_ends(summary, name, scale)
    return Series("", value, value, low, high)


def lines_of(
    summary: xr.Dataset, along: str, name: str, by: str | None, scale: float = 1.0
) -> list[Series]:
    """Return a line of ``name`` along an axis for each value of ``by``, without NaN."""
    x = group_positions(summary, along)
    order = np.argsort(x)
    parts = (
        [(f"{by.removesuffix('_deg')} {label}\u00b0" if by.endswith("_deg") else f"{label}",
          summary.isel({by: k})) for k, label in enumerate(group_labels(summary, by))]
        if by is not None else [("", summary)]
    )
    lines = []
    for label, part in parts:
        value, low, high = values_with_ends(part, name, scale)
        known = order[~np.isnan(value[order])]
        lines.append(Series(label, x[known], value[known], low[known], high[known]))
    return lines


def interval_sentence(
    data: ReportData, summary: xr.Dataset, *names: str, marks: str = "Bars"
) -> str:
    """Return a sentence that says what the drawn intervals are, or why there are none."""
    ends = [summary[f"{name}_{end}"] for name in names for end in ("low", "high")
            if f"{name}_{end}" in summary]
    photographs = of_photographs(data.results)
    if any(bool(np.isfinite(end).any()) for end in ends):
        drawn = (
            "photographs, each with all its markers one draw" if photographs
            else "random draws, conditional on the grid"
        )
        return f"{marks} are 95 % intervals over the {drawn}."
    if photographs:
        return "No intervals: too few photographs."
    few = "median_interval" in summary and bool(
        (summary["median_interval"] == IntervalOf.too_few_draws).any())
    return "No intervals: too few draws." if few else (
        "No intervals: nothing was drawn at random.")


def denominators(
    summary: xr.Dataset, name: str = "looked_for", what: str = "poses looked for"
) -> str:
    """Return a sentence with the denominators: ``Each value is of 40 to 200 poses ...``."""
    counts = summary[name].values[summary[name].values > 0]
    if not counts.size:
        return f"No {what}."
    low, high = int(counts.min()), int(counts.max())
    span = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"Each value is of {span} {what}."


def uncapitalised(title: str) -> str:
    """Return a title as it stands within a sentence or on an axis."""
    return title[0].lower() + title[1:]


def sentences(*parts: str) -> str:
    """Return the parts that are not empty, joined by spaces."""
    return " ".join(part for part in parts if part)


# --------------------------------------------------------------------------------------------------
# Rates and errors along one axis, a line for each configuration: none of them is pooled.

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
