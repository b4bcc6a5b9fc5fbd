"""The image by brute force: N x N samples a pixel, each traced back through lens and pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model.lens import undistort


@compiled
def _unit(key: int) -> float:
    """Return a number in [0, 1) that depends on ``key`` alone (splitmix64's finaliser)."""
    z = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.float64((z ^ (z >> np.uint64(31))) >> np.uint64(11)) * 2.0**-53


@compiled
def supersample(
    mean: NDArray[np.float64],
    share: NDArray[np.float64],
    per_side: int,
    jittered: bool,
    modules: NDArray[np.bool_],
    quiet: float,
    levels: NDArray[np.float64],
    inverse: NDArray[np.float64],
    view: NDArray[np.float64],
    lens: NDArray[np.float64],
    distorted: bool,
    left: int,
    top: int,
) -> None:
    """Write the mean level of the marker's samples to ``mean`` and their share to ``share``.

    ``mean`` counts samples beside the marker as level 0, so a pixel's level is
    ``mean + (1 - share) * background``. ``inverse`` (3, 3) takes normalised image coordinates to
    module coordinates; samples are at the middle of N x N cells of the pixel or, ``jittered``,
    anywhere within them. The other arguments are those of
    :func:`sweep.model.coverage.accumulate`.
    """
    n = modules.shape[0]
    total = per_side * per_side
    for i in range(mean.shape[0]):
        for j in range(mean.shape[1]):
            level, hits = 0.0, 0
            for k in range(total):
                offset_x, offset_y = 0.5, 0.5
                if jittered:
                    key = (((top + i) * 131072 + left + j) * total + k) * 2 + 1
                    offset_x, offset_y = _unit(key), _unit(key + 1)
                u = left + j - 0.5 + (k % per_side + offset_x) / per_side
                v = top + i - 0.5 + (k // per_side + offset_y) / per_side
                x, y = (u - view[2]) / view[0], (v - view[3]) / view[1]
                if distorted:
                    x, y, found = undistort(x, y, lens)
                    if not found:
                        continue
                w = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
                if not w > 0.0:
                    continue
                column = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / w
                line = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / w
                if not (-quiet <= column < n + quiet and -quiet <= line < n + quiet):
                    continue
                hits += 1
                white = True
                if 0.0 <= column < n and 0.0 <= line < n:
                    white = modules[int(line), int(column)]
                level += levels[2] if white else levels[1]
            mean[i, j] = level / total
            share[i, j] = hits / total
