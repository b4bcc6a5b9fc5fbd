"""The adapters of other packages' detectors and solvers; tests skip where a package is missing."""

import importlib
import importlib.metadata
from unittest import mock

import cv2
import numpy as np
import pytest

import sweep
from support.blocks import run_cells
from support.here import Here
from sweep import Pipeline, PipelineError
from sweep.conformance.check import check_plugin
from sweep.evaluation.inspection import scene_image
from sweep.experiment.pipeline import cell
from sweep.isolation.child_process import Child
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plugins.loading import load

MODULES = {
    "pyapriltags": "pyapriltags", "pupil-apriltags": "pupil_apriltags",
    "robotpy-apriltag": "robotpy_apriltag", "locus-tag": "locus", "stag-python": "stag",
}

RUN = """
title = "Detectors on the same images"
seed = 4
[camera]
width_px = 320
height_px = 240
fx_px = 500.0
[marker]
dictionary = "DICT_APRILTAG_36h11"
size_m = 0.1
[pose]
side_px = 70
jitter_px = 0.5
roll_deg = 30
[scene]
noise_grey = 2
[detector]
quad_decimate = 1
[axes]
tilt_deg = [0, 35]
detector = ["opencv", "pyapriltags"]
trial = 4
"""


@pytest.fixture(params=MODULES)
def detector(request):
    pytest.importorskip(MODULES[request.param])
    return request.param


def test_an_adapter_conforms(detector):
    # Images of few pixels, which are tried too, leave pupil-apriltags' heap corrupted: the process
    # may die when it ends.
    child = Child if detector == "pupil-apriltags" else Here
    with mock.patch("sweep.conformance.check.Child", child):
        report = check_plugin(detector)
    assert report.conforms, report.findings
    assert max(map(abs, report.numbers["offset_px"])) < 0.02


@pytest.mark.evidence
def test_all_families_of_an_adapter_come_in_our_order(detector):
    for family in load("detector", detector, ".").families:
        if family in ("tagCircle49h12", "tagCustom48h12", "tagStandard52h13"):
            continue  # seconds and gigabytes each
        with mock.patch("sweep.conformance.check.Child", Here):
            report = check_plugin(detector, family)
        assert report.conforms, (family, report.findings)


def test_a_run_is_a_plain_loop_with_the_package(tmp_path):
    package = pytest.importorskip("pyapriltags")
    pipeline = Pipeline.from_text(RUN)
    results = sweep.run(pipeline, store=str(tmp_path / "run.zarr")).load()
    plain = package.Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)
    square = 0.05 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=float)
    camera = np.array([[500, 0, 159.5], [0, 500, 119.5], [0, 0, 1.0]])
    for tilt in (0, 35):
        for trial in range(4):
            single = cell(pipeline, f"tilt_deg={tilt},trial={trial},detector=pyapriltags")
            image = np.ascontiguousarray(scene_image(single, whole_frame=True))
            (tag,) = plain.detect(image)
            ours = results.sel(tilt_deg=tilt, trial=trial, detector="pyapriltags")
            truth, _ = cv2.projectPoints(
                square, ours.true_rvec.values, ours.true_tvec_m.values, camera, None
            )
            # AprilTag's corners are TR, TL, BL, BR of OpenCV's marker, pixel centres at 0.5.
            error = np.asarray(tag.corners)[[1, 0, 3, 2]] - 0.5 - truth[:, 0]
            assert np.abs(ours.corner_error_px.values - error).max() < 1e-6
            other = results.sel(tilt_deg=tilt, trial=trial, detector="opencv")
            assert np.abs(other.corner_error_px.values).max() < 2


def test_a_missing_package_is_told_with_its_command(monkeypatch):
    if not importlib.metadata.entry_points(group="sweep.detectors", name="locus-tag"):
        pytest.skip("installed before there were adapters")
    version = importlib.metadata.version

    def without(name):
        if name == "locus-tag":
            raise importlib.metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(importlib.metadata, "version", without)
    with pytest.raises(PipelineError, match=r"pip install 'fiducial-sweep\[locus-tag\]'"):
        Pipeline.from_text(
            RUN.replace('["opencv", "pyapriltags"]', '["locus-tag"]').replace(
                "quad_decimate = 1", ""
            )
        )


def test_settings_of_adapters_reach_their_packages():
    pytest.importorskip("pyapriltags")
    plugin = load("detector", "pyapriltags", ".")
    text = RUN.replace('detector = ["opencv", "pyapriltags"]', 'detector = ["pyapriltags"]')
    image = np.ascontiguousarray(scene_image(
        cell(Pipeline.from_text(text), "tilt_deg=35"), whole_frame=True))
    corners = {}
    for decimate in (1.0, 2.0):
        corners[decimate] = plugin.make(plugin.settings(quad_decimate=decimate), "tag36h11")(image)
        assert len(corners[decimate].ids) == 1
    assert not np.array_equal(corners[1.0].corners, corners[2.0].corners)
    strict = plugin.make(plugin.settings(min_decision_margin=250.0), "tag36h11")(image)
    assert len(strict.ids) == 0


BOARD = """
seed = 5
[camera]
width_px = 640
height_px = 480
fx_px = 700
[marker]
dictionary = "DICT_APRILTAG_36h11"
size_m = 0.05
quiet_zone_modules = 1
[board]
kind = "grid"
rows = 3
columns = 4
gap_m = 0.02
[pose]
distance_m = 0.5
tilt_deg = 30
azimuth_deg = { uniform = [0, 360] }
jitter_px = 20
[scene]
blur_px = 0.5
[estimator]
solver = "sqpnp"
[axes]
trial = 4
"""
CHARUCO = BOARD.replace(
    'kind = "grid"\nrows = 3\ncolumns = 4\ngap_m = 0.02\n',
    'kind = "charuco"\nsquares_x = 5\nsquares_y = 4\nsquare_m = 0.065\nlegacy_pattern = true\n',
)


@pytest.mark.parametrize("detector", [name for name in MODULES if name != "stag-python"])
def test_a_detectors_markers_make_the_boards_pose(detector):
    pytest.importorskip(MODULES[detector])
    pipeline = Pipeline.from_text(
        BOARD, [f"detector='{detector}'", "tilt_deg=20", "distance_m=0.4"]
        + (["min_cluster_pixels=5"] if detector == "robotpy-apriltag" else []),
    )
    results = run_cells(pipeline, [np.arange(4)]).columns
    flags = results["marker_detection"][0]
    assert (flags == DetectionStatus.detected).mean() > 0.9
    assert (results["estimate"][0] == EstimateStatus.solved).all()
    # A corner is off by less than 0.2 px at 1750 px/m: 0.1 mm over a board of 27 cm.
    assert results["rotation_error_deg"][0].max() < 0.3


@pytest.mark.parametrize(("text", "settings"), [
    (BOARD, []), (BOARD, ["detector='locus-tag'"]), (CHARUCO, []),
    (CHARUCO, ["locus_chessboard=false"]),
], ids=["grid", "grid, own detector", "charuco", "markers of a charuco"])
def test_locus_own_estimator_gives_the_boards_pose_and_covariance(text, settings):
    pytest.importorskip("locus")
    text = text.replace('"sqpnp"', '"locus-board"')
    results = run_cells(Pipeline.from_text(text, settings), [np.arange(4)]).columns
    assert (results["estimate"][0] == EstimateStatus.solved).all()
    assert results["rotation_error_deg"][0].max() < 0.3
    assert np.abs(results["translation_error_m"][0]).max() < 1e-3
    assert np.isfinite(results["nees"][0]).all()


@pytest.mark.parametrize(("change", "expected"), [
    (("legacy_pattern = true\n", ""), "legacy_pattern = true and an even number"),
    (("squares_y = 4", "squares_y = 3"), "legacy_pattern = true and an even number"),
    (("size_m = 0.05", "size_m = 0.05\nmarker_id = 3"), "expected marker_id 0"),
    (("fx_px = 700", "fx_px = 700\ndistortion = [-0.1, 0, 0, 0]"), "built without lenses"),
])
def test_boards_that_locus_lacks_are_failures_that_say_why(change, expected):
    pytest.importorskip("locus")
    pipeline = Pipeline.from_text(CHARUCO.replace('"sqpnp"', '"locus-board"').replace(*change))
    results = run_cells(pipeline, [np.arange(1)])
    assert (results.columns["estimate"][0] == EstimateStatus.failed).all()
    assert expected in results.failures[0].text


def test_settings_of_other_solvers_are_one_line_beside_locus():
    pytest.importorskip("locus")
    text = BOARD.replace('"sqpnp"', '"locus-board"')
    for broken, settings, expected in (
        (text, ["points='each_marker'"], "markers beside solver = locus-board, which chooses by"),
        (text, ["refine='lm'"], "none beside solver = locus-board, which chooses by itself"),
        (text.replace('kind = "grid"\nrows = 3\ncolumns = 4\ngap_m = 0.02\n', ""), [],
         "a solver of single markers, or a board: give kind under [board]"),
    ):
        with pytest.raises(PipelineError) as error:
            Pipeline.from_text(broken, settings)
        (line,) = str(error.value).splitlines()
        assert expected in line
