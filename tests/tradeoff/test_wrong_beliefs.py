"""A belief that is not the truth costs accuracy, and is no choice that is recommended."""


from sweep.experiment.experiment import wrong_beliefs
from sweep.experiment.pipeline import Pipeline

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
