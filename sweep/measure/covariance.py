"""The covariance of a pose by a model of the corners' noise, and errors relative to it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.measure.positive_definite import pose_covariance, solve_positive
from sweep.model.camera import Cameras
from sweep.model.derivatives import POSE, velocity
from sweep.model.marker import marker_corners
from sweep.model.pose import transform_points
from sweep.model.projection import Optics
from sweep.typing import Floats


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
