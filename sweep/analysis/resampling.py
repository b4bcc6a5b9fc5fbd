"""Quantiles of resampled units: the bootstrap where values of one unit are not independent.

A unit, such as a photograph, is drawn with all its values (Davison and Hinkley, "Bootstrap Methods
and their Application", 1997, section 3.8). The draws are the same in each call.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sweep.analysis.intervals import LEVEL
from sweep.typing import Floats, Masks

REPLICATES = 1000

MIN_UNITS = 5
"""Units from which there are intervals."""

SEED = 21

MAX_AT_ONCE = 1 << 22
"""Weights that are in memory at a time: 32 MB."""


def unit_counts(units: int) -> NDArray[np.int64]:
    """Return how often each unit is drawn in each replicate, (replicates, units)."""
    generator = np.random.default_rng(SEED)
    return generator.multinomial(units, np.full(units, 1.0 / units), REPLICATES)


def resampled_quantiles(
    values: Floats, used: Masks, counts: NDArray[np.int64] | None, share: float
) -> Floats:
    """Return a quantile of each replicate, (replicates,); NaN where none of the units has a value.

    Parameters
    ----------
    values, used
        (units, rows): the values of each unit, and which there are.
    counts
        (replicates, units) as of :func:`unit_counts`; None if each unit has one value at most.
        A replicate's quantile is then a random order statistic, whose rank is that of a share
        drawn from a beta distribution, and no weights are needed.
    share
        Of the values, at or below the quantile.
    """
    unit, _ = np.nonzero(used)
    some = values[used]
    if not len(some):
        return np.full(REPLICATES, np.nan)
    order = np.argsort(some, kind="stable")
    ascending, unit = some[order], unit[order]
    n = len(some)
    if counts is None:
        rank = max(int(np.ceil(share * n - 1e-9)), 1)
        drawn = np.random.default_rng(SEED + 1).beta(rank, n - rank + 1, REPLICATES)
        return np.asarray(ascending[np.minimum((n * drawn).astype(np.int64), n - 1)])
    result = np.empty(REPLICATES)
    step = max(MAX_AT_ONCE // n, 1)
    for start in range(0, REPLICATES, step):
        weights = np.cumsum(counts[start : start + step][:, unit], axis=1)
        wanted = share * weights[:, -1:] - 1e-9
        first = np.argmax(weights >= np.maximum(wanted, 1), axis=1)
        result[start : start + step] = np.where(weights[:, -1] > 0, ascending[first], np.nan)
    return result


def percentile_interval(replicates: Floats, units: int) -> tuple[float, float]:
    """Return the ends of the expanded percentile interval of replicates (n,).

    The tails are those that make the interval of a mean of ``units`` normal values Student's:
    Hesterberg, The American Statistician 69(4), 2015, doi:10.1080/00031305.2015.1089789, section
    5.3. NaN of fewer than :data:`MIN_UNITS` units, or where too few replicates have a value.
    """
    known = replicates[~np.isnan(replicates)]
    if units < MIN_UNITS or len(known) < 0.95 * len(replicates):
        return float("nan"), float("nan")
    tail = expanded_tail(units)
    ends: Sequence[float] = np.quantile(
        known, [tail, 1.0 - tail], method="inverted_cdf"
    ).tolist()
    return ends[0], ends[1]


def expanded_tail(units: int, level: float = LEVEL) -> float:
    """Return the probability beyond each end of a percentile interval of some units.

    >>> round(expanded_tail(10), 4), round(expanded_tail(10**6), 4)
    (0.0086, 0.025)
    """
    reach = special.stdtrit(units - 1, (1.0 - level) / 2.0)
    return float(special.ndtr(np.sqrt(units / (units - 1)) * reach))
