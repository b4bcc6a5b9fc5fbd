"""Statistics whose states merge: sums over chunks, and what is made of them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.lib.array_utils import normalize_axis_tuple
from numpy.typing import ArrayLike, NDArray

from sweep.plan.schema import cf_attributes
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Arrays whose first axis runs over groups of poses: several put together, some cells among all.

def interleaved(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return n arrays (groups, ...) as one (groups * n, ...), the n values of a group together.

    Examples
    --------
    >>> interleaved([np.array([1, 2]), np.array([10, 20])]).tolist()
    [1, 10, 2, 20]
    """
    stacked = np.stack(arrays, axis=1)
    return stacked.reshape(-1, *stacked.shape[2:])


def scattered(array: NDArray[Any], where: Masks, fill: float = 0.0) -> NDArray[Any]:
    """Return an array (groups, some cells) as one of all cells, ``fill`` for the others.

    Examples
    --------
    >>> scattered(np.array([[1, 2]]), np.array([True, False, True])).tolist()
    [[1, 0, 2]]
    """
    whole = np.full((len(array), len(where)), fill, dtype=array.dtype)
    whole[:, where] = array
    return whole


MAX_SLICES = 8
"""Settings up to which they are summed one by one: below 8 NumPy adds in the same order."""


def sum_of_settings(array: NDArray[Any]) -> NDArray[Any]:
    """Return the sums over the last axis of (groups, cells, draws, settings), bit for bit.

    NumPy's loop along a short last axis takes three times as long.

    Examples
    --------
    >>> sum_of_settings(np.array([[[[True, True], [False, True]]]])).tolist()
    [[[2, 1]]]
    """
    if not 0 < array.shape[3] < MAX_SLICES:
        return np.asarray(array.sum(axis=3))
    total = array[..., 0].astype(np.int64 if array.dtype.kind == "b" else array.dtype)
    for k in range(1, array.shape[3]):
        total += array[..., k]
    return total


# --------------------------------------------------------------------------------------------------
# Mean and variance of values that arrive in chunks, accurate to the last digits of a double.
#
# The values are taken as exact: at an offset of 1e9 doubles are 1.2e-7 apart, and the variance is
# that of these doubles.
#
# Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm for computing sample
# variances", Stanford STAN-CS-79-773, 1979, and "Algorithms for computing the sample variance:
# analysis and recommendations", The American Statistician 37(3), 1983.

_DTYPES = (np.dtype(np.int64), *(np.dtype(np.float64),) * 3)
"""Of the fields of `Moments`."""


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """Count, mean and sum of squared deviations of many series at once.

    All arrays have one shape, an element a series; ``mean`` and ``m2`` are in the unit of the
    values and its square. Arithmetic overflow never warns, it shows in the result:

    - No value: count 0, mean NaN, m2 0, variance NaN.
    - An infinite value: the mean is that infinity (NaN if both signs occur), m2 NaN.
    - Deviations above about 1e154 (their squares overflow): m2 infinite, the mean is right.
      A sum of values above 1.8e308: mean and m2 are not finite.
    - Deviations below about 1e-154 (their squares are denormal) lose digits of m2; below 1e-162
      it is 0. The mean is right.

    Raises ``ValueError`` if the shapes differ.

    >>> both = Moments.of([1.0, 2.0], axis=0).merge(Moments.of([6.0, np.nan], axis=0))
    >>> int(both.count), float(both.mean), float(both.variance)
    (3, 3.0, 7.0)
    """

    count: Integers  # values that are not NaN
    mean: Floats  # the double nearest to the mean
    mean_tail: Floats  # what the rounding of the mean left over: mean + mean_tail is the mean
    m2: Floats  # sum of the squared deviations from the mean

    def __post_init__(self) -> None:
        arrays = (self.count, self.mean, self.mean_tail, self.m2)
        shape = np.shape(self.mean)
        if all(type(array) is np.ndarray and array.dtype == dtype and array.shape == shape
               for array, dtype in zip(arrays, _DTYPES, strict=True)):
            return
        for name, dtype in (("count", np.int64), ("mean", np.float64),
                            ("mean_tail", np.float64), ("m2", np.float64)):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=dtype))
        shapes = {array.shape for array in (self.count, self.mean, self.mean_tail, self.m2)}
        if len(shapes) > 1:
            raise ValueError(f"count, mean, mean_tail and m2 must have one shape, not {shapes}")

    @classmethod
    def of(cls, values: ArrayLike, axis: int | tuple[int, ...] | None = None) -> Self:
        """Return the moments of ``values`` over ``axis`` (all axes by default), without the NaN.

        The corrected two-pass algorithm of Chan, Golub and LeVeque (1983), with the correction
        taken from each deviation instead of from their sum of squares: so m2 is never negative,
        and exactly 0 for equal values. Raises ``AxisError``, a ``ValueError``, for an axis that
        does not exist.
        """
        values = np.asarray(values, dtype=np.float64)
        over = normalize_axis_tuple(range(values.ndim) if axis is None else axis, values.ndim)
        kept = [dimension for dimension in range(values.ndim) if dimension not in over]
        size = math.prod(values.shape[dimension] for dimension in over)
        rows = values.transpose(*kept, *over)
        # NumPy sums pairwise along the last axis in memory only: the error then grows with log n.
        rows = np.ascontiguousarray(rows.reshape(*rows.shape[: len(kept)], size))
        missing = np.isnan(rows)
        some_missing = bool(missing.any())
        count = np.asarray(size - missing.sum(axis=-1))
        with np.errstate(all="ignore"):
            n = np.maximum(count, 1)
            filled = np.where(missing, 0.0, rows) if some_missing else rows
            centre = filled.sum(axis=-1) / n
            # In place, which is what takes least time.
            deviations = filled - centre[..., None]
            if some_missing:
                deviations[missing] = 0.0
            correction = deviations.sum(axis=-1) / n
            deviations -= correction[..., None]
            if some_missing:
                deviations[missing] = 0.0
            np.multiply(deviations, deviations, out=deviations)
            m2 = deviations.sum(axis=-1)
            mean, tail = _two_sum(centre, np.where(np.isfinite(centre), correction, 0.0))
        empty = count == 0
        return cls(count, np.where(empty, np.nan, mean), np.where(empty, 0.0, tail), m2)

    @property
    def variance(self) -> Floats:
        """Unbiased variance (ddof = 1); NaN of fewer than two values."""
        degrees = np.where(self.count < 2, np.nan, self.count - 1.0)
        return np.asarray(self.m2 / degrees)

    @property
    def standard_deviation(self) -> Floats:
        """Square root of ``variance``, in the unit of the values."""
        return np.asarray(np.sqrt(self.variance))

    @property
    def standard_error(self) -> Floats:
        """Standard deviation of the mean of independent values."""
        return np.asarray(np.sqrt(self.variance / np.maximum(self.count, 1)))

    def merge(self, other: Moments) -> Moments:
        """Return the moments of the values of both together; both of one shape.

        The pairwise formula of Chan, Golub and LeVeque (1979, 1983). Theirs sees the means rounded
        to doubles, which can cost the whole variance at an offset of 1e9 and a spread of 1e-3; here
        the mean keeps its tail. Empty moments change nothing. NaN and infinity as in `Moments`.
        Raises ``ValueError`` if the shapes differ.
        """
        a, b = self, other
        if a.mean.shape != b.mean.shape:
            raise ValueError(
                f"merge moments of one shape, not of {a.mean.shape} and {b.mean.shape}")
        swapped = b.count > a.count

        def larger_and_smaller(of_a: Any, of_b: Any) -> tuple[Any, Any]:
            return np.where(swapped, of_b, of_a), np.where(swapped, of_a, of_b)

        larger, smaller = larger_and_smaller(a.count, b.count)
        mean, other_mean = larger_and_smaller(a.mean, b.mean)
        tail, other_tail = larger_and_smaller(a.mean_tail, b.mean_tail)
        with np.errstate(all="ignore"):
            share = smaller / np.maximum(larger + smaller, 1)
            gap = np.where(smaller == 0, 0.0, (other_mean - mean) + (other_tail - tail))
            total, rest = _two_sum(mean, gap * share)
            total, rest = _two_sum(total, rest + tail)
            # A gap that is not finite: of infinite means, or of means above 9e307.
            weighted = mean * (1.0 - share) + other_mean * share
            total = np.where(np.isfinite(gap), total, weighted)
            m2 = a.m2 + b.m2 + gap * (gap * share) * larger
        return Moments(larger + smaller, total, rest, m2)

    @staticmethod
    def interleave(parts: Sequence[Moments]) -> Moments:
        """Return n moments (groups, ...) as one, (groups * n, ...); the n of a group together."""
        return Moments(
            interleaved([part.count for part in parts]), interleaved([part.mean for part in parts]),
            interleaved([part.mean_tail for part in parts]),
            interleaved([part.m2 for part in parts]))

    def every_nth(self, n: int, first: int) -> Moments:
        """Return the moments at ``first``, ``first + n`` and so on along the first axis."""
        return Moments(self.count[first::n], self.mean[first::n], self.mean_tail[first::n],
                       self.m2[first::n])


def _two_sum(a: Any, b: Any) -> tuple[Any, Any]:
    """Return a + b rounded and the rounding's error, exactly (Knuth 1969); 0 if not finite."""
    total = a + b
    of_b = total - a
    error = (a - (total - of_b)) + (b - of_b)
    return total, np.where(np.isfinite(total), error, 0.0)


# --------------------------------------------------------------------------------------------------
# States: what a statistic keeps of a block of poses, and how those of several blocks merge.
#
# A state is a frozen dataclass whose first axis runs over the groups. That of a block may also
# hold values of each cell, (groups, cells): it is merged over the blocks that share the cells
# (other draws), then folded to a state of the groups alone, and that is merged over the other
# blocks.

class Part(Protocol):
    """A value of a state that is not an array of sums: `Moments`, a `Tally`, another state."""

    def merge(self, other: Self) -> Self:
        """Return the value of the poses of both."""
        ...

    @staticmethod
    def interleave(parts: Sequence[Any]) -> Any:
        """Return the value of the groups of all, those of the last index fastest."""
        ...


@dataclass(frozen=True)
class State:
    """Base of all states: fields are arrays (groups, ...) that add up, or a `Part`."""

    def merge(self, other: Self) -> Self:
        """Return the state of the poses of both, of the same groups."""
        return type(self)(*map(_merge, self._values(), other._values()))

    @classmethod
    def interleave(cls, states: Sequence[Self]) -> Self:
        """Return n states of as many groups each as one; the n of a group stand together."""
        if len(states) == 1:
            return states[0]
        return cls(*map(_interleave, zip(*map(cls._values, states), strict=True)))

    def every_nth(self, n: int, first: int) -> Self:
        """Return the state of the groups ``first``, ``first + n`` and so on."""
        if n == 1:
            return self
        return type(self)(*(
            value[first::n] if isinstance(value, np.ndarray) else value.every_nth(n, first)
            for value in self._values()))

    def scatter(self, where: Masks) -> Self:
        """Return the state of some cells as that of all; ``where`` (cells,) marks those."""
        return type(self)(*(
            value.scatter(where) if isinstance(value, State) else value
            for value in self._values()))

    def fold(self) -> Any:
        """Return the state of the groups, the values of their cells put together."""
        return type(self)(*(
            value.fold() if isinstance(value, State) else value for value in self._values()))

    def _values(self) -> list[Any]:
        # The names of the fields; `dataclasses.fields` takes longer than to merge a small state.
        names: tuple[str, ...] = self.__match_args__
        return [getattr(self, name) for name in names]


def _merge(a: Any, b: Any) -> Any:
    return a + b if isinstance(a, np.ndarray) else a.merge(b)


def _interleave(values: Sequence[Any]) -> Any:
    first = values[0]
    return interleaved(values) if isinstance(first, np.ndarray) else type(first).interleave(values)


@dataclass(frozen=True)
class Nothing(State):
    """State of a pass that is not needed."""


# Draws.

@dataclass(frozen=True)
class CellDraws(State):
    """How many draws of each cell have a pose that counts."""

    draws: Integers  # (groups, cells)

    @classmethod
    def of(cls, settings: Integers) -> Self:
        """Return that of the number of settings that count, (groups, cells, draws)."""
        return cls((settings > 0).sum(axis=2))

    def scatter(self, where: Masks) -> Self:
        """Return the state of some cells as that of all."""
        return type(self)(scattered(self.draws, where))

    def fold(self) -> Integers:
        """Return the degrees of freedom (groups,): the draws beyond the first of each cell."""
        return np.asarray(np.maximum(self.draws - 1, 0).sum(axis=1))


Freedom = Any
"""Degrees of freedom (groups,): Integers; before a block is folded its `CellDraws`."""


@dataclass(frozen=True)
class Sample(State):
    """The poses that count, and the draws that they are of; each (groups,)."""

    n: Integers  # poses, times pooled settings
    squares: Floats  # sum over the draws of the squared number of settings that count
    freedom: Freedom  # draws beyond the first of each cell

    @classmethod
    def of(cls, used: Masks) -> Self:
        """Return the sample of the poses that count, (groups, cells, draws, settings)."""
        settings = sum_of_settings(used)
        squares = np.square(settings, dtype=np.float64).sum(axis=(1, 2))
        return cls(settings.sum(axis=(1, 2)), squares, CellDraws.of(settings))

    @property
    def draws(self) -> Integers:
        """Number of draws that the poses are worth.

        That is the number of draws with a pose that counts if each has equally many of them; else
        it is less, for those with more of them count more: the effective sample size,
        (Σ m)² / Σ m² of m poses a draw, rounded down (Kish, "Survey Sampling", 1965, section 11.7).
        """
        worth = self.n.astype(np.float64)**2 / np.maximum(self.squares, 1.0)
        return np.asarray(np.floor(worth * (1.0 + 1e-12)), dtype=np.int64)

    @property
    def drawn(self) -> Masks:
        """Whether any cell has two draws, so that intervals exist."""
        return np.asarray(self.freedom > 0)


# Spread of draws within cells.

@dataclass(frozen=True)
class Largest:
    """The largest values (groups, ...) of poses; -inf of none."""

    values: Floats

    def merge(self, other: Self) -> Self:
        """Return the largest values of the poses of both."""
        return type(self)(np.maximum(self.values, other.values))

    @staticmethod
    def interleave(parts: Sequence[Largest]) -> Largest:
        """Return n of as many groups each as one; the n of a group stand together."""
        return Largest(interleaved([part.values for part in parts]))

    def every_nth(self, n: int, first: int) -> Self:
        """Return the values of the groups ``first``, ``first + n`` and so on."""
        return type(self)(self.values[first::n])


@dataclass(frozen=True)
class Spread(State):
    """Sums over cells from which the error of a mean follows; each (groups,).

    `sweep.analysis.means.estimate_mean` uses them.
    """

    variance: Floats  # sum over the cells of n_c s_c², s_c² being the variance within the cell
    squares: Floats  # sum of its terms' squares over their degrees of freedom + 2
    single: Integers  # cells with a single draw
    m2: Floats  # sum of squared deviations from the cells' means
    freedom: Floats  # its degrees of freedom
    largest: Largest  # the largest score of a pose


@dataclass(frozen=True)
class CellDeviations(State):
    """Moments (groups, cells) of the draws' deviations from the mean, and the largest scores."""

    within: Moments
    largest: Largest

    def scatter(self, where: Masks) -> Self:
        """Return the state of some cells as that of all."""
        w = self.within
        return type(self)(Moments(
            scattered(w.count, where), scattered(w.mean, where, np.nan),
            scattered(w.mean_tail, where), scattered(w.m2, where)), self.largest)

    def fold(self) -> Spread:
        """Return the sums over the cells."""
        repeated = self.within.count > 1
        freedom = np.where(repeated, self.within.count - 1.0, 0.0)
        m2 = np.where(repeated, self.within.m2, 0.0)
        with np.errstate(all="ignore"):
            terms = (freedom + 1.0) * m2 / np.maximum(freedom, 1.0)
            return Spread(
                terms.sum(axis=1), (terms**2 / (freedom + 2.0)).sum(axis=1),
                (self.within.count == 1).sum(axis=1), m2.sum(axis=1), freedom.sum(axis=1),
                self.largest)


# --------------------------------------------------------------------------------------------------
# A statistic of poses as a record: two passes over every block, and the variables they give.
#
# Poses come in blocks, arrays (groups, cells, draws, settings): the settings of a draw see the
# same images, so that together they count as one draw. A statistic passes over every block twice;
# it keeps states of a block, which merge (`sweep.analysis.statistic`).
#
# All intervals are at 95 %, over the random draws, conditional on the grid; NaN if no cell has
# two draws that count.

ViewT = TypeVar("ViewT")
FirstT = TypeVar("FirstT", bound=State)
KnownT = TypeVar("KnownT", bound=State)
SecondT = TypeVar("SecondT", bound=State)

Variables = dict[str, NDArray[Any]]
"""Values of variables (groups,), by name."""

OVER_ALL = (1, 2, 3)
"""Axes of cells, draws and settings."""


@dataclass(frozen=True)
class Output:
    """A variable that a statistic gives."""

    name: str
    meaning: str
    units: str
    dtype: str = "f8"
    flags: type[IntEnum] | None = None

    def attributes(self) -> dict[str, Any]:
        """Return its attributes."""
        return cf_attributes(self.meaning, self.units, self.flags)


def with_interval(name: str, meaning: str, units: str) -> list[Output]:
    """Return a variable and the ends of its interval."""
    return [
        Output(name, meaning, units),
        Output(f"{name}_low", f"lower end of the 95 % interval: {meaning}", units),
        Output(f"{name}_high", f"upper end of the 95 % interval: {meaning}", units),
    ]


def interval_variables(name: str, interval: Sequence[NDArray[Any]]) -> Variables:
    """Return a value and the ends of its interval, (value, low, high), by name."""
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


class Statistic(ABC, Generic[ViewT, FirstT, KnownT, SecondT]):
    """What is computed of poses, in two passes over every block.

    Generic over the view of a block's poses, over the merged states of the first and second pass,
    and over what the second pass must know of the first.
    """

    @abstractmethod
    def outputs(self) -> Sequence[Output]:
        """Return the variables that it gives."""

    @abstractmethod
    def first_pass(self, poses: ViewT) -> State:
        """Return the state of a block."""

    @abstractmethod
    def prepare_second(self, first: FirstT) -> KnownT:
        """Return what the second pass needs, from the state of all blocks."""

    @abstractmethod
    def second_pass(self, poses: ViewT, known: KnownT) -> State:
        """Return the state of a block, whose groups ``known`` has."""

    @abstractmethod
    def finish(self, known: KnownT, second: SecondT) -> Variables:
        """Return the variables, each (groups,)."""


class SinglePass(Statistic[ViewT, FirstT, FirstT, Nothing]):
    """A statistic of a single pass; if all are so the second pass is left out."""

    @abstractmethod
    def result(self, state: FirstT) -> Variables:
        """Return the variables, each (groups,)."""

    def prepare_second(self, first: FirstT) -> FirstT:
        """Return the state of all blocks."""
        return first

    def second_pass(self, poses: ViewT, known: FirstT) -> Nothing:  # noqa: ARG002
        """Return nothing."""
        return Nothing()

    def finish(self, known: FirstT, second: Nothing) -> Variables:  # noqa: ARG002
        """Return the variables, each (groups,)."""
        return self.result(known)
