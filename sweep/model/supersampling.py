"""The image by brute force: N x N samples a pixel, each traced back through lens and pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model.lens import undistort
from sweep.model.projection import Optics
from sweep.model.splitmix import mixed
from sweep.typing import Floats


class SampledMarker(NamedTuple):
    """A marker or a board as its samples see it.

    Attributes
    ----------
    modules
        (n, n) True for white; (0, 0) of a board.
    quiet
        Width of the quiet zone in modules.
    outlines
        (E, 6) of a board: ends of its edges, and the code of the areas on their two sides.
    prints
        (P, 6) of a board: first and past-the-end row of each print's edges, and left, top, right,
        bottom of the print.
    levels
        (3,) grey levels of outside, black and white.
    inverse
        (3, 3) takes undistorted normalised image coordinates to module coordinates.
    optics
        The camera.
    """

    modules: NDArray[np.bool_]
    quiet: float
    outlines: Floats
    prints: Floats
    levels: Floats
    inverse: Floats
    optics: Optics


@compiled
def _unit(key: int) -> float:
    """Return a number in [0, 1) that depends on ``key`` alone."""
    bits = mixed(np.uint64(key) * np.uint64(0x9E3779B97F4A7C15))
    return np.float64(bits >> np.uint64(11)) * 2.0**-53


@compiled
def _on_board(column: float, line: float, marker: SampledMarker) -> tuple[float, float]:
    """Return the level of a board's point, beside the board 0, and whether the board has it.

    The sum of the jumps at the edges to the left of the point, of the prints around it.
    """
    levels = marker.levels
    level, inside = 0.0, 0.0
    for each in marker.prints:
        if not (each[2] <= column < each[4] and each[3] <= line < each[5]):
            continue
        for k in range(int(each[0]), int(each[1])):
            x0, y0, x1, y1 = marker.outlines[k, :4]
            if not min(y0, y1) <= line < max(y0, y1):
                continue
            if x0 + (x1 - x0) * (line - y0) / (y1 - y0) <= column:
                down = 1.0 if y1 > y0 else -1.0
                a, b = int(marker.outlines[k, 4]), int(marker.outlines[k, 5])
                level += down * ((levels[b] if b > 0 else 0.0) - (levels[a] if a > 0 else 0.0))
                inside += down * (min(b, 1) - min(a, 1))
    return level, inside


@compiled
def supersample(
    mean: Floats, share: Floats, marker: SampledMarker, per_side: int, jittered: bool, left: int,
    top: int,
) -> None:
    """Write the mean level of the marker's samples to ``mean`` and their share to ``share``.

    Both are (height, width), of the box whose top left pixel is (``left``, ``top``). ``mean``
    counts samples beside the marker as level 0, so that a pixel's level is
    ``mean + (1 - share) * background``. Samples lie in the middle of N x N cells of the pixel or,
    if ``jittered``, at random within them.
    """
    modules, quiet, _, _, levels, inverse, optics = marker
    intrinsics, lens = optics.intrinsics, optics.lens
    n = modules.shape[0]
    total = per_side * per_side
    for i in range(mean.shape[0]):
        for j in range(mean.shape[1]):
            level, hits = 0.0, 0.0
            for k in range(total):
                offset_x, offset_y = 0.5, 0.5
                if jittered:
                    key = (((top + i) * 131072 + left + j) * total + k) * 2 + 1
                    offset_x, offset_y = _unit(key), _unit(key + 1)
                u = left + j - 0.5 + (k % per_side + offset_x) / per_side
                v = top + i - 0.5 + (k // per_side + offset_y) / per_side
                x, y = (u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1]
                if optics.distorted:
                    x, y, converged = undistort(x, y, lens)
                    if not converged:
                        continue
                w = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
                if not w > 0.0:
                    continue
                column = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / w
                line = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / w
                if n == 0:
                    seen, inside = _on_board(column, line, marker)
                    level, hits = level + seen, hits + inside
                    continue
                if not (-quiet <= column < n + quiet and -quiet <= line < n + quiet):
                    continue
                hits += 1
                white = True
                if 0.0 <= column < n and 0.0 <= line < n:
                    white = modules[int(line), int(column)]
                level += levels[2] if white else levels[1]
            mean[i, j] = level / total
            share[i, j] = hits / total
