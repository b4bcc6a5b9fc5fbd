"""What a statistic of poses is: a record that a block of poses is given to, and its outputs."""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, Self, TypeVar

import numpy as np
from numpy.lib.array_utils import normalize_axis_tuple
from numpy.typing import ArrayLike, NDArray

from sweep.analysis.draws import Design
from sweep.experiment.schema import cf_attributes
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Poses of some groups, laid out as (groups, cells, draws, settings, ...), and read in blocks.
#
# A group is one row of the table. Its cells are a fixed grid, the draws of a cell are random, and
# the settings of a draw see the same images, so that together they count as one draw.

ViewT = TypeVar("ViewT")
ResultT = TypeVar("ResultT")

Arrays = dict[str, NDArray[Any]]
"""Arrays of poses, by name."""

Variables = dict[str, NDArray[Any]]
"""Values of variables (groups,), by name."""

OVER_ALL = (1, 2, 3)
"""Axes of cells, draws and settings."""

MAX_BLOCK = 1 << 17
"""Poses in a block: a thread needs 25 MB for so many."""

MAX_SHARED = 1 << 20
"""Poses of which views are kept for all statistics: what they compute takes some 200 MB."""


class Blocks(Generic[ViewT]):
    """The poses of some groups, in blocks along the cells and the draws.

    The columns are in memory; what is computed of them pose by pose is so for a block at a time.

    Parameters
    ----------
    arrays
        The columns, (groups, cells, draws, settings, ...).
    view
        Makes of a block's arrays the view that statistics read.
    threads
        Where blocks are computed side by side; None for one after the other.
    """

    def __init__(
        self, arrays: Arrays, view: Callable[[Arrays], ViewT], threads: Executor | None = None
    ) -> None:
        self._arrays, self._view, self._threads = arrays, view, threads
        groups, cells, draws, settings = next(iter(arrays.values())).shape[:4]
        self.poses = groups * cells * draws * settings
        most = max(MAX_BLOCK // max(groups * settings, 1), 1)
        steps = max(most // max(draws, 1), 1), most
        self._cuts = [
            [slice(start, start + step) for start in range(0, max(length, 1), step)]
            for length, step in zip((cells, draws), steps, strict=True)]
        self._blocks = list(itertools.product(*self._cuts))
        self._views: dict[int, ViewT] = {}

    def map(self, function: Callable[[ViewT], ResultT]) -> list[ResultT]:
        """Return what a function gives of the view of each block."""
        def of_block(number: int) -> ResultT:
            return function(self._view_of(number))

        blocks = range(len(self._blocks))
        if self._threads is None or len(blocks) == 1:
            return list(map(of_block, blocks))
        return list(self._threads.map(of_block, blocks))

    def _view_of(self, number: int) -> ViewT:
        """Return the view of a block; of few poses all statistics share it, and what it keeps."""
        if number in self._views:
            return self._views[number]
        cut = self._blocks[number]
        view = self._view({name: array[:, *cut] for name, array in self._arrays.items()})
        if len(self._blocks) == 1 or self.poses <= MAX_SHARED:
            self._views[number] = view
        return view

    def gather(
        self, function: Callable[[ViewT], tuple[NDArray[Any], ...]]
    ) -> tuple[NDArray[Any], ...]:
        """Return the arrays (groups, cells, draws, ...) that a function gives of the blocks."""
        found = self.map(function)
        if len(found) == 1:
            return found[0]
        width = len(self._cuts[1])
        rows = [found[start : start + width] for start in range(0, len(found), width)]
        return tuple(
            np.concatenate([np.concatenate([each[k] for each in row], axis=2) for row in rows],
                           axis=1)
            for k in range(len(found[0])))


def settings_of(used: Masks) -> Integers:
    """Return how many settings of each draw count: (groups, cells, draws)."""
    return sum_of_settings(used).astype(np.int32)


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


def _two_sum(a: Any, b: Any) -> tuple[Any, Any]:
    """Return a + b rounded and the rounding's error, exactly (Knuth 1969); 0 if not finite."""
    total = a + b
    of_b = total - a
    error = (a - (total - of_b)) + (b - of_b)
    return total, np.where(np.isfinite(total), error, 0.0)


# --------------------------------------------------------------------------------------------------
# A statistic of poses: a record that says what of the blocks it needs, and the variables it gives.
#
# All intervals are at 95 %, over the random draws, conditional on the grid; NaN if no cell has
# two draws that count.

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


INTERVAL = {"": "", "_low": "lower end of the 95 % interval: ",
            "_high": "upper end of the 95 % interval: "}
"""Endings of names, of a value and of its interval's ends, with what meanings begin with."""


def with_interval(name: str, meaning: str, units: str) -> list[Output]:
    """Return a variable and the ends of its interval."""
    return [Output(f"{name}{end}", words + meaning, units) for end, words in INTERVAL.items()]


def interval_variables(name: str, interval: Sequence[NDArray[Any]]) -> Variables:
    """Return a value and the ends of its interval, (value, low, high), by name."""
    return {f"{name}{end}": each for end, each in zip(INTERVAL, interval, strict=True)}


class Statistic(ABC, Generic[ViewT]):
    """What is computed of poses; generic over the view of them."""

    @abstractmethod
    def outputs(self) -> Sequence[Output]:
        """Return the variables that it gives."""

    @abstractmethod
    def variables(self, blocks: Blocks[ViewT], design: Design) -> Variables:
        """Return the variables, each (groups,), of poses whose draws are of a design."""
