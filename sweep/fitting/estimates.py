"""Means over photographs, each of which is one draw: intervals, and spread between photographs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import special

from sweep.analysis.intervals import LEVEL, TAIL
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
    spread
        Standard deviation from photograph to photograph, without that of the estimates; 0 if these
        explain the differences.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    spread: float = 0.0

    @property
    def judged(self) -> bool:
        """Whether there is an interval."""
        return math.isfinite(self.low)

    def excludes(self, absent: float) -> bool:
        """Return whether the interval excludes a value."""
        return self.high < absent or self.low > absent

    def mapped(self, function: Callable[[float], float]) -> Estimate:
        """Return the estimate of an increasing function of the parameter."""
        value = function(self.value)
        spread = 0.0
        if self.spread > 0:
            spread = (
                function(self.value + self.spread) - function(self.value - self.spread)
            ) / 2
        return Estimate(value, function(self.low), function(self.high), spread)


def estimate(values: Floats, variances: Floats | None = None) -> Estimate:
    """Return the mean of a parameter's values (n,) in n photographs.

    The interval is Student's. ``variances`` (n,) of the values make known how much of their
    spread is the estimates' own; without them there is said to be none.
    """
    known = np.isfinite(values)
    values, count = values[known], int(known.sum())
    if not count:
        return Estimate(math.nan)
    mean = float(values.mean())
    if count < MIN_PHOTOGRAPHS:
        return Estimate(mean)
    total = float(values.var(ddof=1))
    half = float(special.stdtrit(count - 1, 1 - TAIL)) * math.sqrt(total / count)
    spread = 0.0
    if variances is not None:
        own = float(np.nanmean(variances[known]))
        # Differences that the estimates' errors alone bring about with less than 5 %.
        limit = own * float(special.chdtri(count - 1, 1 - LEVEL)) / (count - 1)
        if np.isfinite(own) and total > limit:
            spread = math.sqrt(total - own)
    return Estimate(mean, mean - half, mean + half, spread)


def jackknife(full: float, without: Floats) -> Floats:
    """Return the pseudo-values (n,) of an estimate and those without each of n photographs.

    Tukey, "Bias and confidence in not quite large samples", Annals of Mathematical Statistics 29,
    1958: their mean and its Student interval are those of the estimate.
    """
    count = len(without)
    return np.asarray(count * full - (count - 1) * without)
