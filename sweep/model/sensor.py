"""Light on the sensor, its noise, and what is read out: pixel by pixel, after the optics."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model.coverage import ROUNDING_SNAP
from sweep.model.splitmix import mixed

_PIXEL_STEP = np.uint64(0x9E3779B97F4A7C15)
_DRAW_STEP = np.uint64(0xD1342543DE82EF95)
_ONE = np.uint64(1)


@compiled
def illuminate(
    levels: NDArray[np.float64], left: int, top: int, slope_x: float, slope_y: float,
    middle_x: float, middle_y: float, view: NDArray[np.float64], vignetting: float,
) -> None:
    """Multiply levels (h, w), whose top left pixel is given, by the light that falls there.

    1 + slope · (pixel - middle of the frame), never below 0, times the ``vignetting``-th power of
    the cosine of the pixel's angle to the optical axis (the natural cos⁴ law: Born and Wolf,
    "Principles of optics", section 4.8.1). ``view`` (4,) is fx, fy, cx, cy.
    """
    for i in range(levels.shape[0]):
        y = (top + i - view[3]) / view[1]
        along_y = 1.0 + slope_y * (top + i - middle_y)
        for j in range(levels.shape[1]):
            light = max(along_y + slope_x * (left + j - middle_x), 0.0)
            if vignetting > 0.0:
                x = (left + j - view[2]) / view[0]
                light *= (1.0 + x * x + y * y) ** (-0.5 * vignetting)
            levels[i, j] *= light


@compiled
def _uniform(pixel: np.uint64, draw: int) -> float:
    """Return the draw of a given number of a pixel's key, in (0, 1)."""
    bits = mixed(pixel + _DRAW_STEP * (np.uint64(draw) + _ONE))
    return (float(bits >> np.uint64(11)) + 0.5) * 2.0**-53


@compiled
def _normal(pixel: np.uint64, draw: int) -> float:
    """Return a standard normal number from draws ``draw`` and the next (Box and Muller 1958)."""
    radius = math.sqrt(-2.0 * math.log(_uniform(pixel, draw)))
    return radius * math.cos(2.0 * math.pi * _uniform(pixel, draw + 1))


@compiled
def _poisson(mean: float, pixel: np.uint64, draw: int) -> float:
    """Return a Poisson number, exactly distributed, from draws ``draw`` and those after it.

    Below a mean of 10 by multiplying (Knuth, "The art of computer programming", vol. 2, 3.4.1);
    else by transformed rejection (Hörmann, "The transformed rejection method for generating
    Poisson random variables", 1993, algorithm PTRS).
    """
    if mean <= 0.0:
        return 0.0
    if mean < 10.0:
        limit, product, count = math.exp(-mean), _uniform(pixel, draw), 0.0
        while product > limit:
            draw += 1
            count += 1.0
            product *= _uniform(pixel, draw)
        return count
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    shape = 1.1239 + 1.1328 / (b - 3.4)
    fast = 0.9277 - 3.6224 / (b - 2.0)
    logarithm = math.log(mean)
    while True:
        u, v = _uniform(pixel, draw) - 0.5, _uniform(pixel, draw + 1)
        draw += 2
        us = 0.5 - abs(u)
        k = math.floor((2.0 * a / us + b) * u + mean + 0.43)
        if us >= 0.07 and v <= fast:
            return k
        if k < 0.0 or (us < 0.013 and v > us):
            continue
        left = math.log(v) + math.log(shape) - math.log(a / (us * us) + b)
        if left <= k * logarithm - mean - math.lgamma(k + 1.0):
            return k


@compiled
def read_out(
    levels: NDArray[np.float64], left: int, top: int, key: np.uint64, full_well: float,
    read_noise: float, gain: float, noise: float, bits: int, image: NDArray[np.uint8],
) -> None:
    """Turn levels (h, w), whose top left pixel is given, into the image (h, w).

    In this order: electrons with shot noise, at most ``full_well``, and ``read_noise`` (e-); gain;
    plain Gaussian ``noise`` (grey levels); quantisation to ``bits``, clipped; 8 bits for OpenCV.
    ``full_well`` is NaN where there are no electrons. All of a pixel's noise is a function of
    ``key`` and of where it lies in the frame (EMVA standard 1288, section 2, has the model).
    """
    most = 2.0**bits - 1.0
    for i in range(levels.shape[0]):
        for j in range(levels.shape[1]):
            level = levels[i, j]
            place = (np.uint64(top + i) << np.uint64(32)) + np.uint64(left + j)
            pixel = mixed(key + _PIXEL_STEP * (place + _ONE))
            if not math.isnan(full_well):
                electrons = _poisson(level * full_well / 255.0, pixel, 4)
                electrons = min(electrons, full_well)
                if read_noise > 0.0:
                    electrons += read_noise * _normal(pixel, 0)
                level = electrons * 255.0 / full_well
            level *= gain
            if noise > 0.0:
                level += noise * _normal(pixel, 2)
            counts = math.floor(level * (most / 255.0) + (0.5 + ROUNDING_SNAP))
            counts = min(max(counts, 0.0), most)
            if bits != 8:
                counts = math.floor(counts * (255.0 / most) + 0.5)
            image[i, j] = np.uint8(counts)
