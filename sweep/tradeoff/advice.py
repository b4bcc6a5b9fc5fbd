"""Advice: which configuration to take for which time a frame, in a sentence for each condition."""

from __future__ import annotations

from decimal import ROUND_CEILING, Context, Decimal

import numpy as np
import xarray as xr

from sweep.tradeoff.labels import digits, unit_of
from sweep.tradeoff.pareto import by_condition, choices, interval, pareto_front
from sweep.typing import Floats

MISSES_COUNT = {"median": 50, "p95": 5, "p99": 1}
"""Statistics in which a miss is an infinite error, and the percentage of misses that shows."""

WORTHWHILE = 1.3
"""A step between the cheapest and the best is named if it is better by this factor."""


def advice(trade: xr.Dataset, criterion: str) -> list[str]:
    """Return a sentence for each condition: which configuration to take for which budget.

    Each sentence names at most three configurations, all on the Pareto front:

    - the cheapest. The budgets that are named are costs (ms) rounded up to two significant digits;
      of configurations with one budget the most accurate is named;
    - the best: the cheapest than which no other is clearly better;
    - between them the cheapest that gains at least half of what the best gains, on a logarithmic
      scale, if that makes it better than the cheapest by the factor `WORTHWHILE`.

    Each is clearly better than the one before: its error is smaller, and the two 95 % intervals
    do not overlap, as far as they are known.

    Parameters
    ----------
    trade
        With ``cost_ms``, ``solved_rate`` and the criterion; KeyError if it lacks one of them.
    criterion
        One of `sweep.tradeoff.pareto.CRITERIA`.
    """
    return [
        f"{label}: {sentence}" if label else sentence
        for label, condition in by_condition(choices(trade), criterion)
        for sentence in [_sentence(condition, criterion)]
    ]


def budget_advice(trade: xr.Dataset, criterion: str, budget_ms: float) -> list[str]:
    """Return a sentence for each condition: the most accurate configuration within a budget.

    Where none is within it, the sentence names the cheapest with a finite criterion.

    Parameters
    ----------
    trade, criterion
        As :func:`advice` takes them.
    budget_ms
        Most milliseconds a frame.
    """
    return [
        f"{label}: {sentence}" if label else sentence
        for label, condition in by_condition(choices(trade), criterion)
        for sentence in [_budget_sentence(condition, criterion, budget_ms)]
    ]


def _budget_sentence(condition: xr.Dataset, criterion: str, budget_ms: float) -> str:
    cost, error = condition["cost_ms"].to_numpy(), condition[criterion].to_numpy()
    known = np.isfinite(cost) & np.isfinite(error)
    name, unit = unit_of(criterion)
    if not known.any():
        return (
            f"nothing fits {budget_ms:g} ms: no configuration has a finite {criterion}: "
            f"{_reason_for_none(condition, criterion)}"
        )
    fits = known & (cost <= budget_ms)
    if fits.any():
        best = int(np.argmin(np.where(fits, error, np.inf)))
        start = f"within {budget_ms:g} ms a frame take"
    else:
        best = int(np.argmin(np.where(known, cost, np.inf)))
        start = f"nothing fits {budget_ms:g} ms a frame; the nearest is"
    label = condition["treatment"].to_numpy()[best]
    return f"{start} {label}: {digits(cost[best])} ms, {name} {digits(error[best])} {unit}"


def _sentence(condition: xr.Dataset, criterion: str) -> str:
    cost = condition["cost_ms"].to_numpy()
    error = condition[criterion].to_numpy()
    steps = _steps(cost, error, *interval(condition, criterion))
    name, unit = unit_of(criterion)
    if not steps:
        return (
            f"no configuration has a finite {criterion}: {_reason_for_none(condition, criterion)}; "
            "another criterion may rank them"
        )
    parts: list[str] = []
    for step in steps:
        accuracy = f"{digits(error[step])} {unit}"
        if "rmse" in criterion:  # which does not count misses
            solved = 100 * condition["solved_rate"].to_numpy()[step]
            accuracy += f", {digits(solved)} % solved"
        budget, label = f"{_budget(cost[step]):f} ms", condition["treatment"].to_numpy()[step]
        if parts:
            parts.append(f"if you can wait {budget}, {label} ({accuracy})")
        else:
            parts.append(f"within {budget} a frame take {label} ({name} {accuracy})")
    if len(steps) == 1 < cost.size:
        parts.append("no more expensive one is clearly better")
    return "; ".join(parts)


def _steps(cost: Floats, error: Floats, low: Floats, high: Floats) -> list[int]:
    """Return the configurations to name, cheapest first; none if no error is finite."""
    budgets = np.array([float(_budget(value)) for value in cost])
    order = np.lexsort((cost, error, budgets))
    front = order[pareto_front(budgets, error)[order]]
    front = front[np.unique(budgets[front], return_index=True)[1]]
    if not front.size:
        return []
    # If only the lower end is known, the upper one lies beyond the largest draw.
    high = np.where(np.isnan(high) & ~np.isnan(low), np.inf, high)
    clearly_better = (error[:, None] < error) & ~(high[:, None] >= low)
    first = front[0]
    better = [k for k in front if clearly_better[k, first]]
    if not better:
        return [int(first)]
    best = next(k for k in better if not clearly_better[better, k].any())
    knees = [
        k for k in better
        if budgets[k] < budgets[best]
        and clearly_better[best, k]
        and error[k] ** 2 <= error[first] * error[best]
        and error[k] * WORTHWHILE <= error[first]
    ]
    return [int(k) for k in (first, *knees[:1], best)]


def _budget(cost: float) -> Decimal:
    """Return the cost rounded up to two significant digits."""
    return Context(prec=2, rounding=ROUND_CEILING).create_decimal(repr(float(cost)))


def _reason_for_none(condition: xr.Dataset, criterion: str) -> str:
    """Return why no configuration has a finite criterion."""
    statistic = unit_of(criterion)[0].rpartition("_")[2]
    if not (condition["solved_rate"] > 0).any():
        return "none solved any pose"
    if statistic in MISSES_COUNT and np.isposinf(condition[criterion]).all():
        return f"each misses at least {MISSES_COUNT[statistic]} % of the poses"
    return "none solved enough poses"
