"""Whether a camera's file is of the photographs' resolution, where it does not say."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from sweep.errors import ArgumentError
from sweep.messages import plain
from sweep.photographs.board_truth import fitted_board
from sweep.photographs.corners import FoundCorners
from sweep.photographs.pose_fit import Lens

DOUBTFUL_PX = 0.5
"""RMS of a board's corners, in the median photograph, from which other resolutions are tried."""

CLEARLY = 0.5
"""Share of that RMS below which another resolution fits."""

MAX_TRIED = 5
"""Photographs with the most corners in which they are tried."""

SCALES = tuple(map(Fraction, ("1/4", "1/3", "1/2", "2/3", "3/4", "4/3", "3/2", "2", "3", "4")))
"""Resolutions of photographs over that of a calibration."""


def check_resolution(
    written: str, lens: Lens, size: tuple[int, int], found: Sequence[FoundCorners], rms_px: float
) -> None:
    """Refuse a camera of a file that fits the board far better in another resolution.

    Parameters
    ----------
    written
        The file.
    lens, size
        The camera, and the photographs' width and height in px.
    found
        The board's corners in each photograph.
    rms_px
        Their RMS in the median photograph with this camera.

    Raises
    ------
    ArgumentError
        One line.
    """
    if rms_px < DOUBTFUL_PX:
        return
    best = sorted(found, key=lambda each: -len(each.points))[:MAX_TRIED]
    own = _median_rms(lens, best)
    fitting = {scale: _median_rms(scaled(lens, float(scale)), best) for scale in SCALES}
    scale = min(fitting, key=lambda each: fitting[each])
    if fitting[scale] < CLEARLY * own:
        raise ArgumentError(
            "camera", plain(written),
            f"the board's corners are {own:.2g} px RMS beside it, and {fitting[scale]:.2g} px if "
            f"its numbers are times {scale}: it is of another resolution; give the calibration of "
            f"{size[0]} x {size[1]}",
        )


def scaled(lens: Lens, scale: float) -> Lens:
    """Return the camera of images that are ``scale`` times as large; pixels' edges lie at halves.

    >>> scaled(Lens.of(100.0, 100.0, 9.5, 7.5, ()), 2.0).matrix[0].tolist()
    [200.0, 0.0, 19.5]
    """
    matrix = lens.matrix.copy()
    matrix[:2] *= scale
    matrix[:2, 2] += (scale - 1.0) / 2.0
    return Lens(matrix, lens.distortion)


def _median_rms(lens: Lens, found: Sequence[FoundCorners]) -> float:
    fits = [fitted_board(lens, each) for each in found]
    return float(np.median([np.inf if fit is None else fit.rms_px for fit in fits]))
