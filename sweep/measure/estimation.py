"""What an estimator of poses receives, and what it gives back."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sweep.measure.flags import EstimateStatus
from sweep.model.camera import Cameras
from sweep.model.marker import MarkerKey
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class Detections:
    """N detected markers, with all that is believed of them.

    Attributes
    ----------
    corners
        (N, 4, 2) px in the frame, as found.
    cameras, size_m, noise_grey, blur_px
        N cameras and (N,) each: camera, black square's side, noise of a pixel in grey levels, and
        point spread, as the estimator believes them.
    markers
        Dictionary, ID and quiet zone of each.
    images, origins
        The windows in which they were found, and (N, 2) their first pixels in the frame; no images
        for estimators that do not ask for them.
    """

    corners: Floats
    cameras: Cameras
    size_m: Floats
    noise_grey: Floats
    blur_px: Floats
    markers: Sequence[MarkerKey]
    images: Sequence[NDArray[np.uint8]]
    origins: NDArray[np.int64]

    def take(self, rows: NDArray[np.intp]) -> Detections:
        """Return the sightings of the given rows."""
        return Detections(
            self.corners[rows], self.cameras.take(rows), self.size_m[rows], self.noise_grey[rows],
            self.blur_px[rows], [self.markers[row] for row in rows],
            [self.images[row] for row in rows] if len(self.images) else [], self.origins[rows],
        )


@dataclass(frozen=True, slots=True)
class Estimates:
    """N estimated poses; NaN where there is none, and where there is no alternative."""

    status: NDArray[np.uint8]
    rotation: Floats
    """(N, 3, 3)"""
    translation: Floats
    """(N, 3) in metres"""
    reprojection_px: Floats
    """(N,) RMS over the corners"""
    alternative_rotation: Floats
    """(N, 3, 3) of the other planar solution"""
    alternative_reprojection_px: Floats
    """(N,) RMS over the corners"""
    covariance: Floats
    """(N, 6, 6) of the errors that the estimator expects: turn about the camera's x, y and z in
    radians, position along them in metres"""
    residual_ratio: Floats
    """(N,) variance of the pixels' residuals over what noise and rounding make"""

    @staticmethod
    def none(count: int, status: EstimateStatus) -> Estimates:
        """Return ``count`` estimates that do not exist, all with one status."""
        shapes = ((3, 3), (3,), (), (3, 3), (), (6, 6), ())
        return Estimates(
            np.full(count, status, dtype=np.uint8),
            *(np.full((count, *shape), np.nan) for shape in shapes),
        )

    @staticmethod
    def joined(parts: Sequence[Estimates]) -> Estimates:
        """Return the estimates of several parts as one."""
        names = [field.name for field in dataclasses.fields(Estimates)]
        return Estimates(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in names)
        )


class PoseEstimator(Protocol):
    """Anything that makes poses of sightings: from corners, or from the pixels as well."""

    @property
    def needs_images(self) -> bool:
        """Whether sightings must carry their images."""
        ...

    def __call__(self, sightings: Detections) -> Estimates:
        """Return one estimate a sighting; where there is none, its status says why."""
        ...
