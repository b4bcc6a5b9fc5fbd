"""The detectors: OpenCV's and those of plug-ins, each made from its setting."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.declaration import parameter
from sweep.environments.interpreters import INSTALLED
from sweep.errors import PluginError
from sweep.measure import detector as opencv
from sweep.measure.board_detector import BoardDetector, BoardDetectorSetting
from sweep.measure.detector import (
    UNEVEN_LIGHT_CONSTANT,
    Detector,
    DetectorOutput,
    DetectorSetting,
    opencv_parameters,
)
from sweep.measure.foreign_detector import ForeignDetector, ForeignSetting
from sweep.measure.plugged_detector import PluggedDetector
from sweep.plugins import DetectorPlugin
from sweep.plugins.declared import PluginSetting
from sweep.plugins.recording import is_recording

OPENCV = "opencv"
"""The detector that is no plug-in, ``cv2.aruco.ArucoDetector``."""


@dataclass(frozen=True, slots=True)
class DetectorChoice:
    """Which detector searches the images."""

    detector: str = parameter(
        OPENCV, "opencv: cv2.aruco.ArucoDetector, which has the settings below; or a plug-in: the "
        "name of an installed one, or file:name beside the pipeline; or the .npz file of "
        "detections that `sweep score` recorded", choices=(OPENCV,),
        plugin="detector",
    )
    environment: str = parameter(
        INSTALLED, "the Python whose OpenCV searches: installed, the one that runs this; a name of "
        "`sweep environments list`; or the path of a Python or of a virtual environment",
    )


AnyDetectorSetting = DetectorSetting | PluginSetting | ForeignSetting
"""A setting of any detector."""

FindFunction = Callable[[NDArray[np.uint8], str, int], DetectorOutput]
"""A search of an image (h, w): a window of a frame whose larger side is the last argument, for
markers of a dictionary."""


def make_detector(setting: AnyDetectorSetting) -> FindFunction:
    """Return the search that a setting describes; those of plug-ins are kept by the process.

    Raises
    ------
    PluginError
        If a plug-in cannot be used.
    EnvironmentFaultError
        If an environment cannot be used.
    """
    if isinstance(setting, DetectorSetting):
        return Detector(setting).find
    if isinstance(setting, ForeignSetting):
        return ForeignDetector(setting)
    if is_recording(setting.plugin.name):
        return _find_nothing
    return _kept_plugin(setting).find


def make_board_detector(
    setting: AnyDetectorSetting, board_setting: BoardDetectorSetting
) -> BoardDetector:
    """Return what finds corners by means of a board, beside the detector of a setting."""
    of_opencv = setting if isinstance(setting, DetectorSetting) else DetectorSetting()
    return BoardDetector(board_setting, opencv_parameters(of_opencv))


def _find_nothing(
    image: NDArray[np.uint8], dictionary: str, frame_side: int  # noqa: ARG001
) -> DetectorOutput:
    """Return no marker: recorded detections are read, whatever the image."""
    return [], None, []


@lru_cache(maxsize=1024)
def _kept_plugin(setting: PluginSetting) -> PluggedDetector:
    record: DetectorPlugin = setting.record()
    return PluggedDetector(setting.plugin.name, record, setting.instance())


def _of_opencv(setting: AnyDetectorSetting) -> DetectorSetting | PluginSetting:
    """Return the setting of OpenCV's detector, in whichever environment; a plug-in's as it is."""
    return setting.setting if isinstance(setting, ForeignSetting) else setting


def full_frame_reason(setting: AnyDetectorSetting) -> str | None:
    """Return why a setting must search the whole frame; None if it can search a window."""
    setting = _of_opencv(setting)
    if isinstance(setting, DetectorSetting):
        return opencv.full_frame_reason(setting)
    if _margin_px(setting) is None:
        return f"{setting.plugin.name} declares no margin_px"
    return None


def margin_px(setting: AnyDetectorSetting) -> int:
    """Return the width of the border around the marker whose pixels can change the detection."""
    setting = _of_opencv(setting)
    if isinstance(setting, DetectorSetting):
        return opencv.margin_px(setting)
    return _margin_px(setting) or 0


def uneven_light_needs_frame(setting: AnyDetectorSetting, gain: Any) -> Any:
    """Return whether uneven light, amplified by ``gain`` (...; 0: even), needs whole frames."""
    setting = _of_opencv(setting)
    if isinstance(setting, DetectorSetting):
        return setting.adaptiveThreshConstant < UNEVEN_LIGHT_CONSTANT * gain
    return np.zeros(np.shape(gain), dtype=bool)


@lru_cache(maxsize=1024)
def _margin_px(setting: PluginSetting) -> int | None:
    margin = setting.record().margin_px
    if callable(margin):
        try:
            margin = margin(setting.instance())
        except Exception as error:
            raise PluginError(f"{setting.plugin.name}: margin_px raises {error!r}") from error
    if margin is None:
        return None
    if not isinstance(margin, int) or not 0 <= margin < 1 << 31:
        raise PluginError(
            f"{setting.plugin.name}: margin_px = {margin!r}: expected a whole number, at least 0"
        )
    return margin
