"""Pose of a board from pixels: maximum likelihood with the exact image of all that is printed.

As :mod:`sweep.measure.photometric` has it for a marker. Pixels that show something beside the board
are left out. The starts are poses from the corners of
all detected markers, and that of the marker on which most of the others agree: one marker that is
wrong spoils the former.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sweep.measure.board_solver import (
    MIN_POINTS,
    BoardDetections,
    guarded_poses,
    one_by_one,
    poses_of_each_marker,
    reprojection_px,
)
from sweep.measure.covariance import covariance_elsewhere
from sweep.measure.estimation import Estimates
from sweep.measure.flags import EstimateStatus
from sweep.measure.likelihood import (
    BACKGROUND_MARGIN_PX,
    POSITION,
    marker_view,
    middle_m,
    noise_variance,
    rotation_of,
)
from sweep.measure.photometric import refined_quad, start_states, write_most_likely
from sweep.model.marker import module_count
from sweep.model.pose import transform_points
from sweep.model.printed import box_corners, extent_of, unit_m
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class BoardPhotometric:
    """Maximum likelihood on a board's pixels as an estimator of its pose.

    Attributes
    ----------
    refined, spread_free
        As :class:`sweep.measure.photometric.Photometric` has them.
    """

    refined: bool
    spread_free: bool

    @property
    def needs_images(self) -> bool:
        """Whether detections must carry their images: yes."""
        return True

    def __call__(self, detections: BoardDetections) -> Estimates:
        """Return the poses, with covariances from the curvature of the likelihood."""
        return one_by_one(detections, self._estimate)

    def _estimate(self, one: BoardDetections, i: int, out: Estimates) -> None:
        """Write the estimate of a single board as number ``i``."""
        board, found, scale = one.boards[0], one.points[0], float(one.scale[0])
        if found.corners_px.size < 2 * MIN_POINTS:
            out.status[i] = EstimateStatus.too_few_points
            return
        sets = [found.corners_px]
        if self.refined:
            sets.append(_refined(one))
        poses = [pose for corners in sets for pose in _starts(one, corners)]
        middle = scale * middle_m(board)
        if not poses:
            return
        starts = start_states(
            np.array([rotation for rotation, _ in poses]),
            np.array([shift + rotation @ middle for rotation, shift in poses]),
            float(one.blur_px[0]), self.spread_free,
        )
        left, top, right, bottom = _window(one, poses)
        if not len(starts) or right - left < 2 or bottom - top < 2:
            return
        noise = float(one.noise_grey[0])
        view = marker_view(
            board, scale * unit_m(board) * module_count(board.dictionary), one.cameras.optics(0),
            one.origins[0] + (left, top), noise_variance(noise),
        )
        image = one.images[0][top:bottom, left:right].astype(np.float64)
        if len(one.beside):
            image[one.beside[0][top:bottom, left:right]] = np.nan
        fitted = write_most_likely(image, starts, view, self.spread_free, noise, out, i)
        if fitted is None:
            return
        points = scale * board.corners_m[found.marker].reshape(-1, 3)
        pixels = found.corners_px.reshape(-1, 2)
        out.point_count[i] = len(pixels)
        errors = []
        for state in fitted:
            rotation = rotation_of(state)
            errors.append(reprojection_px(
                rotation, state[POSITION] - rotation @ middle, points, pixels, one.cameras
            ))
        out.reprojection_px[i], out.alternative_reprojection_px[i] = errors
        arm = -out.rotation[i] @ middle
        if arm.any():
            out.translation[i] += arm
            out.covariance[i] = covariance_elsewhere(out.covariance[i], arm)


Pose = tuple[Floats, Floats]
"""Rotation (3, 3) and translation (3,) in metres."""


def _starts(one: BoardDetections, corners_px: Floats) -> list[Pose]:
    """Return poses from corners (K, 4, 2): of all together, and the one that fits most markers."""
    objects = float(one.scale[0]) * one.boards[0].corners_m[one.points[0].marker]
    points, pixels = objects.reshape(-1, 3), corners_px.reshape(-1, 2)
    poses = [
        pose for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_ITERATIVE)
        for pose in guarded_poses(points, pixels, one.cameras, method)
    ]
    if len(corners_px) > 1:
        each = poses_of_each_marker(one, points, pixels)
        away = [_typical_error_px(pose, one, objects, corners_px) for pose in each]
        poses += [each[k] for k in np.argsort(away)[:1].tolist() if math.isfinite(away[k])]
    return poses


def _typical_error_px(
    pose: Pose, one: BoardDetections, objects: Floats, corners_px: Floats
) -> float:
    """Return the median of K markers' reprojection errors; NaN becomes infinite."""
    errors = [
        reprojection_px(*pose, corners, pixels, one.cameras)
        for corners, pixels in zip(objects, corners_px, strict=True)
    ]
    return float(np.median(np.nan_to_num(errors, nan=math.inf)))


def _refined(one: BoardDetections) -> Floats:
    """Return the markers' corners (K, 4, 2) after ``cv2.cornerSubPix``."""
    modules, corners_px = module_count(one.boards[0].dictionary), one.points[0].corners_px
    refined = [
        refined_quad(one.images[0], corners - one.origins[0], modules) for corners in corners_px
    ]
    return np.array(
        [corners if moved is None else moved + one.origins[0]
         for corners, moved in zip(corners_px, refined, strict=True)]
    )


def _window(one: BoardDetections, poses: list[Pose]) -> list[int]:
    """Return what is fitted of the image: left, top, right, bottom around the sheet in any pose."""
    board = one.boards[0]
    sheet = box_corners(extent_of(board).target[None]) * unit_m(board) * float(one.scale[0])
    size = np.array(one.images[0].shape[::-1])
    pixels = np.concatenate([
        one.cameras.project(transform_points(sheet, rotation[None], translation[None]))[0]
        for rotation, translation in poses
    ]) - one.origins[0]
    if not np.isfinite(pixels).any():
        return [0, 0, 0, 0]
    low, high = np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0)
    low = np.clip(np.floor(low - BACKGROUND_MARGIN_PX), 0, size)
    high = np.clip(np.ceil(high + BACKGROUND_MARGIN_PX) + 1, 0, size)
    window: list[int] = np.concatenate([low, high]).astype(np.int64).tolist()
    return window
