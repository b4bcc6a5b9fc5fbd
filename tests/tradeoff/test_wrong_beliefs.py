"""A belief that is not the truth costs accuracy, and is no choice that is recommended."""

import numpy as np
import xarray as xr

from sweep.experiment.experiment import wrong_beliefs
from sweep.experiment.pipeline import Pipeline
from sweep.tradeoff.pareto import WRONG_BELIEF, mark_front

TEXT = """seed = 1
[camera]
fx_px = 500
[pose]
side_px = 40
[axes]
"""


def flags(axis, camera=""):
    pipeline = Pipeline.from_text(TEXT.replace("fx_px = 500", f"fx_px = 500\n{camera}") + axis)
    return list(wrong_beliefs(pipeline, pipeline.axes[0]))


def test_a_belief_is_wrong_where_it_differs_from_the_truth():
    assert flags("believed_focal_scale = [0.99, 1, 1.01]") == [True, False, True]
    assert flags("believed_fx_px = [500, 510]") == [False, True]
    assert flags('believed = ["truth", "calibration"]', "calibration_sd = [1, 1, 1, 1]") == [
        False, True]
    assert flags("believed_distortion = [[], [0.1, 0, 0, 0], [0, 0, 0, 0]]") == [
        False, True, False]
    assert flags('solver = ["ippe", "iterative"]') == [False, False]
    assert flags('pair = { zip = { believed_focal_scale = [1.0, 1.1], solver = ["ippe", "ap3p"]'
                 " } }") == [False, True]


def test_what_is_wrong_is_not_on_the_front():
    names = ["scale 0.99 (wrong)", "scale 1.0", "scale 1.01 (wrong)"]
    columns = {"cost_ms": [0.2, 0.3, 0.3], "rotation_p95_deg": [0.5, 1.0, 0.1],
               "solved_rate": [1.0, 1.0, 1.0]}
    trade = xr.Dataset(
        {name: ("treatment", values) for name, values in columns.items()},
        {"treatment": np.array(names, dtype=object),
         WRONG_BELIEF: ("treatment", [True, False, True])})
    front = mark_front(trade, "rotation_p95_deg")["on_front"].values.tolist()
    assert front == [False, True, False]
