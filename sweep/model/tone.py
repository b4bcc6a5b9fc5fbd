"""A camera's response: bloom around bright areas, and a monotonic curve of gamma, toe and knee."""

from __future__ import annotations

import numpy as np

from sweep.compilation import compiled
from sweep.typing import Floats

MAX_LEVEL = 255.0

BEND = 0.5
"""The share of the scale, from its end, over which toe and knee act: they never overlap."""


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
