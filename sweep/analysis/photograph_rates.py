"""Rates of markers in photographs: those of one photograph are not independent.

A photograph is a draw, whatever it shows. The interval is Wilson's of an effective number of
draws: that of which a rate would vary as it does between photographs.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy import special

from sweep.analysis.counts import BlockRateState, Rate, RateState
from sweep.analysis.flip_mixture import FlipMixture
from sweep.analysis.groups import sum_of_settings
from sweep.analysis.states import BlockSample
from sweep.analysis.statistic import OVER_ALL, Statistic, ViewT
from sweep.typing import Floats, Integers

MIN_SPREAD = 5
"""Photographs with the rarer outcome from which the spread between photographs is estimated."""


def by_photograph(statistic: Statistic[ViewT, Any, Any, Any]) -> Statistic[ViewT, Any, Any, Any]:
    """Return a statistic as it is computed of photographs."""
    if isinstance(statistic, Rate):
        return _rate(statistic)
    if isinstance(statistic, FlipMixture):
        mixture = dataclasses.replace(statistic, flips=_rate(statistic.flips))
        return cast("Statistic[ViewT, Any, Any, Any]", mixture)
    return statistic


def _rate(rate: Rate[ViewT]) -> PhotographRate[ViewT]:
    return PhotographRate(**{
        field.name: getattr(rate, field.name) for field in dataclasses.fields(Rate)
    })


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
        hits, counts = (
            sum_of_settings(each).sum(axis=1).astype(np.float64) for each in (hit, used)
        )
        products = [(a * b).sum(axis=1) for a, b in
                    ((hits, hits), (hits, counts), (counts, counts))]
        photographs = [(each > 0).sum(axis=1) for each in (counts, hits, counts - hits)]
        return BlockPhotographRateState(
            BlockSample.of(used), np.asarray(hit.sum(axis=OVER_ALL)), *products, *photographs
        )

    def draws_of(self, state: RateState) -> Integers:
        """Return the number of independent draws that the rate is worth."""
        if not isinstance(state, PhotographRateState):
            raise TypeError(state)
        n, hits = state.sample.n.astype(np.float64), state.hits.astype(np.float64)
        m = state.with_any.astype(np.float64)
        tail = (1.0 - self.level) / 2.0
        with np.errstate(all="ignore"):
            shrink = (special.ndtri(tail) / special.stdtrit(np.maximum(m - 1, 1), tail)) ** 2
            rate = hits / n
            squares = state.hits_hits - 2.0 * rate * state.hits_used + rate**2 * state.used_used
            variance = squares * m / (m - 1.0) / n**2
            worth = np.fmin(shrink * rate * (1.0 - rate) / variance, n)
            few = np.minimum(state.with_hits, state.with_misses) < MIN_SPREAD
            worth = np.where(few, np.fmin(worth, state.sample.draws), worth)
        worth = np.where(n > 0, np.maximum(np.nan_to_num(worth, nan=1.0), 1.0), 0.0)
        return np.asarray(np.floor(worth * (1.0 + 1e-12)), dtype=np.int64)
