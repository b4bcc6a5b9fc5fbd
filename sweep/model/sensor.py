"""The sensor, pixel by pixel after the optics: light, noise, gain, quantisation."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled, compiled_inline
from sweep.model.coverage import ROUNDING_SNAP
from sweep.model.splitmix import mixed
from sweep.typing import Floats

_PIXEL_STEP = np.uint64(0x9E3779B97F4A7C15)
_DRAW_STEP = np.uint64(0xD1342543DE82EF95)
_ONE = np.uint64(1)


class Light(NamedTuple):
    """How the light varies over the frame.

    Attributes
    ----------
    slope_x, slope_y
        Change of the light per pixel, relative to that at the middle.
    middle_x, middle_y
        Middle of the frame in pixels.
    vignetting
        Power of the cosine of the angle to the optical axis.
    """

    slope_x: float
    slope_y: float
    middle_x: float
    middle_y: float
    vignetting: float


class Readout(NamedTuple):
    """The sensor's noise and quantisation.

    Attributes
    ----------
    key
        Key of the scene's noise: all of a pixel's noise is a function of it and of the pixel.
    full_well_e, read_noise_e
        Electrons at level 255 and gain 1, and standard deviation of the read noise in electrons;
        NaN for no electrons.
    gain, noise_grey, bits
        As :class:`sweep.model.effects.Effects` has them.
    """

    key: np.uint64
    full_well_e: float
    read_noise_e: float
    gain: float
    noise_grey: float
    bits: int


@compiled
def illuminate(
    levels: Floats, left: int, top: int, light: Light, intrinsics: Floats
) -> None:
    """Multiply levels (h, w), whose top left pixel is (left, top), by the light on each pixel.

    1 + slope · (pixel - middle of the frame), never below 0, times the ``vignetting``-th power of
    the cosine of the pixel's angle to the optical axis (the natural cos⁴ law: Born and Wolf,
    "Principles of optics", section 4.8.1). ``intrinsics`` (4,) is fx, fy, cx, cy.
    """
    slope_x, slope_y, middle_x, middle_y, vignetting = light
    for i in range(levels.shape[0]):
        y = (top + i - intrinsics[3]) / intrinsics[1]
        along_y = 1.0 + slope_y * (top + i - middle_y)
        for j in range(levels.shape[1]):
            factor = max(along_y + slope_x * (left + j - middle_x), 0.0)
            if vignetting > 0.0:
                x = (left + j - intrinsics[2]) / intrinsics[0]
                factor *= (1.0 + x * x + y * y) ** (-0.5 * vignetting)
            levels[i, j] *= factor


@compiled
def _uniform(pixel: np.uint64, draw: int) -> float:
    """Return draw number ``draw`` of a pixel's key, in (0, 1)."""
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


@compiled_inline
def _pixel_key(key: np.uint64, column: int, row: int) -> Any:
    """Return the key of a pixel's draws: a function of the scene's key and of its position."""
    position = (np.uint64(row) << np.uint64(32)) + np.uint64(column)
    return mixed(key + _PIXEL_STEP * (position + _ONE))


@compiled_inline
def _signal(level: float, pixel: np.uint64, readout: Readout) -> float:
    """Return a pixel's signal in grey levels: electrons and their noise, gain, plain noise.

    In this order: electrons with shot noise, at most ``full_well_e``, and read noise; gain; plain
    Gaussian noise in grey levels (EMVA standard 1288, section 2).
    """
    if not math.isnan(readout.full_well_e):
        electrons = _poisson(level * readout.full_well_e / 255.0, pixel, 4)
        electrons = min(electrons, readout.full_well_e)
        if readout.read_noise_e > 0.0:
            electrons += readout.read_noise_e * _normal(pixel, 0)
        level = electrons * 255.0 / readout.full_well_e
    level *= readout.gain
    if readout.noise_grey > 0.0:
        level += readout.noise_grey * _normal(pixel, 2)
    return level


@compiled_inline
def _digitised(level: float, bits: int, most: float) -> np.uint8:
    """Return a level quantised to ``bits`` (``most`` is the largest value), clipped, in 8 bits."""
    counts = float(math.floor(level * (most / 255.0) + (0.5 + ROUNDING_SNAP)))
    counts = min(max(counts, 0.0), most)
    if bits != 8:
        counts = math.floor(counts * (255.0 / most) + 0.5)
    return np.uint8(counts)


@compiled
def read_out(
    levels: Floats, left: int, top: int, readout: Readout, image: NDArray[np.uint8]
) -> None:
    """Turn levels (h, w), whose top left pixel is (left, top), into the image (h, w).

    In one pass: :func:`add_noise` and :func:`digitise`.
    """
    most = 2.0**readout.bits - 1.0
    for i in range(levels.shape[0]):
        for j in range(levels.shape[1]):
            pixel = _pixel_key(readout.key, left + j, top + i)
            image[i, j] = _digitised(_signal(levels[i, j], pixel, readout), readout.bits, most)


@compiled
def add_noise(levels: Floats, left: int, top: int, readout: Readout) -> None:
    """Replace levels (h, w) by the signal with noise and gain, in grey levels, not quantised."""
    for i in range(levels.shape[0]):
        for j in range(levels.shape[1]):
            pixel = _pixel_key(readout.key, left + j, top + i)
            levels[i, j] = _signal(levels[i, j], pixel, readout)


@compiled
def digitise(levels: Floats, bits: int, image: NDArray[np.uint8]) -> None:
    """Quantise levels (h, w) to ``bits``, clipped, and write them to ``image`` in 8 bits."""
    most = 2.0**bits - 1.0
    for i in range(levels.shape[0]):
        for j in range(levels.shape[1]):
            image[i, j] = _digitised(levels[i, j], bits, most)


@compiled
def standard_normals(key: np.uint64, draw: int, left: int, top: int, normals: Floats) -> None:
    """Fill ``normals`` (h, w) with standard normal numbers, a function of key and pixel alone.

    From draws number ``draw`` and the next of each pixel; the first pixel is (left, top).
    """
    for i in range(normals.shape[0]):
        for j in range(normals.shape[1]):
            normals[i, j] = _normal(_pixel_key(key, left + j, top + i), draw)
