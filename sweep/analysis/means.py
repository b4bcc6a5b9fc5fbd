"""Means and root mean squares of errors, also where flips are mixed in."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, cast

import numpy as np
from scipy import special

from sweep.analysis.counts import Rate, RateState, scaled_to_draws
from sweep.analysis.intervals import LEVEL, clopper_pearson
from sweep.analysis.poses import Poses, component_sum
from sweep.analysis.statistic import (
    OVER_ALL,
    CellDeviations,
    CellDraws,
    Freedom,
    Largest,
    Moments,
    Output,
    Spread,
    State,
    Statistic,
    Variables,
    ViewT,
    interval_variables,
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


def estimate_mean(mean: Floats, n: Integers, freedom: Integers, spread: Spread) -> MeanEstimate:
    """Return the means of ``n`` values in cells, with their standard errors.

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
    with np.errstate(all="ignore"):
        pooled = spread.single * spread.m2 / spread.freedom
        variance = spread.variance + np.where(spread.single > 0, pooled, 0.0)
        welch = spread.variance ** 2 / spread.squares - 2.0
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


@dataclass(frozen=True)
class MeanState(State):
    """Moments (groups, components) of the values, and the draws' degrees of freedom (groups,)."""

    moments: Moments
    freedom: Freedom


@dataclass(frozen=True)
class CentredState(State):
    """What the second pass knows: the first's state, and the mean of the scores, (groups,)."""

    moments: Moments
    freedom: Freedom
    centre: Floats


@dataclass(frozen=True)
class Mean(Statistic[DrawnT, MeanState, CentredState, Spread], Generic[DrawnT]):
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

    def outputs(self) -> Sequence[Output]:
        """Return the mean and its interval."""
        return with_interval(self.name, self.meaning, self.units)

    def first_pass(self, poses: DrawnT) -> MeanState:
        """Take the moments of the values, all together."""
        values = self.values(poses)
        used = self._used(poses, values)
        moments = Moments.of(np.where(used[..., None], values, np.nan), axis=OVER_ALL)
        return MeanState(moments, CellDraws.of(sum_of_settings(used)))

    def prepare_second(self, first: MeanState) -> CentredState:
        """Return the moments with the mean of the scores."""
        return CentredState(first.moments, first.freedom, self._centre(first.moments))

    def second_pass(self, poses: DrawnT, known: CentredState) -> Any:
        """Take the moments of the draws' deviations within the cells."""
        values = self.values(poses)
        used = self._used(poses, values)
        with np.errstate(all="ignore"):
            scores = self._scores(values, known.moments)
            centre = known.centre[:, None, None, None]
            deviations = sum_of_settings(np.where(used, scores - centre, 0.0))
        largest = np.where(used, scores, -np.inf).max(axis=OVER_ALL, initial=-np.inf)
        return CellDeviations(
            Moments.of(np.where(poses.draws, deviations, np.nan), axis=2), Largest(largest))

    def finish(self, known: CentredState, second: Spread) -> Variables:
        """Return the mean and its interval."""
        n = known.moments.count[:, 0]
        estimate = estimate_mean(known.centre, n, known.freedom, second)
        return interval_variables(self.name, self._interval(estimate, known, second))

    def _used(self, poses: DrawnT, values: Floats) -> Masks:
        return np.asarray(self.used(poses) & ~missing(values))

    def _centre(self, moments: Moments) -> Floats:
        return np.asarray(moments.mean[:, 0])

    def _scores(self, values: Floats, moments: Moments) -> Floats:  # noqa: ARG002
        return values[..., 0]

    def _interval(
        self, estimate: MeanEstimate, known: CentredState, second: Spread,  # noqa: ARG002
    ) -> tuple[Floats, Floats, Floats]:
        """Return value, low and high, from the mean of the scores."""
        return symmetric(estimate, self.level)


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
    points_per_draw: int | None = None
    """Of draws that are Sobol' points, the pooled settings of one; None if draws are random."""

    def _interval(
        self, estimate: MeanEstimate, known: CentredState, second: Spread
    ) -> tuple[Floats, Floats, Floats]:
        mean, low, high = exponential(estimate, self.level)
        if self.guarded:
            draws = known.freedom + 1 if self.points_per_draw is None else (
                known.moments.count[:, 0] / self.points_per_draw)
            high = with_unseen_tail(high, second.largest.values, draws, self.level)
        return mean, low, high


class RootMeanSquare(PositiveMean[DrawnT]):
    """The root of the mean of squares, which are the values.

    Squares are skewed, and a mean square's error goes with its size: Student's interval is right
    for the logarithm. With 50 normal errors in 1, 5, 10 or 25 cells it covers 0.938 to 0.954,
    without the logarithm 0.92 to 0.95; with Laplace's tails 0.90 to 0.94.
    """

    def _interval(
        self, estimate: MeanEstimate, known: CentredState, second: Spread
    ) -> tuple[Floats, Floats, Floats]:
        mean, low, high = map(np.sqrt, super()._interval(estimate, known, second))
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

    def _interval(
        self, estimate: MeanEstimate, known: CentredState, second: Spread,  # noqa: ARG002
    ) -> tuple[Floats, Floats, Floats]:
        return length_interval(estimate, known.moments.mean.shape[1], self.level)


class RootMeanSquareRatio(Mean[DrawnT]):
    """The root of the ratio of two means of squares, of the same poses: components 1 over 0.

    Its interval is Student's of the logarithm, by the delta method.
    """

    def _centre(self, moments: Moments) -> Floats:
        return np.zeros(len(moments.mean))

    def _scores(self, values: Floats, moments: Moments) -> Floats:
        share = values / moments.mean[:, None, None, None]
        return np.asarray(share[..., 1] - share[..., 0])

    def _interval(
        self, estimate: MeanEstimate, known: CentredState, second: Spread,  # noqa: ARG002
    ) -> tuple[Floats, Floats, Floats]:
        half = half_width(estimate, self.level) / 2.0
        mean = known.moments.mean
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

@dataclass(frozen=True)
class MixtureState(State):
    """The squares of the poses that are not flipped, of those that are, and how many are."""

    unflipped: MeanState
    flipped: MeanState
    flips: RateState


@dataclass(frozen=True)
class CentredMixture(State):
    """What the second pass knows."""

    unflipped: CentredState
    flipped: CentredState
    flips: RateState


@dataclass(frozen=True)
class MixtureSpread(State):
    """Sums over cells, of both parts."""

    unflipped: Spread
    flipped: Spread


FLIPS: Rate[Poses] = Rate("", "", lambda poses: poses.flipped, lambda poses: poses.solved)
"""The share of flips among the solved."""


@dataclass(frozen=True)
class FlipMixture(Statistic[Poses, MixtureState, CentredMixture, MixtureSpread]):
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
    points_per_draw: int | None = None

    def outputs(self) -> Sequence[Output]:
        """Return the root mean square and its interval."""
        return with_interval(self.name, self.meaning, self.units)

    def _of(self, used: Callable[[Poses], Masks]) -> RootMeanSquare[Poses]:
        return RootMeanSquare("rms", "", self.units, self.squares, used, self.level, self.guarded,
                              self.points_per_draw)

    @property
    def _unflipped(self) -> RootMeanSquare[Poses]:
        return self._of(lambda poses: poses.unflipped)

    @property
    def _flipped(self) -> RootMeanSquare[Poses]:
        return self._of(lambda poses: poses.flipped)

    def first_pass(self, poses: Poses) -> MixtureState:
        """Take the moments of both parts, and count."""
        return MixtureState(
            self._unflipped.first_pass(poses), self._flipped.first_pass(poses),
            self.flips.first_pass(poses))

    def prepare_second(self, first: MixtureState) -> CentredMixture:
        """Return the moments with their means."""
        return CentredMixture(
            self._unflipped.prepare_second(first.unflipped),
            self._flipped.prepare_second(first.flipped), first.flips)

    def second_pass(self, poses: Poses, known: CentredMixture) -> MixtureSpread:
        """Take the moments of the draws' deviations within the cells, of both parts."""
        return MixtureSpread(
            self._unflipped.second_pass(poses, known.unflipped),
            self._flipped.second_pass(poses, known.flipped))

    def finish(self, known: CentredMixture, second: MixtureSpread) -> Variables:
        """Return the root mean square and its interval."""
        unflipped = self._unflipped.finish(known.unflipped, second.unflipped)
        flipped = self._flipped.finish(known.flipped, second.flipped)
        (u, u_low, u_high), (v, v_low, v_high) = (
            [part[f"rms{end}"] ** 2 for end in ("", "_low", "_high")]
            for part in (unflipped, flipped))
        others, flips = known.unflipped.moments.count[:, 0], known.flipped.moments.count[:, 0]
        with np.errstate(invalid="ignore"):
            square = np.where(others > 0, u * others, 0.0) + np.where(flips > 0, v * flips, 0.0)
            square = square / (others + flips)
        largest = self.bound**2
        lows = _first_known(u_low, v_low), _first_known(v_low, u_low)
        highs = [np.fmin(high, largest) for high in (u_high, v_high)]
        shares = _shares(self.flips.draws_of(known.flips), known.flips, self.level)
        low = np.minimum(*((1 - share) * lows[0] + share * lows[1] for share in shares))
        high = np.maximum(*((1 - share) * highs[0] + share * highs[1] for share in shares))
        # What is computed is rounded: the value lies in its interval.
        interval = (square, np.fmin(low, square), np.fmax(high, square))
        drawn = known.flips.sample.drawn
        ends = [np.where(drawn | (k == 0), each, np.nan) for k, each in enumerate(interval)]
        return interval_variables(self.name, [np.sqrt(each) for each in ends])


def _first_known(*values: Floats) -> Floats:
    """Return the first that is not NaN of each, or 0."""
    first, second = values
    return np.nan_to_num(np.where(np.isnan(first), second, first), nan=0.0)


def _shares(draws: Integers, flips: RateState, level: float) -> tuple[Floats, Floats]:
    """Return the ends of the share of flips, counted in draws."""
    fewest, most = scaled_to_draws(flips.hits, flips.sample.n, draws)
    return clopper_pearson(fewest, draws, level)[0], clopper_pearson(most, draws, level)[1]


def guarded(statistic: Statistic[ViewT, Any, Any, Any]) -> Statistic[ViewT, Any, Any, Any]:
    """Return a statistic with the interval by which something is decided.

    Upper ends of means of squares then hold rare errors that no draw showed.
    """
    if not isinstance(statistic, FlipMixture | PositiveMean):
        return statistic
    changed = dataclasses.replace(statistic, guarded=True)
    return cast("Statistic[ViewT, Any, Any, Any]", changed)
