"""Pose from four corners: OpenCV's solvers, guarded or as plain calls."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.measure.estimation import Detections, Estimates, corner_covariance
from sweep.measure.flags import EstimateStatus
from sweep.model.camera import Cameras
from sweep.model.marker import marker_corners
from sweep.model.polygon import side_lengths
from sweep.model.pose import rotation_of_vector, transform_points, vector_of_rotation
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class OpenCVSolver:
    """One method of ``cv2.solvePnP``.

    Attributes
    ----------
    method
        OpenCV's constant.
    meaning
        One line for the reference.
    guarded
        Whether the guard can call it: it is stable for four coplanar points.
    planar_only
        Whether it solves for coplanar points alone.
    two_solutions
        Whether it returns both planar solutions.
    """

    method: int
    meaning: str
    guarded: bool = True
    planar_only: bool = False
    two_solutions: bool = False


OPENCV_SOLVERS = {
    "ippe": OpenCVSolver(
        cv2.SOLVEPNP_IPPE, "both planar solutions from the homography", planar_only=True,
        two_solutions=True,
    ),
    "ippe_square": OpenCVSolver(
        cv2.SOLVEPNP_IPPE_SQUARE, "ippe for the corners of a square", planar_only=True,
        two_solutions=True,
    ),
    "iterative": OpenCVSolver(
        cv2.SOLVEPNP_ITERATIVE, "Levenberg-Marquardt on the reprojection error, started from the "
        "homography",
    ),
    "sqpnp": OpenCVSolver(cv2.SOLVEPNP_SQPNP, "SQPnP, a quadratic program over rotations"),
    "p3p": OpenCVSolver(cv2.SOLVEPNP_P3P, "three corners; the fourth selects the solution"),
    "ap3p": OpenCVSolver(
        cv2.SOLVEPNP_AP3P, "three corners, algebraic; the fourth selects the solution"
    ),
    "epnp": OpenCVSolver(
        cv2.SOLVEPNP_EPNP, "EPnP, unreliable for a single marker: it is not made for four coplanar "
        "points", guarded=False,
    ),
}
"""The solvers of OpenCV that estimate a pose from four corners."""

_TWO_SOLUTIONS = {each.method for each in OPENCV_SOLVERS.values() if each.two_solutions}


def reprojection_errors_px(
    rotation: Floats, translation: Floats, size_m: Floats, corners: Floats, cameras: Cameras
) -> Floats:
    """Return the RMS reprojection error (N,); NaN for poses with a corner behind the camera."""
    pixels = cameras.project(transform_points(marker_corners(size_m), rotation, translation))
    return np.asarray(np.sqrt(((pixels - corners) ** 2).sum(axis=2).mean(axis=1)))


def estimate(
    corners: Floats, cameras: Cameras, size_m: Floats, solver: str, guarded: bool, limit: float
) -> Estimates:
    """Estimate N poses from corners (N, 4, 2) px with assumed cameras and sizes (N,).

    ``limit`` is the largest RMS reprojection error of a solution, as a share of the mean side of
    the detected quadrilateral.
    """
    # OpenCV raises on strided corners, and the guard would take that for no solution.
    corners = np.ascontiguousarray(corners, dtype=np.float64)
    method = OPENCV_SOLVERS[solver]
    call = _guarded if guarded and method.guarded else _plain
    rotation, translation = call(corners, cameras, size_m, method.method)
    reprojection = np.stack(
        [
            reprojection_errors_px(rotation[:, k], translation[:, k], size_m, corners, cameras)
            for k in range(2)
        ],
        axis=1,
    )
    side = side_lengths(corners).mean(axis=1)
    with np.errstate(invalid="ignore"):
        solved = reprojection <= limit * side[:, None]
    rotation[~solved], translation[~solved], reprojection[~solved] = np.nan, np.nan, np.nan
    solved[:, 1] &= solved[:, 0]
    for k in range(2):
        rotation[~solved[:, 0], k] = np.nan
        reprojection[~solved[:, 0], k] = np.nan
    count = len(corners)
    return Estimates(
        status=np.where(solved[:, 0], EstimateStatus.solved, EstimateStatus.solver_failed).astype(
            np.uint8
        ),
        rotation=rotation[:, 0],
        translation=translation[:, 0],
        reprojection_px=reprojection[:, 0],
        alternative_rotation=rotation[:, 1],
        alternative_reprojection_px=reprojection[:, 1],
        covariance=np.broadcast_to(np.nan, (count, 6, 6)),
        residual_ratio=np.broadcast_to(np.nan, (count,)),
        misfit_px=np.broadcast_to(np.nan, (count,)),
        point_count=np.broadcast_to(np.nan, (count,)),
    )


@dataclass(frozen=True, slots=True)
class CornerSolver:
    """An OpenCV solver as a pose estimator: poses from corners alone.

    Attributes
    ----------
    solver
        A key of :data:`OPENCV_SOLVERS`.
    guarded, reprojection_limit
        As :func:`estimate` takes them.
    corner_noise_px
        Standard deviation of a corner's coordinates for the poses' covariances; None for none.
    """

    solver: str
    guarded: bool
    reprojection_limit: float
    corner_noise_px: float | None

    @property
    def needs_images(self) -> bool:
        """Whether detections must carry their images: no."""
        return False

    def __call__(self, detections: Detections) -> Estimates:
        """Return the poses, with covariances if the corners' noise is given."""
        estimates = estimate(
            detections.corners, detections.cameras, detections.size_m, self.solver, self.guarded,
            self.reprojection_limit,
        )
        if self.corner_noise_px is None:
            return estimates
        covariance = corner_covariance(
            estimates.rotation, estimates.translation, detections.cameras, detections.size_m,
            self.corner_noise_px,
        )
        return dataclasses.replace(estimates, covariance=covariance)


def both_planar_solutions(
    corners: Floats, cameras: Cameras, size_m: Floats
) -> tuple[Floats, Floats]:
    """Return IPPE's rotations (N, 2, 3, 3) and translations (N, 2, 3), guarded; NaN if missing."""
    corners = np.ascontiguousarray(corners, dtype=np.float64)
    return _guarded(corners, cameras, size_m, cv2.SOLVEPNP_IPPE)


def _plain(
    corners: Floats, cameras: Cameras, size_m: Floats, method: int
) -> tuple[Floats, Floats]:
    """Call ``cv2.solvePnP`` plainly: marker frame, metres, OpenCV's own lens inverse."""
    count = len(corners)
    rvec, translation = np.full((count, 2, 3), np.nan), np.full((count, 2, 3), np.nan)
    objects = marker_corners(size_m)
    for i in range(count):
        distortion = cameras.lenses[i, :14] if cameras.distorted[i] else None
        try:
            success, r, t = cv2.solvePnP(
                objects[i], corners[i], cameras.matrix(i), distortion, flags=method
            )
        except cv2.error:
            continue
        if success:
            rvec[i, 0], translation[i, 0] = r[:, 0], t[:, 0]
    return rotation_of_vector(rvec), translation


# The guard. IPPE divides by sin(pi) if the rotation vector's norm is pi, which in the marker
# frame (z out) is every upright marker tilted about one image axis; and it is not finite for a
# few poses on the optical axis in any frame. SQPNP's tolerances are absolute lengths. On 14,832
# noise-free poses the plain calls of ippe, ippe_square and sqpnp were wrong for 2,441, 2,431 and
# 572 of them (`pytest -m long -k guard -s` counts again). OpenCV inverts a lens in about five
# steps, converged or not: of 990 poses to 40° off the axis 36 to 45 % came out wrong by more than
# 0.01° (tests/measure/test_guards.py), so corners are undistorted before.

_UNIT_SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Corners BL, BR, TR, TL (IPPE_SQUARE's order) in the marker's frame turned z in."""

_Z_OUT = np.array([1.0, -1.0, -1.0])

CREDIBLE_SHARE = 0.05
"""Solutions with a reprojection error below this share of the side are accepted; wrong solutions
lie far above it. Others are compared with ITERATIVE's."""

CREDIBLE_RATIO = 2.0
"""The largest ratio of a solution's reprojection error to that of ITERATIVE."""

_FAR_SHARE = 1 / 800
"""Sides below this share of the focal length are compared with IPPE: the perspective across the
marker, which tells the two planar solutions apart, is below this share of the side, and what all
solvers but IPPE leave of it is rounding."""

_FAR_RATIO = 4.0
"""The largest ratio of a far solution's reprojection error to that of IPPE. Without perspective an
exact solution of three corners has twice the least error of four: c/2 and c/4 if the opposite
sides differ by a vector of length c."""

ASTRAY_RATIO = {cv2.SOLVEPNP_ITERATIVE: 1.1, cv2.SOLVEPNP_P3P: 4.0, cv2.SOLVEPNP_AP3P: 4.0}
"""Methods that go astray for a few poses of real corners -> the largest ratio of their
reprojection error to that of IPPE. ITERATIVE ends in another minimum than the least (1-4 % of
markers of 12 to 80 px, at up to 24 times the least error), and is started again from both of
IPPE's solutions. P3P and AP3P fit three corners exactly and miss the fourth (by up to 22 times
the least error), and IPPE's solution is taken."""

ASTRAY_SHARE = 1e-3
"""Reprojection errors below this share of the side are not astray, but the rounding of corners
that nearly fit."""


def _guarded(
    corners: Floats, cameras: Cameras, size_m: Floats, method: int
) -> tuple[Floats, Floats]:
    """Solve in a stable frame: undistorted corners, unit side, z in, roll within 45°.

    Returns both solutions' rotations (N, 2, 3, 3) and translations (N, 2, 3), NaN if missing.
    """
    pixels = corners
    if cameras.distorted.any():
        flat = cameras.normalise(corners)
        pixels = flat * cameras.view[:, None, :2] + cameras.view[:, None, 2:]
    points = np.ascontiguousarray(pixels[:, ::-1])
    right = points[:, 1] + points[:, 2] - points[:, 0] - points[:, 3]
    roll = np.arctan2(right[:, 1], right[:, 0])
    turns = np.nan_to_num(np.round(roll / (np.pi / 2))).astype(np.int64) % 4
    matrices = np.zeros((len(points), 3, 3))
    matrices[:, 0, 0], matrices[:, 1, 1] = cameras.view[:, 0], cameras.view[:, 1]
    matrices[:, 0, 2], matrices[:, 1, 2] = cameras.view[:, 2], cameras.view[:, 3]
    matrices[:, 2, 2] = 1.0

    rotation, translation = _solve_turned(points, matrices, turns, method)
    pinhole = Cameras(cameras.view, cameras.lenses, np.zeros(len(points), dtype=bool))
    unit = np.ones(len(points))
    side = side_lengths(points).mean(axis=1)
    known = np.isfinite(points).all(axis=(1, 2))

    def errors(rows: NDArray[np.intp], r: Floats, t: Floats) -> Floats:
        return reprojection_errors_px(r, t, unit[rows], pixels[rows], pinhole.take(rows))

    error = errors(np.arange(len(points)), rotation[:, 0], translation[:, 0])
    with np.errstate(invalid="ignore"):
        doubtful = ~(error <= CREDIBLE_SHARE * side)
    rows = np.flatnonzero(doubtful & known)
    if len(rows):
        for k in range(1, 4):
            others = _solve_turned(points[rows], matrices[rows], (turns[rows] + k) % 4, method)
            other = errors(rows, others[0][:, 0], others[1][:, 0])
            with np.errstate(invalid="ignore"):
                better = ~np.isfinite(error[rows]) & np.isfinite(other)
            chosen = rows[better]
            rotation[chosen], translation[chosen] = others[0][better], others[1][better]
            error[chosen] = other[better]
        if method != cv2.SOLVEPNP_ITERATIVE:
            others = _solve_turned(
                points[rows], matrices[rows], turns[rows], cv2.SOLVEPNP_ITERATIVE
            )
            other = errors(rows, others[0][:, 0], others[1][:, 0])
            with np.errstate(invalid="ignore"):
                better = ~(error[rows] <= CREDIBLE_RATIO * other) & np.isfinite(other)
            chosen = rows[better]
            rotation[chosen], translation[chosen] = others[0][better], others[1][better]
            error[chosen] = other[better]
    far = side < _FAR_SHARE * cameras.view[:, :2].min(axis=1)
    rows = np.flatnonzero((far | (method in ASTRAY_RATIO)) & known)
    if len(rows) and method != cv2.SOLVEPNP_IPPE:
        others = _guarded(corners[rows], cameras.take(rows), unit[rows], cv2.SOLVEPNP_IPPE)
        other = errors(rows, others[0][:, 0], others[1][:, 0])
        ratio = np.where(far[rows], _FAR_RATIO, ASTRAY_RATIO.get(method, np.inf))
        least = np.where(far[rows], 0.0, ASTRAY_SHARE * side[rows])
        with np.errstate(invalid="ignore"):
            better = ~(error[rows] <= np.maximum(ratio * other, least)) & np.isfinite(other)
        astray = np.flatnonzero(better & ~far[rows])
        if method == cv2.SOLVEPNP_ITERATIVE and len(astray):
            at = rows[astray]
            for k in range(2):
                again = _iterated(
                    points[at], matrices[at], others[0][astray, k], others[1][astray, k]
                )
                now = errors(at, *again)
                with np.errstate(invalid="ignore"):
                    lower = now < other[astray]
                others[0][astray[lower], 0] = again[0][lower]
                others[1][astray[lower], 0] = again[1][lower]
                other[astray[lower]] = now[lower]
        chosen = rows[better]
        rotation[chosen], translation[chosen] = others[0][better], others[1][better]
        if method not in _TWO_SOLUTIONS:
            rotation[chosen, 1], translation[chosen, 1] = np.nan, np.nan
    return rotation, translation * size_m[:, None, None]


def _iterated(
    points: Floats, matrices: Floats, rotation: Floats, translation: Floats
) -> tuple[Floats, Floats]:
    """Solve by ITERATIVE from poses (n, 3, 3), (n, 3) in sides; NaN where it has none.

    Points (n, 4, 2) are BL, BR, TR, TL in undistorted pixels.
    """
    vectors = vector_of_rotation(rotation * _Z_OUT)
    ended = np.full((2, len(points), 3), np.nan)
    for i in np.flatnonzero(np.isfinite(vectors).all(axis=1)):
        success, r, t = cv2.solvePnP(
            _UNIT_SQUARE, points[i], matrices[i], None, vectors[i, :, None].copy(),
            translation[i, :, None].copy(), useExtrinsicGuess=True, flags=cv2.SOLVEPNP_ITERATIVE,
        )
        if success:
            ended[0, i], ended[1, i] = r[:, 0], t[:, 0]
    return rotation_of_vector(ended[0]) * _Z_OUT, ended[1]


def _solve_turned(
    points: Floats, matrices: Floats, turns: NDArray[np.int64], method: int
) -> tuple[Floats, Floats]:
    """Solve with the corners' labels turned by quarter ``turns`` (n,), and undo the turn.

    Points (n, 4, 2) are BL, BR, TR, TL in undistorted pixels. Returns rotations (n, 2, 3, 3) of
    the marker frame and translations (n, 2, 3) in sides.
    """
    count = len(points)
    missing = np.full((3, 1), np.nan)
    order = (np.arange(4) + turns[:, None]) % 4
    turned = np.take_along_axis(points, order[:, :, None], axis=1)
    vectors: list[Any] = []
    both = method in _TWO_SOLUTIONS
    for pixels, matrix in zip(turned, matrices, strict=True):
        try:
            if both:
                success, rs, ts, _ = cv2.solvePnPGeneric(
                    _UNIT_SQUARE, pixels, matrix, None, flags=method
                )
            else:
                success, r, t = cv2.solvePnP(_UNIT_SQUARE, pixels, matrix, None, flags=method)
                rs, ts = (r,), (t,)
        except cv2.error:
            success = False
        if not success:
            vectors += [missing] * 4
        elif len(rs) > 1:
            vectors += [rs[0], rs[1], ts[0], ts[1]]
        else:
            vectors += [rs[0], missing, ts[0], missing]
    solved = np.concatenate(vectors).reshape(count, 2, 2, 3) if vectors else np.empty((0, 2, 2, 3))
    rotation, translation = rotation_of_vector(solved[:, 0]), solved[:, 1]
    c, s = np.array([1.0, 0.0, -1.0, 0.0])[turns], np.array([0.0, 1.0, 0.0, -1.0])[turns]
    back = np.zeros((count, 3, 3))
    back[:, 0, 0], back[:, 0, 1], back[:, 1, 0], back[:, 1, 1] = c, -s, s, c
    back[:, 2, 2] = 1.0
    return np.asarray(rotation @ (back * _Z_OUT)[:, None]), translation.copy()
