"""Confidence intervals: of rates and means, by resampling, and at repeated looks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# Confidence intervals of a binomial proportion, a rate of ``successes`` of ``n``.
#
# Brown, Cai and DasGupta, "Interval Estimation for a Binomial Proportion", Statistical Science
# 16(2), 2001, doi:10.1214/ss/1009213286, recommends both for small n.

#: Probability with which every interval of a table holds its value.
LEVEL = 0.95

#: Probability beyond each end.
TAIL = (1.0 - LEVEL) / 2.0

#: Standard deviations from the middle to the ends, of a normal variable: 1.96.
DEVIATIONS = float(special.ndtri(1.0 - TAIL))


def wilson(successes: ArrayLike, n: ArrayLike, level: float = LEVEL) -> tuple[Floats, Floats]:
    """Return the ends (low, high) of Wilson's score interval, of the broadcast shape.

    Brown, Cai and DasGupta 2001, section 3.1.1, eq. 4. The lower end is taken from the product of
    both, successes² / (n (n + κ²)), so that nothing cancels: each is right to 1e-15 of itself.

    Counts are whole numbers up to 1e15: so far n, n - successes and successes + 1/2 are exact in
    doubles. ``n = 0`` gives NaN, NaN; 0 of n has low = 0 and n of n has high = 1, exactly.

    >>> low, high = wilson([0, 15], [20, 148])
    >>> low.round(4).tolist(), high.round(4).tolist()
    ([0.0, 0.0624], [0.1611, 0.1605])
    """
    successes, n = _counts(successes, n)
    kappa = float(np.sqrt(2.0) * special.erfinv(level))  # keeps the digits of any level
    with np.errstate(all="ignore"):
        spread = kappa * np.sqrt(successes * ((n - successes) / n) + kappa**2 / 4)
        upper = successes + kappa**2 / 2 + spread
        return _with_exact_ends(successes, n, successes / n * (successes / upper),
                                upper / (n + kappa**2))


def clopper_pearson(
    successes: ArrayLike, n: ArrayLike, level: float = LEVEL
) -> tuple[Floats, Floats]:
    """Return the ends (low, high) of Clopper and Pearson's interval, of the broadcast shape.

    Quantiles of Beta(successes, n - successes + 1) and Beta(successes + 1, n - successes), 0 at 0
    of n and 1 at n of n: each end is right with (1 + level) / 2 at least, whatever the rate.
    Clopper and Pearson, Biometrika 26(4), 1934, doi:10.1093/biomet/26.4.404.

    Counts, ``n = 0`` and exact ends as in `wilson`.

    >>> low, high = clopper_pearson([0, 1], 50)
    >>> low.round(4).tolist(), high.round(4).tolist()
    ([0.0, 0.0005], [0.0711, 0.1065])
    """
    successes, n = _counts(successes, n)
    tail, failures = (1.0 - level) / 2.0, n - successes
    low = special.betaincinv(np.maximum(successes, 1.0), failures + 1.0, tail)
    high = special.betainccinv(successes + 1.0, np.maximum(failures, 1.0), tail)
    return _with_exact_ends(successes, n, low, high)


def _counts(successes: ArrayLike, n: ArrayLike) -> tuple[Floats, Floats]:
    """Return the counts as float64 of one shape."""
    successes, n = np.broadcast_arrays(np.asarray(successes, np.float64), np.asarray(n, np.float64))
    return successes, n


def _with_exact_ends(
    successes: Floats, n: Floats, low: Floats, high: Floats
) -> tuple[Floats, Floats]:
    low = np.where(successes == 0, 0.0, low)
    high = np.where(successes == n, 1.0, high)
    return np.where(n == 0, np.nan, low), np.where(n == 0, np.nan, high)


# --------------------------------------------------------------------------------------------------
# Quantiles of resampled units: the bootstrap where values of one unit are not independent.
#
# A unit, such as a photograph, is drawn with all its values (Davison and Hinkley, "Bootstrap
# Methods and their Application", 1997, section 3.8). The draws are the same in each call.

REPLICATES = 1000

#: Units from which there are intervals.
MIN_UNITS = 5

SEED = 21

#: Weights that are in memory at a time: 32 MB.
MAX_AT_ONCE = 1 << 22


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


# --------------------------------------------------------------------------------------------------
# Decisions that are looked at again and again: the error probability that each look may spend.
#
# Trials come in waves, and after each wave it is asked whether a requirement is met. If every
# look had the error probability of a single one, the first that errs would end the search. So
# each spends a part. Looks at the same growing sample err together, so that the part may be
# larger than one over their number (Bonferroni): by `looks_factor`. For rates that it suffices is
# enumerated exactly (`pytest -m evidence tests/sampling/test_limit_search.py`).

FIRST, EACH = 0.35, 0.65


def looks_factor(count: int) -> float:
    """Return by how much the error probability of a decision is divided for each of its looks.

    It is for samples that grow by a quarter or more from look to look; a single look has 1.

    Of Clopper and Pearson's interval, enumerated over all paths of the counts at 1 to 21 looks up
    to 10,000 draws, rates from 0.01 to 0.99 and errors from 0.025 to 1e-4, the probability that
    any look errs is then at most 1.006 times a single look's.

    Examples
    --------
    >>> looks_factor(1), round(looks_factor(14), 1)
    (1.0, 9.4)
    """
    return FIRST + EACH * count
