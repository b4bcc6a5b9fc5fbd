"""Quantiles of errors, exact, with rank intervals."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Self

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sweep.analysis.intervals import LEVEL
from sweep.analysis.statistic import (
    Output,
    Sample,
    SinglePass,
    State,
    Variables,
    ViewT,
    interval_variables,
    with_interval,
)
from sweep.errors import DatasetError
from sweep.measure.flags import Flag, flag
from sweep.typing import Floats, Integers, Masks

PERCENTS = {"median": 50, "p95": 95, "p99": 99}


class IntervalOf(Flag):
    """Why an interval has both ends, or not."""

    not_run = flag(0, "No pose counts.", counted=False)
    given = flag(1, "Both ends exist.", present=True)
    nothing_drawn = flag(2, "No cell has two draws that count.")
    too_few_draws = flag(3, "An end lies beyond the smallest or the largest draw.")


MAX_VALUES = 2 * 10**8
"""Values of a column that are sorted at once: 1.6 GB."""

OF_VALUE = 1 << 32
"""How many keys the values of a group can have."""


@dataclass(frozen=True, slots=True, eq=False)
class Keys:
    """Non-negative values of all groups as whole numbers (m,), in any order.

    A key is the number of the value's group, and below it the bits of the value as a float32 (the
    precision in which errors are stored), which are ordered as the values are. So the sorted keys
    have the sorted values of each group, one group after the other.
    """

    keys: NDArray[np.uint64] | NDArray[np.uint32]
    """Of 32 bits where all values are of the first group, which takes half the memory."""

    @classmethod
    def of(cls, groups: Integers, values: Floats) -> Self:
        """Return the keys of values (m,) of groups (m,); DatasetError as `merge`."""
        require_values(len(values))
        with np.errstate(over="ignore"):  # above 3.4e38: infinite
            bits = np.abs(values).astype(np.float32).view(np.uint32)
        return cls(groups.astype(np.uint64) * OF_VALUE + bits if groups.any() else bits)

    def merge(self, other: Self) -> Self:
        """Return the keys of the values of both.

        Raises
        ------
        DatasetError
            If they are too many to be sorted at once.
        """
        require_values(len(self.keys) + len(other.keys))
        return type(self)(np.concatenate([self.keys, other.keys]))

    @staticmethod
    def interleave(parts: Sequence[Keys]) -> Keys:
        """Return n parts as one of n times as many groups: g of the k-th becomes g * n + k."""
        moved = [(*np.divmod(part.keys.astype(np.uint64), OF_VALUE), k)
                 for k, part in enumerate(parts)]
        return Keys(np.concatenate([
            (group * len(parts) + k) * OF_VALUE + bits for group, bits, k in moved]))

    def every_nth(self, n: int, first: int) -> Self:
        """Return the keys of the groups ``first``, ``first + n`` and so on."""
        group, bits = np.divmod(self.keys.astype(np.uint64), OF_VALUE)
        chosen = group % n == first
        return type(self)(group[chosen] // n * OF_VALUE + bits[chosen])

    def values_at(self, ranks: Integers) -> Floats:
        """Return the values at ranks (groups, ...), from 1; NaN for those that do not exist."""
        self.keys.sort()  # in place: their order means nothing
        ascending = self.keys
        if ascending.dtype == np.uint32:
            starts = np.array([0, *[len(ascending)] * len(ranks)])
        else:
            starts = np.searchsorted(
                ascending, np.arange(len(ranks) + 1, dtype=np.uint64) * np.uint64(OF_VALUE))
        shape = (len(ranks), *[1] * (ranks.ndim - 1))
        first, size = starts[:-1].reshape(shape), np.diff(starts).reshape(shape)
        exists = (ranks >= 1) & (ranks <= size)
        if not len(ascending):
            return np.full(ranks.shape, np.nan)
        keys = ascending[np.where(exists, first + ranks - 1, 0)]
        bits = (keys.astype(np.uint64) % OF_VALUE).astype(np.uint32)
        return np.where(exists, bits.view(np.float32).astype(np.float64), np.nan)


def require_values(count: int) -> None:
    """Raise DatasetError if so many values cannot be sorted at once."""
    if count > MAX_VALUES:
        raise DatasetError(
            f"quantiles of {count:,} poses at once: expected at most {MAX_VALUES:,}; divide them: "
            "keep an axis apart (per=), or take a part of the dataset (isel) for each condition")


@dataclass(frozen=True)
class QuantileState(State):
    """The poses that count, and their values."""

    sample: Sample
    values: Keys


@dataclass(frozen=True)
class Quantiles(SinglePass[ViewT, QuantileState], Generic[ViewT]):
    """The quantiles of `PERCENTS` of the errors of ``used`` poses; not ``solved`` is infinite.

    The values of a column are in memory at once, up to `MAX_VALUES` of a block of the table.

    A quantile is the smallest value with at least that share at or below. The interval's ends are
    order statistics of the pooled sample: David and Nagaraja, "Order Statistics", 3rd ed. 2003,
    section 7.1. If cells differ, the count below the quantile varies less than binomially
    (Hoeffding, Annals of Mathematical Statistics 27, 1956): it then covers more. Pooled settings
    see the same draws: ranks are counted in draws.
    """

    name: str
    """With {} in place of the statistic, such as ``rotation_{}_deg``."""
    meaning: str
    units: str
    errors: Callable[[ViewT], Floats]
    solved: Callable[[ViewT], Masks]
    used: Callable[[ViewT], Masks]
    with_reason: bool = False
    level: float = LEVEL

    def outputs(self) -> Sequence[Output]:
        """Return the quantiles and their intervals."""
        variables = []
        for statistic, percent in PERCENTS.items():
            meaning = f"{percent} % quantile of the {self.meaning}, not solved = infinite"
            variables += with_interval(self.name.format(statistic), meaning, self.units)
            if self.with_reason:
                variables.append(Output(
                    f"{statistic}_interval", f"why the interval of the {percent} % quantile has "
                    "both ends, or not", "", "u1", IntervalOf))
        return variables

    def first_pass(self, poses: ViewT) -> QuantileState:
        """Take the values."""
        used = self.used(poses)
        return QuantileState(
            Sample.of(used), Keys.of(*self._grouped_errors(poses, used)))

    def result(self, state: QuantileState) -> Variables:
        """Return the quantiles, their intervals, and why these may have no ends."""
        ranks, sample = self._ranks(state.sample), state.sample
        values = state.values.values_at(ranks)
        variables: Variables = {}
        for at, statistic in enumerate(PERCENTS):
            variables |= interval_variables(self.name.format(statistic), list(values[:, at].T))
            if self.with_reason:
                missing = np.isnan(values[:, at, 1:]).any(axis=1)
                variables[f"{statistic}_interval"] = np.select(
                    [sample.n == 0, ~sample.drawn, missing],
                    [IntervalOf.not_run, IntervalOf.nothing_drawn, IntervalOf.too_few_draws],
                    IntervalOf.given,
                ).astype(np.uint8)
        return variables

    def _ranks(self, sample: Sample) -> Integers:
        """Return the ranks (groups, percents, 3) of quantiles and their interval's ends."""
        n, draws, drawn = sample.n, sample.draws, sample.drawn
        ranks = np.zeros((len(n), len(PERCENTS), 3), dtype=np.int64)
        for at, percent in enumerate(PERCENTS.values()):
            ranks[:, at, 0] = -(-n * percent // 100)
            for count in np.unique(draws[drawn]).tolist():
                same = (draws == count) & drawn
                low, high = interval_ranks(count, percent, self.level)
                ranks[same, at, 1] = low * n[same] // count
                # One beyond the last if there is no such draw.
                ranks[same, at, 2] = -(-high * n[same] // count) if high <= count else n[same] + 1
        return ranks

    def _grouped_errors(self, poses: ViewT, used: Masks) -> tuple[Integers, Floats]:
        """Return the group and the error of each used pose, both (m,)."""
        groups = np.nonzero(used)[0]
        errors = self.errors(poses)
        known = self.solved(poses) & ~np.isnan(errors)
        return groups, np.where(known, errors, np.inf)[used]


@functools.lru_cache(maxsize=4096)
def interval_ranks(n: int, percent: int, level: float = LEVEL) -> tuple[int, int]:
    """Return the ranks, from 1, between which the quantile lies.

    It lies beyond each with (1 - level) / 2 at most. 0 and n + 1 stand for ends that the sample
    does not have.

    Examples
    --------
    >>> interval_ranks(100, 50)
    (40, 61)
    """
    p = percent / 100.0
    reach = 10.0 * np.sqrt(n * p * (1.0 - p)) + 10.0
    below = np.arange(max(0, int(n * p - reach)), min(n, int(n * p + reach)) + 1)
    chance = special.bdtr(below, n, p)
    tail = (1.0 - level) / 2.0
    first = below[np.searchsorted(chance, tail)]
    last = below[np.searchsorted(chance, 1.0 - tail)] + 1
    return int(first), int(last)
