"""Guarded solvers of boards at their edges: right, or flagged; never nonsense, never a warning.

Their covariances, points of one line, and a marker across the board's plane, too.
"""

import itertools
import warnings

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.blocks import run_cells
from support.lengths import lengths
from support.solving import BOARD_METHODS, BoardPoints, detected
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import EstimateStatus
from sweep.measure.solver import OPENCV_SOLVERS, PointSolver
from sweep.model.board_kinds import BoardMarker, Charuco, Grid, Markers
from sweep.model.camera import Cameras
from sweep.model.lens import pack
from sweep.model.pose import rotation_of_angles

VIEW = np.array([600.0, 600.0, 319.5, 239.5])
CAMERA = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
LENSES = {"none": (), "mild": (-0.3, 0.1, 0.0, 0.0), "folds": (-0.5, 0.0, 0.0, 0.0)}
NO_CHESSBOARD = np.zeros(0, dtype=np.int64), np.zeros((0, 2))


def charuco(size_m):
    """A ChArUco of 5 x 4 squares whose longer side is ``size_m``."""
    return Charuco(
        dictionary="DICT_5X5_100", squares_x=5, squares_y=4, square_m=size_m / 5,
        marker_m=size_m / 8,
    ).board()


BOARDS = {
    "charuco": charuco(0.15),
    "millimetre": charuco(0.001),
    "kilometre": charuco(1000.0),
    "one marker": Grid(
        dictionary="DICT_4X4_50", rows=1, columns=1, marker_m=0.05, gap_m=0.01
    ).board(),
    "folded": Markers(dictionary="DICT_4X4_50", quiet_zone_modules=1.0, markers=tuple(
        BoardMarker(marker_id=k, x_m=x, y_m=0.0, size_m=0.05, tilt_deg=tilt, azimuth_deg=90.0)
        for k, (x, tilt) in enumerate([(-0.05, -30.0), (0.05, 30.0)])
    )).board(),
}


def detections(board, points, lens=()):
    camera = Cameras(VIEW[None], pack(lens)[None], np.array([bool(lens)]))
    return detected(board, points, camera)


def settings(board, refines):
    """Each guarded solver that boards have, for all its points and refinements."""
    flat = board.is_flat
    for solver, refine in itertools.product(BOARD_METHODS, refines):
        if flat or solver != "ippe":
            yield PointSolver(solver, True, 0.25, 0.3, "markers", refine)
            if board.chessboard is not None:
                yield PointSolver(solver, True, 0.25, 0.3, "chessboard", refine)
    for points, solver in (("each_marker", "ippe"), ("largest_marker", "ippe_square"),
                           ("largest_marker", "ap3p")):
        yield PointSolver(solver, True, 0.25, 0.3, points, "none")


def judged(solver, asked):
    """Return the estimate of a single board, after checks of what all estimates must fulfil."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = solver(asked)
    status, context = found.status[0], str(solver)
    assert status in (
        EstimateStatus.solved, EstimateStatus.solver_failed, EstimateStatus.too_few_points
    ), context
    rotation, translation = found.rotation[0], found.translation[0]
    if status != EstimateStatus.solved:
        assert np.isnan(rotation).all(), context
        assert np.isnan(translation).all(), context
        assert np.isnan(found.reprojection_px[0]), context
        assert np.isnan(found.covariance[0]).all(), context
        return found
    # 1e-9: a hundred thousand roundings.
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-9, context
    assert np.linalg.det(rotation) > 0, context
    assert np.isfinite(translation).all(), context
    assert np.isfinite(found.reprojection_px[0]), context
    if len(asked.corners) == 1:
        side = np.linalg.norm(asked.corners - np.roll(asked.corners, 1, axis=1), axis=2).mean()
        assert found.reprojection_px[0] <= 0.25 * side, context
    board, known = asked.targets[0], np.isfinite(asked.chessboard_px[0, :, 0])
    used = (board.chessboard_m[known] if solver.points == "chessboard"
            else asked.objects_m.reshape(-1, 3))
    depth = (used @ rotation.T + translation)[:, 2]
    if solver.points == "largest_marker":
        depth = depth.reshape(-1, 4)[depth.reshape(-1, 4).min(axis=1).argmax()]  # the one used
    assert depth.min() > 0, context
    alternative = found.alternative_rotation[0]
    assert np.isnan(alternative).all() == np.isnan(found.alternative_reprojection_px[0]), context
    return found


def projected(objects, rotation, translation, lens=()):
    vector = Rotation.from_matrix(rotation).as_rotvec()
    coefficients = np.array(lens or (0.0,) * 4)
    return cv2.projectPoints(objects, vector, translation, CAMERA, coefficients)[0].reshape(-1, 2)


def sighted(board, rotation, translation, lens=()):
    """All points of a board as OpenCV projects them."""
    corners = projected(board.corners_m.reshape(-1, 3), rotation, translation, lens)
    number = np.arange(len(board.chessboard_m))
    chessboard = (projected(board.chessboard_m, rotation, translation, lens)
                  if len(number) else np.zeros((0, 2)))
    return BoardPoints(np.arange(len(board)), corners.reshape(-1, 4, 2), number, chessboard)


SPANS_PX = (1.0, 10.0, 100.0, 600.0, 6e3, 6e5)
"""How wide a board is that faces the camera: to 1000 times the frame."""

TILTS_DEG = ((0.0, 0.0), (0.0, 60.0), (60.0, 85.0), (85.0, 89.9))


@lengths(1, 12)
@pytest.mark.parametrize(("name", "lens"), [
    ("charuco", "none"), ("charuco", "mild"),
    *(pytest.param(name, "none", marks=pytest.mark.long) for name in BOARDS if name != "charuco"),
])
def test_exact_points_give_the_pose_at_any_size_distance_and_tilt(count, name, lens):
    rng = np.random.default_rng(41)
    board = BOARDS[name]
    corners_m = board.corners_m.reshape(-1, 3)
    extent = float(np.ptp(corners_m, axis=0).max())
    seen = 0
    for span_px, tilts, _ in itertools.product(SPANS_PX, TILTS_DEG, range(count)):
        rotation = rotation_of_angles(
            np.radians([rng.uniform(*tilts)]), rng.uniform(0, 7, 1), rng.uniform(0, 7, 1)
        )[0]
        translation = np.array([0.0, 0.0, extent * 600 / span_px])
        depth = (corners_m @ rotation.T + translation)[:, 2]
        if depth.min() < 1e-3 * translation[2] or (lens != "none" and span_px > 600):
            continue  # behind the camera, or where the lens folds
        seen += 1
        coefficients = LENSES[lens]
        asked = detections(board, sighted(board, rotation, translation, coefficients), coefficients)
        for solver in settings(board, ("none", "lm") if count > 1 else ("none",)):
            found = judged(solver, asked)
            if solver.solver == "epnp":
                continue  # unreliable, and says so
            context = solver, span_px, tilts
            assert found.status[0] == EstimateStatus.solved, context
            error = Rotation.from_matrix(found.rotation[0] @ rotation.T).magnitude()
            # OpenCV's iterations end at about 0.01 degrees.
            assert np.degrees(error) < 0.05, context
    assert seen >= 10 * count


@pytest.mark.parametrize("solver", ["ippe", "sqpnp"])
def test_what_opencv_cannot_solve_is_solved_by_another_method(solver):
    board = BOARDS["charuco"]
    unsolved = 0
    for k, span_px in itertools.product(range(12), (1.0, 100.0)):
        rotation = rotation_of_angles(np.zeros(1), np.zeros(1), np.array([0.5 * k]))[0]
        translation = np.array([0.0, 0.0, 0.15 * 600 / span_px])
        points = sighted(board, rotation, translation)
        asked = detections(board, points)
        plain = PointSolver(solver, False, 0.25, None, "markers", "none")(asked)
        unsolved += plain.status[0] != EstimateStatus.solved
        found = judged(PointSolver(solver, True, 0.25, None, "markers", "none"), asked)
        error = Rotation.from_matrix(found.rotation[0] @ rotation.T).magnitude()
        assert np.degrees(error) < 0.05
    assert unsolved > 0


def garbage(board, rng):
    """Points that no board gave, by kind: markers, their corners, and chessboard corners."""
    rotation = rotation_of_angles(np.array([0.5]), np.array([1.0]), np.array([2.0]))[0]
    exact = sighted(board, rotation, np.array([0.0, 0.0, 0.5]))
    some = len(board)
    line = rng.uniform(0, 600, 2) + rng.uniform(-1, 1, (some, 4, 1)) * rng.uniform(-300, 300, 2)
    kinds = [
        rng.uniform(-200, 800, (some, 4, 2)), line, 300.0 + rng.integers(0, 5, (some, 4, 2)),
        np.repeat(rng.uniform(0, 600, (some, 2, 2)), 2, axis=1),  # two identical
        rng.uniform(0, 600, (some, 2, 2))[:, [0, 0, 0, 1]], np.full((some, 4, 2), VIEW[2:]),
        np.stack([rng.uniform(0, 600, (some, 4)), np.full((some, 4), 9.0)], 2),  # in one row
        320 + rng.uniform(-1e-9, 1e-9, (some, 4, 2)),
        2 * VIEW[2:] - exact.corners_px,  # behind the camera, upside down
        exact.corners_px[rng.permutation(some)],
        # The detector's corners are float32.
        *(rng.uniform(-largest, largest, (some, 4, 2)) for largest in (1e5, 1e20, 3e38)),
    ]
    number = np.arange(len(board.chessboard_m))
    for corners in kinds:
        chessboard = rng.permutation(corners.reshape(-1, 2))
        chessboard = np.resize(chessboard, (len(number), 2)) if len(number) else np.zeros((0, 2))
        yield BoardPoints(np.arange(some), corners, number, chessboard)
        one = rng.integers(some, size=1)
        yield BoardPoints(one, corners[one], *NO_CHESSBOARD)
    yield BoardPoints(number[:0], np.zeros((0, 4, 2)), *NO_CHESSBOARD)
    twice = np.zeros(2, dtype=np.int64)
    yield BoardPoints(twice, exact.corners_px[[0, -1]], *NO_CHESSBOARD)


def of_a_marker(board):
    """All solvers of a single marker, guarded and plain; none of larger boards."""
    for solver, guarded in itertools.product(OPENCV_SOLVERS, (True, False)):
        if len(board) == 1:
            yield PointSolver(solver, guarded, 0.25)


@lengths(1, 10)
@pytest.mark.parametrize(("name", "lens"), [
    ("charuco", "none"), *(("one marker", lens) for lens in LENSES),
    pytest.param("folded", "mild", marks=pytest.mark.long),
    *(pytest.param(name, "folds", marks=pytest.mark.long) for name in BOARDS
      if name != "one marker"),
])
def test_garbage_is_solved_in_front_of_the_camera_or_not_at_all(count, name, lens):
    rng = np.random.default_rng(43)
    board = BOARDS[name]
    for _ in range(count):
        for points in garbage(board, rng):
            refines = ("none", "lm", "vvs") if count > 1 else ("lm",)
            for solver in (*of_a_marker(board), *settings(board, refines)):
                judged(solver, detections(board, points, LENSES[lens]))


@lengths(100, 1000)
@pytest.mark.parametrize("rows", [1, 2])
def test_iterative_finds_the_least_error_of_few_coarse_corners(count, rows):
    """Before it was compared, it ended at up to 23 times the least error in 1-9 %."""
    rng = np.random.default_rng(44)
    board = Grid(
        dictionary="DICT_4X4_50", rows=rows, columns=rows, marker_m=0.02, gap_m=0.01
    ).board()
    for _ in range(count):
        rotation = rotation_of_angles(
            np.radians(rng.uniform(0, 75, 1)), rng.uniform(0, 7, 1), rng.uniform(0, 7, 1)
        )[0]
        depth = 0.02 * 600 / rng.uniform(12, 40)
        translation = depth * np.array([*rng.uniform(-0.25, 0.25, 2), 1.0])
        exact = sighted(board, rotation, translation)
        asked = detections(board, exact._replace(corners_px=np.round(exact.corners_px)))
        errors = [
            judged(PointSolver(solver, True, 0.25, None, "markers", "lm"), asked).reprojection_px[0]
            for solver in ("iterative", "sqpnp", "ippe")
        ]
        assert errors[0] <= max(1.25 * min(errors), 1e-3 * 600 * 0.02 / depth)


@pytest.mark.parametrize("solver", BOARD_METHODS)
@pytest.mark.parametrize("line", [[0, 1, 2, 3], [0, 4, 8], [8, 9, 10, 11]], ids=str)
def test_points_of_one_line_are_no_pose(solver, line):
    rotation = rotation_of_angles(np.radians([30.0]), np.ones(1), np.zeros(1))[0]
    every = sighted(BOARDS["charuco"], rotation, np.array([0.0, 0.0, 0.5]))
    points = every._replace(chessboard=np.array(line), chessboard_px=every.chessboard_px[line])
    found = PointSolver(solver, True, 0.25, None, "chessboard", "none")(
        detections(BOARDS["charuco"], points))
    wanted = EstimateStatus.too_few_points if len(line) < 4 else EstimateStatus.solver_failed
    assert found.status[0] == wanted


@pytest.mark.parametrize("points", ["markers", "chessboard", "largest_marker", "each_marker"])
@pytest.mark.parametrize("refine", ["none", "lm"])
def test_covariance_is_that_of_the_points_that_gave_the_pose(points, refine):
    """By OpenCV's derivatives; the pose of one marker is as uncertain as its four corners make it,
    unless it is refined on those of all."""
    board = BOARDS["charuco"]
    rotation = rotation_of_angles(np.radians([30.0]), np.ones(1), np.zeros(1))[0]
    translation, noise_px = np.array([0.02, -0.01, 0.5]), 0.3
    found = PointSolver("iterative", True, 0.25, noise_px, points, refine)(
        detections(board, sighted(board, rotation, translation)))

    def deviations(objects):
        vector = Rotation.from_matrix(rotation).as_rotvec()
        slopes = cv2.projectPoints(objects, vector, translation, CAMERA, None)[1][:, :6]
        return noise_px * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))[3:]

    together = {"markers": board.corners_m.reshape(-1, 3), "chessboard": board.chessboard_m}
    if refine == "lm":
        together["each_marker"] = together["markers"]
    sets = [together[points]] if points in together else board.corners_m
    given = np.sqrt(np.diag(found.covariance[0]))[3:]
    assert any(np.allclose(given, deviations(each), rtol=1e-3) for each in sets)


@pytest.mark.parametrize("tilt_deg", [30, 60])
@pytest.mark.parametrize("solver", ["iterative", "sqpnp"])
def test_a_marker_across_the_board_s_plane_is_solved_alone(solver, tilt_deg):
    """The side face of a cube: its corners lie on a line of the board's plane."""
    face = {"marker_id": 1, "x_m": 0.025, "y_m": 0, "z_m": -0.025, "tilt_deg": 90,
            "azimuth_deg": 90}
    columns = run_cells(Pipeline.from_dict({
        "camera": {"width_px": 1280, "height_px": 720, "fx_px": 900},
        "marker": {"dictionary": "DICT_4X4_50", "size_m": 0.04},
        "board": {"kind": "markers", "markers": [face]},
        "pose": {"distance_m": 0.4, "azimuth_deg": 90, "tilt_deg": tilt_deg},
        "scene": {"background": 120}, "detector": {"cornerRefinementMethod": "subpix"},
        "estimator": {"solver": solver},
    }), []).columns
    assert columns["estimate"][0][0] == EstimateStatus.solved
    assert np.linalg.norm(columns["rotation_error_rad"][0][0]) < 0.1
