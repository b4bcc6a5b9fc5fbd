"""Other versions of OpenCV give what a plain loop in their Python gives; windows are as frames."""

import subprocess

import numpy as np
import pytest

from sweep.environments.virtual_environments import add
from sweep.errors import EnvironmentFaultError
from sweep.evaluation.cells import run_cells
from sweep.evaluation.search import search, visibility_flags, whole_frames
from sweep.measure.flags import DetectionStatus
from sweep.model.scene import build_scenes
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import detector_settings, scene_values

TEXT = """
[pose]
side_px = {{ uniform = [12, 110] }}
tilt_deg = {{ uniform = [0, 70] }}
azimuth_deg = {{ uniform = [0, 360] }}
jitter_px = 0.5
[scene]
window = "{window}"
[detector]
environment = "{python}"
[axes]
trial = 150
cornerRefinementMethod = ["none", "subpix", "contour", "apriltag"]
"""

PLAIN = """
import sys
import cv2
import numpy as np
aruco = cv2.aruco
modern = hasattr(aruco, "ArucoDetector")
images = np.load(sys.argv[1])
corners = np.full((4, len(images), 4, 2), np.nan, np.float32)
for k, name in enumerate(("NONE", "SUBPIX", "CONTOUR", "APRILTAG")):
    parameters = aruco.DetectorParameters() if modern else aruco.DetectorParameters_create()
    parameters.cornerRefinementMethod = getattr(aruco, "CORNER_REFINE_" + name)
    dictionary = aruco.getPredefinedDictionary(aruco.DICT_5X5_50)
    for i, image in enumerate(images):
        if modern:
            quads, ids, _ = aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
        else:
            quads, ids, _ = aruco.detectMarkers(image, dictionary, parameters=parameters)
        if ids is not None:
            corners[k, i] = quads[ids.ravel().tolist().index(0)][0]
np.save(sys.argv[2], corners)
"""


@pytest.fixture(scope="module", params=["4.5.5.64", "4.8.1.78", "4.10.0.84", "4.14.0.94"])
def python(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        try:
            made = add("other", [f"opencv-contrib-python-headless=={request.param}"])
        except EnvironmentFaultError as fault:
            pytest.skip(str(fault))
    assert request.param.startswith(made.opencv)
    return made.python


@pytest.mark.long
def test_another_opencv_gives_what_a_plain_loop_there_gives(python, tmp_path):
    pipeline = Pipeline.from_text(TEXT.format(window="full", python=python))
    index = [np.arange(150)]
    values = scene_values(pipeline, index)
    scenes = build_scenes(values, 150)
    assert (visibility_flags(scenes) == DetectionStatus.not_run).all()
    settings = detector_settings(pipeline)
    found, _, _ = search(
        scenes, np.ones((150, 4), dtype=bool), settings, whole_frames(values, 150), [], keep=True)
    np.save(tmp_path / "images.npy", np.stack([found[0].images[k] for k in range(150)]))
    (tmp_path / "plain.py").write_text(PLAIN)
    subprocess.run(
        [python, tmp_path / "plain.py", tmp_path / "images.npy", tmp_path / "corners.npy"],
        check=True)
    plain = np.load(tmp_path / "corners.npy")
    for result, corners in zip(found, plain, strict=True):
        detected = result.flags == DetectionStatus.detected
        assert detected.mean() > 0.6
        np.testing.assert_array_equal(result.corners[detected], corners[detected])
        assert np.isnan(corners[~detected]).all()


@pytest.mark.long
def test_windows_give_another_opencv_the_flags_of_whole_frames(python):
    flags = []
    for window in ("auto", "full"):
        pipeline = Pipeline.from_text(TEXT.format(window=window, python=python))
        flags.append(np.array(run_cells(pipeline, [np.arange(150)]).columns["detection"]))
    detected = [each == DetectionStatus.detected for each in flags]
    assert (detected[0] == detected[1]).mean() > 0.995
