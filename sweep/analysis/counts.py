"""Counts of flags as rates with intervals, and paired differences of rates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np
from scipy import special

from sweep.analysis.intervals import LEVEL, clopper_pearson, jeffreys, wilson
from sweep.analysis.statistic import (
    OVER_ALL,
    Output,
    Sample,
    SinglePass,
    State,
    Variables,
    ViewT,
    with_interval,
)
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Counts of poses, and rates of them with intervals of a binomial proportion.

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
class CountState(State):
    """How many poses there are, (groups,)."""

    n: Integers


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

    def first_pass(self, poses: ViewT) -> Sample:
        """Count."""
        return Sample.of(self.of(poses))

    def result(self, state: Sample) -> Variables:
        """Return the counts."""
        return {self.name: state.n, self.draws: state.draws, self.drawn: state.drawn}


@dataclass(frozen=True)
class RateState(State):
    """The poses that count, and how many of them are successes, (groups,)."""

    sample: Sample
    hits: Integers


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

    def first_pass(self, poses: ViewT) -> RateState:
        """Count."""
        used = self.used(poses)
        hits = (self.successes(poses) & used).sum(axis=OVER_ALL)
        return RateState(Sample.of(used), np.asarray(hits))

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


# --------------------------------------------------------------------------------------------------
# The difference of two rates of the same pairs: its interval, and McNemar's test.

def newcombe_and_mcnemar(
    both: Integers, first: Integers, second: Integers, neither: Integers, draws: Integers,
    drawn: Masks, level: float = LEVEL,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the difference of two paired rates, its interval's ends, and McNemar's p-value.

    ``both``, ``first`` (alone), ``second`` (alone) and ``neither`` are counts of pairs, scaled to
    ``draws`` if these are fewer; without ``drawn`` the interval and the p-value are NaN.
    Newcombe, Statistics in Medicine 17 (1998), pages 2635-2650, method 10, with the continuity
    correction of the correlation; the test is the exact binomial one of the discordant pairs.
    """
    n = both + first + second + neither
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = draws / np.maximum(n, 1)
        rates, lows, highs = [], [], []
        for hits in (both + second, both + first):
            rates.append(hits / n)
            fewest, most = scaled_to_draws(hits, n, draws)
            lows.append(wilson(fewest, draws, level)[0])
            highs.append(wilson(most, draws, level)[1])
        margins = ((both + first) * (second + neither)).astype(np.float64) * (
            (both + second) * (first + neither))
        cross = both.astype(np.float64) * neither - first.astype(np.float64) * second
        # Of counts scaled to draws.
        corrected = np.maximum(cross * scale**2 - draws / 2, 0.0)
        lessened = np.where(cross > 0, corrected, cross * scale**2)
        correlation = np.where(margins > 0, lessened / (np.sqrt(margins) * scale**2), 0.0)

        def reach(up: Floats, down: Floats) -> Floats:
            squares = up**2 - 2 * correlation * up * down + down**2
            return np.sqrt(np.maximum(squares, 0.0))

        difference = rates[0] - rates[1]
        low = difference - reach(rates[0] - lows[0], highs[1] - rates[1])
        high = difference + reach(highs[0] - rates[0], rates[1] - lows[1])
        _, fewer = scaled_to_draws(np.minimum(first, second), n, draws)
        discordant = np.maximum(scaled_to_draws(first + second, n, draws)[0], fewer)
        p_value = np.minimum(1.0, 2.0 * special.bdtr(fewer, discordant, 0.5))
    low, high, p_value = (np.where(drawn, each, np.nan) for each in (low, high, p_value))
    return difference, low, high, p_value
