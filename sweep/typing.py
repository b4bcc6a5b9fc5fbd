"""Names for types of arrays that stand in many places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Numbers: coordinates, lengths, angles, errors."""

Integers = NDArray[np.int64]
"""Pixels of boxes and windows, IDs, counts."""

Masks = NDArray[np.bool_]
"""Which elements are meant."""

Grey = NDArray[np.uint8]
"""(h, w) grey levels of an image."""
