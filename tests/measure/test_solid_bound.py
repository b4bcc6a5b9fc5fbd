"""The bound of targets in several planes: differences of clipped polygons, and of exact images."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.exact_image import add_clipped
from sweep.evaluation.block import run_cells
from sweep.measure.bound import BACKGROUND_MARGIN_PX, bounds
from sweep.measure.flags import BoundStatus
from sweep.model.coverage import sum_levels
from sweep.model.extent import marker_boxes
from sweep.model.scene import build_scenes
from sweep.model.scene_sheet import accumulate_solid
from sweep.plan.grid import scene_values
from sweep.plan.pipeline import Pipeline

OPENCV = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
LEVELS = np.array([120.0, 40.0, 200.0])
NOISE = 2.0


def marker(marker_id, x, y, z, tilt=0.0, azimuth=0.0, size=0.03):
    return {"marker_id": marker_id, "x_m": x, "y_m": y, "z_m": z, "tilt_deg": tilt,
            "azimuth_deg": azimuth, "size_m": size}


FOLD = [marker(0, -0.022, 0, 0, -30, 90), marker(1, 0.022, 0, 0, 30, 90)]
CUBE = [marker(0, 0, 0, 0.021)] + [
    marker(1 + k, 0.021 * np.sin(np.radians(a)), -0.021 * np.cos(np.radians(a)), 0.0, 90, a)
    for k, a in enumerate((0.0, 90.0, 180.0, 270.0))
]
FIELD = [  # two sheets hide the same part of the first, one of them a part of the other
    marker(1, 0, 0, 0), marker(2, 0.02, 0.01, 0.03, 25, 40, 0.02),
    marker(3, -0.012, -0.012, 0.05, 10, 100, 0.015), marker(4, 0.006, 0.0, 0.06, 0, 0, 0.012),
]


def pipeline(board, **sections):
    return Pipeline.from_dict({
        "seed": 2,
        "camera": {"width_px": 160, "height_px": 120, "fx_px": 150, "fy_px": 150,
                   **sections.pop("camera", {})},
        "marker": {"dictionary": "DICT_4X4_50", "size_m": 0.03},
        "board": board,
        "pose": {"distance_m": 0.2, "tilt_deg": 35, "azimuth_deg": 70, "roll_deg": 20,
                 **sections.pop("pose", {})},
        "scene": {"background": LEVELS[0], "black": LEVELS[1], "white": LEVELS[2],
                  "noise_grey": NOISE, "bound": "known_blur", **sections.pop("scene", {})},
        "estimator": {"solver": "iterative"}, **sections,
    })


def listed(markers, **beside):
    return {"kind": "markers", "markers": markers, **beside}


def scenes_of(chosen):
    return build_scenes(scene_values(chosen, []), 1)


def bound_of(scenes, boxes=None, *, unknown_blur=False):
    boxes = marker_boxes(scenes) if boxes is None else boxes
    found = bounds(scenes, np.array([0]), boxes, unknown_blur)
    assert found.status[0] == BoundStatus.given
    return found.std[0]


def box_of(scenes):
    box, frame = marker_boxes(scenes)[0], scenes.frame[0]
    low = np.maximum(box[:2] - BACKGROUND_MARGIN_PX, 0)
    return low, np.minimum(box[2:] + BACKGROUND_MARGIN_PX, frame)


def deviations(areas, step_size, left_out=None):
    """Deviations (6,) from shares (3, pixels) of outside, black, white at a step of the pose."""
    slopes = []
    for k in range(6):
        step = np.zeros(6)
        step[k] = step_size
        slopes.append(LEVELS @ (areas(step) - areas(-step)) / (2 * step_size))
    design = np.concatenate([slopes, areas(np.zeros(6))]).T
    if left_out is not None:
        design = design[~left_out.ravel()]
    norms = np.linalg.norm(design, axis=0)
    inverse = np.linalg.inv(np.linalg.qr(design / norms)[1])
    covariance = (NOISE**2 + 1 / 12) * (inverse @ inverse.T) / np.outer(norms, norms)
    return np.sqrt(np.diag(covariance))[:6]


def squares(each):
    """The corners (4, 3) of a marker's sheet, and of what is black on it, in the target's frame."""
    azimuth, unit = np.radians(each["azimuth_deg"]), each["size_m"] / 6
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * np.radians(each["tilt_deg"])
    turn = Rotation.from_rotvec(axis).as_matrix()
    centre = [each["x_m"], each["y_m"], each["z_m"]]

    def square(left, top, side):
        points = np.array([[left, top], [left + side, top], [left + side, top + side],
                           [left, top + side]]) - 3
        flat = np.column_stack([points[:, 0], -points[:, 1], np.zeros(4)]) * unit
        return flat @ turn.T + centre

    bits = cv2.aruco.generateImageMarker(OPENCV, each["marker_id"], 6)
    dark = [square(j, i, 1) for i, j in zip(*np.nonzero(bits == 0), strict=True)]
    return turn[:, 2], square(-1, -1, 8), dark


def clipped_areas(markers, scenes):
    """A function of a step of the pose: shares of clipped polygons, none of which hides another."""
    low, high = box_of(scenes)
    width, height = (high - low).tolist()
    view = scenes.cameras.view[0]
    shapes = [squares(each) for each in markers]

    def areas(step):
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ scenes.rotation[0]
        position = scenes.translation[0] + step[3:]
        shares = np.zeros((2, height, width))
        for normal, sheet, dark in shapes:
            if (rotation @ normal) @ (rotation @ sheet[0] + position) >= 0:
                continue
            for share, corners in [(shares[0], sheet), *((shares[1], each) for each in dark)]:
                points = corners @ rotation.T + position
                pixels = points[:, :2] / points[:, 2:] * view[:2] + view[2:] - low
                add_clipped(np.zeros((height, width)), share, pixels, 0.0)
        sheet, dark = shares.reshape(2, -1)
        return np.array([1 - sheet, dark, sheet - dark])

    return areas


def image_areas(scenes, sigma=0.0):
    """The same from exact images, which are judged by rays (tests/model/test_solid_board.py)."""
    low, high = box_of(scenes)
    width, height = (high - low).tolist()
    rotation, position = scenes.rotation[0].copy(), scenes.translation[0].copy()

    def areas(step):
        scenes.rotation[0] = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        scenes.translation[0] = position + step[3:]
        shares = []
        for levels in ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0]):
            cover, share = np.zeros((height, width + 2)), np.empty((height, width))
            accumulate_solid(cover, scenes, 0, np.array(levels), (*low, *high), sigma)
            sum_levels(cover, 0.0, share)
            shares.append(share.ravel())
        scenes.rotation[0], scenes.translation[0] = rotation, position
        dark, light = shares
        return np.array([1 - dark - light, dark, light])

    return areas


@pytest.mark.parametrize("markers", [
    FOLD, pytest.param(CUBE, marks=pytest.mark.long)
], ids=["fold", "cube"])
def test_bound_of_a_target_in_several_planes_is_that_of_clipped_polygons(markers):
    scenes = scenes_of(pipeline(listed(markers)))
    expected = deviations(clipped_areas(markers, scenes), 1e-6)
    # Edges near pixels' corners cross them within a step.
    np.testing.assert_allclose(bound_of(scenes), expected, rtol=1e-4)


@pytest.mark.parametrize(("lens", "blur_px"), [
    ([], 0.0), *(pytest.param(lens, blur, marks=pytest.mark.long)
                 for lens, blur in (([], 0.6), ([-0.2, 0.05, 0, 0], 0.0))),
])
def test_bound_of_sheets_that_hide_others_is_that_of_differences_of_images(lens, blur_px):
    """Edges at which a sheet is hidden move with the sheet in front.

    Images with blur are quadratures, with errors of 1e-4 (of one marker, too).
    """
    scenes = scenes_of(pipeline(
        listed(FIELD), camera={"distortion": lens}, scene={"blur_px": blur_px}
    ))
    expected = deviations(image_areas(scenes, blur_px), 1e-6)
    np.testing.assert_allclose(bound_of(scenes), expected, rtol=2e-3 if blur_px else 2e-5)


def test_targets_in_one_plane_have_the_same_bound_from_the_sum_over_their_sheets():
    """As flat boards have it, which is judged by tests/measure/test_board_bound.py."""
    flat = [marker(3, 0.0, 0.0, 0.0), marker(7, 0.05, 0.01, 0.0)]
    raised = [{**each, "z_m": 1e-12} for each in flat]
    scenes = [scenes_of(pipeline(listed(each), scene={"blur_px": 0.5})) for each in (flat, raised)]
    boxes = marker_boxes(scenes[0])
    for unknown_blur in (False, True):
        one, several = (bound_of(each, boxes, unknown_blur=unknown_blur) for each in scenes)
        np.testing.assert_allclose(several, one, rtol=1e-6)


def test_what_a_distractor_in_front_hides_tells_nothing():
    """Pixels of the distractor, and their neighbours, have no slopes, be the target flat or not."""
    beside = [marker(9, -0.01, 0.0, 0.06, 20, 10, 0.015)]
    for board in (listed(FOLD), {"kind": "grid", "rows": 1, "columns": 2, "gap_m": 0.014}):
        behind, free = (
            bound_of(scenes_of(pipeline(each, scene={"blur_px": 0.5})))
            for each in ({**board, "distractors": beside}, board)
        )
        assert (behind > free).all()


@pytest.mark.long
def test_poses_of_a_flat_board_behind_a_distractor_attain_the_bound():
    """RMSE of 200 x 3 errors scatters by 3 %."""
    chosen = pipeline(
        {"kind": "grid", "rows": 2, "columns": 2, "gap_m": 0.008,
         "distractors": [marker(9, 0.03, 0.01, 0.05, 20, 10, 0.02)]},
        camera={"width_px": 320, "height_px": 240, "fx_px": 400, "fy_px": 400},
        scene={"blur_px": 0.5}, estimator={"solver": "photometric"}, pose={"jitter_px": 5},
        axes={"trial": 200},
    )
    result = run_cells(chosen, [np.arange(200)])
    assert not result.failures
    columns = {name: parts[0] for name, parts in result.columns.items()}
    relative = np.concatenate(
        [columns["rotation_error_rad"], columns["translation_error_m"]], axis=1
    ) / columns["bound_std"]
    for part in (relative[:, :3], relative[:, 3:]):
        assert 0.88 < np.sqrt((part**2).mean()) < 1.12
    assert abs(columns["nees"].mean() - 6) < 5 * np.sqrt(12 / 200)
