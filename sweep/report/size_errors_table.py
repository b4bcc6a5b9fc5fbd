"""The table of one configuration's errors at each distance, size or other value of an axis."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.report.configurations import configurations
from sweep.report.error_columns import IN_MM
from sweep.report.formatting import number
from sweep.report.grouping import CONFIGURATION, Grouping, by_configuration, group_labels
from sweep.report.report_data import ReportData
from sweep.report.scene_figures import signed_axis, signed_error_statistics
from sweep.report.table import Table

MAX_ROWS = 12


def size_errors_table(data: ReportData, best: int) -> list[Table]:
    """Return detection, bias and spread of a configuration at each size; none without solved poses.

    In x, y, z and yaw: bias ± standard deviation of the solved poses without flips.
    """
    known = configurations(data)
    axis = signed_axis(data)
    groups = data.along(axis, MAX_ROWS) if axis else Grouping()
    _, table = by_configuration(
        data.pipeline, data.analysed(signed_error_statistics, known.settings.grouping + groups),
        known.settings.grouping.dims)
    table = table.isel({CONFIGURATION: best})
    if not np.nan_to_num(table["solved"].values).sum():
        return []
    labels = group_labels(table, axis) if axis else ["all"]
    parts = [table.isel({axis: k}) if axis else table for k in range(len(labels))]
    rows = [[label, *_row(part)] for label, part in zip(labels, parts, strict=True)]
    stub = data.label(axis) if axis else "poses"
    whose = f", with {known.names[best]}" if known.several else ""
    pooled = data.pooled(*groups.dims).rstrip(".")
    return [Table(
        f"Errors by {stub.split(',')[0]}{whose}: range p95 (not solved: infinite), and bias ± "
        "standard deviation of the solved poses without flips"
        + (f". {pooled}" if pooled else ""),
        [stub, "detected, %", "range p95, %", *(f"{name}, mm" for name in IN_MM),
         "yaw, deg"], rows)]


def _row(part: xr.Dataset) -> list[str]:
    def signed(name: str, unit: str, scale: float) -> str:
        bias, spread = (scale * float(part[f"{name}_{what}_{unit}"]) for what in ("bias", "sd"))
        return number(bias) if np.isnan(spread) else f"{_beside(bias, spread)} ± {number(spread)}"

    return [
        number(100 * float(part["detection_rate"])), number(float(part["range_p95_percent"])),
        *(signed(name, "m", 1000.0) for name in IN_MM),
        signed("yaw", "deg", 1.0),
    ]


def _beside(value: float, spread: float) -> str:
    """Return a value with no more decimals than its spread has: 0.00042 beside 0.00742."""
    _, point, decimals = number(spread).partition(".")
    if not point or not decimals.isdigit():
        return number(value)
    text = f"{value:.{len(decimals)}f}"
    return text.replace("-", "\u2212") if float(text) else text.removeprefix("-")
