"""Quantiles of errors, exact, with rank intervals."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sweep.analysis.draws import Design, Sample, Unit
from sweep.analysis.intervals import LEVEL
from sweep.analysis.statistic import (
    Blocks,
    Output,
    Statistic,
    Variables,
    ViewT,
    interval_variables,
    settings_of,
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

ROUNDING = 1e-9
"""Share of a pose by which a rank may be above a whole number."""


def require_values(count: int) -> None:
    """Raise DatasetError if so many values cannot be sorted at once."""
    if count > MAX_VALUES:
        raise DatasetError(
            f"quantiles of {count:,} poses at once: expected at most {MAX_VALUES:,}; divide them: "
            "keep an axis apart (per=), or take a part of the dataset (isel) for each condition")


def sorted_by_group(errors: Floats) -> Floats:
    """Return errors (groups, ...) in ascending order (groups, n); NaN stands last."""
    return np.sort(errors.reshape(len(errors), math.prod(errors.shape[1:])), axis=1)


def values_at(ascending: Floats, ranks: Integers) -> Floats:
    """Return the values (groups, ...) at ranks from 1; NaN for those that do not exist."""
    flat = ranks.reshape(len(ranks), -1)
    exists = (flat >= 1) & (flat <= ascending.shape[1])
    if not ascending.size:
        return np.full(ranks.shape, np.nan)
    values = np.take_along_axis(ascending, np.where(exists, flat - 1, 0), axis=1)
    return np.where(exists, values, np.nan).astype(np.float64).reshape(ranks.shape)


def quantile_intervals(
    errors: Floats, used: Integers, percents: Sequence[int], design: Design, level: float = LEVEL
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
        What the draws are.
    level
        Probability with which the interval is to hold it.
    """
    sample, ascending = Sample(used), sorted_by_group(errors)
    n, draws, drawn = sample.n, sample.draws, sample.drawn
    values = np.full((len(n), len(percents), 3), np.nan)
    for at, percent in enumerate(percents):
        ranks = np.zeros((len(n), 3), dtype=np.int64)
        ranks[:, 0] = -(-n * percent // 100)
        if design.unit is Unit.photograph:
            value = values_at(ascending, ranks[:, :1])
            below = settings_of(errors <= value.reshape(-1, 1, 1, 1))
            worth, share = design.worth(below, used, level), percent / 100.0
            tail = (1.0 - level) / 2.0
            low = special.betaincinv(share * worth, (1.0 - share) * worth + 1.0, tail)
            high = special.betaincinv(share * worth + 1.0, (1.0 - share) * worth, 1.0 - tail)
            ranks[:, 1] = np.ceil(np.nan_to_num(low) * n - ROUNDING)
            ranks[:, 2] = np.floor(np.nan_to_num(high) * n + ROUNDING) + 1
        else:
            for count in np.unique(draws[drawn]).tolist():
                same = (draws == count) & drawn
                first, last = interval_ranks(count, percent, level)
                ranks[same, 1] = first * n[same] // count
                # One beyond the last if there is no such draw.
                ranks[same, 2] = -(-last * n[same] // count) if last <= count else n[same] + 1
        ranks[:, 1:] = np.where(drawn[:, None], ranks[:, 1:], 0)
        values[:, at] = values_at(ascending, ranks)
    return values


@dataclass(frozen=True)
class Quantiles(Statistic[ViewT]):
    """The quantiles of `PERCENTS` of the errors of ``used`` poses; not ``solved`` is infinite.

    The values of a column are in memory at once, up to `MAX_VALUES` of a group, in single precision
    as errors are stored. Intervals: `quantile_intervals`.
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

    def column(self, blocks: Blocks[ViewT]) -> tuple[Floats, Integers]:
        """Return the errors (groups, cells, draws, settings), and how many count of each draw."""
        def values(poses: ViewT) -> tuple[NDArray[np.float32], Integers]:
            errors, used = self.errors(poses), self.used(poses)
            known = self.solved(poses) & ~np.isnan(errors)
            with np.errstate(over="ignore"):  # above 3.4e38: infinite
                single = np.where(used, np.where(known, errors, np.inf), np.nan).astype(np.float32)
            return single, settings_of(used)

        require_values(blocks.poses)
        errors, used = blocks.gather(values)
        return errors, used

    def variables(self, blocks: Blocks[ViewT], design: Design) -> Variables:
        """Return the quantiles, their intervals, and why these may have no ends."""
        errors, used = self.column(blocks)
        sample = Sample(used)
        values = quantile_intervals(
            errors, used, [*PERCENTS.values()], design, design.level(self.level))
        found: Variables = {}
        for at, statistic in enumerate(PERCENTS):
            found |= interval_variables(self.name.format(statistic), list(values[:, at].T))
            if self.with_reason:
                missing = np.isnan(values[:, at, 1:]).any(axis=1)
                found[f"{statistic}_interval"] = np.select(
                    [sample.n == 0, ~sample.drawn, missing],
                    [IntervalOf.not_run, IntervalOf.nothing_drawn, IntervalOf.too_few_draws],
                    IntervalOf.given,
                ).astype(np.uint8)
        return found


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


@functools.cache
def draws_of_quantile(percent: int, level: float = LEVEL) -> int:
    """Return the least number of draws at which the interval of a quantile has an upper end.

    From the median on it has a lower one, too.

    >>> draws_of_quantile(95)
    72
    """
    n = 1
    while interval_ranks(n, percent, level)[1] > n:
        n += 1
    return n
