"""What more markers on a board gain: spread and bias of the range, and the accuracy bound.

    python pipelines/boards/gain.py OUTPUT.png [POSES]

Runs a pipeline (into ``runs/gain.zarr``), prints a table for each series, and draws the figure. All
markers have sides of 16 mm. They are spread over a square of 120 mm, or are 4.8 mm apart whatever
that spans.
"""  # noqa: INP001  (not a package)

from __future__ import annotations

import sys
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

import sweep
from sweep.analysis import efficiency, error_statistics
from sweep.report.figure import COLOURS, STYLE

SIDE_M, SPAN_M, GAP_M = 0.016, 0.12, 0.0048
SERIES: dict[str, dict[int, float]] = {
    "within 120 mm": {k: round((SPAN_M - k * SIDE_M) / (k - 1), 6) for k in (2, 3, 4, 5, 6)},
    "4.8 mm apart": dict.fromkeys((1, 2, 3, 4, 5), GAP_M),
}
"""Name -> markers in a row -> the gap between them in metres."""

REFINEMENTS = ("none", "subpix", "apriltag")

COMMON: dict[str, Any] = {
    "title": "What more markers gain",
    "seed": 22,
    "camera": {"width_px": 640, "height_px": 480, "fx_px": 600, "fy_px": 600},
    "marker": {"dictionary": "DICT_4X4_50", "size_m": SIDE_M},
    "board": {"kind": "grid"},
    "pose": {"distance_m": 0.4, "tilt_deg": {"uniform": [10, 50]},
             "azimuth_deg": {"uniform": [0, 360]}, "roll_deg": {"uniform": [-180, 180]},
             "jitter_px": 20},
    "scene": {"blur_px": 0.5, "noise_grey": 2, "black": 40, "white": 200, "background": 120,
              "bound": "known_blur"},
    "estimator": {"solver": "iterative", "corner_noise_px": 1},
}


def computed(poses: int) -> xr.Dataset:
    """Return statistics of the range's errors by board and refinement, from a run or its store.

    Beside those of the analysis: ``independent_percent``, the spread that independent errors of
    1 px of all corners would give, and ``bound_percent``, that of the bound.
    """
    grids = [(k, gap) for series in SERIES.values() for k, gap in series.items()]
    rows = [k for k, _ in grids]
    pipeline = sweep.Pipeline.from_dict({**COMMON, "axes": {
        "target": {"zip": {"rows": rows, "columns": rows, "gap_m": [gap for _, gap in grids]}},
        "cornerRefinementMethod": list(REFINEMENTS), "trial": poses,
    }})
    results = sweep.run(pipeline, store="runs/gain.zarr")
    per = ["target", "cornerRefinementMethod"]
    table = error_statistics(results, per=per).merge(efficiency(results, per=per))
    depth = {"pose_parameter": "translation_z"}
    for name, of in (("independent", "predicted_std"), ("bound", "bound_std")):
        share = 100 * results[of].sel(depth, drop=True) / results["true_tvec_m"].sel(xyz="z")
        table[f"{name}_percent"] = np.sqrt((share**2).mean("trial"))
    return table.compute()


def interval(table: xr.Dataset, name: str, digits: int) -> list[str]:
    """Return numbers with their intervals of 95 % as text."""
    ends = (table[f"{name}{end}"].values.tolist() for end in ("", "_low", "_high"))
    return [f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"
            for middle, low, high in zip(*ends, strict=True)]


def print_table(title: str, counts: list[int], table: xr.Dataset) -> None:
    """Print a series as a table in Markdown."""
    lines = [["", "", *(f"n = {n}" for n in counts)], ["---"] * (len(counts) + 2)]
    for refinement in REFINEMENTS:
        each = table.sel(cornerRefinementMethod=refinement)
        ratio = 1 / xr.Dataset({
            f"ratio{end}": each[f"range_efficiency{other}"]
            for end, other in (("", ""), ("_low", "_high"), ("_high", "_low"))
        })
        spread, law = (each[name].values for name in ("range_sd_percent", "independent_percent"))
        lines += [
            [refinement, "RMSE / bound", *interval(ratio, "ratio", 1)],
            ["", "bias, %", *interval(each, "range_bias_percent", 3)],
            ["", "spread, %", *interval(each, "range_sd_percent", 3)],
            ["", "of independent corners, px", *(f"{value:.3f}" for value in spread / law)],
        ]
    lines.append(["bound, %", "", *(f"{value:.4f}" for value in table["bound_percent"].values)])
    print(f"\n{title}\n")  # noqa: T201  (a command)
    for line in lines:
        print(f"| {' | '.join(line)} |")  # noqa: T201  (a command)


def draw(axes: Any, counts: list[int], each: xr.Dataset) -> None:
    """Draw spread, bias, what independent corners would give, and the bound, against markers."""
    spread = each["range_sd_percent"].values
    law = each["independent_percent"].values * spread[0] / each["independent_percent"].values[0]
    for name, label, colour, shape in (
        ("range_bias_percent", "bias", COLOURS[1], "s"),
        ("range_sd_percent", "spread", COLOURS[0], "o"),
    ):
        low, high = (each[f"{name}{end}"].values for end in ("_low", "_high"))
        signed = each[name].values
        middle = np.abs(signed)
        away = np.where(signed < 0, -1, 1)
        ends = np.sort([away * low, away * high], axis=0).clip(1e-4)
        axes.errorbar(counts, middle, np.abs(ends - middle), label=label, color=colour,
                      marker=shape, ms=4.5, lw=1.4, elinewidth=0.8)
    axes.plot(counts, law, "--", color=COLOURS[0], lw=1, label="spread of independent corners")
    axes.plot(counts, each["bound_percent"], color="0.35", lw=1.2, label="bound")


def main(output: str, poses: str = "200") -> None:
    """Run what is not run yet, print the tables, and draw the figure."""
    table, first = computed(int(poses)), 0
    with mpl.rc_context(fname=STYLE):
        figure = Figure(figsize=(7.6, 5.2), layout="constrained")
        panels = figure.subplots(len(SERIES), len(REFINEMENTS), sharex="row", sharey=True)
        for row, (title, series) in zip(panels, SERIES.items(), strict=True):
            part = table.isel(target=slice(first, first + len(series)))
            first, counts = first + len(series), [k * k for k in series]
            print_table(title, counts, part)
            for axes, refinement in zip(row, REFINEMENTS, strict=True):
                draw(axes, counts, part.sel(cornerRefinementMethod=refinement))
                axes.set(xscale="log", yscale="log", title=f"{refinement}, {title}")
                axes.set_xticks(counts, [str(n) for n in counts])
                axes.set_yticks([0.001, 0.01, 0.1, 1.0], ["0.001", "0.01", "0.1", "1"])
                axes.minorticks_off()
                axes.grid(axis="y")
            row[0].set_ylabel("error of the range, %")
        for axes in panels[-1]:
            axes.set_xlabel("markers")
        lines, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(lines, labels, loc="outside upper center", ncols=4)
        figure.savefig(output, dpi=150)


if __name__ == "__main__":
    main(*sys.argv[1:])
