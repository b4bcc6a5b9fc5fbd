"""The camera from the photographs themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sweep.errors import ArgumentError
from sweep.model.pose import rotation_of_vector
from sweep.photographs.corners import FoundCorners
from sweep.photographs.pose_fit import Lens
from sweep.typing import Floats

MIN_PHOTOGRAPHS = 4
"""Photographs with a board from which a camera is calibrated."""

MIN_CORNERS = 12
"""Corners of a board in a photograph that is used."""

COUNT = 9
"""Numbers that are estimated: fx, fy, cx, cy, k1, k2, p1, p2, k3."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera:
    """A camera that was calibrated.

    Attributes
    ----------
    lens
        Its numbers.
    sd
        Standard deviations of fx, fy, cx, cy (px) and of the five coefficients.
    covariance
        Their covariance (9, 9).
    rms_px
        Root mean square of the residuals' lengths.
    photographs
        How many were used.
    """

    lens: Lens
    sd: tuple[float, ...]
    covariance: Floats
    rms_px: float
    photographs: int


def calibrate(size: tuple[int, int], found: Sequence[FoundCorners]) -> CalibratedCamera:
    """Calibrate a camera with five lens coefficients (``cv2.calibrateCameraExtended``).

    Parameters
    ----------
    size
        Width and height in pixels.
    found
        The board's corners in each photograph.

    Raises
    ------
    ArgumentError
        If too few photographs show enough of the board.
    """
    used = [each for each in found if len(each.points) >= MIN_CORNERS]
    if len(used) < MIN_PHOTOGRAPHS:
        raise ArgumentError(
            "camera", "calibrate",
            f"expected {MIN_PHOTOGRAPHS} photographs with at least {MIN_CORNERS} corners of the "
            f"board, from different sides; there are {len(used)}; take more, or give the file of a "
            "calibration",
        )
    try:
        rms, matrix, distortion, turns, shifts, deviations, *_ = cv2.calibrateCameraExtended(
            [(each.points * [1.0, -1.0, -1.0]).astype(np.float32) for each in used],
            [each.pixels.astype(np.float32) for each in used], size, np.eye(3), np.zeros(5),
        )
    except cv2.error as error:
        raise ArgumentError(
            "camera", "calibrate", f"OpenCV cannot calibrate from these photographs: {error.err}"
        ) from None
    lens = Lens(
        np.asarray(matrix, dtype=np.float64), np.asarray(distortion, dtype=np.float64).ravel()[:5]
    )
    covariance = _covariance(lens, used, turns, shifts)
    return CalibratedCamera(
        lens, tuple(np.asarray(deviations).ravel()[:COUNT].tolist()), covariance, float(rms),
        len(used),
    )


def _covariance(
    lens: Lens, used: Sequence[FoundCorners], turns: Sequence[Any], shifts: Sequence[Any]
) -> Floats:
    """Return the covariance (9, 9) of the camera's numbers beside the photographs' poses.

    That of least squares with the residuals' variance: the inverse of the Schur complement of the
    poses in the normal equations, as of a bundle adjustment (Triggs et al., 2000, section 6.1).
    """
    information = np.zeros((COUNT, COUNT))
    squares, count = 0.0, 0
    for found, turn, shift in zip(used, turns, shifts, strict=True):
        at = (
            found.points * [1.0, -1.0, -1.0],
            rotation_of_vector(np.asarray(turn, dtype=np.float64).reshape(1, 3))[0],
            np.asarray(shift, dtype=np.float64).ravel(),
        )
        image, by_pose = lens.derivatives(*at)
        pose, camera = by_pose.reshape(-1, 6), lens.camera_derivatives(*at)
        cross = pose.T @ camera
        information += camera.T @ camera - cross.T @ np.linalg.solve(pose.T @ pose, cross)
        squares += float(((image - found.pixels) ** 2).sum())
        count += 2 * len(found.points) - 6
    scale = np.sqrt(np.diag(information))  # the numbers' units differ by many powers of ten
    scaled = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)
    return np.asarray(squares / max(count - COUNT, 1) * scaled / np.outer(scale, scale))
