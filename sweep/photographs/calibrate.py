"""The camera from the photographs themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.errors import ArgumentError
from sweep.measure import intrinsics
from sweep.measure.flags import CalibrationStatus
from sweep.model.pose import rotation_of_vector
from sweep.photographs.corners import FoundCorners
from sweep.photographs.pose_fit import Lens
from sweep.typing import Floats

MIN_PHOTOGRAPHS = 4
"""Photographs with a board from which a camera is calibrated."""

MIN_CORNERS = 12
"""Corners of a board in a photograph that is used."""


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
    """Calibrate a camera with five coefficients (:func:`sweep.measure.intrinsics.calibrate`).

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
    made = intrinsics.calibrate(
        [each.points for each in used], [each.pixels for each in used], size
    )
    if made.status != CalibrationStatus.calibrated:
        raise ArgumentError(
            "camera", "calibrate",
            "OpenCV cannot calibrate from these photographs; take others, from different sides, or "
            "give the file of a calibration",
        )
    fx, fy, cx, cy, *distortion = made.values.tolist()
    lens = Lens.of(fx, fy, cx, cy, tuple(distortion))
    return CalibratedCamera(
        lens, tuple(made.std.tolist()), _covariance(lens, [used[i] for i in made.used], made),
        made.rms_px, made.views,
    )


def _covariance(lens: Lens, used: Sequence[FoundCorners], made: intrinsics.Intrinsics) -> Floats:
    """Return the covariance (9, 9) of the camera's numbers beside the photographs' poses.

    That of least squares with the residuals' variance: the inverse of the Schur complement of the
    poses in the normal equations, as of a bundle adjustment (Triggs et al., 2000, section 6.1).
    """
    numbers = len(intrinsics.INTRINSICS)
    information = np.zeros((numbers, numbers))
    squares, count = 0.0, 0
    rotations = rotation_of_vector(made.turns)
    for found, rotation, shift in zip(used, rotations, made.shifts, strict=True):
        at = (found.points * [1.0, -1.0, -1.0], rotation, shift)
        image, by_pose = lens.derivatives(*at)
        pose, camera = by_pose.reshape(-1, 6), lens.camera_derivatives(*at)
        cross = pose.T @ camera
        information += camera.T @ camera - cross.T @ np.linalg.solve(pose.T @ pose, cross)
        squares += float(((image - found.pixels) ** 2).sum())
        count += 2 * len(found.points) - 6
    scale = np.sqrt(np.diag(information))  # the numbers' units differ by many powers of ten
    scaled = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True)
    return np.asarray(squares / max(count - numbers, 1) * scaled / np.outer(scale, scale))
