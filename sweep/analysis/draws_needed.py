"""About how many draws decide a requirement, if the value stays what it is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from sweep.analysis.intervals import clopper_pearson
from sweep.analysis.quantiles import interval_ranks
from sweep.analysis.requirable import MIN_DRAWS, Requirable
from sweep.typing import Floats

if TYPE_CHECKING:
    from sweep.analysis.requirements import Requirement

MAX_DRAWS = 1e9
"""More draws than this are none that anyone waits for."""


def draws_needed(
    requirement: Requirement, value: xr.DataArray, low: xr.DataArray, high: xr.DataArray,
    draws: xr.DataArray,
) -> xr.DataArray:
    """Return about how many draws would decide a requirement, infinite if no number would.

    For a rate it is the least n at which Clopper and Pearson's end for n times the rate reaches
    the limit. Other intervals narrow with the root of the number of draws; a quantile needs as
    many as its interval's ends need to exist.
    """
    what = requirement.requirable
    needed: xr.DataArray = xr.apply_ufunc(
        np.vectorize(lambda *numbers: _needed(what, requirement, *numbers), otypes=[float]),
        value, low, high, draws.astype(np.float64))
    return needed


def _needed(
    what: Requirable, requirement: Requirement, value: float, low: float, high: float, draws: float
) -> float:
    if what.is_rate:
        return _of_rate(value, requirement.limit, what.level)
    least = float(MIN_DRAWS)
    if what.percent is not None:
        least = float(_of_quantile(what.percent, what.level))
    if math.isnan(value):
        return math.nan
    good = value >= requirement.limit if requirement.at_least else value <= requirement.limit
    # The end that has to pass the limit.
    end = low if good == requirement.at_least else high
    gap = abs(value - requirement.limit)
    if not math.isfinite(end) or not math.isfinite(value):
        return max(least, 2.0 * draws)
    if gap == 0.0:
        return math.inf
    return _rounded(max(least, draws * ((end - value) / gap) ** 2))


def _of_rate(rate: float, limit: float, level: float) -> float:
    """Return the least power of about 1.1 at which the interval of a rate leaves the limit."""
    if math.isnan(rate) or rate == limit:
        return math.nan if math.isnan(rate) else math.inf
    counts: Floats = np.unique(np.ceil(1.1 ** np.arange(1, 218)))
    hits = np.rint(rate * counts)
    low, high = clopper_pearson(hits, counts, level)
    decided = (low > limit) if rate > limit else (high < limit)
    if not decided.any():
        return math.inf
    return _rounded(float(counts[np.argmax(decided)]))


def _of_quantile(percent: int, level: float) -> int:
    """Return the least number of draws at which a quantile's interval has an upper end.

    >>> _of_quantile(95, 0.95)
    72
    """
    n = 1
    while interval_ranks(n, percent, level)[1] > n:
        n += 1
    return n


def _rounded(count: float) -> float:
    """Return a number of draws with two digits, rounded up; infinite if it is too large."""
    if count > MAX_DRAWS:
        return math.inf
    step = 10.0 ** max(0, math.floor(math.log10(max(count, 1.0))) - 1)
    return math.ceil(count / step) * step
