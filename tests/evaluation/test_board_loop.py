"""Runs with boards give what a plain OpenCV loop over full frames gives."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.blocks import run_block, run_cells
from support.board_pictures import DICTIONARY, KINDS, NAME, SIZE_M, opencv_board
from support.lengths import first_of
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.model.exposure import marker_boxes
from sweep.model.renderers import render
from sweep.model.scene import build_scenes

CAMERA = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
LENS = [-0.2, 0.05, 0.0, 0.0]
METHODS = {
    "iterative": cv2.SOLVEPNP_ITERATIVE, "sqpnp": cv2.SOLVEPNP_SQPNP, "ippe": cv2.SOLVEPNP_IPPE,
    "epnp": cv2.SOLVEPNP_EPNP,
}
DETECTED, NOT_VISIBLE = 1, 5
SOLVED, SOLVER_FAILED = 1, 3


def pipeline_of(name, trials):
    return Pipeline.from_dict({
        "seed": 8,
        "camera": {"width_px": 320, "height_px": 240, "fx_px": 300, "fy_px": 300},
        "marker": {"dictionary": NAME, "size_m": SIZE_M}, "board": KINDS[name],
        "pose": {
            "tilt_deg": {"uniform": [0, 70]}, "azimuth_deg": {"uniform": [0, 360]},
            "roll_deg": {"uniform": [0, 360]}, "bearing_x_deg": {"uniform": [-24, 24]},
            "bearing_y_deg": {"uniform": [-18, 18]},
        },
        "scene": {"window": "full", "black": 30, "white": 220, "background": 100,
                  "noise_grey": 3, "blur_px": 0.5},
        "detector": {"cornerRefinementMaxIterations": 1}, "estimator": {"guarded": False},
        "axes": {
            "distance_m": [0.13, 0.25], "trial": trials, "distortion": [[], LENS],
            "cornerRefinementMethod": ["none", "subpix"], "solver": list(METHODS),
            "points": points_of(name),
        },
    })


def points_of(name):
    return ["markers", "chessboard"] if "square_m" in KINDS[name] else ["markers"]


def board_detector(board, refinement):
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    parameters.cornerRefinementMaxIterations = 1  # of the chessboard's corners, too
    detector = cv2.aruco.ArucoDetector(DICTIONARY, parameters)
    if not isinstance(board, cv2.aruco.CharucoBoard):
        return detector, None
    return detector, cv2.aruco.CharucoDetector(board, cv2.aruco.CharucoParameters(), parameters)


def exact(points, board):
    """The board's own points next to OpenCV's float32 ones, the same to the bit: where a solver's
    iterations end (at FLT_EPSILON, or after 15 steps of SQPnP) hangs on the last digits."""
    known = np.concatenate([board.corners_m.reshape(-1, 3), board.chessboard_m])
    distance = np.linalg.norm(points[:, None] - known, axis=2)
    assert distance.min(axis=1).max() < 1e-7
    return known[distance.argmin(axis=1)]


def mean_side(corners):
    quads = np.array(corners).reshape(-1, 4, 2)
    return np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).mean()


def plain_pose(objects, pixels, lens, method, limit_px):
    """OpenCV's pose of a board in OpenCV's frame, and its RMS error; None if it is no pose."""
    try:
        found, rvec, tvec = cv2.solvePnP(objects, pixels, CAMERA, lens, flags=method)
    except cv2.error:
        return None
    if not found or not np.isfinite([rvec, tvec]).all():
        return None
    depth = objects @ Rotation.from_rotvec(rvec.ravel()).as_matrix().T[:, 2] + tvec[2]
    if (depth <= 0).any():
        return None
    off = cv2.projectPoints(objects, rvec, tvec, CAMERA, lens)[0].reshape(-1, 2) - pixels
    rms = np.sqrt(np.mean(np.sum(off**2, axis=1)))
    return None if rms > limit_px else (rvec.ravel(), tvec.ravel(), rms)


@pytest.mark.parametrize("name", first_of(("charuco", *(k for k in KINDS if k != "charuco")), 2))
def test_a_board_of_a_run_is_what_a_plain_opencv_loop_finds(name, request):
    trials = 8 if request.node.get_closest_marker("long") else 1
    pipeline = pipeline_of(name, trials)
    shape = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    block = Block((0,) * len(shape), shape)
    result = run_block(pipeline, block)
    assert not result.failures
    got = {
        key: column.reshape(len(block), *column.shape[len(shape) :])
        for key, column in result.values.items()
    }
    values = pipeline.experiment.scene_values(block.indices())
    scenes = build_scenes(values, len(block))
    (printed,) = set(values["board"].listed(len(block)))
    boxes = marker_boxes(scenes)
    board, ours = opencv_board(name)
    object_corners = ours(board.getObjPoints())
    number = {marker_id: k for k, marker_id in enumerate(board.getIds().ravel().tolist())}
    compared = solved = 0
    for row in range(len(block)):
        if (got["detection"][row] == NOT_VISIBLE).all():
            continue
        lens = np.array(LENS) if scenes.cameras.distorted[row] else None
        image = render(scenes, row, boxes[row], (0, 0, 320, 240))
        rotation, position = scenes.rotation[row], scenes.translation[row]
        vector = Rotation.from_matrix(rotation).as_rotvec()

        def projected(points, vector=vector, position=position, lens=lens):
            return cv2.projectPoints(points, vector, position, CAMERA, lens)[0].reshape(-1, 2)

        for k, refinement in enumerate((0, 1)):
            detector, charuco = board_detector(board, refinement)
            corners, ids, _ = detector.detectMarkers(image)
            listed = [] if ids is None else ids.ravel().tolist()
            flags = got["marker_detection"][row, k]
            assert got["detection"][row, k] == DETECTED or not (flags == DETECTED).any()
            # What is detected is in the loop's list, with its corners; a marker of the loop that
            # lies at the truth is detected.
            for marker_id, m in number.items():
                quads = [np.reshape(q, (4, 2)) for q, i in zip(corners, listed, strict=True)
                         if i == marker_id]
                truth = projected(object_corners[m])
                errors = [np.abs(q - truth).max() for q in quads]
                if quads and min(errors) < 3:
                    assert flags[m] == DETECTED
                    error = got["marker_corner_error_px"][row, k, m]
                    # Corners as OpenCV's float32, and OpenCV's float32 points of the board.
                    assert np.abs(error - (quads[int(np.argmin(errors))] - truth)).max() < 1e-4
                    compared += 1
                elif flags[m] != DETECTED:
                    assert np.isnan(got["marker_corner_error_px"][row, k, m]).all()
                else:
                    assert quads
            if not (flags == DETECTED).any():
                continue
            # matchImagePoints of a CharucoBoard takes the chessboard's corners.
            markers = cv2.aruco.Board(board.getObjPoints(), DICTIONARY, board.getIds())
            found = [markers.matchImagePoints(corners, ids)]
            if charuco is not None:
                cross, cross_ids, _, _ = charuco.detectBoard(
                    image, markerCorners=corners, markerIds=ids
                )
                seen = np.isfinite(got["chessboard_corner_error_px"][row, k]).all(axis=1)
                indices = [] if cross_ids is None else cross_ids.ravel().tolist()
                assert np.flatnonzero(seen).tolist() == sorted(indices)
                if indices:
                    order = np.argsort(indices)
                    truth = projected(ours(board.getChessboardCorners())[indices])
                    off = cross.reshape(-1, 2) - truth
                    given = got["chessboard_corner_error_px"][row, k][seen]
                    assert np.abs(given - off[order]).max() < 2e-3
                found.append(
                    board.matchImagePoints(cross, cross_ids) if indices else (None, None)
                )
            for (solver, method), (p, _) in (
                (each, point) for each in METHODS.items() for point in enumerate(points_of(name))
            ):
                at = (row, k, list(METHODS).index(solver), p)
                objects, pixels = found[p]
                status = got["estimate"][at]
                if objects is None or len(objects) < 4:
                    assert status not in (SOLVED, SOLVER_FAILED)
                    continue
                pose = plain_pose(
                    exact(ours(objects.reshape(-1, 3)), printed),
                    pixels.reshape(-1, 2).astype(np.float64), lens, method, 0.25 * mean_side([
                        q for q, i in zip(corners, listed, strict=True) if i in number
                    ]),
                )
                if pose is None or status != SOLVED:
                    # What lies at the limit may fall on either side of it.
                    assert (pose is None) == (status != SOLVED)
                    continue
                solved += 1
                assert got["point_count"][at] == len(pixels)
                error = pose[1] - position
                assert np.abs(got["translation_error_m"][at] - error).max() < 2e-5
                turn = Rotation.from_rotvec(pose[0]) * Rotation.from_matrix(rotation).inv()
                stored = Rotation.from_rotvec(got["rotation_error_rad"][at].astype(np.float64))
                assert (stored * turn.inv()).magnitude() < 2e-4
                assert abs(got["reprojection_error_px"][at] - pose[2]) < 2e-3
    assert compared > 2 * trials
    assert solved > 2 * trials


def test_results_of_a_board_do_not_depend_on_larger_boards_of_the_grid():
    shown = {
        "marker": {"dictionary": "DICT_4X4_50", "size_m": 0.03},
        "board": {"kind": "grid", "columns": 3, "gap_m": 0.01},
        "pose": {"distance_m": 0.4, "tilt_deg": 30, "jitter_px": 5},
        "estimator": {"solver": "sqpnp"},
    }
    small, both = (
        run_cells(Pipeline.from_dict(
            shown | {"axes": {"trial": 12, "rows": rows, "bearing_x_deg": [0, 80]}}),
                  [np.tile(np.arange(12), 2), np.zeros(24, dtype=int), np.repeat([0, 1], 12)])
        for rows in ([2], [2, 3])
    )
    area = small.columns["marker_area_px"][0]
    np.testing.assert_array_equal(both.columns["marker_area_px"][0], area)
    assert np.isfinite(area[:12]).all()
    assert np.isnan(area[12:]).all()  # outside the frame
    for name in ("translation_error_m", "rotation_error_deg", "estimate"):
        np.testing.assert_array_equal(both.columns[name][0], small.columns[name][0])
