"""Photographs beside their simulation, calibrations, two stores: tables, JSON, and a figure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.binning import Bins
from sweep.analysis.poses import QUANTITIES, Poses
from sweep.analysis.simulation_gaps import (
    QUANTILES,
    RATES,
    SOURCES,
    Compared,
    paired_units,
)
from sweep.report.charts import Panel, Series, draw_lines
from sweep.report.formatting import bin_text, coordinate, interval_text, number, plural
from sweep.report.report_data import axis_label, group_labels
from sweep.report.table import Findings, Table, each_cell
from sweep.tradeoff.pareto import configuration_label
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Photographs beside their simulation, as a table for a terminal, a page, or JSON.

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
    return Table.of(
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
    """Return the table's rows with their numbers, for JSON."""
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


def _ends(one: xr.Dataset, name: str) -> list[float]:
    return [float(one[f"{name}{end}"]) for end in ("", "_low", "_high")]


# --------------------------------------------------------------------------------------------------
# The figure of photographs and their simulation: distributions of errors side by side.

MAX_CONFIGURATIONS = 6
"""Configurations that are drawn, two panels each."""

PERCENT = np.arange(2.0, 99.0, 2.0)
"""Percent of the solved poses at which the errors' distributions are drawn."""


def gap_panels(
    photographs: xr.Dataset, simulated: xr.Dataset, bins: Bins | None = None
) -> list[Panel]:
    """Return the panels of photographs and a simulation, as `sweep.analysis.simulation_gap`.

    For each configuration the distribution functions of the rotation error and of the depth error
    of all solved poses; of a simulation that is compared in bins, those within the bins.
    """
    pair = paired_units(photographs, simulated, bins)
    inside = [np.logical_or.reduce(masks) for masks in zip(*pair.bins(), strict=True)]
    sides = [Poses(arrays) for arrays in pair.within(inside)]
    values = ([f"{name} {coordinate(each)}" for each in pair.coordinates[name].values.tolist()]
              for name in pair.configurations)
    panels = []
    for k, names in enumerate(itertools.product(*values)):
        for errors, words in (
            (QUANTITIES[0].norm, "rotation error, deg"),
            (lambda poses: poses.range_percent[..., 0], "depth error, % of the true depth"),
        ):
            lines = [_distribution(source, errors(side)[k][side.solved[k]])
                     for source, side in zip(SOURCES, sides, strict=True)]
            panels.append(Panel(
                ", ".join(names) or "All markers",
                f"Share of the solved poses with at most this {words}: photographs and simulation.",
                partial(draw_lines, series=lines, labels=(words, "share of solved poses, %"),
                        share=True)))
    return panels[:2 * MAX_CONFIGURATIONS]


def _distribution(source: str, errors: Floats) -> Series:
    """Return the distribution of errors (n,) as a line; none without errors."""
    errors = errors[np.isfinite(errors)]
    shares = PERCENT if errors.size else PERCENT[:0]
    x = np.percentile(errors, shares) if errors.size else shares
    return Series(source, x, shares, shares * np.nan, shares * np.nan)


# --------------------------------------------------------------------------------------------------
# Camera calibrations as a table: errors beside what OpenCV reports of them.

INNER = ("views", "intrinsic", "direction", "xyz")


STATISTICS = ("bias", "rmse", "mean_std", "coverage", "coverage_low", "coverage_high")


def calibration_records(summary: xr.Dataset) -> list[dict[str, Any]]:
    """Return the numbers of a `calibration_summary` for JSON, a record for each table row's sets.

    ``numbers`` has, by name with unit (``fx_px``, ``k1``), the statistics of each number of the
    camera in that unit; ``depth_rmse_m`` by direction of the target.
    """
    dims = [str(dim) for dim in summary["calibrated"].dims if dim not in INNER]
    records = []
    for index in itertools.product(*(range(summary.sizes[dim]) for dim in (*dims, "views"))):
        one = summary.isel(dict(zip((*dims, "views"), index, strict=True)))
        depth = one["position_rmse_m"].sel(xyz="z")
        records.append({
            **{dim: one[dim].item() for dim in (*dims, "views")},
            "tried": int(one["tried"]), "calibrated": int(one["calibrated"]),
            "numbers": {
                name: {each: float(one[each].sel(intrinsic=name)) for each in STATISTICS}
                for name in one["intrinsic"].values.tolist()
            },
            "depth_rmse_m": {
                where: float(depth.sel(direction=where))
                for where in one["direction"].values.tolist()
            },
        })
    return records


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
    return Table.of(caption, [
        *(axis_label(summary, dim) for dim in dims), "views", "calibrated", "number", "bias",
        "RMSE", "reported sd", "coverage", "z in the centre, mm", "z towards the corner, mm",
    ], rows, stub=len(dims) + 3)


def calibration_findings(summary: xr.Dataset, store: str) -> Findings:
    """Return a `calibration_summary` as findings, which print themselves."""
    return Findings(
        [calibration_table(summary)],
        {"points": summary.attrs["points"], "target_m": summary.attrs["target_m"],
         "rows": calibration_records(summary)}, summary, 0,
        (f"sweep.analysis.camera_calibrations(sweep.open({store!r}), [20]) in Python",
         "the errors of each calibration"))


# --------------------------------------------------------------------------------------------------
# Differences between two stores of one pipeline, as tables for a terminal, and as JSON.

def store_difference_tables(table: xr.Dataset) -> list[Table]:
    """Return tables of detections, corners, poses and versions that differ."""
    return [
        Table.of(
            "Detections, on the same images",
            ["configuration", "compared", "another flag", "first \u2192 second"],
            [[label, *_counts(one, "detections_compared", "detections_differing"),
              _pairs_text(one, "detection")]
             for label, one in _configurations(table, "detections_compared")],
        ),
        Table.of(
            "Corners that both found; shifts of those that differ: median, p99, worst",
            ["configuration", "compared", "differ", "found once", "px"],
            [[label, *_counts(one, "corners_compared", "corners_differing", "corners_found_once"),
              _shift_text(one, "corner_shift_px")]
             for label, one in _configurations(table, "corners_compared")],
        ),
        Table.of(
            "Poses that both solved; shifts of those that differ: median, p99, worst",
            ["configuration", "compared", "differ", "mm", "\u00b0", "another flag",
             "first \u2192 second"],
            [[label, *_counts(one, "poses_compared", "poses_differing"),
              _shift_text(one, "position_shift_m", 1e3), _shift_text(one, "rotation_shift_deg"),
              *_counts(one, "estimates_differing"), _pairs_text(one, "estimate")]
             for label, one in _configurations(table, "poses_compared")],
        ),
        Table.of(
            "Versions and files that differ", ["", "first", "second"],
            [[entry, *map(str, texts)] for entry, texts in _versions(table)], words=True,
        ),
    ]


def store_difference_json(table: xr.Dataset) -> dict[str, Any]:
    """Return the tables' numbers as JSON has them; null where nothing differs."""
    return {
        "detection": [
            {**settings,
             **_integers(one, "detections_compared", "detections_differing", "computed_once",
                         "corners_compared", "corners_differing", "corners_found_once"),
             "flags": list(_pairs(one, "detection")), **_numbers(one, "corner_shift_px")}
            for settings, one in _cells(table, "detections_compared")
        ],
        "estimation": [
            {**settings, **_integers(one, "estimates_differing", "poses_compared",
                                     "poses_differing"),
             "flags": list(_pairs(one, "estimate")),
             **_numbers(one, "position_shift_m", "rotation_shift_deg")}
            for settings, one in _cells(table, "poses_compared")
        ],
        "fingerprint": [
            {"entry": entry, "first": texts[0], "second": texts[1]}
            for entry, texts in _versions(table)
        ],
    }


def _cells(table: xr.Dataset, name: str) -> Iterator[tuple[dict[str, Any], xr.Dataset]]:
    """Yield the settings, and the results, of each configuration that a variable has."""
    return each_cell(table, [str(dim) for dim in table[name].dims])


def _configurations(table: xr.Dataset, name: str) -> Iterator[tuple[str, xr.Dataset]]:
    for settings, one in _cells(table, name):
        yield configuration_label(settings), one


def _versions(table: xr.Dataset) -> Iterator[tuple[str, list[str]]]:
    for entry in table["entry"].values:
        yield str(entry), table["fingerprint"].sel(entry=entry).values.tolist()


def _counts(one: xr.Dataset, *names: str) -> list[str]:
    return [f"{int(one[name]):,}" for name in names]


def _integers(one: xr.Dataset, *names: str) -> dict[str, int]:
    return {name: int(one[name]) for name in names}


def _numbers(one: xr.Dataset, *names: str) -> dict[str, dict[str, float | None]]:
    return {
        name: {
            str(statistic): None if np.isnan(value) else float(value)
            for statistic, value in zip(one["statistic"].values, one[name].values, strict=True)
        }
        for name in names
    }


def _shift_text(one: xr.Dataset, name: str, factor: float = 1.0) -> str:
    values = factor * one[name].values
    return "\u2013" if np.isnan(values).all() else " ".join(map(number, values))


def _pairs(one: xr.Dataset, stage: str) -> Iterator[dict[str, Any]]:
    """Yield the pairs of two different flags that occur, the most frequent first."""
    counts = one[f"{stage}s"].transpose(f"first_{stage}", f"second_{stage}").values
    flags = one[f"first_{stage}"].values
    different = [(i, j) for i, j in np.argwhere(counts) if i != j]
    for i, j in sorted(different, key=lambda pair: -int(counts[pair])):
        yield {"first": str(flags[i]), "second": str(flags[j]), "poses": int(counts[i, j])}


def _pairs_text(one: xr.Dataset, stage: str) -> str:
    return ", ".join(
        f"{pair['first']} \u2192 {pair['second']} {pair['poses']:,}" for pair in _pairs(one, stage)
    ) or "\u2013"
