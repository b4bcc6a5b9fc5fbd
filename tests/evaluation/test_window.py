"""Searching a window around the marker finds what searching the whole frame finds."""

import numpy as np
import pytest

from support.blocks import run_block, whole
from support.lengths import lengths
from support.windows import outcomes_elsewhere, searched
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import visibility_flags
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import REFINEMENTS, DetectorSetting, full_frame_reason
from sweep.measure.flags import DetectionStatus
from sweep.model.scene import build_scenes

SCENES = {
    "seed": 11,
    "pose": {
        "tilt_deg": {"uniform": [0, 80]}, "azimuth_deg": {"uniform": [0, 360]},
        "roll_deg": {"uniform": [0, 360]},
        # Half the field of view is 31 by 24 degrees.
        "bearing_x_deg": {"uniform": [-33, 33]}, "bearing_y_deg": {"uniform": [-26, 26]},
    },
    "axes": {
        "dictionary": ["DICT_4X4_50", "DICT_5X5_50", "DICT_6X6_250", "DICT_APRILTAG_36h11"],
        "background": [0, 128, 255], "marker_id": [3, 17],
        "side_px": {"geom": [6, 400, 24]}, "trial": 20,
    },
}


def visible_scenes(count, width=640, height=480, settings=()):
    """Return ``count`` scenes of the grid, each visible at least in part."""
    document = SCENES | {"camera": {"width_px": width, "height_px": height}}
    pipeline = Pipeline.from_dict(document, settings)
    block = whole(pipeline)
    order = np.random.default_rng(5).permutation(len(block))

    def built(cells):
        return build_scenes(
            pipeline.experiment.scene_values(block.indices(cells)), len(cells))

    candidates = order[: count * 5 // 4 + 20]
    seen = np.flatnonzero(visibility_flags(built(candidates), 0) == DetectionStatus.not_run)
    assert len(seen) >= count
    return built(candidates[seen[:count]])


def limit_px(setting, width):
    """How far corners in windows may be from those in frames."""
    if full_frame_reason(setting):
        return 0.0
    return {
        "none": 0.0,
        # The iteration stops at a step of 0.1 px, and never leaves the half window around its
        # start, which is the same for both.
        "subpix": 2.0 * setting.cornerRefinementWinSize,
        # Lines are fitted in float32 to whole-pixel contours; sums of products of coordinates lose
        # digits with the square of the distance to the image's corner (0.3 px at 4000).
        "contour": 1.0,
        # Corners are float32 in the pixels of the image that was searched.
        "apriltag": np.spacing(np.float32(width)),
    }[setting.cornerRefinementMethod]


@single_threaded()
def compared(scenes, setting):
    """Hold window and frame equal but for few exceptions of OpenCV's own; return how far corners
    differ where both are detected, and the exceptions' number."""
    windowed, framed = searched(scenes, setting), searched(scenes, setting, full=True)
    exceptions = np.flatnonzero(windowed.flags != framed.flags)
    assert len(exceptions) <= max(1, 0.01 * len(scenes))
    for row in exceptions:
        # OpenCV itself is not invariant to where these very pixels lie in the frame.
        assert len(outcomes_elsewhere(scenes, row, setting)) > 1, row
    both = (windowed.flags == DetectionStatus.detected) & (framed.flags == DetectionStatus.detected)
    corners, expected = (each.found.marker_corners[:, 0] for each in (windowed, framed))
    difference = np.abs(corners - expected)[both].max(axis=(1, 2))
    assert difference.max(initial=0.0) <= limit_px(setting, scenes.frame[0, 0])
    return difference, len(exceptions)


@pytest.mark.parametrize("refinement", REFINEMENTS)
@pytest.mark.parametrize(("count", "width", "height"), [
    (100, 640, 480), pytest.param(1500, 640, 480, marks=pytest.mark.long),
    pytest.param(40, 4000, 3000, marks=pytest.mark.long),
])
def test_window_finds_what_the_frame_holds(count, width, height, refinement, claim):
    setting = DetectorSetting(cornerRefinementMethod=refinement)
    difference, exceptions = compared(visible_scenes(count, width, height), setting)
    high = np.quantile(difference, 0.99)
    claim(f"corners in windows, {refinement}", "whole frames of 640 x 480 and 4000 x 3000", high,
          "px (99th percentile)")
    claim("flags in windows", "whole frames of 640 x 480 and 4000 x 3000", exceptions / count,
          "of the poses differ")
    if refinement == "subpix":
        assert high < DetectorSetting().cornerRefinementMinAccuracy


SETTINGS = [
    {"adaptiveThreshWinSizeMax": 61},
    {"adaptiveThreshWinSizeMin": 4, "adaptiveThreshWinSizeMax": 24,
     "adaptiveThreshWinSizeStep": 4},
    *({"adaptiveThreshConstant": constant} for constant in (0.5, 0.0, -5.0)),
    {"minMarkerPerimeterRate": 0.05, "maxMarkerPerimeterRate": 0.125},
    {"polygonalApproxAccuracyRate": 0.1}, {"minDistanceToBorder": 10},
    {"minMarkerDistanceRate": 0.0}, {"markerBorderBits": 2},
    {"perspectiveRemovePixelPerCell": 10, "validBitIdThreshold": 0.2},
    {"detectInvertedMarker": True}, {"useAruco3Detection": True},
    *({"cornerRefinementMethod": "apriltag", name: value} for name, value in {
        "aprilTagQuadSigma": 2.0, "aprilTagQuadDecimate": 2.0, "aprilTagMinWhiteBlackDiff": 100,
        "aprilTagMinClusterPixels": 100, "minDistanceToBorder": 0,
    }.items()),
]
# cornerSubPix refuses images narrower than its window: with a margin of 16 px, 40 %.
WIDE = {"cornerRefinementMethod": "subpix", "cornerRefinementWinSize": 40,
        "relativeCornerRefinmentWinSize": 100.0}
WHOLE = ["bearing_x_deg=0", "bearing_y_deg=0", "side_px={geom=[12, 200, 12]}"]
PROCESSING = [
    ["quiet_zone_modules=0"], ["distortion=[-0.3, 0.1, 0.001, -0.002]"], ["noise_grey=8"],
    ["noise_grey=16", "noise_correlation=0.99"],
    ["noise_grey=4", "jpeg_quality=1", "noise_correlation=0.7"],
    ["noise_grey=4", "bayer=RGGB", "bayer_red=0.8", "demosaic=edge_aware"],
    ["noise_grey=4", "sharpening=2", "sharpening_px=3", "blur_px=0.5"],
    ["bloom=1", "illumination_gradient=2", "illumination_deg=30"],
    ["noise_table=[0, 20, 255, 2]", "sharpening=1", "sharpening_px=20"],
]


@pytest.mark.parametrize(("setting", "scene"), [
    *((setting, []) for setting in SETTINGS), *(({}, scene) for scene in PROCESSING),
    (WIDE, WHOLE),
], ids=str)
@lengths(7, 100)
def test_window_finds_what_the_frame_holds_under_any_setting_and_processing(count, setting, scene):
    compared(visible_scenes(count, settings=scene), DetectorSetting(**setting))


def test_adding_a_setting_with_a_larger_window_changes_no_other_setting():
    alone, beside = (
        run_block(Pipeline.from_dict({
            "seed": 3, "scene": {"background": 128},
            "pose": {"tilt_deg": {"uniform": [0, 70]}, "bearing_x_deg": {"uniform": [-30, 30]}},
            "axes": {
                "side_px": [15, 40, 120], "trial": 12, "cornerRefinementMethod": list(REFINEMENTS),
                "adaptiveThreshWinSizeMax": sizes, "solver": ["ippe_square", "iterative"],
            },
        }), Block((0, 0), (3, 12))).values
        for sizes in ([23], [61, 23])
    )
    assert (alone["detection"] == DetectionStatus.detected).any()
    for name, expected in alone.items():
        found = beside[name]
        if found.shape != expected.shape:
            found = found[:, :, :, 1:]
        np.testing.assert_array_equal(found, expected, err_msg=name)


BOARDS = {
    "charuco": {"kind": "charuco", "squares_x": 5, "squares_y": 4, "square_m": 0.03},
    "squares": {"kind": "grid", "rows": 3, "columns": 3, "gap_m": 0.006, "corner_squares": True},
}


def board_of(name, noise, window, trials):
    """What the windows or the whole frames of a board's scenes give."""
    pipeline = Pipeline.from_dict({
        "seed": 8, "marker": {"dictionary": "DICT_5X5_100", "size_m": 0.02}, "board": BOARDS[name],
        "pose": {
            "tilt_deg": {"uniform": [0, 60]}, "azimuth_deg": {"uniform": [0, 360]},
            "roll_deg": {"uniform": [0, 360]}, "bearing_x_deg": {"uniform": [-15, 15]},
            "bearing_y_deg": {"uniform": [-12, 12]},
        },
        "scene": {"background": 100, "noise_grey": noise, "window": window},
        "estimator": {"solver": "sqpnp"},
        "axes": {"distance_m": [0.25, 0.4, 0.7], "cornerRefinementMethod": ["none", "subpix"],
                 "trial": trials},
    })
    return run_block(pipeline, Block((0, 0), (3, trials))).values


@pytest.mark.parametrize("noise", [0, 3])
@pytest.mark.parametrize("name", BOARDS)
@lengths(4, 40)
def test_window_finds_of_a_board_what_the_frame_holds_but_for_stated_exceptions(
    count, name, noise, claim
):
    """OpenCV's answers depend on the place of the pixels, not on what surrounds the window."""
    windowed, framed = (board_of(name, noise, window, count) for window in ("auto", "full"))
    for k in range(2):
        flags, expected = (each["marker_detection"][:, k] for each in (windowed, framed))
        claim("flags of boards in windows", "whole frames", (flags != expected).mean(),
              "of the markers differ")
        assert (flags != expected).sum() <= max(4, 0.005 * flags.size)
        for variable in ("marker_corner_error_px", "chessboard_corner_error_px"):
            if variable not in framed or not framed[variable].size:
                continue
            off = np.abs(windowed[variable][:, k] - framed[variable][:, k]).max(axis=-1)
            off = off[np.isfinite(off)]
            assert (off > 0.1).sum() <= max(4, 0.003 * off.size)
            # Two half windows of the refinement, or a pixel of another quadrilateral.
            assert off.max() <= 3
