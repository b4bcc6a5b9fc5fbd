"""Figures of a report as data: an analysis by configuration along axes, and what shows it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr

from sweep.analysis.dataset import of_photographs
from sweep.analysis.quantiles import IntervalOf
from sweep.experiment.parameters import Stage
from sweep.report.charts import (
    FLOOR_NOTE,
    Panel,
    Series,
    below_floor,
    draw_dots,
    draw_lines,
    draw_map,
    draw_stack,
    rows_height,
)
from sweep.report.report_data import (
    BOTH,
    CONFIGURATION,
    MAX_CONFIGURATIONS,
    MAX_LINES,
    Analysis,
    Grouping,
    ReportData,
    Settings,
    by_configuration,
    group_labels,
    is_numeric,
    most_exact_first,
    settings_of,
)
from sweep.report.table import Columns, Table, table_of
from sweep.typing import Floats


class Curve(NamedTuple):
    """A variable of an analysis that is drawn.

    Attributes
    ----------
    variable
        Its name.
    title, unit
        As they stand on the chart.
    scale
        Factor by which it is multiplied.
    share
        Whether it is drawn from 0 to 100 %.
    level
        Where a dashed line is drawn, such as at 0 for a bias; None for none.
    """

    variable: str
    title: str
    unit: str = ""
    scale: float = 1.0
    share: bool = False
    level: float | None = None

    @property
    def label(self) -> str:
        """Title and unit as they stand on an axis."""
        words = uncapitalised(self.title)
        return f"{words}, {self.unit}" if self.unit else words


@dataclass(frozen=True, slots=True)
class Figure:
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
    covers
        Axes that need no figure of their own beside this one.
    """

    name: str
    title: str
    caption: str
    table: Table
    panels: Sequence[Panel]
    covers: Sequence[str] = ()


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


def dots_of(summary: xr.Dataset, name: str, scale: float = 1.0) -> Series:
    """Return a variable (n,) and its intervals as the dots of n rows."""
    value, low, high = values_with_ends(summary, name, scale)
    return Series("", value, value, low, high)


def map_panel(
    title: str, rows: Sequence[str], columns: Sequence[str], values: Floats,
    labels: tuple[str, str], *, share: bool = False, upwards: bool = False,
) -> Panel:
    """Return a map of values (rows, columns), the first row at the top or, ``upwards``, lowest.

    ``labels`` are those of columns and rows; rows without one are configurations.
    """
    step = 1 if upwards else -1
    shown = np.asarray(values, dtype=np.float64).reshape(len(rows), -1)[::step]
    over = f"{labels[0] or 'all poses'} and {labels[1] or CONFIGURATION}"
    return Panel(
        title, f"Map of {uncapitalised(title)} over {over}.",
        lambda axes: draw_map(axes, rows[::step], columns, shown, labels, share=share),
        wide=len(columns) > WIDE_FROM, height=max(2.6, rows_height(len(rows)) + 0.5),
    )


def denominators(summary: xr.Dataset, name: str = "looked_for") -> str:
    """Return a sentence with the denominators: ``Each value is of 40 to 200 poses ...``."""
    what = {"looked_for": "poses looked for", "solved": "solved poses"}[name]
    counts = summary[name].values[summary[name].values > 0]
    if not counts.size:
        return f"No {what}."
    low, high = int(counts.min()), int(counts.max())
    span = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"Each value is of {span} {what}."


def interval_sentence(data: ReportData, summary: xr.Dataset) -> str:
    """Return a sentence that says what intervals are over, or why there are none."""
    photographs = of_photographs(data.results)
    ends = [each for name, each in summary.items() if str(name).endswith(("_low", "_high"))]
    if any(bool(np.isfinite(end).any()) for end in ends):
        return "Intervals have 95 % and are over the " + (
            "photographs, each with all its markers one draw." if photographs
            else "random draws, conditional on the grid.")
    if photographs:
        return "No intervals: too few photographs."
    few = "median_interval" in summary and bool(
        (summary["median_interval"] == IntervalOf.too_few_draws).any())
    return "No intervals: too few draws." if few else (
        "No intervals: nothing was drawn at random.")


def uncapitalised(title: str) -> str:
    """Return a title as it stands within a sentence or on an axis."""
    return title[0].lower() + title[1:]


def sentences(*parts: str) -> str:
    """Return the parts that are not empty, joined by spaces."""
    return " ".join(part for part in parts if part)


# --------------------------------------------------------------------------------------------------
# An analysis by configuration and groups: what lines, rows, maps, bars and tables show.

MAX_BINS, MAX_ROWS = 40, 24
"""Groups of a numeric axis, and of any other."""

MAX_ANGLES, MAX_ANGLE_PANELS = 6, 2
"""Angles that are lines of one configuration, and panels of several."""

MAX_MAPPED = 3
"""Configurations that have a map, or bars, of their own."""

WIDE_FROM = 8
"""A panel alone, or a map, takes the whole width if it has more groups along x."""


@dataclass(frozen=True, eq=False)
class Grouped:
    """An analysis by configuration and groups of poses. No configuration is pooled.

    Attributes
    ----------
    data
        The store.
    settings
        The configurations.
    summary
        The analysis (configuration, *dims).
    dims
        Dimensions of the groups; the last one is along x.
    notes
        Sentences for the reader on bins and chosen values.
    """

    data: ReportData
    settings: Settings
    summary: xr.Dataset
    dims: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def names(self) -> list[str]:
        """The labels of the configurations."""
        return [str(name) for name in self.summary[CONFIGURATION].values]

    @property
    def several(self) -> bool:
        """Whether there is more than one configuration."""
        return len(self.names) > 1

    def shown(self, most: int) -> list[int]:
        """Return which configurations are drawn: the first in order, as they stand in the grid."""
        return sorted(most_exact_first(self.data, self.settings)[:most])

    def labels(self, name: str) -> list[str]:
        """Return the groups of a dimension as text."""
        return group_labels(self.summary, name)

    def panels(self, curves: Sequence[Curve]) -> list[Panel]:
        """Return charts of some variables.

        Along a numeric axis they are lines, of several configurations one for each, in a panel for
        each angle; targets, words, or configurations alone are rows with intervals.
        """
        curves = [curve for curve in curves if curve.variable in self.summary]
        axis = self.data.pipeline.axis(self.dims[-1]) if self.dims else None
        if not self.dims or (axis is not None and not is_numeric(axis)):
            return [self._rows(curve) for curve in curves]
        by = self.dims[0] if len(self.dims) > 1 else None
        parts: list[tuple[str, xr.Dataset, str | None]] = [("", self.summary, CONFIGURATION)]
        if not self.several:
            parts = [("", self.summary.isel({CONFIGURATION: 0}), by)]
        elif by is not None:
            parts = [(f", {by.removesuffix('_deg').replace('_', ' ')} {label}\u00b0",
                      self.summary.isel({by: k}), CONFIGURATION)
                     for k, label in enumerate(self.labels(by))]
        if self.several:
            shown = self.shown(MAX_LINES)
            parts = [(label, part.isel({CONFIGURATION: shown}), by) for label, part, by in parts]
        alone = len(curves) * len(parts) == 1
        return [self._lines(curve, *part, alone=alone) for curve in curves for part in parts]

    def _lines(
        self, curve: Curve, suffix: str, part: xr.Dataset, by: str | None, *, alone: bool
    ) -> Panel:
        along = self.dims[-1]
        x = _positions(part, along)
        order = np.argsort(x)
        lines = []
        for k, label in enumerate([""] if by is None else group_labels(part, by)):
            one = part if by is None else part.isel({by: k})
            value, low, high = values_with_ends(one, curve.variable, curve.scale)
            known = order[~np.isnan(value[order])]
            name = f"{by.removesuffix('_deg')} {label}\u00b0" if (by or "").endswith("_deg") and (
                by is not None) else label
            lines.append(Series(name, x[known], value[known], low[known], high[known]))
        label = self.data.label(along)
        return Panel(
            curve.title + suffix, f"Lines of {curve.label}{suffix} against {label}.",
            lambda axes: draw_lines(
                axes, lines, (label, curve.label), share=curve.share, level=curve.level),
            wide=alone and len(x) > WIDE_FROM,
        )

    def _rows(self, curve: Curve) -> Panel:
        part = self.summary.isel(
            {CONFIGURATION: self.shown(MAX_LINES if self.dims else MAX_CONFIGURATIONS)})
        rows = part.stack(row=[*self.dims, CONFIGURATION], create_index=False)
        groups = [group_labels(part, name) for name in self.dims]
        if self.several or not groups:
            groups.append([str(name) for name in part[CONFIGURATION].values])
        names = list(map(", ".join, itertools.product(*groups)))
        dots = dots_of(rows, curve.variable, curve.scale)
        return Panel(
            curve.title, f"Rows of {curve.label} for each "
                         f"{self.dims[-1] if self.dims else CONFIGURATION}.",
            lambda axes: draw_dots(
                axes, names, dots, curve.label, share=curve.share, level=curve.level),
            height=rows_height(len(names)),
        )

    def maps(self, curve: Curve, *, upwards: bool = True) -> list[Panel]:
        """Return a map of a variable over two dimensions for each configuration that is shown."""
        values = curve.scale * self.summary[curve.variable].transpose(
            CONFIGURATION, *self.dims).values
        down, across = self.dims
        return [
            map_panel(f"{curve.title}, {curve.unit}" + f", {self.names[k]}" * self.several,
                      self.labels(down), self.labels(across), values[k],
                      (self.data.label(across), self.data.label(down)), share=curve.share,
                      upwards=upwards)
            for k in self.shown(MAX_MAPPED)
        ]

    def bars(self, title: str, parts: Mapping[str, str]) -> list[Panel]:
        """Return stacked bars of shares, name -> variable, for each configuration that is shown."""
        bars = self.labels(self.dims[-1]) if self.dims else ["all"]
        label = self.data.label(self.dims[-1]) if self.dims else "all poses"

        def panel(k: int) -> Panel:
            one = self.summary.isel({CONFIGURATION: k})
            shares = {name: np.atleast_1d(one[variable].values.astype(np.float64))
                      for name, variable in parts.items()}
            whose = f", {self.names[k]}" if self.several else ""
            return Panel(
                title + whose,
                f"Stacked bars of the shares of {', '.join(parts) or 'nothing'}{whose}.",
                lambda axes: draw_stack(axes, bars, shares, label),
                wide=len(bars) > WIDE_FROM and not self.several)

        return [panel(k) for k in self.shown(MAX_MAPPED)]

    def table(self, caption: str, columns: Columns) -> Table:
        """Return the table of all configurations, with 95 % intervals."""
        summary = self.summary if self.several or not self.dims else (
            self.summary.isel({CONFIGURATION: 0}))
        named = [CONFIGURATION] if CONFIGURATION in summary.dims else []
        return table_of(summary, f"{caption}, with 95 % intervals", [*named, *self.dims], columns,
                        self.data.results)

    def caption(self, text: str, curves: Sequence[Curve] = (), counted: str = "looked_for") -> str:
        """Return ``text`` with what holds of every figure: intervals, counts, what is pooled."""
        count, lines = len(self.names), MAX_LINES if curves else MAX_MAPPED
        tiny = any(below_floor(self.summary[curve.variable].values) for curve in curves
                   if not curve.share and curve.level is None and curve.variable in self.summary)
        return sentences(
            text, FLOOR_NOTE if tiny else "", interval_sentence(self.data, self.summary),
            denominators(self.summary, counted) if counted in self.summary else "",
            f"Drawn are the {lines} of {count:,} configurations with the smallest median rotation "
            "error; the table has all." if self.dims and count > lines else "",
            *self.notes, self.data.pooled(*self.dims))


def _positions(summary: xr.Dataset, name: str) -> Floats:
    """Return the positions (n,) of groups on a numeric axis: values, or the middles of bins.

    The middle of a bin is the geometric mean of its ends if both are positive.
    """
    if f"{name}_low" in summary.coords:
        low, high = (
            np.asarray(summary[f"{name}_{end}"], dtype=np.float64) for end in ("low", "high")
        )
        return np.asarray(np.where(low > 0, np.sqrt(np.abs(low * high)), (low + high) / 2))
    return np.asarray(summary[name].values, dtype=np.float64)


def grouped(
    data: ReportData, analysis: Analysis, groups: Grouping | None = None,
    stages: Sequence[Stage] = BOTH, without: Sequence[str] = (),
) -> Grouped:
    """Return an analysis by configuration and groups.

    ``stages`` are those whose settings make a difference: of the detection rate the detector's.
    """
    groups = groups or Grouping()
    settings = settings_of(data, stages, without)
    grouping = settings.grouping + groups
    _, summary = by_configuration(
        data.pipeline, data.analysed(analysis, grouping), settings.grouping.dims)
    return Grouped(data, settings, summary, groups.dims, grouping.notes)


def along_axis(
    data: ReportData, analysis: Analysis, along: str, stages: Sequence[Stage] = BOTH, *,
    angles: bool = True,
) -> Grouped:
    """Return an analysis along an axis, the area, or a drawn parameter; if ``angles``, by angle."""
    axis = data.pipeline.axis(along)
    groups = data.along(along, MAX_BINS if axis is None or is_numeric(axis) else MAX_ROWS)
    if angles and data.angle_axis and along != data.angle_axis:
        several = len(settings_of(data, stages, (along,)).combinations) > 1
        groups = data.by_angle(
            MAX_ANGLE_PANELS if several else MAX_ANGLES, binned=not several) + groups
    return grouped(data, analysis, groups, stages, (along,))
