"""The pose of a rigid target from many points, with its covariance."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from sweep.measure.solver import GuardedPoints
from sweep.model.camera import Cameras
from sweep.model.lens import pack
from sweep.model.pose import rotation_of_vector
from sweep.photographs.board_view import FoundCorners
from sweep.typing import Floats, Masks

MAX_STEPS = 20

#: Step, in rad and in shares of the distance, below which the iteration ends.
CONVERGED = 1e-9

#: Residuals beyond this many robust standard deviations are left out.
OUTLIER = 4.0

MIN_OUTLIER_PX = 0.5

#: Corners of a board, without the marker's own, from which its pose is taken for known.
MIN_CORNERS = 6


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
    ) -> tuple[Floats, Floats, Floats]:
        """Return images (n, 2) with derivatives by the pose (2 n, 6) and by the camera (2 n, c).

        The pose changes by a rotation vector in the camera's frame, about the target's origin,
        and by a translation. The derivative by a point in the camera's frame is OpenCV's by the
        translation. The camera's numbers are fx, fy, cx, cy and the coefficients.
        """
        turned = points @ rotation.T
        image, jacobian = cv2.projectPoints(
            np.ascontiguousarray(turned + translation), np.zeros(3), np.zeros(3), self.matrix,
            self.distortion if len(self.distortion) else None,
        )
        slopes = np.asarray(jacobian, dtype=np.float64)
        by_point = slopes[:, 3:6].reshape(-1, 2, 3)
        by_turn = np.cross(turned[:, None, :], by_point)
        return (
            np.asarray(image, dtype=np.float64).reshape(-1, 2),
            np.concatenate([by_turn, by_point], axis=2).reshape(-1, 6),
            slopes[:, 6 : 10 + len(self.distortion)],
        )


def cameras_of(lens: Lens, count: int) -> Cameras:
    """Return ``count`` equal cameras as solvers take them."""
    matrix, packed = lens.matrix, pack(tuple(lens.distortion.tolist()))
    view = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
    return Cameras(
        np.repeat(view[None], count, axis=0), np.repeat(packed[None], count, axis=0),
        np.full(count, bool(packed[:14].any())),
    )


class FittedPose(NamedTuple):
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
    """Return rotation, translation and covariance; None if the steps diverge."""
    for _ in range(MAX_STEPS):
        image, design, _ = lens.derivatives(points, rotation, translation)
        residual = (pixels - image).ravel()
        if not (np.isfinite(design).all() and np.isfinite(residual).all()):
            return None
        step = np.asarray(np.linalg.lstsq(design, residual, rcond=None)[0], dtype=np.float64)
        rotation = rotation_of_vector(step[None, :3])[0] @ rotation
        translation = translation + step[3:]
        if not translation[2] > 0:
            return None
        shift = np.linalg.norm(step[3:]) / np.linalg.norm(translation)
        if np.linalg.norm(step[:3]) < CONVERGED and shift < CONVERGED:
            normal = design.T @ design
            if np.linalg.cond(normal) > 1e18:
                return None
            variance = float(residual @ residual) / max(len(residual) - 6, 1)
            return rotation, translation, np.asarray(variance * np.linalg.inv(normal), np.float64)
    return None


def fitted_board(lens: Lens, found: FoundCorners) -> FittedPose | None:
    """Return a board's pose; None with too few corners."""
    if len(found.points) < MIN_CORNERS:
        return None
    guard = GuardedPoints.of(found.points, found.pixels, cameras_of(lens, 1))
    fits = [
        fit_pose(lens, found.points, found.pixels, *start)
        for method in (cv2.SOLVEPNP_ITERATIVE, cv2.SOLVEPNP_IPPE) for start in guard.poses(method)
    ]
    good = [fit for fit in fits if fit is not None and fit.used.sum() >= MIN_CORNERS]
    return min(
        good, key=lambda fit: float(np.median((fit.residuals**2).sum(axis=1))), default=None
    )
