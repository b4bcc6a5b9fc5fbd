"""One estimator: statistics of poses by group, each with an interval that holds for its draws.

`aggregates` arranges a dataset's columns as (groups, cells, draws, settings, ...). A group is one
row of the table; its cells are a fixed grid, the draws of a cell are random, and the settings of a
draw see the same images, so that together they count as one draw. A statistic is a record: it
sums what it needs of each draw, and makes of these sums a value and its interval.
"""

from __future__ import annotations

import bisect
import functools
import itertools
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy import special, stats

from sweep.analysis import dataset
from sweep.analysis.dataset import COMMON, DRAWS, INSIDE, Poses, norm_squared
from sweep.errors import ArgumentError, DatasetError
from sweep.experiment.draws import REPLICATES
from sweep.experiment.schema import LABELS, cf_attributes
from sweep.typing import Floats, Integers, Masks

#: Arrays of poses, (groups, cells, draws, settings, ...), by name.
Arrays = dict[str, NDArray[Any]]


#: A view of a block's poses, which statistics read; it has the mask ``run`` of those that were run.
ViewT = TypeVar("ViewT", bound=Any)
ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")

#: Arrays (groups, cells, draws, ...) of a block's view and its groups.
Parts = Callable[[ViewT, slice], Sequence[NDArray[Any]]]


# --------------------------------------------------------------------------------------------------
# Confidence intervals of a binomial proportion, a rate of ``successes`` of ``n``.
#
# Brown, Cai and DasGupta, "Interval Estimation for a Binomial Proportion", Statistical Science
# 16(2), 2001, doi:10.1214/ss/1009213286, recommends both for small n.

#: Probability with which every interval of a table holds its value.
LEVEL = 0.95

#: Probability beyond each end.
TAIL = (1.0 - LEVEL) / 2.0

#: Standard deviations from the middle to the ends, of a normal variable: 1.96.
DEVIATIONS = float(special.ndtri(1.0 - TAIL))


def wilson(successes: ArrayLike, n: ArrayLike, level: float = LEVEL) -> tuple[Floats, Floats]:
    """Return the ends (low, high) of Wilson's score interval, of the broadcast shape.

    Brown, Cai and DasGupta 2001, section 3.1.1, eq. 4. The lower end is taken from the product of
    both, successes² / (n (n + κ²)), so that nothing cancels: each is right to 1e-15 of itself.

    Counts are whole numbers up to 1e15: so far n, n - successes and successes + 1/2 are exact in
    doubles. ``n = 0`` gives NaN, NaN; 0 of n has low = 0 and n of n has high = 1, exactly.

    >>> low, high = wilson([0, 15], [20, 148])
    >>> low.round(4).tolist(), high.round(4).tolist()
    ([0.0, 0.0624], [0.1611, 0.1605])
    """
    successes, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(n, float))
    kappa = float(np.sqrt(2.0) * special.erfinv(level))  # keeps the digits of any level
    with np.errstate(all="ignore"):
        spread = kappa * np.sqrt(successes * ((n - successes) / n) + kappa**2 / 4)
        upper = successes + kappa**2 / 2 + spread
        return _with_exact_ends(successes, n, successes / n * (successes / upper),
                                upper / (n + kappa**2))


def clopper_pearson(
    successes: ArrayLike, n: ArrayLike, level: float = LEVEL
) -> tuple[Floats, Floats]:
    """Return the ends (low, high) of Clopper and Pearson's interval, of the broadcast shape.

    Quantiles of Beta(successes, n - successes + 1) and Beta(successes + 1, n - successes), 0 at 0
    of n and 1 at n of n: each end is right with (1 + level) / 2 at least, whatever the rate.
    Clopper and Pearson, Biometrika 26(4), 1934, doi:10.1093/biomet/26.4.404.

    Counts, ``n = 0`` and exact ends as in `wilson`.

    >>> low, high = clopper_pearson([0, 1], 50)
    >>> low.round(4).tolist(), high.round(4).tolist()
    ([0.0, 0.0005], [0.0711, 0.1065])
    """
    successes, n = np.broadcast_arrays(np.asarray(successes, float), np.asarray(n, float))
    tail, failures = (1.0 - level) / 2.0, n - successes
    low = special.betaincinv(np.maximum(successes, 1.0), failures + 1.0, tail)
    high = special.betainccinv(successes + 1.0, np.maximum(failures, 1.0), tail)
    return _with_exact_ends(successes, n, low, high)


def _with_exact_ends(
    successes: Floats, n: Floats, low: Floats, high: Floats
) -> tuple[Floats, Floats]:
    low = np.where(successes == 0, 0.0, low)
    high = np.where(successes == n, 1.0, high)
    return np.where(n == 0, np.nan, low), np.where(n == 0, np.nan, high)


# --------------------------------------------------------------------------------------------------
# Decisions that are looked at again and again: the error probability that each look may spend.
#
# Trials come in waves, and after each wave it is asked whether a requirement is met. If every
# look had the error probability of a single one, the first that errs would end the search. So
# each spends a part. Looks at the same growing sample err together, and early ones cannot err at
# all where so few draws show nothing, so that the part may be larger than one over their number
# (Bonferroni): by `looks_factor`, which follows all paths of the counts (group-sequential tests
# with a constant nominal level: Pocock, Biometrika 64(2), 1977, doi:10.1093/biomet/64.2.191; exact
# for binomial counts: Jennison and Turnbull, Group Sequential Methods, 2000, section 12.1).

#: Factor of a mean, whose looks are not counts: of the first look, and of each one.
FIRST_LOOK, EACH_LOOK = 0.35, 0.65

#: Shares of the draws that count, for all of which a factor holds: such as those that are solved.
COUNTING = np.linspace(0.3, 1.0, 15)

#: Variance of a count above which the paths are too many: the factor of means holds there, too.
MAX_VARIANCE = 3e4


@functools.cache
def looks_factor(ends: tuple[int, ...], rate: float = math.nan, error: float = 0.025) -> float:
    """Return by how much the error probability of a decision is divided for each of its looks.

    Parameters
    ----------
    ends
        Draws of the growing sample at each look.
    rate
        The share of the draws that is on the decision's side where it is wrong most often; NaN if
        what is decided is no share: samples that grow by a quarter or more from look to look.
    error
        The probability that one look decides it falsely.

    Notes
    -----
    Of 1 to 15 looks up to 2,400 draws, rates from 0.01 to 0.99 and errors from 0.025 to 1e-4 the
    probability that any look errs is at most a single one's, and 1.3 times that if another share of
    the draws counts than was tried (`pytest -m evidence tests/sampling/test_limit_search.py`).

    Examples
    --------
    A rate of 0.99 cannot be shown by the first of these looks, however many successes they have:

    >>> looks_factor((400,), 0.99), round(looks_factor((40, 80, 120, 400, 600), 0.99), 1)
    (1.0, 1.4)
    >>> round(looks_factor((50, 100, 150, 200)), 1)
    3.0
    """
    if not ends[-1] * rate * (1.0 - rate) <= MAX_VARIANCE:
        return FIRST_LOOK + EACH_LOOK * len(ends)
    # Bonferroni's factor, the number of looks, holds in any case; the next one differs by 3 %.
    factors: list[float] = np.geomspace(1.0, len(ends), 100).tolist()
    samples = [[max(1, int(share * end)) for end in ends] for share in COUNTING]
    return factors[bisect.bisect_left(factors[:-1], True, key=lambda factor: all(
        error_of_looks(each, rate, error / factor) <= error for each in samples))]


def error_of_looks(ends: Sequence[int], rate: float, tail: float) -> float:
    """Return the probability that any look at a growing sample says "more than ``rate``".

    A look says it of k of n draws if so many have a probability of ``tail`` at most where the share
    is ``rate``: Clopper and Pearson's lower end.
    """
    paths, seen, first, error = np.ones(1), 0, 0, 0.0
    for end in ends:
        # Counts of the new draws; of others the probability is below 1e-15.
        new, mean = end - seen, (end - seen) * rate
        spread = 40.0 + 9.0 * math.sqrt(mean * (1.0 - rate))
        added = np.arange(max(0, int(mean - spread)), min(new, int(mean + spread)) + 1)
        paths = np.convolve(paths, stats.binom.pmf(added, new, rate))
        seen, first = end, first + int(added[0])
        says = special.bdtrc(first + np.arange(len(paths)) - 1.0, end, rate) <= tail
        error += float(paths[says].sum())
        paths[says] = 0.0
    return error


# --------------------------------------------------------------------------------------------------
# Columns in memory; quantities of single poses are computed a block at a time.

#: Poses in a block: a thread needs 13 MB for so many.
MAX_BLOCK = 1 << 16

#: Poses of which views are kept for all statistics: what they compute takes some 200 MB.
MAX_SHARED = 1 << 20

#: Blocks that are computed side by side; with more, reading memory is what takes time.
MAX_THREADS = 4

#: Settings up to which they are summed one by one, for NumPy's loop along a short axis is slow.
MAX_SLICES = 8


def in_threads(function: Callable[[ItemT], ResultT], items: Sequence[ItemT]) -> list[ResultT]:
    """Return the results of a function of each item; NumPy's loops run side by side."""
    if len(items) == 1:
        return [function(items[0])]
    with ThreadPoolExecutor(min(MAX_THREADS, len(os.sched_getaffinity(0)))) as threads:
        return list(threads.map(function, items))


class Columns(Generic[ViewT]):
    """The poses of some groups, read in blocks along groups, cells and draws.

    Parameters
    ----------
    arrays
        The columns, (groups, cells, draws, settings, ...).
    view
        Makes of a block's arrays the view that statistics read.
    """

    def __init__(self, arrays: Arrays, view: Callable[[Arrays], ViewT]) -> None:
        self._arrays, self._view = arrays, view
        self.shape = next(iter(arrays.values())).shape[:4]
        self.poses = math.prod(self.shape)
        # Groups are cut first: cells are where they are small, draws where a cell is large.
        cuts = []
        for axis, length in enumerate(self.shape[:3]):
            step = max(MAX_BLOCK // max(math.prod(self.shape[axis + 1 :]), 1), 1)
            cuts.append([slice(start, start + step) for start in range(0, max(length, 1), step)])
        self._blocks = list(itertools.product(*cuts))
        self._views: dict[int, ViewT] = {}
        #: Means (groups, components) by the functions of their values and of the poses that count.
        self.means: dict[tuple[Any, Any], Floats] = {}

    def map(self, function: Callable[[ViewT, tuple[slice, ...]], ResultT]) -> list[ResultT]:
        """Return the results of a function of each block's view and place."""
        return in_threads(lambda number: function(self._view_of(number), self._blocks[number]),
                          range(len(self._blocks)))

    @functools.cached_property
    def run(self) -> Masks:
        """Which draws were run, (groups, cells, draws)."""
        return np.asarray(self.by_draw(lambda poses, _: [poses.run])[0] > 0)

    def _view_of(self, number: int) -> ViewT:
        """Return the view of a block; of few poses all statistics share it, and what it keeps."""
        view = self._views.get(number) or self._view({
            name: array[self._blocks[number]] for name, array in self._arrays.items()})
        if self.poses <= MAX_SHARED:
            self._views[number] = view
        return view

    def joined(self, function: Parts[ViewT]) -> list[NDArray[Any]]:
        """Return arrays (groups, cells, draws, ...) of all blocks.

        ``function`` gives the arrays of a block's view and its groups.
        """
        first = function(self._view_of(0), self._blocks[0][0])
        out = [np.empty((*self.shape[:3], *each.shape[3:]), each.dtype) for each in first]

        def fill(view: ViewT, cut: tuple[slice, ...]) -> None:
            for array, values in zip(out, function(view, cut[0]), strict=True):
                array[cut] = values

        self.map(fill)
        return out

    def by_draw(self, function: Parts[ViewT]) -> list[NDArray[Any]]:
        """Return the sums over settings (groups, cells, draws, ...) of arrays of poses.

        ``function`` gives arrays (groups, cells, draws, settings, ...) of a block's view and its
        groups. Sums of masks are counts, of the smallest type; all others are float64.
        """
        return self.joined(
            lambda view, groups: [sum_of_settings(each) for each in function(view, groups)])


def zero_unless(mask: Masks, values: Floats) -> Floats:
    """Return values where a mask is true, else 0, as `numpy.where`, which takes five times as long.

    Its branch cannot be foreseen; here the mask is a number of 64 bits that are all set or none.

    Examples
    --------
    >>> zero_unless(np.array([True, False]), np.array([1.5, np.nan])).tolist()
    [1.5, 0.0]
    """
    return (-mask.astype(np.int64) & values.view(np.int64)).view(np.float64)


def sum_of_settings(array: NDArray[Any]) -> NDArray[Any]:
    """Return the sums over the settings of (groups, cells, draws, settings, ...), bit for bit.

    Examples
    --------
    >>> sum_of_settings(np.array([[[[True, True], [False, True]]]])).tolist()
    [[[2, 1]]]
    """
    dtype = np.min_scalar_type(array.shape[3]) if array.dtype.kind == "b" else np.dtype("f8")
    if not 0 < array.shape[3] < MAX_SLICES:
        return np.asarray(array.sum(axis=3, dtype=dtype))
    with np.errstate(all="ignore"):  # of infinite errors of both signs it is NaN
        return np.asarray(functools.reduce(
            np.add, (array[:, :, :, k] for k in range(array.shape[3])), np.zeros((), dtype)))


# --------------------------------------------------------------------------------------------------
# How draws are sampled: trials, photographs or Sobol' replicates, all of them or till a stop.
#
# A unit is independent of all else, and counts as one draw whatever it holds: the pooled settings
# of a trial see the same images, the errors of the markers of a photograph are correlated, and the
# points of a replicate (`sweep.experiment.draws`) fill their space evenly; the replicates have
# scrambles of their own. Means follow from the sums of units, with Student's t of the spread
# between them; rates and quantiles have the intervals of a number of draws that they are worth.
#
# Owen, "Randomly permuted (t,m,s)-nets and (t,s)-sequences", 1995; L'Ecuyer and Lemieux, "Recent
# advances in randomized quasi-Monte Carlo methods", 2002, section 2 (replicates).
#
# Who looks at an interval again and again and stops when it is narrow finds it narrow by chance,
# too: it then covers less than its level. So all intervals of a store whose sampling was stopped
# have smaller tails, by `TAIL_SHARE` (but those of mean squares, whose upper ends hold what was not
# seen: `PositiveMean`), and those of rates are Clopper and Pearson's. By exact
# enumeration (`tests/sampling/test_stopped_rate.py`) those of rates then cover 95 % at least at any
# rate; the others by simulation (`tests/sampling/test_stopped_coverage.py`).

#: Tails of intervals of stores whose sampling was stopped, of those that they would have.
#:
#: The interval of 95 % is one of 97 %. The least coverage of a rate, over all rates, half-widths
#: from 0.005 to 0.25, waves of 5 to 99 draws at first and any largest number of trials, is then
#: 0.954.
TAIL_SHARE = 0.6

#: Photographs with the rarer outcome from which the spread between photographs is estimated.
MIN_SPREAD = 5

#: More draws than this are none that a rate is worth, or that anyone waits for.
MAX_DRAWS = 1e9


def stopped_level(level: float) -> float:
    """Return the level of the interval that has another level where sampling was not stopped.

    >>> round(stopped_level(0.95), 3)
    0.97
    """
    return 1.0 - (1.0 - level) * TAIL_SHARE


#: The unit that is drawn independently of all else.
Unit = Literal["trial", "photograph", "replicate"]


@dataclass(frozen=True)
class Design:
    """How the draws of a table were sampled.

    Attributes
    ----------
    unit
        The independent unit: its axis is the axis of draws.
    points
        Pooled settings that see the same Sobol' point.
    stopped
        Whether sampling stopped when intervals were narrow, or a decision was sure.
    """

    unit: Unit = "trial"
    points: int = 1
    stopped: bool = False

    def level(self, level: float) -> float:
        """Return the level of the interval that is to hold its value with that probability."""
        return stopped_level(level) if self.stopped else level

    def worth(self, hits: Integers, used: Integers, level: float) -> Floats:
        """Return the number of independent draws (groups,) that a rate is worth.

        Of trials it is `Sample.draws`. Of photographs and replicates it is p (1 - p) over the
        variance of the ratio of sums (`ratio_terms`), times (z / t)² for the units' degrees of
        freedom: Korn and Graubard, "Confidence intervals for proportions with small expected number
        of positive counts estimated from survey data", Survey Methodology 24, 1998. If successes or
        failures are too few to tell how they spread, it is no more than the number of draws.

        Parameters
        ----------
        hits, used
            Numbers of successes and of poses that count (groups, cells, draws).
        level
            Of the interval.
        """
        sample = Sample(used)
        if self.unit == "trial":
            return sample.draws.astype(np.float64)
        n, successes = sample.n.astype(np.float64), hits.sum(axis=(1, 2), dtype=np.float64)
        of_points = self.unit == "replicate"
        tail = (1.0 - level) / 2.0
        with np.errstate(all="ignore"):
            rate = successes / n
            counted = np.ones_like(used, dtype=bool) if of_points else used > 0
            units, m2 = ratio_terms(hits, used, rate, counted)
            variance = (m2 * units / (units - 1.0)).sum(axis=1) / n**2
            freedom = np.maximum(units.max(axis=1, initial=0.0) - 1.0, 1.0)
            shrink = (special.ndtri(tail) / special.stdtrit(freedom, tail)) ** 2
            binomial = rate * (1.0 - rate)
            draws: Floats | Integers = n / self.points if of_points else sample.draws
            if of_points:
                # The spread between replicates of p points is no finer than a point.
                variance = np.maximum(
                    variance, binomial / (draws * np.maximum(draws / REPLICATES, 1.0)))
                few = np.minimum(successes, n - successes) < 2 * REPLICATES * self.points
            else:
                few = np.minimum(*((each > 0).sum(axis=(1, 2)) for each in (hits, used - hits))
                                 ) < MIN_SPREAD
            worth = np.fmin(shrink * binomial / variance, MAX_DRAWS if of_points else n)
            worth = np.where(few, np.fmin(worth, draws), worth)
        return np.where(n > 0, np.maximum(np.nan_to_num(worth, nan=1.0), 1.0), 0.0)


@dataclass(frozen=True)
class Sample:
    """The poses that count, and the draws that they are of.

    ``used`` (groups, cells, draws) is the number of settings of each draw that count.
    """

    used: Integers

    @functools.cached_property
    def n(self) -> Integers:
        """Poses (groups,), times pooled settings."""
        return np.asarray(self.used.sum(axis=(1, 2), dtype=np.int64))

    @functools.cached_property
    def draws(self) -> Integers:
        """Number of draws (groups,) that the poses are worth.

        That is the number of draws with a pose that counts if each has equally many of them; else
        it is less, for those with more of them count more: the effective sample size,
        (Σ m)² / Σ m² of m poses a draw, rounded down (Kish, "Survey Sampling", 1965, section 11.7).
        """
        squares = np.einsum("gcd,gcd->g", self.used, self.used, dtype=np.float64)
        return whole(self.n.astype(np.float64) ** 2 / np.maximum(squares, 1.0))

    @functools.cached_property
    def freedom(self) -> Integers:
        """Degrees of freedom (groups,): the draws beyond the first of each cell."""
        return np.asarray(np.maximum((self.used > 0).sum(axis=2) - 1, 0).sum(axis=1))

    @functools.cached_property
    def drawn(self) -> Masks:
        """Whether any cell has two draws, so that intervals exist; (groups,)."""
        return np.asarray(self.freedom > 0)


def whole(draws: Floats) -> Integers:
    """Return numbers of draws rounded down, but for what rounding took from them."""
    return np.asarray(np.floor(draws * (1.0 + 1e-12)), dtype=np.int64)


def scaled_to_draws(hits: Integers, n: Integers, draws: Integers) -> tuple[Integers, Integers]:
    """Return ``hits`` of ``n`` poses as hits of draws, rounded down and up.

    Examples
    --------
    >>> [int(each) for each in scaled_to_draws(np.int64(5), np.int64(8), np.int64(4))]
    [2, 3]
    """
    n = np.maximum(n, 1)
    return hits * draws // n, -(-hits * draws // n)


# --------------------------------------------------------------------------------------------------
# The estimator: a mean is a ratio of two sums over a stratified sample of clusters.
#
# The cells are the strata and the draws the clusters: R = Σ v / Σ n, v and n being a draw's sums of
# values and of what counts. Its error is that of the sum of e = v - R n over Σ n, each cell's
# variance from its own draws: Cochran, "Sampling Techniques", 3rd ed. 1977, sections 3.12, 6.11 and
# 5A.14. If all draws count it is the sum of n_c s_c² over n²; if some do not, it includes that
# which ones do is random. Lengths, standard deviations and ratios are linear in such sums to first
# order, so that they have residuals e, too.

class MeanEstimate(NamedTuple):
    """Means, their standard errors, and the degrees of freedom of these, each (groups,)."""

    mean: Floats
    error: Floats
    freedom: Floats


def ratio_terms(
    values: NDArray[Any], used: Integers, ratio: Floats, counted: Masks
) -> tuple[Integers, Floats]:
    """Return the number of draws and their residuals' sum of squared deviations, (groups, cells).

    ``values``, ``used`` and the draws that are ``counted`` are (groups, cells, draws), the ratio of
    the sums of both is (groups,).
    """
    units = counted.sum(axis=2)

    def squares(start: int) -> Floats:
        cut = np.s_[:, start : start + step]
        with np.errstate(all="ignore"):
            rests = zero_unless(counted[cut], values[cut] - ratio[:, None, None] * used[cut])
            rests -= (rests.sum(axis=2) / np.maximum(units[cut], 1))[..., None]
            return np.asarray(np.square(zero_unless(counted[cut], rests)).sum(axis=2))

    # Some cells at a time stay in the processor's cache.
    groups, cells, draws = counted.shape
    step = max(MAX_BLOCK // max(groups * draws, 1), 1)
    return units, np.concatenate(in_threads(squares, range(0, max(cells, 1), step)), axis=1)


#: Value, low and high, each (groups,).
Interval = tuple[Floats, Floats, Floats]


def half_width(estimate: MeanEstimate, level: float) -> Floats:
    """Return half the width of Student's interval."""
    return np.asarray(estimate.error * special.stdtrit(estimate.freedom, (1.0 + level) / 2.0))


def symmetric(estimate: MeanEstimate, level: float) -> Interval:
    """Return Student's interval of means."""
    half = half_width(estimate, level)
    return estimate.mean, estimate.mean - half, estimate.mean + half


#: Errors that no draw showed are taken to be at most so many times as large as the largest seen.
#:
#: The first is that of intervals: they then cover a root mean square with 0.94 to 0.98, also of
#: Student's t with 4 degrees of freedom and of lognormal errors, with 0.84 to 0.90 without (`pytest
#: -m evidence tests/analysis/test_coverage.py`). The second is that of decisions: on draws whose
#: worst 1 % carries half of the squares, and on those errors, a root mean square at its limit is
#: met in less than 5 % of the samples of 50, 100 and 400; without, in up to 49 % (`pytest -m
#: evidence tests/analysis/test_requirements_at_the_limit.py`).
UNSEEN_FACTOR, GUARDED_UNSEEN_FACTOR = 1.0, 2.0


# --------------------------------------------------------------------------------------------------
# A statistic of poses: a record that says what of the blocks it needs, and the variables it gives.
#
# All intervals are at 95 %, over the random draws, conditional on the grid; NaN if no cell has
# two draws that count.

class Output(NamedTuple):
    """A variable that a statistic gives."""

    name: str
    meaning: str
    units: str
    dtype: str = "f8"
    dims: tuple[str, ...] = ()


#: Endings of names, of a value and of its interval's ends, with what meanings begin with.
INTERVAL = {"": "", "_low": "lower end of the 95 % interval: ",
            "_high": "upper end of the 95 % interval: "}


def with_interval(name: str, meaning: str, units: str) -> list[Output]:
    """Return a variable and the ends of its interval."""
    return [Output(f"{name}{end}", words + meaning, units) for end, words in INTERVAL.items()]


@dataclass(frozen=True)
class Statistic(ABC, Generic[ViewT]):
    """A statistic of poses; generic over the view of them.

    Attributes
    ----------
    name, meaning, units
        Of the variable of its value.
    level
        Probability with which the interval is to hold the value.
    unseen_factor
        Of upper ends of mean squares, as in `PositiveMean`.
    inputs
        Names of the arrays that it reads, as in `sweep.analysis.dataset.pose_arrays`.
    """

    name: str
    meaning: str
    _: KW_ONLY
    units: str = "1"
    level: float = LEVEL
    unseen_factor: float = UNSEEN_FACTOR
    inputs: tuple[str, ...] = ()

    def outputs(self) -> Sequence[Output]:
        """Return the variables that it gives: by default a value and its interval."""
        return with_interval(self.name, self.meaning, self.units)

    @abstractmethod
    def arrays(self, columns: Columns[ViewT], design: Design) -> Sequence[NDArray[Any]]:
        """Return `outputs`, each (groups,), of poses whose draws are of a design."""


def guarded(statistic: Statistic[ViewT]) -> Statistic[ViewT]:
    """Return a statistic with the interval by which something is decided.

    Upper ends of means of squares then hold rare errors that are larger than all that was seen.
    """
    return replace(statistic, unseen_factor=GUARDED_UNSEEN_FACTOR)


# --------------------------------------------------------------------------------------------------
# Counts of poses, and rates of them with intervals of a binomial proportion.

@dataclass(frozen=True)
class Count(Statistic[ViewT]):
    """How many poses there are of a kind.

    With names for these also the ``draws`` that they are worth, and whether intervals exist:
    ``drawn``.
    """

    of: Callable[[ViewT], Masks]
    draws: str = ""
    drawn: str = ""

    def outputs(self) -> Sequence[Output]:
        """Return the variables."""
        count = Output(self.name, self.meaning, "1", "i8")
        return [count, Output(self.draws, "random draws that the intervals are of", "1", "i8"),
                Output(self.drawn, "whether any cell has two draws", "1", "?")
                ] if self.draws else [count]

    def arrays(self, columns: Columns[ViewT], design: Design) -> Sequence[NDArray[Any]]:  # noqa: ARG002
        """Return the counts."""
        sample = Sample(*columns.by_draw(lambda poses, _: [self.of(poses)]))
        return [sample.n, sample.draws, sample.drawn] if self.draws else [sample.n]


@dataclass(frozen=True)
class Rate(Statistic[ViewT]):
    """The share of ``used`` that are ``successes``, with an interval of a level.

    It is Wilson's, or Clopper and Pearson's if it is to be ``exact``, or sampling was stopped.

    n of the interval is the number of draws that the rate is worth (`Design.worth`), and the
    successes are rounded outwards to whole draws. It is a little wide if the cells' rates differ.
    """

    successes: Callable[[ViewT], Masks]
    used: Callable[[ViewT], Masks]
    #: Names and meanings for the numbers of ``used`` and of ``successes``, if they are wanted.
    counts: Sequence[tuple[str, str]] = ()
    exact: bool = False

    def outputs(self) -> Sequence[Output]:
        """Return the rate, its interval, and the counts that are asked for."""
        counted = [*self.counts, ("draws", "random draws that the interval is of")]
        return [*(Output(*each, "1", "i8") for each in counted if self.counts), *super().outputs()]

    def worth(
        self, columns: Columns[ViewT], design: Design, level: float
    ) -> tuple[Sample, Integers, Integers]:
        """Return the poses that count, the successes and the draws, (groups,), that they are worth.

        ``level`` is that of the interval.
        """
        def masks(poses: ViewT, _: slice) -> list[Masks]:
            used = self.used(poses)
            return [self.successes(poses) & used, used]

        hits, used = columns.by_draw(masks)
        return Sample(used), Sample(hits).n, whole(design.worth(hits, used, level))

    def arrays(self, columns: Columns[ViewT], design: Design) -> Sequence[NDArray[Any]]:
        """Return the counts, the rate and its intervals."""
        level = design.level(self.level)
        sample, hits, draws = self.worth(columns, design, level)
        interval = clopper_pearson if self.exact or design.stopped else wilson
        ends = [np.where(sample.drawn, end, np.nan)
                for end in outward(interval, hits, sample.n, draws, level)]
        counts = [sample.n, hits][: len(self.counts)] + [draws] * bool(self.counts)
        with np.errstate(invalid="ignore"):
            return [*counts, hits / sample.n, *ends]


def outward(
    interval: Callable[..., tuple[Floats, Floats]], hits: Integers, n: Integers, draws: Integers,
    level: float,
) -> tuple[Floats, Floats]:
    """Return the interval of ``hits`` of ``n`` poses that are worth ``draws``.

    The hits are rounded to whole draws, for each end to its side.
    """
    fewest, most = scaled_to_draws(hits, n, draws)
    return interval(fewest, draws, level)[0], interval(most, draws, level)[1]


# --------------------------------------------------------------------------------------------------
# Means of poses' values with their intervals: bias, standard deviation, root mean square.

class Sums(NamedTuple):
    """The sums of each draw that a mean needs.

    Attributes
    ----------
    run
        Whether the draw was run (groups, cells, draws).
    values
        Sums of the values (groups, cells, draws, components).
    used
        How many count (groups, cells, draws).
    largest
        The largest first component (groups, cells, draws); -inf of none; where it is asked for.
    """

    run: Masks
    values: Floats
    used: Integers
    largest: Floats = np.empty(0)

    @property
    def mean(self) -> Floats:
        """Mean values (groups, components)."""
        with np.errstate(all="ignore"):
            return np.asarray(self.values.sum(axis=(1, 2)) / Sample(self.used).n[:, None])

    def estimate(self, mean: Floats, values: Floats) -> MeanEstimate:
        """Return a mean (groups,), ``values`` (groups, cells, draws) being the draws' sums.

        A cell with a single draw has no variance of its own and gets the pooled one. The degrees of
        freedom are Welch's (Biometrika 34, 1947, the form with f + 2): a few cells with the largest
        errors can make most of the variance. They are at most `Sample.freedom`; 0 of these:
        standard error NaN.
        """
        n, most = Sample(self.used).n, Sample(self.used).freedom
        with np.errstate(all="ignore"):
            units, m2 = ratio_terms(values, self.used, mean, self.run)
            rest, m2 = np.maximum(units - 1.0, 0.0), np.where(units > 1, m2, 0.0)
            terms = (rest + 1.0) * m2 / np.maximum(rest, 1.0)  # n_c s_c²
            variance = terms.sum(axis=1)
            welch = variance**2 / (terms**2 / (rest + 2.0)).sum(axis=1) - 2.0
            single = (units == 1).sum(axis=1)
            pooled = single * m2.sum(axis=1) / rest.sum(axis=1)
            variance = variance + np.where(single > 0, pooled, 0.0)
            degrees = np.where(most > 0, np.fmin(most, welch), np.nan)
            error = np.where(most > 0, np.sqrt(variance) / n, np.nan)
        return MeanEstimate(np.where(n > 0, mean, np.nan), error, degrees)


@dataclass(frozen=True)
class Mean(Statistic[ViewT]):
    """A mean of values, (groups, cells, draws, settings, components), with Student's interval.

    Values that are NaN do not count.
    """

    values: Callable[[ViewT], Floats]
    used: Callable[[ViewT], Masks]

    def arrays(self, columns: Columns[ViewT], design: Design) -> Sequence[NDArray[Any]]:
        """Return the mean and its interval."""
        return self.interval(columns, design, design.level(self.level))

    def interval(self, columns: Columns[ViewT], design: Design, level: float) -> Interval:  # noqa: ARG002
        """Return value, low and high."""
        sums = self.sums(columns)
        columns.means[self.values, self.used] = mean = sums.mean
        return symmetric(sums.estimate(mean[:, 0], sums.values[..., 0]), level)

    def sums(
        self, columns: Columns[ViewT], centre: Floats | None = None, *, largest: bool = False
    ) -> Sums:
        """Return the values of each draw, or their squared distances to a centre.

        ``centre`` is (groups, components). ``largest``: with the largest value of each draw.
        """
        def parts(poses: ViewT, groups: slice) -> Sequence[NDArray[Any]]:
            values = self.values(poses)
            missing = functools.reduce(
                np.logical_or, (np.isnan(values[..., k]) for k in range(values.shape[-1])))
            used = np.asarray(self.used(poses) & ~missing)
            if centre is not None:
                values = norm_squared(values - centre[groups, None, None, None])[..., None]
            sums = [zero_unless(used[..., None], values), used]
            if largest:
                sums.append(np.where(used, values[..., 0], -np.inf).max(
                    axis=3, initial=-np.inf)[..., None])
            return sums

        return Sums(columns.run, *columns.by_draw(parts))


class MeanLength(Mean[ViewT]):
    """The length of the mean of vectors, with an interval of at least 0.

    Along its own direction the mean vector is a plain mean, and the upper end is Student's. The
    mean's length grows by chance, so the lower end is Scheffé's: the length minus
    sqrt(k d / (d - k + 1) · F(k, d - k + 1)) standard errors, k components, d degrees of freedom.
    By the Cauchy-Schwarz inequality this holds a bias of 0 whenever Hotelling's T² does, in 95 %
    at least. With 50 normal errors of 3 components it covers 0.97 (a large bias) to 0.995 (a bias
    of its error).
    """

    def interval(self, columns: Columns[ViewT], design: Design, level: float) -> Interval:  # noqa: ARG002
        """Return value, low and high."""
        sums = self.sums(columns)
        columns.means[self.values, self.used] = mean = sums.mean
        components = mean.shape[1]
        length = np.linalg.norm(mean, axis=1)
        with np.errstate(all="ignore"):
            direction = np.where(
                length[:, None] > 0.0, mean / length[:, None], np.eye(1, components))
        estimate = sums.estimate(length, np.einsum("gcdk,gk->gcd", sums.values, direction))
        length, low, high = symmetric(estimate, level)
        rest = estimate.freedom - (components - 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            reach = np.sqrt(
                components * estimate.freedom / rest * special.fdtri(components, rest, level))
            low = np.where(rest > 0.0, np.fmax(0.0, length - reach * estimate.error), 0.0)
        return length, np.where(np.isnan(estimate.error), np.nan, low), high


class RootMeanSquareRatio(Mean[ViewT]):
    """The root of the ratio of two means of squares, of the same poses: components 1 over 0.

    Its interval is Student's of the logarithm, by the delta method.
    """

    def interval(self, columns: Columns[ViewT], design: Design, level: float) -> Interval:  # noqa: ARG002
        """Return value, low and high."""
        sums = self.sums(columns)
        mean = sums.mean
        with np.errstate(all="ignore"):
            shares = sums.values / mean[:, None, None]
            difference = sums.estimate(np.zeros(len(mean)), shares[..., 1] - shares[..., 0])
            factor = np.exp(half_width(difference, level) / 2.0)
            ratio = np.sqrt(mean[:, 1] / mean[:, 0])
            return ratio, ratio / factor, ratio * factor


class PositiveMean(Mean[ViewT]):
    """The mean of squares, or of other values that are not negative.

    Its interval is Student's of the logarithm, by the delta method, and the upper end also holds
    rare large values that the draws did not show.

    A sample without outliers says nothing of their size, but it bounds their share: with
    probability 1 - a, a = (1 - level) / 2, less than p = 1 - a^(1/n) of the population is of a
    kind that none of n draws is of (Clopper and Pearson's end without a success; over cells the
    geometric mean of the shares seen is at most the arithmetic one, so that it holds there, too).
    Errors of that share are taken to be at most ``unseen_factor`` times as large as the largest
    that was seen. That is an assumption: no sample can tell. It lets the end be a p-th part of the
    square of that and a (1 - p)-th part of the end for the draws that were seen.

    The end of 100 normal errors of one component is then 1.24 times their root mean square, 1.11
    times of 400 (1.15 and 1.07 without); with the factor of decisions 1.5 and 1.2 times.
    """

    def arrays(self, columns: Columns[ViewT], design: Design) -> Sequence[NDArray[Any]]:
        """Return the mean and its interval: what may be unseen widens it for a stop, too."""
        return self.interval(columns, design, self.level)

    def interval(self, columns: Columns[ViewT], design: Design, level: float) -> Interval:
        """Return value, low and high."""
        of_points = design.unit == "replicate"
        sums = self.scores(columns, largest=of_points)
        sample = Sample(sums.used)
        # A draw with all its poses may be unseen, or a point of the replicates.
        draws: Floats | Integers = sample.n / design.points if of_points else sample.freedom + 1
        with np.errstate(all="ignore"):  # NaN of a draw of which none counts
            most = np.fmax.reduce(
                sums.largest if of_points else sums.values[..., 0] / sums.used,
                axis=(1, 2), initial=-np.inf)
        estimate = sums.estimate(sums.mean[:, 0], sums.values[..., 0])
        value, low, high = symmetric(estimate, level)
        with np.errstate(all="ignore"):
            factor = np.exp(half_width(estimate, level) / value)
            low = np.where(value == 0.0, low, value / factor)
            high = np.where(value == 0.0, high, value * factor)
            share = -np.expm1(np.log((1.0 - level) / 2.0) / draws)
            end = (1.0 - share) * high + share * self.unseen_factor**2 * most
        return value, low, np.where(np.isfinite(most), np.fmax(high, end), high)

    def scores(self, columns: Columns[ViewT], *, largest: bool) -> Sums:
        """Return the sums whose mean is taken, ``largest`` as for `sums`."""
        return self.sums(columns, largest=largest)


class RootMeanSquare(PositiveMean[ViewT]):
    """The root of the mean of squares, which are the values.

    Squares are skewed, and a mean square's error goes with its size: Student's interval is right
    for the logarithm. With 50 errors in 1, 5 or 25 cells, normal, of Laplace or Student's t with 4
    degrees of freedom, it covers 0.945 to 0.99; of lognormal ones 0.88 to 0.96, with 100 0.93 to
    0.97; with 13 to 54 photographs whose errors have an intraclass correlation of 0.1 to 0.7, 0.94
    to 0.985.
    """

    def interval(self, columns: Columns[ViewT], design: Design, level: float) -> Interval:
        """Return value, low and high."""
        value, low, high = map(np.sqrt, super().interval(columns, design, level))
        return value, low, high


class StandardDeviation(RootMeanSquare[ViewT]):
    """The root of the summed variances of a vector's components about their mean (n - 1)."""

    def scores(self, columns: Columns[ViewT], *, largest: bool) -> Sums:
        """Return the sums of squared distances to the mean, each times n / (n - 1)."""
        centre = columns.means.get((self.values, self.used))  # of the bias
        centre = self.sums(columns).mean if centre is None else centre
        sums = self.sums(columns, centre, largest=largest)
        n = Sample(sums.used).n[:, None, None]
        with np.errstate(all="ignore"):
            factor = n / (n - 1.0)
            np.multiply(sums.values, factor[..., None], out=sums.values)
            return sums._replace(largest=sums.largest * factor) if largest else sums


# --------------------------------------------------------------------------------------------------
# Root mean square of errors of which rare flips make most: an interval that counts unseen ones.
#
# With 2 % flips of 60 degrees among errors of half a degree the mean square is nearly that of the
# flips alone, and a third of all samples of 50 has none of them: whatever is computed from such a
# sample alone says nothing of the mean square. What bounds it is how many flips the sample may
# have missed, and that no rotation error is larger than half a turn.

#: The share of flips among the solved.
FLIP_RATE: Rate[Poses] = Rate(
    "flip_rate", "nearer to the mirror of the truth, of solved", lambda poses: poses.flipped,
    lambda poses: poses.solved, inputs=dataset.ESTIMATE_INPUTS)


@dataclass(frozen=True)
class FlipMixture(Statistic[Poses]):
    """The root mean square over solved poses, with an interval that holds if flips are rare.

    The mean square is (1 - p) u + p v: p the share of flips, u the mean square of the other poses,
    v that of the flips. The interval's ends are the least and the largest value over the ends of
    p (Clopper and Pearson, Biometrika 26, 1934), u and v (`PositiveMean`), each right with 97.5 %
    at either end. Where v has no upper end, or one beyond it, ``bound`` takes its place.

    With 1, 2 and 5 % flips of 60 degrees among errors of half a degree it covers 0.97 to 1.00 from
    50 draws on. Without a flip in 50 draws the upper end is 48 degrees, in 1,000 draws 11, in
    10^6 draws 0.6: there are samples without flips of populations with such a mean square.
    """

    squares: Callable[[Poses], Floats]
    #: The solved poses.
    used: Callable[[Poses], Masks]
    #: The largest error that exists, in the unit of the errors.
    bound: float

    def arrays(self, columns: Columns[Poses], design: Design) -> Sequence[NDArray[Any]]:
        """Return the root mean square and its interval."""
        level = design.level(self.level)

        mean = functools.partial(
            PositiveMean[Poses], "", "", self.squares, unseen_factor=self.unseen_factor)
        square = mean(self.used).sums(columns).mean[:, 0]
        _, u_low, u_high = mean(lambda poses: poses.unflipped).interval(columns, design, level)
        _, v_low, v_high = mean(lambda poses: poses.flipped).interval(columns, design, level)
        lows = [np.nan_to_num(np.where(np.isnan(one), other, one), nan=0.0)
                for one, other in ((u_low, v_low), (v_low, u_low))]
        highs = [np.fmin(high, self.bound**2) for high in (u_high, v_high)]
        sample, hits, draws = FLIP_RATE.worth(columns, design, LEVEL)
        shares = outward(clopper_pearson, hits, sample.n, draws, level)
        low = np.minimum(*((1 - share) * lows[0] + share * lows[1] for share in shares))
        high = np.maximum(*((1 - share) * highs[0] + share * highs[1] for share in shares))
        # Sums are rounded: the value lies in its interval.
        ends = [np.where(sample.drawn, each, np.nan)
                for each in (np.fmin(low, square), np.fmax(high, square))]
        return [np.sqrt(each) for each in (square, *ends)]


# --------------------------------------------------------------------------------------------------
# Quantiles of errors, exact, with rank intervals.

PERCENTS = {"median": 50, "p95": 95, "p99": 99}


#: Values of a column that are sorted at once: 1.6 GB.
MAX_VALUES = 2 * 10**8

#: Share of a pose by which a rank may be above a whole number.
ROUNDING = 1e-9


def values_at(ascending: NDArray[Any], ranks: Integers) -> Floats:
    """Return the values (groups, ...) at ranks from 1; NaN for those that do not exist."""
    exists = (ranks >= 1) & (ranks <= ascending.shape[1])
    if not ascending.size:
        return np.full(ranks.shape, np.nan)
    values = np.take_along_axis(ascending, np.where(exists, ranks - 1, 0), axis=1)
    return np.where(exists, values, np.nan).astype(np.float64)


def quantile_intervals(
    errors: NDArray[Any], used: Integers, percents: Sequence[int], design: Design,
    level: float = LEVEL,
) -> Floats:
    """Return quantiles and the ends of their intervals, (groups, percents, 3).

    A quantile is the smallest value with at least that share at or below. An end is NaN where it
    lies beyond all values, and where no cell has two draws.

    The ends are order statistics of the pooled sample: David and Nagaraja, "Order Statistics", 3rd
    ed. 2003, section 7.1. If cells differ, the count below the quantile varies less than binomially
    (Hoeffding, Annals of Mathematical Statistics 27, 1956): they then cover more. Ranks are counted
    in draws. Of photographs, whose markers are correlated, they are Woodruff's: the quantiles at
    the ends of the interval of the share below the quantile (Journal of the American Statistical
    Association 47, 1952), Clopper and Pearson's of the number of draws that the share is worth
    (Korn and Graubard, Survey Methodology 24, 1998).

    Parameters
    ----------
    errors
        (groups, cells, draws, settings); NaN for those that do not count.
    used
        How many count of each draw, (groups, cells, draws).
    percents
        Of the values, at or below the quantile.
    design
        The design of the draws.
    level
        Probability with which the interval is to hold it.
    """
    sample, tail = Sample(used), (1.0 - level) / 2.0
    ascending = np.sort(errors.reshape(len(errors), math.prod(errors.shape[1:])), axis=1)
    n, drawn, draws = sample.n, sample.drawn, np.maximum(sample.draws, 1)
    counts, place = np.unique(draws, return_inverse=True)
    values = np.full((len(n), len(percents), 3), np.nan)
    for at, percent in enumerate(percents):
        ranks, share = np.zeros((len(n), 3), dtype=np.int64), percent / 100.0
        ranks[:, 0] = -(-n * percent // 100)
        if design.unit == "photograph":
            value = values_at(ascending, ranks[:, :1])
            below = sum_of_settings(errors <= value.reshape(-1, 1, 1, 1))
            worth = design.worth(below, used, level)
            low = special.betaincinv(share * worth, (1.0 - share) * worth + 1.0, tail)
            high = special.betaincinv(share * worth + 1.0, (1.0 - share) * worth, 1.0 - tail)
            ranks[:, 1] = np.ceil(np.nan_to_num(low) * n - ROUNDING)
            ranks[:, 2] = np.floor(np.nan_to_num(high) * n + ROUNDING) + 1
        else:
            # The ranks of draws, from 1, beyond each of which it lies with a tail at most; 0 and
            # one beyond the last stand for ends that the sample does not have.
            first, last = (stats.binom.ppf(end, counts, share).astype(np.int64)[place]
                           for end in (tail, 1.0 - tail))
            ranks[:, 1] = first * n // draws
            ranks[:, 2] = np.where(last < draws, -(-(last + 1) * n // draws), n + 1)
        ranks[:, 1:] = np.where(drawn[:, None], ranks[:, 1:], 0)
        values[:, at] = values_at(ascending, ranks)
    return values


@dataclass(frozen=True)
class Quantiles(Statistic[ViewT]):
    """The quantiles of `PERCENTS` of the errors of ``used`` poses; not ``solved`` is infinite.

    The values of a column are in memory at once, up to `MAX_VALUES` of a group, in single precision
    as errors are stored. Intervals: `quantile_intervals`. The name has {} in place of the
    statistic, such as ``rotation_{}_deg``.
    """

    errors: Callable[[ViewT], Floats]
    solved: Callable[[ViewT], Masks]
    used: Callable[[ViewT], Masks]

    def outputs(self) -> Sequence[Output]:
        """Return the quantiles and their intervals."""
        return [output for statistic, percent in PERCENTS.items() for output in with_interval(
            self.name.format(statistic),
            f"{percent} % quantile of the {self.meaning}, not solved = infinite", self.units)]

    def arrays(self, columns: Columns[ViewT], design: Design) -> Sequence[NDArray[Any]]:
        """Return the quantiles and their intervals."""
        def values(poses: ViewT, _: slice) -> list[NDArray[np.float32]]:
            errors = self.errors(poses)
            known = self.solved(poses) & ~np.isnan(errors)
            errors = np.where(self.used(poses), np.where(known, errors, np.inf), np.nan)
            with np.errstate(over="ignore"):  # above 3.4e38: infinite
                return [errors.astype(np.float32)]

        if columns.poses > MAX_VALUES:
            raise DatasetError(
                f"quantiles of {columns.poses:,} poses at once: expected at most {MAX_VALUES:,}; "
                "divide them: keep an axis apart (per=), or take a part of the dataset (isel) for "
                "each condition")
        used, = columns.by_draw(lambda poses, _: [self.used(poses)])
        errors, = columns.joined(values)
        found = quantile_intervals(
            errors, used, [*PERCENTS.values()], design, design.level(self.level))
        return [*found.reshape(len(found), -1).T]


def draws_to_see(share: float, level: float = LEVEL) -> int:
    """Return the least number of draws that show what has a share of the population.

    None of them is of that kind with a probability of (1 - level) / 2 at most. So many the interval
    of a quantile needs for an upper end, ``share`` being what lies above it, and that of a rate
    without a failure to exclude it.

    >>> draws_to_see(1.0 - 0.95)
    72
    """
    return math.ceil(math.log((1.0 - level) / 2.0) / math.log1p(-share))


# --------------------------------------------------------------------------------------------------
# Bins of a variable of the scene, as a dimension of a table.

#: Edges of bins, by the name of the variable or coordinate that is binned.
Bins = Mapping[str, Sequence[float]]

#: Prefix of the name of a binned array, among a block's arrays.
PREFIX = "bin "

#: Edges (n + 1,) of the bins [low, high), by the name of what is binned.
Edges = Mapping[str, Floats]


def read_bins(results: xr.Dataset, kept: Sequence[str], bins: Bins) -> Edges:
    """Return the edges of bins of a dataset's variables or coordinates.

    Raises
    ------
    ArgumentError
        For bins of a variable that does not exist or is not one number for each scene, and for
        edges that do not increase.
    """
    if not isinstance(bins, Mapping):
        raise ArgumentError("bins", bins, "expected names with edges, such as "
                            '{"marker_area_px": [0, 100, 1000]}')
    edges: dict[str, Floats] = {}
    for name in bins:
        if name not in results.variables or name in kept:
            possible = [str(other) for other, variable in results.variables.items()
                        if variable.dtype.kind == "f" and other not in kept]
            raise ArgumentError("bins", name, f"no such variable; there are {', '.join(possible)}")
        array = results[name]
        scalar = name in results.coords and not array.dims
        if array.dtype.kind not in "fiu" or scalar or any(dim in LABELS for dim in array.dims):
            raise ArgumentError("bins", name, "expected a variable of one number for each scene")
        try:
            given = np.asarray(bins[name], dtype=np.float64)
        except (TypeError, ValueError):
            given = np.empty(0)
        if given.ndim != 1 or len(given) < 2 or not (given[1:] > given[:-1]).all():
            raise ArgumentError("bins", name, "expected at least two increasing edges")
        edges[name] = given
    return edges


def in_bins(columns: Arrays, edges: Edges, design: Design) -> Iterator[Arrays]:
    """Yield the columns of each combination of bins, with the mask of the poses inside.

    Cells without a pose inside are left out, and trials: each cell has its own, those with a pose
    inside first. Replicates count in any case, and photographs keep their places.
    """
    # Of values at the last edge and beyond, and of NaN, it is the number of bins.
    numbers = [np.searchsorted(each, columns.pop(f"{PREFIX}{name}"), side="right").astype(np.int32)
               - 1 for name, each in edges.items()]
    for index in np.ndindex(*(len(each) - 1 for each in edges.values())):
        inside = np.logical_and.reduce([a == b for a, b in zip(numbers, index, strict=True)])
        cells, = inside.any(axis=(0, 2, 3)).nonzero()
        seen = inside.any(axis=3) | (design.unit != "trial")
        most = seen.sum(axis=2).max(initial=1)
        draws = np.argsort(~seen[:, cells], axis=2, kind="stable")[..., :most].astype(np.int32)
        part, at = {**columns, INSIDE: inside}, np.arange(len(draws))[:, None, None]
        # In memory the draws stay side by side, as `_column` arranges them.
        yield part if draws.size == inside[..., 0].size else {name: np.moveaxis(np.moveaxis(
            each, (0, 1, 2), (-3, -2, -1))[..., at, cells[:, None], draws].copy(), (-3, -2, -1),
            (0, 1, 2)) for name, each in part.items()}


def bin_coordinates(results: xr.Dataset, edges: Edges) -> dict[str, Any]:
    """Return the coordinates of bins: middles, lower and upper edges."""
    coordinates: dict[str, Any] = {}
    for name, each in edges.items():
        # Of a bin without an end the middle is its other end.
        finite = np.nan_to_num(each, neginf=each[1], posinf=each[-2])
        for label, values in ((name, (finite[:-1] + finite[1:]) / 2),
                              (f"{name}_low", each[:-1]), (f"{name}_high", each[1:])):
            coordinates[label] = (name, values, dict(results[name].attrs))
    return coordinates


# --------------------------------------------------------------------------------------------------
# Statistics of all poses of a dataset, by group: the one way to a table.

def aggregates(
    results: xr.Dataset, inputs: Mapping[str, xr.DataArray], kept: Sequence[str],
    sets: Sequence[Sequence[Statistic[ViewT]]], view: Callable[[Arrays], ViewT],
    bins: Bins | None = None, *, stopped: bool | None = None,
) -> list[xr.Dataset]:
    """Return a table of the poses of each combination of ``kept`` and of bins, for each set.

    Parameters
    ----------
    results
        The dataset whose coordinates and variables are kept and binned.
    inputs
        The arrays, by name, of which ``view`` makes the poses that the statistics read: once.
    kept
        The dimensions of the tables; all others are pooled.
    sets
        What to compute: the statistics of each table.
    view
        Makes the view from a block's arrays, (groups, cells, draws, settings, ...).
    bins
        Edges (n + 1,) of bins [low, high) of a variable or coordinate of the scene.
    stopped
        Whether sampling was stopped; by default what the dataset's attributes say.

    Returns
    -------
    list of xr.Dataset
        A variable (*kept, *bins) for each output, computed.

    Raises
    ------
    ArgumentError
        For bins that cannot be.
    """
    edges = read_bins(results, kept, bins or {})
    binned = {f"{PREFIX}{name}": results[name] for name in edges}
    columns, design = arranged(results, {**inputs, **binned}, kept, stopped=stopped)
    statistics = [*itertools.chain(*sets)]
    found: list[list[NDArray[Any]]] = []  # (bins, outputs, groups, ...)
    for part in in_bins(columns, edges, design) if edges else [columns]:
        groups, *rest = next(iter(part.values())).shape[:4]
        step = max(MAX_SHARED // max(math.prod(rest), 1), 1)  # groups at a time
        # One at a time: each keeps what it has computed of its poses.
        blocks = (Columns({name: each[start : start + step] for name, each in part.items()}, view)
                  for start in range(0, groups, step))
        found.append([np.concatenate(arrays) for arrays in zip(*(
            [array for statistic in statistics for array in statistic.arrays(block, design)]
            for block in blocks), strict=True)])
        del part  # before the next is made
    shape = (*(results.sizes[name] for name in kept), *(len(each) - 1 for each in edges.values()))
    coordinates = {name: value.variable for name, value in results.coords.items()
                   if set(value.dims) <= set(kept) and not dataset.is_fixed(value)}
    every = zip(*found, strict=True)
    return [xr.Dataset({
        output.name: (
            (*kept, *edges, *output.dims), np.stack(arrays, axis=1).reshape(
                (*shape, *arrays[0].shape[1:])).astype(output.dtype),
            cf_attributes(output.meaning, output.units))
        for statistic in some for output, arrays in zip(statistic.outputs(), every, strict=False)
    }, coordinates).assign_coords(bin_coordinates(results, edges)) for some in sets]


# Named dimensions are kept, all others are pooled. Of these, ``trial`` counts random draws; the
# other dimensions of camera, marker and pose make cells, a fixed grid; all others that are pooled
# (effects, levels, renderers, settings of detector and estimator, and names that are no
# parameter's) see the same draws (`sweep.experiment.draws`), so that their values together count
# as one draw. Replicates of Sobol' points stand in the place of draws.

def arranged(
    results: xr.Dataset, inputs: Mapping[str, xr.DataArray], kept: Sequence[str], *,
    stopped: bool | None = None,
) -> tuple[Arrays, Design]:
    """Return a dataset's columns (groups, cells, draws, settings, ...), and the draws' design."""
    stopped = dataset.stopping_rule(results) is not None if stopped is None else stopped
    if stopped:
        inputs = {COMMON: dataset.common_trials(results, inputs, kept), **inputs}
    sizes = {name: results.sizes[name] for name in kept}
    for array in inputs.values():
        sizes |= {str(dim): size for dim, size in array.sizes.items() if dim not in LABELS}
    pooled = [name for name in sizes if name not in kept]
    draws = [name for name in pooled if name == DRAWS]
    cells = [name for name in pooled if name != DRAWS and dataset.is_grid_axis(name, results)]
    settings = [name for name in pooled if name not in (*cells, *draws)]
    axes = [[*kept], cells, settings, draws]
    order = dataset.replicate_order(results, draws)
    unit: Unit = "replicate" if order is not None else (
        "photograph" if dataset.of_photographs(results) else "trial")
    return ({name: _column(array, axes, sizes, order) for name, array in inputs.items()},
            Design(unit, math.prod(sizes[name] for name in settings), stopped))


def _column(
    array: xr.DataArray, axes: Sequence[Sequence[str]], sizes: Mapping[str, int],
    order: NDArray[np.intp] | None,
) -> NDArray[Any]:
    """Return the values of an array, (groups, cells, draws, settings, ...).

    ``axes`` are the dimensions of groups, cells, settings and draws; ``order`` the indices of the
    trials by replicate, if they have such.
    """
    # In memory each component is by itself, and the draws of a setting are side by side: NumPy's
    # loops along a short last axis are slow. So arranged, nothing is copied once it is read.
    inner = {str(dim): size for dim, size in array.sizes.items() if dim not in sizes}
    dims = [dim for dim in (*inner, *itertools.chain(*axes)) if dim in array.dims]
    read: Any = xr.Variable(dims, np.empty([array.sizes[dim] for dim in dims], array.dtype))
    target = read.transpose(*array.dims).values
    try:
        # Of Dask a part at a time: together they would be in memory twice. Few parts, for each
        # looks through the names of all chunks. What is in memory has none, and is one part.
        ends = np.cumsum(array.chunks[0], dtype=int).tolist() if array.chunks else []
        ends = [0, *ends[: -1 : len(ends) // 16 or 1], *ends[-1:]]
        for part in [*itertools.starmap(slice, itertools.pairwise(ends))] or (...,):
            target[part] = array[part].to_numpy()
    except (RuntimeError, ValueError) as error:  # Zarr's, of a chunk that is damaged
        raise DatasetError(
            f"a store cannot be read: {error}; `sweep verify` names what is damaged") from None
    # Of dimensions that make an axis together an array has all, or is repeated along all.
    own = [axis if set(axis) & set(dims) else [] for axis in axes]
    values = read.set_dims({dim: {**inner, **sizes}[dim] for dim in (
        *inner, *itertools.chain(*own))}).to_numpy().reshape(*inner.values(), *(
            math.prod(sizes[dim] for dim in axis) for axis in own))
    values = np.broadcast_to(values, (*inner.values(), *(
        math.prod(sizes[dim] for dim in axis) for axis in axes)))
    values = np.moveaxis(values, range(len(inner), values.ndim), (0, 1, 3, 2))
    if order is None:
        return values
    # Of a replicate, all points and their settings together.
    return values[:, :, order].reshape((*values.shape[:2], REPLICATES, -1, *inner.values()))
