"""Every flag is reached by a real scene, and what does not exist is NaN with a flag that says why.

``failed`` and ``crashed`` are for exceptions and dead processes; the engine's tests reach them. The
regimes of the extremes are the files of pipelines/extremes; ``python -m tests.benchmarks extremes``
prints what every solver does there.
"""

import cv2
import numpy as np
import pytest

from benchmarks.bench_extremes import FILES, broken_promises, measured
from support.blocks import run_block, whole
from support.flags_and_numbers import contradiction
from support.lengths import lengths
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA
from sweep.measure.flags import DetectionStatus, EstimateStatus

PLAIN = {"seed": 9, "pose": {"side_px": 60}, "scene": {"background": 128}}


def run(pipeline):
    result = run_block(pipeline, whole(pipeline))
    assert not result.failures
    return result.values


def flags(*settings, folder="."):
    """Return the flags of detection over the whole grid, in its order."""
    return run(Pipeline.from_dict(PLAIN, settings, folder=folder))["detection"].ravel().tolist()


SCENES = {
    DetectionStatus.detected: [
        [], ["tilt_deg=60", "roll_deg=200"], ["bearing_x_deg=28"],  # cut in the quiet zone
        ["black=255", "white=0", "detectInvertedMarker=true"],
    ],
    DetectionStatus.no_candidate: [
        ["side_px=4"], ["black=128", "white=128"],
        ["bearing_x_deg=32.5"],  # only a corner is in the frame
    ],
    DetectionStatus.rejected: [
        ["side_px=10", "bearing_x_deg=1.03"],  # modules too small
        ["side_px=60", "markerBorderBits=3"],  # grey where the detector wants black
    ],
    DetectionStatus.wrong_id: [
        # Turned by half a turn, this marker of the original dictionary is itself.
        ["dictionary=DICT_ARUCO_ORIGINAL", "marker_id=1023", "roll_deg=180"],
    ],
    DetectionStatus.not_visible: [
        ["bearing_x_deg=40"], ["bearing_y_deg=-35"],
        ["bearing_x_deg=33", "bearing_y_deg=26.5", "roll_deg=45"],  # beyond the frame's corner
        ["tilt_deg=120"], ["tilt_deg=90.01"],  # from behind
        ["side_px=900", "tilt_deg=89", "bearing_y_deg=40"],  # a corner behind the camera
    ],
    DetectionStatus.not_modelled: [
        # x (1 - r²/2) turns back at r = 0.82, which is 39 degrees from the axis.
        ["distortion=[-0.5, 0, 0, 0]", "bearing_x_deg=45"],
        # Sideways: without its fold at -29 degrees it would be drawn in the frame.
        ["distortion=[0, 0, 0.3, 0]", "bearing_y_deg=-35"],
        # Within the marker.
        ["distortion=[-0.5, 0, 0, 0]", "bearing_x_deg=36", "side_px=120"],
    ],
}


@pytest.mark.parametrize(("expected", "settings"), [
    pytest.param(flag, settings, id=f"{flag.name} {settings}")
    for flag, scenes in SCENES.items() for settings in scenes
])
def test_flag_is_reached_by_a_real_scene(expected, settings):
    assert flags(*settings) == [expected]


def test_clutter_that_decodes_where_the_marker_is_counts_as_a_wrong_id(tmp_path):
    # ID 5's centre module is white, and so is the surround of the marker that lies on it.
    image = np.full((480, 640), 255, dtype=np.uint8)
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_50)
    image[135:345, 215:425] = cv2.aruco.generateImageMarker(known, 5, 210)
    cv2.imwrite(str(tmp_path / "clutter.png"), image)
    settings = "side_px=6", "marker_id=7"
    assert flags("background=clutter.png", *settings, folder=tmp_path) == [DetectionStatus.wrong_id]
    assert flags("background=255", *settings) == [DetectionStatus.rejected]


def test_numbers_exist_exactly_where_the_flags_say_so():
    pipeline = Pipeline.from_dict({
        "seed": 10, "pose": {"azimuth_deg": {"uniform": [0, 360]}}, "scene": {"background": 200},
        "estimator": {"reprojection_limit": 0.004},
        "axes": {
            "distortion": [[], [-0.5, 0, 0, 0]], "side_px": [8, 10, 12, 40],
            "tilt_deg": [0, 60, 100], "bearing_x_deg": [0, 29, 31, 36, 45], "trial": 3,
            "cornerRefinementMethod": ["none", "subpix", "apriltag"],
            "solver": ["ippe_square", "iterative", "sqpnp", "p3p", "epnp"],
            "guarded": [True, False],
        },
    })
    values = run(pipeline)
    assert {DetectionStatus(flag).name for flag in np.unique(values["detection"])} >= {
        "detected", "rejected", "no_candidate", "not_visible", "not_modelled"
    }
    assert {*np.unique(values["estimate"])} == {
        EstimateStatus.solved, EstimateStatus.no_detection, EstimateStatus.solver_failed
    }
    assert contradiction(pipeline, SCHEMA, values) == ""

# At the extremes nothing untold passes as detected or solved.

PATHS = {path.stem: path for path in FILES}
MAX_SCENES = 300
@lengths(8, MAX_SCENES)
@pytest.mark.parametrize("name", PATHS)
def test_all_that_is_detected_or_solved_is_finite_and_nothing_is_raised_or_printed(
    name, count, capfd
):
    assert broken_promises(measured(Pipeline.from_toml(PATHS[name]), count)) == []
    assert capfd.readouterr() == ("", "")
