"""Streaming mean and variance against 50 digits, in every order of merging."""

import functools
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mpmath import mp, mpf

from support.lengths import lengths
from sweep.analysis.statistic import Moments

# offset, spread: what is left of the spread is exact in the doubles, be it only three bits.
SCALES = [(1e9, 1e-3), (0.0, 1.0), (-3e5, 1e-9), (1e9, 1e9), (1e15, 1.0), (1e-100, 1e-110)]
SHAPES = {
    "normal": lambda rng, n: rng.normal(size=n),
    "two values": lambda rng, n: rng.choice([-1.0, 1.0], n),
    "drift": lambda rng, n: np.linspace(-1, 1, n) + rng.normal(0, 0.1, n),
    "outlier": lambda rng, n: np.append(1e6, rng.normal(size=n - 1)),
}
# Measured: 1e-15 of the variance in up to 100 merges, 1.2e-14 after a million merges of single
# values (70 s); each addition to m2 rounds by up to 1.1e-16, mostly in both directions.
VARIANCE = 1e-13


@pytest.fixture(autouse=True, scope="module")
def _fifty_digits():
    with mp.workdps(50):
        yield


def exact(values):
    """Return the mean and the variance of the doubles in ``values``."""
    numbers = [mpf(number) for number in values.tolist()]
    mean = mp.fsum(numbers) / len(numbers)
    return mean, mp.fsum((number - mean) ** 2 for number in numbers) / (len(numbers) - 1)


def errors(moments, truth):
    """Return the variance's relative error, and the mean's in ulp and in standard deviations."""
    mean, variance = truth
    missed = float(moments.variance)
    if variance:
        missed = float(abs(mpf(missed) / variance - 1))
    off = abs(mpf(float(moments.mean)) - mean)
    ulp = float(off / mpf(float(np.spacing(abs(moments.mean)))))
    return missed, ulp, float(off / mp.sqrt(variance)) if variance else float(off)


def drawn(rng, size):
    offset, spread = SCALES[rng.integers(len(SCALES))]
    return offset + spread * SHAPES[str(rng.choice(list(SHAPES)))](rng, size)


def random_pieces(rng, values, longest):
    """Cut ``values`` into pieces of 0 to ``longest`` values, short ones as likely as long ones."""
    cuts = [0]
    while cuts[-1] < len(values):
        cuts.append(cuts[-1] + int(np.exp(rng.uniform(-0.5, np.log(longest)))))
    return [Moments.of(values[a:b]) for a, b in itertools.pairwise(cuts)]


def merged_at_random(rng, pieces):
    while len(pieces) > 1:
        a = pieces.pop(rng.integers(len(pieces)))
        b = pieces.pop(rng.integers(len(pieces)))
        pieces.append(a.merge(b))
    return pieces[0]


def same(a, b):
    return all(
        np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        for name in ("count", "mean", "mean_tail", "m2")
    )


# Accuracy.

@lengths(20, 1000)
def test_any_chunks_merged_in_any_order_give_the_variance_of_fifty_digits(count):
    rng = np.random.default_rng(1)
    worst = 0.0
    for _ in range(count):
        values = drawn(rng, int(np.exp(rng.uniform(np.log(2), np.log(3000)))))
        pieces = random_pieces(rng, values, 300)
        variance, ulp, deviations = errors(merged_at_random(rng, pieces), exact(values))
        worst = max(worst, variance)
        assert variance <= VARIANCE
        # The double nearest to the mean, or, where the mean cancels, as near as the spread lets.
        assert ulp <= 0.51 or deviations <= 1e-15
    print(f"{count} series: variance {worst:.1e}")


@lengths(5000, 1_000_000)
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_tiny_spread_on_a_large_offset_keeps_its_variance(shape, count):
    rng = np.random.default_rng(2)
    values = 1e9 + 1e-3 * shape(rng, count)
    truth = exact(values)
    for moments in (
        Moments.of(values),
        merged_at_random(rng, random_pieces(rng, values, 1e5)),
        functools.reduce(Moments.merge, random_pieces(rng, values, 1e5)),
        functools.reduce(Moments.merge, random_pieces(rng, values, 1e5)[::-1]),
    ):
        variance, ulp, _ = errors(moments, truth)
        print(f"{count} values: variance {variance:.1e}, mean {ulp:.2f} ulp")
        assert variance <= VARIANCE  # measured 5e-16
        assert ulp <= 0.51  # measured 0.5: rounded once


FINITE = st.one_of(
    st.just(0.0),
    st.floats(1e-100, 1e100),
    st.floats(-1e100, -1e-100),
    st.integers(-50, 50).map(lambda steps: 1e9 + steps * 2.0**-23),
    st.sampled_from([1e15, 1e15 + 0.125, 1e-100, -1e100]),
)


@lengths(60, 5000)
def test_few_values_in_any_split_have_the_exact_moments(count):
    @settings(derandomize=True, deadline=None, max_examples=count)
    @given(st.lists(FINITE, min_size=2, max_size=12), st.data())
    def holds(numbers, data):
        values = np.array(numbers)
        mean, variance = exact(values)
        cuts = st.lists(st.integers(0, len(values)), max_size=5).map(sorted)
        pieces = [Moments.of(part) for part in np.split(values, data.draw(cuts))]
        order = data.draw(st.permutations(pieces))
        both = functools.reduce(Moments.merge, order)
        assert both.count == len(values)
        assert abs(mpf(float(both.variance)) - variance) <= 1e-14 * variance
        # The mean is the nearest double, up to what cancels among values of both signs.
        off = abs(mpf(float(both.mean)) + mpf(float(both.mean_tail)) - mean)
        assert off <= 1e-15 * mp.sqrt(variance)

    holds()


# Extremes.

@pytest.mark.parametrize("value", [0.1, 1e15, -1e9 / 3, 1e300, 5e-324, 0.0])
def test_equal_values_have_exactly_no_variance(value):
    values = np.full(1001, value)
    parts = [Moments.of(part) for part in np.split(values, [1, 4, 500])]
    for moments in (Moments.of(values), functools.reduce(Moments.merge, parts)):
        assert moments.m2 == 0.0
        assert moments.variance == 0.0
        assert (moments.mean, moments.mean_tail) == (value, 0.0)


def test_spread_below_the_spacing_of_doubles_is_that_of_the_stored_doubles():
    # At 1e15 doubles are 0.125 apart: a spread of 1e-3 is none, and one step is one step.
    rng = np.random.default_rng(5)
    assert Moments.of(1e15 + 1e-3 * rng.normal(size=1000)).variance == 0.0
    one_step = Moments.of([1e15, 1e15, 1e15 + 0.125, 1e15])
    assert one_step.variance == pytest.approx(0.125**2 / 4, rel=1e-15)


def test_squares_that_overflow_make_the_variance_infinite_and_leave_the_mean():
    values = np.array([1e300, 2e300, 3e300])
    for moments in (Moments.of(values), Moments.of(values[:1]).merge(Moments.of(values[1:]))):
        assert moments.mean == pytest.approx(2e300, rel=1e-15)
        assert moments.variance == np.inf
        assert moments.standard_deviation == np.inf
    # Their difference overflows too.
    opposite = Moments.of(1.7e308).merge(Moments.of(-1.7e308))
    assert (opposite.mean, opposite.mean_tail, opposite.m2) == (0.0, 0.0, np.inf)


def test_denormals_keep_their_mean_and_lose_their_variance():
    moments = Moments.of(np.array([1, 2, 6]) * 5e-324)
    assert moments.mean == 3 * 5e-324
    assert moments.variance == 0.0
    # Squares of 1e-150 are normal, squares of 1e-158 are denormal and keep seven digits.
    for spread, tolerance in ((1e-150, 1e-15), (1e-158, 1e-7)):
        deviation = Moments.of([-spread, spread]).standard_deviation
        assert deviation == pytest.approx(spread * np.sqrt(2), rel=tolerance, abs=0)


# What is not a number.

def test_no_value_has_no_mean_and_no_variance():
    for empty in (Moments.of([]), Moments.of([np.nan, np.nan]), Moments.of(np.zeros((3, 0)), 1)):
        assert (empty.count == 0).all()
        assert (empty.m2 == 0).all()
        for number in (empty.mean, empty.variance, empty.standard_deviation,
                       empty.standard_error):
            assert np.isnan(number).all()


def test_one_value_has_a_mean_and_no_variance():
    one = Moments.of([np.nan, 4.0])
    assert (one.count, one.mean) == (1, 4.0)
    assert np.isnan(one.variance)
    assert np.isnan(one.standard_error)


@pytest.mark.parametrize("values", [[], [4.0], [1e9, 1e9 + 0.3], [np.inf, 1.0], [np.inf, -np.inf]])
def test_merging_with_nothing_changes_nothing(values):
    moments, nothing = Moments.of(values), Moments.of([np.nan])
    assert same(moments.merge(nothing), moments)
    assert same(nothing.merge(moments), moments)


@pytest.mark.parametrize(("values", "mean"), [
    ([1.0, np.inf, 2.0], np.inf), ([-np.inf, 5.0], -np.inf), ([np.inf, np.inf], np.inf),
    ([np.inf, 0.0, -np.inf], np.nan), ([np.nan, np.inf], np.inf),
])
def test_an_infinite_value_is_the_mean_and_leaves_no_variance(values, mean):
    pieces = [Moments.of(value) for value in values]
    for moments in (Moments.of(values), functools.reduce(Moments.merge, pieces),
                    functools.reduce(Moments.merge, pieces[::-1])):
        assert np.array_equal(moments.mean, mean, equal_nan=True)
        assert np.isnan(moments.m2)
        assert np.isnan(moments.variance)


# Shapes.

@pytest.mark.parametrize("axis", [None, 0, 1, -1, (0, 1), (2, 0), (0, 1, 2)])
def test_every_axis_gives_the_same_bits_as_one_series_at_a_time(axis):
    values = 1e9 + 1e-3 * np.random.default_rng(6).normal(size=(4, 60, 5))
    moments = Moments.of(values, axis)
    over = tuple(range(3)) if axis is None else tuple(np.atleast_1d(axis) % 3)
    kept = [dimension for dimension in range(3) if dimension not in over]
    assert moments.count.shape == tuple(values.shape[dimension] for dimension in kept)
    for index in np.ndindex(moments.count.shape):
        chosen = [slice(None)] * 3
        for dimension, position in zip(kept, index, strict=True):
            chosen[dimension] = position
        series = values[tuple(chosen)]
        alone = Moments.of(series if len(over) < 2 or over[0] < over[1] else series.T)
        picked = Moments(moments.count[index], moments.mean[index], moments.mean_tail[index],
                         moments.m2[index])
        assert same(alone, picked)
