"""Exact properties of a rate whose sampling stops when its interval is narrow enough.

After each wave there are k successes of n draws. Sampling stops at the first end of a wave at which
the interval of Clopper and Pearson, at a level above that which is promised, has half the wanted
width at most, and after the last wave. So the lattice of (n, k) falls into points at which sampling
continues and points at which it stops; the probability of each follows from those of the wave
before by adding a binomial number of successes. Jennison and Turnbull, "Group Sequential Methods",
2000, section 12.1, do the same for tests.

A rate of solved poses (flips) has random numbers of draws. Which poses are solved says nothing of
whether the others flip, so that given these numbers it is such a rate at other ends of waves: what
holds for any ends holds for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import signal, stats

from sweep.analysis.estimator import stopped_level
from sweep.analysis.intervals import LEVEL, clopper_pearson
from sweep.typing import Floats, Integers, Masks

NEGLIGIBLE = 1e-18
"""Probability of a point that is left out."""

FEW = 300
"""Terms up to which a sum of products is quicker than a Fourier transform."""


class StoppedAt(NamedTuple):
    """Points of the lattice at which sampling stops after one wave, and their probabilities."""

    wave: int
    successes: Integers
    probability: Floats


class RateProperties(NamedTuple):
    """Properties of the estimate of a rate."""

    coverage: float
    """Probability that the interval holds the rate."""
    bias: float
    """Expectation of successes over draws, minus the rate."""
    draws: float
    """Expected number of draws."""


@dataclass(frozen=True)
class StoppedRate:
    """A rule of stopping: the wanted half-width, and the numbers of draws at the ends of waves.

    Attributes
    ----------
    half_width
        Of the interval.
    ends
        Draws at the ends of waves, increasing.
    level
        That is promised; the interval's is `stopped_level` of it.

    Examples
    --------
    >>> rule = StoppedRate(0.1, (50, 100))
    >>> coverage, bias, draws = rule.at(0.5)
    >>> round(coverage, 3), abs(bias) < 1e-9, round(draws)
    (0.979, True, 100)
    """

    half_width: float
    ends: Sequence[int]
    level: float = LEVEL

    @cached_property
    def intervals(self) -> list[tuple[Floats, Floats]]:
        """Low and high ends (n + 1,) of the interval of each number of successes, by wave."""
        return [clopper_pearson(np.arange(n + 1), n, stopped_level(self.level))
                for n in self.ends]

    @cached_property
    def stops(self) -> list[Masks]:
        """Numbers of successes (n + 1,) at which sampling stops, by wave."""
        rule = [clopper_pearson(np.arange(n + 1), n, stopped_level(LEVEL)) for n in self.ends]
        stops = [(high - low) / 2.0 <= self.half_width for low, high in rule]
        stops[-1] = np.ones_like(stops[-1])
        return stops

    def critical_rates(self) -> Floats:
        """Return the ends of all intervals with which sampling can stop, inside (0, 1).

        Between two of them the coverage is a polynomial of the rate; it jumps at them, so that its
        least value lies beside one.
        """
        edges = np.concatenate([
            end[stop] for interval, stop in zip(self.intervals, self.stops, strict=True)
            for end in interval])
        return np.unique(edges[(edges > 0.0) & (edges < 1.0)])

    def stopped(self, rate: float) -> Iterator[StoppedAt]:
        """Yield the points at which sampling stops, wave by wave, for a true rate."""
        probability, first, before = np.ones(1), 0, 0
        for wave, n in enumerate(self.ends):
            step, before = n - before, n
            reach = 9.0 * np.sqrt(step * rate * (1.0 - rate)) + 20.0
            low = max(0, int(step * rate - reach))
            added = stats.binom.pmf(
                np.arange(low, min(step, int(step * rate + reach)) + 1), step, rate)
            few = min(len(probability), len(added)) < FEW
            probability = (np.convolve(probability, added) if few else
                           np.maximum(signal.fftconvolve(probability, added), 0.0))
            first += low
            successes = first + np.arange(len(probability))
            stop = self.stops[wave][successes]
            yield StoppedAt(wave, successes[stop], probability[stop])
            going = np.nonzero(~stop & (probability > NEGLIGIBLE))[0]
            if not len(going):
                return
            probability = np.where(stop, 0.0, probability)[going[0] : going[-1] + 1]
            first += int(going[0])

    def at(self, rate: float) -> RateProperties:
        """Return the properties at a true rate, from 0 to 1."""
        coverage = mean = draws = 0.0
        for wave, successes, probability in self.stopped(rate):
            low, high = (end[successes] for end in self.intervals[wave])
            n = self.ends[wave]
            coverage += float(probability[(low <= rate) & (rate <= high)].sum())
            mean += float((probability * successes).sum()) / n
            draws += float(probability.sum()) * n
        return RateProperties(coverage, mean - rate, draws)
