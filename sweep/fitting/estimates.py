"""Means over photographs, each of which is one draw, and their intervals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import special

from sweep.analysis.intervals import TAIL
from sweep.typing import Floats

MIN_PHOTOGRAPHS = 4
"""Photographs from which intervals are given: with three, Student's are 2.5 standard deviations of
a photograph wide on each side, and their spread is known to a factor of 6."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A parameter of the camera.

    Attributes
    ----------
    value, low, high
        The mean over the photographs, and the ends of its 95 % interval; NaN with too few.
    """

    value: float
    low: float = math.nan
    high: float = math.nan

    @property
    def judged(self) -> bool:
        """Whether there is an interval."""
        return math.isfinite(self.low)

    def excludes(self, absent: float) -> bool:
        """Return whether the interval excludes a value."""
        return self.high < absent or self.low > absent

    def mapped(self, function: Callable[[float], float]) -> Estimate:
        """Return the estimate of an increasing function of the parameter."""
        return Estimate(function(self.value), function(self.low), function(self.high))


def estimate(values: Floats) -> Estimate:
    """Return the mean of a parameter's values (n,) in n photographs; the interval is Student's."""
    known = values[np.isfinite(values)]
    count = len(known)
    if not count:
        return Estimate(math.nan)
    mean = float(known.mean())
    if count < MIN_PHOTOGRAPHS:
        return Estimate(mean)
    half = float(special.stdtrit(count - 1, 1 - TAIL) * known.std(ddof=1) / math.sqrt(count))
    return Estimate(mean, mean - half, mean + half)
