"""Other packages' detectors on boards, and locus-tag's own estimators of boards."""

import numpy as np
import pytest

from support.blocks import run_cells
from sweep.errors import PipelineError
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus
from tests.adapters.test_adapters import MODULES

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
