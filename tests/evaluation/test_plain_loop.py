"""The kernel gives what a plain OpenCV loop over full frames gives."""

import functools

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.blocks import run_block
from support.lengths import lengths
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.model.exposure import marker_boxes
from sweep.model.renderers import render
from sweep.model.scene import build_scenes

DICTIONARIES = {"DICT_4X4_50": cv2.aruco.DICT_4X4_50, "DICT_6X6_250": cv2.aruco.DICT_6X6_250}
REFINEMENTS = {"none": 0, "subpix": 1, "contour": 2, "apriltag": 3}
SOLVERS = {
    name: getattr(cv2, f"SOLVEPNP_{name.upper()}")
    for name in ("ippe_square", "iterative", "sqpnp", "p3p", "ap3p", "epnp", "ippe")
}
SIZE_M = 0.05
CAMERA = np.array([[4.0 / 4.8 * 640, 0, 319.5], [0, 4.0 / 3.6 * 480, 239.5], [0, 0, 1]])

# Flags of the dataset, as the design lists them.
DETECTED, WRONG_ID, REJECTED, NO_CANDIDATE, NOT_VISIBLE = 1, 2, 3, 4, 5
SOLVED, NO_DETECTION, SOLVER_FAILED = 1, 2, 3
NOT_FLIPPED, FLIPPED, NO_ESTIMATE = 1, 2, 3

GRID = {
    "seed": 77, "marker": {"size_m": SIZE_M}, "scene": {"background": 90},
    "pose": {
        "azimuth_deg": {"uniform": [0, 360]}, "roll_deg": {"uniform": [0, 360]},
        "bearing_x_deg": {"uniform": [-29, 29]}, "bearing_y_deg": {"uniform": [-22, 22]},
    },
    "estimator": {"guarded": False},
    "axes": {
        "dictionary": list(DICTIONARIES), "marker_id": [0, 7, 42], "tilt_deg": [0, 25, 55, 75],
        "distance_m": [0.12, 0.4, 1.3], "trial": 2, "cornerRefinementMethod": list(REFINEMENTS),
        "solver": list(SOLVERS),
    },
}


def corners_in_space(size_m):
    half = size_m / 2
    return np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])


def corners_in_image(rvec, tvec):
    return cv2.projectPoints(corners_in_space(SIZE_M), rvec, tvec, CAMERA, None)[0].reshape(4, 2)


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


def visible(true_rotation, true_tvec, true_corners):
    """Tell whether the marker faces the camera and its black square meets the frame."""
    frame = np.array([[-0.5, -0.5], [639.5, -0.5], [639.5, 479.5], [-0.5, 479.5]])
    in_space = true_rotation.apply(corners_in_space(SIZE_M * 1.5)) + true_tvec
    faces = true_rotation.as_matrix()[:, 2] @ true_tvec < 0
    area, _ = cv2.intersectConvexConvex(
        true_corners.astype(np.float32), frame.astype(np.float32)
    )
    return faces and (in_space[:, 2] > 0).all() and area > 0


def plain_pose(corners, solver):
    """Return OpenCV's rvec, tvec and RMS reprojection error, or None where it is no pose."""
    try:
        found, rvec, tvec = cv2.solvePnP(
            corners_in_space(SIZE_M), corners, CAMERA, None, flags=SOLVERS[solver]
        )
    except cv2.error:
        return None
    if not found or not np.isfinite([rvec, tvec]).all():
        return None
    in_space = Rotation.from_rotvec(rvec[:, 0]).apply(corners_in_space(SIZE_M)) + tvec[:, 0]
    if (in_space[:, 2] <= 0).any():
        return None
    off = corners_in_image(rvec, tvec) - corners
    rms = np.sqrt(np.mean(np.sum(off**2, axis=1)))
    side = np.mean(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1))
    return None if rms > 0.25 * side else (rvec[:, 0], tvec[:, 0], rms)


@functools.cache
def plain_loop(trials):
    """Return what the loop finds in ``trials`` of every pose of the grid.

    Flags (n, refinement), corners (n, refinement, 4, 2), statuses (n, refinement, solver), poses
    (n, refinement, solver, 7) as rvec, tvec and RMS; NaN where there is none. Of the package,
    only the poses and the images are taken.
    """
    pipeline = Pipeline.from_dict(GRID, [f"trial={trials}", "window=full"])
    block = whole(pipeline)
    scenes = build_scenes(pipeline.experiment.scene_values(block.indices()), len(block))
    boxes = marker_boxes(scenes)
    detectors = {}
    for name, number in DICTIONARIES.items():
        for refinement, method in REFINEMENTS.items():
            parameters = cv2.aruco.DetectorParameters()
            parameters.cornerRefinementMethod = method
            detectors[name, refinement] = cv2.aruco.ArucoDetector(
                cv2.aruco.getPredefinedDictionary(number), parameters
            )
    flags = np.full((len(block), len(REFINEMENTS)), NOT_VISIBLE)
    corners = np.full((*flags.shape, 4, 2), np.nan)
    statuses = np.full((*flags.shape, len(SOLVERS)), NO_DETECTION)
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
            for j, solver in enumerate(SOLVERS):
                pose = plain_pose(best, solver)
                statuses[row, k, j] = SOLVER_FAILED if pose is None else SOLVED
                if pose is not None:
                    poses[row, k, j] = np.concatenate([*pose[:2], [pose[2]]])
    return flags, corners, statuses, poses


def whole(pipeline):
    shape = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    return Block((0,) * len(shape), shape)


@lengths(1, 12)
@pytest.mark.parametrize("window", ["full", "auto"])
def test_kernel_gives_what_a_plain_opencv_loop_gives(count, window, claim):
    flags, corners, statuses, poses = plain_loop(count)
    pipeline = Pipeline.from_dict(GRID, [f"trial={count}", f"window={window}"])
    block = whole(pipeline)
    result = run_block(pipeline, block)
    assert not result.failures
    values = {
        name: column.reshape(len(block), *column.shape[len(block.shape) :])
        for name, column in result.values.items()
    }
    numbers = np.bincount(flags.ravel(), minlength=6)[1:]
    assert numbers[DETECTED - 1] > numbers.sum() / 3
    assert (numbers[[REJECTED - 1, NO_CANDIDATE - 1, NOT_VISIBLE - 1]] > 0).all()
    np.testing.assert_array_equal(values["detection"], flags)

    # In a window, corners equal those in the frame bit for bit only without refinement; for the
    # others tests/test_window.py measures how nearly.
    kept = len(REFINEMENTS) if window == "full" else 1
    true_corners = np.array([
        corners_in_image(rvec, tvec)
        for rvec, tvec in zip(values["true_rvec"], values["true_tvec_m"], strict=True)
    ])
    # Stored as float32 (6e-8 relative); 1e-9 px is the rounding of the projected truth.
    np.testing.assert_allclose(
        values["corner_error_px"][:, :kept],
        corners[:, :kept] - true_corners[:, None],
        rtol=1e-7, atol=1e-9,
    )
    np.testing.assert_array_equal(values["estimate"][:, :kept], statuses[:, :kept])
    solved = statuses == SOLVED
    solved[:, kept:] = False
    estimated = {name: values[name][solved] for name in ESTIMATED}
    for name in ESTIMATED:
        missing = values[name][:, :kept][~solved[:, :kept]]
        assert (missing == NO_ESTIMATE if name == "flipped" else np.isnan(missing)).all(), name
    row = np.nonzero(solved)[0]
    assert_poses_are(
        estimated, poses[solved], values["true_rvec"][row], values["true_tvec_m"][row]
    )
    claim("flags, corners and poses of a run", "a plain OpenCV loop on full frames", 0.0,
          "of the poses differ")


ESTIMATED = ("translation_error_m", "rotation_error_rad", "rotation_error_deg",
             "normal_error_deg", "reprojection_error_px", "flipped")


def assert_poses_are(values, poses, true_rvec, true_tvec):
    """Hold estimation variables (n, ...) against poses (n, 7) of the plain loop."""
    rotation, true_rotation = Rotation.from_rotvec(poses[:, :3]), Rotation.from_rotvec(true_rvec)
    # The same OpenCV call on the same numbers; results are stored as float32 (6e-8 relative).
    np.testing.assert_allclose(
        values["translation_error_m"], poses[:, 3:6] - true_tvec, rtol=1e-7, atol=1e-15
    )
    # 1e-9 px: the rounding of two ways to project.
    np.testing.assert_allclose(
        values["reprojection_error_px"], poses[:, 6], rtol=1e-7, atol=1e-9
    )
    error = rotation * true_rotation.inv()
    # 1e-6 rad: float32 of a vector of length up to pi, at which its sign is not determined.
    stored = Rotation.from_rotvec(values["rotation_error_rad"].astype(np.float64))
    assert (stored * error.inv()).magnitude().max() < 1e-6
    # 1e-9 degrees: rounding of the truth's rotation vector.
    np.testing.assert_allclose(
        values["rotation_error_deg"], np.degrees(error.magnitude()), rtol=1e-7, atol=1e-9
    )
    normal, true_normal = rotation.as_matrix()[:, :, 2], true_rotation.as_matrix()[:, :, 2]
    between = np.arctan2(
        np.linalg.norm(np.cross(normal, true_normal), axis=1), np.sum(normal * true_normal, axis=1)
    )
    np.testing.assert_allclose(
        values["normal_error_deg"], np.degrees(between), rtol=1e-7, atol=1e-9
    )
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
