"""A grey scene seen through a colour filter array, and made grey again by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

from sweep.typing import Floats

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
"""Filters of the frame's first two pixels, then those of the two below them."""

METHODS = {"bilinear": "", "edge_aware": "_EA"}
"""Demosaicing by name -> the ending of OpenCV's conversion code."""

REACH_PX = 2
"""Pixels around a pixel that its result depends on: neighbours, and at the frame's border the
neighbours of the pixel that OpenCV copies there."""

MIN_FRAME_PX = 3
"""Smallest side of an image that OpenCV demosaics."""

STEPS_PER_LEVEL = 257.0
"""The raw image has 16 bits: 65535 at level 255."""


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
