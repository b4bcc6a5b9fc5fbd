"""Points of one line are no pose; covariances of boards; a marker across the board's plane."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.blocks import run_cells
from support.solving import BOARD_METHODS, BoardPoints, detected
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.measure.solver import PointSolver
from sweep.model.board_kinds import Charuco
from sweep.model.camera import Cameras
from sweep.model.lens import pack
from sweep.model.pose import rotation_of_angles

BOARD = Charuco(
    dictionary="DICT_5X5_100", squares_x=5, squares_y=4, square_m=0.03, marker_m=0.02
).board()
VIEW = np.array([600.0, 600.0, 319.5, 239.5])
CAMERA = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
def solved(solver, points, chessboard, rotation, translation, distortion, refine="none",
           noise_px=None):
    """The estimate from a ChArUco board's exact markers and chessboard corners, as OpenCV
    projects them."""
    packed = pack(distortion)
    vector, lens = Rotation.from_matrix(rotation).as_rotvec(), np.array(distortion or (0.0,) * 4)

    def pixels(objects):
        return cv2.projectPoints(objects, vector, translation, CAMERA, lens)[0].reshape(-1, 2)

    found = BoardPoints(
        np.arange(len(BOARD)), pixels(BOARD.corners_m.reshape(-1, 3)).reshape(-1, 4, 2),
        chessboard, pixels(BOARD.chessboard_m[chessboard]),
    )
    camera = Cameras(VIEW[None], packed[None], np.array([bool(distortion)]))
    return PointSolver(solver, True, 0.25, noise_px, points, refine)(detected(BOARD, found, camera))


@pytest.mark.parametrize("solver", BOARD_METHODS)
def test_points_of_one_line_are_no_pose(solver):
    rotation = rotation_of_angles(np.radians([30.0]), np.ones(1), np.zeros(1))[0]
    for line in ([0, 1, 2, 3], [0, 4, 8], [8, 9, 10, 11]):
        found = solved(
            solver, "chessboard", np.array(line), rotation, np.array([0.0, 0.0, 0.5]), ()
        )
        wanted = EstimateStatus.too_few_points if len(line) < 4 else EstimateStatus.solver_failed
        assert found.status[0] == wanted


@pytest.mark.parametrize("points", ["markers", "chessboard", "largest_marker", "each_marker"])
@pytest.mark.parametrize("refine", ["none", "lm"])
def test_covariance_is_that_of_the_points_that_gave_the_pose(points, refine):
    """By OpenCV's derivatives; the pose of one marker is as uncertain as its four corners make it,
    unless it is refined on those of all."""
    rotation = rotation_of_angles(np.radians([30.0]), np.ones(1), np.zeros(1))[0]
    translation, noise_px = np.array([0.02, -0.01, 0.5]), 0.3
    number = np.arange(len(BOARD.chessboard_m))
    found = solved("iterative", points, number, rotation, translation, (), refine, noise_px)

    def deviations(objects):
        vector = Rotation.from_matrix(rotation).as_rotvec()
        slopes = cv2.projectPoints(objects, vector, translation, CAMERA, None)[1][:, :6]
        return noise_px * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))[3:]

    together = {"markers": BOARD.corners_m.reshape(-1, 3), "chessboard": BOARD.chessboard_m}
    if refine == "lm":
        together["each_marker"] = together["markers"]
    sets = [together[points]] if points in together else BOARD.corners_m
    given = np.sqrt(np.diag(found.covariance[0]))[3:]
    assert any(np.allclose(given, deviations(each), rtol=1e-3) for each in sets)


@pytest.mark.parametrize("tilt_deg", [30, 60])
@pytest.mark.parametrize("solver", ["iterative", "sqpnp"])
def test_a_marker_across_the_board_s_plane_is_solved_alone(solver, tilt_deg):
    """The side face of a cube: its corners lie on a line of the board's plane."""
    text = """
[camera]
width_px = 1280
height_px = 720
fx_px = 900
[marker]
dictionary = "DICT_4X4_50"
size_m = 0.04
[board]
kind = "markers"
[[board.markers]]
marker_id = 1
x_m = 0.025
y_m = 0
z_m = -0.025
tilt_deg = 90
azimuth_deg = 90
[pose]
distance_m = 0.4
azimuth_deg = 90
[scene]
background = 120
[detector]
cornerRefinementMethod = "subpix"
[estimator]
solver = "sqpnp"
"""
    pipeline = Pipeline.from_text(text, [f"tilt_deg={tilt_deg}", f"solver={solver!r}"])
    result = run_cells(pipeline, [])
    columns = {name: parts[0] for name, parts in result.columns.items()}
    assert columns["detection"][0] == DetectionStatus.detected
    assert columns["estimate"][0] == EstimateStatus.solved
    assert np.linalg.norm(columns["rotation_error_rad"][0]) < 0.1
