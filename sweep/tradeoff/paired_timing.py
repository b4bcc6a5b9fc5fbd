"""Paired timing: parts are timed in turns, in random order, until their ratios are known.

Each round times every part once, in a new order, so that changes of the machine (clock, cache,
neighbours) affect all of them. The ratio of two parts is the median over rounds, with the interval
of order statistics. Another process, with another layout of its memory, gives ratios that differ by
a little more than the rounds of one process show: :data:`PROCESS_SHARE` is added to the intervals
on both sides.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import stats

from sweep.isolation.interrupts import Interrupts
from sweep.typing import Floats

PROCESS_SHARE = 0.025
"""Difference of ratios between processes: standard deviations of 0.3 to 1.5 % were measured."""

MIN_ROUNDS, MAX_ROUNDS = 12, 2000

LEAST_ROUNDS = 6
"""Rounds where the time limit does not allow more: the fewest with a 95 % interval of a median."""

NARROW = 0.03
"""Width of a ratio's 95 % interval, as a share of it, that is narrow enough."""


def time_in_turns(
    parts: Sequence[Callable[[], Any]], ratios: Callable[[Floats], Floats], limit_s: float,
    interrupts: Interrupts, progress: Callable[[float], None] | None = None,
    clock: Callable[[], float] | None = None,
) -> Floats:
    """Time P parts in R rounds, each round in a random order of its own.

    Parameters
    ----------
    parts
        Functions without arguments.
    ratios
        (R, P) seconds -> (R, ...) ratios; rounds end once the interval of each ratio's median is
        narrower than :data:`NARROW`, or the ratio is NaN.
    limit_s
        Time limit in seconds; :data:`LEAST_ROUNDS` rounds are measured in any case.
    interrupts
        Checked between two parts.
    progress
        Called after each round with the share of the time limit that is used.
    clock
        Returns the seconds that are counted (default: this thread's own time).

    Returns
    -------
    (R, P) seconds of the clock, without the first round, which warms up.
    """
    clock = clock or time.thread_time
    generator = np.random.Generator(np.random.PCG64(0))
    rounds = np.zeros((MAX_ROUNDS, len(parts)))
    started = time.perf_counter()
    for count in range(MAX_ROUNDS):
        for part in generator.permutation(len(parts)):
            interrupts.check()
            begun = clock()
            parts[part]()
            rounds[count, part] = clock() - begun
        used_s = time.perf_counter() - started
        if progress is not None:
            progress(min(used_s / limit_s, 1.0))
        if count >= LEAST_ROUNDS and used_s + used_s / (count + 1) > limit_s:
            break
        if count >= MIN_ROUNDS:
            value, low, high = median_interval(ratios(rounds[1 : count + 1]))
            if not (high - low > NARROW * value).any():
                break
    return rounds[1 : count + 1]


def median_interval(values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the median of (R, ...) values along the first axis, and its 95 % interval.

    The interval ends at the order statistics that cover the median with a probability of at least
    95 % (David and Nagaraja, "Order Statistics", 3rd edition, section 7.1).

    Returns
    -------
    Median, low and high end, each (...).
    """
    ordered = np.sort(values, axis=0)
    count = len(ordered)
    lowest = int(stats.binom.ppf(0.025, count, 0.5))
    lowest = min(max(lowest - 1, 0), count - 1)
    return np.median(ordered, axis=0), ordered[lowest], ordered[count - 1 - lowest]


def any_process_interval(ratio: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the median ratio of (R, ...) rounds, and the interval of what any process measures.

    The interval of the baseline, whose ratio is 1 in each round, stays [1, 1].
    """
    value, low, high = median_interval(ratio)
    spare = np.where(high > low, PROCESS_SHARE * value, 0.0)
    return value, low - spare, high + spare
