"""Statistics of draws in cells of a fixed grid, and their intervals, as records that are streamed.

Poses come in blocks, arrays (groups, cells, draws, settings): the settings of a draw see the same
images, so that together they count as one. A statistic looks at every block twice; what it keeps
of a block are states.

Every interval has 95 % and speaks of other draws on the same grid; where no cell has two draws
that count it is NaN.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sweep.analysis import radix_histogram as tallies
from sweep.analysis.intervals import jeffreys, wilson
from sweep.analysis.moments import Moments
from sweep.analysis.states import State
from sweep.plan.schema import cf_attributes
from sweep.typing import Floats

Integers = NDArray[np.int64]
Masks = NDArray[np.bool_]
Found = dict[str, NDArray[Any]]
"""What was found of the groups, by name of the variable."""

LEVEL = 0.95
TAIL = (1.0 - LEVEL) / 2.0
PERCENTS = {"median": 50, "p95": 95, "p99": 99}
OVER_ALL = (1, 2, 3)
"""Axes of cells, draws and settings."""


class IntervalOf(IntEnum):
    """Why an interval has an end, or not."""

    not_run = 0
    """There is nothing that counts."""
    given = 1
    nothing_drawn = 2
    """No cell has two draws that count."""
    too_few_draws = 3
    """An end lies beyond the smallest or the largest draw."""


class Output(NamedTuple):
    """A variable that a statistic gives."""

    name: str
    meaning: str
    units: str
    dtype: str = "f8"
    flags: type[IntEnum] | None = None

    def attributes(self) -> dict[str, Any]:
        """Return its attributes."""
        return cf_attributes(self.meaning, self.units, self.flags)


class Statistic(Protocol):
    """What is asked of poses: two looks at every block, and what follows from them.

    ``first`` and ``second`` return the state of the block and that of its cells; ``between``
    what the second look needs to know of the first.
    """

    def outputs(self) -> Sequence[Output]:
        """Return the variables that it gives."""
        ...

    def first(self, poses: Any) -> tuple[State, State]:
        """Look at a block."""
        ...

    def between(self, first: State) -> State:
        """Return what the second look needs, from the first states merged and folded."""
        ...

    def second(self, poses: Any, known: State) -> tuple[State, State]:
        """Look at a block again."""
        ...

    def finish(self, known: State, second: State) -> Found:
        """Return the variables, each (groups,)."""
        ...


def with_interval(name: str, meaning: str, units: str) -> list[Output]:
    """Return a variable and the ends of its interval."""
    return [
        Output(name, meaning, units),
        Output(f"{name}_low", f"lower end of the 95 % interval: {meaning}", units),
        Output(f"{name}_high", f"upper end of the 95 % interval: {meaning}", units),
    ]


# Intervals of means.

class Estimated(NamedTuple):
    """Means, their standard errors, and the degrees of freedom of these, each (groups,)."""

    mean: Floats
    error: Floats
    freedom: Floats


def error_of(mean: Floats, n: Integers, most: Integers, sums: State) -> Estimated:
    """Return the means of values in cells with their standard errors.

    A mean is a ratio of two sums over a stratified sample, the cells being the strata and the
    draws the sample: of the values, and of what counts. So its variance is that of the sum of
    ``used * (value - mean)`` over n², each cell's from its own draws: Cochran, "Sampling
    Techniques", 3rd ed. 1977, sections 6.11 and 5A.14. Where all draws count it is the sum of
    n_c s_c² over n²; where some do not, it also knows that which ones do is random. A cell with a
    single draw cannot tell its variance and gets the pooled one.

    The degrees of freedom are Welch's (Biometrika 34, 1947, the form with f + 2): a few cells
    with the largest errors can make most of the variance. They are no more than ``most``, the
    draws with a used value beyond the first of each cell; 0 of these: standard error NaN.
    """
    with np.errstate(all="ignore"):
        pooled = sums["alone"] * sums["m2_repeated"] / sums["freedom_repeated"]
        spread = sums["spread"] + np.where(sums["alone"] > 0, pooled, 0.0)
        welch = sums["spread"] ** 2 / sums["spread_squares"] - 2.0
        freedom = np.where(most > 0, np.fmin(most, welch), np.nan)
        error = np.where(most > 0, np.sqrt(spread) / n, np.nan)
    return Estimated(np.where(n > 0, mean, np.nan), error, freedom)


def symmetric(estimated: Estimated) -> tuple[Floats, Floats, Floats]:
    """Return Student's interval of means: value, low, high."""
    mean, error, freedom = estimated
    half = error * special.stdtrit(freedom, 1.0 - TAIL)
    return mean, mean - half, mean + half


def exponential(estimated: Estimated) -> tuple[Floats, Floats, Floats]:
    """Return the interval of positive means: Student's of the logarithm, by the delta method."""
    mean, error, freedom = estimated
    with np.errstate(all="ignore"):
        factor = np.exp(error / mean * special.stdtrit(freedom, 1.0 - TAIL))
        positive = mean, mean / factor, mean * factor
    plain = symmetric(estimated)
    low, high = (np.where(mean == 0.0, a, b) for a, b in zip(plain[1:], positive[1:], strict=True))
    return mean, low, high


def _named(name: str, interval: Sequence[NDArray[Any]]) -> Found:
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


def counted(used: Masks) -> tuple[State, State]:
    """Return the states of how many poses are used, and of the draws that these are of."""
    settings = used.sum(axis=3)
    squares = np.square(settings, dtype=np.float64).sum(axis=(1, 2))
    return ({"n": settings.sum(axis=(1, 2)), "squares": squares},
            {"draws": (settings > 0).sum(axis=2)})


def draws_of(known: State) -> Integers:
    """Return the number of draws that the used poses are worth.

    That is the number of draws with a used pose where each has as many of them; else it is less,
    for those with more of them count more: the effective sample size, (Σ m)² / Σ m² of m used
    poses a draw, rounded down (Kish, "Survey Sampling", 1965, section 11.7).
    """
    n = known["n"].astype(np.float64)
    worth = n**2 / np.maximum(known["squares"], 1.0)
    return np.asarray(np.floor(worth * (1.0 + 1e-12)), dtype=np.int64)


def in_draws(hits: Integers, n: Integers, draws: Integers) -> tuple[Integers, Integers]:
    """Return ``hits`` of ``n`` poses as hits of draws, rounded down and up."""
    n = np.maximum(n, 1)
    return hits * draws // n, -(-hits * draws // n)


# The records.

class SinglePass:
    """What is known after one look: where all statistics are so, there is no second."""

    def between(self, first: State) -> State:
        """Return what was seen."""
        return first

    def second(self, poses: Any, known: State) -> tuple[State, State]:  # noqa: ARG002
        """Return nothing."""
        return {}, {}


@dataclass(frozen=True)
class Count(SinglePass):
    """How many poses there are of a kind."""

    name: str
    meaning: str
    of: Callable[[Any], Masks]

    def outputs(self) -> Sequence[Output]:
        """Return the one variable."""
        return [Output(self.name, self.meaning, "1", "i8")]

    def first(self, poses: Any) -> tuple[State, State]:
        """Count."""
        return {"n": self.of(poses).sum(axis=OVER_ALL)}, {}

    def finish(self, known: State, second: State) -> Found:  # noqa: ARG002
        """Return the count."""
        return {self.name: known["n"]}


@dataclass(frozen=True)
class Draws(Count):
    """How many poses there are of a kind, the draws that they are worth, and if any was drawn."""

    def outputs(self) -> Sequence[Output]:
        """Return the three variables."""
        return [*super().outputs(),
                Output("draws", "random draws that the intervals are of", "1", "i8"),
                Output("drawn", "whether any cell has two draws", "1", "?")]

    def first(self, poses: Any) -> tuple[State, State]:
        """Count."""
        return counted(self.of(poses))

    def finish(self, known: State, second: State) -> Found:
        """Return the counts."""
        return super().finish(known, second) | {
            "draws": draws_of(known), "drawn": known["freedom"] > 0}


@dataclass(frozen=True)
class Rate(SinglePass):
    """The share of ``used`` that are ``successes``, with Wilson's interval of a level.

    Pooled settings see the same draws: n of the interval is the number of draws, `draws_of`, and
    the successes are rounded outwards to whole draws. It is a little wide where the cells' rates
    differ.
    """

    name: str
    meaning: str
    successes: Callable[[Any], Masks]
    used: Callable[[Any], Masks]
    level: float = LEVEL
    counts: Sequence[tuple[str, str]] = ()
    """Names and meanings for the number of ``used`` and of ``successes``, where they are wanted."""
    with_jeffreys: bool = False

    def outputs(self) -> Sequence[Output]:
        """Return the rate, its interval, and the counts that are asked for."""
        draws = Output("draws", "random draws that the interval is of", "1", "i8")
        return [
            *(Output(name, meaning, "1", "i8") for name, meaning in self.counts),
            *([draws] if self.counts else []),
            *with_interval(self.name, self.meaning, "1"),
            *(with_interval(f"{self.name}_jeffreys", f"{self.meaning} (Jeffreys)", "1")[1:]
              if self.with_jeffreys else []),
        ]

    def first(self, poses: Any) -> tuple[State, State]:
        """Count."""
        used = self.used(poses)
        pooled, cells = counted(used)
        return pooled | {"hits": (self.successes(poses) & used).sum(axis=OVER_ALL)}, cells

    def finish(self, known: State, second: State) -> Found:  # noqa: ARG002
        """Return the rate and its intervals."""
        n, hits, draws = known["n"], known["hits"], draws_of(known)
        drawn = known["freedom"] > 0
        fewest, most = in_draws(hits, n, draws)
        with np.errstate(invalid="ignore"):
            found: Found = {self.name: hits / n}
        if self.counts:
            names = (name for name, _ in self.counts)
            found |= dict(zip(names, (n, hits), strict=False)) | {"draws": draws}
        kinds = {"": wilson} | ({"_jeffreys": jeffreys} if self.with_jeffreys else {})
        for ending, interval in kinds.items():
            low, high = interval(fewest, draws, self.level)[0], interval(most, draws, self.level)[1]
            found[f"{self.name}{ending}_low"] = np.where(drawn, low, np.nan)
            found[f"{self.name}{ending}_high"] = np.where(drawn, high, np.nan)
        return found


@dataclass(frozen=True)
class Mean:
    """A mean of values, (groups, cells, draws, settings, components), with Student's interval.

    Values that are NaN do not count.
    """

    name: str
    meaning: str
    units: str
    values: Callable[[Any], Floats]
    used: Callable[[Any], Masks]

    def outputs(self) -> Sequence[Output]:
        """Return the mean and its interval."""
        return with_interval(self.name, self.meaning, self.units)

    def first(self, poses: Any) -> tuple[State, State]:
        """Take the moments of the values, all together."""
        values = self.values(poses)
        used = self._used(poses, values)
        moments = Moments.of(np.where(used[..., None], values, np.nan), axis=OVER_ALL)
        return {"moments": moments}, counted(used)[1]

    def between(self, first: State) -> State:
        """Return the moments with the mean of the scores."""
        return first | {"centre": self._centre(first["moments"])}

    def second(self, poses: Any, known: State) -> tuple[State, State]:
        """Take the moments of the draws' deviations within the cells."""
        values, moments = self.values(poses), known["moments"]
        used = self._used(poses, values)
        with np.errstate(all="ignore"):
            scores = self._scores(values, moments)
            centre = known["centre"][:, None, None, None]
            deviations = np.where(used, scores - centre, 0.0).sum(axis=3)
        within = Moments.of(np.where(poses.draws, deviations, np.nan), axis=2)
        return {}, {"within": within}

    def finish(self, known: State, second: State) -> Found:
        """Return the mean and its interval."""
        n = known["moments"].count[:, 0]
        estimated = error_of(known["centre"], n, known["freedom"], second)
        return _named(self.name, self._interval(estimated))

    def _used(self, poses: Any, values: Floats) -> Masks:
        return np.asarray(self.used(poses) & ~np.isnan(values).any(axis=-1))

    def _centre(self, moments: Moments) -> Floats:
        return np.asarray(moments.mean[:, 0])

    def _scores(self, values: Floats, moments: Moments) -> Floats:  # noqa: ARG002
        return values[..., 0]

    def _interval(self, estimated: Estimated) -> tuple[Floats, Floats, Floats]:
        return symmetric(estimated)


class PositiveMean(Mean):
    """The mean of values that are not negative; Student's interval of its logarithm."""

    def _interval(self, estimated: Estimated) -> tuple[Floats, Floats, Floats]:
        return exponential(estimated)


class RootMeanSquare(PositiveMean):
    """The root of the mean of squares, which are the values.

    Squares are skewed, and a mean square's error goes with its size: Student's interval is right
    for the logarithm. With 50 normal errors in 1, 5, 10 or 25 cells it covers 0.938 to 0.954,
    without the logarithm 0.92 to 0.95; with Laplace's tails 0.90 to 0.94.
    """

    def _interval(self, estimated: Estimated) -> tuple[Floats, Floats, Floats]:
        mean, low, high = (np.sqrt(each) for each in exponential(estimated))
        return mean, low, high


class StandardDeviation(RootMeanSquare):
    """The root of the summed variances of a vector's components about their mean (n - 1)."""

    def _centre(self, moments: Moments) -> Floats:
        return np.asarray(moments.variance.sum(axis=1))

    def _scores(self, values: Floats, moments: Moments) -> Floats:
        mean = moments.mean[:, None, None, None]
        count = moments.count[:, :1, None, None]
        return np.asarray(np.square(values - mean).sum(axis=-1) * (count / (count - 1.0)))


class Length(Mean):
    """The length of the mean of vectors.

    Along its own direction the mean vector is a plain mean, and the upper end is Student's. The
    mean's length grows by chance, so the lower end is Scheffé's: the length minus
    sqrt(k d / (d - k + 1) · F(k, d - k + 1)) standard errors, k components, d degrees of freedom,
    at least 0. By the Cauchy-Schwarz inequality this holds a bias of 0 whenever Hotelling's T²
    does, in 95 % at least. With 50 normal errors of 3 components it covers 0.97 (a large bias) to
    0.995 (a bias of its error).
    """

    def between(self, first: State) -> State:
        """Return the moments, their length, and the number of components."""
        components = np.full(len(first["moments"].mean), first["moments"].mean.shape[1])
        return super().between(first) | {"components": components}

    def finish(self, known: State, second: State) -> Found:
        """Return the length and its interval."""
        n, k = known["moments"].count[:, 0], known["components"]
        estimated = error_of(known["centre"], n, known["freedom"], second)
        length, low, high = symmetric(estimated)
        rest = estimated.freedom - (k - 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            reach = np.sqrt(k * estimated.freedom / rest * special.fdtri(k, rest, LEVEL))
            low = np.where(rest > 0.0, np.fmax(0.0, length - reach * estimated.error), 0.0)
        low = np.where(np.isnan(estimated.error), np.nan, low)
        return _named(self.name, (length, low, high))

    def _centre(self, moments: Moments) -> Floats:
        return np.asarray(np.linalg.norm(moments.mean, axis=1))

    def _scores(self, values: Floats, moments: Moments) -> Floats:
        length = np.linalg.norm(moments.mean, axis=1)[:, None]
        unit = np.zeros_like(moments.mean)
        unit[:, 0] = 1.0
        direction = np.where(length > 0.0, moments.mean / length, unit)
        return np.asarray((values * direction[:, None, None, None]).sum(axis=-1))


class RootMeanSquareRatio(Mean):
    """The root of the ratio of two means of squares, of the same poses: components 1 over 0.

    Its interval is Student's of the logarithm, by the delta method.
    """

    def finish(self, known: State, second: State) -> Found:
        """Return the ratio and its interval."""
        moments = known["moments"]
        estimated = error_of(known["centre"], moments.count[:, 0], known["freedom"], second)
        half = estimated.error * special.stdtrit(estimated.freedom, 1.0 - TAIL) / 2.0
        with np.errstate(all="ignore"):
            ratio = np.sqrt(moments.mean[:, 1] / moments.mean[:, 0])
            return _named(self.name, (ratio, ratio * np.exp(-half), ratio * np.exp(half)))

    def _centre(self, moments: Moments) -> Floats:
        return np.zeros(len(moments.mean))

    def _scores(self, values: Floats, moments: Moments) -> Floats:
        share = values / moments.mean[:, None, None, None]
        return np.asarray(share[..., 1] - share[..., 0])


@dataclass(frozen=True)
class Quantiles:
    """The quantiles of `PERCENTS` of the errors of ``used`` poses; not ``solved`` is infinite.

    A quantile is the smallest value with at least that share at or below. The interval's ends are
    order statistics of the pooled sample: David and Nagaraja, "Order Statistics", 3rd ed. 2003,
    section 7.1. Where cells differ, the count below the quantile varies less than binomially
    (Hoeffding, Annals of Mathematical Statistics 27, 1956): it then covers more. Pooled settings
    see the same draws: ranks are counted in draws.
    """

    name: str
    """With {} in place of the statistic, such as ``rotation_{}_deg``."""
    meaning: str
    units: str
    errors: Callable[[Any], Floats]
    solved: Callable[[Any], Masks]
    used: Callable[[Any], Masks]
    with_reason: bool = False

    def outputs(self) -> Sequence[Output]:
        """Return the quantiles and their intervals."""
        found = []
        for statistic, percent in PERCENTS.items():
            meaning = f"{percent} % quantile of the {self.meaning}, not solved = infinite"
            found += with_interval(self.name.format(statistic), meaning, self.units)
            if self.with_reason:
                found.append(Output(
                    f"{statistic}_interval", f"why the interval of the {percent} % quantile has "
                    "both ends, or not", "", "u1", IntervalOf))
        return found

    def first(self, poses: Any) -> tuple[State, State]:
        """Count the values by their upper bits."""
        used = self.used(poses)
        pooled, cells = counted(used)
        return pooled | {"upper": tallies.upper_tally(*self._flat(poses, used))}, cells

    def between(self, first: State) -> State:
        """Return the bins in which the ranks lie that are wanted."""
        n, draws = first["n"], draws_of(first)
        ranks = np.zeros((len(n), len(PERCENTS), 3), dtype=np.int64)
        for at, percent in enumerate(PERCENTS.values()):
            ranks[:, at, 0] = -(-n * percent // 100)
            for count in np.unique(draws[(first["freedom"] > 0)]).tolist():
                here = (draws == count) & (first["freedom"] > 0)
                low, high = _ranks(count, percent)
                ranks[here, at, 1] = low * n[here] // count
                # One beyond the last where there is no such draw.
                ranks[here, at, 2] = -(-high * n[here] // count) if high <= count else n[here] + 1
        bins, within = tallies.bins_of(first["upper"], _groups_of(ranks), ranks)
        kept = {name: value for name, value in first.items() if name != "upper"}
        return kept | {"bins": bins, "ranks": within}

    def second(self, poses: Any, known: State) -> tuple[State, State]:
        """Count the values in those bins by all their bits."""
        flat = self._flat(poses, self.used(poses))
        return {"lower": tallies.lower_tally(*flat, known["bins"])}, {}

    def finish(self, known: State, second: State) -> Found:
        """Return the quantiles, their intervals, and why these may have no ends."""
        bins = known["bins"]
        values = tallies.values_at(second["lower"], _groups_of(bins), bins, known["ranks"])
        found: Found = {}
        for at, statistic in enumerate(PERCENTS):
            found |= _named(self.name.format(statistic), list(values[:, at].T))
            if self.with_reason:
                missing = (bins[:, at, 1:] < 0).any(axis=1)
                found[f"{statistic}_interval"] = np.select(
                    [known["n"] == 0, known["freedom"] == 0, missing],
                    [IntervalOf.not_run, IntervalOf.nothing_drawn, IntervalOf.too_few_draws],
                    IntervalOf.given,
                ).astype(np.uint8)
        return found

    def _flat(self, poses: Any, used: Masks) -> tuple[Integers, Floats]:
        groups = np.nonzero(used)[0]
        errors = self.errors(poses)
        known = self.solved(poses) & ~np.isnan(errors)
        return groups, np.where(known, errors, np.inf)[used]


def _groups_of(array: NDArray[Any]) -> Integers:
    """Return the group of each element of (groups, ...)."""
    numbers = np.arange(len(array)).reshape(-1, *[1] * (array.ndim - 1))
    return np.broadcast_to(numbers, array.shape)


@functools.lru_cache(maxsize=4096)
def _ranks(n: int, percent: int) -> tuple[int, int]:
    """Return the ranks, from 1, between which the quantile lies, beyond each with 2.5 % at most.

    0 and n + 1 stand for ends that the sample does not have.
    """
    p = percent / 100.0
    reach = 10.0 * np.sqrt(n * p * (1.0 - p)) + 10.0
    below = np.arange(max(0, int(n * p - reach)), min(n, int(n * p + reach)) + 1)
    chance = special.bdtr(below, n, p)
    first = below[np.searchsorted(chance, TAIL)]
    last = below[np.searchsorted(chance, 1.0 - TAIL)] + 1
    return int(first), int(last)
