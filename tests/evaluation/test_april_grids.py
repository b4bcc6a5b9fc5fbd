"""AprilGrids in scenes: Kalibr's order, IDs of one's own, and what detects them."""

import numpy as np
import pytest

from support.blocks import run_block
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus

GRID = {"kind": "aprilgrid", "tagCols": 4, "tagRows": 3, "tagSpacing": 0.3}


def pipeline(settings=(), board=GRID):
    return Pipeline.from_dict({
        "marker": {"dictionary": "DICT_APRILTAG_36h11", "size_m": 0.04}, "board": board,
        "pose": {"jitter_px": 1, "azimuth_deg": {"uniform": [0, 360]},
                 "roll_deg": {"uniform": [0, 360]}},
        "estimator": {"solver": "sqpnp"},
        "axes": {"distance_m": [0.4, 0.7, 1.2], "tilt_deg": [0, 25, 50], "trial": 3},
    }, settings)


FOUND = ["adaptiveThreshConstant=60", "adaptiveThreshWinSizeMax=33", "adaptiveThreshWinSizeStep=4"]
"""The setting that the guide of boards and the plan name."""


def run(settings, shape=(3, 3, 3), board=GRID):
    return run_block(pipeline(settings, board), Block((0, 0, 0), shape)).values


def test_the_named_setting_finds_what_the_default_loses():
    default, named = (run(settings) for settings in ([], FOUND))
    lost = default["detection"] != DetectionStatus.detected
    assert lost.sum() >= 5
    assert (named["detection"] == DetectionStatus.detected).all()
    assert (default["marker_detection"] == DetectionStatus.detected).mean() < 0.5
    assert (named["marker_detection"] == DetectionStatus.detected).mean() > 0.75
    solved = named["estimate"] == EstimateStatus.solved
    assert solved.mean() > 0.9
    # A board whose markers have other IDs or another turn than the picture fits nowhere.
    assert np.nanmedian(named["reprojection_error_px"][solved]) < 2
    assert np.nanmedian(np.linalg.norm(named["rotation_error_rad"], axis=-1)[solved]) < 0.05


def test_plan_names_the_setting_where_the_default_loses_markers():
    (line,) = [each for each in pipeline().facts.notes if "squares" in each]
    for setting in FOUND:
        assert setting.replace("=", " = ") in line
    assert not [each for each in pipeline(FOUND).facts.notes if "squares" in each]


@pytest.mark.parametrize("board", [
    GRID, {"kind": "grid", "columns": 4, "rows": 3, "gap_m": 0.012},
], ids=["aprilgrid", "grid"])
def test_ids_are_those_listed_in_the_order_of_the_kind(board):
    ids = [7, 3, 11, 5, 30, 31, 32, 33, 0, 1, 2, 4]
    values = run(FOUND, (1, 1, 1), board | {"ids": ids})
    assert values["board_marker_id"].ravel().tolist() == ids
    assert (values["marker_detection"] == DetectionStatus.detected).mean() > 0.5
