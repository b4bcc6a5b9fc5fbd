"""The rule of [precision] against plain loops over its conditions."""

import itertools

import numpy as np
import pytest
from scipy import stats

from sweep.analysis.decisions import wanted_precisions
from sweep.analysis.estimator import stopped_level
from sweep.analysis.intervals import LEVEL, clopper_pearson
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.sampling.rules import GroupResults, make_rule

TEXT = """
seed = 3
camera = { width_px = 64, height_px = 48 }
pose = { jitter_px = 0.5, side_px = 30 }
axes = { marker_id = [0, 1], tilt_deg = [0, 20, 40, 60], solver = ["ippe", "sqpnp"] }
search = { max_trials = 3000, per = ["tilt_deg"], precision = { WANTED } }
"""


def pipeline_of(wanted):
    return Pipeline.from_text(TEXT.replace("WANTED", wanted), name="precise")


def results_of(pipeline, trials, detected, sigma=(1.0, 1.0), seed=0):
    """Return results of both markers, with errors of the range in percent (normal)."""
    rng = np.random.default_rng(seed)
    shape = (2, 4, trials)
    flags = np.where(rng.random(shape) < np.asarray(detected)[None, :, None],
                     DetectionStatus.detected, DetectionStatus.no_candidate).astype(np.uint8)
    seen = (flags == DetectionStatus.detected)[..., None] & np.ones(2, bool)
    errors = rng.normal(size=(*shape, 2, 3)) * np.asarray(sigma)[:, None] / 100
    errors[~seen] = np.nan
    truth = np.zeros((*shape, 3))
    truth[..., 2] = 1.0
    return GroupResults(pipeline, (0, 0), (2, 4), 1, trials, {
        "detection": flags,
        "estimate": np.where(seen, EstimateStatus.solved, EstimateStatus.no_detection),
        "flipped": np.where(seen, Flipped.not_flipped, Flipped.no_estimate),
        "rotation_error_rad": errors, "translation_error_m": errors, "true_tvec_m": truth,
    })


@pytest.mark.parametrize("trials", [25, 50, 75, 600])
def test_a_rate_needs_trials_until_its_interval_is_narrow(trials):
    pipeline = pipeline_of("detection_rate = 0.04")
    results = results_of(pipeline, trials, [0.0, 0.02, 0.5, 1.0])
    expected = []
    for k in range(4):
        n = 2 * trials  # both markers together
        hits = int((results.values["detection"][:, k] == 1).sum())
        low = stats.beta.ppf(0.015, hits, n - hits + 1) if hits else 0.0
        high = stats.beta.isf(0.015, hits + 1, n - hits) if hits < n else 1.0
        expected.append((high - low) / 2 > 0.04)
    needed = make_rule(pipeline).needed(results)
    assert needed.tolist() == [expected, expected]


def test_every_configuration_and_every_quantity_must_be_known():
    """Of 1,200 normal errors the RMSE is known to about 1.96 / sqrt(2,400) = 4 %."""
    trials = 600
    for wanted, expected in (('range_rmse_percent = "6 %"', False),
                             ('range_rmse_percent = "4.5 %"', True),
                             ('range_rmse_percent = "6 %", detection_rate = 0.001', True)):
        pipeline = pipeline_of(wanted)
        results = results_of(pipeline, trials, [1.0] * 4)
        assert make_rule(pipeline).needed(results).all() == expected
    # One solver's quantiles are infinite half of the time: its configuration alone needs more.
    pipeline = pipeline_of('range_median_percent = "20 %"')
    results = results_of(pipeline, trials, [1.0] * 4)
    assert not make_rule(pipeline).needed(results).any()
    results.values["estimate"][:, 2, ::2, 1] = EstimateStatus.solver_failed
    assert make_rule(pipeline).needed(results).any(axis=0).tolist() == [False, False, True, False]


def test_a_bias_is_relative_to_the_root_mean_square():
    """Half of Student's interval of 97 % of 1,200 draws is 2.17 / sqrt(1,200) = 6.3 % of it."""
    for wanted, expected in (("7 %", False), ("6 %", True)):
        pipeline = pipeline_of(f'range_bias_percent = "{wanted}"')
        needed = make_rule(pipeline).needed(results_of(pipeline, 600, [1.0] * 4))
        assert needed.all() == needed.any() == expected


def test_what_cannot_be_seen_or_solved_is_settled():
    pipeline = pipeline_of('range_rmse_percent = "5 %"')
    results = results_of(pipeline, 300, [0.0, 0.5, 0.5, 0.5])
    results.values["detection"][:, 3] = DetectionStatus.not_visible
    results.values["estimate"][:, 3] = EstimateStatus.no_detection
    needed = make_rule(pipeline).needed(results)
    assert needed.tolist() == [[False, True, True, False]] * 2


def test_a_smaller_half_width_needs_every_trial_that_a_larger_one_needs():
    for trials in (25, 100, 300):
        needed = []
        for width in (0.3, 0.1, 0.03, 0.01):
            pipeline = pipeline_of(f"detection_rate = {width}, range_p95_percent = {width}, "
                                   f"flip_rate = {width}, range_bias_percent = {width}")
            results = results_of(pipeline, trials, [0.0, 0.03, 0.5, 1.0])
            needed.append(make_rule(pipeline).needed(results))
        for looser, stricter in itertools.pairwise(needed):
            assert (stricter | ~looser).all()


@pytest.mark.parametrize("width", [0.49, 0.2, 0.05, 0.01])
def test_no_fewer_draws_than_are_told_make_an_interval_as_narrow(width):
    fewest = wanted_precisions({"detection_rate": width})[0].fewest_draws
    widths = [clopper_pearson(0, n, stopped_level(LEVEL))[1] / 2 for n in (fewest - 1, fewest)]
    assert widths[1] <= width < widths[0]
    assert wanted_precisions({"rotation_rmse_deg": width})[0].fewest_draws == 450
