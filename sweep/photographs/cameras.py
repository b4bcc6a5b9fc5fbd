"""Cameras of photographs from files: one camera, or two with the pose of one to the other."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from sweep.errors import ArgumentError
from sweep.messages import plain
from sweep.model.calibration import Calibration, calibration_of
from sweep.model.image_file import read_regular
from sweep.model.structured_text import MAX_BYTES, read_tree
from sweep.photographs.pose_fit import Lens
from sweep.photographs.record_files import KnownCamera
from sweep.photographs.reference_pose import StereoCamera
from sweep.plan.camera_files import file_and_camera
from sweep.typing import Floats

ORTHOGONAL = 1e-3
"""Largest deviation of RᵀR from the identity; files have few digits."""


def camera_of_file(written: str, size: tuple[int, int]) -> Calibration:
    """Return the camera of ``FILE`` or ``FILE#NAME`` for photographs of a size in pixels.

    Raises
    ------
    ArgumentError
        If there is none, or it is of another frame size.
    """
    path, name = file_and_camera(written, lambda each: Path(each).is_file())
    calibration = _camera("camera", written, _tree("camera", path), name)
    _check_size("camera", written, calibration, size)
    return calibration


def stereo_of_file(written: str, size: tuple[int, int]) -> tuple[StereoCamera, list[Calibration]]:
    """Return the two cameras of a file with K1, D1, K2, D2, R and T, as OpenCV names them.

    Raises
    ------
    ArgumentError
        If it is no such file, or of another frame size.
    """
    tree = _tree("stereo", written)
    cameras = [_camera("stereo", written, tree, name) for name in ("1", "2")]
    for each in cameras:
        _check_size("stereo", written, each, size)
    rotation, translation = (_numbers(written, tree, *each) for each in (("R", 9), ("T", 3)))
    rotation = rotation.reshape(3, 3)
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if not error < ORTHOGONAL or np.linalg.det(rotation) < 0:
        raise ArgumentError("stereo", plain(written), "R: expected a rotation matrix")
    u, _, vt = np.linalg.svd(rotation)
    return StereoCamera(lens_of(cameras[0]), lens_of(cameras[1]), u @ vt, translation), cameras


def lens_of(calibration: Calibration) -> Lens:
    """Return the camera of a calibration."""
    return Lens.of(
        calibration.fx_px, calibration.fy_px, calibration.cx_px, calibration.cy_px,
        calibration.distortion,
    )


def known_camera(calibration: Calibration) -> KnownCamera:
    """Return the camera of a calibration, with the errors of its numbers as far as it has them."""
    covariance = None
    if calibration.covariance:
        count = math.isqrt(len(calibration.covariance))
        covariance = np.reshape(np.array(calibration.covariance), (count, count))
    return KnownCamera(lens_of(calibration), calibration.sd, covariance=covariance)


def _tree(argument: str, path: str) -> Any:
    try:
        return read_tree(read_regular(path, MAX_BYTES))
    except OSError as error:
        raise ArgumentError(
            argument, plain(path), f"expected a camera file ({error.strerror or 'unreadable'})"
        ) from None
    except ValueError as error:
        raise ArgumentError(argument, plain(path), f"expected a camera file ({error})") from None


def _camera(argument: str, written: str, tree: Any, name: str) -> Calibration:
    try:
        return calibration_of(tree, name)
    except ValueError as error:
        expected = "expected a camera file" if argument == "camera" else (
            "expected a file with K1, D1, K2, D2, R and T of two cameras"
        )
        raise ArgumentError(argument, plain(written), f"{expected} ({error})") from None


def _check_size(
    argument: str, written: str, calibration: Calibration, size: tuple[int, int]
) -> None:
    own = calibration.width_px, calibration.height_px
    if None not in own and own != size:
        turned = "; they are turned, perhaps by their EXIF tags" if own == size[::-1] else ""
        raise ArgumentError(
            argument, plain(written),
            f"it holds for {own[0]} x {own[1]}, but the photographs are {size[0]} x {size[1]}"
            f"{turned}; give the calibration of their size",
        )
    cx, cy = calibration.cx_px, calibration.cy_px
    if not (0 < cx < size[0] and 0 < cy < size[1]):
        raise ArgumentError(
            argument, plain(written),
            f"its principal point ({cx:g}, {cy:g}) is outside the photographs of {size[0]} x "
            f"{size[1]}; give the calibration of their size",
        )


def _numbers(written: str, tree: Any, name: str, count: int) -> Floats:
    """Return the numbers of a matrix in a file."""
    value = next((each for key, each in tree.items() if str(key).lower() == name.lower()), None)
    if isinstance(value, dict):
        value = value.get("data")
    try:
        numbers = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ArgumentError(
            "stereo", plain(written),
            f"{name}: expected {count} numbers: "
            + ("the rotation" if count == 9 else "the translation, in metres,")
            + " that takes points of the left camera's frame to the right one's",
        )
    return numbers
