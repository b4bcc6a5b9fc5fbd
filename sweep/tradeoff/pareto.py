"""The front of cost and accuracy, labels of configurations, and what they come to in a line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
# What a trade comes to, in a line for each condition.

def advice(trade: xr.Dataset, criterion: str) -> list[str]:
    """Return a line for each condition: the most accurate configuration, and the cheapest.

    Both are on the Pareto front, with their cost, error and share of solved poses.

    Parameters
    ----------
    trade
        With ``cost_ms``, ``solved_rate`` and the criterion; KeyError if it lacks one of them.
    criterion
        One of `CRITERIA`.
    """
    return [_line(label, condition, criterion, np.inf)
            for label, condition in by_condition(choices(trade), criterion)]


def budget_advice(trade: xr.Dataset, criterion: str, budget_ms: float) -> list[str]:
    """Return a line for each condition: the most accurate configuration within a budget.

    Where none is within it, the line names the cheapest with a finite criterion.

    Parameters
    ----------
    trade, criterion
        As :func:`advice` takes them.
    budget_ms
        Most milliseconds a frame.
    """
    return [_line(label, condition, criterion, budget_ms)
            for label, condition in by_condition(choices(trade), criterion)]


def _line(label: str, condition: xr.Dataset, criterion: str, budget_ms: float) -> str:
    cost, error = condition["cost_ms"].to_numpy(), condition[criterion].to_numpy()
    known = np.isfinite(cost) & np.isfinite(error)
    # Of equal errors the cheapest, of equal costs the most accurate.
    by_error, by_cost = (np.lexsort((*keys, ~known)) for keys in ((cost, error), (error, cost)))
    best, cheapest = int(by_error[0]), int(by_cost[0])
    if not known.any():
        line = f"no configuration has a finite {criterion}; another criterion may rank them"
    elif np.isinf(budget_ms):
        line = f"most accurate {_facts(condition, best, criterion)}"
        if cheapest != best:
            line += f"; cheapest {_facts(condition, cheapest, criterion)}"
    else:
        fitting = [int(k) for k in by_error if known[k] and cost[k] <= budget_ms]
        line = (f"within {budget_ms:g} ms a frame take {_facts(condition, fitting[0], criterion)}"
                if fitting else f"nothing fits {budget_ms:g} ms a frame; the nearest is "
                                f"{_facts(condition, cheapest, criterion)}")
    return f"{label}: {line}" if label else line


def _facts(condition: xr.Dataset, k: int, criterion: str) -> str:
    """Return a configuration with its cost, its error with interval, and its solved poses."""
    name, unit = unit_of(criterion)
    value, solved = (float(condition[each].to_numpy()[k]) for each in (criterion, "solved_rate"))
    low, high = (float(end[k]) for end in interval(condition, criterion))
    between = "" if np.isnan(low) and np.isnan(high) else f" ({digits(low)} to {digits(high)})"
    return (f"{condition['treatment'].to_numpy()[k]}: "
            f"{digits(float(condition['cost_ms'].to_numpy()[k]))} ms, {name} "
            f"{digits(value)}{between} {unit}, {digits(100 * solved)} % solved")
