"""Quantiles of poses' errors, exact in little memory, with intervals that are order statistics."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np
from scipy import special

from sweep.analysis.groups import group_numbers
from sweep.analysis.intervals import LEVEL
from sweep.analysis.radix_histogram import LowerTally, UpperTally
from sweep.analysis.states import BlockSample, BlockState, Sample, State
from sweep.analysis.statistic import (
    Output,
    Statistic,
    Variables,
    ViewT,
    interval_variables,
    with_interval,
)
from sweep.measure.flags import Flag, flag
from sweep.typing import Floats, Integers, Masks

PERCENTS = {"median": 50, "p95": 95, "p99": 99}


class IntervalOf(Flag):
    """Why an interval has both ends, or not."""

    not_run = flag(0, "No pose counts.", counted=False)
    given = flag(1, "Both ends exist.", present=True)
    nothing_drawn = flag(2, "No cell has two draws that count.")
    too_few_draws = flag(3, "An end lies beyond the smallest or the largest draw.")


@dataclass(frozen=True)
class QuantileState(State):
    """The poses that count, and their values by the upper bits."""

    sample: Sample
    upper: UpperTally


@dataclass(frozen=True)
class BlockQuantileState(BlockState[QuantileState]):
    """The same of a block."""

    sample: BlockSample
    upper: UpperTally

    def fold(self) -> QuantileState:
        """Return the state of all cells."""
        return QuantileState(self.sample.fold(), self.upper)


@dataclass(frozen=True)
class WantedRanks(State):
    """What the second pass knows: the bins of the wanted ranks, and the ranks within these.

    ``bins`` and ``ranks`` are (groups, percents, 3): the quantile's, and its interval's ends'.
    """

    sample: Sample
    bins: Integers
    ranks: Integers


@dataclass(frozen=True)
class LowerState(BlockState["LowerState"]):
    """The values in the wanted bins, by all their bits."""

    lower: LowerTally

    def fold(self) -> LowerState:
        """Return itself."""
        return self


@dataclass(frozen=True)
class Quantiles(Statistic[ViewT, QuantileState, WantedRanks, LowerState], Generic[ViewT]):
    """The quantiles of `PERCENTS` of the errors of ``used`` poses; not ``solved`` is infinite.

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

    def first_pass(self, poses: ViewT) -> BlockQuantileState:
        """Count the values by their upper bits."""
        used = self.used(poses)
        upper = UpperTally.of(*self._grouped_errors(poses, used))
        return BlockQuantileState(BlockSample.of(used), upper)

    def prepare_second(self, first: QuantileState) -> WantedRanks:
        """Return the bins in which the wanted ranks lie."""
        n, draws, drawn = first.sample.n, first.sample.draws, first.sample.drawn
        ranks = np.zeros((len(n), len(PERCENTS), 3), dtype=np.int64)
        for at, percent in enumerate(PERCENTS.values()):
            ranks[:, at, 0] = -(-n * percent // 100)
            for count in np.unique(draws[drawn]).tolist():
                same = (draws == count) & drawn
                low, high = interval_ranks(count, percent, self.level)
                ranks[same, at, 1] = low * n[same] // count
                # One beyond the last if there is no such draw.
                ranks[same, at, 2] = -(-high * n[same] // count) if high <= count else n[same] + 1
        return WantedRanks(first.sample, *first.upper.bins_of(group_numbers(ranks), ranks))

    def second_pass(self, poses: ViewT, known: WantedRanks) -> LowerState:
        """Count the values in those bins by all their bits."""
        groups, errors = self._grouped_errors(poses, self.used(poses))
        return LowerState(LowerTally.of(groups, errors, known.bins))

    def finish(self, known: WantedRanks, second: LowerState) -> Variables:
        """Return the quantiles, their intervals, and why these may have no ends."""
        bins, sample = known.bins, known.sample
        values = second.lower.values_at(group_numbers(bins), bins, known.ranks)
        variables: Variables = {}
        for at, statistic in enumerate(PERCENTS):
            variables |= interval_variables(self.name.format(statistic), list(values[:, at].T))
            if self.with_reason:
                missing = (bins[:, at, 1:] < 0).any(axis=1)
                variables[f"{statistic}_interval"] = np.select(
                    [sample.n == 0, ~sample.drawn, missing],
                    [IntervalOf.not_run, IntervalOf.nothing_drawn, IntervalOf.too_few_draws],
                    IntervalOf.given,
                ).astype(np.uint8)
        return variables

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
