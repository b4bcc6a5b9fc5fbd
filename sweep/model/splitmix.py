"""SplitMix64's mixing of bits, from which all random numbers are made."""

from __future__ import annotations

from typing import Any

import numpy as np

from sweep.compilation import compiled


@compiled
def mixed(bits: Any) -> Any:
    """Return 64-bit numbers, a scalar or an array, mixed so that each bit depends on all.

    SplitMix64's finaliser (Steele, Lea and Flood, "Fast splittable pseudorandom number
    generators", 2014).
    """
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))
