"""Searching a window around the marker finds what searching the whole frame finds."""

import cv2
import numpy as np
import pytest

from support.blocks import run_block
from support.lengths import lengths
from support.searching import searched
from support.windows import corners_of, outcomes_elsewhere
from sweep.errors import PipelineError
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import search_windows, visibility_flags
from sweep.experiment.grid import (
    Block,
)
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import REFINEMENTS, DetectorSetting, full_frame_reason, windows
from sweep.measure.flags import DetectionStatus
from sweep.model.exposure import marker_boxes
from sweep.model.marker import opencv_dictionary
from sweep.model.renderers import render
from sweep.model.scene import build_scenes

SCENES = """
seed = 11
[camera]
width_px = {width}
height_px = {height}
[marker]
[pose]
tilt_deg = {{ uniform = [0, 80] }}
azimuth_deg = {{ uniform = [0, 360] }}
roll_deg = {{ uniform = [0, 360] }}
bearing_x_deg = {{ uniform = [-33, 33] }}   # half the field of view is 31 by 24 degrees
bearing_y_deg = {{ uniform = [-26, 26] }}
[axes]
dictionary = ["DICT_4X4_50", "DICT_5X5_50", "DICT_6X6_250", "DICT_APRILTAG_36h11"]
background = [0, 128, 255]
marker_id = [3, 17]
side_px = {{ geom = [6, 400, 24] }}
trial = 20
"""


def visible_scenes(count, width=640, height=480, settings=()):
    """Return ``count`` scenes of the grid, each visible at least in part."""
    pipeline = Pipeline.from_text(SCENES.format(width=width, height=height), settings)
    shape = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    order = np.random.default_rng(5).permutation(int(np.prod(shape)))

    def built(cells):
        indices = list(np.unravel_index(cells, shape))
        return build_scenes(pipeline.experiment.scene_values(indices), len(cells))

    candidates = order[: count * 5 // 4 + 20]
    seen = np.flatnonzero(visibility_flags(built(candidates)) == DetectionStatus.not_run)
    assert len(seen) >= count
    return built(candidates[seen[:count]])


@single_threaded()
def both_searches(scenes, setting):
    """Return what a setting finds in the windows, and in the whole frames."""
    return searched(scenes, setting), searched(scenes, setting, full=True)


def compare(count, width, height, refinement, claim):
    """Hold window and frame equal for ``count`` poses; print how far the corners differ."""
    setting = DetectorSetting(cornerRefinementMethod=refinement)
    scenes = visible_scenes(count, width, height)
    windowed, framed = both_searches(scenes, setting)
    exceptions = np.flatnonzero(windowed.flags != framed.flags)
    both = (windowed.flags == DetectionStatus.detected) & (framed.flags == DetectionStatus.detected)
    difference = np.abs(corners_of(windowed) - corners_of(framed))[both].max(axis=(1, 2))
    median, high, worst = np.quantile(difference, [0.5, 0.99, 1.0])
    cut = (scenes.outline_px < -0.5) | (scenes.outline_px > scenes.frame[:, None] - 0.5)
    print(
        f"\n{width}x{height} {refinement}: {count} poses, {cut.any(axis=(1, 2)).sum()} cut by "
        f"the frame, {both.sum()} detected, {len(exceptions)} exceptions; corners differ by "
        f"median {median:.2g}, 99th percentile {high:.2g}, worst {worst:.2g} px"
    )
    claim(f"corners in windows, {refinement}", "whole frames of 640 x 480 and 4000 x 3000", high,
          "px (99th percentile)")
    claim("flags in windows", "whole frames of 640 x 480 and 4000 x 3000", len(exceptions) / count,
          "of the poses differ")
    assert len(exceptions) <= max(1, 0.001 * count)
    for row in exceptions:
        # OpenCV itself is not invariant to where these very pixels lie in the frame.
        assert len(outcomes_elsewhere(scenes, row, setting)) > 1, (
            f"pose {row}: {windowed.flags[row]} in the window, {framed.flags[row]} in the frame"
        )
    if refinement == "none":
        assert worst == 0.0
    elif refinement == "apriltag":
        # Corners are float32 in the pixels of the image that was searched.
        assert worst <= np.spacing(np.float32(width))
    elif refinement == "subpix":
        # The iteration stops at a step of 0.1 px, and never leaves the half window of 5 px
        # around its start, which is the same for both: 10 px between any two results.
        assert high < DetectorSetting().cornerRefinementMinAccuracy
        assert worst <= 2 * DetectorSetting().cornerRefinementWinSize
    else:
        # Lines are fitted in float32 to whole-pixel contours; sums of products of coordinates
        # lose digits with the square of the distance to the image's corner (0.3 px at 4000).
        assert worst < 1.0


PINNED = """
[marker]
dictionary = "DICT_6X6_250"
marker_id = 17
[pose]
side_px = 10.376535841555254
tilt_deg = 20.68056882444784
azimuth_deg = 215.69171069220565
roll_deg = 319.86845927813033
bearing_x_deg = 8.876074845458405
bearing_y_deg = 21.136956593398267
[scene]
background = 255
"""


def test_pose_that_a_margin_of_16_px_lost_to_the_apriltag_search_is_found_as_in_the_frame():
    """Rejected in the frame and no candidate in a window with 16 px around it."""
    scenes = build_scenes(Pipeline.from_text(PINNED).experiment.scene_values([]), 1)
    windowed, framed = both_searches(scenes, DetectorSetting(cornerRefinementMethod="apriltag"))
    assert windowed.flags == framed.flags


@lengths(100, 10_600)
@pytest.mark.parametrize("refinement", REFINEMENTS)
def test_window_finds_what_the_frame_of_640_by_480_holds(count, refinement, claim):
    compare(count, 640, 480, refinement, claim)


@pytest.mark.long
@lengths(4, 500)
@pytest.mark.parametrize("refinement", REFINEMENTS)
def test_window_finds_what_the_frame_of_4000_by_3000_holds(count, refinement, claim):
    compare(count, 4000, 3000, refinement, claim)


OTHER_SETTINGS = [
    {"adaptiveThreshWinSizeMax": 61},
    {"adaptiveThreshWinSizeMin": 4, "adaptiveThreshWinSizeMax": 24,
     "adaptiveThreshWinSizeStep": 4},
    {"adaptiveThreshConstant": 1.0},
    {"adaptiveThreshConstant": 0.5},
    {"adaptiveThreshConstant": 0.0},
    {"adaptiveThreshConstant": -5.0},
    {"minMarkerPerimeterRate": 0.2},
    {"minMarkerPerimeterRate": 0.05, "maxMarkerPerimeterRate": 0.125},
    {"polygonalApproxAccuracyRate": 0.1},
    {"minDistanceToBorder": 10},
    {"minDistanceToBorder": 0},
    {"minMarkerDistanceRate": 0.0},
    {"minGroupDistance": 2.0},
    {"markerBorderBits": 2},
    {"perspectiveRemovePixelPerCell": 10, "validBitIdThreshold": 0.2},
    {"detectInvertedMarker": True},
    {"useAruco3Detection": True},
    {"cornerRefinementMethod": "apriltag", "aprilTagQuadSigma": 2.0},
    {"cornerRefinementMethod": "apriltag", "aprilTagQuadSigma": -1.0},
    {"cornerRefinementMethod": "apriltag", "aprilTagQuadDecimate": 2.0},
    {"cornerRefinementMethod": "apriltag", "aprilTagMinWhiteBlackDiff": 100},
    {"cornerRefinementMethod": "apriltag", "aprilTagMinClusterPixels": 100},
    {"cornerRefinementMethod": "apriltag", "minDistanceToBorder": 0},
]


@lengths(10, 500)
@pytest.mark.parametrize(
    "given", OTHER_SETTINGS, ids=lambda given: ",".join(f"{k}={v}" for k, v in given.items())
)
def test_window_finds_what_the_frame_holds_under_other_settings(count, given):
    setting = DetectorSetting(**given)
    scenes = visible_scenes(count)
    windowed, framed = both_searches(scenes, setting)
    assert (windowed.flags != framed.flags).sum() <= 0.001 * count
    both = (windowed.flags == DetectionStatus.detected) & (framed.flags == DetectionStatus.detected)
    difference = np.abs(corners_of(windowed) - corners_of(framed))[both]
    exact = (
        full_frame_reason(setting) is not None or setting.cornerRefinementMethod == "none"
    )
    # As above: one float32 ulp of the frame's width for apriltag's corners.
    assert difference.max(initial=0.0) <= (0.0 if exact else np.spacing(np.float32(640)))


@lengths(10, 500)
@pytest.mark.parametrize("changed", ["quiet_zone_modules=0", "distortion=[-0.3,0.1,0.001,-0.002]"])
def test_window_finds_what_the_frame_holds_without_quiet_zone_and_through_a_lens(count, changed):
    scenes = visible_scenes(count, settings=[changed])
    windowed, framed = both_searches(scenes, DetectorSetting())
    np.testing.assert_array_equal(windowed.flags, framed.flags)
    np.testing.assert_array_equal(corners_of(windowed), corners_of(framed))


PAIRED = """
seed = 3
[pose]
tilt_deg = { uniform = [0, 70] }
bearing_x_deg = { uniform = [-30, 30] }
[scene]
background = 128
[axes]
side_px = [15, 40, 120]
trial = 12
cornerRefinementMethod = ["none", "subpix", "contour", "apriltag"]
adaptiveThreshWinSizeMax = [23]
solver = ["ippe_square", "iterative"]
"""


def test_adding_a_setting_with_a_larger_window_changes_no_other_setting():
    alone, beside = (
        run_block(Pipeline.from_text(PAIRED, settings), Block((0, 0), (3, 12))).values
        for settings in ((), ("adaptiveThreshWinSizeMax=[61, 23]",))
    )
    assert (alone["detection"] == DetectionStatus.detected).any()
    for name, expected in alone.items():
        found = beside[name]
        if found.shape != expected.shape:
            found = found[:, :, :, 1:]
        np.testing.assert_array_equal(found, expected, err_msg=name)


def test_deglitching_is_refused():
    """OpenCV's aprilTagDeglitch reads memory that it never wrote, at the image's border."""
    with pytest.raises(PipelineError, match="aprilTagDeglitch = 1"):
        Pipeline.from_text(PAIRED, ["cornerRefinementMethod=apriltag", "aprilTagDeglitch=1"])


def test_settings_of_the_grid_are_told_apart_by_their_margins():
    pipeline = Pipeline.from_text(PAIRED, ["adaptiveThreshWinSizeMax=[23, 61]"])
    small, large = pipeline.experiment.detectors[:2]
    assert (small.adaptiveThreshWinSizeMax, large.adaptiveThreshWinSizeMax) == (23, 61)
    scenes = visible_scenes(20)
    inner, outer = (
        search_windows(scenes, marker_boxes(scenes), setting, np.zeros(20, dtype=bool))
        for setting in (small, large)
    )
    assert (outer[:, :2] <= inner[:, :2]).all()
    assert (outer[:, 2:] >= inner[:, 2:]).all()
    assert (outer != inner).any()


BOARDS = {
    "charuco": 'kind = "charuco"\nsquares_x = 5\nsquares_y = 4\nsquare_m = 0.03',
    "grid": 'kind = "grid"\nrows = 3\ncolumns = 3\ngap_m = 0.01',
    "squares": 'kind = "grid"\nrows = 3\ncolumns = 3\ngap_m = 0.006\ncorner_squares = true',
}
BOARD = """
seed = 8
[marker]
dictionary = "DICT_5X5_100"
size_m = 0.02
[board]
{board}
[pose]
tilt_deg = {{ uniform = [0, 60] }}
azimuth_deg = {{ uniform = [0, 360] }}
roll_deg = {{ uniform = [0, 360] }}
bearing_x_deg = {{ uniform = [-15, 15] }}
bearing_y_deg = {{ uniform = [-12, 12] }}
[scene]
background = 100
noise_grey = {noise}
window = "{window}"
[estimator]
solver = "sqpnp"
[axes]
distance_m = [0.25, 0.4, 0.7]
cornerRefinementMethod = ["none", "subpix"]
trial = {trials}
"""


def boards(name, noise, trials):
    """Return what the windows and the whole frames of a board's scenes give."""
    return [
        run_block(Pipeline.from_text(BOARD.format(
            board=BOARDS[name], noise=noise, window=window, trials=trials,
        )), Block((0, 0), (3, trials))).values
        for window in ("auto", "full")
    ]


@lengths(8, 40)
@pytest.mark.parametrize("noise", [0, 3])
@pytest.mark.parametrize("name", BOARDS)
def test_window_finds_of_a_board_what_the_frame_holds_but_for_stated_exceptions(
    name, noise, count
):
    """OpenCV's answers depend on the place of the pixels, not on what surrounds the window.

    The same pixels pasted elsewhere in the full frame give as many other corners (below).
    """
    windowed, framed = boards(name, noise, count)
    for k, refinement in enumerate(("none", "subpix")):
        flags = [each["marker_detection"][:, k] for each in (windowed, framed)]
        other = int((flags[0] != flags[1]).sum())
        told = f"\n{name}, noise {noise}, {refinement}: {other} of {flags[0].size} flags differ"
        assert other <= max(4, 0.005 * flags[0].size)
        for variable in ("marker_corner_error_px", "chessboard_corner_error_px"):
            if variable not in framed or not framed[variable].size:
                continue
            off = np.abs(windowed[variable][:, k] - framed[variable][:, k]).max(axis=-1)
            off = off[np.isfinite(off)]
            told += (f"; {variable}: {(off > 0.1).sum()} of {off.size} corners beyond 0.1 px, "
                     f"worst {off.max():.2g} px")
            assert (off > 0.1).sum() <= max(4, 0.003 * off.size)
            # Two half windows of the refinement, or a pixel of another quadrilateral.
            assert off.max() <= 3
        print(told)


@lengths(12, 60)
@pytest.mark.parametrize("name", ["charuco", "grid"])
def test_opencv_refines_the_same_pixels_elsewhere_in_the_frame_otherwise(name, count):
    text = BOARD.format(board=BOARDS[name], noise=0, window="full", trials=count)
    pipeline = Pipeline.from_text(text)
    shape = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    values = pipeline.experiment.scene_values(Block((0, 0), shape).indices())
    scenes = build_scenes(values, 3 * count)
    boxes = marker_boxes(scenes)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(opencv_dictionary("DICT_5X5_100"), parameters)
    moved, compared = [], 0
    for row in range(len(scenes)):
        x0, y0, x1, y1 = windows(boxes[[row]], scenes.frame[[row]], np.array([[16]]))[0].tolist()
        if x0 == 0 or y0 == 0 or x1 == 640 or y1 == 480:
            continue
        image = render(scenes, row, boxes[row], (0, 0, 640, 480))
        elsewhere = np.full_like(image, 100)
        elsewhere[: y1 - y0, : x1 - x0] = image[y0:y1, x0:x1]
        found = []
        for each in (image, elsewhere):
            corners, ids, _ = detector.detectMarkers(each)
            numbers = [] if ids is None else ids.ravel().tolist()
            quads = np.reshape(corners, (-1, 4, 2))
            found.append(dict(zip(numbers, quads, strict=True)))
        for marker in found[0].keys() & found[1].keys():
            off = np.abs(found[1][marker] + [x0, y0] - found[0][marker]).max(axis=1)
            moved += off[off > 0.1].tolist()
            compared += 4
    print(f"\n{name}: {len(moved)} of {compared} corners beyond 0.1 px, worst "
          f"{max(moved, default=0):.2g} px")
    assert moved
