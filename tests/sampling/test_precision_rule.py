"""The rule of [precision] against plain loops over its conditions."""

import numpy as np
import pytest
from scipy import stats

from support.searches import flags_of, needed_by
from support.small_datasets import perfect
from sweep.analysis.estimator import LEVEL, clopper_pearson, stopped_level
from sweep.analysis.requirements import Reached, precision_reached, wanted_precisions
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.sampling.rules import make_rule

TEXT = """
seed = 3
camera = { width_px = 64, height_px = 48 }
pose = { jitter_px = 0.5, side_px = 30 }
axes = { marker_id = [0, 1], tilt_deg = [0, 20, 40, 60], solver = ["ippe", "sqpnp"] }
search = { max_trials = 3000, per = ["tilt_deg"], precision = { WANTED } }
"""


def pipeline_of(wanted):
    return Pipeline.from_text(TEXT.replace("WANTED", wanted), name="precise")


def results_of(trials, detected, sigma=(1.0, 1.0), seed=0):
    """Return results of both markers, with errors of the range in percent (normal)."""
    rng = np.random.default_rng(seed)
    shape = (2, 4, trials)
    found = rng.random(shape) < np.asarray(detected)[None, :, None]
    flags = np.where(found, DetectionStatus.detected, DetectionStatus.no_candidate)
    errors = rng.normal(size=(*shape, 2, 3)) * np.asarray(sigma)[:, None] / 100
    errors[~found] = np.nan
    truth = np.zeros((*shape, 3))
    truth[..., 2] = 1.0
    return {
        **flags_of(flags, 2), "true_tvec_m": truth, **dict.fromkeys(
            ("rotation_error_rad", "translation_error_m"), errors.swapaxes(2, 3)),
    }


def needed(pipeline, results):
    rule = make_rule(pipeline)
    return needed_by(rule, {name: results[name] for name in rule.variables})


@pytest.mark.parametrize("trials", [50, 75, 600])
def test_a_rate_needs_trials_until_its_interval_is_narrow(trials):
    pipeline = pipeline_of("detection_rate = 0.04")
    results = results_of(trials, [0.0, 0.02, 0.5, 1.0])
    expected = []
    for k in range(4):
        hits = int((results["detection"][:, k] == 1).sum())  # both markers together
        ends = stats.binomtest(hits, 2 * trials).proportion_ci(0.97, method="exact")
        expected.append((ends.high - ends.low) / 2 > 0.04)
    assert needed(pipeline, results).tolist() == [expected, expected]


@pytest.mark.parametrize(("wanted", "expected"), [
    # Of 1,200 normal errors the RMSE is known to about 1.96 / sqrt(2,400) = 4 %.
    ('range_rmse_percent = "6 %"', False), ('range_rmse_percent = "4.5 %"', True),
    ('range_rmse_percent = "6 %", detection_rate = 0.001', True),
    # Half of Student's interval of 97 % of 1,200 draws is 2.17 / sqrt(1,200) = 6.3 % of it.
    ('range_bias_percent = "7 %"', False), ('range_bias_percent = "6 %"', True),
])
def test_every_quantity_must_be_known_relative_to_the_root_mean_square(wanted, expected):
    pipeline = pipeline_of(wanted)
    more = needed(pipeline, results_of(600, [1.0] * 4))
    assert more.all() == more.any() == expected


def test_a_configuration_of_which_too_little_is_known_needs_more():
    """One solver's quantiles are infinite half of the time."""
    pipeline = pipeline_of('range_median_percent = "20 %"')
    results = results_of(600, [1.0] * 4)
    assert not needed(pipeline, results).any()
    results["estimate"][:, 2, 1, ::2] = EstimateStatus.solver_failed
    assert needed(pipeline, results).any(axis=0).tolist() == [False, False, True, False]


def test_what_cannot_be_seen_or_solved_is_settled():
    pipeline = pipeline_of('range_rmse_percent = "5 %"')
    results = results_of(300, [0.0, 0.5, 0.5, 0.5])
    results["detection"][:, 3] = DetectionStatus.not_visible
    results["estimate"][:, 3] = EstimateStatus.no_detection
    assert needed(pipeline, results).tolist() == [[False, True, True, False]] * 2


@pytest.mark.parametrize(("most", "reached"), [(49, "not_reached"), (50, "too_rare")])
def test_a_rate_is_too_rare_where_all_trials_could_give_enough(most, reached):
    """One of all poses is looked for: 50 trials would be enough if they all were."""
    results = perfect(np.random.default_rng(1), {"trial": most, "solver": 1})
    results["detection"].values[1:] = DetectionStatus.not_visible
    table = precision_reached(results, {"detection": 0.02})
    assert Reached(table["reached"].item()).name == reached


@pytest.mark.parametrize("width", [0.49, 0.05, 0.01])
def test_no_fewer_draws_than_are_told_make_an_interval_as_narrow(width):
    fewest = wanted_precisions({"detection_rate": width})[0][0].fewest_draws
    widths = [clopper_pearson(0, n, stopped_level(LEVEL))[1] / 2 for n in (fewest - 1, fewest)]
    assert widths[1] <= width < widths[0]
    assert wanted_precisions({"rotation_rmse_deg": width})[0][0].fewest_draws == 450
    quantile = wanted_precisions({"rotation_p95_deg": width})[0][0].fewest_draws
    assert 0.95**quantile <= (1.0 - stopped_level(LEVEL)) / 2.0 < 0.95 ** (quantile - 1)
