"""The pose of a board from its points: OpenCV's solvers, guarded or as plain calls."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.measure.estimation import Estimates, point_covariance
from sweep.measure.flags import EstimateStatus
from sweep.measure.solver import (
    ASTRAY_RATIO,
    ASTRAY_SHARE,
    CREDIBLE_RATIO,
    CREDIBLE_SHARE,
    both_planar_solutions,
    estimate,
)
from sweep.model.board import Board
from sweep.model.camera import Cameras
from sweep.model.polygon import side_lengths, signed_areas
from sweep.model.pose import rotation_of_vector, transform_points, vector_of_rotation
from sweep.typing import Floats, Grey, Integers, Masks

# --------------------------------------------------------------------------------------------------
# Poses of boards from points: OpenCV's solvers, called plainly or guarded, and single markers'.

Pose = tuple[Floats, Floats]
"""Rotation (3, 3) and translation (3,) in metres."""


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


def plain_poses(
    objects: Floats, pixels: Floats, cameras: Cameras, method: int
) -> list[Pose]:
    """Call ``cv2.solvePnPGeneric`` plainly: the board's frame, metres, OpenCV's lens inverse."""
    return _called(objects, pixels, cameras.matrix(0), lens_of(cameras), method)


def _called(
    objects: Floats, pixels: Floats, matrix: Floats, lens: Floats | None, method: int
) -> list[Pose]:
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


COLLINEAR = 1e-6
"""Least extent of points across their line, of unit size along it: points of a line leave the turn
about it open, and SQPnP and EPnP return any."""

_Z_IN = np.diag([1.0, -1.0, -1.0])


def guarded_poses(
    objects: Floats, pixels: Floats, cameras: Cameras, method: int
) -> list[Pose]:
    """Solve in a stable frame: undistorted pixels, points of unit size, z in, roll within 45°.

    For the reasons that the guard of a single marker has (:mod:`sweep.measure.solver`).
    """
    flat = pixels
    if cameras.distorted[0]:
        view = cameras.view[0]
        flat = cameras.normalise(pixels[None])[0] * view[:2] + view[2:]
    middle = objects.mean(axis=0)
    size = float(np.sqrt(((objects - middle) ** 2).sum(axis=1).mean()))
    if not size > 0 or not np.isfinite(flat).all():
        return []
    unit = (objects - middle) / size @ _Z_IN
    if np.linalg.svd(unit[:, :2], compute_uv=False)[1] < COLLINEAR:
        _, extents, axes = np.linalg.svd(objects - middle, full_matrices=False)
        if extents[1] < COLLINEAR * size:
            return []
        # In a plane across the board's, such as one face of a cube: solved in their own.
        axes *= np.sign(np.linalg.det(axes))
        own = guarded_poses((objects - middle) @ axes.T, pixels, cameras, method)
        return [of_board(*pose, (axes.T, middle)) for pose in own]
    planar = np.column_stack([unit[:, :2], np.ones(len(unit))])
    (right, _, _), *_ = np.linalg.lstsq(planar, flat, rcond=None)
    turn = round(math.atan2(right[1], right[0]) / (math.pi / 2)) % 4
    cosine, sine = (1.0, 0.0, -1.0, 0.0)[turn], (0.0, 1.0, 0.0, -1.0)[turn]
    back = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    poses = []
    for rotation, position in _called(unit @ back.T, flat, cameras.matrix(0), None, method):
        turned = rotation @ back @ _Z_IN
        poses.append((turned, position * size - turned @ middle))
    return poses


# --------------------------------------------------------------------------------------------------
# The pose of a board from its points: the estimator, and what estimators of boards get.

BOARD_METHODS: dict[str, int] = {
    "iterative": cv2.SOLVEPNP_ITERATIVE,
    "sqpnp": cv2.SOLVEPNP_SQPNP,
    "ippe": cv2.SOLVEPNP_IPPE,
    "epnp": cv2.SOLVEPNP_EPNP,
}
"""Solvers for any number of points in a plane -> OpenCV's constant."""

MIN_POINTS = 4
"""The fewest points that a pose is estimated from."""


class BoardPoints(NamedTuple):
    """What was found of one board.

    Attributes
    ----------
    marker
        (K,) indices on the board of the decoded markers whose ID it has.
    corners_px
        (K, 4, 2) their corners in pixels of the frame: TL, TR, BR, BL.
    chessboard, chessboard_px
        (C,) and (C, 2) indices and pixels of the chessboard's corners that were found.
    """

    marker: Integers
    corners_px: Floats
    chessboard: Integers
    chessboard_px: Floats


@dataclass(frozen=True, slots=True)
class BoardDetections:
    """N boards, and the camera, noise and blur that the estimator assumes.

    Attributes
    ----------
    boards, points
        The boards, and what was found of each.
    cameras, noise_grey, blur_px
        N cameras, and (N,) as :class:`sweep.measure.estimation.Detections` has them.
    scale
        (N,) believed size of the board relative to the true one.
    images, origins
        As :class:`sweep.measure.estimation.Detections` has them.
    beside
        Of each image which pixels show something beside the board; empty if none does.
    """

    boards: Sequence[Board]
    points: Sequence[BoardPoints]
    cameras: Cameras
    noise_grey: Floats
    blur_px: Floats
    scale: Floats
    images: Sequence[Grey]
    origins: Integers
    beside: Sequence[Masks] = ()

    def take(self, rows: NDArray[np.intp]) -> BoardDetections:
        """Return the detections of the given rows."""
        return BoardDetections(
            [self.boards[row] for row in rows], [self.points[row] for row in rows],
            self.cameras.take(rows), self.noise_grey[rows], self.blur_px[rows], self.scale[rows],
            [self.images[row] for row in rows] if len(self.images) else [], self.origins[rows],
            [self.beside[row] for row in rows] if len(self.beside) else [],
        )


class BoardEstimator(Protocol):
    """A function from what was found of boards to their poses."""

    @property
    def needs_images(self) -> bool:
        """Whether the searched images must be kept."""
        ...

    def __call__(self, detections: BoardDetections, /) -> Estimates:
        """Return one estimate for each board; its status says why a pose is missing."""
        ...


def one_by_one(
    detections: BoardDetections, write: Callable[[BoardDetections, int, Estimates], None]
) -> Estimates:
    """Return the estimates that ``write`` writes of each board, as the number that it gets."""
    count = len(detections.boards)
    out = Estimates.none(count, EstimateStatus.solver_failed)
    for i in range(count):
        write(detections.take(np.array([i])), i, out)
    return out


class _Solution(NamedTuple):
    """A pose (3, 3), (3,) in metres, its reprojection error, and the points (k, 3) that gave it.

    All are NaN if there is none.
    """

    rotation: Floats
    translation: Floats
    error_px: float
    objects: Floats


_NONE = _Solution(np.full((3, 3), np.nan), np.full(3, np.nan), math.nan, np.zeros((0, 3)))


@dataclass(frozen=True, slots=True)
class BoardSolver:
    """An OpenCV solver as an estimator of boards' poses.

    Attributes
    ----------
    solver, points, refine, guarded, reprojection_limit, corner_noise_px
        As :class:`sweep.measure.estimators.EstimatorSetting` has them.
    """

    solver: str
    points: str
    refine: str
    guarded: bool
    reprojection_limit: float
    corner_noise_px: float | None

    @property
    def needs_images(self) -> bool:
        """Whether the searched images must be kept: no."""
        return False

    def __call__(self, detections: BoardDetections) -> Estimates:
        """Return the poses, with covariances if the corners' noise is given."""
        return one_by_one(detections, self._estimate)

    def _estimate(self, one: BoardDetections, i: int, out: Estimates) -> None:
        """Write the estimate of a single board as number ``i``."""
        found, board, scale = one.points[0], one.boards[0], float(one.scale[0])
        objects, pixels = self._points(board, found)
        objects = objects * scale
        if len(pixels) < MIN_POINTS:
            out.status[i] = EstimateStatus.too_few_points
            return
        side = float(side_lengths(found.corners_px).mean())
        solutions = self._solutions(one, objects, pixels, side)
        limit = self.reprojection_limit * side
        if not solutions or not solutions[0].error_px <= limit:
            return
        best = solutions[0]
        other = next((each for each in solutions[1:] if each.error_px <= limit), _NONE)
        out.status[i], out.point_count[i] = EstimateStatus.solved, len(pixels)
        out.rotation[i], out.translation[i], out.reprojection_px[i], used = best
        out.alternative_rotation[i], _, out.alternative_reprojection_px[i], _ = other
        if self.corner_noise_px is not None:
            out.covariance[i] = point_covariance(
                best.rotation, best.translation, used, one.cameras, self.corner_noise_px
            )

    def _points(self, board: Board, found: BoardPoints) -> tuple[Floats, Floats]:
        """Return the points (k, 3) in the board's frame and their pixels (k, 2)."""
        if self.points == "chessboard":
            return board.chessboard_m[found.chessboard], found.chessboard_px
        marker, corners = found.marker, found.corners_px
        if self.points == "largest_marker" and len(marker):
            largest = np.argmax(np.abs(signed_areas(corners)))
            marker, corners = marker[[largest]], corners[[largest]]
        return board.corners_m[marker].reshape(-1, 3), corners.reshape(-1, 2)

    def _solutions(
        self, one: BoardDetections, objects: Floats, pixels: Floats, side_px: float
    ) -> list[_Solution]:
        """Return the poses by their reprojection error, the best first.

        ``side_px`` is the mean side of the detected markers.
        """
        if self.points == "largest_marker":
            ordered = _by_error(self._of_marker(one, objects, pixels), objects, pixels, one.cameras)
        elif self.points == "each_marker":
            poses = poses_of_each_marker(objects, pixels, one.cameras)
            used = np.repeat(objects.reshape(-1, 4, 3), 2, axis=0)
            ordered = _by_error(poses, objects, pixels, one.cameras, used)
        else:
            method = BOARD_METHODS[self.solver]
            solve = guarded_poses if self.guarded else plain_poses
            ordered = _by_error(
                solve(objects, pixels, one.cameras, method), objects, pixels, one.cameras
            )
            if self.guarded and self.solver == "iterative":
                ordered = _least_of(ordered, one, objects, pixels, side_px)
            if self.guarded and self.solver != "epnp":
                ordered = _or_others(ordered, one, objects, pixels, CREDIBLE_SHARE * side_px)
        if self.refine != "none" and ordered:
            ordered[0] = _refined(ordered[0], self.refine, objects, pixels, one.cameras)
        return ordered[:2]

    def _of_marker(
        self, one: BoardDetections, objects: Floats, pixels: Floats
    ) -> list[Pose]:
        """Return the board's poses from the corners (4, 3) and (4, 2) of a single marker."""
        size, to_board = marker_frame(objects)
        solved = estimate(
            pixels[None], one.cameras, np.array([size]), self.solver, self.guarded,
            self.reprojection_limit,
        )
        poses = [(solved.rotation[0], solved.translation[0])]
        if np.isfinite(solved.alternative_rotation[0]).all():
            both, positions = both_planar_solutions(pixels[None], one.cameras, np.array([size]))
            poses.append((both[0, 1], positions[0, 1]))
        return [of_board(*pose, to_board) for pose in poses]


def _refined(
    start: _Solution, refine: str, objects: Floats, pixels: Floats, cameras: Cameras
) -> _Solution:
    """Return a pose after OpenCV's refinement, lm or vvs, on all points; the start if it fails."""
    call: Any = cv2.solvePnPRefineLM if refine == "lm" else cv2.solvePnPRefineVVS
    vector = vector_of_rotation(start.rotation[None])[0][:, None]
    try:
        r, t = call(
            objects, pixels, cameras.matrix(0), lens_of(cameras), vector,
            start.translation[:, None].copy(),
        )
    except cv2.error:
        return start
    rotation, translation = rotation_of_vector(r.reshape(1, 3))[0], t.ravel()
    error = reprojection_px(rotation, translation, objects, pixels, cameras)
    found = _Solution(rotation, translation, error, objects)
    return found if math.isfinite(error) else start


def _least_of(
    ordered: list[_Solution], one: BoardDetections, objects: Floats, pixels: Floats,
    side_px: float,
) -> list[_Solution]:
    """Return ITERATIVE's solutions, or other solvers' refined where it missed the least error.

    As for single markers, and about as often if one marker of the board is detected.
    """
    starts = _by_error(
        [pose for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP)
         for pose in guarded_poses(objects, pixels, one.cameras, method)],
        objects, pixels, one.cameras,
    )
    if not starts:
        return ordered
    credible = max(
        ASTRAY_RATIO[cv2.SOLVEPNP_ITERATIVE] * starts[0].error_px, ASTRAY_SHARE * side_px
    )
    if ordered and ordered[0].error_px <= credible:
        return ordered
    refined = [_refined(each, "lm", objects, pixels, one.cameras) for each in starts]
    return [min([*refined, *starts], key=lambda each: each.error_px)]


def _by_error(
    poses: Sequence[Pose], objects: Floats, pixels: Floats, cameras: Cameras,
    used: Iterable[Floats] | None = None,
) -> list[_Solution]:
    """Return the finite poses, the best first; ``used`` gave each, by default all points."""
    given = itertools.repeat(objects, len(poses)) if used is None else used
    found = [
        _Solution(*pose, reprojection_px(*pose, objects, pixels, cameras), points)
        for pose, points in zip(poses, given, strict=True)
    ]
    return sorted((each for each in found if math.isfinite(each.error_px)),
                  key=lambda each: each.error_px)


def _or_others(
    ordered: list[_Solution], one: BoardDetections, objects: Floats, pixels: Floats,
    credible_px: float,
) -> list[_Solution]:
    """Return solutions, or those of ITERATIVE or IPPE where the best is not credible.

    As for single markers: IPPE is not finite for a fifth of the boards that face the camera
    exactly, and SQPnP has no solution of boards of a few pixels.
    """
    if ordered and ordered[0].error_px <= credible_px:
        return ordered
    for method in (cv2.SOLVEPNP_ITERATIVE, cv2.SOLVEPNP_IPPE):
        others = _by_error(
            guarded_poses(objects, pixels, one.cameras, method), objects, pixels, one.cameras
        )
        if others and not (
            ordered and ordered[0].error_px <= CREDIBLE_RATIO * others[0].error_px
        ):
            ordered = others
    return ordered
