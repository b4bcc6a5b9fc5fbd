"""Confidence intervals of a binomial proportion, a rate of ``successes`` of ``n``.

Brown, Cai and DasGupta, "Interval Estimation for a Binomial Proportion", Statistical Science
16(2), 2001, doi:10.1214/ss/1009213286, recommends both for small n.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from sweep.errors import ArgumentError
from sweep.typing import Floats

LEVEL = 0.95
"""Probability with which every interval of a table holds its value."""

TAIL = (1.0 - LEVEL) / 2.0
"""Probability beyond each end."""

DEVIATIONS = float(special.ndtri(1.0 - TAIL))
"""Standard deviations from the middle to the ends, of a normal variable: 1.96."""

MAX_N = 10**15  # up to here n, n - successes and successes + 1/2 are exact in doubles
# With as many successes and failures, the Cornish-Fisher expansion is right to 3e-12; scipy's
# inverse is off by up to 7e-12 below that, and by up to 1e-8 far above.
MANY = 3e6


def wilson(successes: ArrayLike, n: ArrayLike, level: float = LEVEL) -> tuple[Floats, Floats]:
    """Return the ends (low, high) of Wilson's score interval, of the broadcast shape.

    Brown, Cai and DasGupta 2001, section 3.1.1, eq. 4. The lower end is taken from the product of
    both, successes² / (n (n + κ²)), so that nothing cancels: each is right to 1e-15 of itself.

    ``n = 0`` gives NaN, NaN; 0 of n has low = 0 and n of n has high = 1, exactly. Raises
    ``ValueError`` for counts that are not whole, not 0 <= successes <= n <= 1e15, or NaN, and for
    a level outside (0, 1).

    >>> low, high = wilson([0, 15], [20, 148])
    >>> low.round(4).tolist(), high.round(4).tolist()
    ([0.0, 0.0624], [0.1611, 0.1605])
    """
    successes, n, level = _checked(successes, n, level)
    kappa = _kappa(level)
    with np.errstate(all="ignore"):
        spread = kappa * np.sqrt(successes * ((n - successes) / n) + kappa**2 / 4)
        upper = successes + kappa**2 / 2 + spread
        return _with_exact_ends(successes, n, successes / n * (successes / upper),
                                upper / (n + kappa**2))


def jeffreys(successes: ArrayLike, n: ArrayLike, level: float = LEVEL) -> tuple[Floats, Floats]:
    """Return the ends (low, high) of Jeffreys' equal-tailed interval, of the broadcast shape.

    Quantiles of Beta(successes + 1/2, n - successes + 1/2), and 0 at 0 of n, 1 at n of n: Brown,
    Cai and DasGupta 2001, section 3.1.3. Each is right to 1e-11 of itself. The upper end comes
    from its own tail, for 1 - tail is not a double; where it is near 1 its distance from 1 is the
    lower end for n - successes.

    ``n = 0``, exact ends and ``ValueError`` as in `wilson`.

    >>> low, high = jeffreys([0, 5], 7)
    >>> low.round(3).tolist(), high.round(3).tolist()
    ([0.0, 0.352], [0.292, 0.935])
    """
    successes, n, level = _checked(successes, n, level)
    a, b = successes + 0.5, n - successes + 0.5
    kappa, tail = _kappa(level), (1.0 - level) / 2.0
    few = np.minimum(a, b) < MANY
    low = np.where(few, special.betaincinv(a, b, tail), _cornish_fisher(a, b, -kappa))
    high = np.where(few, special.betainccinv(a, b, tail), _cornish_fisher(a, b, kappa))
    return _with_exact_ends(successes, n, low, high)


def clopper_pearson(
    successes: ArrayLike, n: ArrayLike, level: float = LEVEL
) -> tuple[Floats, Floats]:
    """Return the ends (low, high) of Clopper and Pearson's interval, of the broadcast shape.

    Quantiles of Beta(successes, n - successes + 1) and Beta(successes + 1, n - successes), 0 at 0
    of n and 1 at n of n: each end is right with (1 + level) / 2 at least, whatever the rate.
    Clopper and Pearson, Biometrika 26(4), 1934, doi:10.1093/biomet/26.4.404.

    ``n = 0``, exact ends and ``ValueError`` as in `wilson`.

    >>> low, high = clopper_pearson([0, 1], 50)
    >>> low.round(4).tolist(), high.round(4).tolist()
    ([0.0, 0.0005], [0.0711, 0.1065])
    """
    successes, n, level = _checked(successes, n, level)
    tail, failures = (1.0 - level) / 2.0, n - successes
    low = special.betaincinv(np.maximum(successes, 1.0), failures + 1.0, tail)
    high = special.betainccinv(successes + 1.0, np.maximum(failures, 1.0), tail)
    return _with_exact_ends(successes, n, low, high)


def _checked(
    successes: ArrayLike, n: ArrayLike, level: float,
) -> tuple[Floats, Floats, float]:
    """Return the counts as float64 of one shape, and the level, if they are good."""
    if not 0.0 < level < 1.0:
        raise ArgumentError("level", level, "expected a number between 0 and 1, such as 0.95")
    successes, n = np.broadcast_arrays(
        np.asarray(successes, dtype=np.float64), np.asarray(n, dtype=np.float64)
    )
    good = (successes >= 0) & (successes <= n) & (n <= MAX_N)
    bad = ~(good & (np.floor(successes) == successes) & (np.floor(n) == n))
    if bad.any():
        raise ArgumentError(
            "successes", f"{successes[bad][0]:.17g}, n = {n[bad][0]:.17g}",
            f"expected whole numbers with 0 <= successes <= n <= {MAX_N:.0e}")
    return successes, n, float(level)


def _kappa(level: float) -> float:
    """Return κ, the normal quantile at (1 + level) / 2; erfinv keeps the digits of any level."""
    return float(np.sqrt(2.0) * special.erfinv(level))


def _cornish_fisher(a: Floats, b: Floats, z: float) -> Floats:
    """Return the quantile of Beta(a, b) at Φ(z), off by the order of min(a, b)⁻² of itself.

    Abramowitz and Stegun 26.2.49 with the cumulants of 26.1.33.
    """
    n = a + b
    deviation = np.sqrt(a * b / (n + 1)) / n
    skewness = 2 * (b - a) * np.sqrt(n + 1) / ((n + 2) * np.sqrt(a * b))
    excess = 6 * ((a - b) ** 2 * (n + 1) - a * b * (n + 2)) / (a * b * (n + 2) * (n + 3))
    bend = skewness * (z**2 - 1) / 6 + excess * (z**3 - 3 * z) / 24
    return np.asarray(a / n + deviation * (z + bend - skewness**2 * (2 * z**3 - 5 * z) / 36))


def _with_exact_ends(
    successes: Floats, n: Floats, low: Floats, high: Floats
) -> tuple[Floats, Floats]:
    low = np.where(successes == 0, 0.0, low)
    high = np.where(successes == n, 1.0, high)
    return np.where(n == 0, np.nan, low), np.where(n == 0, np.nan, high)
