"""A belief that is not the truth costs accuracy, and is no choice that is recommended."""

import pytest

from sweep.experiment.experiment import wrong_beliefs
from sweep.experiment.pipeline import Pipeline


@pytest.mark.parametrize(("axis", "wrong"), [
    ("believed_focal_scale = [0.99, 1, 1.01]", [True, False, True]),
    ("believed_fx_px = [500, 510]", [False, True]),
    ('believed = ["truth", "calibration"]', [False, True]),
    ("believed_distortion = [[], [0.1, 0, 0, 0], [0, 0, 0, 0]]", [False, True, False]),
    ('solver = ["ippe", "iterative"]', [False, False]),
    ('pair = { zip = { believed_focal_scale = [1.0, 1.1], solver = ["ippe", "ap3p"] } }',
     [False, True]),
])
def test_a_belief_is_wrong_where_it_differs_from_the_truth(axis, wrong):
    calibrated = "calibration_sd = [1, 1, 1, 1]" if "calibration" in axis else ""
    pipeline = Pipeline.from_text(
        f"seed = 1\n[camera]\nfx_px = 500\n{calibrated}\n[pose]\nside_px = 40\n[axes]\n{axis}")
    assert list(wrong_beliefs(pipeline, pipeline.axes[0])) == wrong
