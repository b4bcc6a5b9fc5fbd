"""Rates of false markers: the closed form, the exact interval, and OpenCV on random bits."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, binomtest

import sweep

FOLDER = Path(__file__).parents[1] / "pipelines" / "false_positives"
RATES = runpy.run_path(str(FOLDER / "rates.py"))


@pytest.mark.parametrize(("false", "candidates"), [(0, 9), (3, 57), (9, 9)])
def test_the_interval_is_scipys_exact_one(false, candidates):
    known = binomtest(false, candidates).proportion_ci(0.95, "exact")
    assert RATES["interval"](false, candidates) == pytest.approx((known.low, known.high))


@pytest.mark.parametrize(("name", "rate"), [("4X4_1000", 0.6), ("APRILTAG_16h5", 1.0)])
def test_random_bits_are_read_as_often_as_the_closed_form_says(name, rate):
    """The probability that a sound count is refused is below 1e-6 (binomial)."""
    dictionary, generator = RATES["dictionary_of"](name), np.random.default_rng(1)
    images = [RATES["random_codes"](generator, dictionary.markerSize) for _ in range(8)]
    squares = RATES["SQUARES"] * len(images)
    false, _ = RATES["count"](images, dictionary, rate)
    low, high = binom.interval(1 - 1e-6, squares, RATES["closed_form"](dictionary, rate))
    assert low <= false <= high


def test_the_gain_of_error_correction_can_be_measured():
    pipeline = sweep.Pipeline.from_toml(FOLDER / "gain.toml")
    assert [axis.name for axis in pipeline.axes][-2:] == ["errorCorrectionRate", "trial"]
