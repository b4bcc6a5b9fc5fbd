"""Shifts of an image that vary slowly over the frame.

They are a Gaussian random field with the covariance s² exp(-d² / (2 l²)), made of plane waves
(Rahimi and Recht, "Random features for large-scale kernel machines", 2007): a smooth function of
the pixel, whatever part of the frame is computed.
"""

from __future__ import annotations

import math
from hashlib import sha256

import numpy as np

from sweep.model.sensor import standard_normals
from sweep.typing import Floats

WAVES = 32
"""Waves of each coordinate's shift. Given their directions, the field is exactly Gaussian; their
directions are drawn, so that the covariance of one frame deviates from the formula by 1/8 of its
height."""

_STREAM = np.uint64(int.from_bytes(sha256(b"geometry_px").digest()[:8], "little"))


def shift_waves(std_px: float, length_px: float, key: np.uint64) -> Floats:
    """Return the waves (2, M, 4) of a field of shifts (:class:`sweep.model.sheet.Sheet`).

    Parameters
    ----------
    std_px, length_px
        Standard deviation of each coordinate's shift, and its correlation length.
    key
        Of the frame's random numbers.
    """
    normals = np.empty((8, WAVES))
    standard_normals(np.uint64(key ^ _STREAM), 0, 0, 0, normals)
    waves = np.stack([normals[:4].T, normals[4:].T])
    waves[:, :, :2] /= length_px
    waves[:, :, 2:] *= std_px / math.sqrt(WAVES)
    return waves
