"""Rates of markers in photographs: those of one photograph are not independent.

A photograph is a draw, whatever it shows. The interval is Wilson's of an effective number of
draws: that of which a rate would vary as it does between photographs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import special

from sweep.analysis.counts import BlockRateState, Rate, RateState
from sweep.analysis.groups import sum_of_settings
from sweep.analysis.intervals import LEVEL
from sweep.analysis.states import BlockSample
from sweep.analysis.statistic import OVER_ALL, ViewT
from sweep.typing import Floats, Integers

MIN_SPREAD = 5
"""Photographs with the rarer outcome from which the spread between photographs is estimated."""


@dataclass(frozen=True)
class PhotographRateState(RateState):
    """The poses that count, and sums over photographs, (groups,) each.

    ``hits_hits``, ``hits_used`` and ``used_used`` are of products of the numbers of successes and
    of used poses in a photograph; ``with_any``, ``with_hits`` and ``with_misses`` are numbers of
    photographs.
    """

    hits_hits: Floats
    hits_used: Floats
    used_used: Floats
    with_any: Integers
    with_hits: Integers
    with_misses: Integers


@dataclass(frozen=True)
class BlockPhotographRateState(BlockRateState):
    """The same of a block."""

    hits_hits: Floats
    hits_used: Floats
    used_used: Floats
    with_any: Integers
    with_hits: Integers
    with_misses: Integers

    def fold(self) -> PhotographRateState:
        """Return the state of all cells."""
        return PhotographRateState(
            self.sample.fold(), self.hits, self.hits_hits, self.hits_used, self.used_used,
            self.with_any, self.with_hits, self.with_misses,
        )


@dataclass(frozen=True)
class PhotographRate(Rate[ViewT]):
    """A rate whose draws are the number that it is worth: Korn and Graubard's effective number.

    p (1 - p) over the variance of a ratio of sums over m photographs, Σ (h - p n)² m / ((m - 1) N²)
    with h of n markers in a photograph and N in all (Cochran, "Sampling Techniques", 1977,
    section 3.12), times (z / t)² for m - 1 degrees of freedom: Korn and Graubard, Survey
    Methodology 24, 1998. It is at most the number of markers. Where fewer than
    :data:`MIN_SPREAD` photographs have the rarer outcome, it is at most the number of photographs.
    """

    def first_pass(self, poses: ViewT) -> BlockPhotographRateState:
        """Count, by photograph."""
        used = self.used(poses)
        hit = self.successes(poses) & used
        sums = PhotographSums.of(*(sum_of_settings(each).sum(axis=1) for each in (hit, used)))
        return BlockPhotographRateState(
            BlockSample.of(used), np.asarray(hit.sum(axis=OVER_ALL)), sums.hits_hits,
            sums.hits_used, sums.used_used, sums.with_any, sums.with_hits, sums.with_misses,
        )

    def draws_of(self, state: RateState) -> Integers:
        """Return the number of independent draws that the rate is worth."""
        if not isinstance(state, PhotographRateState):
            raise TypeError(state)
        sums = PhotographSums(
            state.sample.n, state.hits, state.hits_hits, state.hits_used, state.used_used,
            state.with_any, state.with_hits, state.with_misses, state.sample.draws,
        )
        return np.asarray(np.floor(sums.worth(self.level) * (1.0 + 1e-12)), dtype=np.int64)


class PhotographSums(NamedTuple):
    """Sums over photographs, each (groups,), as of :class:`PhotographRateState`.

    ``used`` is the number of markers, ``draws`` Kish's effective number of photographs
    (`sweep.analysis.states.Sample.draws`).
    """

    used: Integers
    hits: Integers
    hits_hits: Floats
    hits_used: Floats
    used_used: Floats
    with_any: Integers
    with_hits: Integers
    with_misses: Integers
    draws: Integers

    @staticmethod
    def of(hits: Integers, used: Integers) -> PhotographSums:
        """Return the sums of successes and markers of photographs (groups, photographs)."""
        h, n = hits.astype(np.float64), used.astype(np.float64)
        squares = (n * n).sum(axis=1)
        return PhotographSums(
            used.sum(axis=1), hits.sum(axis=1), (h * h).sum(axis=1), (h * n).sum(axis=1), squares,
            (used > 0).sum(axis=1), (hits > 0).sum(axis=1), (used > hits).sum(axis=1),
            np.floor(n.sum(axis=1) ** 2 / np.maximum(squares, 1.0)).astype(np.int64),
        )

    def worth(self, level: float = LEVEL) -> Floats:
        """Return the number of independent draws that a rate is worth, (groups,)."""
        n, hits, m = (
            each.astype(np.float64) for each in (self.used, self.hits, self.with_any)
        )
        tail = (1.0 - level) / 2.0
        with np.errstate(all="ignore"):
            shrink = (special.ndtri(tail) / special.stdtrit(np.maximum(m - 1, 1), tail)) ** 2
            rate = hits / n
            squares = self.hits_hits - 2.0 * rate * self.hits_used + rate**2 * self.used_used
            variance = squares * m / (m - 1.0) / n**2
            worth = np.fmin(shrink * rate * (1.0 - rate) / variance, n)
            few = np.minimum(self.with_hits, self.with_misses) < MIN_SPREAD
            worth = np.where(few, np.fmin(worth, self.draws), worth)
        return np.where(n > 0, np.maximum(np.nan_to_num(worth, nan=1.0), 1.0), 0.0)
