"""How far corners and poses moved between two treatments of the same images, as statistics."""

from __future__ import annotations

import numpy as np

from sweep.analysis.means import Mean, RootMeanSquare
from sweep.analysis.pose_pairs import Pair
from sweep.analysis.pose_view import norm_squared
from sweep.analysis.quantities import QUANTITIES
from sweep.typing import Floats

CORNERS = "corner_error_px"
ROTATION = "rotation_error_rad"

_ROTATION, _DEPTH = QUANTITIES[:2]


def corner_shift(whose: str) -> RootMeanSquare[Pair]:
    """Return the RMS of the second corners minus the first, ``whose`` in its description."""
    return RootMeanSquare(
        "corner_shift_rms_px", f"RMS of a corner's coordinate minus {whose}", "px", _corner_shift,
        lambda pair: pair.compared & pair.first.detected & pair.second.detected)


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


def _corner_shift(pair: Pair) -> Floats:
    moved = np.subtract(pair.second[CORNERS], pair.first[CORNERS], dtype=np.float64)
    return np.asarray((moved**2).mean(axis=(-2, -1))[..., None])


def _rotation_shift(pair: Pair) -> Floats:
    moved = np.subtract(pair.second[ROTATION], pair.first[ROTATION], dtype=np.float64)
    return norm_squared(np.degrees(moved))[..., None]
