"""About how many draws decide a requirement, if the value stays what it is."""

from __future__ import annotations

import bisect
import functools
import math
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from scipy import special

from sweep.analysis.intervals import clopper_pearson
from sweep.analysis.quantiles import interval_ranks
from sweep.analysis.requirable import MIN_DRAWS, Requirable

if TYPE_CHECKING:
    from sweep.analysis.requirements import Requirement

MAX_DRAWS = 1e9
"""More draws than this are none that anyone waits for."""


def draws_needed(
    requirement: Requirement, value: xr.DataArray, low: xr.DataArray, high: xr.DataArray,
    draws: xr.DataArray, solved: xr.DataArray, undecided: xr.DataArray,
) -> xr.DataArray:
    """Return about how many draws would decide a requirement, infinite if no number would.

    NaN where it is not ``undecided``, and without a value.

    For a rate it is the least n at which Clopper and Pearson's end for n times the rate reaches
    the limit. Other intervals narrow with the root of the number of draws (those of spreads on the
    scale of logarithms, on which they are made); a quantile needs as
    many as its interval's ends need to exist and, if its end is infinite for too few poses are
    ``solved`` (a share), as many as decide whether enough are.
    """
    what = requirement.requirable
    needed: xr.DataArray = xr.apply_ufunc(
        np.vectorize(lambda *numbers: _needed(what, requirement, *numbers), otypes=[float]),
        value.where(undecided), low, high, draws.astype(np.float64), solved)
    return needed


def _needed(
    what: Requirable, requirement: Requirement, value: float, low: float, high: float, draws: float,
    solved: float,
) -> float:
    if math.isnan(value):
        return math.nan
    if what.is_rate:
        return _of_rate(value, requirement.limit, what.level)
    least = float(MIN_DRAWS)
    if what.percent is not None:
        least = float(_of_quantile(what.percent, what.level))
    good = value >= requirement.limit if requirement.at_least else value <= requirement.limit
    # The end that has to pass the limit.
    end = low if good == requirement.at_least else high
    gap = abs(value - requirement.limit)
    if what.percent is not None and math.inf in (end, value) and draws >= least:
        return max(least, _of_rate(solved, what.percent / 100.0, what.level))
    if not math.isfinite(end) or not math.isfinite(value):
        return max(least, 2.0 * draws)
    if gap == 0.0:
        return math.inf
    reach = (end - value) / gap
    if what.is_of_logarithm and min(value, end) > 0.0:
        reach = math.log(end / value) / math.log(requirement.limit / value)
    if 2.0 <= draws < MIN_DRAWS and not what.exact:
        # Student's factor of so few draws is far above that of many.
        end_probability = (1.0 + what.level) / 2.0
        reach *= special.ndtri(end_probability) / special.stdtrit(draws - 1.0, end_probability)
    return _rounded(max(least, draws * reach ** 2))


def _of_rate(rate: float, limit: float, level: float) -> float:
    """Return the least power of about 1.1 at which the interval excludes the limit."""
    if rate == limit:
        return math.inf
    counts = np.unique(np.ceil(1.1 ** np.arange(1, 218)))

    def is_decided(n: float) -> bool:
        # Whole hits, rounded towards the limit.
        hits = math.floor(rate * n) if rate > limit else math.ceil(rate * n)
        low, high = clopper_pearson(hits, n, level)
        return bool(low > limit) if rate > limit else bool(high < limit)

    first = bisect.bisect_left(counts, True, key=is_decided)
    return _rounded(float(counts[first])) if first < len(counts) else math.inf


@functools.cache
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
