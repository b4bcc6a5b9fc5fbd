"""Draws that are Sobol' points: their replicates are what is independent.

The draws of a replicate (`sweep.plan.sobol`) fill their space evenly, so that they are not
independent; the replicates are, each with a scramble of its own. So a replicate counts as one
draw, as all settings of a trial do: intervals follow from the spread between the replicates of a
cell, with Student's t of as many degrees of freedom. Rates have Wilson's interval of an effective
number of draws. Quantiles have order statistics of as many draws as there are replicates, which is
wide; those of high quantiles may have no ends, with the reason.

Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995; L'Ecuyer and Lemieux, "Recent
advances in randomized quasi-Monte Carlo methods", 2002, section 2 (replicates).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from sweep.analysis.counts import BlockRateState, Rate, RateState
from sweep.analysis.dimensions import DRAWS, fingerprint_of
from sweep.analysis.flip_mixture import FlipMixture
from sweep.analysis.states import BlockSample
from sweep.analysis.statistic import OVER_ALL, Statistic, ViewT
from sweep.errors import DatasetError
from sweep.plan.sobol import REPLICATES
from sweep.typing import Floats, Integers

MAX_DRAWS = 10**9
"""The most draws that a rate is said to be worth."""


def is_replicated(results: xr.Dataset) -> bool:
    """Return whether the draws of a dataset are Sobol' points."""
    return fingerprint_of(results).get("sampling") == "sobol"


def replicate_order(results: xr.Dataset, draws: Sequence[str]) -> NDArray[np.intp] | None:
    """Return the indices of the trials, those of each replicate together; None if not replicated.

    ``draws`` are the pooled dimensions of draws.

    Raises
    ------
    DatasetError
        If the dataset does not have equally many trials of each replicate.
    """
    if not is_replicated(results) or DRAWS not in draws:
        return None
    trials = results[DRAWS].to_numpy().astype(np.int64)
    replicate = trials % REPLICATES
    counts = np.bincount(replicate, minlength=REPLICATES)
    if len(set(counts.tolist())) > 1:
        raise DatasetError(
            f"{DRAWS}: not equally many of each of the {REPLICATES} replicates of Sobol' points "
            f"(sampling = sobol); keep a multiple of {REPLICATES} in a row, from a multiple of "
            f"{REPLICATES} on"
        )
    return np.argsort(replicate, kind="stable")


def replicated(
    statistic: Statistic[ViewT, Any, Any, Any], settings: int
) -> Statistic[ViewT, Any, Any, Any]:
    """Return a statistic as it is computed of replicates; ``settings`` see the same draws each."""
    if isinstance(statistic, Rate):
        return _rate(statistic, settings)
    if isinstance(statistic, FlipMixture):
        mixture = dataclasses.replace(statistic, flips=_rate(statistic.flips, settings))
        return cast("Statistic[ViewT, Any, Any, Any]", mixture)
    return statistic


def _rate(rate: Rate[ViewT], settings: int) -> ReplicateRate[ViewT]:
    fields = {field.name: getattr(rate, field.name) for field in dataclasses.fields(Rate)}
    return ReplicateRate(**fields, settings=settings)


@dataclass(frozen=True)
class ReplicateRateState(RateState):
    """The poses that count, how many are successes, and the spread between replicates.

    ``hits_hits``, ``hits_used`` and ``used_used`` are the variances and the covariance of the sums
    over all replicates of successes and of used poses, summed over the cells, (groups,).
    """

    hits_hits: Floats
    hits_used: Floats
    used_used: Floats


@dataclass(frozen=True)
class BlockReplicateRateState(BlockRateState):
    """The same of a block."""

    hits_hits: Floats
    hits_used: Floats
    used_used: Floats

    def fold(self) -> ReplicateRateState:
        """Return the state of all cells."""
        return ReplicateRateState(
            self.sample.fold(), self.hits, self.hits_hits, self.hits_used, self.used_used)


@dataclass(frozen=True)
class ReplicateRate(Rate[ViewT]):
    """A rate whose draws are the number that it is worth: Korn and Graubard's effective number.

    p (1 - p) over the variance of the rate between replicates, times (z / t)² for the degrees of
    freedom of that variance: Korn and Graubard, "Confidence intervals for proportions with small
    expected number of positive counts estimated from survey data", Survey Methodology 24, 1998.
    If successes or failures are too few to tell how they spread, it is no more than the number of
    draws.
    """

    settings: int = 1

    def first_pass(self, poses: ViewT) -> BlockReplicateRateState:
        """Count, by replicate."""
        used = self.used(poses)
        hit = self.successes(poses) & used
        hits, counts = (
            each.sum(axis=3, dtype=np.float64) for each in (hit, used))
        hits -= hits.mean(axis=2, keepdims=True)
        counts -= counts.mean(axis=2, keepdims=True)
        factor = REPLICATES / (REPLICATES - 1)
        sums = [factor * (a * b).sum(axis=(1, 2))
                for a, b in ((hits, hits), (hits, counts), (counts, counts))]
        return BlockReplicateRateState(
            BlockSample.of(used), np.asarray(hit.sum(axis=OVER_ALL)), *sums)

    def draws_of(self, state: RateState) -> Integers:
        """Return the number of independent draws that the rate is worth."""
        if not isinstance(state, ReplicateRateState):
            raise TypeError(state)
        n, hits = state.sample.n.astype(np.float64), state.hits.astype(np.float64)
        tail = (1.0 - self.level) / 2.0
        shrink = (special.ndtri(tail) / special.stdtrit(REPLICATES - 1, tail)) ** 2
        with np.errstate(all="ignore"):
            rate = hits / n
            variance = (
                state.hits_hits - 2.0 * rate * state.hits_used + rate**2 * state.used_used
            ) / n**2
            binomial = rate * (1.0 - rate)
            draws = n / self.settings
            # The spread between replicates of p points is no finer than a point.
            finest = binomial / (draws * np.maximum(draws / REPLICATES, 1.0))
            worth = shrink * binomial / np.maximum(variance, finest)
            few = np.minimum(hits, n - hits) < 2 * REPLICATES * self.settings
            worth = np.where(few, np.fmin(worth, draws), worth)
        worth = np.where(n > 0, np.clip(np.nan_to_num(worth, nan=1.0), 1.0, MAX_DRAWS), 0.0)
        return np.asarray(np.floor(worth * (1.0 + 1e-12)), dtype=np.int64)
