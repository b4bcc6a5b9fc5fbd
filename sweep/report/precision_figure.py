"""The figure of the trials that conditions needed for a wanted precision, and what was reached."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis import precision_reached
from sweep.analysis.half_widths import Reached
from sweep.plan.precision_rule import PrecisionRule
from sweep.report.charts import draw_lines
from sweep.report.figure import FigureKind, RenderedFigure, sentences
from sweep.report.formatting import number
from sweep.report.report_data import ReportData
from sweep.report.scales import Series
from sweep.report.svg import Panel
from sweep.report.table import Table


def _applies(data: ReportData) -> bool:
    return isinstance(data.pipeline.stopping, PrecisionRule)


def _render(data: ReportData) -> RenderedFigure:
    table = data.once("precision_reached", lambda: precision_reached(data.results))
    run = _poses_of_conditions(table)
    most = int(table["poses"].max())
    settled = table["settled"].values
    return RenderedFigure(
        "precision", "Poses that the wanted precision needed",
        sentences(
            f"{int(settled.sum()):,} of {settled.size:,} conditions are settled: every quantity of "
            "every configuration is known as well as was wanted, or cannot be.",
            f"Of {most:,} poses each, {number(100 * float(run.sum()) / (most * run.size))} % were "
            f"computed: {int(run.min()):,} to {int(run.max()):,} a condition, median "
            f"{int(np.median(run)):,}.",
            "What is pooled over conditions is pooled over the trials that all of them have.",
        ),
        Table(
            "Conditions by what was reached; of rates the half-width of the interval, of others "
            "relative to the value (bias: to the RMSE)",
            ["quantity", "configuration", "wanted", "widest", *(
                f"{each.name.replace('_', ' ')}" for each in Reached)],
            _rows(table), stub=2),
        [_panel(run)] if run.size > 1 else [],
    )


def _poses_of_conditions(table: xr.Dataset) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """Return the poses that were run of each condition, increasing."""
    configuration = table.attrs["configuration_dims"]
    first = table["run"].isel(dict.fromkeys(configuration, 0))
    return np.sort(first.values.ravel())


def _rows(table: xr.Dataset) -> list[list[str]]:
    configuration = table.attrs["configuration_dims"]
    rows = []
    for k, name in enumerate(table["quantity"].values):
        one = table.isel(quantity=k)
        for at in np.ndindex(*(table.sizes[dim] for dim in configuration)):
            part = one.isel(dict(zip(configuration, at, strict=True)))
            label = " · ".join(str(part[dim].values) for dim in configuration) or "all"
            half = part["half_width"].where(part["reached"].isin(
                (Reached.reached, Reached.not_reached)))
            rows.append([
                str(name), label, number(float(one["wanted"])), number(float(half.max())),
                *(f"{int((part['reached'] == flag).sum()):,}" for flag in Reached)])
    return rows


def _panel(run: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> Panel:
    rank = np.arange(1, run.size + 1, dtype=np.float64)
    poses = run.astype(np.float64)
    line = Series("", rank, poses, poses * np.nan, poses * np.nan)
    return Panel(
        "Poses by condition", "Line of the poses of all conditions, in increasing order.",
        lambda axes: draw_lines(axes, [line], ("condition, by poses", "poses")))


PRECISION = FigureKind("precision", _applies, _render)
