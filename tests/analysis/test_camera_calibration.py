"""Calibrations of a store's views against a plain OpenCV loop on the same images."""

import cv2
import numpy as np
import pytest

from support.stores import by_hand
from sweep.analysis import calibration_summary, camera_calibrations
from sweep.errors import ArgumentError, DatasetError
from sweep.evaluation.inspection import scene_image
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline, cell
from sweep.report.findings import calibration_findings
from sweep.store.lifecycle import open_dataset

PIPELINE = {
    "seed": 4,
    "camera": {"width_px": 320, "height_px": 240, "fx_px": 300, "fy_px": 300,
               "distortion": [-0.1, 0, 0, 0, 0]},
    "marker": {"dictionary": "DICT_4X4_50", "size_m": 0.04},
    "board": {"kind": "charuco", "squares_x": 5, "squares_y": 4, "square_m": 0.06},
    "pose": {"distance_m": {"uniform": [0.4, 0.6]}, "tilt_deg": {"uniform": [10, 45]},
             "azimuth_deg": {"uniform": [0, 360]}},
    "scene": {"noise_grey": 2, "background": 120, "black": 40, "white": 200},
    "detector": {"cornerRefinementMethod": "subpix"},
    "estimator": {"solver": "iterative"},
    "axes": {"trial": 12},
}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("calibration") / "views.zarr")
    close(by_hand(url, Pipeline.from_dict(PIPELINE)))
    return open_dataset(url)


def by_opencv(views):
    """The camera of whole frames, searched and calibrated by OpenCV alone."""
    pipeline = Pipeline.from_dict(PIPELINE)
    board = cv2.aruco.CharucoBoard(
        (5, 4), 0.06, 0.04, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    detection = cv2.aruco.DetectorParameters()
    detection.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.CharucoDetector(board)
    detector.setDetectorParameters(detection)
    objects, pixels = [], []
    for view in views:
        image = scene_image(cell(pipeline, f"trial={view}"), whole_frame=True)
        corners, ids, _, _ = detector.detectBoard(image)
        some, seen = board.matchImagePoints(corners, ids)
        objects.append(some)
        pixels.append(seen)
    rms, matrix, lens, *_ = cv2.calibrateCamera(
        objects, pixels, (320, 240), np.eye(3), np.zeros(5)
    )
    return rms, np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]), lens.ravel()


def test_a_set_of_views_gives_the_camera_of_a_plain_loop(results):
    found = camera_calibrations(results, [6])
    assert found.sizes["set"] == 2
    for number in range(2):
        rms, view, lens = by_opencv(range(6 * number, 6 * number + 6))
        one = found.isel(views=0, set=number)
        truth = [300.0, 300.0, 159.5, 119.5, -0.1, 0, 0, 0, 0]
        estimated = one["intrinsic_error"].values + truth
        np.testing.assert_allclose(estimated[:4], view, atol=0.02)
        np.testing.assert_allclose(estimated[4:6], lens[:2], rtol=0.05, atol=2e-3)
        assert one["rms_px"].item() == pytest.approx(rms, rel=1e-3)


@pytest.mark.parametrize("target_m", [0.5, 2.0])
def test_errors_of_positions_are_those_that_solve_pnp_makes_with_the_camera(target_m, results):
    one = camera_calibrations(
        results, [12], coefficients=1, target_m=target_m).isel(views=0, set=0)
    truth = np.array([300.0, 300.0, 159.5, 119.5, -0.1, 0, 0, 0, 0])
    line = np.linspace(-0.1, 0.1, 5)
    target = np.array([[x, y, 0.0] for y in line for x in line])
    turn = np.array([np.pi, 0.0, 0.0])
    for k, bearing in enumerate(([0.0, 0.0], [0.8 * 159.5 / 300, 0.8 * 119.5 / 300])):
        position = target_m * np.array([*bearing, 1.0])
        cameras = [(np.array([[each[0], 0, each[2]], [0, each[1], each[3]], [0, 0, 1]]), each[4:])
                   for each in (truth, truth + one["intrinsic_error"].values)]
        pixels, _ = cv2.projectPoints(target, turn, position, *cameras[0])
        _, _, found = cv2.solvePnP(target, pixels, *cameras[1], flags=cv2.SOLVEPNP_IPPE)
        np.testing.assert_allclose(
            one["position_error_m"].values[k], found.ravel() - position, rtol=1e-6, atol=2e-7)


def test_half_a_pixel_moves_the_principal_point_and_nothing_else(results):
    right = camera_calibrations(results, [6])
    shifted = camera_calibrations(results, [6], offset_px=0.5)
    moved = (shifted - right)["intrinsic_error"].isel(views=0)
    np.testing.assert_allclose(moved.sel(intrinsic=["cx_px", "cy_px"]), 0.5, atol=0.01)
    np.testing.assert_allclose(moved.sel(intrinsic=["fx_px", "fy_px"]), 0.0, atol=0.01)
    np.testing.assert_allclose(shifted["rms_px"], right["rms_px"], rtol=1e-3)


def test_the_summary_is_that_of_numpy(results):
    found = camera_calibrations(results, [4], coefficients=1)
    summary = calibration_summary(found)
    error, std = (found[name].values[0] for name in ("intrinsic_error", "intrinsic_std"))
    np.testing.assert_allclose(summary["bias"].values[0], error.mean(axis=0))
    np.testing.assert_allclose(summary["rmse"].values[0], np.sqrt((error**2).mean(axis=0)))
    held = (np.abs(error) <= 1.96 * std).mean(axis=0)
    np.testing.assert_allclose(summary["coverage"].values[0][:5], held[:5])
    assert np.isnan(summary["coverage"].values[0][5:]).all()  # they are not estimated
    rows = calibration_findings(summary, "a.zarr").numbers["rows"]
    told = [row["bias"]["value"] for row in rows]
    np.testing.assert_allclose(told, error.mean(axis=0)[:len(rows)])


@pytest.mark.parametrize(("arguments", "fault"), [
    ({"views": [2]}, "at least 3"),
    ({"views": [6], "coefficients": 3}, "one of 0, 1, 2, 4, 5"),
    ({"views": [6], "target_m": 0.0}, "above 0 m"),
    ({"views": [6], "points": "corners"}, "chessboard, markers"),
    ({"views": [10, 40]}, "12 trials: expected at least 40"),
])
def test_arguments_that_cannot_be_are_refused(arguments, fault, results):
    with pytest.raises((ArgumentError, DatasetError), match=fault):
        camera_calibrations(results, **arguments)
