"""Flips of one marker, of two, of two at an angle, and of a board of the same size: one figure.

    python pipelines/boards/flips.py OUTPUT.png [POSES]

Runs a pipeline for each target (a minute with 60 poses a distance, into ``runs/``) and draws the
share of poses that are nearer to the mirror of the truth, with intervals of 95 %.
"""  # noqa: INP001  (not a package)

from __future__ import annotations

import sys
from typing import Any

import matplotlib as mpl
import xarray as xr
from matplotlib.figure import Figure

import sweep
from sweep.analysis import flip_rate
from sweep.report.figure import COLOURS, SHAPES, STYLE

SIDE_M = 0.08
TARGETS: dict[str, dict[str, Any]] = {
    "one marker of 80 mm": {"marker": {"size_m": SIDE_M}, "board": {"kind": "none"}},
    "two of 38 mm in a plane": {
        "marker": {"size_m": 0.038},
        "board": {"kind": "grid", "rows": 1, "columns": 2, "gap_m": 0.004},
    },
    "two of 38 mm, folded by 60°": {
        "board": {"kind": "markers", "markers": [
            {"marker_id": k, "x_m": x, "y_m": 0.0, "size_m": 0.038, "tilt_deg": 30.0 * side,
             "azimuth_deg": 90.0} for k, (x, side) in enumerate(((-0.022, -1), (0.022, 1)))
        ]},
    },
    "3 x 3 of 22 mm": {
        "marker": {"size_m": 0.022},
        "board": {"kind": "grid", "rows": 3, "columns": 3, "gap_m": 0.007},
    },
}


COMMON: dict[str, Any] = {
    "seed": 22,
    "camera": {"width_px": 640, "height_px": 480, "fx_px": 600, "fy_px": 600},
    "pose": {"tilt_deg": {"uniform": [0, 40]}, "azimuth_deg": {"uniform": [0, 360]},
             "roll_deg": {"uniform": [-180, 180]}, "jitter_px": 20},
    "scene": {"blur_px": 0.5, "noise_grey": 2, "black": 40, "white": 200, "background": 120},
    "detector": {"cornerRefinementMethod": "subpix"},
    "estimator": {"solver": "sqpnp"},
}


def flips(name: str, number: int, poses: int) -> xr.Dataset:
    """Return the rate of flips by distance of one target, from a run or the store that it left."""
    target = TARGETS[name]
    marker = {"dictionary": "DICT_4X4_50", "size_m": 0.038} | target.get("marker", {})
    pipeline = sweep.Pipeline.from_dict({
        **COMMON, "title": f"Flips of {name}", "marker": marker, "board": target["board"],
        "axes": {"distance_m": [0.4, 0.6, 0.8, 1.0, 1.3], "trial": poses},
    })
    results = sweep.run(pipeline, store=f"runs/flips_{number}.zarr")
    return flip_rate(results, per=["distance_m"]).compute()


def main(output: str, poses: str = "60") -> None:
    """Run what is not run yet, print the rates, and draw the figure."""
    with mpl.rc_context(fname=STYLE):
        figure = Figure(figsize=(7.0, 3.8), layout="constrained")
        axes = figure.subplots()
        for number, name in enumerate(TARGETS):
            rates = flips(name, number, int(poses))
            middle, low, high = (
                100 * rates[f"flip_rate{end}"].values for end in ("", "_low", "_high")
            )
            rates_text = "  ".join(f"{each:.1f} %" for each in middle)
            print(f"{name}  {rates_text}")  # noqa: T201  (a command)
            distance = rates["distance_m"].values * 1.006**number  # beside each other
            axes.errorbar(
                distance, middle, [middle - low, high - middle], label=name, lw=1.4, ms=5,
                color=COLOURS[number], marker=SHAPES[number], elinewidth=0.8,
            )
        axes.set(
            xlabel="distance, m", ylabel="flipped, % of solved poses", ylim=(0, None),
            xlim=(0.38, 1.36),
        )
        axes.grid(axis="y")
        axes.legend(loc="upper left")
        figure.savefig(output, dpi=150)


if __name__ == "__main__":
    main(*sys.argv[1:])
