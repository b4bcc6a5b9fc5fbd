"""The interface of pose estimators, errors of poses, and covariances by the corners' noise."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.measure.flags import EstimateStatus
from sweep.measure.likelihood import pose_covariance, solve_positive
from sweep.measure.surroundings import BoardMarker
from sweep.model.camera import Cameras
from sweep.model.derivatives import POSE, velocity
from sweep.model.marker import MarkerKey, marker_corners
from sweep.model.polygon import Optics
from sweep.model.pose import angle_between, mirrored, transform_points, vector_of_rotation
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The interface of pose estimators: detections in, estimates out.

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


# --------------------------------------------------------------------------------------------------
# Errors of estimated poses.

@dataclass(frozen=True, slots=True)
class PoseError:
    """Errors of N poses, estimated against true, in the camera frame; NaN if not solved."""

    translation_m: Floats
    """(N, 3)"""
    rotation_rad: Floats
    """(N, 3) rotation vector of R_est · R_trueᵀ"""
    rotation_angle_rad: Floats
    """(N,) its length: the geodesic angle"""
    normal_angle_rad: Floats
    """(N,) angle between the true and the estimated normal"""
    flipped: NDArray[np.bool_]
    """(N,) nearer to the mirror of the truth than to the truth"""


def rotation_difference(rotation: Floats, other: Floats) -> Floats:
    """Return the rotation vectors (N, 3) of rotation · otherᵀ, both (N, 3, 3)."""
    return vector_of_rotation(rotation @ np.swapaxes(other, 1, 2))


def pose_error(
    rotation: Floats, translation: Floats, true_rotation: Floats, true_translation: Floats
) -> PoseError:
    """Compare estimated poses (N, 3, 3), (N, 3) with true ones of the same shapes."""
    difference = rotation_difference(rotation, true_rotation)
    angle = np.linalg.norm(difference, axis=1)
    mirror = mirrored(true_rotation, true_translation)
    to_mirror = np.linalg.norm(rotation_difference(rotation, mirror), axis=1)
    return PoseError(
        translation_m=translation - true_translation,
        rotation_rad=difference,
        rotation_angle_rad=angle,
        normal_angle_rad=angle_between(rotation[:, :, 2], true_rotation[:, :, 2]),
        flipped=to_mirror < angle,
    )


# --------------------------------------------------------------------------------------------------
# The covariance of a pose by a model of the corners' noise, and errors relative to it.

def corner_covariance(
    rotation: Floats, translation: Floats, cameras: Cameras, size_m: Floats, noise_px: float
) -> Floats:
    """Return the first-order covariance (N, 6, 6) of poses (N, 3, 3), (N, 3) from four corners.

    That of least squares, noise_px² (JᵀJ)⁻¹, for corners whose coordinates have independent errors
    of ``noise_px``; J (8, 6) are the corners' velocities in pixels by turn about the camera's
    axes (radians) and shift along them (metres). Hartley and Zisserman, "Multiple view geometry",
    2nd edition, section 5.2.1. NaN if the pose is NaN or J does not have full rank.
    """
    points = transform_points(marker_corners(size_m), rotation, translation)
    return _corner_covariance(
        points, np.ascontiguousarray(translation), cameras.view, cameras.lenses,
        cameras.distorted, float(noise_px),
    )


def point_covariance(
    rotation: Floats, translation: Floats, points: Floats, cameras: Cameras, noise_px: float
) -> Floats:
    """As :func:`corner_covariance`, (6, 6) of one pose (3, 3), (3,) from points (k, 3)."""
    moved = transform_points(points[None], rotation[None], translation[None])
    return np.asarray(_corner_covariance(
        moved, np.ascontiguousarray(translation[None]), cameras.view, cameras.lenses,
        cameras.distorted, float(noise_px),
    )[0])


@compiled
def _corner_covariance(
    points: Floats, translation: Floats, view: Floats, lenses: Floats,
    distorted: NDArray[np.bool_], noise_px: float,
) -> Floats:
    """As :func:`corner_covariance`, for points (N, k, 3) in the camera frame."""
    covariance = np.full((points.shape[0], POSE, POSE), np.nan)
    rates = np.empty((2, POSE))
    for n in range(points.shape[0]):
        distance = abs(translation[n, 2])
        information = np.zeros((POSE, POSE))
        for corner in range(points.shape[1]):
            x, y, z = points[n, corner, 0], points[n, corner, 1], points[n, corner, 2]
            velocity(x, y, z, translation[n], Optics(view[n], lenses[n], distorted[n]), rates)
            # Shifts as shares of the distance, so that all numbers are of one size.
            for axis in range(2):
                for i in range(POSE):
                    for j in range(POSE):
                        unit = (distance if i >= 3 else 1.0) * (distance if j >= 3 else 1.0)
                        information[i, j] += rates[axis, i] * rates[axis, j] * unit
        of_pose, exists = pose_covariance(information, noise_px**2, distance)
        if exists:
            for i in range(POSE):
                for j in range(POSE):
                    covariance[n, i, j] = of_pose[i, j]
    return covariance


def covariance_elsewhere(covariance: Floats, arm: Floats) -> Floats:
    """Return a covariance (6, 6) of a pose for another point of the same body.

    ``arm`` (3,) leads to it from the pose's origin, in the camera frame: a turn by a small ω moves
    it by ω x arm.
    """
    x, y, z = arm.tolist()
    moves = np.eye(POSE)
    moves[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return np.asarray(moves @ covariance @ moves.T)


def squared_deviations(
    rotation_error: Floats, translation_error: Floats, covariance: Floats
) -> Floats:
    """Return eᵀ C⁻¹ e (N,) of errors (N, 3) rad and (N, 3) m under covariances (N, 6, 6).

    The normalised estimation error squared: if the covariances are correct and the errors
    Gaussian, it is chi-square distributed with six degrees of freedom (Bar-Shalom, Li and
    Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.4.2).
    NaN if an input is NaN or a covariance is singular.
    """
    deviations = np.full(len(covariance), np.nan)
    known = np.flatnonzero(np.isfinite(covariance[:, 0, 0]))
    if len(known):
        error = np.concatenate([rotation_error[known], translation_error[known]], axis=1)
        deviations[known] = _squared_deviations(error, covariance[known])
    return deviations


@compiled
def _squared_deviations(error: Floats, covariance: Floats) -> Floats:
    """As :func:`squared_deviations`, for errors (N, 6)."""
    deviations = np.full(len(error), np.nan)
    solved = np.empty((POSE, 1))
    for n in range(len(error)):
        finite = True
        for i in range(POSE):
            solved[i, 0] = error[n, i]
            finite = finite and math.isfinite(error[n, i])
            for j in range(POSE):
                finite = finite and math.isfinite(covariance[n, i, j])
        if finite and solve_positive(covariance[n], solved):
            deviations[n] = 0.0
            for i in range(POSE):
                deviations[n] += error[n, i] * solved[i, 0]
    return deviations
