"""The sensor and the camera's processing, step by step: noise, gain, response, demosaicing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled, compiled_inline
from sweep.model.coverage import ROUNDING_SNAP, mixed
from sweep.typing import Floats, Grey

# --------------------------------------------------------------------------------------------------
# The sensor, pixel by pixel after the optics: electrons and their noise, quantisation.

_PIXEL_STEP = np.uint64(0x9E3779B97F4A7C15)
_DRAW_STEP = np.uint64(0xD1342543DE82EF95)
_ONE = np.uint64(1)


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


@compiled
def expose(
    levels: Floats, left: int, top: int, key: np.uint64, full_well_e: float, read_noise_e: float
) -> None:
    """Replace levels (h, w) of light by those of electrons with their noise.

    With shot noise, at most ``full_well_e``, which are at level 255, and with read noise of that
    many electrons (EMVA standard 1288, section 2). A pixel's noise is a function of ``key`` and of
    its place in the frame, the first of which is (left, top).
    """
    for i in range(levels.shape[0]):
        for j in range(levels.shape[1]):
            pixel = _pixel_key(key, left + j, top + i)
            electrons = _poisson(levels[i, j] * full_well_e / 255.0, pixel, 4)
            electrons = min(electrons, full_well_e)
            if read_noise_e > 0.0:
                electrons += read_noise_e * _normal(pixel, 0)
            levels[i, j] = electrons * 255.0 / full_well_e


@compiled
def digitise(levels: Floats, bits: int, image: NDArray[np.uint8]) -> None:
    """Quantise levels (h, w) to ``bits``, clipped, and write them to ``image`` in 8 bits."""
    most = 2.0**bits - 1.0
    for i in range(levels.shape[0]):
        for j in range(levels.shape[1]):
            counts = float(math.floor(levels[i, j] * (most / 255.0) + (0.5 + ROUNDING_SNAP)))
            counts = min(max(counts, 0.0), most)
            if bits != 8:
                counts = math.floor(counts * (255.0 / most) + 0.5)
            image[i, j] = np.uint8(counts)


#: The draw of a pixel that plain grey noise is made from, correlated or not.
GREY_NOISE_DRAW = 2


@compiled
def standard_normals(key: np.uint64, draw: int, left: int, top: int, normals: Floats) -> None:
    """Fill ``normals`` (h, w) with standard normal numbers, a function of key and pixel alone.

    From draws number ``draw`` and the next of each pixel; the first pixel is (left, top).
    """
    for i in range(normals.shape[0]):
        for j in range(normals.shape[1]):
            normals[i, j] = _normal(_pixel_key(key, left + j, top + i), draw)


# --------------------------------------------------------------------------------------------------
# Noise that is correlated from pixel to pixel.

#: Standard deviations at which the kernel's Gaussian is cut off.
REACH = 5.0


@lru_cache(maxsize=256)
def noise_kernel(correlation: float) -> Floats:
    """Return the weights (2 n + 1,) whose sums of white noise have a correlation at a lag of 1 px.

    A Gaussian exp(-i² / 2 s²), of the width s at which the correlation of neighbours is
    ``correlation`` to rounding; the squares of its weights sum to 1, so that the variance is kept.
    The correlation at a lag of d px is the kernel's with itself, sum_i k[i] k[i + d]: with Jacobi's
    theta functions at the nome q = exp(-1 / s²) it is exp(-d² / 4 s²) at even d, times
    theta_2(0, q) / theta_3(0, q) at odd d. From a correlation of 0.8 on this is ``correlation`` **
    d² to 1e-4; below it is more: at two pixels 0.025, 0.084 and 0.24 for 0.3, 0.5 and 0.7.
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
    # Each number is summed in the same order, wherever it lies.
    across, field = np.zeros((len(white), shape[1])), np.zeros(shape)
    for k, weight in enumerate(kernel):
        across += weight * white[:, k : k + shape[1]]
    for k, weight in enumerate(kernel):
        field += weight * across[k : k + shape[0]]
    return field


# --------------------------------------------------------------------------------------------------
# A grey scene seen through a colour filter array, and made grey again by OpenCV.

#: Filters of the frame's first two pixels, then those of the two below them.
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")

#: Demosaicing by name -> the ending of OpenCV's conversion code.
METHODS = {"bilinear": "", "edge_aware": "_EA"}

#: Pixels around a pixel that its result depends on: neighbours, and at the frame's border the
#: neighbours of the pixel that OpenCV copies there.
REACH_PX = 2

#: The raw image has 16 bits: 65535 at level 255.
STEPS_PER_LEVEL = 257.0


def demosaiced(
    levels: Floats, pattern: str, method: str, red_gain: float, blue_gain: float
) -> Floats:
    """Return grey levels (h, w) after demosaicing.

    The signal is multiplied by the gain of each pixel's filter (green: 1), quantised to 16 bits
    over the levels 0 to 255, clipped, converted to colour and from that to grey (0.299 R + 0.587 G
    + 0.114 B) by OpenCV.

    Parameters
    ----------
    levels
        The signal of a part of the frame that begins at an even column and an even row.
    pattern, method
        One of :data:`PATTERNS`, and of :data:`METHODS`.
    red_gain, blue_gain
        Of red and blue filters, relative to green.
    """
    gains = {"R": red_gain, "G": 1.0, "B": blue_gain}
    raw = levels.copy()
    for position, colour in enumerate(pattern):
        raw[position // 2 :: 2, position % 2 :: 2] *= gains[colour]
    counts = np.clip(np.floor(raw * STEPS_PER_LEVEL + 0.5), 0, 65535).astype(np.uint16)
    code = getattr(cv2, f"COLOR_Bayer{pattern}2BGR{METHODS[method]}")
    grey = cv2.cvtColor(cv2.cvtColor(counts, code), cv2.COLOR_BGR2GRAY)
    return np.asarray(grey / STEPS_PER_LEVEL)


# --------------------------------------------------------------------------------------------------
# JPEG: an image through the encoder and the decoder that OpenCV has.

#: Sides of the blocks that a grey image is compressed in, each on its own.
BLOCK_PX = 8

#: Largest side of an image that is compressed at once, in whole blocks: JPEG ends at 65535.
TILE_PX = 1 << 14


def compressed(image: Grey, quality: int) -> Grey:
    """Return an image (h, w) after compression with ``quality`` from 1 to 100.

    Blocks count from the image's first pixel: of a part of a frame they are those of the frame if
    it begins at multiples of :data:`BLOCK_PX`, and ends at these or with the frame.
    """
    result = np.empty_like(image)
    setting = [cv2.IMWRITE_JPEG_QUALITY, quality]
    for top in range(0, image.shape[0], TILE_PX):
        for left in range(0, image.shape[1], TILE_PX):
            tile = np.s_[top : top + TILE_PX, left : left + TILE_PX]
            _, code = cv2.imencode(".jpg", image[tile], setting)
            result[tile] = np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    return result


# --------------------------------------------------------------------------------------------------
# A frame of which each pixel is one of a larger image: pixels are not evenly spaced.

#: Largest denominator of the ratio of both images' pixels.
MAX_DENOMINATOR = 8

#: Pixels on each side of a pixel from which levels between pixels are interpolated.
TAPS_PX = 3


def displaced(numbers: NDArray[np.int64], decimation: float) -> Floats:
    """Return how far pixels lie from even spacing, in px along an axis: columns, or rows (...).

    Pixel i is number floor(i · decimation) of the larger image. The mean over all pixels is 0.
    """
    p, q = Fraction(decimation).limit_denominator(MAX_DENOMINATOR).as_integer_ratio()
    return np.asarray(((q - 1) / 2 - numbers * p % q) / p)


def decimated(levels: Floats, left: int, top: int, decimation: float) -> Floats:
    """Return levels (h, w) at the places of :func:`displaced` pixels, the first at (left, top).

    By Lagrange's polynomial through seven pixels along each axis: behind a point spread of 0.4 px
    within 1 % (RMS) of the contrast around a marker; sharper edges overshoot.
    """
    taps = np.arange(-TAPS_PX, TAPS_PX + 1)
    for first in (top, left):
        at = displaced(first + np.arange(len(levels)), decimation)
        weights = [np.prod([(at - k) / (j - k) for k in taps if k != j], axis=0) for j in taps]
        padded = np.pad(levels, ((TAPS_PX, TAPS_PX), (0, 0)), mode="edge")
        parts = [padded[k : k + len(levels)] * each[:, None] for k, each in enumerate(weights)]
        levels = np.sum(parts, axis=0).T
    return levels


# --------------------------------------------------------------------------------------------------
# A camera's response: bloom around bright areas, and a monotonic curve of gamma, toe and knee.

MAX_LEVEL = 255.0

#: The share of the scale, from its end, over which toe and knee act: they never overlap.
BEND = 0.5


def bloomed(levels: Floats, black: float, white: float, bloom: float) -> Floats:
    """Return levels (h, w) with bright areas grown at their edges.

    A level's share s of the way from the darker to the brighter of ``black`` and ``white`` becomes
    s + ``bloom`` · s (1 - s); levels outside them stay. The slope in s is 1 + bloom (1 - 2 s), from
    1 - |bloom| to 1 + |bloom|: the order of levels is kept for ``bloom`` from -1 to 1. Where a
    straight edge of the two levels crosses a pixel, s (1 - s) is the same on both of its sides, so
    that the edge moves towards the dark by the integral of bloom · s (1 - s) across it. With equal
    levels nothing changes.
    """
    dark, bright = min(black, white), max(black, white)
    if bright == dark:
        return levels
    share = np.clip((levels - dark) / (bright - dark), 0.0, 1.0)
    return np.asarray(levels + (bloom * (bright - dark)) * (share * (1.0 - share)))


@compiled
def curve(share: float, gamma: float, toe: float, knee: float) -> float:
    """Return the response, 0 to 1, to a signal from 0 to 1: toe, knee, then gamma.

    The toe acts on the lower half: at x = 2 · share it takes the part toe · (1 - x)² of the signal,
    so that the slope is 1 - toe at black and 1 at the middle. The knee does the same to the upper
    half, seen from white: its slope there is 1 - knee. Gamma is the exponent that follows. Each
    keeps 0 and 1, and grows strictly in between for toe and knee from -1 to 1: the derivative of
    x (1 - a (1 - x)²) is 1 - a (1 - x) (1 - 3 x), where (1 - x) (1 - 3 x) lies between -1/3 and 1,
    and is 1 only at x = 0.
    """
    if share <= 0.0:
        return 0.0
    if share >= 1.0:
        return 1.0
    if share < BEND:
        rest = 1.0 - share / BEND
        share -= share * toe * rest * rest
    else:
        left = 1.0 - share
        rest = 1.0 - left / BEND
        share = 1.0 - (left - left * knee * rest * rest)
    return float(share**gamma) if gamma != 1.0 else share


@compiled
def apply_tone(levels: Floats, gamma: float, toe: float, knee: float) -> None:
    """Replace levels (h, w) by the response to them, on the scale from 0 to 255; clipped there."""
    for i in range(levels.shape[0]):
        for j in range(levels.shape[1]):
            levels[i, j] = MAX_LEVEL * curve(levels[i, j] / MAX_LEVEL, gamma, toe, knee)
