"""Which cells of a small upright marker the detector misreads, and where markers are lost for it.

Against OpenCV: its warp of rendered squares, its detector, and sweeps that the model was not made
from. Draws are functions of the pipeline's seed: no test here is up to chance.
"""

import importlib
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

import sweep
from sweep.measure.detectors import DetectorSetting
from sweep.model.marker import modules

PIPELINES = Path(__file__).parents[2] / "pipelines"
sys.path.insert(0, str(PIPELINES / "open_question"))
try:
    model, dips, shapes, sweeps = (
        importlib.import_module(name)
        for name in ("bit_reading", "dips", "quadrilaterals", "sweeps")
    )
finally:
    sys.path.pop(0)

DICTIONARY = "DICT_5X5_50"
WITH_THE_DIP = {0, 2, 4, 7}
"""Of IDs 0-9 of DICT_5X5_50."""
UNIT = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)


def reading(dictionary=DICTIONARY, **settings):
    return model.reading_of(dictionary, 640, 480, DetectorSetting(**settings))


def warped(bits, corners, size=64, background=255):
    """Return an image of a marker with a quiet zone of one module: 10 px a module, warped."""
    n = len(bits)
    bitmap = np.kron(bits.astype(np.uint8) * 255, np.ones((10, 10), dtype=np.uint8))
    onto = cv2.getPerspectiveTransform(9.5 + 10 * n * UNIT, np.float32(corners))
    padded = np.pad(bitmap, 10, constant_values=255)
    return cv2.warpPerspective(
        padded, onto, (size, size), flags=cv2.INTER_LINEAR, borderValue=(background,))


def test_rule_and_model_name_the_ids_that_have_the_second_dip():
    bits = np.array([modules(DICTIONARY, marker_id) for marker_id in range(10)])
    most = reading().corrected_bits
    assert {i for i in range(10) if model.lone_cells(bits[i]) > most} == WITH_THE_DIP
    rates = np.array([
        model.predicted_rates(bits, shapes.upright_corners(side), reading())
        for side in np.arange(18.8, 21.4, 0.2)
    ])
    assert set(np.flatnonzero(rates.min(axis=0) < 0.97)) == WITH_THE_DIP
    assert model.lone_cells(modules("DICT_4X4_50", 0)) == 0


def test_worked_example_is_lost_at_4_samples_a_cell_and_found_at_8():
    bits = modules(DICTIONARY, 7)
    corners = np.array([[21.5, 21.25]]) + 20.0 * UNIT
    image = warped(bits, corners)
    # The first pixel inside is 22 in x and in y, the last is 41.
    quad = 22.0 + 19.0 * UNIT[None].astype(float)
    for samples, wrong, ids in ((4, [[2, 3], [3, 3], [5, 3]], []), (8, [], [7])):
        read = reading(perspectiveRemovePixelPerCell=samples)
        mixing = model.quadrilateral_mixing(quad, corners[None], 7, read)
        misread = model.wrong_cells(bits[None], mixing, read)[0, :, 0].reshape(7, 7)
        assert np.argwhere(misread).tolist() == wrong
        parameters = cv2.aruco.DetectorParameters()
        parameters.minMarkerPerimeterRate = 0.03 * 640 / 64
        parameters.perspectiveRemovePixelPerCell = samples
        detector = cv2.aruco.ArucoDetector(
            cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50), parameters)
        found = detector.detectMarkers(image)[1]
        assert ([] if found is None else found.ravel().tolist()) == ids


@pytest.mark.parametrize("samples", [4, 8])
@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", DICTIONARY, "DICT_7X7_50"])
def test_cells_read_what_opencv_reads_of_a_square_with_the_same_corners(dictionary, samples):
    rng = np.random.default_rng(11)
    read = reading(dictionary, perspectiveRemovePixelPerCell=samples,
                   perspectiveRemoveIgnoredMarginPerCell=0.0)
    for _ in range(60):
        bits = modules(dictionary, int(rng.integers(50)))
        n = len(bits)
        side, (left, top) = rng.uniform(1.2 * n, 5 * n), rng.uniform(10, 11, 2)
        # The image: a pixel is white where its centre lies in a white module or outside.
        at_y, at_x = (np.floor((np.arange(64) - edge) * n / side).astype(int)
                      for edge in (top, left))
        framed = np.pad(bits, 1, constant_values=True)
        image = framed[np.clip(at_y, -1, n)[:, None] + 1, np.clip(at_x, -1, n) + 1]
        first = np.ceil([left, top])
        last = np.ceil(np.array([left, top]) + side) - 1
        quad = (first + (last - first) * UNIT).astype(np.float32)
        expected = opencv_cells(image, quad, n, samples)
        (along_x, along_y), _ = model.cell_mixing(side, n, np.array([left, top]) - first, read)
        np.testing.assert_allclose(
            along_y @ bits @ along_x.T, expected,
            atol=1e-12, err_msg=f"side {side}, left {left}, top {top}")
        corners = np.array([left, top]) + side * UNIT.astype(float)
        mixing = model.quadrilateral_mixing(quad[None].astype(float), corners[None], n, read)[0]
        np.testing.assert_allclose(
            (mixing @ np.append(bits.ravel(), True)).reshape(n, n), expected, atol=1e-12)


def opencv_cells(image, quad, n, samples):
    """Return the share of white (n, n) in the cells of a quadrilateral, through OpenCV's warp."""
    size = n * samples
    onto = cv2.getPerspectiveTransform(np.float32(quad), np.float32(size - 1) * UNIT)
    canonical = cv2.warpPerspective(image.astype(np.uint8), onto, (size, size),
                                    flags=cv2.INTER_NEAREST)
    return canonical.reshape(n, samples, n, samples).mean(axis=(1, 3))


@pytest.mark.long
@pytest.mark.parametrize("number", [0, 7])
def test_dips_of_sweeps_held_back_are_where_and_as_deep_as_was_written_down(number, tmp_path):
    one = sweeps.HELD_BACK[number]
    truth = sweeps.measured(one, sweep.run(one.pipeline(), store=tmp_path / "held_back.zarr"))
    model = one.rates(sweeps.written_down()[one.title][:, None])
    off = np.abs(model.mean - truth.mean)
    assert off.max() <= 0.1
    for mine, its in dips.pairs(model, truth):
        if mine is None or its is None:
            # A dip near the least prominence may be one for the one and not for the other.
            assert (mine or its).prominence < 0.12
        else:
            assert abs(mine.area_px2 / its.area_px2 - 1) <= 0.1
            assert abs(mine.lowest - its.lowest) <= 0.1
