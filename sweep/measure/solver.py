"""Pose from points: OpenCV's solvers, guarded or as plain calls, for markers and for boards."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.measure import estimation
from sweep.measure.estimation import Detections, Estimates
from sweep.measure.flags import EstimateStatus
from sweep.model.camera import Cameras
from sweep.model.marker import marker_corners
from sweep.model.polygon import side_lengths, signed_areas
from sweep.model.pose import rotation_of_vector, transform_points, vector_of_rotation
from sweep.plugins import EstimatorPlugin
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# OpenCV's solvers, and poses of N markers at once, from four corners each.

@dataclass(frozen=True, kw_only=True)
class Solver(EstimatorPlugin):
    """A built-in choice of ``solver`` in pipeline files: a plug-in's record, and more about it.

    Its ``make`` takes a :class:`sweep.measure.estimators.EstimatorSetting`, and returns an
    estimator.

    Attributes
    ----------
    own
        The settings that it has beside those of all solvers, by name; ``guarded`` apart.
    method
        OpenCV's constant of a solver that takes corners alone; None of others.
    guarded
        Whether the setting ``guarded`` applies to it: it is stable for four coplanar points.
    planar_only
        Whether it works for coplanar points alone.
    two_solutions
        Whether OpenCV returns both planar solutions.
    recorded
        Whether it estimates nothing, and takes poses of recorded detections.
    of_boards
        Whether it estimates the pose of a board from all its points, too.
    """

    own: tuple[str, ...] = ()
    method: Any = None
    guarded: bool = False
    planar_only: bool = False
    two_solutions: bool = False
    recorded: bool = False


def _of_opencv(method: int, meaning: str, *, guarded: bool = True, **properties: Any) -> Solver:
    """Return the record of one method of ``cv2.solvePnP``."""
    return Solver(
        make=lambda setting: PointSolver(
            setting.solver, setting.guarded, setting.reprojection_limit, setting.corner_noise_px,
            setting.points, setting.refine,
        ),
        meaning=meaning, method=method, guarded=guarded, **properties,
    )


#: The solvers of OpenCV.
OPENCV_SOLVERS = {
    "ippe": _of_opencv(
        cv2.SOLVEPNP_IPPE, "both planar solutions from the homography", planar_only=True,
        two_solutions=True, of_boards=True,
    ),
    "ippe_square": _of_opencv(
        cv2.SOLVEPNP_IPPE_SQUARE, "ippe for the corners of a square", planar_only=True,
        two_solutions=True,
    ),
    "iterative": _of_opencv(
        cv2.SOLVEPNP_ITERATIVE, "Levenberg-Marquardt on the reprojection error, started from the "
        "homography", of_boards=True,
    ),
    "sqpnp": _of_opencv(
        cv2.SOLVEPNP_SQPNP, "SQPnP, a quadratic program over rotations", of_boards=True
    ),
    "p3p": _of_opencv(cv2.SOLVEPNP_P3P, "three corners; the fourth selects the solution"),
    "ap3p": _of_opencv(
        cv2.SOLVEPNP_AP3P, "three corners, algebraic; the fourth selects the solution"
    ),
    "epnp": _of_opencv(
        cv2.SOLVEPNP_EPNP, "EPnP, unreliable for a single marker: it is not made for four coplanar "
        "points", guarded=False, of_boards=True,
    ),
}

_TWO_SOLUTIONS = {each.method for each in OPENCV_SOLVERS.values() if each.two_solutions}


def reprojection_errors_px(
    rotation: Floats, translation: Floats, size_m: Floats, corners: Floats, cameras: Cameras
) -> Floats:
    """Return the RMS reprojection error (N,); NaN for poses with a corner behind the camera."""
    pixels = cameras.project(transform_points(marker_corners(size_m), rotation, translation))
    return np.asarray(np.sqrt(((pixels - corners) ** 2).sum(axis=2).mean(axis=1)))


def square_poses(
    corners: Floats, cameras: Cameras, size_m: Floats, solver: str, guarded: bool
) -> tuple[Floats, Floats]:
    """Return rotations (N, 2, 3, 3) and translations (N, 2, 3) of N markers; NaN if missing.

    From corners (N, 4, 2) px with assumed cameras and sizes (N,). The second is the other planar
    solution.
    """
    # OpenCV raises on strided corners, and the guard would take that for no solution.
    corners = np.ascontiguousarray(corners, dtype=np.float64)
    method = OPENCV_SOLVERS[solver]
    call = _guarded if guarded and method.guarded else _plain
    return call(corners, cameras, size_m, method.method)


def both_planar_solutions(
    corners: Floats, cameras: Cameras, size_m: Floats
) -> tuple[Floats, Floats]:
    """Return IPPE's rotations (N, 2, 3, 3) and translations (N, 2, 3), guarded; NaN if missing."""
    return square_poses(corners, cameras, size_m, "ippe", guarded=True)


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
# 572 of them (`pytest -m evidence -k guard -s` counts again). OpenCV inverts a lens in about five
# steps, converged or not: of 990 poses to 40° off the axis 36 to 45 % came out wrong by more than
# 0.01° (tests/measure/test_guards.py), so corners are undistorted before.

#: Corners BL, BR, TR, TL (IPPE_SQUARE's order) in the marker's frame turned z in.
_UNIT_SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])

_Z_OUT = np.array([1.0, -1.0, -1.0])

#: Solutions with a reprojection error below this share of the side are accepted; wrong solutions
#: lie far above it. Others are compared with ITERATIVE's.
CREDIBLE_SHARE = 0.05

#: The largest ratio of a solution's reprojection error to that of ITERATIVE.
CREDIBLE_RATIO = 2.0

#: Sides below this share of the focal length are compared with IPPE: the perspective across the
#: marker, which tells the two planar solutions apart, is below this share of the side, and what all
#: solvers but IPPE leave of it is rounding.
_FAR_SHARE = 1 / 800

#: The largest ratio of a far solution's reprojection error to that of IPPE. Without perspective an
#: exact solution of three corners has twice the least error of four: c/2 and c/4 if the opposite
#: sides differ by a vector of length c.
_FAR_RATIO = 4.0

#: Methods that go astray for a few poses of real corners -> the largest ratio of their reprojection
#: error to that of IPPE. ITERATIVE ends in another minimum than the least (1-4 % of markers of 12
#: to 80 px, at up to 24 times the least error), and is started again from both of IPPE's solutions.
#: P3P and AP3P fit three corners exactly and miss the fourth (by up to 22 times the least error),
#: and IPPE's solution is taken.
ASTRAY_RATIO = {cv2.SOLVEPNP_ITERATIVE: 1.1, cv2.SOLVEPNP_P3P: 4.0, cv2.SOLVEPNP_AP3P: 4.0}

#: Reprojection errors below this share of the side are not astray, but the rounding of corners that
#: nearly fit.
ASTRAY_SHARE = 1e-3


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
    matrices = cameras.matrices

    rotation, translation = _solve_turned(points, matrices, turns, method)
    pinhole = Cameras(cameras.view, cameras.lenses, np.zeros(len(points), dtype=bool))
    unit = np.ones(len(points))
    side = side_lengths(points).mean(axis=1)
    known = np.isfinite(points).all(axis=(1, 2))

    def errors(rows: NDArray[np.intp], r: Floats, t: Floats) -> Floats:
        return reprojection_errors_px(r, t, unit[rows], pixels[rows], pinhole.take(rows))

    def solved(rows: NDArray[np.intp], turn: int, by: int) -> tuple[Floats, Floats, Floats]:
        """Return other solutions, with the labels turned on, and the first ones' errors."""
        others = _solve_turned(points[rows], matrices[rows], (turns[rows] + turn) % 4, by)
        return *others, errors(rows, others[0][:, 0], others[1][:, 0])

    def take(rows: NDArray[np.intp], better: Masks, others: tuple[Floats, Floats, Floats]) -> None:
        chosen = rows[better]
        rotation[chosen], translation[chosen], error[chosen] = (each[better] for each in others)

    error = errors(np.arange(len(points)), rotation[:, 0], translation[:, 0])
    rows = np.flatnonzero(~(error <= CREDIBLE_SHARE * side) & known)
    if len(rows):
        for k in range(1, 4):
            others = solved(rows, k, method)
            take(rows, ~np.isfinite(error[rows]) & np.isfinite(others[2]), others)
        if method != cv2.SOLVEPNP_ITERATIVE:
            others = solved(rows, 0, cv2.SOLVEPNP_ITERATIVE)
            worse = ~(error[rows] <= CREDIBLE_RATIO * others[2])
            take(rows, worse & np.isfinite(others[2]), others)
    far = side < _FAR_SHARE * cameras.view[:, :2].min(axis=1)
    rows = np.flatnonzero((far | (method in ASTRAY_RATIO)) & known)
    if len(rows) and method != cv2.SOLVEPNP_IPPE:
        turned, moved = _guarded(corners[rows], cameras.take(rows), unit[rows], cv2.SOLVEPNP_IPPE)
        other = errors(rows, turned[:, 0], moved[:, 0])
        ratio = np.where(far[rows], _FAR_RATIO, ASTRAY_RATIO.get(method, np.inf))
        least = np.where(far[rows], 0.0, ASTRAY_SHARE * side[rows])
        better = ~(error[rows] <= np.maximum(ratio * other, least)) & np.isfinite(other)
        astray = np.flatnonzero(better & ~far[rows])
        if method == cv2.SOLVEPNP_ITERATIVE and len(astray):
            at = rows[astray]
            for k in range(2):
                again = _iterated(points[at], matrices[at], turned[astray, k], moved[astray, k])
                now = errors(at, *again)
                lower = now < other[astray]
                turned[astray[lower], 0], moved[astray[lower], 0] = again[0][lower], again[1][lower]
                other[astray[lower]] = now[lower]
        take(rows, better, (turned, moved, other))
        if method not in _TWO_SOLUTIONS:
            rotation[rows[better], 1], translation[rows[better], 1] = np.nan, np.nan
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


# --------------------------------------------------------------------------------------------------
# Poses of one target from any number of points: OpenCV's solvers, called plainly or guarded.

#: Rotation (3, 3) and translation (3,) in metres.
Pose = tuple[Floats, Floats]


def lens_of(cameras: Cameras) -> Floats | None:
    """Return the lens of the first camera as OpenCV's calls take it; None if it has none."""
    return cameras.lenses[0, :14] if cameras.distorted[0] else None


def reprojection_px(
    rotation: Floats, translation: Floats, objects: Floats, pixels: Floats, cameras: Cameras
) -> float:
    """Return the RMS reprojection error of points (k, 3); NaN if one is behind the camera."""
    projected = cameras.project(
        transform_points(objects[None], rotation[None], translation[None])
    )[0]
    return float(np.sqrt(((projected - pixels) ** 2).sum(axis=1).mean()))


def marker_frame(corners_m: Floats) -> tuple[float, Pose]:
    """Return a marker's side, and the pose (3, 3), (3,) of its frame on the board."""
    right = corners_m[1] - corners_m[0]
    up = corners_m[0] - corners_m[3]
    size = float(np.linalg.norm(right))
    x, y = right / size, up / np.linalg.norm(up)
    return size, (np.stack([x, y, np.cross(x, y)], axis=1), corners_m.mean(axis=0))


def of_board(rotation: Floats, translation: Floats, to_board: Pose) -> Pose:
    """Return the board's pose from that of a marker whose frame is ``to_board`` on it."""
    turned = rotation @ to_board[0].T
    return turned, translation - turned @ to_board[1]


def poses_of_each_marker(
    objects: Floats, pixels: Floats, cameras: Cameras
) -> list[Pose]:
    """Return the board's poses from both planar solutions of each marker."""
    corners_m, corners = objects.reshape(-1, 4, 3), pixels.reshape(-1, 4, 2)
    frames = [marker_frame(each) for each in corners_m]
    same = cameras.take(np.zeros(len(corners), dtype=np.intp))
    rotation, translation = both_planar_solutions(
        corners, same, np.array([size for size, _ in frames])
    )
    return [
        of_board(rotation[k, solution], translation[k, solution], frames[k][1])
        for k in range(len(corners)) for solution in range(2)
    ]


def _called(
    objects: Floats, pixels: Floats, matrix: Floats, lens: Floats | None, method: int
) -> list[Pose]:
    """Call ``cv2.solvePnPGeneric``; no pose if it fails."""
    try:
        success, vectors, positions, _ = cv2.solvePnPGeneric(
            np.ascontiguousarray(objects), np.ascontiguousarray(pixels), matrix, lens, flags=method
        )
    except cv2.error:
        return []
    if not success:
        return []
    return [
        (rotation_of_vector(np.asarray(r, dtype=np.float64).reshape(1, 3))[0],
         np.asarray(t, dtype=np.float64).ravel())
        for r, t in zip(vectors, positions, strict=True)
    ]


#: Least extent of points across their line, of unit size along it: points of a line leave the turn
#: about it open, and SQPnP and EPnP return any.
COLLINEAR = 1e-6

_Z_IN = np.diag([1.0, -1.0, -1.0])


class GuardedPoints(NamedTuple):
    """Points of a target in a stable frame: unit size, z in, roll within 45°; undistorted pixels.

    For the reasons that the guard of a single marker has (:mod:`sweep.measure.solver`).

    Attributes
    ----------
    points, pixels, matrix
        (k, 3), (k, 2), and OpenCV's camera matrix (3, 3); no points if they have no pose.
    turn, size, middle
        (3, 3), metres and (3,) metres: from the target's frame to the stable one.
    to_target
        The pose of the points' plane on the target, if it lies across the target's.
    """

    points: Floats
    pixels: Floats
    matrix: Floats
    turn: Floats
    size: float
    middle: Floats
    to_target: Pose | None = None

    @staticmethod
    def of(objects: Floats, pixels: Floats, cameras: Cameras) -> GuardedPoints:
        """Return points (k, 3) in metres and their pixels (k, 2) in the first camera."""
        flat, matrix = pixels, cameras.matrix(0)
        if cameras.distorted[0]:
            view = cameras.view[0]
            flat = cameras.normalise(pixels[None])[0] * view[:2] + view[2:]
        middle = objects.mean(axis=0)
        size = float(np.sqrt(((objects - middle) ** 2).sum(axis=1).mean()))
        none = GuardedPoints(np.empty((0, 3)), np.empty((0, 2)), matrix, np.eye(3), size, middle)
        if not size > 0 or not np.isfinite(flat).all():
            return none
        unit = (objects - middle) / size @ _Z_IN
        if np.linalg.svd(unit[:, :2], compute_uv=False)[1] < COLLINEAR:
            _, extents, axes = np.linalg.svd(objects - middle, full_matrices=False)
            if extents[1] < COLLINEAR * size:
                return none
            # In a plane across the target's, such as one face of a cube: solved in their own.
            axes *= np.sign(np.linalg.det(axes))
            own = GuardedPoints.of((objects - middle) @ axes.T, pixels, cameras)
            return own._replace(to_target=(axes.T, middle))
        planar = np.column_stack([unit[:, :2], np.ones(len(unit))])
        (right, _, _), *_ = np.linalg.lstsq(planar, flat, rcond=None)
        turn = round(math.atan2(right[1], right[0]) / (math.pi / 2)) % 4
        cosine, sine = (1.0, 0.0, -1.0, 0.0)[turn], (0.0, 1.0, 0.0, -1.0)[turn]
        back = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return GuardedPoints(unit @ back.T, flat, matrix, back, size, middle)

    def poses(self, method: int) -> list[Pose]:
        """Return the target's poses by a method of ``cv2.solvePnPGeneric``."""
        found = []
        if len(self.points):
            for rotation, position in _called(
                self.points, self.pixels, self.matrix, None, method
            ):
                turned = rotation @ self.turn @ _Z_IN
                pose = turned, position * self.size - turned @ self.middle
                found.append(pose if self.to_target is None else of_board(*pose, self.to_target))
        return found


# --------------------------------------------------------------------------------------------------
# The estimator of poses from corners.

#: The fewest points that a pose is estimated from.
MIN_POINTS = 4


class _Solution(NamedTuple):
    """A pose (3, 3), (3,) in metres, its reprojection error, and the points (k, 3) that gave it.

    All are NaN if there is none.
    """

    rotation: Floats
    translation: Floats
    error_px: float
    objects: Floats


_NONE = _Solution(np.full((3, 3), np.nan), np.full(3, np.nan), math.nan, np.zeros((0, 3)))


class _Points(NamedTuple):
    """Points (k, 3) of a target in metres, their pixels (k, 2), and the camera, the first."""

    objects: Floats
    pixels: Floats
    cameras: Cameras

    def solutions(
        self, poses: Sequence[Pose], used: Iterable[Floats] | None = None
    ) -> list[_Solution]:
        """Return the finite poses, the best first; ``used`` gave each, by default all points."""
        objects, pixels, cameras = self
        given = itertools.repeat(objects, len(poses)) if used is None else used
        found = [
            _Solution(*pose, reprojection_px(*pose, objects, pixels, cameras), points)
            for pose, points in zip(poses, given, strict=True)
        ]
        return sorted((each for each in found if math.isfinite(each.error_px)),
                      key=lambda each: each.error_px)

    def refined(self, start: _Solution, refine: str) -> _Solution:
        """Return a pose after OpenCV's refinement, lm or vvs; the start if it fails."""
        call: Any = cv2.solvePnPRefineLM if refine == "lm" else cv2.solvePnPRefineVVS
        vector = vector_of_rotation(start.rotation[None])[0][:, None]
        try:
            r, t = call(
                self.objects, self.pixels, self.cameras.matrix(0), lens_of(self.cameras), vector,
                start.translation[:, None].copy(),
            )
        except cv2.error:
            return start
        pose = rotation_of_vector(r.reshape(1, 3))[0], t.ravel()
        return next(iter(self.solutions([pose])), start)


@dataclass(frozen=True, slots=True)
class PointSolver:
    """An OpenCV solver as an estimator of poses from corners alone.

    Markers are solved together, each from its four corners; boards one by one, from the points that
    the setting chooses.

    Attributes
    ----------
    solver, guarded, reprojection_limit, corner_noise_px, points, refine
        As :class:`sweep.measure.estimators.EstimatorSetting` has them.
    """

    solver: str
    guarded: bool
    reprojection_limit: float
    corner_noise_px: float | None = None
    points: str = "markers"
    refine: str = "none"

    def __call__(self, detections: Detections) -> Estimates:
        """Return the poses, with covariances if the corners' noise is given."""
        if not detections.targets.are_markers:
            out = Estimates.none(len(detections), EstimateStatus.solver_failed)
            for i in range(len(detections)):
                self._estimate(detections.take(np.array([i])), i, out)
            return out
        rotation, translation = square_poses(
            detections.corners, detections.cameras, detections.size_m, self.solver, self.guarded
        )
        return estimation.credible_estimates(
            detections, rotation[:, 0], translation[:, 0], self.reprojection_limit,
            alternative=(rotation[:, 1], translation[:, 1]),
            corner_noise_px=self.corner_noise_px,
        )

    def _estimate(self, one: Detections, i: int, out: Estimates) -> None:
        """Write the estimate of a single board as number ``i``."""
        points = self._points(one)
        if len(points.pixels) < MIN_POINTS:
            out.status[i] = EstimateStatus.too_few_points
            return
        side = float(one.side_px()[0])
        solutions = self._solutions(points, side)
        limit = self.reprojection_limit * side
        if not solutions or not solutions[0].error_px <= limit:
            return
        best = solutions[0]
        other = next((each for each in solutions[1:] if each.error_px <= limit), _NONE)
        out.status[i], out.point_count[i] = EstimateStatus.solved, len(points.pixels)
        out.rotation[i], out.translation[i], out.reprojection_px[i], used = best
        out.alternative_rotation[i], _, out.alternative_reprojection_px[i], _ = other
        if self.corner_noise_px is not None:
            out.covariance[i] = estimation.point_covariance(
                best.rotation[None], best.translation[None], used[None],
                np.zeros(1, dtype=np.int64), one.cameras, self.corner_noise_px,
            )[0]

    def _points(self, one: Detections) -> _Points:
        """Return the points in the board's frame."""
        if self.points == "chessboard":
            found = np.isfinite(one.chessboard_px[0, :, 0])
            objects = one.targets[0].chessboard_m[found] * one.scale[0]
            return _Points(objects, one.chessboard_px[0, found], one.cameras)
        objects, corners = one.objects_m, one.corners
        if self.points == "largest_marker" and len(corners):
            largest = np.argmax(np.abs(signed_areas(corners)))
            objects, corners = objects[[largest]], corners[[largest]]
        return _Points(objects.reshape(-1, 3), corners.reshape(-1, 2), one.cameras)

    def _solutions(self, points: _Points, side_px: float) -> list[_Solution]:
        """Return the two poses of least reprojection error, the best first.

        ``side_px`` is the mean side of the detected markers.
        """
        objects, pixels, cameras = points
        method, guard, used = OPENCV_SOLVERS[self.solver].method, None, None
        if self.points == "largest_marker":
            size, to_board = marker_frame(objects)
            (rotations,), (positions,) = square_poses(
                pixels[None], cameras, np.array([size]), self.solver, self.guarded
            )
            poses = [of_board(*pose, to_board) for pose in zip(rotations, positions, strict=True)]
        elif self.points == "each_marker":
            poses = poses_of_each_marker(*points)
            used = np.repeat(objects.reshape(-1, 4, 3), 2, axis=0)
        elif self.guarded:
            guard = GuardedPoints.of(*points)
            poses = guard.poses(method)
        else:
            poses = _called(objects, pixels, cameras.matrix(0), lens_of(cameras), method)
        ordered = points.solutions(poses, used)
        if guard is not None and self.solver == "iterative":
            ordered = _least_of(ordered, guard, points, side_px)
        if guard is not None and self.solver != "epnp":
            ordered = _or_others(ordered, guard, points, CREDIBLE_SHARE * side_px, method)
        if self.refine != "none" and ordered:
            ordered[0] = points.refined(ordered[0], self.refine)
        return ordered[:2]


#: With fewer points SQPnP, too, may end in the worse of two minima of nearly the same error (14 of
#: 12,000 drawn targets; none of 11,000 with more), and IPPE, which has both, is asked as well.
_AMBIGUOUS_POINTS = 24


def _least_of(
    ordered: list[_Solution], guard: GuardedPoints, points: _Points, side_px: float
) -> list[_Solution]:
    """Return ITERATIVE's solutions, or other solvers' refined where it missed the least error.

    As for single markers, and about as often if one marker of the board is detected.
    """
    if ordered and ordered[0].error_px <= ASTRAY_SHARE * side_px:
        return ordered
    poses = guard.poses(cv2.SOLVEPNP_SQPNP)
    if len(points.pixels) < _AMBIGUOUS_POINTS:
        poses = [*guard.poses(cv2.SOLVEPNP_IPPE), *poses]
    starts = points.solutions(poses)
    if not starts:
        return ordered
    least = starts[0].error_px
    if ordered and ordered[0].error_px <= ASTRAY_RATIO[cv2.SOLVEPNP_ITERATIVE] * least:
        return ordered
    refined = [points.refined(each, "lm") for each in starts]
    return [min([*refined, *starts], key=lambda each: each.error_px)]


def _or_others(
    ordered: list[_Solution], guard: GuardedPoints, points: _Points, credible_px: float,
    tried: int,
) -> list[_Solution]:
    """Return solutions of a method ``tried``, or ITERATIVE's or IPPE's if the best is not credible.

    As for single markers: IPPE is not finite for a fifth of the boards that face the camera
    exactly, and SQPnP has no solution of boards of a few pixels.
    """
    if ordered and ordered[0].error_px <= credible_px:
        return ordered
    for method in (cv2.SOLVEPNP_ITERATIVE, cv2.SOLVEPNP_IPPE):
        if method == tried:
            continue
        others = points.solutions(guard.poses(method))
        if others and not (
            ordered and ordered[0].error_px <= CREDIBLE_RATIO * others[0].error_px
        ):
            ordered = others
    return ordered
