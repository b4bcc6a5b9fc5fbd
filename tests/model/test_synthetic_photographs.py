"""The maker of test photographs: what it writes is what was seen, and OpenCV finds the truth."""

import json

import cv2
import numpy as np
import pytest

from support.photographs import WEBCAM, photographs, save
from sweep.model.board_kinds import Charuco
from sweep.model.calibration import calibration_of
from sweep.model.structured_text import read_tree

BOARD = Charuco(
    dictionary="DICT_4X4_50", squares_x=5, squares_y=4, square_m=0.03, marker_m=0.022
).board()
CAMERA = {"width_px": 320, "height_px": 240, "fx_px": 300.0, "distortion": (-0.1, 0.02)}


def opencv_pose(image, camera):
    """The board's pose by OpenCV alone, in our frame, and how many markers it found."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    points = BOARD.corners_m[np.ravel(ids)].reshape(-1, 3)
    fx = camera["fx_px"]
    matrix = np.array([[fx, 0, (camera["width_px"] - 1) / 2],
                       [0, fx, (camera["height_px"] - 1) / 2], [0, 0, 1]])
    lens = np.array([*camera["distortion"], 0, 0])
    _, rvec, tvec = cv2.solvePnP(points, np.concatenate(corners).reshape(-1, 2), matrix, lens)
    return cv2.Rodrigues(rvec)[0], tvec.ravel(), len(corners)


def test_opencv_finds_the_board_where_it_is(tmp_path):
    taken = photographs(BOARD, CAMERA, 4, seed=1)
    assert save(tmp_path, taken, CAMERA).name == "camera.yml"
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert sorted(truth) == [f"photo_{i:02d}.png" for i in range(4)]
    for name, pose in truth.items():
        image = cv2.imread(str(tmp_path / name), cv2.IMREAD_GRAYSCALE)
        rotation, translation, found = opencv_pose(image, CAMERA)
        assert found >= 5
        turn = rotation @ np.array(pose["rotation"]).T
        assert np.degrees(np.arccos(min((np.trace(turn) - 1) / 2, 1.0))) < 2
        assert np.linalg.norm(translation - pose["translation"]) < 0.03 * translation[2]


def test_the_camera_file_is_the_camera(tmp_path):
    file = save(tmp_path, [], CAMERA)
    camera = calibration_of(read_tree(file.read_bytes()))
    assert (camera.width_px, camera.height_px, camera.fx_px) == (320, 240, 300.0)
    assert (camera.cx_px, camera.distortion[:2]) == (159.5, (-0.1, 0.02))


@pytest.mark.long
def test_equal_seeds_give_equal_photographs_and_each_effect_changes_them():
    effects = WEBCAM | {
        "curvature_per_m": 0.5, "bend": "saddle", "bayer": "RGGB", "jpeg_quality": 80,
        "tone_knee": 0.2, "tone_toe": 0.2, "noise_table": (0.0, 3.0, 255.0, 1.0),
    }
    small = CAMERA | {"width_px": 160, "height_px": 120, "fx_px": 150.0}
    (image,) = (each.image for each in photographs(BOARD, small, 1, 3, effects))
    (again,) = (each.image for each in photographs(BOARD, small, 1, 3, effects))
    assert np.array_equal(image, again)
    for name in ("sharpening", "bloom", "tone_gamma", "blur_px", "noise_grey", "geometry_px",
                 "curvature_per_m", "bayer", "jpeg_quality", "tone_knee", "tone_toe",
                 "noise_table", "illumination_gradient"):
        less = {key: value for key, value in effects.items() if key != name}
        (other,) = (each.image for each in photographs(BOARD, small, 1, 3, less))
        assert not np.array_equal(image, other), name


def test_an_effect_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="sharpning"):
        photographs(BOARD, CAMERA, 1, 3, {"sharpning": 1.0})
