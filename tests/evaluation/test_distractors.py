"""Distractors beside a target are in its image and in the search, and count for nothing else."""

import numpy as np
import pytest

from support.blocks import run_cells
from sweep.evaluation.search import visibility_flags
from sweep.experiment.pipeline import Pipeline
from sweep.measure.classify import target_scenes
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.scene import build_scenes

GRID = {"kind": "grid", "rows": 2, "columns": 2, "gap_m": 0.01}
BOARD_ID = {"marker_id": 2, "x_m": 0.11, "y_m": 0.0}
SQUARE = {"x_m": -0.1, "y_m": 0.02, "size_m": 0.03, "roll_deg": 20.0}
OTHER = {"marker_id": 30, "x_m": 0.0, "y_m": 0.1}
BESIDE = [BOARD_ID, SQUARE, OTHER]


def pipeline(board, *settings, **sections):
    return Pipeline.from_dict({
        "seed": 5,
        "camera": {"width_px": 320, "height_px": 240, "fx_px": 300, "fy_px": 300},
        "marker": {"dictionary": "DICT_4X4_50", "size_m": 0.04, "quiet_zone_modules": 1},
        "board": board,
        "pose": {"distance_m": 0.35, **sections.pop("pose", {})},
        "scene": {"background": 120, "black": 30, "white": 220, "blur_px": 0.5,
                  **sections.pop("scene", {})},
        "estimator": {"solver": "iterative", "guarded": False},
        **sections,
    }, settings=settings)


def shown(chosen):
    values = chosen.experiment.scene_values([])
    return build_scenes(values, 1), values


def one(chosen, name):
    return run_cells(chosen, []).columns[name][0][0]


@pytest.mark.parametrize("board", [GRID, {"kind": "none"}])
def test_a_target_is_visible_and_as_large_as_without_distractors(board):
    for pose in ({}, {"bearing_x_deg": -36.0}):
        plain, beside = (
            pipeline({**board, **more}, pose=pose)
            for more in (({} if board is GRID else {"distractors": [SQUARE]}),
                         {"distractors": BESIDE})
        )
        assert beside.largest_board == plain.largest_board
        for name in ("marker_area_px", "detection", "marker_detection", "board_marker_id"):
            np.testing.assert_array_equal(one(beside, name), one(plain, name))
    # At the last pose the frame shows the distractor with the board's ID alone.
    assert one(beside, "detection") == DetectionStatus.not_visible


def test_an_id_of_the_board_elsewhere_is_no_detection_of_its_marker():
    """Marker 2 is hidden; what has its ID lies beside the board."""
    chosen = pipeline({
        "kind": "markers", "markers": [
            {"marker_id": 0, "x_m": -0.03, "y_m": 0.0}, {"marker_id": 2, "x_m": 0.03, "y_m": 0.0},
        ], "distractors": [{**BOARD_ID, "x_m": -0.1}],
    }, scene={"occlusion": 0.4, "occluder": 120})
    flags = one(chosen, "marker_detection")
    assert flags[0] == DetectionStatus.detected
    assert flags[1] in (DetectionStatus.no_candidate, DetectionStatus.rejected)
    # Solvers get both, as OpenCV's matchImagePoints takes them, and find no pose of these.
    assert one(chosen, "estimate") == EstimateStatus.solver_failed


@pytest.mark.parametrize(("beside", "tilt", "expected"), [
    ([], 60.0, DetectionStatus.not_run),
    ([{"marker_id": 1, "x_m": 0.0, "y_m": 0.45}], 60.0, DetectionStatus.not_modelled),
    ([{"marker_id": 1, "x_m": 0.0, "y_m": 0.45, "z_m": 0.02}], 60.0, DetectionStatus.not_run),
    ([{"marker_id": 1, "x_m": 0.0, "y_m": 0.45}], 120.0, DetectionStatus.not_visible),
])
def test_what_comes_behind_the_camera_is_not_modelled_in_the_board_s_plane(beside, tilt, expected):
    chosen = pipeline({**GRID, "distractors": beside}, pose={"tilt_deg": tilt})
    scenes, values = shown(chosen)
    flags = visibility_flags(scenes)
    assert flags[0] == expected
    boards = target_scenes(
        scenes, flags, values["board"].listed(1), chosen.largest_board)
    assert (boards.flags == expected).all()
