"""Names for types of arrays that stand in many places."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Numbers: coordinates, lengths, angles, errors.
Floats = NDArray[np.float64]

#: Pixels of boxes and windows, IDs, counts.
Integers = NDArray[np.int64]

#: Which elements are meant.
Masks = NDArray[np.bool_]

#: (h, w) grey levels of an image.
Grey = NDArray[np.uint8]
