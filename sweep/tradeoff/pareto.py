"""The front of cost and accuracy, labels of configurations, and advice."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from decimal import ROUND_CEILING, Context, Decimal
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sweep.errors import ArgumentError
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The Pareto front of configurations: those that no other beats in both cost and accuracy.
#
# A `trade` dataset has the dimension ``treatment``, the configurations by label, and may have
# scene axes beside it; each combination of their values is a condition.

Booleans = NDArray[np.bool_]

WRONG_BELIEF = "wrong_belief"
"""Coordinate of a trade: whether a configuration believes what is known not to be true."""

UNITS = {"rotation": "deg", "range": "percent"}
CRITERIA = tuple(
    f"{quantity}_{statistic}_{unit}"
    for quantity, unit in UNITS.items()
    for statistic in ("rmse", "rmse_unflipped", "median", "p95", "p99")
)
"""Variables of a `trade` that can rank configurations; all are errors, smaller is better."""


def pareto_front(cost: ArrayLike, error: ArrayLike) -> Booleans:
    """Return which of n points no other point dominates.

    A point dominates another if neither its cost nor its error is larger and one of them is
    smaller; so of equal points all are on the front, or none. A point whose cost or error is
    infinite or NaN is never on the front and dominates no other.

    Parameters
    ----------
    cost, error
        (n,) each; smaller is better.

    Returns
    -------
    (n,) whether each point is on the front.

    Raises
    ------
    ArgumentError
        If the two are not of one shape (n,).

    Examples
    --------
    >>> pareto_front([1, 2, 3, 4], [0.9, 0.5, 0.7, np.inf]).tolist()
    [True, True, False, False]
    """
    cost, error = np.asarray(cost, dtype=np.float64), np.asarray(error, dtype=np.float64)
    if cost.ndim != 1 or cost.shape != error.shape:
        raise ArgumentError(
            "error", error.shape, f"expected the shape (n,) of the cost, which has {cost.shape}"
        )
    finite = np.isfinite(cost) & np.isfinite(error)
    no_worse = (cost[:, None] <= cost) & (error[:, None] <= error)
    better = (cost[:, None] < cost) | (error[:, None] < error)
    dominated = (finite[:, None] & no_worse & better).any(axis=0)
    return np.asarray(finite & ~dominated)


def mark_front(trade: xr.Dataset, criterion: str) -> xr.Dataset:
    """Return ``trade`` with the variable ``on_front``: the Pareto front of each condition.

    A configuration with a wrong belief is never on it, and dominates no other.

    Parameters
    ----------
    trade
        With ``cost_ms`` and the criterion; KeyError if it lacks either.
    criterion
        One of `CRITERIA`.
    """
    error = trade[criterion]
    if WRONG_BELIEF in trade.coords:
        error = error.where(~trade[WRONG_BELIEF])
    on_front = xr.apply_ufunc(
        pareto_front, trade["cost_ms"], error, vectorize=True, output_dtypes=[bool],
        input_core_dims=[["treatment"], ["treatment"]], output_core_dims=[["treatment"]],
    )
    return trade.assign(on_front=on_front)


def choices(trade: xr.Dataset) -> xr.Dataset:
    """Return ``trade`` without the configurations that believe what is known not to be true.

    A wrong belief is an error of the user's, whose cost a trade shows, and no choice.
    """
    if WRONG_BELIEF not in trade.coords:
        return trade
    return trade.isel(treatment=np.flatnonzero(~trade[WRONG_BELIEF].values))


def by_condition(trade: xr.Dataset, criterion: str) -> Iterator[tuple[str, xr.Dataset]]:
    """Yield the label of each condition, such as ``side_px = 20``, and its part of ``trade``.

    If ``trade`` has one condition alone, that is all of it, with an empty label. KeyError if it
    lacks the criterion.
    """
    sizes = {name: size for name, size in trade[criterion].sizes.items() if name != "treatment"}
    for index in np.ndindex(*sizes.values()):
        condition = trade.isel(dict(zip(sizes, index, strict=True)))
        values = {name: condition[name].item() for name in sizes}
        label = ", ".join(
            f"{name} = {value:g}" if isinstance(value, float) else f"{name} = {value}"
            for name, value in values.items()
        )
        yield label, condition


def interval(condition: xr.Dataset, name: str) -> tuple[Floats, Floats]:
    """Return the low and high ends of a variable's interval, in its unit and of its shape.

    NaN if ``condition`` has no interval; KeyError if it lacks the variable.
    """
    unknown = xr.full_like(condition[name], np.nan, dtype=np.float64)
    low, high = (condition.get(f"{name}_{end}", unknown) for end in ("low", "high"))
    return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)


# --------------------------------------------------------------------------------------------------
# Configurations, variables and numbers of a tradeoff as text.

WRONG = " (wrong)"
"""Behind the label of a configuration whose estimator believes what is not true."""

NO_SETTINGS = "as set"
"""Label of the only configuration of a pipeline without axes of settings."""


def configuration_label(settings: Mapping[str, Any]) -> str:
    """Return the label of a configuration; words stand alone, other values behind their setting.

    >>> configuration_label({"cornerRefinementMethod": "subpix", "guarded": True})
    'subpix · guarded True'
    """
    return " · ".join(
        value if isinstance(value, str) else f"{name} {value}"
        for name, value in settings.items()
    ) or NO_SETTINGS


def digits(value: float) -> str:
    """Return a number with three significant digits; ``-`` for NaN, ``inf`` for infinity.

    Examples
    --------
    >>> [digits(value) for value in (0.31, 12.345, 1234, 0, float("inf"))]
    ['0.310', '12.3', '1230', '0', 'inf']
    """
    if np.isnan(value):
        return "-"
    rounded = float(f"{value:.2e}")
    if rounded == 0 or 1e3 <= abs(rounded) < 1e6:
        return f"{rounded:.0f}"
    return f"{rounded:#.3g}".rstrip(".")


def unit_of(criterion: str) -> tuple[str, str]:
    """Return a criterion's name without its unit, and the unit: ``deg`` or ``%``."""
    name, _, unit = criterion.rpartition("_")
    return name, "%" if unit == "percent" else unit


def heading_of(name: str) -> str:
    """Return a variable's name in words, its unit behind a comma: ``range RMSE, %``."""
    words, unit = unit_of(name)
    return f"{words.replace('_', ' ').replace('rmse', 'RMSE')}, {unit}"


# --------------------------------------------------------------------------------------------------
# Advice: which configuration to take for which time a frame, in a sentence for each condition.

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
