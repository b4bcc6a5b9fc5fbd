"""Confidence intervals of rates, and error probabilities of repeated looks."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from sweep.typing import Floats

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
