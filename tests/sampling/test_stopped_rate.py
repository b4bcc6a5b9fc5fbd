"""The exact properties of a rate whose sampling stops, against all sequences and against SciPy."""

import functools
import itertools

import numpy as np
import pytest
from scipy import stats

from support.stopped_rate import StoppedRate
from sweep.analysis.estimator import TAIL_SHARE
from sweep.experiment.sampling import wave_ends

ALPHA = 0.05 * TAIL_SHARE
RATES = (0.0, 0.001, 0.01, 0.1, 0.5, 0.9, 0.99, 1.0)


@functools.cache
def clopper_pearson(k, n):
    """Return the interval as SciPy's beta distribution has it."""
    low = stats.beta.ppf(ALPHA / 2, k, n - k + 1) if k else 0.0
    high = stats.beta.isf(ALPHA / 2, k + 1, n - k) if k < n else 1.0
    return low, high


def of_all_sequences(half_width, ends, rate):
    """Return coverage, bias and draws, of every sequence of successes."""
    coverage = mean = draws = 0.0
    for sequence in itertools.product((0, 1), repeat=ends[-1]):
        probability = float(np.prod([rate if hit else 1 - rate for hit in sequence]))
        for n in ends:
            k = sum(sequence[:n])
            low, high = clopper_pearson(k, n)
            if (high - low) / 2 <= half_width or n == ends[-1]:
                break
        coverage += probability * (low <= rate <= high)
        mean += probability * k / n
        draws += probability * n
    return coverage, mean - rate, draws


@pytest.mark.parametrize("rate", [0.02, 0.3])
def test_the_enumeration_has_the_properties_of_all_sequences(rate):
    expected = of_all_sequences(0.31, (3, 6, 9), rate)
    assert StoppedRate(0.31, (3, 6, 9)).at(rate) == pytest.approx(expected, abs=1e-12)
    assert expected[2] < 9   # some stop before


def test_coverage_is_kept_at_rates_from_0_to_1_and_needs_the_smaller_tails():
    ends = wave_ends(3000, 50)
    rule = StoppedRate(0.02, ends)
    assert min(rule.at(rate).coverage for rate in RATES) >= 0.95
    assert rule.at(0.0).draws <= 150
    assert rule.at(0.5).draws > 2500
    for rate in RATES:
        total = sum(probability.sum() for _, _, probability in rule.stopped(rate))
        assert total == pytest.approx(1.0, abs=1e-9)
    # With alpha = 0.05 the same rule covers less than 95 % somewhere.
    plain = StoppedRate(0.02, ends, level=1.0 - 0.05 / TAIL_SHARE)
    assert min(plain.at(rate).coverage for rate in np.linspace(0.02, 0.08, 120)) < 0.95


def enough(half_width):
    """Return trials that are enough for an interval of any rate."""
    return int(1.7 / half_width**2) + 200


def rules_of_width(half_width, rng):
    """Yield rules of waves of any first length (those of flips are shorter) and most trials."""
    for unit in (5, 50, 99):
        for most in (enough(half_width), int(enough(half_width) * rng.uniform(0.05, 0.5)) + unit):
            yield StoppedRate(half_width, wave_ends(most, unit))


def rules_of_level(level, _rng):
    """Yield rules whose intervals have another level, as requirements of many conditions need.

    Trials stop by intervals of 95 %.
    """
    for half_width in (0.01, 0.02, 0.05):
        yield StoppedRate(half_width, wave_ends(enough(half_width), 50), level)


def rules_of_solved(share, rng):
    """Yield rules of a flip rate: of the solved poses alone, whose waves have random lengths."""
    for _ in range(5):
        n = np.cumsum(rng.binomial(np.diff((0, *wave_ends(4500, 50))), share))
        yield StoppedRate(0.02, tuple(np.unique(n[n > 0]).tolist()))


@pytest.mark.long
@pytest.mark.parametrize(("rules", "value", "most", "error"), [
    *((rules_of_width, half_width, 60, 0.05) for half_width in (0.01, 0.03, 0.1, 0.25)),
    # At 0.9999 the error is up to 1.18 times that promised, beside 4,000 ends of each rule.
    *((rules_of_level, level, 30, times * (1 - level))
      for level, times in ((0.9, 1.0), (0.99, 1.0), (0.9999, 1.2))),
    (rules_of_solved, 0.3, 60, 0.05),
])
def test_the_least_coverage_of_any_rate_is_as_promised(rules, value, most, error, claim):
    """It lies beside an end of an interval, of which ``most`` are drawn."""
    rng = np.random.default_rng(20)
    for rule in rules(value, rng):
        ends = rule.critical_rates()
        ends = ends[ends <= 0.5]  # it is symmetric
        if len(ends) > most:
            ends = rng.choice(ends, most, replace=False)
        beside = np.concatenate([ends * (1 - 1e-9), ends * (1 + 1e-9)])
        missed = 1.0 - min(rule.at(rate).coverage for rate in beside)
        if error == 0.05:
            claim("intervals of 95 % of rates whose sampling stops, and do not hold the truth",
                  "exact enumeration", 100 * missed, "%")
            assert max(abs(rule.at(rate).bias) for rate in ends) < 0.25 * rule.half_width
        assert missed <= error
