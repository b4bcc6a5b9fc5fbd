"""The interface of pose estimators, errors of poses, and covariances by the corners' noise."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.measure.flags import Ambiguous, EstimateStatus
from sweep.measure.surroundings import BoardMarker
from sweep.model.camera import Cameras
from sweep.model.coverage import POSE, velocity
from sweep.model.marker import marker_corners
from sweep.model.polygon import Optics, side_lengths
from sweep.model.pose import angle_between, mirrored, transform_points, vector_of_rotation
from sweep.model.scene import Targets
from sweep.typing import Floats, Grey, Integers, Masks

# --------------------------------------------------------------------------------------------------
# The interface of pose estimators: detections in, estimates out.

@dataclass(frozen=True, slots=True)
class Detections:
    """Detections of N targets, with the camera, size and noise that the estimator assumes.

    A marker is a target of one square: of markers alone K is N and all arrays have a row a marker.

    Attributes
    ----------
    corners
        (K, 4, 2) corners of the squares that were found, in px of the frame, target by target: TL,
        TR, BR, BL. Of a board all decoded markers with an ID that it has, false ones included, as
        OpenCV's ``Board.matchImagePoints`` takes them.
    cameras, size_m, noise_grey, blur_px
        N cameras and (N,) each: camera, black square's side (of a board, of markers without a side
        of their own), noise of a pixel in grey levels, and point spread, as the estimator assumes
        them.
    targets
        The N targets.
    images, origins
        The windows that were searched, and (N, 2) their first pixels in the frame; no images for
        estimators that do not need them.
    owner, square
        (K,) the target that each square was found of, ascending, and its number on the target.
    scale
        (N,) assumed size of the target relative to the true one.
    chessboard_px
        (N, C, 2) px of the inner corners of the targets' chessboards; NaN where none was found.
    beside
        Of each image which pixels show something beside the target; empty if none does.
    recorded_rotation, recorded_translation
        (N, 3, 3) and (N, 3) in metres: poses that came with recorded detections, NaN where none
        did; None where images were searched.
    on_board
        The marker of a board that each is, None for one alone; None if all are alone.
    """

    corners: Floats
    cameras: Cameras
    size_m: Floats
    noise_grey: Floats
    blur_px: Floats
    targets: Targets
    images: Sequence[Grey]
    origins: Integers
    owner: Integers
    square: Integers
    scale: Floats
    chessboard_px: Floats
    beside: Sequence[Masks] = ()
    recorded_rotation: Floats | None = None
    recorded_translation: Floats | None = None
    on_board: Sequence[BoardMarker | None] | None = None

    def __len__(self) -> int:
        return len(self.origins)

    @property
    def objects_m(self) -> Floats:
        """(K, 4, 3) the found squares' corners in their targets' frames, of the assumed size."""
        if self.targets.are_markers:
            return marker_corners(self.size_m)
        corners = [
            target.corners_m[self.square[self.owner == row]] * self.scale[row]
            for row, target in enumerate(self.targets)
        ]
        return np.concatenate([np.empty((0, 4, 3)), *corners])

    def mean_of_each(self, values: Floats) -> Floats:
        """Return the means (N,) over each target's squares of values (K,); NaN without one."""
        with np.errstate(invalid="ignore"):
            return np.asarray(
                np.bincount(self.owner, values, len(self))
                / np.bincount(self.owner, minlength=len(self))
            )

    def side_px(self) -> Floats:
        """Return the mean side (N,) of each target's squares in px; NaN without one."""
        return self.mean_of_each(side_lengths(self.corners).mean(axis=1))

    def reprojection_px(self, rotation: Floats, translation: Floats) -> Floats:
        """Return the RMS reprojection error (N,) of poses (N, 3, 3), (N, 3) over all corners.

        NaN for poses with a corner behind the camera, and without a square.
        """
        owner = self.owner
        pixels = self.cameras.take(owner).project(
            transform_points(self.objects_m, rotation[owner], translation[owner])
        )
        squared = ((pixels - self.corners) ** 2).sum(axis=2).mean(axis=1)
        return np.sqrt(self.mean_of_each(squared))

    def take(self, rows: NDArray[np.intp]) -> Detections:
        """Return copies of the detections of the given targets."""
        first = np.searchsorted(self.owner, rows)
        counts = np.searchsorted(self.owner, rows, side="right") - first
        squares = np.arange(counts.sum()) + np.repeat(first - np.cumsum(counts) + counts, counts)

        def of_rows(values: Any) -> Any:
            if values is None or isinstance(values, np.ndarray):
                return None if values is None else values[rows]
            return [values[row] for row in rows.tolist()] if len(values) else []

        return Detections(
            self.corners[squares], self.cameras.take(rows), self.size_m[rows],
            self.noise_grey[rows], self.blur_px[rows], self.targets.take(rows),
            of_rows(self.images), self.origins[rows], np.repeat(np.arange(len(rows)), counts),
            self.square[squares], self.scale[rows], self.chessboard_px[rows],
            of_rows(self.beside), of_rows(self.recorded_rotation),
            of_rows(self.recorded_translation), of_rows(self.on_board),
        )


@dataclass(frozen=True, slots=True)
class Estimates:
    """N estimated poses.

    Numbers are NaN if there is no pose, and those of the alternative if there is no other planar
    solution.

    Attributes
    ----------
    status
        (N,) :class:`sweep.measure.flags.EstimateStatus`.
    ambiguous
        (N,) :class:`sweep.measure.flags.Ambiguous`.
    rotation, translation
        (N, 3, 3), and (N, 3) in metres.
    reprojection_px
        (N,) RMS over the corners.
    alternative_rotation, alternative_reprojection_px
        (N, 3, 3) and (N,), the same of the other planar solution.
    covariance
        (N, 6, 6) of the errors, as the estimator predicts it: turn about the camera's x, y and z in
        radians, position along them in metres.
    residual_ratio
        (N,) variance of the pixels' residuals relative to that of noise and rounding.
    misfit_px
        (N,) standard deviation in px of the shifts of a marker's parts that the residuals show.
    point_count
        (N,) points of the target that the pose was estimated from.
    """

    status: NDArray[np.uint8]
    ambiguous: NDArray[np.uint8]
    rotation: Floats
    translation: Floats
    reprojection_px: Floats
    alternative_rotation: Floats
    alternative_reprojection_px: Floats
    covariance: Floats
    residual_ratio: Floats
    misfit_px: Floats
    point_count: Floats

    @staticmethod
    def none(count: int, status: EstimateStatus) -> Estimates:
        """Return ``count`` estimates without a pose, all with one status."""
        shapes = ((3, 3), (3,), (), (3, 3), (), (6, 6), (), (), ())
        return Estimates(
            np.full(count, status, dtype=np.uint8),
            np.full(count, Ambiguous.not_judged, dtype=np.uint8),
            *(np.full((count, *shape), np.nan) for shape in shapes),
        )

    @staticmethod
    def concatenate(parts: Sequence[Estimates]) -> Estimates:
        """Return the estimates of several parts as one."""
        if len(parts) == 1:
            return parts[0]
        names = [field.name for field in dataclasses.fields(Estimates)]
        return Estimates(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in names)
        )


#: From detections to poses, by their corners or by their pixels as well: one estimate for each
#: target, whose status says why a pose is missing.
PoseEstimator = Callable[[Detections], Estimates]


def credible_estimates(
    detections: Detections, rotation: Floats, translation: Floats, limit: float, *,
    alternative: tuple[Floats, Floats] | None = None, covariance: Floats | None = None,
    corner_noise_px: float | None = None,
) -> Estimates:
    """Return the estimates of N targets whose poses are credible; ``solver_failed`` without one.

    NaN, a corner behind the camera, and an RMS reprojection error above ``limit``, a share of the
    mean side of the detected squares, are no solution.

    Parameters
    ----------
    detections, rotation, translation
        N targets, and their poses (N, 3, 3) and (N, 3).
    alternative
        The other planar solutions, (N, 3, 3) and (N, 3).
    covariance, corner_noise_px
        (N, 6, 6), or the standard deviation of a corner's coordinates that gives them.
    """
    count = len(detections)
    out = Estimates.none(count, EstimateStatus.solver_failed)
    side_px = detections.side_px()
    with np.errstate(invalid="ignore", over="ignore"):
        reprojection = detections.reprojection_px(rotation, translation)
        solved = reprojection <= limit * side_px
        rows = np.flatnonzero(solved)
        out.status[rows], out.reprojection_px[rows] = EstimateStatus.solved, reprojection[rows]
        out.rotation[rows], out.translation[rows] = rotation[rows], translation[rows]
        out.point_count[rows] = 4.0 * np.bincount(detections.owner, minlength=count)[rows]
        if alternative is not None:
            reprojection = detections.reprojection_px(*alternative)
            rows = np.flatnonzero(solved & (reprojection <= limit * side_px))
            out.alternative_rotation[rows] = alternative[0][rows]
            out.alternative_reprojection_px[rows] = reprojection[rows]
    if covariance is None and corner_noise_px is not None:
        covariance = point_covariance(
            out.rotation, out.translation, detections.objects_m, detections.owner,
            detections.cameras, corner_noise_px,
        )
    if covariance is not None:
        out.covariance[solved] = covariance[solved]
    return out


# --------------------------------------------------------------------------------------------------
# Errors of estimated poses.

@dataclass(frozen=True, slots=True)
class PoseError:
    """Errors of N poses, estimated against true, in the camera frame; NaN if not solved.

    Attributes
    ----------
    translation_m, rotation_rad
        (N, 3), and (N, 3) rotation vector of R_est · R_trueᵀ.
    rotation_angle_rad, normal_angle_rad
        (N,) its length, the geodesic angle, and the angle between the true and estimated normals.
    flipped
        (N,) nearer to the mirror of the truth than to the truth.
    """

    translation_m: Floats
    rotation_rad: Floats
    rotation_angle_rad: Floats
    normal_angle_rad: Floats
    flipped: NDArray[np.bool_]


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
# Systems of equations with a positive definite matrix, and the covariance of a pose.

@compiled
def solve_positive(matrix: Floats, right: Floats) -> bool:
    """Solve matrix · x = right in place; return False if the matrix is not positive definite.

    Scaled to a unit diagonal, then by Cholesky's factors; a pivot must be above 1e-11.
    """
    n = matrix.shape[0]
    scale, factor = np.empty(n), np.empty((n, n))
    for i in range(n):
        if not (matrix[i, i] > 0.0 and matrix[i, i] < math.inf):
            return False
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 1e-11:
                factor[i, i] = math.sqrt(total)
            else:
                return False
    for column in range(right.shape[1]):
        for i in range(n):
            total = right[i, column] * scale[i]
            for k in range(i):
                total -= factor[i, k] * right[k, column]
            right[i, column] = total / factor[i, i]
        for i in range(n - 1, -1, -1):
            total = right[i, column]
            for k in range(i + 1, n):
                total -= factor[k, i] * right[k, column]
            right[i, column] = total / factor[i, i]
        for i in range(n):
            right[i, column] *= scale[i]
    return True


@compiled
def pose_covariance(information: Floats, variance: float, distance: float) -> tuple[Floats, bool]:
    """Return the covariance (6, 6) of the pose in radians and metres, and whether it exists."""
    free = information.shape[0]
    inverse = np.eye(free)
    exists = solve_positive(information, inverse)
    for i in range(POSE):
        for j in range(POSE):
            unit = (distance if i >= 3 else 1.0) * (distance if j >= 3 else 1.0)
            inverse[i, j] *= variance * unit
    return inverse[:POSE, :POSE].copy(), exists


def covariance_elsewhere(covariance: Floats, arm: Floats) -> Floats:
    """Return a covariance (6, 6) of a pose for another point of the same body.

    ``arm`` (3,) leads to it from the pose's origin, in the camera frame: a turn by a small ω moves
    it by ω x arm.
    """
    x, y, z = arm.tolist()
    moves = np.eye(POSE)
    moves[3:, :3] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return np.asarray(moves @ covariance @ moves.T)


# --------------------------------------------------------------------------------------------------
# The covariance of a pose by a model of the corners' noise, and errors relative to it.

def point_covariance(
    rotation: Floats, translation: Floats, points: Floats, owner: Integers, cameras: Cameras,
    noise_px: float,
) -> Floats:
    """Return the first-order covariance (N, 6, 6) of poses (N, 3, 3), (N, 3) from points.

    By least squares, noise_px² (JᵀJ)⁻¹, for points whose pixels have independent errors of
    ``noise_px`` in both coordinates; the two rows of J (., 6) for a point are its pixel's
    velocities by turn about the camera's axes (radians) and shift along them (metres). Hartley and
    Zisserman, "Multiple view geometry", 2nd edition, section 5.2.1. NaN if the pose is NaN or J
    does not have full rank.

    Parameters
    ----------
    rotation, translation, cameras
        N poses and cameras.
    points, owner
        (K, k, 3) in the frames of the poses ``owner`` (K,), ascending: corners of squares.
    noise_px
        Standard deviation of a coordinate.
    """
    return np.asarray(_point_covariance(
        transform_points(points, rotation[owner], translation[owner]), owner,
        np.ascontiguousarray(translation), cameras.view, cameras.lenses, cameras.distorted,
        float(noise_px),
    ))


@compiled
def _point_covariance(
    points: Floats, owner: Integers, translation: Floats, view: Floats, lenses: Floats,
    distorted: Masks, noise_px: float,
) -> Floats:
    """As :func:`point_covariance`, for points (K, k, 3) in the camera frame."""
    covariance = np.full((len(translation), POSE, POSE), np.nan)
    rates = np.empty((2, POSE))
    part = 0
    for n in range(len(translation)):
        distance = abs(translation[n, 2])
        information = np.zeros((POSE, POSE))
        while part < len(owner) and owner[part] == n:
            for k in range(points.shape[1]):
                x, y, z = points[part, k, 0], points[part, k, 1], points[part, k, 2]
                velocity(
                    x, y, z, translation[n], Optics(view[n], lenses[n], distorted[n]), rates
                )
                # Shifts as shares of the distance, so that all numbers are of one size.
                for axis in range(2):
                    for i in range(POSE):
                        for j in range(POSE):
                            unit = (distance if i >= 3 else 1.0) * (distance if j >= 3 else 1.0)
                            information[i, j] += rates[axis, i] * rates[axis, j] * unit
            part += 1
        of_pose, exists = pose_covariance(information, noise_px**2, distance)
        if exists:
            for i in range(POSE):
                for j in range(POSE):
                    covariance[n, i, j] = of_pose[i, j]
    return covariance


def squared_deviations(
    rotation_error: Floats, translation_error: Floats, covariance: Floats
) -> Floats:
    """Return eᵀ C⁻¹ e (N,) of errors (N, 3) rad and (N, 3) m under covariances (N, 6, 6).

    The normalised estimation error squared: if the covariances are correct and the errors
    Gaussian, it is chi-square distributed with six degrees of freedom (Bar-Shalom, Li and
    Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.4.2).
    NaN if an input is NaN or a covariance is singular.
    """
    error = np.concatenate([rotation_error, translation_error], axis=1)
    known = np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    deviations = np.full(len(error), np.nan)
    if known.any():  # most solvers give no covariance: nothing is compiled for them
        deviations[known] = _squared_deviations(error[known], covariance[known])
    return deviations


@compiled
def _squared_deviations(error: Floats, covariance: Floats) -> Floats:
    """As :func:`squared_deviations`, for finite errors (N, 6) and covariances."""
    deviations = np.full(len(error), np.nan)
    solved = np.empty((POSE, 1))
    for n in range(len(error)):
        solved[:, 0] = error[n]
        if solve_positive(covariance[n], solved):
            deviations[n] = 0.0
            for i in range(POSE):
                deviations[n] += error[n, i] * solved[i, 0]
    return deviations
