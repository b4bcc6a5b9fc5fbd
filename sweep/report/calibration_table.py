"""Camera calibrations as a table: errors beside what OpenCV reports of them."""

from __future__ import annotations

import itertools

import numpy as np
import xarray as xr

from sweep.report.formatting import interval_text, number
from sweep.report.grouping import axis_label, group_labels
from sweep.report.table import Table

INNER = ("views", "intrinsic", "direction", "xyz")


def calibration_table(summary: xr.Dataset) -> Table:
    """Return a row for each condition and number of views of a `calibration_summary`."""
    dims = [str(dim) for dim in summary["calibrated"].dims if dim not in INNER]
    numbers = [str(each) for each in summary["intrinsic"].values
               if np.isfinite(summary["coverage"].sel(intrinsic=each)).any()]
    target = summary.attrs["target_m"]
    names = {dim: group_labels(summary, dim) for dim in dims}
    rows = []
    for index in itertools.product(*(range(summary.sizes[dim]) for dim in (*dims, "views"))):
        one = summary.isel(dict(zip((*dims, "views"), index, strict=True)))
        labels = [names[dim][k] for dim, k in zip(dims, index, strict=False)]
        for name in numbers:
            cell = one.sel(intrinsic=name)
            low, high = float(cell["coverage_low"]), float(cell["coverage_high"])
            first = name == numbers[0]
            depths = [
                f"{1e3 * float(one['position_rmse_m'].sel(direction=where, xyz='z')):.2g}"
                if first and np.isfinite(one["position_rmse_m"].sel(direction=where, xyz="z"))
                else ""
                for where in one["direction"].values.tolist()
            ]
            rows.append([
                *labels, str(int(one["views"])), f"{int(one['calibrated'])} of {int(one['tried'])}",
                name, *(number(float(cell[each])) for each in ("bias", "rmse", "mean_std")),
                f"{number(float(cell['coverage']))} ({interval_text(low, high)})"
                if np.isfinite(low) else "-",
                *depths,
            ])
    caption = (
        f"Calibrations from the {summary.attrs['points']} points of a board: estimated minus "
        "true, px or 1; share of reported 95 % intervals that hold the truth; error of the depth "
        f"of a target at {target:g} m"
    )
    return Table(caption, [
        *(axis_label(summary, dim) for dim in dims), "views", "calibrated", "number", "bias",
        "RMSE", "reported sd", "coverage", "z in the centre, mm", "z towards the corner, mm",
    ], rows, stub=len(dims) + 3)
