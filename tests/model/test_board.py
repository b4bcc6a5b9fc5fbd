"""Boards have OpenCV's layouts: corners and IDs; Kalibr's grids its picture.

Pictures of the other kinds are held in tests/evaluation/test_board_scenes.py.
"""

import cv2
import numpy as np
import pytest

from support.small_scenes import image_of
from sweep.model.board import first_overlap
from sweep.model.board_kinds import AprilGrid, Charuco

DICTIONARY = "DICT_4X4_250"
OPENCV = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)


def in_our_frame(points, middle):
    """Points (..., 3) of OpenCV's boards (down from the top left, z in) in our frame."""
    return (points - [*middle, 0]) * [1, -1, -1]


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("shape", [(3, 4), (4, 3), (5, 5), (4, 6)])
def test_charuco_board_is_opencvs(shape, legacy):
    ours = Charuco(
        dictionary=DICTIONARY, squares_x=shape[0], squares_y=shape[1], square_m=0.02,
        marker_m=0.012, first_id=7, legacy_pattern=legacy, margin_m=0.01,
    ).board()
    ids = np.arange(7, 7 + len(ours))
    theirs = cv2.aruco.CharucoBoard(shape, 0.02, 0.012, OPENCV, ids)
    theirs.setLegacyPattern(legacy)
    middle = np.array(shape) * 0.01
    corners = in_our_frame(np.array(theirs.getObjPoints()), middle)
    assert ours.marker_ids == tuple(theirs.getIds().ravel())
    assert np.abs(ours.corners_m - corners).max() < 1e-8
    chessboard = in_our_frame(np.array(theirs.getChessboardCorners()), middle)
    assert np.abs(ours.chessboard_m - chessboard).max() < 1e-8


def squares(boxes):
    return np.array([np.column_stack([cv2.boxPoints(box), np.zeros(4)]) for box in boxes])


def test_squares_overlap_as_their_clipped_polygons_do():
    rng = np.random.default_rng(4)
    seen = set()
    for _ in range(300):
        centres, sides = rng.uniform(-1, 1, (2, 2)), rng.uniform(0.3, 1.5, 2)
        boxes = [((float(x), float(y)), (float(s), float(s)), float(np.degrees(r)))
                 for (x, y), s, r in zip(centres, sides, rng.uniform(0, 7, 2), strict=True)]
        state, region = cv2.rotatedRectangleIntersection(*boxes)
        area = 0.0 if region is None else cv2.contourArea(cv2.convexHull(region))
        if state == cv2.INTERSECT_NONE or area > 1e-4:
            seen.add(area > 0)
            assert (first_overlap(squares(boxes)) is not None) == (area > 0)
    assert seen == {True, False}
    beside = [((x, 0.0), (1.0, 1.0), 0.0) for x in (0.0, 1.0)]
    assert first_overlap(squares(beside)) is None


def test_an_april_grid_in_kalibrs_words_is_what_kalibr_prints():
    """IDs from the bottom left, upwards; codes turned by 180 degrees against OpenCV's dictionary.

    That is what kalibr_create_target_pdf draws of its codes (rotation=2): of ID 0,
    0xd5d628584, bit 6 i + j is row i, column j of a matrix turned by 180 degrees.
    """
    grid = {"tagCols": 4, "tagRows": 3, "tagSpacing": 0.25}
    board = AprilGrid(dictionary="DICT_APRILTAG_36h11", tagSize=0.016, **grid).board()
    assert board.marker_ids == tuple(range(12))
    corners = board.corners_m
    assert corners[0, :, :2].max() < 0  # at the bottom left
    assert np.allclose(corners[1] - corners[0], [0.02, 0, 0])
    assert np.allclose(corners[4] - corners[0], [0, 0.02, 0])
    image = image_of(text={  # 1 px a mm, 2 a module, and 4 around
        "camera": {"width_px": 84, "height_px": 64, "fx_px": 1000, "fy_px": 1000},
        "marker": {"dictionary": "DICT_APRILTAG_36h11", "size_m": 0.016},
        "board": {"kind": "aprilgrid", **grid}, "pose": {"distance_m": 1},
        "scene": {"background": 255}, "estimator": {"solver": "iterative"},
    })
    expected = np.full(image.shape, 255.0)
    theirs = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    code = np.array([[0xD5D628584 >> (6 * i + j) & 1 for j in range(6)] for i in range(6)])
    assert (cv2.aruco.generateImageMarker(theirs, 0, 8)[1:7, 1:7] // 255 == code).all()
    for up in range(4):
        for column in range(5):
            y, x = image.shape[0] - 20 * up, 20 * column
            expected[y - 4 : y, x : x + 4] = 0
            if up < 3 and column < 4:
                tag = cv2.aruco.generateImageMarker(theirs, 4 * up + column, 16)
                expected[y - 20 : y - 4, x + 4 : x + 20] = tag[::-1, ::-1]
    assert (image == expected).all()
