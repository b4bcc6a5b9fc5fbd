"""Photographs beside their simulation, two stores, calibrations: tables and a figure."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import xarray as xr

from sweep.analysis import simulation_gap
from sweep.analysis.comparisons import (
    GAP_RATES,
    GAP_STATISTICS,
    SOURCES,
    ComparedRate,
    SolvedQuantile,
    is_measured,
    matched_sides,
    store_differences,
)
from sweep.analysis.dataset import QUANTITIES, each_cell
from sweep.analysis.estimator import Bins
from sweep.errors import ArgumentError
from sweep.messages import quoted
from sweep.report.decisions import selected_store
from sweep.report.figure import Figure, write_figure
from sweep.report.output_file import figure_file
from sweep.report.table import (
    Column,
    Findings,
    Table,
    Value,
    coordinate,
    group_cells,
    plural,
    table_of,
)
from sweep.tradeoff.pareto import configuration_label
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# How two stores differ: photographs and their simulation, or two versions.


def compare(
    first: str, second: str, *, bins: Mapping[str, Sequence[float]] | None = None,
    output: str | None = None,
) -> Findings:
    """Compare photographs with a simulation, or two stores of one pipeline; as `sweep.compare`."""
    figure = figure_file(output)
    one, other = (selected_store(url)[0] for url in (first, second))
    then = (f"sweep report {quoted(second)}", "")
    if is_measured(one) == is_measured(other):
        for name, value in (("bins", bins), ("output", output)):
            if value:
                raise ArgumentError(name, "", "expected a store of photographs and a simulation")
        table = store_differences(one, other)
        tables = store_difference_tables(table)
        return Findings([*tables.values()], {
            "first": first, "second": second,
            **{name: each.as_json()["rows"] for name, each in tables.items()}}, table, 0, then)
    gap = simulation_gap(one, other, bins).load()
    if figure is not None:
        write_figure(gap_figures(one, other, bins), figure)
    found = gap_table(gap)
    return Findings(
        [found, *gap_lines(gap)],
        {"photographs": first, "simulated": second, "paired": bool(gap.attrs["paired"]),
         **found.as_json()}, gap, 0, then)


# --------------------------------------------------------------------------------------------------
# Photographs beside their simulation.

#: Names of the statistics in a table.
WORDS = {
    "detection_rate": "detected, %", "flip_rate": "flipped, % of solved",
    "range_bias_percent": "range bias, %", "rotation_median_deg": "rotation error, median, \u00b0",
    "rotation_p90_deg": "rotation error, 90 %, \u00b0",
    "range_median_percent": "range error, median, %", "range_p90_percent": "range error, 90 %, %",
}


def gap_table(gap: xr.Dataset) -> Table:
    """Return a row for each statistic, configuration and bin of `sweep.analysis.simulation_gap`."""
    dims = [str(dim) for dim in gap["detection_rate_gap"].dims]
    groups = list(itertools.product(*(group_cells(gap, dim) for dim in dims)))
    rows = [
        [WORDS[each.name], *group, *(
            Value(_scale(each) * float(one[each.name].sel(source=source))) for source in SOURCES),
         "ratio" if each.ratio else "difference",
         Column("", f"{each.name}_gap", 1.0 if each.ratio else _scale(each)).cells(one)[0]]
        for each in GAP_STATISTICS
        for group, (_, one) in zip(groups, each_cell(gap, dims), strict=True)]
    return Table.of(
        "Photographs and simulation, with 95 % intervals of the gap: the difference, or the ratio",
        ["statistic", *dims, *SOURCES, "compared by", "gap"], rows, stub=1 + len(dims))


def gap_lines(gap: xr.Dataset) -> list[str]:
    """Return lines on the compared poses, and on the meaning of intervals."""
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


def _scale(each: ComparedRate | SolvedQuantile) -> float:
    return 100.0 if each in GAP_RATES else 1.0


#: Configurations that are drawn, two panels each.
MAX_CONFIGURATIONS = 6

#: Percent of the solved poses at which the errors' distributions are drawn.
PERCENT = np.arange(2.0, 99.0, 2.0)

SHARE = Column("share of solved poses, %", "share", 100)


def gap_figures(
    photographs: xr.Dataset, simulated: xr.Dataset, bins: Bins | None = None
) -> list[Figure]:
    """Return the figures of photographs and a simulation, as `sweep.analysis.simulation_gap`.

    For each configuration the distribution functions of the rotation error and of the depth error
    of all solved poses; of a simulation that is compared in bins, those within the bins.
    """
    matched = matched_sides(photographs, simulated, bins)
    sides = matched.poses()
    values = ([f"{name} {coordinate(each)}" for each in matched.datasets[0][name].values.tolist()]
              for name in matched.kept)
    names = [", ".join(each) or "all markers" for each in itertools.product(*values)]
    figures = []
    for heading, errors_of in (
        ("rotation error, deg", QUANTITIES[0].norm),
        ("depth error, % of the true depth", lambda poses: poses.range_percent[..., 0]),
    ):
        rows = [[name, source, Value(x), Value(share)]
                for k, name in enumerate(names[:MAX_CONFIGURATIONS])
                for source, side in zip(SOURCES, sides, strict=True)
                for x, share in _distribution(errors_of(side)[k][side.solved[k]])]
        figures.append(Figure(
            heading.partition(" ")[0], heading, "", Table.of(
                "Shares of the solved poses with at most this error",
                ["configuration", "source", heading, SHARE.heading], rows, stub=2),
            [SHARE], heading, "source"))
    return figures


def _distribution(errors: Floats) -> Iterator[tuple[float, float]]:
    """Yield error and share of the distribution of errors (n,); nothing without errors."""
    errors = errors[np.isfinite(errors)]
    if errors.size:
        yield from zip(np.percentile(errors, PERCENT).tolist(), PERCENT.tolist(), strict=True)


# --------------------------------------------------------------------------------------------------
# Camera calibrations: errors beside what OpenCV reports of them.

INNER = ("views", "intrinsic", "direction", "xyz")


def calibration_table(summary: xr.Dataset) -> Table:
    """Return a row for each condition, number of views and number of a `calibration_summary`."""
    dims = [str(dim) for dim in summary["calibrated"].dims if dim not in INNER]
    numbers = [str(each) for each in summary["intrinsic"].values
               if np.isfinite(summary["coverage"].sel(intrinsic=each)).any()]
    depth = 1e3 * summary["position_rmse_m"].sel(xyz="z", drop=True)
    depths = {f"z in the {where}, mm": depth.sel(direction=where, drop=True)
              for where in summary["direction"].values.tolist()}
    columns = [Column("calibrated", "calibrated"), Column("tried", "tried"), Column("bias", "bias"),
               Column("RMSE", "rmse"), Column("reported sd", "mean_std"),
               Column("coverage", "coverage"), *(Column(name, name) for name in depths)]
    caption = (
        f"Calibrations from the {summary.attrs['points']} points of a board: estimated minus "
        "true, px or 1; share of reported 95 % intervals that hold the truth; error of the depth "
        f"of a target at {summary.attrs['target_m']:g} m"
    )
    shown = summary.sel(intrinsic=numbers).assign(depths).rename(intrinsic="number")
    return table_of(shown, caption, [*dims, "views", "number"], columns)


def calibration_findings(summary: xr.Dataset, store: str) -> Findings:
    """Return a `calibration_summary` as findings, which print themselves."""
    table = calibration_table(summary)
    return Findings(
        [table], {"points": summary.attrs["points"], "target_m": summary.attrs["target_m"],
                  **table.as_json()}, summary, 0,
        (f"sweep.analysis.camera_calibrations(sweep.open({store!r}), [20]) in Python",
         "the errors of each calibration"))


# --------------------------------------------------------------------------------------------------
# Differences between two stores of one pipeline.


def store_difference_tables(table: xr.Dataset) -> dict[str, Table]:
    """Return tables of detections, corners, poses and versions that differ, by name."""
    def made(
        caption: str, counts: Mapping[str, str], shifts: Mapping[str, tuple[str, float]],
        stage: str = "",
    ) -> Table:
        first = next(iter(counts.values()))
        statistics = [str(each) for each in table["statistic"].values]
        rows = [
            [configuration_label(at), *(int(one[each]) for each in counts.values()),
             *(Value(scale * float(value)) for each, scale in shifts.values()
               for value in one[each].values),
             *([_pairs(one, stage)] if stage else [])]
            for at, one in each_cell(table, [str(dim) for dim in table[first].dims])]
        return Table.of(caption, [
            "configuration", *counts, *(f"{statistic}, {unit}" for unit in shifts
                                        for statistic in statistics),
            *(["first \u2192 second"] if stage else [])], rows)

    return {
        "detection": made("Detections, on the same images", {
            "compared": "detections_compared", "another flag": "detections_differing",
            "computed once": "computed_once"}, {}, "detection"),
        "corners": made("Corners that both found; shifts of those that differ", {
            "compared": "corners_compared", "differ": "corners_differing",
            "found once": "corners_found_once"}, {"px": ("corner_shift_px", 1.0)}),
        "estimation": made("Poses that both solved; shifts of those that differ", {
            "compared": "poses_compared", "differ": "poses_differing",
            "another flag": "estimates_differing"},
            {"mm": ("position_shift_m", 1e3), "\u00b0": ("rotation_shift_deg", 1.0)}, "estimate"),
        "fingerprint": Table.of(
            "Versions and files that differ", ["entry", "first", "second"],
            [[str(entry), *map(str, table["fingerprint"].sel(entry=entry).values)]
             for entry in table["entry"].values], words=True),
    }


def _pairs(one: xr.Dataset, stage: str) -> str:
    """Return the pairs of two different flags that occur, the most frequent first."""
    counts = one[f"{stage}s"].transpose(f"first_{stage}", f"second_{stage}").values
    flags = one[f"first_{stage}"].values
    different = sorted(((i, j) for i, j in np.argwhere(counts).tolist() if i != j),
                       key=lambda pair: -int(counts[pair]))
    return ", ".join(f"{flags[i]} \u2192 {flags[j]} {int(counts[i, j]):,}" for i, j in different)
