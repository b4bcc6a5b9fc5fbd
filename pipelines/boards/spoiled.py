"""What one spoiled marker costs the pose of a board of 3 x 3, by each estimator: a table.

    python pipelines/boards/spoiled.py [POSES]

Runs a pipeline for each fault (into ``runs/``). Faults are stickers on the board, which are printed
as distractors 0.05 mm in front of it.
"""  # noqa: INP001  (not a package)

from __future__ import annotations

import sys
from typing import Any

import xarray as xr

import sweep
from sweep.analysis import error_statistics

SIDE_M, GAP_M = 0.022, 0.012
PITCH_M = SIDE_M + GAP_M
CORNER, MIDDLE, BESIDE = 2, 4, 5
"""IDs of markers: at the top right, in the middle, and below the former."""


def sticker(marker_id: int, at: int, right_m: float = 0.0, off_m: float = 5e-5) -> dict[str, Any]:
    """Return a sticker with an ID over the marker ``at``, shifted right and off the board."""
    return {"marker_id": marker_id, "x_m": PITCH_M * (at % 3 - 1) + right_m,
            "y_m": PITCH_M * (1 - at // 3), "z_m": off_m}


FAULTS: dict[str, list[dict[str, Any]]] = {
    "none": [],
    "corner marker covered": [
        {name: value for name, value in sticker(0, CORNER).items() if name != "marker_id"}],
    "corner marker 0.5 mm aside": [sticker(CORNER, CORNER, right_m=5e-4)],
    "middle marker 0.5 mm aside": [sticker(MIDDLE, MIDDLE, right_m=5e-4)],
    "corner marker 1 mm off the board": [sticker(CORNER, CORNER, off_m=1e-3)],
    "two neighbours swapped": [sticker(CORNER, BESIDE), sticker(BESIDE, CORNER)],
    "the corner's ID again beside the board": [
        {"marker_id": CORNER, "x_m": 3 * PITCH_M, "y_m": 0.0}],
}

ESTIMATORS: dict[str, tuple[str, str]] = {
    "iterative": ("iterative", "markers"),
    "sqpnp": ("sqpnp", "markers"),
    "ippe": ("ippe", "markers"),
    "each_marker": ("iterative", "each_marker"),
    "largest_marker": ("iterative", "largest_marker"),
}

COMMON: dict[str, Any] = {
    "seed": 22,
    "camera": {"width_px": 640, "height_px": 480, "fx_px": 600, "fy_px": 600},
    "marker": {"dictionary": "DICT_4X4_50", "size_m": SIDE_M},
    "pose": {"distance_m": 0.4, "tilt_deg": {"uniform": [10, 50]},
             "azimuth_deg": {"uniform": [0, 360]}, "roll_deg": {"uniform": [-180, 180]},
             "jitter_px": 20},
    "scene": {"blur_px": 0.5, "noise_grey": 2, "black": 40, "white": 200, "background": 120},
    "detector": {"cornerRefinementMethod": "subpix"},
}


def errors(number: int, stickers: list[dict[str, Any]], poses: int) -> xr.Dataset:
    """Return statistics of errors by estimator of a board with stickers, run or stored."""
    solvers, points = zip(*ESTIMATORS.values(), strict=True)
    board = {"kind": "grid", "rows": 3, "columns": 3, "gap_m": GAP_M}
    pipeline = sweep.Pipeline.from_dict({
        **COMMON, "title": "A spoiled marker",
        "board": board | ({"distractors": stickers} if stickers else {}),
        "axes": {"trial": poses,
                 "method": {"zip": {"solver": list(solvers), "points": list(points)}}},
    })
    results = sweep.run(pipeline, store=f"runs/spoiled_{number}.zarr")
    return error_statistics(results, per=["method"]).compute()


def main(poses: str = "100") -> None:
    """Run what is not run yet, and print the RMSE of rotation and range."""
    tables = [errors(number, each, int(poses)) for number, each in enumerate(FAULTS.values())]
    print_row("", list(ESTIMATORS))
    print_row("---", ["---"] * len(ESTIMATORS))
    for fault, table in zip(FAULTS, tables, strict=True):
        cells = [_cell(table.isel(method=k), tables[0].isel(method=k), fault == "none")
                 for k in range(len(ESTIMATORS))]
        print_row(fault, cells)


def _cell(table: xr.Dataset, sound: xr.Dataset, absolute: bool) -> str:
    """Return RMSE of rotation and range as text: absolute, or as multiples of the sound board's."""
    if table["solved_rate"] < 0.5:
        return "not solved"
    rotation, depth = (
        float(table[name]) / (1.0 if absolute else float(sound[name]))
        for name in ("rotation_rmse_unflipped_deg", "range_rmse_unflipped_percent")
    )
    return f"{rotation:.2f}°, {depth:.2f} %" if absolute else f"{rotation:.1f}, {depth:.1f}"


def print_row(name: str, cells: list[str]) -> None:
    """Print a row of the table in Markdown."""
    print(f"| {name} | {' | '.join(cells)} |")  # noqa: T201  (a command)


if __name__ == "__main__":
    main(*sys.argv[1:])
