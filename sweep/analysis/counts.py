"""Counts of poses, and rates of them with intervals of a binomial proportion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np

from sweep.analysis.intervals import LEVEL, clopper_pearson, jeffreys, wilson
from sweep.analysis.states import BlockSample, BlockState, Sample, State
from sweep.analysis.statistic import (
    OVER_ALL,
    Output,
    SinglePass,
    Variables,
    ViewT,
    with_interval,
)
from sweep.typing import Integers, Masks


def scaled_to_draws(hits: Integers, n: Integers, draws: Integers) -> tuple[Integers, Integers]:
    """Return ``hits`` of ``n`` poses as hits of draws, rounded down and up.

    Examples
    --------
    >>> [int(each) for each in scaled_to_draws(np.int64(5), np.int64(8), np.int64(4))]
    [2, 3]
    """
    n = np.maximum(n, 1)
    return hits * draws // n, -(-hits * draws // n)


@dataclass(frozen=True)
class CountState(BlockState["CountState"]):
    """How many poses there are, (groups,)."""

    n: Integers

    def fold(self) -> CountState:
        """Return itself."""
        return self


@dataclass(frozen=True)
class Count(SinglePass[ViewT, CountState], Generic[ViewT]):
    """How many poses there are of a kind."""

    name: str
    meaning: str
    of: Callable[[ViewT], Masks]

    def outputs(self) -> Sequence[Output]:
        """Return the variable."""
        return [Output(self.name, self.meaning, "1", "i8")]

    def first_pass(self, poses: ViewT) -> CountState:
        """Count."""
        return CountState(np.asarray(self.of(poses).sum(axis=OVER_ALL)))

    def result(self, state: CountState) -> Variables:
        """Return the count."""
        return {self.name: state.n}


@dataclass(frozen=True)
class CountOfDraws(SinglePass[ViewT, Sample], Generic[ViewT]):
    """How many poses there are of a kind, the draws they are worth, and if intervals exist."""

    name: str
    meaning: str
    of: Callable[[ViewT], Masks]
    draws: str = "draws"
    drawn: str = "drawn"

    def outputs(self) -> Sequence[Output]:
        """Return the three variables."""
        return [Output(self.name, self.meaning, "1", "i8"),
                Output(self.draws, "random draws that the intervals are of", "1", "i8"),
                Output(self.drawn, "whether any cell has two draws", "1", "?")]

    def first_pass(self, poses: ViewT) -> BlockSample:
        """Count."""
        return BlockSample.of(self.of(poses))

    def result(self, state: Sample) -> Variables:
        """Return the counts."""
        return {self.name: state.n, self.draws: state.draws, self.drawn: state.drawn}


@dataclass(frozen=True)
class RateState(State):
    """The poses that count, and how many of them are successes, (groups,)."""

    sample: Sample
    hits: Integers


@dataclass(frozen=True)
class BlockRateState(BlockState[RateState]):
    """The same of a block."""

    sample: BlockSample
    hits: Integers

    def fold(self) -> RateState:
        """Return the state of all cells."""
        return RateState(self.sample.fold(), self.hits)


@dataclass(frozen=True)
class Rate(SinglePass[ViewT, RateState], Generic[ViewT]):
    """The share of ``used`` that are ``successes``, with an interval of a level.

    It is Wilson's, or Clopper and Pearson's if it is to be ``exact``.

    Pooled settings see the same draws: n of the interval is the number of draws, `Sample.draws`,
    and the successes are rounded outwards to whole draws. It is a little wide if the cells' rates
    differ.
    """

    name: str
    meaning: str
    successes: Callable[[ViewT], Masks]
    used: Callable[[ViewT], Masks]
    level: float = LEVEL
    counts: Sequence[tuple[str, str]] = ()
    """Names and meanings for the numbers of ``used`` and of ``successes``, if they are wanted."""
    with_jeffreys: bool = False
    exact: bool = False
    draws_name: str = "draws"

    def outputs(self) -> Sequence[Output]:
        """Return the rate, its interval, and the counts that are asked for."""
        draws = Output(self.draws_name, "random draws that the interval is of", "1", "i8")
        return [
            *(Output(name, meaning, "1", "i8") for name, meaning in self.counts),
            *([draws] if self.counts else []),
            *with_interval(self.name, self.meaning, "1"),
            *(with_interval(f"{self.name}_jeffreys", f"{self.meaning} (Jeffreys)", "1")[1:]
              if self.with_jeffreys else []),
        ]

    def first_pass(self, poses: ViewT) -> BlockRateState:
        """Count."""
        used = self.used(poses)
        hits = (self.successes(poses) & used).sum(axis=OVER_ALL)
        return BlockRateState(BlockSample.of(used), np.asarray(hits))

    def draws_of(self, state: RateState) -> Integers:
        """Return the number of draws that the interval is of."""
        return state.sample.draws

    def result(self, state: RateState) -> Variables:
        """Return the rate and its intervals."""
        n, draws, hits = state.sample.n, self.draws_of(state), state.hits
        fewest, most = scaled_to_draws(hits, n, draws)
        with np.errstate(invalid="ignore"):
            values: Variables = {self.name: hits / n}
        if self.counts:
            names = (name for name, _ in self.counts)
            values |= dict(zip(names, (n, hits), strict=False)) | {self.draws_name: draws}
        kinds = {"": clopper_pearson if self.exact else wilson}
        if self.with_jeffreys:
            kinds["_jeffreys"] = jeffreys
        for ending, interval in kinds.items():
            low, high = interval(fewest, draws, self.level)[0], interval(most, draws, self.level)[1]
            values[f"{self.name}{ending}_low"] = np.where(state.sample.drawn, low, np.nan)
            values[f"{self.name}{ending}_high"] = np.where(state.sample.drawn, high, np.nan)
        return values
