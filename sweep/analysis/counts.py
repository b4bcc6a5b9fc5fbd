"""Counts of flags as rates with intervals, and paired differences of rates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from sweep.analysis.draws import Design, Sample
from sweep.analysis.intervals import LEVEL, clopper_pearson, jeffreys, wilson
from sweep.analysis.statistic import (
    OVER_ALL,
    Blocks,
    Output,
    Statistic,
    Variables,
    ViewT,
    settings_of,
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
class Count(Statistic[ViewT]):
    """How many poses there are of a kind."""

    name: str
    meaning: str
    of: Callable[[ViewT], Masks]

    def outputs(self) -> Sequence[Output]:
        """Return the variable."""
        return [Output(self.name, self.meaning, "1", "i8")]

    def variables(self, blocks: Blocks[ViewT], design: Design) -> Variables:  # noqa: ARG002
        """Return the count."""
        counts = blocks.map(lambda poses: self.of(poses).sum(axis=OVER_ALL))
        return {self.name: np.sum(counts, axis=0)}


@dataclass(frozen=True)
class CountOfDraws(Statistic[ViewT]):
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

    def variables(self, blocks: Blocks[ViewT], design: Design) -> Variables:  # noqa: ARG002
        """Return the counts."""
        sample = Sample(*blocks.gather(lambda poses: (settings_of(self.of(poses)),)))
        return {self.name: sample.n, self.draws: sample.draws, self.drawn: sample.drawn}


@dataclass(frozen=True)
class Rate(Statistic[ViewT]):
    """The share of ``used`` that are ``successes``, with an interval of a level.

    It is Wilson's, or Clopper and Pearson's if it is to be ``exact``, or sampling was stopped.

    n of the interval is the number of draws that the rate is worth (`Design.worth`), and the
    successes are rounded outwards to whole draws. It is a little wide if the cells' rates differ.
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

    def by_draw(self, blocks: Blocks[ViewT]) -> tuple[Integers, Integers]:
        """Return the numbers of successes and of poses that count, (groups, cells, draws) each."""
        def count(poses: ViewT) -> tuple[Integers, Integers]:
            used = self.used(poses)
            return settings_of(self.successes(poses) & used), settings_of(used)

        hits, used = blocks.gather(count)
        return hits, used

    def variables(self, blocks: Blocks[ViewT], design: Design) -> Variables:
        """Return the rate and its intervals."""
        hits_by_draw, used_by_draw = self.by_draw(blocks)
        level, sample = design.level(self.level), Sample(used_by_draw)
        hits = hits_by_draw.sum(axis=(1, 2), dtype=np.int64)
        n, draws = sample.n, design.draws_of_rate(hits_by_draw, used_by_draw, level)
        fewest, most = scaled_to_draws(hits, n, draws)
        with np.errstate(invalid="ignore"):
            values: Variables = {self.name: hits / n}
        if self.counts:
            names = (name for name, _ in self.counts)
            values |= dict(zip(names, (n, hits), strict=False)) | {self.draws_name: draws}
        kinds = {"": clopper_pearson if self.exact or design.stopped else wilson}
        if self.with_jeffreys:
            kinds["_jeffreys"] = jeffreys
        for ending, interval in kinds.items():
            low, high = interval(fewest, draws, level)[0], interval(most, draws, level)[1]
            values[f"{self.name}{ending}_low"] = np.where(sample.drawn, low, np.nan)
            values[f"{self.name}{ending}_high"] = np.where(sample.drawn, high, np.nan)
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
