"""The interface of pose estimators: detections in, estimates out."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sweep.measure.flags import EstimateStatus
from sweep.measure.surroundings import BoardMarker
from sweep.model.camera import Cameras
from sweep.model.marker import MarkerKey
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class Detections:
    """N detected markers, with the camera, size and noise that the estimator assumes.

    Attributes
    ----------
    corners
        (N, 4, 2) detected corners in px of the frame.
    cameras, size_m, noise_grey, blur_px
        N cameras and (N,) each: camera, black square's side, noise of a pixel in grey levels, and
        point spread, as the estimator assumes them.
    markers
        Dictionary, ID and quiet zone of each.
    images, origins
        The windows that were searched, and (N, 2) their first pixels in the frame; no images for
        estimators that do not need them.
    on_board
        The marker of a board that each is, None for one alone; None if all are alone.
    recorded_rotation, recorded_translation
        (N, 3, 3) and (N, 3) in metres: poses that came with recorded detections, NaN where none
        did; None where images were searched.
    """

    corners: Floats
    cameras: Cameras
    size_m: Floats
    noise_grey: Floats
    blur_px: Floats
    markers: Sequence[MarkerKey]
    images: Sequence[NDArray[np.uint8]]
    origins: NDArray[np.int64]
    recorded_rotation: Floats | None = None
    recorded_translation: Floats | None = None
    on_board: Sequence[BoardMarker | None] | None = None

    def take(self, rows: NDArray[np.intp]) -> Detections:
        """Return the detections of the given rows."""
        return Detections(
            self.corners[rows], self.cameras.take(rows), self.size_m[rows], self.noise_grey[rows],
            self.blur_px[rows], [self.markers[row] for row in rows],
            [self.images[row] for row in rows] if len(self.images) else [], self.origins[rows],
            None if self.recorded_rotation is None else self.recorded_rotation[rows],
            None if self.recorded_translation is None else self.recorded_translation[rows],
            None if self.on_board is None else [self.on_board[row] for row in rows],
        )


@dataclass(frozen=True, slots=True)
class Estimates:
    """N estimated poses.

    Numbers are NaN if there is no pose, and those of the alternative if there is no other planar
    solution.
    """

    status: NDArray[np.uint8]
    """(N,) :class:`sweep.measure.flags.EstimateStatus`"""
    rotation: Floats
    """(N, 3, 3)"""
    translation: Floats
    """(N, 3) in metres"""
    reprojection_px: Floats
    """(N,) RMS over the corners"""
    alternative_rotation: Floats
    """(N, 3, 3) of the other planar solution"""
    alternative_reprojection_px: Floats
    """(N,) RMS over the corners of the other planar solution"""
    covariance: Floats
    """(N, 6, 6) of the errors, as the estimator predicts it: turn about the camera's x, y and z in
    radians, position along them in metres"""
    residual_ratio: Floats
    """(N,) variance of the pixels' residuals relative to that of noise and rounding"""
    misfit_px: Floats
    """(N,) standard deviation in px of the shifts of a marker's parts that the residuals show"""
    point_count: Floats
    """(N,) points of a board that the pose was estimated from; NaN for single markers"""

    @staticmethod
    def none(count: int, status: EstimateStatus) -> Estimates:
        """Return ``count`` estimates without a pose, all with one status."""
        shapes = ((3, 3), (3,), (), (3, 3), (), (6, 6), (), (), ())
        return Estimates(
            np.full(count, status, dtype=np.uint8),
            *(np.full((count, *shape), np.nan) for shape in shapes),
        )

    @staticmethod
    def concatenate(parts: Sequence[Estimates]) -> Estimates:
        """Return the estimates of several parts as one."""
        names = [field.name for field in dataclasses.fields(Estimates)]
        return Estimates(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in names)
        )


class PoseEstimator(Protocol):
    """A function from detections to poses, by their corners or by their pixels as well."""

    @property
    def needs_images(self) -> bool:
        """Whether detections must carry their images."""
        ...

    def __call__(self, detections: Detections, /) -> Estimates:
        """Return one estimate for each detection; its status says why a pose is missing."""
        ...
