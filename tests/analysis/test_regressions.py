"""Whether a store is worse than an older one: plain paired tests of SciPy, and chance alone."""

import numpy as np
import pytest
from scipy import stats

from support.small_datasets import perfect
from sweep.analysis.comparisons import MARGIN, regressions
from sweep.errors import DatasetError
from sweep.measure.flags import DetectionStatus, EstimateStatus

SIZES = {"side_px": 3, "trial": 80, "solver": 2}


def changed(old, *, factor=1.0, lost=(), seed=1):
    """Return a dataset whose depth errors are larger, and that has lost poses by side."""
    new = old.copy(deep=True)
    noise = np.random.default_rng(seed).normal(1.0, 0.2, new["translation_error_m"].shape[:-1])
    new["translation_error_m"].values[..., 2] *= factor * noise
    for side, count in enumerate(lost):
        new["detection"].values[side, :count] = DetectionStatus.no_candidate
        new["estimate"].values[side, :count] = EstimateStatus.no_detection
    return new


def percent(results, side, solver):
    error = results["translation_error_m"].values[side, :, solver, 2].astype(np.float64)
    return np.abs(100.0 * error / results["true_tvec_m"].values[side, :, 2])


@pytest.mark.parametrize("factor", [1.02, 1.1])
def test_a_worse_error_is_found_as_by_plain_paired_intervals(factor):
    old = perfect(np.random.default_rng(3), SIZES)
    new = changed(old, factor=factor)
    tests = 2 * 3 * 2  # configurations, conditions, kinds
    found = [each for each in regressions(old, new, ["range_p95_percent"], ["side_px"])
             if each["units"] == "percent"]
    for solver, one in enumerate(found):
        worse = []
        for side in range(3):
            before = percent(old, side, solver)
            paired = stats.ttest_1samp(percent(new, side, solver) - before, 0.0)
            interval = paired.confidence_interval(1.0 - 0.05 / tests)
            worse.append(interval.low > MARGIN * before.mean())
            if old["side_px"].values[side] == one["condition"]["side_px"]:
                assert one["low"] == pytest.approx(interval.low, rel=1e-6)
                assert one["high"] == pytest.approx(interval.high, rel=1e-6)
        assert one["worse"] == any(worse)
    assert any(one["worse"] for one in found) == (factor > 1.05)


@pytest.mark.parametrize("lost", [0, 9, 10])
def test_a_worse_rate_is_found_as_by_the_exact_test(lost):
    old = perfect(np.random.default_rng(4), SIZES)
    found = regressions(old, changed(old, lost=[0, lost]), ["detection_rate"], ["side_px"])
    rate = next(one for one in found if one["quantity"] == "detection_rate")
    tests = 2 * 3 * 3
    p_value = stats.binomtest(lost, lost, 0.5).pvalue if lost else 1.0
    assert rate["worse"] == (p_value <= 0.05 / tests)
    if lost:
        assert rate["condition"] == {"side_px": 20.0}
        assert rate["difference"] == pytest.approx(-lost / 80)


def test_other_scenes_are_not_compared():
    old = perfect(np.random.default_rng(5), SIZES)
    with pytest.raises(DatasetError, match="nothing can be paired"):
        regressions(old, perfect(np.random.default_rng(6), SIZES))


@pytest.mark.evidence
def test_chance_alone_is_rarely_worse(claim):
    # 400 pairs of stores that differ by chance, each with 3 conditions: 5 % at most, expected 2.5.
    worse = 0
    for seed in range(400):
        old = perfect(np.random.default_rng(seed), {"side_px": 3, "trial": 60, "solver": 1})
        worse += any(one["worse"] for one in regressions(
            old, changed(old, seed=seed + 1000), ["range_rmse_percent"], ["side_px"]))
    claim("stores that are worse by chance alone", "400 simulated pairs; 5 % are allowed",
          worse / 4, "%")
    assert worse <= stats.binom.isf(1e-6, 400, 0.05)
