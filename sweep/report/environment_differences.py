"""Tables of environments: what each version of OpenCV changed, and in which poses first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import xarray as xr

from sweep.analysis import environment_differences
from sweep.analysis.environments import ENVIRONMENT, changed_poses
from sweep.report.formatting import number
from sweep.report.report_data import ReportData
from sweep.report.table import Table
from sweep.tradeoff.labels import configuration_label

CAPTION = "What each environment changes on the same images; shifts are of poses that both have"

POSES_CAPTION = "The first poses whose flag of detection changed, and since which environment"

COLUMNS = {
    "poses": "compared", "flag": "changed", "gained": "gained", "lost": "lost",
    "other ID": "other_id", "moved": "moved", "corner, px": "corner_shift_rms_px",
    "range, %": "range_bias_percent", "rotation, \u00b0": "rotation_shift_deg",
}
"""Heading -> variable of `environment_differences`."""

MAX_POSES = 5
"""Changed poses that are listed of each environment."""


def environment_tables(data: ReportData) -> Sequence[Table]:
    """Return the tables of a store with several environments; none of other stores."""
    results = data.results
    if results.sizes.get(ENVIRONMENT, 1) < 2:
        return []
    table = data.once((__name__,), lambda: environment_differences(results).compute())
    tables = [Table(
        CAPTION, [ENVIRONMENT, "configuration", *COLUMNS], list(_rows(table)), stub=2
    )]
    changed = list(changed_poses(results, MAX_POSES))
    if changed:
        headings = [name for name in changed[0] if name not in ("before", "since", ENVIRONMENT)]
        tables.append(Table(
            POSES_CAPTION, [ENVIRONMENT, *headings, "before", "since"],
            [[pose[ENVIRONMENT], *(pose[name] for name in headings), pose["before"],
              pose["since"]] for pose in changed],
            words=True,
        ))
    return tables


def _rows(table: xr.Dataset) -> Iterator[list[str]]:
    """Yield a row for each environment but the first, and each configuration."""
    settings = [str(dim) for dim in table["rotation_shift_deg"].dims if dim != ENVIRONMENT]
    for name in table[ENVIRONMENT].values[1:]:
        one = table.sel({ENVIRONMENT: name})
        for index in np.ndindex(*(one.sizes[dim] for dim in settings)):
            cell = one.isel(dict(zip(settings, index, strict=True)))
            label = configuration_label({dim: cell[dim].item() for dim in settings})
            yield [
                f"{cell['compared_with'].item()} \u2192 {name}", label,
                *(_text(cell[variable]) for variable in COLUMNS.values()),
            ]


def _text(value: xr.DataArray) -> str:
    if value.dtype.kind in "iu":
        return f"{int(value):,}"
    return "\u2013" if np.isnan(value) else number(float(value))
