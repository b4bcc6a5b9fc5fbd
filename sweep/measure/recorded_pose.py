"""Poses that another program estimated, as an estimator."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from sweep.measure.estimation import Detections, Estimates
from sweep.measure.flags import EstimateStatus
from sweep.measure.solver import reprojection_errors_px


@dataclass(frozen=True, slots=True)
class RecordedPose:
    """Takes the poses that came with recorded detections; there are none for other detections.

    Attributes
    ----------
    reprojection_limit
        Largest RMS reprojection error of a pose, as a share of the mean side of the detected
        quadrilateral, as for solvers.
    """

    reprojection_limit: float

    @property
    def needs_images(self) -> bool:
        """Whether detections must carry their images: no."""
        return False

    def __call__(self, detections: Detections) -> Estimates:
        """Return the poses; solver_failed where there is none, or none in front of the camera."""
        corners = detections.corners
        none = Estimates.none(len(corners), EstimateStatus.solver_failed)
        rotation, translation = detections.recorded_rotation, detections.recorded_translation
        if rotation is None or translation is None:
            return none
        error = reprojection_errors_px(
            rotation, translation, detections.size_m, corners, detections.cameras
        )
        side = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).mean(axis=1)
        with np.errstate(invalid="ignore"):
            solved = error <= self.reprojection_limit * side
        return dataclasses.replace(
            none,
            status=np.where(solved, EstimateStatus.solved, EstimateStatus.solver_failed).astype(
                np.uint8
            ),
            rotation=np.where(solved[:, None, None], rotation, np.nan),
            translation=np.where(solved[:, None], translation, np.nan),
            reprojection_px=np.where(solved, error, np.nan),
        )
