"""The figure of the poses' outcomes: solved, or the flag that says why not."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis import failure_composition
from sweep.measure.flags import outcomes
from sweep.report.charts import draw_stack
from sweep.report.figure import FigureKind, RenderedFigure, interval_sentence, sentences
from sweep.report.grouping import IDS, Grouping, group_labels
from sweep.report.report_data import ReportData
from sweep.report.scene_figures import WIDE_FROM, long_name
from sweep.report.svg import Panel
from sweep.report.table import Table, cells

MAX_BARS = 24


def _axis(data: ReportData) -> str | None:
    """Return the axis along which the outcomes change most; None without axes."""
    if data.size_axis is not None:
        return data.size_axis
    names = [name for name in (*data.scene_axes, *data.setting_axes) if name != IDS]
    if data.size is not None:
        names.append(data.size)
    if not names:
        return None

    def influence(name: str) -> float:
        summary = data.analysed(failure_composition, data.along(name, MAX_BARS))
        share = summary["share"].fillna(0).transpose(name, "outcome").values
        return float(np.abs(share - share.mean(axis=0)).sum(axis=1).mean())

    return max(names, key=influence)


def _render(data: ReportData) -> RenderedFigure:
    axis = _axis(data)
    grouping = data.along(axis, MAX_BARS) if axis else Grouping()
    summary = data.analysed(failure_composition, grouping)
    if axis and axis in summary.indexes and np.issubdtype(summary[axis].dtype, np.number):
        summary = summary.isel({axis: np.argsort(summary[axis].values, kind="stable")})
    names = group_labels(summary, axis) if axis else ["all"]
    counts = summary["count"].sum([axis] if axis else [])
    parts = {
        str(outcome): np.atleast_1d(
            summary["share"].sel(outcome=outcome).values.astype(np.float64))
        for outcome in summary["outcome"].values.tolist()
        if counts.sel(outcome=outcome) > 0
        and np.isfinite(summary["share"].sel(outcome=outcome)).any()
    }
    excluded = ", ".join(
        f"{int(counts.sel(outcome=outcome)):,} {outcome}" for outcome in outcomes(counted=False)
        if outcome in summary["outcome"].values and counts.sel(outcome=outcome) > 0
    )
    label = data.label(axis) if axis else "all poses"
    return RenderedFigure(
        "failures", "Outcomes of the poses",
        sentences(
            "Shares of the poses looked for" + (f", by {long_name(axis)}" if axis else "")
            + ": solved, or the flag that says why not.",
            f"Not counted in the shares: {excluded}." if excluded else "",
            interval_sentence(summary, "share", marks="In the table there"),
            *grouping.notes, data.pooled(*grouping.dims),
        ),
        _table(summary, label, names, list(parts)),
        [Panel("Outcome", f"Stacked bars of the shares of {', '.join(parts) or 'nothing'}.",
               lambda axes: draw_stack(axes, names, parts, label),
               wide=len(names) > WIDE_FROM)],
    )


def _table(summary: xr.Dataset, label: str, names: list[str], shown: list[str]) -> Table:
    columns = [cells(summary.sel(outcome=outcome), "share", 100) for outcome in shown]
    total = summary["count"].where(summary["share"].notnull(), 0).sum("outcome")
    looked_for = [f"{int(value):,}" for value in np.atleast_1d(total.values)]
    rows = [
        [name, looked_for[k], *(column[k] for column in columns)] for k, name in enumerate(names)
    ]
    headings = [label, "looked for", *(f"{name.replace('_', ' ')}, %" for name in shown)]
    return Table("Shares in percent, with 95 % intervals", headings, rows)


FAILURES = FigureKind("failures", lambda _: True, _render)
