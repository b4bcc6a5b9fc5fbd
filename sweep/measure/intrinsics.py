"""A camera's calibration from views of a board, as an estimate whose errors are measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sweep.measure.flags import CalibrationStatus
from sweep.model import calibration
from sweep.typing import Floats

COEFFICIENTS = calibration.COEFFICIENTS[:5]
#: The numbers of a camera that are estimated, in the order of arrays.
INTRINSICS = (*calibration.VIEW, *COEFFICIENTS)

#: Lens coefficients that are estimated, of :data:`COEFFICIENTS` the first -> OpenCV's flags.
FREE_COEFFICIENTS: dict[int, int] = {
    0: cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
    1: cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
    2: cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3,
    4: cv2.CALIB_FIX_K3,
    5: 0,
}

#: Points in a view that is used.
MIN_POINTS = 6

#: Views with which a calibration is tried.
MIN_VIEWS = 3

#: Ratio of the extents of a view's points below which they lie on a line.
_FLAT = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Intrinsics:
    """A calibration.

    Attributes
    ----------
    status
        Whether there is one.
    values, std
        (9,) the numbers of :data:`INTRINSICS`, and their standard deviations as OpenCV reports
        them; those of coefficients that are not estimated are 0.
    rms_px
        OpenCV's root mean square of the residuals' lengths.
    used
        The numbers of the views that were used.
    turns, shifts
        (len(used), 3) the board's pose in each: rotation vectors and translations in metres, of
        points whose y and z have the opposite sign.
    """

    status: CalibrationStatus
    values: Floats
    std: Floats
    rms_px: float
    used: tuple[int, ...]
    turns: Floats
    shifts: Floats

    @property
    def views(self) -> int:
        """How many views were used."""
        return len(self.used)

    @staticmethod
    def none(status: CalibrationStatus, used: Sequence[int]) -> Intrinsics:
        """Return that there is no calibration from the views ``used``."""
        missing = np.full(len(INTRINSICS), np.nan)
        poses = np.full((len(used), 3), np.nan)
        return Intrinsics(status, missing, missing, np.nan, tuple(used), poses, poses)


def calibrate(
    objects: Sequence[Floats], pixels: Sequence[Floats], frame: tuple[int, int],
    coefficients: int = 5,
) -> Intrinsics:
    """Calibrate a camera by ``cv2.calibrateCameraExtended``, as users do.

    Parameters
    ----------
    objects, pixels
        Of each view: points (k, 3) of a flat board in metres, x right and y up, and their pixels
        (k, 2). Views with fewer than :data:`MIN_POINTS`, or with points on a line, are left out.
    frame
        Width and height in pixels.
    coefficients
        A key of :data:`FREE_COEFFICIENTS`.
    """
    used = [i for i, points in enumerate(objects) if _spans_a_plane(points)]
    if len(used) < MIN_VIEWS:
        return Intrinsics.none(CalibrationStatus.too_few_views, used)
    try:
        rms, matrix, lens, turns, shifts, deviations, *_ = cv2.calibrateCameraExtended(
            [(objects[i] * [1.0, -1.0, -1.0]).astype(np.float32) for i in used],
            [pixels[i].astype(np.float32) for i in used], frame, np.eye(3), np.zeros(5),
            flags=FREE_COEFFICIENTS[coefficients],
        )
    except cv2.error:
        return Intrinsics.none(CalibrationStatus.failed, used)
    values = np.array([
        matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *np.ravel(lens)[:5],
    ], dtype=np.float64)
    std = np.ravel(deviations)[: len(INTRINSICS)].astype(np.float64)
    if not (np.isfinite(values).all() and np.isfinite(std).all() and (values[:2] > 0).all()):
        return Intrinsics.none(CalibrationStatus.failed, used)
    return Intrinsics(
        CalibrationStatus.calibrated, values, std, float(rms), tuple(used),
        *(np.array(each, dtype=np.float64).reshape(-1, 3) for each in (turns, shifts)),
    )


def _spans_a_plane(points: Floats) -> bool:
    if len(points) < MIN_POINTS:
        return False
    extents = np.linalg.svd((points - points.mean(axis=0))[:, :2], compute_uv=False)
    return bool(extents[1] > _FLAT * extents[0])
