"""The figure of the poses' outcomes: solved, or the flag that says why not."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis import failure_composition
from sweep.measure.flags import outcomes
from sweep.report.charts import draw_stack
from sweep.report.configurations import settings_of, shown_lines, shown_note
from sweep.report.curves import WIDE_FROM
from sweep.report.figure import FigureKind, RenderedFigure, interval_sentence, sentences
from sweep.report.grouping import (
    CONFIGURATION,
    IDS,
    Grouping,
    by_configuration,
    equal_bins,
    group_labels,
)
from sweep.report.report_data import ReportData
from sweep.report.scene_figures import long_name
from sweep.report.svg import Panel
from sweep.report.table import Table, cells

MAX_BARS = 24
MAX_STACKS = 4
"""Configurations that have bars of their own."""

VIEW = "viewing_angle_deg"
VIEW_BIN_DEG = 10.0
MIN_VIEW_RANGE_DEG = 5.0
"""From this range on, outcomes are shown by the viewing angle."""


def _axis(data: ReportData) -> str | None:
    """Return the axis of the scene along which the outcomes change most; None without axes."""
    if data.size_axis is not None:
        return data.size_axis
    names = [name for name in data.scene_axes if name != IDS]
    if data.size is not None:
        names.append(data.size)
    if not names:
        return None
    settings = settings_of(data)

    def influence(name: str) -> float:
        summary = data.analysed(
            failure_composition, settings.grouping + data.along(name, MAX_BARS))
        share = summary["share"].fillna(0).transpose(name, "outcome", ...).values
        return float(np.abs(share - share.mean(axis=0)).mean())

    return max(names, key=influence)


class _Outcomes:
    """The outcomes of each configuration, along an axis or bins of the viewing angle."""

    def __init__(self, data: ReportData, axis: str | None, groups: Grouping, label: str) -> None:
        settings = settings_of(data)
        self.names, summary = by_configuration(
            data.pipeline, data.analysed(failure_composition, settings.grouping + groups),
            settings.grouping.dims)
        self.several = len(self.names) > 1
        if axis and axis in summary.indexes and np.issubdtype(summary[axis].dtype, np.number):
            summary = summary.isel({axis: np.argsort(summary[axis].values, kind="stable")})
        self.label, self.axis = label, axis or "all"
        self.summary = summary if axis else summary.expand_dims("all", axis=1)
        self.bars = group_labels(summary, axis) if axis else ["all"]
        self.shown = shown_lines(data, settings, MAX_STACKS)
        self.counts = summary["count"].sum([name for name in summary["count"].dims
                                            if name != "outcome"])
        self.notes = (shown_note(self.shown, len(self.names)), *settings.grouping.notes,
                      *groups.notes, data.pooled(*groups.dims))

    @property
    def happened(self) -> list[str]:
        """The outcomes that poses looked for have."""
        return [str(name) for name in self.summary["outcome"].values.tolist()
                if self.counts.sel(outcome=name) > 0
                and np.isfinite(self.summary["share"].sel(outcome=name)).any()]

    def panels(self, title: str) -> list[Panel]:
        """Return bars for each configuration that is shown."""
        return [self._panel(k, title) for k in self.shown]

    def _panel(self, k: int, title: str) -> Panel:
        share = self.summary["share"].isel({CONFIGURATION: k})
        parts = {name: share.sel(outcome=name).values.astype(np.float64)
                 for name in self.happened}
        whose = f", {self.names[k]}" if self.several else ""
        return Panel(
            title + whose,
            f"Stacked bars of the shares of {', '.join(parts) or 'nothing'}{whose}.",
            lambda axes: draw_stack(axes, self.bars, parts, self.label),
            wide=len(self.bars) > WIDE_FROM and not self.several,
        )

    def table(self) -> Table:
        """Return the shares of all configurations."""
        stacked = self.summary.stack(row=[CONFIGURATION, self.axis], create_index=False)
        columns = [cells(stacked.sel(outcome=name), "share", 100) for name in self.happened]
        total = stacked["count"].where(stacked["share"].notnull(), 0).sum("outcome").values
        stubs = [[*([name] if self.several else []), bar]
                 for name in self.names for bar in self.bars]
        rows = [[*stub, f"{int(total[k]):,}", *(column[k] for column in columns)]
                for k, stub in enumerate(stubs)]
        headings = [*([CONFIGURATION] if self.several else []), self.label, "looked for",
                    *(f"{name.replace('_', ' ')}, %" for name in self.happened)]
        return Table("Shares in percent, with 95 % intervals", headings, rows,
                     stub=1 + self.several)


def _view_bins(data: ReportData) -> Grouping:
    """Return bins of the viewing angle; none if it hardly varies, or is an axis shown already."""
    if VIEW not in data.results:
        return Grouping()
    ends = data.once("viewing angles", lambda: xr.Dataset(
        {"low": data.results[VIEW].min(), "high": data.results[VIEW].max()}))
    low, high = float(ends["low"]), float(ends["high"])
    if not high - low >= MIN_VIEW_RANGE_DEG:
        return Grouping()
    return equal_bins(VIEW, low, high, VIEW_BIN_DEG)


def _render(data: ReportData) -> RenderedFigure:
    axis = _axis(data)
    along = _Outcomes(data, axis, data.along(axis, MAX_BARS) if axis else Grouping(),
                      data.label(axis) if axis else "all poses")
    panels = along.panels("Outcome")
    view = _view_bins(data)
    if view.dims:
        panels += _Outcomes(data, VIEW, view, "viewing angle, deg").panels(
            "Outcome by viewing angle")
    excluded = ", ".join(
        f"{int(along.counts.sel(outcome=outcome)):,} {outcome}"
        for outcome in outcomes(counted=False)
        if outcome in along.summary["outcome"].values
        and along.counts.sel(outcome=outcome) > 0
    )
    return RenderedFigure(
        "failures", "Outcomes of the poses",
        sentences(
            "Shares of the poses looked for" + (f", by {long_name(axis)}" if axis else "")
            + (" and by viewing angle (normal to line of sight)" if view.dims else "")
            + ": solved, or the flag that says why not.",
            f"Not counted in the shares: {excluded}." if excluded else "",
            interval_sentence(data, along.summary, "share", marks="In the table there"),
            *along.notes,
        ),
        along.table(), panels,
    )


FAILURES = FigureKind("failures", lambda _: True, _render)
