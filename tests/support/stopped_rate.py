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

from typing import NamedTuple

import numpy as np
from scipy import signal, stats

from sweep.analysis.estimator import stopped_level
from sweep.analysis.intervals import LEVEL, clopper_pearson

NEGLIGIBLE = 1e-18
"""Probability of a point that is left out."""

FEW = 300
"""Terms up to which a sum of products is quicker than a Fourier transform."""


class RateProperties(NamedTuple):
    """The probability that the interval holds the rate, the expectation of successes over draws
    minus the rate, and the expected number of draws."""

    coverage: float
    bias: float
    draws: float


class StoppedRate:
    """A rule of stopping: the wanted half-width, draws at the ends of waves, the promised level.

    ``intervals``: low and high ends (n + 1,) of the interval of each number of successes, by wave;
    ``stops``: masks (n + 1,) of the numbers at which sampling stops, by wave.
    """

    def __init__(self, half_width, ends, level=LEVEL):
        def intervals(level):
            return [clopper_pearson(np.arange(n + 1), n, stopped_level(level)) for n in ends]

        self.half_width, self.ends = half_width, ends
        self.intervals = intervals(level)
        self.stops = [(high - low) / 2.0 <= half_width for low, high in intervals(LEVEL)]
        self.stops[-1] = np.ones_like(self.stops[-1])

    def critical_rates(self):
        """Return the ends of all intervals with which sampling can stop, inside (0, 1).

        Between two of them the coverage is a polynomial of the rate; it jumps at them, so that its
        least value lies beside one.
        """
        edges = np.concatenate([
            end[stop] for interval, stop in zip(self.intervals, self.stops, strict=True)
            for end in interval])
        return np.unique(edges[(edges > 0.0) & (edges < 1.0)])

    def stopped(self, rate):
        """Yield (wave, successes, probabilities) of the points at which sampling stops."""
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
            yield wave, successes[stop], probability[stop]
            going = np.nonzero(~stop & (probability > NEGLIGIBLE))[0]
            if not len(going):
                return
            probability = np.where(stop, 0.0, probability)[going[0] : going[-1] + 1]
            first += int(going[0])

    def at(self, rate):
        """Return the properties at a true rate, from 0 to 1."""
        coverage = mean = draws = 0.0
        for wave, successes, probability in self.stopped(rate):
            low, high = (end[successes] for end in self.intervals[wave])
            n = self.ends[wave]
            coverage += float(probability[(low <= rate) & (rate <= high)].sum())
            mean += float((probability * successes).sum()) / n
            draws += float(probability.sum()) * n
        return RateProperties(coverage, mean - rate, draws)
