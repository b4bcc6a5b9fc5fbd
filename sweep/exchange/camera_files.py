"""Camera files for other programs: OpenCV's FileStorage and ROS's camera_info.

Both put pixel (0, 0) at the centre of the top left pixel and have OpenCV's lens model, as the
simulation does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.model.scene import Scenes

MODELS = {5: "plumb_bob", 8: "rational_polynomial"}
"""Coefficients -> ROS's name of the lens model; longer ones are rational polynomials, too."""


@dataclass(frozen=True, slots=True)
class FileCamera:
    """A camera as files have it: frame in pixels, fx, fy, cx, cy in px, and coefficients."""

    width_px: int
    height_px: int
    view: tuple[float, float, float, float]
    distortion: tuple[float, ...]

    @staticmethod
    def of(scenes: Scenes, row: int) -> FileCamera:
        """Return the camera of a scene, with 5, 8, 12 or 14 coefficients."""
        width, height = scenes.frame[row].tolist()
        fx, fy, cx, cy = scenes.cameras.view[row].tolist()
        coefficients = scenes.cameras.lenses[row, :14].tolist()
        used = int(np.max(np.flatnonzero(coefficients), initial=-1)) + 1
        count = next(length for length in (5, 8, 12, 14) if length >= used)
        return FileCamera(width, height, (fx, fy, cx, cy), tuple(coefficients[:count]))

    @property
    def matrix(self) -> list[float]:
        """The camera matrix, row by row."""
        fx, fy, cx, cy = self.view
        return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]

    def opencv_yaml(self) -> str:
        """Return the text of a file that ``cv::FileStorage`` reads."""
        return "\n".join([
            "%YAML:1.0", "---",
            f"image_width: {self.width_px}", f"image_height: {self.height_px}",
            *_opencv_matrix("camera_matrix", 3, self.matrix),
            *_opencv_matrix("distortion_coefficients", 1, self.distortion), "",
        ])

    def ros_yaml(self, name: str) -> str:
        """Return the text of a ``camera_info`` file as ROS's camera_calibration writes it."""
        fx, fy, cx, cy = self.view
        model = MODELS.get(len(self.distortion), "rational_polynomial")
        return "\n".join([
            f"image_width: {self.width_px}", f"image_height: {self.height_px}",
            f"camera_name: {name}",
            *_ros_matrix("camera_matrix", 3, self.matrix),
            f"distortion_model: {model}",
            *_ros_matrix("distortion_coefficients", 1, self.distortion),
            *_ros_matrix("rectification_matrix", 3, np.eye(3).ravel().tolist()),
            *_ros_matrix(
                "projection_matrix", 3,
                [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            ), "",
        ])


def _numbers(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _opencv_matrix(name: str, rows: int, values: Sequence[float]) -> list[str]:
    return [
        f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {len(values) // rows}",
        "   dt: d", f"   data: {_numbers(values)}",
    ]


def _ros_matrix(name: str, rows: int, values: Sequence[float]) -> list[str]:
    return [f"{name}:", f"  rows: {rows}", f"  cols: {len(values) // rows}",
            f"  data: {_numbers(values)}"]
