"""Quantiles of markers in photographs: those of one photograph are not independent.

The interval is Woodruff's: the quantiles at the ends of the interval of the share below the
quantile (Journal of the American Statistical Association 47, 1952). That is Clopper and Pearson's
of the number of draws that the share is worth (Korn and Graubard, Survey Methodology 24, 1998).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy import special

from sweep.analysis.intervals import LEVEL
from sweep.analysis.photograph_rates import PhotographSums
from sweep.analysis.quantiles import PERCENTS, IntervalOf, Quantiles
from sweep.analysis.states import BlockState, Nothing
from sweep.analysis.statistic import Variables, ViewT, interval_variables
from sweep.typing import Floats, Integers

ROUNDING = 1e-9
"""Share of a pose by which a rank may be above a whole number."""


def quantile_of(ascending: Floats, share: float) -> float:
    """Return the smallest of some values with at least that share at or below; NaN of none.

    >>> quantile_of(np.array([1.0, 2.0, 3.0, 4.0]), 0.5)
    2.0
    """
    if not len(ascending):
        return float("nan")
    return float(ascending[max(int(np.ceil(share * len(ascending) - ROUNDING)), 1) - 1])


def quantile_ends(
    values: Floats, photograph: Integers, share: float, level: float = LEVEL
) -> tuple[float, float]:
    """Return the ends of the interval of a quantile; NaN for one beyond all values.

    Parameters
    ----------
    values, photograph
        (n,) each: the values, and the index of the photograph of each.
    share
        Of the values, at or below the quantile.
    level
        Probability with which the interval is to hold it.
    """
    if not len(values):
        return float("nan"), float("nan")
    ascending = np.sort(values)
    below = values <= quantile_of(ascending, share)
    count = int(photograph.max()) + 1
    hits, used = (
        np.bincount(photograph[which], minlength=count)[None]
        for which in (below, slice(None))
    )
    draws = float(PhotographSums.of(hits, used).worth(level)[0])
    tail = (1.0 - level) / 2.0
    low = special.betaincinv(share * draws, (1.0 - share) * draws + 1.0, tail)
    high = special.betaincinv(share * draws + 1.0, (1.0 - share) * draws, 1.0 - tail)
    first = int(np.ceil(low * len(values) - ROUNDING))
    last = int(np.floor(high * len(values) + ROUNDING)) + 1
    return (
        float("nan") if first < 1 else float(ascending[first - 1]),
        float("nan") if last > len(values) else float(ascending[last - 1]),
    )


@dataclass(frozen=True)
class PhotographValues(BlockState["PhotographValues"]):
    """The values of each group, and the photograph of each value, numbered up to ``count``."""

    values: tuple[Floats, ...]
    photograph: tuple[Integers, ...]
    count: int

    def fold(self) -> Self:
        """Return itself."""
        return self

    def merge(self, other: Self) -> Self:
        """Return those of the photographs of both."""
        pairs = zip(self.values, other.values, strict=True)
        numbers = zip(self.photograph, other.photograph, strict=True)
        return type(self)(
            tuple(np.concatenate(each) for each in pairs),
            tuple(np.concatenate([a, b + self.count]) for a, b in numbers),
            self.count + other.count,
        )

    @classmethod
    def interleave(cls, states: Sequence[Self]) -> Self:
        """Return the states as one; those of a group stand together."""
        columns = [
            tuple(each for group in zip(*parts, strict=True) for each in group)
            for parts in ([s.values for s in states], [s.photograph for s in states])
        ]
        return cls(columns[0], columns[1], max(state.count for state in states))

    def every_nth(self, n: int, first: int) -> Self:
        """Return those of the groups ``first``, ``first + n`` and so on."""
        return type(self)(self.values[first::n], self.photograph[first::n], self.count)


@dataclass(frozen=True)
class PhotographQuantiles(Quantiles[ViewT]):
    """Quantiles whose draws are as many as the share below each is worth.

    All errors are in memory: photographs are few.
    """

    def first_pass(self, poses: ViewT) -> Any:
        """Return the errors of a block."""
        used = self.used(poses)
        _, errors = self._grouped_errors(poses, used)
        groups, _, photograph, _ = np.nonzero(used)
        ends = np.cumsum(np.bincount(groups, minlength=len(used)))[:-1]
        return PhotographValues(
            tuple(np.split(errors, ends)), tuple(np.split(photograph, ends)), used.shape[2]
        )

    def prepare_second(self, first: Any) -> Any:
        """Return the errors of all blocks."""
        return first

    def second_pass(self, poses: ViewT, known: Any) -> Any:  # noqa: ARG002
        """Return nothing."""
        return Nothing()

    def finish(self, known: Any, second: Any) -> Variables:  # noqa: ARG002
        """Return the quantiles, their intervals, and why these may have no ends."""
        groups = list(zip(known.values, known.photograph, strict=True))
        drawn = np.array([len(np.unique(numbers)) > 1 for _, numbers in groups], dtype=bool)
        some = np.array([len(values) > 0 for values, _ in groups], dtype=bool)
        variables: Variables = {}
        for statistic, percent in PERCENTS.items():
            share = percent / 100.0
            value = np.array([quantile_of(np.sort(values), share) for values, _ in groups])
            ends = np.array([
                quantile_ends(*group, share, self.level) if several else (np.nan, np.nan)
                for group, several in zip(groups, drawn.tolist(), strict=True)
            ]).reshape(-1, 2)
            variables |= interval_variables(self.name.format(statistic), [value, *ends.T])
            if self.with_reason:
                variables[f"{statistic}_interval"] = np.select(
                    [~some, ~drawn, np.isnan(ends).any(axis=1)],
                    [IntervalOf.not_run, IntervalOf.nothing_drawn, IntervalOf.too_few_draws],
                    IntervalOf.given,
                ).astype(np.uint8)
        return variables
