"""Truth by a board: the pose of each marker, from all corners of the board but its own.

Its covariance is that of least squares with the residuals' variance, and is raised where the
poses of two halves of the corners differ by more than it says: neighbouring residuals are not
independent. An error of the camera's numbers is in it as far as the marker's own corners do not
lead to the same change of the pose: what truth and estimates share is no error of either against
the other. A bent board is not in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sweep.measure.accuracy import rotation_difference
from sweep.measure.flags import TruthSource
from sweep.model.board import Board
from sweep.model.pose import rotation_of_vector
from sweep.photographs.corners import FoundCorners, own_corners
from sweep.photographs.pose_fit import FittedPose, Lens, fit_pose
from sweep.photographs.poses import Poses
from sweep.typing import Floats

MIN_CORNERS = 6
"""Corners of a board from which its pose is taken for known, beside those of the marker."""

MIN_HALF = 5
"""Corners in each of two halves whose poses are compared."""

Z_IN = np.diag([1.0, -1.0, -1.0])
"""Takes points of a board to a frame with z away from the viewer, where IPPE is stable."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardPoses:
    """The poses of a board's M markers in P photographs.

    Attributes
    ----------
    poses
        Of the markers that are wholly in the photograph.
    boards
        The board's own pose in each photograph; None where too few corners were found.
    halves_ratio
        Root mean square of the differences between the poses of two halves of the corners, over
        what the residuals' variance predicts; NaN if no photograph has corners enough.
    """

    poses: Poses
    boards: tuple[FittedPose | None, ...]
    halves_ratio: float


def board_poses(
    board: Board, lens: Lens, size: tuple[int, int], found: Sequence[FoundCorners],
    camera_covariance: Floats | None = None,
) -> BoardPoses:
    """Return the poses of a board's markers in photographs.

    Parameters
    ----------
    board, lens
        The board and the camera.
    size
        Width and height of the photographs in px.
    found
        The board's corners in each photograph.
    camera_covariance
        (c, c) of fx, fy, cx, cy and the coefficients; None if it is not known.
    """
    boards = tuple(fitted_board(lens, each) for each in found)
    ratio = _halves_ratio(lens, boards, found)
    raised = max(1.0, ratio) if np.isfinite(ratio) else 1.0
    own, frames = own_corners(board), marker_frames(board)
    poses = Poses.none(len(found), len(board))
    for photograph, (pose, corners) in enumerate(zip(boards, found, strict=True)):
        if pose is None:
            continue
        shown = markers_within(board, lens, size, pose)
        for k in np.flatnonzero(shown).tolist():
            without = pose.used & ~np.isin(corners.number, list(own[k]))
            if without.sum() < MIN_CORNERS:
                continue
            axes, centre = frames[k]
            fitted = fit_pose(
                lens, (corners.points - centre) @ axes, corners.pixels, pose.rotation @ axes,
                pose.rotation @ centre + pose.translation, without,
            )
            if fitted is None:
                continue
            variance = raised**2 * np.diag(fitted.covariance)
            if camera_covariance is not None:
                variance = variance + unshared_variance(
                    lens, camera_covariance, fitted, (corners.points[without] - centre) @ axes,
                    (board.corners_m[k] - centre) @ axes,
                )
            poses.put(photograph, k, fitted.rotation, fitted.translation, np.sqrt(variance),
                      TruthSource.board_without_this_marker)
    return BoardPoses(poses, boards, ratio)


def unshared_variance(
    lens: Lens, camera_covariance: Floats, pose: FittedPose, points: Floats, own: Floats
) -> Floats:
    """Return the variances (6,) of a pose by errors of the camera that the estimates do not share.

    To first order a pose by least squares from the marker's ``own`` corners (4, 3) changes by
    another amount than that from the board's ``points`` (n, 3): the difference counts.
    """
    change = (
        lens.by_camera(own, pose.rotation, pose.translation)
        - lens.by_camera(points, pose.rotation, pose.translation)
    )
    return np.asarray(np.diag(change @ camera_covariance @ change.T))


def fitted_board(lens: Lens, found: FoundCorners) -> FittedPose | None:
    """Return a board's pose; None with too few corners."""
    if len(found.points) < MIN_CORNERS:
        return None
    points = np.ascontiguousarray(found.points @ Z_IN)
    pixels = np.ascontiguousarray(found.pixels)
    starts = []
    for method in (cv2.SOLVEPNP_ITERATIVE, cv2.SOLVEPNP_IPPE):
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(
                points, pixels, lens.matrix, lens.distortion, flags=method
            )
        except cv2.error:
            continue
        starts += [
            (
                rotation_of_vector(np.asarray(rotation, dtype=np.float64).reshape(1, 3))[0] @ Z_IN,
                np.asarray(translation, dtype=np.float64).ravel(),
            )
            for rotation, translation in zip(rotations, translations, strict=True)
            if np.isfinite(rotation).all() and np.asarray(translation).ravel()[2] > 0
        ]
    fits = [fit_pose(lens, found.points, found.pixels, *start) for start in starts]
    good = [fit for fit in fits if fit is not None and fit.used.sum() >= MIN_CORNERS]
    if not good:
        return None
    return min(good, key=lambda fit: float(np.median((fit.residuals**2).sum(axis=1))))


def marker_frames(board: Board) -> list[tuple[Floats, Floats]]:
    """Return the axes (3, 3) and the centre (3,) of each marker in its board's frame."""
    frames = []
    for top_left, top_right, bottom_right, bottom_left in board.corners_m:
        right = top_right - top_left
        up = top_left - bottom_left
        x, y = right / np.linalg.norm(right), up / np.linalg.norm(up)
        centre = (top_left + top_right + bottom_right + bottom_left) / 4
        frames.append((np.column_stack([x, y, np.cross(x, y)]), centre))
    return frames


def markers_within(
    board: Board, lens: Lens, size: tuple[int, int], pose: FittedPose
) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return which markers (M,) of a board are wholly in the frame."""
    points = board.corners_m.reshape(-1, 3)
    depth = (points @ pose.rotation.T + pose.translation)[:, 2]
    pixels = lens.project(points, pose.rotation, pose.translation)
    limit = np.array(size) - 0.5
    inside = (depth > 0) & ((pixels >= -0.5) & (pixels <= limit)).all(axis=1)
    return np.asarray(inside.reshape(len(board), 4).all(axis=1))


def _halves_ratio(
    lens: Lens, boards: Sequence[FittedPose | None], found: Sequence[FoundCorners]
) -> float:
    """Return how far the poses of two halves differ, in predicted standard deviations."""
    squares = []
    for pose, corners in zip(boards, found, strict=True):
        if pose is None:
            continue
        # Every other corner of a chessboard's row, every other marker of a grid.
        first = (corners.number // (1 if _is_dense(corners) else 4)) % 2 == 0
        centre = corners.points.mean(axis=0)
        halves = [
            fit_pose(lens, corners.points - centre, corners.pixels, pose.rotation,
                     pose.rotation @ centre + pose.translation, half & pose.used)
            if (half & pose.used).sum() >= MIN_HALF else None
            for half in (first, ~first)
        ]
        one, other = halves
        if one is None or other is None:
            continue
        turn = rotation_difference(one.rotation[None], other.rotation[None])[0]
        difference = np.concatenate([turn, one.translation - other.translation])
        covariance = one.covariance + other.covariance
        squares.append(float(difference @ np.linalg.solve(covariance, difference)) / 6)
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")


def _is_dense(corners: FoundCorners) -> bool:
    """Return whether the corners are a chessboard's: their numbers are not four a marker."""
    return not np.array_equal(corners.number, (4 * corners.marker[:, None] + np.arange(4)).ravel())
