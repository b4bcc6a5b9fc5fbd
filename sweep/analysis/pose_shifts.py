"""How far corners and poses moved between two treatments of the same images, as statistics."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis.board_markers import OF_MARKERS
from sweep.analysis.means import Mean, RootMeanSquare
from sweep.analysis.pose_pairs import Pair
from sweep.analysis.pose_view import norm_squared
from sweep.analysis.quantities import QUANTITIES
from sweep.typing import Floats, Masks

CORNERS = "corner_error_px"
OF_BOARDS = next(name for name, single in OF_MARKERS.items() if single == CORNERS)
ROTATION = "rotation_error_rad"

_ROTATION, _DEPTH = QUANTITIES[:2]

_POSE_DIMENSIONS = 4
"""Groups, cells, draws and settings: what stands before the dimensions of a pose's corners."""


def corners_of(results: xr.Dataset) -> str:
    """Return the name of the corners' errors: a marker's, or those of a board's markers."""
    return OF_BOARDS if OF_BOARDS in results else CORNERS


def corner_shift(whose: str, corners: str) -> RootMeanSquare[Pair]:
    """Return the RMS of the second corners minus the first, ``whose`` in its description.

    ``corners`` as :func:`corners_of` returns it. Of a board the corners count that both found; one
    without any does not count.
    """
    def in_both(pair: Pair) -> Masks:
        shown = pair.compared & pair.first.detected & pair.second.detected
        return shown if corners == CORNERS else np.asarray(
            shown & np.isfinite(_corner_shift(pair, corners)[..., 0]))

    return RootMeanSquare(
        "corner_shift_rms_px", f"RMS of a corner's coordinate minus {whose}", "px",
        lambda pair: _corner_shift(pair, corners), in_both)


def corners_moved(pair: Pair, corners: str) -> Masks:
    """Return which poses have a corner of another value, or one that only one of both found."""
    first, second = pair.first[corners], pair.second[corners]
    moved = (first != second) & ~(np.isnan(first) & np.isnan(second))
    return np.asarray(moved.any(axis=tuple(range(_POSE_DIMENSIONS, moved.ndim))))


def pose_shifts(whose: str) -> list[Mean[Pair] | RootMeanSquare[Pair]]:
    """Return bias of the range and RMS of the rotation, second minus first, as `corner_shift`."""
    return [
        Mean("range_bias_percent",
             f"mean depth error minus {whose}, of the true depth, both solved", "percent",
             lambda pair: _DEPTH.vector(pair.second) - _DEPTH.vector(pair.first),
             lambda pair: pair.both_solved),
        RootMeanSquare(
            "rotation_shift_deg",
            f"RMS of the rotation error minus {whose}, both solved and not flipped",
            _ROTATION.units, _rotation_shift,
            lambda pair: pair.first.unflipped & pair.second.unflipped),
    ]


def _corner_shift(pair: Pair, corners: str) -> Floats:
    """Return the mean squared difference (..., 1) of the corners that both found, else NaN."""
    moved = np.subtract(pair.second[corners], pair.first[corners], dtype=np.float64) ** 2
    if corners == CORNERS:
        return np.asarray(moved.mean(axis=(-2, -1))[..., None])
    inner = tuple(range(_POSE_DIMENSIONS, moved.ndim))
    found = np.isfinite(moved).sum(axis=inner)
    total = np.nansum(moved, axis=inner)
    return np.where(found > 0, total / np.maximum(found, 1), np.nan)[..., None]


def _rotation_shift(pair: Pair) -> Floats:
    moved = np.subtract(pair.second[ROTATION], pair.first[ROTATION], dtype=np.float64)
    return norm_squared(np.degrees(moved))[..., None]
