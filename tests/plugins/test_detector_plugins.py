"""A detector of a user's own file: searched, checked and recorded as OpenCV's is."""

from __future__ import annotations

import numpy as np
import pytest

from support.blocks import run_cells
from sweep.errors import PipelineError, PluginError
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.crash_isolation import use
from sweep.measure.flags import DetectionStatus

MINE = '''
from dataclasses import dataclass

import cv2
import numpy as np

from sweep.plugins import DetectorPlugin, parameter


@dataclass(frozen=True)
class Settings:
    shift_px: float = parameter(0.0, "shift of the corners", unit="px", low=-9, high=9)


class Turned:
    """OpenCV's own search, with other conventions."""

    def __init__(self, settings, family):
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
        self.search = cv2.aruco.ArucoDetector(dictionary).detectMarkers
        self.shift = settings.shift_px

    def __call__(self, image):
        corners, ids, _ = self.search(image)
        if ids is None:
            return [], []
        turned = np.concatenate(corners)[:, [2, 3, 0, 1]]
        return turned + 0.5 + self.shift, ids.ravel()


TURNED = DetectorPlugin(
    make=Turned, settings=Settings, pixel_center=0.5, corner_order=(2, 3, 0, 1), margin_px=16,
)
'''

GRID = """
[marker]
size_m = 0.05
[pose]
distance_m = 0.4
[axes]
tilt_deg = [0, 40]
detector = ["opencv", "mine:TURNED"]
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    return tmp_path


def test_a_detector_of_other_conventions_gives_opencv_s_corners(folder):
    text = GRID + "shift_px = [0, 0.25]\n"
    pipeline = Pipeline.from_text(text, folder=folder)
    assert pipeline.files.keys() == {"mine.py"}
    columns = run_cells(pipeline, [np.arange(2)]).columns
    # detector x shift_px: a setting that OpenCV does not have changes nothing there.
    opencv, same, plain, shifted = columns["corner_error_px"]
    np.testing.assert_array_equal(opencv, same)
    np.testing.assert_allclose(plain, opencv, rtol=0, atol=1e-5)  # OpenCV's corners are float32
    np.testing.assert_allclose(shifted, opencv + 0.25, rtol=0, atol=1e-5)
    assert (np.array(columns["detection"]) == DetectionStatus.detected).all()


def test_settings_are_checked_as_our_own(folder):
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_text(GRID + "shift_px = [0, 10]\n", folder=folder)
    assert str(refused.value) == (
        "pipeline: axes.shift_px = [0, 10]: expected a number from -9 to 9 (not 10)"
    )
    with pytest.raises(PipelineError, match=r"unknown key; did you mean shift_px\?"):
        Pipeline.from_text(GRID + "shift_pixels = [0, 10]\n", folder=folder)


def test_two_plug_ins_share_a_setting_only_if_it_is_declared_equally(folder):
    (folder / "other.py").write_text(MINE)
    both = GRID.replace('"mine:TURNED"]', '"mine:TURNED", "other:TURNED"]\nshift_px = [0, 1]')
    settings = Pipeline.from_text(both, folder=folder).experiment.detectors
    assert len(settings) == 6
    (folder / "other.py").write_text(MINE.replace("high=9", "high=8"))
    with pytest.raises(PipelineError) as refused:
        Pipeline.from_text(both, folder=folder)
    assert str(refused.value) == (
        'pipeline: axes.detector = "other:TURNED": expected its setting shift_px to be declared '
        "as that of another plug-in, or another name"
    )


def test_settings_that_the_plug_in_refuses_are_a_line(folder):
    (folder / "mine.py").write_text(MINE.replace(
        "high=9)\n", 'high=9)\n\n    def __post_init__(self):\n'
        '        if self.shift_px:\n            raise ValueError("no shift on Sundays")\n'))
    pipeline = Pipeline.from_text(GRID + "shift_px = [0, 1]\n", folder=folder)
    with pytest.raises(PluginError, match="mine:TURNED: raises ValueError: no shift on Sundays"):
        use(pipeline, "detector", "mine:TURNED")
