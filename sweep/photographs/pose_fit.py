"""The pose of a rigid target from many points, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.measure.flags import TruthSource
from sweep.model.pose import rotation_of_vector
from sweep.typing import Floats, Integers, Masks

# --------------------------------------------------------------------------------------------------
# The pose of a rigid target from many points: least squares, with its covariance.

MAX_STEPS = 20

#: Step, in rad and in shares of the distance, below which the iteration ends.
CONVERGED = 1e-9

#: Residuals beyond this many robust standard deviations are left out.
OUTLIER = 4.0

MIN_OUTLIER_PX = 0.5

#: Standard deviation over the median absolute value, of a normal variable of mean 0.
MAD_TO_STD = 1.4826


class Lens(NamedTuple):
    """A camera as OpenCV takes it: matrix (3, 3) and coefficients (0, 4, 5, 8, 12 or 14)."""

    matrix: Floats
    distortion: Floats

    @staticmethod
    def of(fx: float, fy: float, cx: float, cy: float, distortion: tuple[float, ...]) -> Lens:
        """Return a camera from its numbers."""
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return Lens(matrix, np.array(distortion, dtype=np.float64))

    def project(self, points: Floats, rotation: Floats, translation: Floats) -> Floats:
        """Return the images (n, 2) of points (n, 3) of a target."""
        return self.derivatives(points, rotation, translation)[0]

    def derivatives(
        self, points: Floats, rotation: Floats, translation: Floats
    ) -> tuple[Floats, Floats]:
        """Return images (n, 2) and their derivatives (n, 2, 6) by the pose.

        The pose changes by a rotation vector in the camera's frame, about the target's origin,
        and by a translation. The derivative by a point in the camera's frame is OpenCV's by the
        translation.
        """
        turned = points @ rotation.T
        image, jacobian = cv2.projectPoints(
            np.ascontiguousarray(turned + translation), np.zeros(3), np.zeros(3), self.matrix,
            self.distortion if len(self.distortion) else None,
        )
        by_point = np.asarray(jacobian, dtype=np.float64)[:, 3:6].reshape(-1, 2, 3)
        by_turn = np.cross(turned[:, None, :], by_point)
        images = np.asarray(image, dtype=np.float64).reshape(-1, 2)
        return images, np.concatenate([by_turn, by_point], axis=2)

    def camera_derivatives(
        self, points: Floats, rotation: Floats, translation: Floats
    ) -> Floats:
        """Return the derivatives (2 n, c) of images (n, 2) by fx, fy, cx, cy and coefficients."""
        _, jacobian = cv2.projectPoints(
            np.ascontiguousarray(points @ rotation.T + translation), np.zeros(3), np.zeros(3),
            self.matrix, self.distortion if len(self.distortion) else None,
        )
        return np.asarray(jacobian, dtype=np.float64)[:, 6 : 10 + len(self.distortion)]

    def by_camera(self, points: Floats, rotation: Floats, translation: Floats) -> Floats:
        """Return the change (6, c) of a fitted pose by the camera's numbers.

        The pose is the least-squares one from the images of points (n, 3): it gives way to an
        error of the camera as far as it can.
        """
        design = self.derivatives(points, rotation, translation)[1].reshape(-1, 6)
        numbers = self.camera_derivatives(points, rotation, translation)
        return -np.asarray(np.linalg.lstsq(design, numbers, rcond=None)[0], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class FittedPose:
    """A fitted pose.

    Attributes
    ----------
    rotation, translation
        (3, 3) and (3,) m, target to camera.
    covariance
        (6, 6) rotation vector in the camera's frame (rad), position (m): from the residuals'
        variance, as if they were independent.
    residuals
        (n, 2) px of all points.
    used
        (n,) which points are no outliers.
    """

    rotation: Floats
    translation: Floats
    covariance: Floats
    residuals: Floats
    used: Masks

    @property
    def rms_px(self) -> float:
        """Root mean square of the used residuals' lengths."""
        return float(np.sqrt((self.residuals[self.used] ** 2).sum(axis=1).mean()))


def fit_pose(
    lens: Lens, points: Floats, pixels: Floats, rotation: Floats, translation: Floats,
    used: Masks | None = None,
) -> FittedPose | None:
    """Return the pose of least squares from a start; None without 4 points, or if it diverges.

    Gauss-Newton steps in the camera's frame: a rotation vector, as OpenCV's functions have it, is
    singular at the half turn of a board that faces the camera. Without ``used`` outliers are left
    out: those beyond :data:`OUTLIER` robust standard deviations, in two rounds.

    Parameters
    ----------
    lens
        The camera.
    points, pixels
        (n, 3) m and (n, 2) px.
    rotation, translation
        The start.
    used
        (n,) the points to use.
    """
    chosen = np.ones(len(points), dtype=bool) if used is None else used
    for last in ((False, False, True) if used is None else (True,)):
        if chosen.sum() < 4:
            return None
        solved = _gauss_newton(lens, points[chosen], pixels[chosen], rotation, translation)
        if solved is None:
            return None
        rotation, translation, covariance = solved
        residuals = lens.project(points, rotation, translation) - pixels
        if not last:
            length = np.linalg.norm(residuals, axis=1)
            # The median length of a two-dimensional normal residual is 1.177 standard deviations.
            spread = float(np.median(length)) / 1.177
            chosen = length <= max(OUTLIER * spread, MIN_OUTLIER_PX)
    return FittedPose(rotation, translation, covariance, residuals, chosen)


def _gauss_newton(
    lens: Lens, points: Floats, pixels: Floats, rotation: Floats, translation: Floats
) -> tuple[Floats, Floats, Floats] | None:
    for _ in range(MAX_STEPS):
        image, derivatives = lens.derivatives(points, rotation, translation)
        residual = (pixels - image).ravel()
        design = derivatives.reshape(-1, 6)
        try:
            step = np.asarray(np.linalg.lstsq(design, residual, rcond=None)[0], dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        rotation = rotation_of_vector(step[None, :3])[0] @ rotation
        translation = translation + step[3:]
        if not translation[2] > 0:
            return None
        scale = float(np.linalg.norm(translation))
        if np.linalg.norm(step[:3]) < CONVERGED and np.linalg.norm(step[3:]) < CONVERGED * scale:
            break
    else:
        return None
    freedom = max(len(residual) - 6, 1)
    variance = float(residual @ residual) / freedom
    normal = design.T @ design
    if np.linalg.cond(normal) > 1e18:
        return None
    return rotation, translation, np.asarray(variance * np.linalg.inv(normal), np.float64)


# --------------------------------------------------------------------------------------------------
# Poses of markers in photographs, as they are gathered.

@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of M markers in P photographs: NaN where a marker is not there, or its pose unknown.

    Attributes
    ----------
    rotation, translation
        (P, M, 3, 3) and (P, M, 3) m, marker to camera.
    std
        (P, M, 6) standard deviations: rotation vector (rad) and position (m), camera frame.
    source
        (P, M) :class:`~sweep.measure.flags.TruthSource`.
    """

    rotation: Floats
    translation: Floats
    std: Floats
    source: NDArray[np.uint8]

    @staticmethod
    def none(photographs: int, markers: int) -> Poses:
        """Return no pose of any marker."""
        grid = (photographs, markers)
        return Poses(
            np.full((*grid, 3, 3), np.nan), np.full((*grid, 3), np.nan),
            np.full((*grid, 6), np.nan), np.zeros(grid, dtype=np.uint8),
        )

    def put(
        self, photograph: int, marker: int, rotation: Floats, translation: Floats, std: Floats,
        source: TruthSource,
    ) -> None:
        """Take a pose."""
        self.rotation[photograph, marker] = rotation
        self.translation[photograph, marker] = translation
        self.std[photograph, marker] = std
        self.source[photograph, marker] = source

    def take(self, markers: Integers) -> Poses:
        """Return the poses of some markers, by their indices."""
        return Poses(
            self.rotation[:, markers], self.translation[:, markers], self.std[:, markers],
            self.source[:, markers],
        )

    @property
    def known(self) -> Masks:
        """Which poses there are, (P, M)."""
        return np.asarray(np.isfinite(self.translation).all(axis=2))
