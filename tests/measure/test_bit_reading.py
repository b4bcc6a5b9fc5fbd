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


@pytest.mark.long
def test_dips_of_a_sweep_held_back_are_where_and_as_deep_as_was_written_down(tmp_path, claim):
    one = sweeps.HELD_BACK[4]
    truth = sweeps.measured(one, sweep.run(one.pipeline(), store=tmp_path / "held_back.zarr"))
    model = one.rates(sweeps.written_down()[one.title][:, None])
    off = np.abs(model.mean - truth.mean)
    claim("detection rates of small markers, from their bits",
          "sweeps of which the model knew nothing", off.max())
    assert off.max() <= 0.1
    for mine, its in dips.pairs(model, truth):
        if mine is None or its is None:
            # A dip near the least prominence may be one for the one and not for the other.
            assert (mine or its).prominence < 0.12
        else:
            assert abs(mine.area_px2 / its.area_px2 - 1) <= 0.1
            assert abs(mine.lowest - its.lowest) <= 0.1
