"""The front of cost and accuracy, and labels of configurations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sweep.analysis.dataset import each_cell
from sweep.analysis.requirements import described
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# The Pareto front of configurations: those that no other beats in both cost and accuracy.
#
# A `trade` dataset has the dimension ``treatment``, the configurations by label, and may have
# scene axes beside it; each combination of their values is a condition.

#: Coordinate of a trade: whether a configuration believes something known not to be true.
WRONG_BELIEF = "wrong_belief"

UNITS = {"rotation": "deg", "range": "percent"}
#: Variables of a `trade` that can rank configurations; all are errors, smaller is better.
CRITERIA = tuple(
    f"{quantity}_{statistic}_{unit}"
    for quantity, unit in UNITS.items()
    for statistic in ("rmse", "rmse_unflipped", "median", "p95", "p99")
)


def pareto_front(cost: ArrayLike, error: ArrayLike) -> Masks:
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

    Examples
    --------
    >>> pareto_front([1, 2, 3, 4], [0.9, 0.5, 0.7, np.inf]).tolist()
    [True, True, False, False]
    """
    cost, error = np.asarray(cost, dtype=np.float64), np.asarray(error, dtype=np.float64)
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


def conditions_of(trade: xr.Dataset) -> Iterator[tuple[str, dict[str, Any], xr.Dataset]]:
    """Yield the label of each condition, such as ``side_px = 20``, its values, and its part.

    If ``trade`` has one condition alone, that is all of it, with an empty label.
    """
    dims = [str(name) for name in trade["cost_ms"].dims if name != "treatment"]
    for values, part in each_cell(trade, dims):
        yield described(values, " = "), values, part


# --------------------------------------------------------------------------------------------------
# Configurations as text.

#: Behind the label of a configuration whose estimator believes something untrue.
WRONG = " (wrong)"

#: Label of the only configuration of a pipeline without axes of settings.
NO_SETTINGS = "as set"


def configuration_label(settings: Mapping[str, Any]) -> str:
    """Return the label of a configuration; a word stands alone, all else behind its setting.

    >>> configuration_label({"cornerRefinementMethod": "subpix", "guarded": True})
    'subpix · guarded True'
    >>> configuration_label({"exposure": "8, 0.001"})  # a label of parameters that go together
    'exposure 8, 0.001'
    """
    return " · ".join(
        value if isinstance(value, str) and value[:1].isalpha() and ", " not in value
        else f"{name} {value}"
        for name, value in settings.items()
    ) or NO_SETTINGS
