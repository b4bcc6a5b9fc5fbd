"""Intervals of a binomial proportion against 50 digits, published values and their coverage."""

import math

import numpy as np
import pytest
from mpmath import mp, mpf

from support.lengths import lengths
from sweep.analysis.estimator import clopper_pearson, wilson

METHODS = pytest.mark.parametrize("interval", [wilson, clopper_pearson])
MAX_N = 10**15
LEVELS = (1e-6, 0.5, 0.9, 0.95, 0.999, 1 - 1e-9)


@pytest.fixture(autouse=True, scope="module")
def _fifty_digits():
    with mp.workdps(50):
        yield


def edges(n):
    """Return the numbers of successes at which formulae break."""
    return sorted({0, 1, n // 10, n // 2, n - 1, n})


def drawn_counts(rng, largest):
    """Draw n and the successes or the failures evenly on a logarithmic scale."""
    n = int(np.exp(rng.uniform(0, math.log(largest))))
    some = min(n, int(np.exp(rng.uniform(0, math.log(n) + 1e-9))))
    return (some if rng.random() < 0.5 else n - some), n


def exact_wilson(successes, n, level):
    """Brown, Cai and DasGupta 2001, eq. 4, as it stands."""
    kappa = mp.findroot(
        lambda z: mp.erfc(z / mp.sqrt(2)) - (1 - mpf(level)), mp.sqrt(2) * mp.erfinv(level)
    )
    p = mpf(successes) / n
    centre = (successes + kappa**2 / 2) / (n + kappa**2)
    half = kappa * mp.sqrt(n) / (n + kappa**2) * mp.sqrt(p * (1 - p) + kappa**2 / (4 * n))
    return centre - half, centre + half


@lengths(30, 3000)
def test_wilson_keeps_its_digits_up_to_a_million_billion(count, claim):
    rng = np.random.default_rng(1)
    cases = [(s, n) for n in (1, 2, 10, 10**3, 10**9, MAX_N) for s in edges(n)]
    cases += [drawn_counts(rng, MAX_N) for _ in range(count)]
    worst = 0.0
    for i, (successes, n) in enumerate(cases):
        level = LEVELS[i % len(LEVELS)]
        exact = exact_wilson(successes, n, level)
        for end, truth in zip(wilson(successes, n, level), exact, strict=True):
            if truth > mpf(10) ** -45:  # at 0 of n the formula leaves what 50 digits cancel to
                worst = max(worst, float(abs(mpf(float(end)) / truth - 1)))
    claim("intervals of rates, up to 10^15 draws", "mpmath, 50 digits", worst)
    assert worst < 2e-15  # measured 5e-16: a few roundings


@pytest.mark.parametrize("n", [1, 2, 10, 1000])
def test_clopper_and_pearsons_is_the_root_that_fifty_digits_find(n):
    tail = (1 - mpf(0.95)) / 2
    for successes in edges(n):
        low, high = (float(end) for end in clopper_pearson(successes, n))
        a, b = mpf(successes), mpf(n - successes)
        if successes > 0:
            assert low == pytest.approx(float(root(a, b + 1, tail, low)), rel=2e-15)
        if successes < n:
            assert high == pytest.approx(float(1 - root(b, a + 1, tail, 1 - high)), rel=2e-15)


def root(a, b, tail, near):
    return mp.findroot(
        lambda x: mp.betainc(a, b, 0, x, regularized=True) - tail, (near, near * 0.999)
    )


@METHODS
@pytest.mark.parametrize("level", LEVELS)
def test_none_and_all_of_n_end_exactly_at_zero_and_one(interval, level):
    n = np.array([1, 2, 7, 1000, 10**9, MAX_N])
    low, high = interval(0, n, level)
    assert (low == 0.0).all()
    assert ((high > 0) & (high < 1)).all()
    low, high = interval(n, n, level)
    assert (high == 1.0).all()
    assert ((low > 0) & (low <= 1)).all()
    assert np.isnan(interval([0, 0], [0, 0], level)).all()
