"""Means and root mean squares of errors, also where flips are mixed in."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar, cast

import numpy as np
from scipy import special

from sweep.analysis.counts import Rate, scaled_to_draws
from sweep.analysis.draws import SPREAD_TAIL_SHARE, TAIL_SHARE, Design, Sample, Unit
from sweep.analysis.intervals import LEVEL, clopper_pearson
from sweep.analysis.poses import Poses, component_sum
from sweep.analysis.statistic import (
    OVER_ALL,
    Blocks,
    Moments,
    Output,
    Statistic,
    Variables,
    ViewT,
    interval_variables,
    settings_of,
    sum_of_settings,
    with_interval,
)
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Means of draws in cells of a fixed grid: their standard errors, and the intervals from these.

UNSEEN_FACTOR = 2.0
"""Errors that no draw showed are taken to be at most so many times as large as the largest seen.

On draws whose worst 1 % carries half of the squares, on Student's t with 4 degrees of freedom and
on lognormal errors with a logarithm's deviation of 0.8, a root mean square at its limit is then
met in less than 5 % of the samples of 50, 100 and 400; without, in up to 49 %
(`pytest -m long tests/analysis/test_requirements_at_the_limit.py`).
"""


class MeanEstimate(NamedTuple):
    """Means, their standard errors, and the degrees of freedom of these, each (groups,)."""

    mean: Floats
    error: Floats
    freedom: Floats


def estimate_mean(
    mean: Floats, n: Integers, freedom: Integers, within: Moments
) -> MeanEstimate:
    """Return the means of ``n`` values in cells, with their standard errors.

    ``within`` are the moments (groups, cells) of what the draws of a cell add to the sum of
    ``used * (value - mean)``.

    A mean is a ratio of two sums over a stratified sample, the cells being the strata and the
    draws the sample: of the values, and of what counts. So its variance is that of the sum of
    ``used * (value - mean)`` over n², each cell's from its own draws: Cochran, "Sampling
    Techniques", 3rd ed. 1977, sections 6.11 and 5A.14. If all draws count it is the sum of
    n_c s_c² over n²; if some do not, it includes that which ones do is random. A cell with a
    single draw has no variance of its own and gets the pooled one.

    The degrees of freedom are Welch's (Biometrika 34, 1947, the form with f + 2): a few cells
    with the largest errors can make most of the variance. They are at most ``freedom``, the
    draws with a used value beyond the first of each cell; 0 of these: standard error NaN.
    """
    repeated = within.count > 1
    rest = np.where(repeated, within.count - 1.0, 0.0)
    m2 = np.where(repeated, within.m2, 0.0)
    with np.errstate(all="ignore"):
        terms = (rest + 1.0) * m2 / np.maximum(rest, 1.0)  # n_c s_c²
        variance = terms.sum(axis=1)
        welch = variance**2 / (terms**2 / (rest + 2.0)).sum(axis=1) - 2.0
        single = (within.count == 1).sum(axis=1)
        pooled = single * m2.sum(axis=1) / rest.sum(axis=1)
        variance = variance + np.where(single > 0, pooled, 0.0)
        degrees = np.where(freedom > 0, np.fmin(freedom, welch), np.nan)
        error = np.where(freedom > 0, np.sqrt(variance) / n, np.nan)
    return MeanEstimate(np.where(n > 0, mean, np.nan), error, degrees)


def half_width(estimate: MeanEstimate, level: float = LEVEL) -> Floats:
    """Return half the width of Student's interval."""
    upper = 1.0 - (1.0 - level) / 2.0
    return np.asarray(estimate.error * special.stdtrit(estimate.freedom, upper))


def symmetric(estimate: MeanEstimate, level: float = LEVEL) -> tuple[Floats, Floats, Floats]:
    """Return Student's interval of means: value, low, high."""
    half = half_width(estimate, level)
    return estimate.mean, estimate.mean - half, estimate.mean + half


def exponential(estimate: MeanEstimate, level: float = LEVEL) -> tuple[Floats, Floats, Floats]:
    """Return the interval of positive means: Student's of the logarithm, by the delta method."""
    mean, error, freedom = estimate
    with np.errstate(all="ignore"):
        factor = np.exp(error / mean * special.stdtrit(freedom, 1.0 - (1.0 - level) / 2.0))
        positive = mean / factor, mean * factor
    plain = symmetric(estimate, level)
    low, high = (np.where(mean == 0.0, a, b) for a, b in zip(plain[1:], positive, strict=True))
    return mean, low, high


def with_unseen_tail(
    high: Floats, largest: Floats, draws: Integers | Floats, level: float = LEVEL
) -> Floats:
    """Return upper ends of mean squares that hold rare large errors which no draw showed.

    A sample without outliers says nothing of their size, but it bounds their share: with
    probability 1 - a, a = (1 - level) / 2, less than p = 1 - a^(1/n) of the population is of a
    kind that none of n draws is of (Clopper and Pearson's end without a success; over cells the
    geometric mean of the shares seen is at most the arithmetic one, so that it holds there, too).
    Errors of that share are taken to be at most `UNSEEN_FACTOR` times as large as the largest that
    was seen. That is an assumption: no sample can tell. It lets the end be a p-th part of the
    square of that and a (1 - p)-th part of the end for what was seen.

    The end of 100 normal errors of one component is then 1.7 times their root mean square, and 1.3
    times of 400.

    Parameters
    ----------
    high
        Upper ends (groups,) of the mean squares of what was seen.
    largest
        Largest squares (groups,) that were seen.
    draws
        Independent draws (groups,).
    level
        Of the interval.
    """
    with np.errstate(all="ignore"):
        share = -np.expm1(np.log((1.0 - level) / 2.0) / draws)
        end = (1.0 - share) * high + share * UNSEEN_FACTOR**2 * largest
        return np.where(np.isfinite(largest), np.fmax(high, end), high)


def length_interval(
    estimate: MeanEstimate, components: int, level: float = LEVEL
) -> tuple[Floats, Floats, Floats]:
    """Return the interval of the length of a mean vector, at least 0.

    Along its own direction the mean vector is a plain mean, and the upper end is Student's. The
    mean's length grows by chance, so the lower end is Scheffé's: the length minus
    sqrt(k d / (d - k + 1) · F(k, d - k + 1)) standard errors, k components, d degrees of freedom.
    By the Cauchy-Schwarz inequality this holds a bias of 0 whenever Hotelling's T² does, in 95 %
    at least. With 50 normal errors of 3 components it covers 0.97 (a large bias) to 0.995 (a bias
    of its error).
    """
    length, low, high = symmetric(estimate, level)
    rest = estimate.freedom - (components - 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        reach = np.sqrt(
            components * estimate.freedom / rest * special.fdtri(components, rest, level))
        low = np.where(rest > 0.0, np.fmax(0.0, length - reach * estimate.error), 0.0)
    return length, np.where(np.isnan(estimate.error), np.nan, low), high


# --------------------------------------------------------------------------------------------------
# Means of poses' values with their intervals: bias, standard deviation, root mean square.

class DrawnPoses(Protocol):
    """A view of poses that knows which draws were run."""

    @property
    def draws(self) -> Masks:
        """Which draws were run: (groups, cells, draws)."""
        ...


DrawnT = TypeVar("DrawnT", bound=DrawnPoses)


class Summary(NamedTuple):
    """What an interval of a mean is made of.

    Attributes
    ----------
    estimate
        The mean of the scores.
    moments
        Of the values (groups, components).
    largest
        The largest score (groups,) of a pose; -inf of none.
    draws
        Independent draws (groups,) of the scores.
    """

    estimate: MeanEstimate
    moments: Moments
    largest: Floats
    draws: Integers | Floats


@dataclass(frozen=True)
class Mean(Statistic[DrawnT]):
    """A mean of values, (groups, cells, draws, settings, components), with Student's interval.

    Values that are NaN do not count. What varies is the mean of scores, one number a pose: for
    the mean itself they are the values, its subclasses linearise with them.
    """

    name: str
    meaning: str
    units: str
    values: Callable[[DrawnT], Floats]
    used: Callable[[DrawnT], Masks]
    level: float = LEVEL
    tail_share: ClassVar[float] = TAIL_SHARE
    """Where sampling was stopped."""

    def outputs(self) -> Sequence[Output]:
        """Return the mean and its interval."""
        return with_interval(self.name, self.meaning, self.units)

    def variables(self, blocks: Blocks[DrawnT], design: Design) -> Variables:
        """Return the mean and its interval."""
        interval = self.interval(
            self.summary(blocks, design), design.level(self.level, self.tail_share))
        return interval_variables(self.name, interval)

    def summary(self, blocks: Blocks[DrawnT], design: Design) -> Summary:
        """Return the mean of the scores with its standard error."""
        def of_block(poses: DrawnT) -> Moments:
            values, used = self._values_and_used(poses)
            return Moments.of(np.where(used[..., None], values, np.nan), axis=OVER_ALL)

        moments = functools.reduce(Moments.merge, blocks.map(of_block))
        centre = self._centre(moments)

        def deviations(poses: DrawnT) -> tuple[Floats, Integers, Floats]:
            values, used = self._values_and_used(poses)
            with np.errstate(all="ignore"):
                scores = self._scores(values, moments)
                sums = sum_of_settings(np.where(used, scores - centre[:, None, None, None], 0.0))
            largest = np.where(used, scores, -np.inf).max(axis=OVER_ALL, initial=-np.inf)
            return (np.where(poses.draws, sums, np.nan), settings_of(used),
                    largest[:, None, None])

        sums, settings, largest = blocks.gather(deviations)
        n, freedom = moments.count[:, 0], Sample(settings).freedom
        draws = n / design.points if design.unit is Unit.replicate else freedom + 1
        estimate = estimate_mean(centre, n, freedom, Moments.of(sums, axis=2))
        return Summary(estimate, moments, largest.max(axis=(1, 2)), draws)

    def _values_and_used(self, poses: DrawnT) -> tuple[Floats, Masks]:
        values = self.values(poses)
        return values, np.asarray(self.used(poses) & ~missing(values))

    def _centre(self, moments: Moments) -> Floats:
        """Return the mean of the scores."""
        return np.asarray(moments.mean[:, 0])

    def _scores(self, values: Floats, moments: Moments) -> Floats:  # noqa: ARG002
        return values[..., 0]

    def interval(self, summary: Summary, level: float) -> tuple[Floats, Floats, Floats]:
        """Return value, low and high."""
        return symmetric(summary.estimate, level)


def missing(values: Floats) -> Masks:
    """Return which vectors (..., components) have a component that is NaN."""
    return functools.reduce(np.logical_or, (
        np.isnan(values[..., k]) for k in range(values.shape[-1])))


@dataclass(frozen=True)
class PositiveMean(Mean[DrawnT]):
    """The mean of squares, or of other values that are not negative.

    Its interval is Student's of the logarithm. If it is ``guarded``, as all by which something is
    decided, the upper end also holds rare large values that the draws did not show
    (`sweep.analysis.means.with_unseen_tail`).
    """

    guarded: bool = False

    def interval(self, summary: Summary, level: float) -> tuple[Floats, Floats, Floats]:
        """Return value, low and high."""
        mean, low, high = exponential(summary.estimate, level)
        if self.guarded:
            high = with_unseen_tail(high, summary.largest, summary.draws, level)
        return mean, low, high


class RootMeanSquare(PositiveMean[DrawnT]):
    """The root of the mean of squares, which are the values.

    Squares are skewed, and a mean square's error goes with its size: Student's interval is right
    for the logarithm. With 50 normal errors in 1, 5, 10 or 25 cells it covers 0.938 to 0.954,
    without the logarithm 0.92 to 0.95; with Laplace's tails 0.90 to 0.94.
    """

    tail_share: ClassVar[float] = SPREAD_TAIL_SHARE

    def interval(self, summary: Summary, level: float) -> tuple[Floats, Floats, Floats]:
        """Return value, low and high."""
        mean, low, high = map(np.sqrt, super().interval(summary, level))
        return mean, low, high


class StandardDeviation(RootMeanSquare[DrawnT]):
    """The root of the summed variances of a vector's components about their mean (n - 1)."""

    def _centre(self, moments: Moments) -> Floats:
        return np.asarray(moments.variance.sum(axis=1))

    def _scores(self, values: Floats, moments: Moments) -> Floats:
        mean = moments.mean[:, None, None, None]
        count = moments.count[:, :1, None, None]
        return np.asarray(component_sum(np.square(values - mean)) * (count / (count - 1.0)))


class MeanLength(Mean[DrawnT]):
    """The length of the mean of vectors, with the interval of `length_interval`."""

    def _centre(self, moments: Moments) -> Floats:
        return np.asarray(np.linalg.norm(moments.mean, axis=1))

    def _scores(self, values: Floats, moments: Moments) -> Floats:
        length = np.linalg.norm(moments.mean, axis=1)[:, None]
        unit = np.zeros_like(moments.mean)
        unit[:, 0] = 1.0
        direction = np.where(length > 0.0, moments.mean / length, unit)
        return np.asarray(component_sum(values * direction[:, None, None, None]))

    def interval(self, summary: Summary, level: float) -> tuple[Floats, Floats, Floats]:
        """Return value, low and high."""
        return length_interval(summary.estimate, summary.moments.mean.shape[1], level)


class RootMeanSquareRatio(Mean[DrawnT]):
    """The root of the ratio of two means of squares, of the same poses: components 1 over 0.

    Its interval is Student's of the logarithm, by the delta method.
    """

    def _centre(self, moments: Moments) -> Floats:
        return np.zeros(len(moments.mean))

    def _scores(self, values: Floats, moments: Moments) -> Floats:
        share = values / moments.mean[:, None, None, None]
        return np.asarray(share[..., 1] - share[..., 0])

    def interval(self, summary: Summary, level: float) -> tuple[Floats, Floats, Floats]:
        """Return value, low and high."""
        half = half_width(summary.estimate, level) / 2.0
        mean = summary.moments.mean
        with np.errstate(all="ignore"):
            ratio = np.sqrt(mean[:, 1] / mean[:, 0])
            return ratio, ratio * np.exp(-half), ratio * np.exp(half)


# --------------------------------------------------------------------------------------------------
# Root mean square of errors of which rare flips make most: an interval that counts unseen ones.
#
# With 2 % flips of 60 degrees among errors of half a degree the mean square is nearly that of the
# flips alone, and a third of all samples of 50 has none of them: whatever is computed from such a
# sample alone says nothing of the mean square. What bounds it is how many flips the sample may
# have missed, and that no rotation error is larger than half a turn.

FLIPS: Rate[Poses] = Rate("", "", lambda poses: poses.flipped, lambda poses: poses.solved)
"""The share of flips among the solved."""


@dataclass(frozen=True)
class FlipMixture(Statistic[Poses]):
    """The root mean square over solved poses, with an interval that holds if flips are rare.

    The mean square is (1 - p) u + p v: p the share of flips, u the mean square of the other poses,
    v that of the flips. The interval's ends are the least and the largest value over the ends of
    p (Clopper and Pearson, Biometrika 26, 1934), u and v (`RootMeanSquare`), each right with 97.5 %
    at either end. Where v has no upper end, or one beyond it, ``bound`` takes its place.

    With 1, 2 and 5 % flips of 60 degrees among errors of half a degree it covers 0.97 to 1.00 from
    50 draws on. Without a flip in 50 draws the upper end is 48 degrees, in 1,000 draws 11, in
    10^6 draws 0.6: there are samples without flips of populations with such a mean square.
    """

    name: str
    meaning: str
    units: str
    squares: Callable[[Poses], Floats]
    bound: float
    """The largest error that exists, in the unit of the errors."""
    flips: Rate[Poses] = FLIPS
    """The share of flips, p."""
    level: float = LEVEL
    guarded: bool = False
    """Whether the ends of u and v also hold errors that no draw showed, as `PositiveMean` says."""

    def outputs(self) -> Sequence[Output]:
        """Return the root mean square and its interval."""
        return with_interval(self.name, self.meaning, self.units)

    def variables(self, blocks: Blocks[Poses], design: Design) -> Variables:
        """Return the root mean square and its interval."""
        level = design.level(self.level, SPREAD_TAIL_SHARE)
        parts: list[tuple[Integers, Sequence[Floats]]] = []
        for used in (lambda poses: poses.unflipped, lambda poses: poses.flipped):
            part: RootMeanSquare[Poses] = RootMeanSquare(
                "", "", self.units, self.squares, used, guarded=self.guarded)
            summary = part.summary(blocks, design)
            parts.append((summary.moments.count[:, 0],
                          [end**2 for end in part.interval(summary, level)]))
        (others, (u, u_low, u_high)), (flips, (v, v_low, v_high)) = parts
        with np.errstate(invalid="ignore"):
            square = np.where(others > 0, u * others, 0.0) + np.where(flips > 0, v * flips, 0.0)
            square = square / (others + flips)
        largest = self.bound**2
        lows = _first_known(u_low, v_low), _first_known(v_low, u_low)
        highs = [np.fmin(high, largest) for high in (u_high, v_high)]
        hits, used_by_draw = self.flips.by_draw(blocks)
        sample = Sample(used_by_draw)
        draws = design.draws_of_rate(hits, used_by_draw, self.flips.level)
        fewest, most = scaled_to_draws(
            hits.sum(axis=(1, 2), dtype=np.int64), sample.n, draws)
        shares = (clopper_pearson(fewest, draws, level)[0], clopper_pearson(most, draws, level)[1])
        low = np.minimum(*((1 - share) * lows[0] + share * lows[1] for share in shares))
        high = np.maximum(*((1 - share) * highs[0] + share * highs[1] for share in shares))
        # What is computed is rounded: the value lies in its interval.
        interval = (square, np.fmin(low, square), np.fmax(high, square))
        ends = [np.where(sample.drawn | (k == 0), each, np.nan) for k, each in enumerate(interval)]
        return interval_variables(self.name, [np.sqrt(each) for each in ends])


def _first_known(*values: Floats) -> Floats:
    """Return the first that is not NaN of each, or 0."""
    first, second = values
    return np.nan_to_num(np.where(np.isnan(first), second, first), nan=0.0)


def guarded(statistic: Statistic[ViewT]) -> Statistic[ViewT]:
    """Return a statistic with the interval by which something is decided.

    Upper ends of means of squares then hold rare errors that no draw showed.
    """
    if not hasattr(statistic, "guarded"):
        return statistic
    return cast("Statistic[ViewT]", dataclasses.replace(cast("Any", statistic), guarded=True))
