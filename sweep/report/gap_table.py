"""Photographs beside their simulation, as a table for a terminal, a page, or JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.simulation_gaps import QUANTILES, RATES, SOURCES, Compared
from sweep.report.formatting import bin_text, coordinate, interval_text, number, plural
from sweep.report.table import Table

WORDS = {
    "detection_rate": "detected, %", "flip_rate": "flipped, % of solved",
    "range_bias_percent": "range bias, %", "rotation_median_deg": "rotation error, median, \u00b0",
    "rotation_p90_deg": "rotation error, 90 %, \u00b0",
    "range_median_percent": "range error, median, %", "range_p90_percent": "range error, 90 %, %",
}
"""What a table calls the statistics."""


def gap_table(gap: xr.Dataset) -> Table:
    """Return a row for each statistic, configuration and bin of `sweep.analysis.simulation_gap`."""
    dims = dimensions(gap)
    rows = [
        [WORDS[each.name], *(_label(gap, dim, k) for dim, k in zip(dims, index, strict=True)),
         *(_value(one, each, source) for source in SOURCES), _gap_text(one, each)]
        for each in (*RATES, *QUANTILES) for index, one in _each(gap, dims)
    ]
    return Table(
        "Photographs and simulation, with 95 % intervals of the gap: the difference, or as "
        "\u00d7 the ratio", ["", *dims, *SOURCES, "gap"], rows, stub=1 + len(dims), words=True,
    )


def gap_lines(gap: xr.Dataset) -> list[str]:
    """Return lines on what was compared, and on what an interval says."""
    photographs, scenes = (int(gap["units"].sel(source=source).max()) for source in SOURCES)
    markers, solved = (int(gap[name].max()) for name in ("looked_for", "solved"))
    first = plural(photographs, "photograph")
    lines = [
        f"{first} and their twins, pairs of markers" if gap.attrs["paired"]
        else f"{first} and {plural(scenes, 'simulated scene')}, bin by bin",
    ]
    if not markers or not solved:
        lines.append("nothing to compare: no marker is in both, or none is solved")
    elif photographs < 5:
        lines.append("fewer than 5 photographs: errors without intervals")
    return lines


def gap_records(gap: xr.Dataset) -> list[dict[str, Any]]:
    """Return the table's rows as JSON has them; a number that does not exist is None."""
    dims = dimensions(gap)
    return [
        {"statistic": each.name, "compared_by": "ratio" if each.ratio else "difference",
         **{dim: gap[dim].values[k].item() if gap[dim].dtype.kind != "O" else gap[dim].values[k]
            for dim, k in zip(dims, index, strict=True)},
         **{source: _ends(one.sel(source=source), each.name) for source in SOURCES},
         "gap": _ends(one, f"{each.name}_gap")}
        for each in (*RATES, *QUANTILES) for index, one in _each(gap, dims)
    ]


def dimensions(gap: xr.Dataset) -> list[str]:
    """Return the dimensions of the gaps: configurations, then bins."""
    return [str(dim) for dim in gap["detection_rate_gap"].dims]


def _each(gap: xr.Dataset, dims: list[str]) -> Iterator[tuple[tuple[int, ...], xr.Dataset]]:
    for index in np.ndindex(*(gap.sizes[dim] for dim in dims)):
        yield index, gap.isel(dict(zip(dims, index, strict=True)))


def _label(gap: xr.Dataset, dim: str, k: int) -> str:
    if f"{dim}_low" in gap.coords:
        return bin_text(*(float(gap[f"{dim}_{end}"][k]) for end in ("low", "high")))
    return coordinate(gap[dim].values[k])


def _scale(each: Compared) -> float:
    return 100.0 if each in RATES else 1.0


def _value(one: xr.Dataset, each: Compared, source: str) -> str:
    return number(_scale(each) * float(one[each.name].sel(source=source)))


def _gap_text(one: xr.Dataset, each: Compared) -> str:
    scale = 1.0 if each.ratio else _scale(each)
    value, low, high = (
        scale * float(one[f"{each.name}_gap{end}"]) for end in ("", "_low", "_high")
    )
    text = ("\u00d7" if each.ratio else "+" if value > 0 else "") + number(value)
    return text if math.isnan(low) else f"{text} ({interval_text(low, high)})"


def _ends(one: xr.Dataset, name: str) -> list[float | None]:
    values = (float(one[f"{name}{end}"]) for end in ("", "_low", "_high"))
    return [value if math.isfinite(value) else None for value in values]
