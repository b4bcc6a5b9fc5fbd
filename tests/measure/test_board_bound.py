"""The bound of boards, in one or several planes: differences of clipped polygons and of images."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from scipy.spatial.transform import Rotation

from support.exact_image import add_clipped, values
from sweep.measure.bound import BACKGROUND_MARGIN_PX, bounds
from sweep.measure.flags import BoundStatus
from sweep.model.board_kinds import BoardMarker, Charuco, Grid, Markers, with_distractors
from sweep.model.effects import NEUTRAL
from sweep.model.exposure import marker_boxes, marker_exposure
from sweep.model.scene import build_scenes

OPENCV = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
ASKED = {False: np.array(["known_blur"]), True: np.array(["unknown_blur"])}
LEVELS = np.array([120.0, 40.0, 200.0])
NOISE = 2.0


def marker(marker_id, x, y, z=0.0, tilt=0.0, azimuth=0.0, size=0.03):
    return BoardMarker(marker_id=marker_id, x_m=x, y_m=y, z_m=z, tilt_deg=tilt,
                       azimuth_deg=azimuth, size_m=size)


FOLD = [marker(0, -0.022, 0, 0, -30, 90), marker(1, 0.022, 0, 0, 30, 90)]
CUBE = [marker(0, 0, 0, 0.021)] + [
    marker(1 + k, 0.021 * np.sin(np.radians(a)), -0.021 * np.cos(np.radians(a)), 0.0, 90, a)
    for k, a in enumerate((0.0, 90.0, 180.0, 270.0))
]
FIELD = [  # two sheets hide the same part of the first, one of them a part of the other
    marker(1, 0, 0, 0), marker(2, 0.02, 0.01, 0.03, 25, 40, 0.02),
    marker(3, -0.012, -0.012, 0.05, 10, 100, 0.015), marker(4, 0.006, 0.0, 0.06, 0, 0, 0.012),
]
TABLE = [marker(7, 0.2, 0.03, size=0.024), marker(3, 0.25, -0.02, size=0.024)]
"""Its origin is far beside it."""


def listed(markers):
    return Markers(
        dictionary="DICT_4X4_50", quiet_zone_modules=1.0, markers=tuple(markers)
    ).board()


CHARUCO = Charuco(
    dictionary="DICT_4X4_50", squares_x=3, squares_y=2, square_m=0.04, marker_m=0.024,
    margin_m=0.01,
).board()


def rectangle(left, up, right, down):
    return np.array([[left, up, 0], [right, up, 0], [right, down, 0], [left, down, 0.0]])


def of_marker(each):
    """A marker's normal, sheet (4, 3) and what is black on it, in the target's frame."""
    azimuth, unit = np.radians(each.azimuth_deg), each.size_m / 6
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * np.radians(each.tilt_deg)
    turn, centre = Rotation.from_rotvec(axis).as_matrix(), [each.x_m, each.y_m, each.z_m]

    def square(left, top, side):
        flat = rectangle(left - 3, 3 - top, left + side - 3, 3 - top - side) * unit
        return flat @ turn.T + centre

    bits = cv2.aruco.generateImageMarker(OPENCV, each.marker_id, 6)
    dark = [square(j, i, 1) for i, j in zip(*np.nonzero(bits == 0), strict=True)]
    return turn[:, 2], square(-1, -1, 8), dark


def of_charuco():
    """The same of :data:`CHARUCO`."""
    corners = [(-0.06, 0.04), (0.02, 0.04), (-0.02, 0.0)]
    dark = [rectangle(x, y, x + 0.04, y - 0.04) for x, y in corners]
    for number, (x, y) in enumerate([(0.0, 0.02), (-0.04, -0.02), (0.04, -0.02)]):
        dark += of_marker(marker(number, x, y, size=0.024))[2]
    return np.array([0.0, 0, 1]), rectangle(-0.07, 0.05, 0.07, -0.05), dark


TARGETS = {
    "charuco": (CHARUCO, [of_charuco()]),
    **{name: (listed(markers), [of_marker(each) for each in markers])
       for name, markers in (("table", TABLE), ("fold", FOLD), ("cube", CUBE))},
}
POSE = {"distance_m": 0.2, "tilt_deg": 35.0, "azimuth_deg": 70.0, "roll_deg": 20.0}
FLAT = {"distance_m": 0.22, "tilt_deg": 33.0, "azimuth_deg": 20.0, "roll_deg": 12.0}


def scene(board, **given):
    return build_scenes(values(**(NEUTRAL | POSE | {
        "size_m": 0.024, "width_px": 160, "height_px": 120, "fx_px": 150.0, "side_px": None,
        "noise_grey": NOISE, "dictionary": "DICT_4X4_50", "board": board,
        **dict(zip(("background", "black", "white"), LEVELS.tolist(), strict=True)),
    } | given)), 1)


def found_of(scenes, unknown_blur=False, boxes=None):
    boxes = marker_boxes(scenes) if boxes is None else boxes
    found = bounds(scenes, boxes, ASKED[unknown_blur], np.array([True]))
    assert found.status[0] == BoundStatus.given
    return found


def box_of(scenes):
    box, frame = marker_boxes(scenes)[0], scenes.frame[0]
    low = np.maximum(box[:2] - BACKGROUND_MARGIN_PX, 0)
    return low, np.minimum(box[2:] + BACKGROUND_MARGIN_PX, frame)


def deviations(areas, seen=slice(None)):
    """Deviations (6,) from shares (3, pixels) of outside, black, white at a step of the pose."""
    slopes = []
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        slopes.append(LEVELS @ (areas(step) - areas(-step)) / 2e-6)
    design = np.concatenate([slopes, areas(np.zeros(6))]).T[seen]
    norms = np.linalg.norm(design, axis=0)
    inverse = np.linalg.inv(np.linalg.qr(design / norms)[1])
    covariance = (NOISE**2 + 1 / 12) * (inverse @ inverse.T) / np.outer(norms, norms)
    return np.sqrt(np.diag(covariance))[:6]


def share_of(scenes, polygons, rotation, position):
    """Shares (h, w) of the box's pixels that polygons (4, 3) of the target cover."""
    low, high = box_of(scenes)
    view = scenes.cameras.view[0]
    share = np.zeros((high - low)[::-1])
    for corners in polygons:
        points = corners @ rotation.T + position
        pixels = points[:, :2] / points[:, 2:] * view[:2] + view[2:] - low
        add_clipped(np.zeros_like(share), share, pixels, 0.0)
    return share


def clipped_areas(parts, scenes):
    """A function of a step of the pose: shares of clipped polygons, none of which hides another."""
    def areas(step):
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ scenes.rotation[0]
        position = scenes.translation[0] + step[3:]
        facing = [(sheet, dark) for normal, sheet, dark in parts
                  if (rotation @ normal) @ (rotation @ sheet[0] + position) < 0]
        sheet = share_of(scenes, [sheet for sheet, _ in facing], rotation, position).ravel()
        dark = share_of(
            scenes, [each for _, dark in facing for each in dark], rotation, position).ravel()
        return np.array([1 - sheet, dark, sheet - dark])

    return areas


def image_areas(scenes):
    """The same from exact images, which are judged by rays (tests/model/test_solid_board.py)."""
    low, high = box_of(scenes)
    rotation, position = scenes.rotation[0].copy(), scenes.translation[0].copy()

    def areas(step):
        scenes.rotation[0] = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        scenes.translation[0] = position + step[3:]
        shares = []
        for levels in ([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]):
            share = marker_exposure(scenes, 0, (*low, *high), np.array(levels))
            shares.append(share.ravel())
        scenes.rotation[0], scenes.translation[0] = rotation, position
        dark, light = shares
        return np.array([1 - dark - light, dark, light])

    return areas


def long(*case):
    return pytest.param(*case, marks=pytest.mark.long)


@pytest.mark.parametrize(("name", "pose"), [
    ("fold", {}), long("cube", {}), long("charuco", FLAT),
    long("charuco",  # cut by the frame
         {"distance_m": 0.15, "tilt_deg": 55.0, "azimuth_deg": 200.0, "roll_deg": 80.0}),
    long("table", {"distance_m": 0.3, "tilt_deg": 25.0, "roll_deg": 5.0, "shift_u_px": -110.0}),
])
def test_bound_of_a_board_is_that_of_differences_of_clipped_polygons(name, pose):
    board, parts = TARGETS[name]
    scenes = scene(board, **pose)
    expected = deviations(clipped_areas(parts, scenes))
    # Edges near pixels' corners cross them within a step.
    np.testing.assert_allclose(found_of(scenes).std[0], expected, rtol=2e-5 if pose else 1e-4)


@pytest.mark.parametrize(("lens", "blur_px"), [
    ((), 0.0), long((), 0.6), long((-0.2, 0.05, 0, 0), 0.0),
])
def test_bound_of_sheets_that_hide_others_is_that_of_differences_of_images(lens, blur_px):
    """Edges at which a sheet is hidden move with the sheet in front.

    Images with blur are quadratures, with errors of 1e-4 (of one marker, too).
    """
    scenes = scene(listed(FIELD), distortion=lens, blur_px=blur_px)
    expected = deviations(image_areas(scenes))
    np.testing.assert_allclose(found_of(scenes).std[0], expected, rtol=2e-3 if blur_px else 2e-5)


@pytest.mark.parametrize("unknown_blur", [False, True])
def test_targets_in_one_plane_have_the_same_bound_from_the_sum_over_their_sheets(unknown_blur):
    flat, raised = (
        scene(listed([marker(3, 0.0, 0.0, z), marker(7, 0.05, 0.01, z)]), blur_px=0.5)
        for z in (0.0, 1e-12)
    )
    boxes = marker_boxes(flat)
    one, several = (found_of(each, unknown_blur, boxes).std for each in (flat, raised))
    np.testing.assert_allclose(several, one, rtol=1e-6)


def test_pixels_of_a_distractor_tell_nothing_of_the_board():
    """It touches the board's sheet, so that neighbours of its pixels see the board's edge."""
    board, parts = TARGETS["charuco"]
    side = 0.03 * 8 / 6
    beside = with_distractors(board, [(None, 0.07 + side / 2, 0.0, 0.03, 0, 0, 0, 0, None)], 1, 1)
    scenes = scene(beside, **FLAT)
    square = rectangle(0.07, side / 2, 0.07 + side, -side / 2)
    hidden = share_of(scenes, [square], scenes.rotation[0], scenes.translation[0])
    seen = maximum_filter(np.abs(hidden), 3).ravel() < 1e-9
    expected = deviations(clipped_areas(parts, scenes), seen)
    np.testing.assert_allclose(found_of(scenes).std[0], expected, rtol=2e-5)
    assert (found_of(scenes).std > 1.002 * found_of(scene(board, **FLAT)).std).any()


@pytest.mark.parametrize("board", [
    listed(FOLD), Grid(dictionary="DICT_4X4_50", rows=1, columns=2, marker_m=0.03,
                       gap_m=0.014).board(),
], ids=["fold", "flat"])
def test_what_a_distractor_in_front_hides_tells_nothing(board):
    hidden = with_distractors(board, [(9, -0.01, 0.0, 0.015, 0, 0.06, 20, 10, None)], 1, 1)
    behind, free = (found_of(scene(each, blur_px=0.5)).std for each in (hidden, board))
    assert (behind > free).all()


@pytest.mark.parametrize("unknown_blur", [False, True])
def test_bound_of_a_board_of_one_marker_is_the_marker_s(unknown_blur):
    alone, beside = (listed([marker(3, *at, size=0.024)]) for at in ((0.0, 0.0), (0.02, 0.01)))
    pose = {"distance_m": 0.1, "tilt_deg": 40.0, "azimuth_deg": 20.0, "roll_deg": 12.0,
            "marker_id": 3, "quiet_zone_modules": 1.0, "blur_px": 0.4}
    lone = scene(None, **pose)
    single, board = (found_of(each, unknown_blur) for each in (lone, scene(alone, **pose)))
    for name in ("std", "kappa", "mirror_distance"):
        np.testing.assert_array_equal(getattr(board, name), getattr(single, name))
    # The same marker, its board's origin elsewhere: turns are known as well, the mirror is as far.
    moved = scene(beside, **pose)
    away = lone.rotation[0] @ [0.02, 0.01, 0.0]
    moved.translation[0] -= away
    moved.plane[0, :, 2] -= away
    shifted = found_of(moved, unknown_blur, marker_boxes(lone))
    np.testing.assert_allclose(shifted.std[0, :3], single.std[0, :3], rtol=1e-8)
    np.testing.assert_allclose(shifted.kappa, single.kappa, rtol=1e-8)
    np.testing.assert_allclose(shifted.mirror_distance, single.mirror_distance, rtol=1e-5)
