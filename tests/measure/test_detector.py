"""OpenCV's detector is set as asked, sees the right window, and keeps its known conventions."""

import dataclasses
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.blocks import run_block, whole
from support.lengths import lengths
from sweep.experiment.pipeline import Pipeline
from sweep.measure.classify import TargetScenes, classify
from sweep.measure.detectors import (
    ALIGNMENT_PX,
    MIN_WINDOW_PX,
    REFINEMENTS,
    BoardDetectorSetting,
    DetectorSetting,
    SearchOutput,
    make_detector,
    opencv_search,
    windows,
)
from sweep.measure.flags import DetectionStatus
from sweep.measure.sources import ImageSearch
from sweep.model.board import single_marker
from sweep.model.exposure import marker_boxes
from sweep.model.marker import marker_count, module_count, opencv_dictionary_names
from sweep.model.renderers import render
from sweep.model.scene import Targets, build_scenes

FIELDS = {field.name: field.default for field in dataclasses.fields(DetectorSetting)}


def opencv_fields(parameters):
    """Return every value that OpenCV's parameters hold, by name."""
    return {
        name: getattr(parameters, name) for name in dir(parameters)
        if not name.startswith("_") and not callable(getattr(parameters, name))
    }


HELD = opencv_fields(cv2.aruco.DetectorParameters())


def test_every_field_of_the_installed_opencv_is_declared_with_its_default():
    assert set(HELD) <= set(FIELDS)
    for name, value in HELD.items():
        ours = REFINEMENTS[FIELDS[name]] if name == "cornerRefinementMethod" else FIELDS[name]
        assert type(ours) is type(value) or isinstance(ours, float)
        assert ours == pytest.approx(value, rel=1e-7)  # some are float32 of OpenCV's


OTHER = {
    name: not default if isinstance(default, bool)
    else default + 2 if isinstance(default, int)
    else (1.25 * default or 0.25) if isinstance(default, float)
    else "subpix"
    for name, default in FIELDS.items()
    if name in HELD
} | {"aprilTagDeglitch": 1}


def held_by(setting, side=64, frame_side=64):
    """OpenCV's parameters in a search of an image with ``side`` of a frame with ``frame_side``."""
    search = opencv_search(setting, "DICT_4X4_50", side, frame_side)
    return search.__self__.getDetectorParameters()


def test_field_that_is_set_reaches_opencv_and_no_other_changes():
    for name, value in OTHER.items():
        setting = DetectorSetting(**{name: value})
        assert value != FIELDS[name]
        assert opencv_fields(held_by(setting)) == {
            each: REFINEMENTS[wanted] if each == "cornerRefinementMethod"
            else pytest.approx(wanted, rel=1e-7)  # some are float32
            for each, wanted in dataclasses.asdict(setting).items() if each in OTHER
        }, name


@given(
    rates=st.tuples(st.floats(0.001, 0.5), st.floats(0.5, 8.0)),
    frame_side=st.integers(8, 8000),
    side=st.integers(8, 500),
)
@settings(derandomize=True, deadline=None, max_examples=100)
def test_perimeter_limits_come_to_the_same_pixels_in_a_window_as_in_the_frame(
    rates, frame_side, side
):
    """OpenCV turns a rate into ``unsigned(rate * max(width, height))`` pixels."""
    side = min(side, frame_side)
    setting = DetectorSetting(minMarkerPerimeterRate=rates[0], maxMarkerPerimeterRate=rates[1])
    held = held_by(setting, side, frame_side)
    assert int(held.minMarkerPerimeterRate * side) == int(rates[0] * frame_side)
    assert int(held.maxMarkerPerimeterRate * side) == int(rates[1] * frame_side)


# What OpenCV gives for a square from 99.5 to 201.5: the first and the last coordinate.
CONVENTIONS = {
    "none": (100.0, 201.0), "contour": (100.0, 201.0), "subpix": (99.56, 201.44),
    "apriltag": (100.0, 202.0),
}


@pytest.mark.parametrize("refinement", REFINEMENTS)
def test_corners_of_an_upright_square_follow_opencvs_known_conventions(refinement):
    image = np.full((300, 320), 255, dtype=np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image[100:202, 100:202] = cv2.aruco.generateImageMarker(dictionary, 1, 102)
    setting = DetectorSetting(cornerRefinementMethod=refinement)
    corners, ids, _ = make_detector(setting)(image, "DICT_4X4_50", 320)
    assert ids == [1]
    a, b = CONVENTIONS[refinement]
    # 0.01 px: contour's float32 line fit, and the two digits of subpix' convention.
    np.testing.assert_allclose(corners[0][0], [[a, a], [b, a], [b, b], [a, b]], atol=0.01)


def test_a_photograph_is_searched_once_a_dictionary():
    image = np.full((200, 200), 255, np.uint8)
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_50)
    image[50:146, 50:146] = cv2.aruco.generateImageMarker(known, 7, 96)
    targets = [single_marker(f"DICT_{name}_50", 7, 0.2) for name in ("6X6", "6X6", "4X4")]
    search = ImageSearch(
        DetectorSetting(), BoardDetectorSetting(), SimpleNamespace(frame=np.full((3, 2), 200)),
        SimpleNamespace(targets=targets))
    first, second, other = (search(row, image) for row in range(3))
    assert second is first
    assert first.ids == [7]
    assert other.ids is None


@pytest.mark.parametrize("dictionary", opencv_dictionary_names())
def test_every_dictionary_is_rendered_and_found_with_its_id_and_rotation(dictionary):
    # The first, a middle and the last ID; the original dictionary's last is symmetric.
    count = marker_count(dictionary)
    ids = [0, count // 2, count - (2 if dictionary == "DICT_ARUCO_ORIGINAL" else 1)]
    # A whole even number of pixels a module: every module's edges lie between pixels.
    side = module_count(dictionary) * (140 // module_count(dictionary) // 2 * 2)
    pipeline = Pipeline.from_text(
        f"[pose]\nside_px = {side}\n[scene]\nbackground = 128\n[axes]\n"
        f'dictionary = ["{dictionary}"]\nmarker_id = {ids}\n'
        "roll_deg = [0, 90, 180, 270]"
    )
    block = whole(pipeline)
    values = run_block(pipeline, block).values
    assert (values["detection"] == DetectionStatus.detected).all()
    # Unrefined corners are whole pixels just within the true ones: half a pixel, plus one for
    # an edge that rounding of the roll's sine moves across a pixel's centre.
    assert np.abs(values["corner_error_px"]).max() <= 1.5

    scenes = build_scenes(pipeline.experiment.scene_values(block.indices()), len(block))
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    left, top = 320 - side // 2, 240 - side // 2
    for row, marker_id in enumerate(scenes.marker_id):
        frame = render(scenes, row, marker_boxes(scenes)[row], (0, 0, 640, 480))
        square = frame[top : top + side, left : left + side]
        upright = np.rot90(square, row % 4)  # a positive roll turns clockwise in the image
        np.testing.assert_array_equal(
            upright, cv2.aruco.generateImageMarker(known, marker_id, side)
        )


@lengths(150, 2000)
def test_windows_hold_the_box_and_its_margin_and_stay_in_the_frame(count):
    sizes = st.integers(1, 5000)

    @settings(derandomize=True, deadline=None, max_examples=count)
    @given(st.tuples(sizes, sizes), st.lists(st.floats(0, 1), min_size=4, max_size=4),
           st.integers(0, 100))
    def check(size, shares, margin):
        frame = np.array(size)
        box = np.sort((np.reshape(shares, (2, 2)) * frame).astype(int), axis=0).ravel()
        box *= (box[:2] < box[2:]).all()  # else empty
        (window,) = windows(box[None], frame[None], np.array([[margin]]))
        start, stop = window[:2], window[2:]
        assert (start >= 0).all()
        assert (stop <= frame).all()
        assert (start <= np.maximum(box[:2] - margin, 0)).all()
        assert (stop >= np.minimum(box[2:] + margin, frame)).all()
        assert (start % ALIGNMENT_PX == 0).all()
        assert ((stop % ALIGNMENT_PX == 0) | (stop == frame)).all()
        assert (stop - start >= np.minimum(MIN_WINDOW_PX, frame)).all()
        # And no more than that: what is added is alignment, or reaches the smallest window.
        smallest = MIN_WINDOW_PX + ALIGNMENT_PX
        wanted = np.minimum(box[2:] + margin, frame) - np.maximum(box[:2] - margin, 0)
        assert (stop - start < np.maximum(wanted + 2 * ALIGNMENT_PX, smallest)).all()

    check()


# What a search found of a marker.

SQUARE = np.array([[100.0, 100.0], [140.0, 100.0], [140.0, 140.0], [100.0, 140.0]])


REJECTED_ID = None
ORIGIN = np.array([[8.0, 16.0]])
"""Top left pixel of the window; what is found is relative to it."""


def classified(*found, truth=SQUARE):
    """Classify what was found, (ID or none, corners in the frame) each, in a scene of ID 7."""
    def quads(wanted):
        return tuple(
            np.float32(quad - ORIGIN)[None] for each, quad in found if (each is not None) == wanted
        )

    ids = [found_id for found_id, _ in found if found_id is not None]
    output = SearchOutput(
        quads(True), np.array(ids, dtype=np.int32) if ids else None, quads(False))
    scene = TargetScenes(
        Targets.of([single_marker("DICT_4X4_50", 7, 1.0)]), np.array([[7]]), truth[None, None],
        np.empty((1, 0, 2)), np.zeros((1, 1), dtype=np.uint8),
    )
    result = classify(scene, {0: output}, ORIGIN)
    return DetectionStatus(result.flags[0]), result.marker_corners[0, 0]


ELSEWHERE = [SQUARE + shift for shift in ([21.0, 0.0], [0.0, -21.0], [300.0, 200.0])]


@pytest.mark.parametrize(("found", "expected"), [
    ([(7, SQUARE + 0.5)], DetectionStatus.detected),
    *(([(each, quad)], DetectionStatus.no_candidate)
      for each in (7, 3, REJECTED_ID) for quad in ELSEWHERE),
    *(([(7, np.roll(SQUARE, turn, axis=0))], DetectionStatus.wrong_id) for turn in (1, 2, 3)),
    *((found, DetectionStatus.wrong_id) for found in (
        [(3, SQUARE)], [(3, SQUARE), (REJECTED_ID, SQUARE)], [(REJECTED_ID, SQUARE), (3, SQUARE)])),
])
def test_what_is_found_is_judged_by_its_id_its_place_and_its_turn(found, expected):
    flag, corners = classified(*found)
    assert flag == expected
    right = found[0][1] if expected == DetectionStatus.detected else np.full((4, 2), np.nan)
    np.testing.assert_array_equal(corners, right)
