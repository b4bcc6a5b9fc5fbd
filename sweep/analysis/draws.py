"""Draws that are not independent trials: photographs, Sobol' replicates, and stopped sampling."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import special

from sweep.analysis.counts import Rate, RateState
from sweep.analysis.dataset import (
    DRAWS,
    axes_of,
    configuration_axes,
    fingerprint_of,
    is_sampling_stopped,
)
from sweep.analysis.intervals import LEVEL
from sweep.analysis.means import FlipMixture, PositiveMean, RootMeanSquare
from sweep.analysis.poses import NOT_LOOKED_FOR
from sweep.analysis.quantiles import PERCENTS, IntervalOf, Quantiles
from sweep.analysis.statistic import (
    OVER_ALL,
    Sample,
    State,
    Statistic,
    Variables,
    ViewT,
    interval_variables,
    sum_of_settings,
)
from sweep.errors import DatasetError
from sweep.measure.flags import DetectionStatus
from sweep.plan.draws import REPLICATES
from sweep.plan.parameters import Stage
from sweep.plan.schema import VARIABLES
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Rates of markers in photographs: those of one photograph are not independent.
#
# A photograph is a draw, whatever it shows. The interval is Wilson's of an effective number of
# draws: that of which a rate would vary as it does between photographs.

MIN_SPREAD = 5
"""Photographs with the rarer outcome from which the spread between photographs is estimated."""


@dataclass(frozen=True)
class PhotographSums(State):
    """Sums over photographs, each (groups,), by which rates vary between them.

    ``used`` is the number of markers. ``hits_hits``, ``hits_used`` and ``used_used`` are of
    products of the numbers of successes and of used poses in a photograph; ``with_any``,
    ``with_hits`` and ``with_misses`` are numbers of photographs.
    """

    used: Integers
    hits: Integers
    hits_hits: Floats
    hits_used: Floats
    used_used: Floats
    with_any: Integers
    with_hits: Integers
    with_misses: Integers

    @staticmethod
    def of(hits: Integers, used: Integers) -> PhotographSums:
        """Return the sums of successes and markers of photographs (groups, photographs)."""
        h, n = hits.astype(np.float64), used.astype(np.float64)
        return PhotographSums(
            used.sum(axis=1), hits.sum(axis=1), (h * h).sum(axis=1), (h * n).sum(axis=1),
            (n * n).sum(axis=1), (used > 0).sum(axis=1), (hits > 0).sum(axis=1),
            (used > hits).sum(axis=1),
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
            # Kish's effective number of photographs, as of `sweep.analysis.statistic.Sample.draws`.
            draws = np.floor(n**2 / np.maximum(self.used_used, 1.0))
            worth = np.where(few, np.fmin(worth, draws), worth)
        return np.where(n > 0, np.maximum(np.nan_to_num(worth, nan=1.0), 1.0), 0.0)


@dataclass(frozen=True)
class PhotographRateState(RateState):
    """The poses that count, how many are successes, and the sums over photographs."""

    sums: PhotographSums


@dataclass(frozen=True)
class PhotographRate(Rate[ViewT]):
    """A rate whose draws are the number that it is worth: Korn and Graubard's effective number.

    p (1 - p) over the variance of a ratio of sums over m photographs, Σ (h - p n)² m / ((m - 1) N²)
    with h of n markers in a photograph and N in all (Cochran, "Sampling Techniques", 1977,
    section 3.12), times (z / t)² for m - 1 degrees of freedom: Korn and Graubard, Survey
    Methodology 24, 1998. It is at most the number of markers. Where fewer than
    :data:`MIN_SPREAD` photographs have the rarer outcome, it is at most the number of photographs.
    """

    def first_pass(self, poses: ViewT) -> PhotographRateState:
        """Count, by photograph."""
        used = self.used(poses)
        hit = self.successes(poses) & used
        sums = PhotographSums.of(*(sum_of_settings(each).sum(axis=1) for each in (hit, used)))
        return PhotographRateState(Sample.of(used), np.asarray(hit.sum(axis=OVER_ALL)), sums)

    def draws_of(self, state: RateState) -> Integers:
        """Return the number of independent draws that the rate is worth."""
        if not isinstance(state, PhotographRateState):
            raise TypeError(state)
        worth = state.sums.worth(self.level)
        return np.asarray(np.floor(worth * (1.0 + 1e-12)), dtype=np.int64)


# --------------------------------------------------------------------------------------------------
# Quantiles of markers in photographs: those of one photograph are not independent.
#
# The interval is Woodruff's: the quantiles at the ends of the interval of the share below the
# quantile (Journal of the American Statistical Association 47, 1952). That is Clopper and
# Pearson's of the number of draws that the share is worth (Korn and Graubard, Survey Methodology
# 24, 1998).

ROUNDING = 1e-9
"""Share of a pose by which a rank may be above a whole number."""


def quantile_of(ascending: Floats, share: float) -> float:
    """Return the smallest of some values with at least that share at or below; NaN of none.

    >>> quantile_of(np.array([1.0, 2.0, 3.0, 4.0]), 0.5)
    2.0
    """
    if not len(ascending):
        return float("nan")
    return float(ascending[max(int(np.ceil(share * len(ascending) - ROUNDING)), 1) - 1])


def quantile_ends(
    values: Floats, photograph: Integers, share: float, level: float = LEVEL
) -> tuple[float, float]:
    """Return the ends of the interval of a quantile; NaN for one beyond all values.

    Parameters
    ----------
    values, photograph
        (n,) each: the values, and the index of the photograph of each.
    share
        Of the values, at or below the quantile.
    level
        Probability with which the interval is to hold it.
    """
    if not len(values):
        return float("nan"), float("nan")
    ascending = np.sort(values)
    below = values <= quantile_of(ascending, share)
    count = int(photograph.max()) + 1
    hits, used = (
        np.bincount(photograph[which], minlength=count)[None]
        for which in (below, slice(None))
    )
    draws = float(PhotographSums.of(hits, used).worth(level)[0])
    tail = (1.0 - level) / 2.0
    low = special.betaincinv(share * draws, (1.0 - share) * draws + 1.0, tail)
    high = special.betaincinv(share * draws + 1.0, (1.0 - share) * draws, 1.0 - tail)
    first = int(np.ceil(low * len(values) - ROUNDING))
    last = int(np.floor(high * len(values) + ROUNDING)) + 1
    return (
        float("nan") if first < 1 else float(ascending[first - 1]),
        float("nan") if last > len(values) else float(ascending[last - 1]),
    )


@dataclass(frozen=True)
class PhotographValues(State):
    """The values of each group, and the photograph of each value, numbered up to ``count``."""

    values: tuple[Floats, ...]
    photograph: tuple[Integers, ...]
    count: int

    def merge(self, other: Self) -> Self:
        """Return those of the photographs of both."""
        pairs = zip(self.values, other.values, strict=True)
        numbers = zip(self.photograph, other.photograph, strict=True)
        return type(self)(
            tuple(np.concatenate(each) for each in pairs),
            tuple(np.concatenate([a, b + self.count]) for a, b in numbers),
            self.count + other.count,
        )

    @classmethod
    def interleave(cls, states: Sequence[Self]) -> Self:
        """Return the states as one; those of a group stand together."""
        columns = [
            tuple(each for group in zip(*parts, strict=True) for each in group)
            for parts in ([s.values for s in states], [s.photograph for s in states])
        ]
        return cls(columns[0], columns[1], max(state.count for state in states))

    def every_nth(self, n: int, first: int) -> Self:
        """Return those of the groups ``first``, ``first + n`` and so on."""
        return type(self)(self.values[first::n], self.photograph[first::n], self.count)


@dataclass(frozen=True)
class PhotographQuantiles(Quantiles[ViewT]):
    """Quantiles whose draws are as many as the share below each is worth.

    All errors are in memory: photographs are few.
    """

    def first_pass(self, poses: ViewT) -> Any:
        """Return the errors of a block."""
        used = self.used(poses)
        _, errors = self._grouped_errors(poses, used)
        groups, _, photograph, _ = np.nonzero(used)
        ends = np.cumsum(np.bincount(groups, minlength=len(used)))[:-1]
        return PhotographValues(
            tuple(np.split(errors, ends)), tuple(np.split(photograph, ends)), used.shape[2]
        )

    def result(self, state: Any) -> Variables:
        """Return the quantiles, their intervals, and why these may have no ends."""
        groups = list(zip(state.values, state.photograph, strict=True))
        drawn = np.array([len(np.unique(numbers)) > 1 for _, numbers in groups], dtype=bool)
        some = np.array([len(values) > 0 for values, _ in groups], dtype=bool)
        variables: Variables = {}
        for statistic, percent in PERCENTS.items():
            share = percent / 100.0
            value = np.array([quantile_of(np.sort(values), share) for values, _ in groups])
            ends = np.array([
                quantile_ends(*group, share, self.level) if several else (np.nan, np.nan)
                for group, several in zip(groups, drawn.tolist(), strict=True)
            ]).reshape(-1, 2)
            variables |= interval_variables(self.name.format(statistic), [value, *ends.T])
            if self.with_reason:
                variables[f"{statistic}_interval"] = np.select(
                    [~some, ~drawn, np.isnan(ends).any(axis=1)],
                    [IntervalOf.not_run, IntervalOf.nothing_drawn, IntervalOf.too_few_draws],
                    IntervalOf.given,
                ).astype(np.uint8)
        return variables


# --------------------------------------------------------------------------------------------------
# Statistics as they are computed of photographs: the markers of one are not independent.

def by_photograph(statistic: Statistic[ViewT, Any, Any, Any]) -> Statistic[ViewT, Any, Any, Any]:
    """Return a statistic as it is computed of photographs."""
    changed: Any = statistic
    if isinstance(statistic, Rate):
        changed = PhotographRate(**_fields(statistic))
    elif isinstance(statistic, Quantiles):
        changed = PhotographQuantiles(**_fields(statistic))
    elif isinstance(statistic, FlipMixture):
        flips = PhotographRate(**_fields(statistic.flips))
        changed = dataclasses.replace(statistic, flips=flips)
    return cast("Statistic[ViewT, Any, Any, Any]", changed)


def _fields(statistic: Any) -> dict[str, Any]:
    return {field.name: getattr(statistic, field.name) for field in dataclasses.fields(statistic)}


# --------------------------------------------------------------------------------------------------
# Draws that are Sobol' points: their replicates are what is independent.
#
# The draws of a replicate (`sweep.plan.draws`) fill their space evenly, so that they are not
# independent; the replicates are, each with a scramble of its own. So a replicate counts as one
# draw, as all settings of a trial do: intervals follow from the spread between the replicates of
# a cell, with Student's t of as many degrees of freedom. Rates have Wilson's interval of an
# effective number of draws. Quantiles have order statistics of as many draws as there are
# replicates, which is wide; those of high quantiles may have no ends, with the reason.
#
# Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995; L'Ecuyer and Lemieux, "Recent
# advances in randomized quasi-Monte Carlo methods", 2002, section 2 (replicates).

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
        mixture = dataclasses.replace(
            statistic, flips=_rate(statistic.flips, settings), points_per_draw=settings)
        return cast("Statistic[ViewT, Any, Any, Any]", mixture)
    if isinstance(statistic, PositiveMean):
        return dataclasses.replace(statistic, points_per_draw=settings)
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
class ReplicateRate(Rate[ViewT]):
    """A rate whose draws are the number that it is worth: Korn and Graubard's effective number.

    p (1 - p) over the variance of the rate between replicates, times (z / t)² for the degrees of
    freedom of that variance: Korn and Graubard, "Confidence intervals for proportions with small
    expected number of positive counts estimated from survey data", Survey Methodology 24, 1998.
    If successes or failures are too few to tell how they spread, it is no more than the number of
    draws.
    """

    settings: int = 1

    def first_pass(self, poses: ViewT) -> ReplicateRateState:
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
        return ReplicateRateState(
            Sample.of(used), np.asarray(hit.sum(axis=OVER_ALL)), *sums)

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


# --------------------------------------------------------------------------------------------------
# Stores whose sampling stopped when their intervals were narrow enough, or a decision was sure.
#
# *Intervals.* Who looks at an interval again and again and stops when it is narrow finds it
# narrow by chance, too: it then covers less than its level. So all intervals of such a store have
# smaller tails, by `TAIL_SHARE` (root mean squares and standard deviations, whose intervals are
# approximations: `SPREAD_TAIL_SHARE`), and those of rates are Clopper and Pearson's. By exact
# enumeration (`tests/support/stopped_rate.py`) those of rates then cover 95 % at least, whatever
# the rate; the others by simulation (`tests/sampling/test_stopped_coverage.py`).
#
# *Pooling.* Conditions that are hard to judge have more trials. A rate over conditions that
# counts all of them would be one of mostly hard ones. So what is pooled is pooled over the trials
# that all pooled cells have: each counts as it does in a store of equally many trials. Cells in
# which no pose was looked for have nothing to count, and do not lessen these trials.

TAIL_SHARE = 0.6
"""Tails of intervals of stores whose sampling was stopped, of those that they would have.

The interval of 95 % is one of 97 %. The least coverage of a rate, over all rates, half-widths from
0.005 to 0.25, waves of 5 to 99 draws at first and any largest number of trials, is then 0.954.
"""

SPREAD_TAIL_SHARE = 0.4
"""The same of root mean squares and standard deviations: the interval of 95 % is one of 98 %."""

NOT_AVAILABLE = (DetectionStatus.not_run, DetectionStatus.not_needed)
"""Flags of the trials that a cell does not have."""


def stopped_level(level: float, share: float = TAIL_SHARE) -> float:
    """Return the level of the interval that has another level where sampling was not stopped.

    >>> round(stopped_level(0.95), 3)
    0.97
    """
    return 1.0 - (1.0 - level) * share


def as_stopped(statistic: Statistic[ViewT, Any, Any, Any]) -> Statistic[ViewT, Any, Any, Any]:
    """Return a statistic with the intervals that it has where sampling was stopped."""
    if not hasattr(statistic, "level"):
        return statistic
    share = SPREAD_TAIL_SHARE if isinstance(statistic, RootMeanSquare | FlipMixture) else TAIL_SHARE
    level = stopped_level(cast("Any", statistic).level, share)
    exact = {"exact": True} if isinstance(statistic, Rate) else {}
    changed = dataclasses.replace(cast("Any", statistic), level=level, **exact)
    return cast("Statistic[ViewT, Any, Any, Any]", changed)


def common_trials(
    results: xr.Dataset, inputs: Mapping[str, xr.DataArray], kept: Sequence[str]
) -> xr.DataArray | None:
    """Return which trials all pooled cells have, computed; None if no cells are pooled.

    Parameters
    ----------
    results
        The dataset that names the axes.
    inputs
        Arrays by name; those whose name ends with ``detection`` hold flags of detection, and a
        trial must be in each.
    kept
        The dimensions that are not pooled.
    """
    scene = [name for name in axes_of(results, Stage.scene) if name != DRAWS]
    pooled = [name for name in scene if name not in kept]
    flags = [array for name, array in inputs.items() if name.split()[-1] == "detection"]
    if not pooled or not flags or DRAWS not in flags[0].dims:
        return None
    common = None
    for array in flags:
        # All configurations of a scene that is needed are computed.
        one = array.isel({dim: 0 for dim in array.dims if dim not in (*scene, DRAWS)}, drop=True)
        one = one.fillna(0) if one.dtype.kind == "f" else one
        counted = (~one.isin(NOT_LOOKED_FOR)).any(DRAWS)
        available = (~one.isin(NOT_AVAILABLE) | ~counted).all(
            [name for name in pooled if name in one.dims])
        common = available if common is None else common & available
    return None if common is None else common.reset_coords(drop=True).compute()


def with_common_trials(results: xr.Dataset, kept: Sequence[str]) -> xr.Dataset:
    """Return a dataset in which only trials that all pooled cells have are run.

    The same dataset unless sampling was stopped in it.
    """
    if not is_sampling_stopped(results):
        return results
    common = common_trials(results, {"detection": results["detection"]}, kept)
    if common is None:
        return results
    flags = {name: results[name] for name in ("detection", "estimate", "flipped")
             if name in results}
    return results.assign({
        name: array.where(common, VARIABLES[name].not_needed).astype(np.uint8).assign_attrs(
            array.attrs)
        for name, array in flags.items()})


def computed_scenes(results: xr.Dataset) -> xr.DataArray:
    """Return which scenes are computed (bool, over the axes of the scene).

    All configurations of a scene are computed, or none.
    """
    flags = results["detection"]
    first = {name: 0 for name in configuration_axes(results) if name in flags.dims}
    return ~flags.isel(first, drop=True).isin(NOT_AVAILABLE)
