"""The table of bias and spread: position along axes, the camera as a robot has it, and angles."""

from __future__ import annotations

from collections.abc import Sequence

import xarray as xr

from sweep.analysis import error_statistics
from sweep.analysis.binning import Bins
from sweep.analysis.quantities import SIGNED
from sweep.report.configurations import configurations
from sweep.report.grouping import CONFIGURATION, by_configuration
from sweep.report.report_data import ReportData
from sweep.report.table import Table, cells

GROUPS = ("camera_frame", "camera_in_marker", "yaw_pitch_roll", "angles")
CAPTION = "Bias and spread of the solved poses without flips, with 95 % intervals"


def signed_errors_table(data: ReportData) -> Table:
    """Return the table, with rows for each configuration."""
    grouping = configurations(data).settings.grouping
    labels, summary = by_configuration(
        data.pipeline, data.analysed(_signed_error_statistics, grouping), grouping.dims)
    names = labels if grouping.dims else []
    rows = []
    for quantity in (each for group in GROUPS for each in SIGNED[group]):
        columns = [cells(summary, quantity.named(statistic)) for statistic in ("bias", "sd")]
        label = f"{quantity.words}, {quantity.unit}"
        rows += [[label, *([name] if names else []), *values]
                 for name, *values in zip(names or [""], *columns, strict=True)]
    stub = ["error", *([CONFIGURATION] if names else [])]
    return Table(CAPTION, [*stub, "bias", "standard deviation"], rows, stub=len(stub))


def _signed_error_statistics(
    results: xr.Dataset, per: Sequence[str], bins: Bins
) -> xr.Dataset:
    return error_statistics(results, per, bins, GROUPS)
