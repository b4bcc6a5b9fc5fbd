"""Runs give what a plain OpenCV loop over full frames gives, of markers and of boards."""

import functools

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.blocks import run_block, run_cells, whole
from support.board_pictures import DICTIONARY, KINDS, NAME, SIZE_M, opencv_board
from support.lengths import first_of, lengths
from sweep.experiment.pipeline import Pipeline
from sweep.model.exposure import marker_boxes
from sweep.model.renderers import render
from sweep.model.scene import build_scenes

REFINEMENTS = {"none": 0, "subpix": 1, "contour": 2, "apriltag": 3}
METHODS = {
    name: getattr(cv2, f"SOLVEPNP_{name.upper()}")
    for name in ("ippe_square", "iterative", "sqpnp", "p3p", "ap3p", "epnp", "ippe")
}

# Flags of the dataset, as the design lists them.
DETECTED, WRONG_ID, REJECTED, NO_CANDIDATE, NOT_VISIBLE = 1, 2, 3, 4, 5
SOLVED, NO_DETECTION, SOLVER_FAILED = 1, 2, 3
NOT_FLIPPED, FLIPPED, NO_ESTIMATE = 1, 2, 3


def ran(pipeline):
    """Return a whole grid's scenes, and its variables with the scenes along the first axis."""
    block = whole(pipeline)
    result = run_block(pipeline, block)
    assert not result.failures
    values = {
        name: column.reshape(len(block), *column.shape[len(block.shape):])
        for name, column in result.values.items()
    }
    return build_scenes(pipeline.experiment.scene_values(block.indices()), len(block)), values


def plain_pose(objects, corners, camera, lens, method, limit_px):
    """Return OpenCV's rvec, tvec and RMS reprojection error (7,), or None where it is no pose."""
    try:
        found, rvec, tvec = cv2.solvePnP(objects, corners, camera, lens, flags=method)
    except cv2.error:
        return None
    if not found or not np.isfinite([rvec, tvec]).all():
        return None
    rvec, tvec = rvec[:, 0], tvec[:, 0]
    if ((Rotation.from_rotvec(rvec).apply(objects) + tvec)[:, 2] <= 0).any():
        return None
    off = cv2.projectPoints(objects, rvec, tvec, camera, lens)[0].reshape(-1, 2) - corners
    rms = np.sqrt(np.mean(np.sum(off**2, axis=1)))
    return None if rms > limit_px else np.array([*rvec, *tvec, rms])


def mean_side(quads):
    quads = np.reshape(quads, (-1, 4, 2))
    return np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).mean()


MARKER_M = 0.05
DICTIONARIES = {"DICT_4X4_50": cv2.aruco.DICT_4X4_50, "DICT_6X6_250": cv2.aruco.DICT_6X6_250}
CAMERA = np.array([[4.0 / 4.8 * 640, 0, 319.5], [0, 4.0 / 3.6 * 480, 239.5], [0, 0, 1]])
SQUARE = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
GRID = {
    "seed": 77, "marker": {"size_m": MARKER_M}, "scene": {"background": 90},
    "pose": {
        "azimuth_deg": {"uniform": [0, 360]}, "roll_deg": {"uniform": [0, 360]},
        "bearing_x_deg": {"uniform": [-29, 29]}, "bearing_y_deg": {"uniform": [-22, 22]},
    },
    "estimator": {"guarded": False},
    "axes": {
        "dictionary": list(DICTIONARIES), "marker_id": [0, 7, 42], "tilt_deg": [0, 25, 55, 75],
        "distance_m": [0.12, 0.4, 1.3], "trial": 2, "cornerRefinementMethod": list(REFINEMENTS),
        "solver": list(METHODS),
    },
}


def corners_in_image(rvec, tvec):
    return cv2.projectPoints(MARKER_M * SQUARE, rvec, tvec, CAMERA, None)[0].reshape(4, 2)


def classified(true_corners, marker_id, found):
    """Return the flag and the corners of a detectMarkers result, as the design defines them."""
    corners, ids, rejected = found
    truth = true_corners.astype(np.float32)

    def there(quadrilateral):
        centre = quadrilateral.reshape(4, 2).astype(np.float64).mean(axis=0)
        return cv2.pointPolygonTest(truth, centre.tolist(), False) >= 0

    flag = REJECTED if any(map(there, rejected)) else NO_CANDIDATE
    best, nearest = None, np.inf
    for quadrilateral, found_id in zip(corners, [] if ids is None else ids.ravel(), strict=True):
        if not there(quadrilateral):
            continue
        points = quadrilateral.reshape(4, 2).astype(np.float64)
        off = [np.sum((np.roll(points, -turn, axis=0) - true_corners) ** 2) for turn in range(4)]
        if found_id == marker_id and off[0] == min(off):
            flag = DETECTED
            if off[0] < nearest:
                best, nearest = points, off[0]
        elif flag != DETECTED:
            flag = WRONG_ID
    return flag, best


def visible(rotation, tvec, true_corners):
    """Tell whether the marker faces the camera and its black square meets the frame."""
    frame = np.array([[-0.5, -0.5], [639.5, -0.5], [639.5, 479.5], [-0.5, 479.5]])
    in_space = rotation.apply(1.5 * MARKER_M * SQUARE) + tvec
    area, _ = cv2.intersectConvexConvex(true_corners.astype(np.float32), frame.astype(np.float32))
    return rotation.as_matrix()[:, 2] @ tvec < 0 and (in_space[:, 2] > 0).all() and area > 0


@functools.cache
def marker_loop(trials):
    """Return what the loop finds in ``trials`` of every pose of the grid.

    Flags (n, refinement), corners (n, refinement, 4, 2), statuses (n, refinement, solver), poses
    (n, refinement, solver, 7) as rvec, tvec and RMS; NaN where there is none. Of the package,
    only the poses and the images are taken.
    """
    pipeline = Pipeline.from_dict(GRID, [f"trial={trials}", "window=full"])
    block = whole(pipeline)
    scenes = build_scenes(pipeline.experiment.scene_values(block.indices()), len(block))
    boxes, detectors = marker_boxes(scenes), {}
    for (name, number), (refinement, method) in (
        (one, other) for one in DICTIONARIES.items() for other in REFINEMENTS.items()
    ):
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = method
        detectors[name, refinement] = cv2.aruco.ArucoDetector(
            cv2.aruco.getPredefinedDictionary(number), parameters)
    flags = np.full((len(scenes), len(REFINEMENTS)), NOT_VISIBLE)
    corners = np.full((*flags.shape, 4, 2), np.nan)
    statuses = np.full((*flags.shape, len(METHODS)), NO_DETECTION)
    poses = np.full((*statuses.shape, 7), np.nan)
    for row, (dictionary, marker_id) in enumerate(
        zip(scenes.dictionary, scenes.marker_id, strict=True)
    ):
        rotation, tvec = Rotation.from_matrix(scenes.rotation[row]), scenes.translation[row]
        true_corners = corners_in_image(rotation.as_rotvec(), tvec)
        if not visible(rotation, tvec, true_corners):
            continue
        image = render(scenes, row, boxes[row], (0, 0, 640, 480))
        for k, refinement in enumerate(REFINEMENTS):
            found = detectors[dictionary, refinement].detectMarkers(image)
            flags[row, k], best = classified(true_corners, marker_id, found)
            if best is None:
                continue
            corners[row, k] = best
            for j, method in enumerate(METHODS.values()):
                pose = plain_pose(
                    MARKER_M * SQUARE, best, CAMERA, None, method, 0.25 * mean_side(best))
                statuses[row, k, j] = SOLVER_FAILED if pose is None else SOLVED
                poses[row, k, j] = np.nan if pose is None else pose
    return flags, corners, statuses, poses


@lengths(1, 12)
@pytest.mark.parametrize("window", ["full", "auto"])
def test_markers_of_a_run_are_what_a_plain_opencv_loop_finds(count, window, claim):
    flags, corners, statuses, poses = marker_loop(count)
    _, values = ran(Pipeline.from_dict(GRID, [f"trial={count}", f"window={window}"]))
    numbers = np.bincount(flags.ravel(), minlength=6)[1:]
    assert numbers[DETECTED - 1] > numbers.sum() / 3
    assert (numbers[[REJECTED - 1, NO_CANDIDATE - 1, NOT_VISIBLE - 1]] > 0).all()
    np.testing.assert_array_equal(values["detection"], flags)

    # In a window, corners equal those in the frame bit for bit only without refinement; for the
    # others test_window.py measures how nearly.
    kept = len(REFINEMENTS) if window == "full" else 1
    true_corners = np.array([
        corners_in_image(rvec, tvec)
        for rvec, tvec in zip(values["true_rvec"], values["true_tvec_m"], strict=True)
    ])
    # Stored as float32 (6e-8 relative); 1e-9 px is the rounding of the projected truth.
    np.testing.assert_allclose(
        values["corner_error_px"][:, :kept], corners[:, :kept] - true_corners[:, None],
        rtol=1e-7, atol=1e-9,
    )
    np.testing.assert_array_equal(values["estimate"][:, :kept], statuses[:, :kept])
    solved = statuses == SOLVED
    solved[:, kept:] = False
    estimated = {}
    for name in ("translation_error_m", "rotation_error_rad", "rotation_error_deg",
                 "normal_error_deg", "reprojection_error_px", "flipped"):
        estimated[name] = values[name][solved]
        missing = values[name][:, :kept][~solved[:, :kept]]
        assert (missing == NO_ESTIMATE if name == "flipped" else np.isnan(missing)).all(), name
    row = np.nonzero(solved)[0]
    assert_poses_are(
        estimated, poses[solved], values["true_rvec"][row], values["true_tvec_m"][row]
    )
    claim("flags, corners and poses of a run", "a plain OpenCV loop on full frames", 0.0,
          "of the poses differ")


def assert_poses_are(values, poses, true_rvec, true_tvec):
    """Hold estimation variables (n, ...) against poses (n, 7) of the plain loop."""
    rotation, true_rotation = Rotation.from_rotvec(poses[:, :3]), Rotation.from_rotvec(true_rvec)
    error = rotation * true_rotation.inv()
    normal, true_normal = rotation.as_matrix()[:, :, 2], true_rotation.as_matrix()[:, :, 2]
    between = np.arctan2(
        np.linalg.norm(np.cross(normal, true_normal), axis=1), np.sum(normal * true_normal, axis=1)
    )
    # The same OpenCV call on the same numbers; results are stored as float32 (6e-8 relative).
    for name, expected, rounding in (
        ("translation_error_m", poses[:, 3:6] - true_tvec, 1e-15),
        ("reprojection_error_px", poses[:, 6], 1e-9),  # of two ways to project
        ("rotation_error_deg", np.degrees(error.magnitude()), 1e-9),  # of the true vector
        ("normal_error_deg", np.degrees(between), 1e-9),
    ):
        np.testing.assert_allclose(values[name], expected, rtol=1e-7, atol=rounding, err_msg=name)
    # 1e-6 rad: float32 of a vector of length up to pi, at which its sign is not determined.
    stored = Rotation.from_rotvec(values["rotation_error_rad"].astype(np.float64))
    assert (stored * error.inv()).magnitude().max() < 1e-6
    # The mirror of the truth: its reflection in the plane across the line of sight.
    sight = true_tvec / np.linalg.norm(true_tvec, axis=1, keepdims=True)
    reflection = np.eye(3) - 2 * sight[:, :, None] * sight[:, None, :]
    mirror = reflection @ true_rotation.as_matrix() @ np.diag([1.0, 1.0, -1.0])
    to_mirror = (rotation * Rotation.from_matrix(mirror).inv()).magnitude()
    expected = np.where(to_mirror < error.magnitude(), FLIPPED, NOT_FLIPPED)
    clear = np.abs(to_mirror - error.magnitude()) > 1e-9  # else truth and mirror are one
    np.testing.assert_array_equal(values["flipped"][clear], expected[clear])
    assert clear.mean() > 0.9
    assert (expected[clear] == FLIPPED).any()


BOARD_CAMERA = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
LENS = [-0.2, 0.05, 0.0, 0.0]
BOARD_METHODS = ("iterative", "sqpnp", "ippe", "epnp")


MIN_MARKERS = 0
"""Not OpenCV's default, which is 2."""


def board_pipeline(name, trials):
    squares = "square_m" in KINDS[name]
    points = ["markers", "chessboard"] if squares else ["markers"]
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
        "detector": {"cornerRefinementMaxIterations": 1} | (
            {"minMarkers": MIN_MARKERS} if squares else {}),
        "estimator": {"guarded": False},
        "axes": {
            "distance_m": [0.13, 0.25], "trial": trials, "distortion": [[], LENS],
            "cornerRefinementMethod": ["none", "subpix"], "solver": list(BOARD_METHODS),
            "points": points,
        },
    })


class Sighting:
    """What OpenCV finds of a board in an image, and the truth it is compared with."""

    def __init__(self, name, image, refinement, truth, lens):
        self.board, self.ours = opencv_board(name)
        self.rotation, self.position, self.lens = *truth, lens
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = refinement
        parameters.cornerRefinementMaxIterations = 1  # of the chessboard's corners, too
        detector = cv2.aruco.ArucoDetector(DICTIONARY, parameters)
        self.corners, ids, _ = detector.detectMarkers(image)
        self.listed = [] if ids is None else ids.ravel().tolist()
        # matchImagePoints of a CharucoBoard takes the chessboard's corners.
        markers = cv2.aruco.Board(self.board.getObjPoints(), DICTIONARY, self.board.getIds())
        self.points = [markers.matchImagePoints(self.corners, ids) if self.listed else (None, None)]
        self.chessboard = None
        if isinstance(self.board, cv2.aruco.CharucoBoard) and self.listed:
            neighbours = cv2.aruco.CharucoParameters()
            neighbours.minMarkers = MIN_MARKERS
            search = cv2.aruco.CharucoDetector(self.board, neighbours, parameters)
            cross, numbers, _, _ = search.detectBoard(
                image, markerCorners=self.corners, markerIds=ids)
            self.points.append((None, None) if numbers is None
                               else self.board.matchImagePoints(cross, numbers))
            self.chessboard = {} if numbers is None else dict(
                zip(numbers.ravel().tolist(), cross.reshape(-1, 2), strict=True))

    def projected(self, points):
        vector = Rotation.from_matrix(self.rotation).as_rotvec()
        pixels, _ = cv2.projectPoints(
            self.ours(points), vector, self.position, BOARD_CAMERA, self.lens)
        return pixels.reshape(-1, 2)

    def assert_markers(self, flags, errors):
        """Hold what is detected to the loop's list, and return how many markers were compared.

        A marker of the loop that lies at the truth is detected, with its corners.
        """
        compared = 0
        for m, marker_id in enumerate(self.board.getIds().ravel().tolist()):
            truth = self.projected(self.board.getObjPoints()[m])
            quads = [np.reshape(quad, (4, 2)) - truth for quad, each in
                     zip(self.corners, self.listed, strict=True) if each == marker_id]
            nearest = min(quads, key=lambda off: np.abs(off).max(), default=None)
            if nearest is not None and np.abs(nearest).max() < 3:
                assert flags[m] == DETECTED
                # Corners as OpenCV's float32, and OpenCV's float32 points of the board.
                assert np.abs(errors[m] - nearest).max() < 1e-4
                compared += 1
            elif flags[m] == DETECTED:
                assert quads
            else:
                assert np.isnan(errors[m]).all()
        return compared

    def assert_chessboard(self, errors):
        seen = np.flatnonzero(np.isfinite(errors).all(axis=1)).tolist()
        assert seen == sorted(self.chessboard)
        if seen:
            truth = self.projected(np.array(self.board.getChessboardCorners())[seen])
            off = np.array([self.chessboard[number] for number in seen]) - truth
            assert np.abs(errors[seen] - off).max() < 2e-3

    def pose(self, points, method, printed):
        """OpenCV's pose from points (objects, pixels); None if it is none.

        Solved with the board's own points next to OpenCV's float32 ones, the same to the bit: where
        a solver's iterations end (at FLT_EPSILON, or after 15 steps of SQPnP) hangs on the last
        digits.
        """
        objects, pixels = self.ours(points[0].reshape(-1, 3)), points[1].reshape(-1, 2)
        known = np.concatenate([printed.corners_m.reshape(-1, 3), printed.chessboard_m])
        distance = np.linalg.norm(objects[:, None] - known, axis=2)
        assert distance.min(axis=1).max() < 1e-7
        limit_px = 0.25 * mean_side([quad for quad, each in
                                     zip(self.corners, self.listed, strict=True)
                                     if each in self.board.getIds()])
        return plain_pose(known[distance.argmin(axis=1)], pixels.astype(np.float64), BOARD_CAMERA,
                          self.lens, METHODS[method], limit_px)


@pytest.mark.parametrize("name", first_of(
    ("charuco", "beside", *(k for k in KINDS if k not in ("charuco", "beside"))), 2))
def test_a_board_of_a_run_is_what_a_plain_opencv_loop_finds(name, request):
    trials = 8 if request.node.get_closest_marker("evidence") else 1
    scenes, got = ran(board_pipeline(name, trials))
    boxes, compared, solved = marker_boxes(scenes), 0, 0
    for row in np.flatnonzero((got["detection"] != NOT_VISIBLE).any(axis=1)):
        lens = np.array(LENS) if scenes.cameras.distorted[row] else None
        image = render(scenes, row, boxes[row], (0, 0, 320, 240))
        truth = scenes.rotation[row], scenes.translation[row]
        for k in range(2):
            loop = Sighting(name, image, k, truth, lens)
            flags = got["marker_detection"][row, k]
            assert got["detection"][row, k] == DETECTED or not (flags == DETECTED).any()
            compared += loop.assert_markers(flags, got["marker_corner_error_px"][row, k])
            if not (flags == DETECTED).any():
                continue
            if loop.chessboard is not None:
                loop.assert_chessboard(got["chessboard_corner_error_px"][row, k])
            for j, p in np.ndindex(len(BOARD_METHODS), len(loop.points)):
                at, points = (row, k, j, p), loop.points[p]
                status = got["estimate"][at]
                if points[0] is None or len(points[0]) < 4:
                    assert status not in (SOLVED, SOLVER_FAILED)
                    continue
                pose = loop.pose(points, BOARD_METHODS[j], scenes.targets[row])
                # What lies at the limit may fall on either side of it.
                assert (pose is None) == (status != SOLVED)
                if pose is None:
                    continue
                solved += 1
                assert got["point_count"][at] == len(points[1])
                error = pose[3:6] - truth[1]
                assert np.abs(got["translation_error_m"][at] - error).max() < 2e-5
                turn = Rotation.from_rotvec(pose[:3]) * Rotation.from_matrix(truth[0]).inv()
                stored = Rotation.from_rotvec(got["rotation_error_rad"][at].astype(np.float64))
                assert (stored * turn.inv()).magnitude() < 2e-4
                assert abs(got["reprojection_error_px"][at] - pose[6]) < 2e-3
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
