"""The accuracy bound of boards, against clipped polygons that are differentiated numerically."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from support.exact_image import add_clipped, values
from sweep.measure.bound import BACKGROUND_MARGIN_PX, bounds
from sweep.measure.flags import BoundStatus
from sweep.model.board_kinds import BoardMarker, Charuco, Markers, with_distractors
from sweep.model.effects import NEUTRAL
from sweep.model.extent import marker_boxes
from sweep.model.scene import build_scenes

OPENCV = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
LEVELS = {"black": 40.0, "white": 200.0, "background": 120.0}


def charuco():
    """A chessboard of 3 x 2 squares of 40 mm; sheet and black areas in metres, right and up."""
    squares = [(-0.06 + 0.04 * j, 0.04 - 0.04 * i, 0.04) for i in range(2) for j in range(3)
               if (i + j) % 2 == 0]
    centres = [(0.0, 0.02), (-0.04, -0.02), (0.04, -0.02)]
    board = Charuco(
        dictionary="DICT_4X4_50", squares_x=3, squares_y=2, square_m=0.04, marker_m=0.024,
        margin_m=0.01,
    ).board()
    return board, [(-0.07, 0.05, 0.07, -0.05)], squares, [(k, *at) for k, at in enumerate(centres)]


def table():
    """Two markers whose origin is far beside them, each on a sheet of its own."""
    centres = [(7, 0.2, 0.03), (3, 0.25, -0.02)]
    board = Markers(
        dictionary="DICT_4X4_50", quiet_zone_modules=1.0,
        markers=tuple(BoardMarker(marker_id=k, x_m=x, y_m=y, size_m=0.024) for k, x, y in centres),
    ).board()
    return board, [(x - 0.016, y + 0.016, x + 0.016, y - 0.016) for _, x, y in centres], [], centres


def rectangles(sheets, squares, markers):
    """Rectangles (left, up, right, down) in metres: of sheets, and of what is black on them."""
    black = [(x, y, x + side, y - side) for x, y, side in squares]
    for marker_id, x, y in markers:
        bits = cv2.aruco.generateImageMarker(OPENCV, marker_id, 6)
        for i, j in zip(*np.nonzero(bits == 0), strict=True):
            left, up = x - 0.012 + 0.004 * j, y + 0.012 - 0.004 * i
            black.append((left, up, left + 0.004, up - 0.004))
    return sheets, black


def reference(scenes, sheets, black, noise, hides=None):
    """Deviations (6,) of the bound, from images of clipped polygons; the levels are unknown.

    ``hides``: corners (4, 2) on the board of what hides the pixels that it touches, and their
    neighbours.
    """
    view, frame = scenes.cameras.view[0], scenes.frame[0]
    low = np.maximum(marker_boxes(scenes)[0, :2] - BACKGROUND_MARGIN_PX, 0)
    high = np.minimum(marker_boxes(scenes)[0, 2:] + BACKGROUND_MARGIN_PX, frame)
    width, height = (high - low).tolist()

    def areas(step):
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ scenes.rotation[0]
        shares = np.zeros((2, height, width))
        for share, boxes in zip(shares, (sheets, black), strict=True):
            for left, up, right, down in boxes:
                corners = [[left, up, 0], [right, up, 0], [right, down, 0], [left, down, 0]]
                points = corners @ rotation.T + scenes.translation[0] + step[3:]
                pixels = points[:, :2] / points[:, 2:] * view[:2] + view[2:] - low
                add_clipped(np.zeros((height, width)), share, pixels, 0.0)
        sheet, dark = shares.reshape(2, -1)
        return np.array([1 - sheet, dark, sheet - dark])

    levels = np.array([LEVELS[name] for name in ("background", "black", "white")])
    slopes = []
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        slopes.append(levels @ (areas(step) - areas(-step)) / 2e-6)
    design = np.concatenate([slopes, areas(np.zeros(6))]).T
    if hides is not None:
        share = np.zeros((height, width))
        points = np.pad(hides, ((0, 0), (0, 1))) @ scenes.rotation[0].T + scenes.translation[0]
        add_clipped(
            np.zeros_like(share), share, points[:, :2] / points[:, 2:] * view[:2] + view[2:] - low,
            0.0,
        )
        design = design[maximum_filter(np.abs(share), 3).ravel() < 1e-9]
    norms = np.linalg.norm(design, axis=0)
    inverse = np.linalg.inv(np.linalg.qr(design / norms)[1])
    covariance = (noise**2 + 1 / 12) * (inverse @ inverse.T) / np.outer(norms, norms)
    return np.sqrt(np.diag(covariance))[:6]


def scene(board, **given):
    return build_scenes(values(**(NEUTRAL | LEVELS | {
        "size_m": 0.024, "width_px": 160, "height_px": 120, "fx_px": 150.0, "side_px": None,
        "noise_grey": 2.0, "dictionary": "DICT_4X4_50", "board": board,
    } | given)), 1)


def found_of(scenes, unknown_blur=False):
    found = bounds(scenes, np.array([0]), marker_boxes(scenes), unknown_blur)
    assert found.status[0] == BoundStatus.given
    return found


@pytest.mark.long
@pytest.mark.parametrize(
    ("parts", "pose"),
    [
        (charuco, {"distance_m": 0.22, "tilt_deg": 33.0, "azimuth_deg": 20.0, "roll_deg": 12.0}),
        (charuco, {"distance_m": 0.15, "tilt_deg": 55.0, "azimuth_deg": 200.0, "roll_deg": 80.0}),
        (table, {"distance_m": 0.3, "tilt_deg": 25.0, "azimuth_deg": 70.0, "roll_deg": 5.0,
                 "shift_u_px": -110.0}),
    ],
    ids=["charuco", "cut by the frame", "origin beside the markers"],
)
def test_bound_of_a_board_is_that_of_differences_of_clipped_polygons(parts, pose):
    board, sheets, squares, markers = parts()
    scenes = scene(board, **pose)
    expected = reference(scenes, *rectangles(sheets, squares, markers), 2.0)
    # Edges near pixels' corners cross them within a step.
    np.testing.assert_allclose(found_of(scenes).std[0], expected, rtol=2e-5)


def test_pixels_of_a_distractor_tell_nothing_of_the_board():
    """It touches the board's sheet, so that neighbours of its pixels see the board's edge."""
    board, sheets, squares, markers = charuco()
    side = 0.03 * 8 / 6
    beside = with_distractors(board, [(None, 0.07 + side / 2, 0.0, 0.03, 0, 0, 0, 0, None)], 1, 1)
    pose = {"distance_m": 0.22, "tilt_deg": 33.0, "azimuth_deg": 20.0, "roll_deg": 12.0}
    scenes = scene(beside, **pose)
    x, y = np.array([[-1, 1, 1, -1], [1, 1, -1, -1]]) * side / 2
    square = np.column_stack([x + 0.07 + side / 2, y])
    expected = reference(scenes, *rectangles(sheets, squares, markers), 2.0, square)
    np.testing.assert_allclose(found_of(scenes).std[0], expected, rtol=2e-5)
    assert (found_of(scenes).std > 1.002 * found_of(scene(board, **pose)).std).any()


@pytest.mark.parametrize("unknown_blur", [False, True])
def test_bound_of_a_board_of_one_marker_is_the_marker_s(unknown_blur):
    alone = Markers(
        dictionary="DICT_4X4_50", quiet_zone_modules=1.0,
        markers=(BoardMarker(marker_id=3, x_m=0.0, y_m=0.0, size_m=0.024),),
    ).board()
    beside = Markers(
        dictionary="DICT_4X4_50", quiet_zone_modules=1.0,
        markers=(BoardMarker(marker_id=3, x_m=0.02, y_m=0.01, size_m=0.024),),
    ).board()
    pose = {"distance_m": 0.1, "tilt_deg": 40.0, "azimuth_deg": 20.0, "roll_deg": 12.0,
            "marker_id": 3, "quiet_zone_modules": 1.0, "blur_px": 0.4}
    single = found_of(scene(None, **pose), unknown_blur)
    board = found_of(scene(alone, **pose), unknown_blur)
    for name in ("std", "kappa", "mirror_distance"):
        np.testing.assert_array_equal(getattr(board, name), getattr(single, name))
    # The same marker, its board's origin elsewhere: turns are known as well, the mirror is as far.
    marker = scene(None, **pose)
    moved = scene(beside, **pose)
    away = marker.rotation[0] @ [0.02, 0.01, 0.0]
    moved.translation[0] -= away
    moved.plane[0, :, 2] -= away
    shifted = bounds(moved, np.array([0]), marker_boxes(marker), unknown_blur)
    np.testing.assert_allclose(shifted.std[0, :3], single.std[0, :3], rtol=1e-8)
    np.testing.assert_allclose(shifted.kappa, single.kappa, rtol=1e-8)
    np.testing.assert_allclose(shifted.mirror_distance, single.mirror_distance, rtol=1e-5)
