"""Noise that is correlated from pixel to pixel, and noise that is a table over the level."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from sweep.compilation import compiled
from sweep.model.sensor import standard_normals
from sweep.typing import Floats

REACH = 5.0
"""Standard deviations at which the kernel's Gaussian is cut off."""


@lru_cache(maxsize=256)
def noise_kernel(correlation: float) -> Floats:
    """Return the weights (2 n + 1,) whose sums of white noise have a correlation at a lag of 1 px.

    A Gaussian, of the width at which the correlation of neighbours is ``correlation`` to rounding;
    the squares of its weights sum to 1, so that the variance is kept. Its correlation at a lag of d
    px is that of the weights with themselves, sum k[i] k[i + d]: about ``correlation`` ** d².
    """
    widest = 0.5 / math.sqrt(-math.log(correlation))
    reach = math.ceil(REACH * widest) + 2

    def weights(sigma: float) -> list[float]:
        return [math.exp(-0.5 * (i / sigma) ** 2) for i in range(-reach, reach + 1)]

    def at_lag(kernel: Sequence[float], lag: int) -> float:
        return math.fsum(a * b for a, b in zip(kernel, kernel[lag:], strict=False))

    low, high = 0.0, 1.5 * widest + 0.1
    for _ in range(100):
        middle = (low + high) / 2
        kernel = weights(middle)
        if at_lag(kernel, 1) < correlation * at_lag(kernel, 0):
            low = middle
        else:
            high = middle
    kernel = weights(high)
    return np.array(kernel) / math.sqrt(at_lag(kernel, 0))


@compiled
def filter_field(white: Floats, kernel: Floats, field: Floats) -> None:
    """Write the separable sums of ``white`` (h + 2 n, w + 2 n) by ``kernel`` to ``field`` (h, w).

    Each number is summed in the same order, wherever it lies.
    """
    taps = len(kernel)
    height, width = field.shape
    across = np.zeros((white.shape[0], width))
    for i in range(white.shape[0]):
        for k in range(taps):
            for j in range(width):
                across[i, j] += kernel[k] * white[i, j + k]
    for i in range(height):
        for j in range(width):
            field[i, j] = 0.0
        for k in range(taps):
            for j in range(width):
                field[i, j] += kernel[k] * across[i + k, j]


def normal_field(
    key: np.uint64, draw: int, left: int, top: int, shape: tuple[int, ...], correlation: float
) -> Floats:
    """Return standard normal numbers (h, w), correlated along rows and along columns.

    Each is a function of ``key``, ``draw`` (as of :func:`sweep.model.sensor.standard_normals`) and
    its pixel's place in the frame, the first of which is (left, top). The correlation of two pixels
    is the product of those along each axis (:func:`noise_kernel`); with 0 they are independent.
    """
    kernel = noise_kernel(correlation) if correlation > 0 else np.ones(1)
    reach = len(kernel) // 2
    white = np.empty((shape[0] + 2 * reach, shape[1] + 2 * reach))
    standard_normals(key, draw, left - reach, top - reach, white)
    if not reach:
        return white
    field = np.empty(shape)
    filter_field(white, kernel, field)
    return field


def deviations(levels: Floats, table: Sequence[float]) -> Floats:
    """Return the noise's standard deviation at levels (h, w).

    ``table`` is level, standard deviation, level, standard deviation, ..., ascending in level: it
    is interpolated linearly and goes on, constant, beyond its ends.
    """
    return np.interp(levels, table[::2], table[1::2])
