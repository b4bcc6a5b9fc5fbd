"""Pose of a marker or a board from pixels: by the exact image, or by a photograph's model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sweep.measure import likelihood
from sweep.measure.estimation import Detections, Estimates, covariance_elsewhere, pose_covariance
from sweep.measure.flags import EstimateStatus
from sweep.measure.likelihood import BLACK, DEPTH, POSITION, WHITE
from sweep.measure.photograph import SIZE, locate_photograph, photograph_view, pixel_count
from sweep.measure.solver import (
    MIN_POINTS,
    GuardedPoints,
    Pose,
    both_planar_solutions,
    poses_of_each_marker,
    reprojection_px,
)
from sweep.model.board import box_corners, extent_of, own_sheets, sheets_m, unit_m
from sweep.model.coverage import LEVELS, POSE
from sweep.model.marker import module_count
from sweep.model.pose import transform_points
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# First poses of one target, marker or board, and the part of the image that is fitted.

def marker_poses(detections: Detections, *, refined: bool) -> list[list[Pose]]:
    """Return both planar solutions of each marker's corners, then of its refined corners."""
    found = [detections.corners, *([refined_corners(detections)] if refined else [])]
    solved = [
        both_planar_solutions(corners, detections.cameras, detections.size_m) for corners in found
    ] if len(detections) else []
    return [
        [(rotation[i, k], translation[i, k]) for rotation, translation in solved for k in range(2)]
        for i in range(len(detections))
    ]


def board_poses(one: Detections, *, refined: bool) -> list[Pose]:
    """Return poses of a board from its corners, and from those after ``cv2.cornerSubPix``.

    The poses from the corners of all markers, and that of the marker on which most of the others
    agree: one marker that is wrong spoils the former.
    """
    poses: list[Pose] = []
    points = one.objects_m.reshape(-1, 3)
    for corners in (one.corners, refined_corners(one)) if refined else (one.corners,):
        pixels = corners.reshape(-1, 2)
        guard = GuardedPoints.of(points, pixels, one.cameras)
        poses += guard.poses(cv2.SOLVEPNP_IPPE) + guard.poses(cv2.SOLVEPNP_ITERATIVE)
        if len(corners) > 1:
            each = poses_of_each_marker(points, pixels, one.cameras)
            away = [_typical_error_px(pose, one, corners) for pose in each]
            poses += [each[k] for k in np.argsort(away)[:1].tolist() if math.isfinite(away[k])]
    return poses


def _typical_error_px(pose: Pose, one: Detections, corners: Floats) -> float:
    """Return the median of the markers' reprojection errors; NaN becomes infinite."""
    errors = [
        reprojection_px(*pose, objects, pixels, one.cameras)
        for objects, pixels in zip(one.objects_m, corners, strict=True)
    ]
    return float(np.median(np.nan_to_num(errors, nan=math.inf)))


def refined_corners(detections: Detections) -> Floats:
    """Return the corners (K, 4, 2) after ``cv2.cornerSubPix``, its window OpenCV's for markers."""
    refined = detections.corners.copy()
    for k, i in enumerate(detections.owner.tolist()):
        image, origin = detections.images[i], detections.origins[i]
        corners = refined[k] - origin
        if ((corners >= 0) & (corners <= np.array(image.shape[::-1]) - 1)).all():
            modules = module_count(detections.targets[i].dictionary)
            side = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
            half = min(5, max(1, round(0.3 * (side / modules))))
            moved = cv2.cornerSubPix(
                image, np.ascontiguousarray(corners[:, None], dtype=np.float32), (half, half),
                (-1, -1), (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 30, 0.1),
            )
            refined[k] = np.asarray(moved[:, 0], dtype=np.float64) + origin
    return refined


def start_states(poses: list[Pose], middle: Floats, spread_px: float) -> Floats:
    """Return the states (K, 18) of a target's middle at the finite ones of some poses."""
    levels = np.zeros(LEVELS)
    states = [
        likelihood.state_of(rotation, translation + rotation @ middle, spread_px, levels)
        for rotation, translation in poses
    ]
    return np.array([each for each in states if np.isfinite(each).all()])


def first_side_m(one: Detections) -> float:
    """Return the assumed side of a target's first marker."""
    target = one.targets[0]
    if target.is_marker:
        return float(one.size_m[0])
    return float(one.scale[0]) * unit_m(target) * module_count(target.dictionary)


def window_of(one: Detections, poses: list[Pose]) -> list[int]:
    """Return the fitted part of the image: left, top, right, bottom.

    Of a marker its quiet zone, as a share of the corners' extent, and half of that for perspective;
    of a board its sheet in any of the poses.
    """
    (target,), (image,), (origin,) = one.targets, one.images, one.origins
    modules = module_count(target.dictionary)
    if target.is_marker:
        low, high = one.corners[0].min(axis=0), one.corners[0].max(axis=0)
        share = 1.5 * (target.margin or 0.0) / modules
        margin = likelihood.BACKGROUND_MARGIN_PX + share * (high - low)
        low, high = low - margin, high + margin
    else:
        scale = first_side_m(one) / modules
        sheet = (
            box_corners(extent_of(target).target[None]) * scale if target.is_planar
            else sheets_m(target)[: own_sheets(target)].reshape(1, -1, 3)
            * (scale / unit_m(target))
        )
        pixels = np.concatenate([
            one.cameras.project(transform_points(sheet, rotation[None], translation[None]))[0]
            for rotation, translation in poses
        ])
        if not np.isfinite(pixels).any():
            return [0, 0, 0, 0]
        low = np.nanmin(pixels, axis=0) - likelihood.BACKGROUND_MARGIN_PX
        high = np.nanmax(pixels, axis=0) + likelihood.BACKGROUND_MARGIN_PX
    size = np.array(image.shape[::-1])
    window: list[int] = np.concatenate([
        np.clip(np.floor(low) - origin, 0, size),
        np.clip(np.ceil(high) + 1 - origin, 0, size),
    ]).astype(np.int64).tolist()
    return window


# --------------------------------------------------------------------------------------------------
# The estimators.

#: Smallest start of an estimated point spread: 0 is a minimum of its own.
LIKELY_SPREAD_PX = 0.5

#: Point spread at which fits of photographs start.
FIRST_SPREAD_PX = 0.7

#: Difference of white and black in grey levels below which there is no marker in the pixels.
MIN_CONTRAST = 1.0

#: Standard deviation of the shifts of the marker's parts above which a pose is not explained.
MAX_MISFIT_PX = 0.5


@dataclass(frozen=True, slots=True)
class Photometric:
    """Maximum likelihood on the pixels as a pose estimator of markers and boards.

    Attributes
    ----------
    refined
        Whether it also starts from poses of the corners after ``cv2.cornerSubPix``, beside those of
        the corners as detected.
    spread_free
        Whether the point spread is estimated.
    """

    refined: bool
    spread_free: bool

    def __call__(self, detections: Detections) -> Estimates:
        """Return the poses, with their covariances."""
        out = Estimates.none(len(detections), EstimateStatus.solver_failed)
        other_translation = np.full((len(detections), 3), np.nan)
        markers = detections.targets.are_markers
        planar = marker_poses(detections, refined=self.refined) if markers else []
        for i in range(len(detections)):
            one = detections.take(np.array([i]))
            if one.corners.size < 2 * MIN_POINTS:
                out.status[i] = EstimateStatus.too_few_points
                continue
            poses = planar[i] if markers else board_poses(one, refined=self.refined)
            middle = float(one.scale[0]) * likelihood.middle_m(one.targets[0])
            states = self._fitted(one, poses, middle, out, i) if poses else None
            if states is None:
                continue
            (rotation, position), (turned, moved) = (
                (likelihood.rotation_of(state), state[POSITION]) for state in states
            )
            out.rotation[i], out.translation[i] = rotation, position
            out.alternative_rotation[i], other_translation[i] = turned, moved - turned @ middle
            out.point_count[i] = one.corners.size // 2
            arm = -rotation @ middle
            if arm.any():
                out.translation[i] += arm
                out.covariance[i] = covariance_elsewhere(out.covariance[i], arm)
        out.reprojection_px[:] = detections.reprojection_px(out.rotation, out.translation)
        out.alternative_reprojection_px[:] = detections.reprojection_px(
            out.alternative_rotation, other_translation)
        return out

    def _fitted(
        self, one: Detections, poses: list[Pose], middle: Floats, out: Estimates, i: int
    ) -> tuple[Floats, Floats] | None:
        """Write all but poses of an estimate; return the states of the best and next minimum.

        Returns None if there is no pose. ``middle`` (3,) is what states are the pose of.
        """
        noise_grey, blur_px = float(one.noise_grey[0]), float(one.blur_px[0])
        spread = max(blur_px, LIKELY_SPREAD_PX) if self.spread_free else blur_px
        starts = start_states(poses, middle, spread)
        left, top, right, bottom = window_of(one, poses)
        if not len(starts) or right - left < 2 or bottom - top < 2:
            return None
        image = one.images[0][top:bottom, left:right].astype(np.float64)
        if len(one.beside):
            image[one.beside[0][top:bottom, left:right]] = np.nan
        free = POSE + 1 if self.spread_free else POSE
        information = np.empty((free, free))

        def seen_from(pose: Pose) -> likelihood.MarkerView:
            return likelihood.marker_view(
                one.targets[0], first_side_m(one), one.cameras.optics(0),
                one.origins[0] + np.array([left, top]), likelihood.noise_variance(noise_grey), pose,
            )

        view = seen_from(poses[0])
        state, level, reached, other, freedom = (
            likelihood.locate_exactly(image, starts, view, information) if one.targets[0].is_planar
            else likelihood.locate_in_sight(image, starts, view, seen_from, information)
        )
        if not math.isfinite(level) or freedom < 1:
            return None
        if not reached:
            out.status[i] = EstimateStatus.not_converged
            return None
        chi_square = level / view.variance
        out.status[i] = (
            EstimateStatus.solved if likelihood.explains(chi_square, freedom, noise_grey)
            else EstimateStatus.not_explained
        )
        covariance, exists = pose_covariance(information, view.variance, abs(state[DEPTH]))
        if exists:
            out.covariance[i] = covariance
        out.residual_ratio[i] = chi_square / freedom
        return state, other


@dataclass(frozen=True, slots=True)
class PhotometricReal(Photometric):
    """Least squares on the pixels of photographs of markers as a pose estimator.

    Attributes
    ----------
    tone
        Whether the tone curve is estimated.
    """

    tone: bool

    def _fitted(
        self, one: Detections, poses: list[Pose], middle: Floats, out: Estimates, i: int
    ) -> tuple[Floats, Floats] | None:
        # The first of the two planar solutions of each set of corners: the other one is its mirror.
        starts = start_states(poses[::2], middle, FIRST_SPREAD_PX)
        view = photograph_view(
            one.targets[0], one.on_board[0] if one.on_board else None, float(one.size_m[0]),
            one.corners[0], one.cameras.optics(0), one.images[0], one.origins[0], self.tone,
        ) if len(starts) and one.targets.are_markers else None
        if view is None or pixel_count(view) <= SIZE:
            return None
        covariance = np.empty((POSE, POSE))
        state, level, reached, other, freedom, misfit = locate_photograph(view, starts, covariance)
        if not math.isfinite(level):
            return None
        if not reached:
            out.status[i] = EstimateStatus.not_converged
            return None
        largest = math.inf if math.isnan(misfit) else covariance.diagonal()[:3].max()
        if abs(state[WHITE] - state[BLACK]) < MIN_CONTRAST or not largest < math.pi**2:
            return None
        out.status[i] = (
            EstimateStatus.not_explained if misfit > MAX_MISFIT_PX else EstimateStatus.solved
        )
        out.covariance[i], out.misfit_px[i] = covariance, misfit
        noise = likelihood.noise_variance(float(one.noise_grey[0]))
        out.residual_ratio[i] = level / (noise * freedom)
        return state, other
