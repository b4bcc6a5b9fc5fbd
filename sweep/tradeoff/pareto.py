"""What accuracy costs: the treatments that no other beats in both, and which of them to take.

A `trade` dataset has the dimension ``treatment`` (combinations of detector and estimator settings,
by label) and may have the scene's axes beside it; each combination of their values is a regime.
"""

from __future__ import annotations

from collections.abc import Iterator
from decimal import ROUND_CEILING, Context, Decimal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sweep.typing import Floats

Booleans = NDArray[np.bool_]

UNITS = {"rotation": "deg", "range": "percent"}
CRITERIA = tuple(
    f"{quantity}_{statistic}_{unit}"
    for quantity, unit in UNITS.items()
    for statistic in ("rmse", "rmse_unflipped", "median", "p95", "p99")
)
"""Variables of a `trade` that can tell treatments apart; all are errors, smaller is better."""

MISSES_COUNT = {"median": 50, "p95": 5, "p99": 1}
"""Statistics in which a miss is an infinite error, and the percentage of misses that shows."""

WORTHWHILE = 1.3
"""A step between the cheapest and the best is named if it is better by this factor."""


def pareto_front(cost: ArrayLike, error: ArrayLike) -> Booleans:
    """Return which of n points, (n,), no other point beats; costs and errors are (n,).

    A point beats another if neither its cost nor its error is larger and one of them is smaller;
    so of equal points all are on the front, or none. A point whose cost or error is infinite or
    NaN is never on the front and beats no other.

    Raises ``ValueError`` if the two are not of one shape (n,).

    >>> pareto_front([1, 2, 3, 4], [0.9, 0.5, 0.7, np.inf]).tolist()
    [True, True, False, False]
    """
    cost, error = np.asarray(cost, dtype=np.float64), np.asarray(error, dtype=np.float64)
    if cost.ndim != 1 or cost.shape != error.shape:
        raise ValueError(f"cost {cost.shape} and error {error.shape}: give two of one shape (n,)")
    finite = np.isfinite(cost) & np.isfinite(error)
    no_worse = (cost[:, None] <= cost) & (error[:, None] <= error)
    better = (cost[:, None] < cost) | (error[:, None] < error)
    beaten = (finite[:, None] & no_worse & better).any(axis=0)
    return np.asarray(finite & ~beaten)


def mark_front(trade: xr.Dataset, criterion: str) -> xr.Dataset:
    """Return ``trade`` with ``on_front``: bool, of the criterion's dimensions, regime by regime.

    The front is that of ``cost_ms`` and the criterion, one of `CRITERIA`. Raises ``KeyError`` if
    ``trade`` lacks either.
    """
    on_front = xr.apply_ufunc(
        pareto_front, trade["cost_ms"], trade[criterion], vectorize=True, output_dtypes=[bool],
        input_core_dims=[["treatment"], ["treatment"]], output_core_dims=[["treatment"]],
    )
    return trade.assign(on_front=on_front)


def by_regime(trade: xr.Dataset, criterion: str) -> Iterator[tuple[str, xr.Dataset]]:
    """Yield each regime's label, such as ``side_px = 20``, and its part of ``trade``.

    Without a regime's dimension that is all of ``trade``, labelled with the empty string. Raises
    ``KeyError`` if ``trade`` lacks the criterion.
    """
    sizes = {name: size for name, size in trade[criterion].sizes.items() if name != "treatment"}
    for index in np.ndindex(*sizes.values()):
        regime = trade.isel(dict(zip(sizes, index, strict=True)))
        values = {name: regime[name].item() for name in sizes}
        label = ", ".join(
            f"{name} = {value:g}" if isinstance(value, float) else f"{name} = {value}"
            for name, value in values.items()
        )
        yield label, regime


def interval(regime: xr.Dataset, name: str) -> tuple[Floats, Floats]:
    """Return the ends (low, high) of a variable's interval, each of the variable's shape.

    In the variable's unit; NaN where ``regime`` has no interval. Raises ``KeyError`` if it lacks
    the variable.
    """
    unknown = xr.full_like(regime[name], np.nan, dtype=np.float64)
    low, high = (regime.get(f"{name}_{end}", unknown) for end in ("low", "high"))
    return np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)


def digits(value: float) -> str:
    """Return a number with three significant digits; ``-`` for NaN, ``inf`` for infinity.

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


def advice(trade: xr.Dataset, criterion: str) -> list[str]:
    """Return a sentence for each regime: which treatment to take for how much time a frame.

    Each names at most three treatments, all on the front:

    - the cheapest: costs (ms) count as rounded up to two significant digits, the budgets that
      are named, and of treatments of one budget the most accurate is named;
    - the best: the cheapest that no other is clearly better than;
    - between them the cheapest that gains at least half of what the best gains, on a logarithmic
      scale, if that makes it better than the cheapest by the factor `WORTHWHILE`.

    Each is clearly better than the one before: its error is smaller, and the two 95 % intervals
    do not overlap, as far as they are known. Raises ``KeyError`` if ``trade`` lacks ``cost_ms``,
    ``solved_rate`` or the criterion, one of `CRITERIA`.
    """
    return [
        f"{label}: {sentence}" if label else sentence
        for label, regime in by_regime(trade, criterion)
        for sentence in [_sentence(regime, criterion)]
    ]


def _sentence(regime: xr.Dataset, criterion: str) -> str:
    cost = regime["cost_ms"].to_numpy()
    error = regime[criterion].to_numpy()
    steps = _steps(cost, error, *interval(regime, criterion))
    name, unit = unit_of(criterion)
    if not steps:
        return (
            f"no treatment has a finite {criterion}: {_why_none(regime, criterion)}; "
            "another --criterion may tell them apart"
        )
    parts: list[str] = []
    for step in steps:
        found = f"{digits(error[step])} {unit}"
        if "rmse" in criterion:  # says nothing of the misses
            found += f", {digits(100 * regime['solved_rate'].to_numpy()[step])} % solved"
        budget, label = f"{_budget(cost[step]):f} ms", regime["treatment"].to_numpy()[step]
        if parts:
            parts.append(f"if you can wait {budget}, {label} ({found})")
        else:
            parts.append(f"within {budget} a frame take {label} ({name} {found})")
    if len(steps) == 1 < cost.size:
        parts.append("no dearer one on the front is clearly better")
    return "; ".join(parts)


def _steps(cost: Floats, error: Floats, low: Floats, high: Floats) -> list[int]:
    """Return the treatments to name, cheapest first; none if no error is finite."""
    budgets = np.array([float(_budget(value)) for value in cost])
    order = np.lexsort((cost, error, budgets))
    front = order[pareto_front(budgets, error)[order]]
    front = front[np.unique(budgets[front], return_index=True)[1]]
    if not front.size:
        return []
    # An upper end that is missing beside a lower one lies beyond the largest draw.
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


def _why_none(regime: xr.Dataset, criterion: str) -> str:
    statistic = unit_of(criterion)[0].rpartition("_")[2]
    if not (regime["solved_rate"] > 0).any():
        return "none solved any pose"
    if statistic in MISSES_COUNT and np.isposinf(regime[criterion]).all():
        return f"each misses at least {MISSES_COUNT[statistic]} % of the poses"
    return "none solved enough poses"
