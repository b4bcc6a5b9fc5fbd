"""The maker of test photographs: what it writes is what was seen, and OpenCV finds the truth."""

import json

import cv2
import numpy as np

from support.photographs import photographs, save
from sweep.model.board_kinds import Charuco

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
