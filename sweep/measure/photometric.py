"""Pose of a marker or a board from pixels: by the exact image, or by a photograph's model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sweep.measure import likelihood, solver
from sweep.measure.estimation import Detections, Estimates, covariance_elsewhere, pose_covariance
from sweep.measure.flags import Ambiguous, EstimateStatus
from sweep.measure.likelihood import BLACK, DEPTH, POSITION, WHITE
from sweep.measure.photograph import locate_photograph, log_odds, photograph_view
from sweep.model.board import box_corners, extent_of, own_sheets, sheets_m, unit_m
from sweep.model.coverage import POSE
from sweep.model.marker import module_count
from sweep.model.pose import transform_points
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# First poses of one target, marker or board, and the part of the image that is fitted.

def marker_poses(detections: Detections, *, refined: bool) -> tuple[Floats, Floats]:
    """Return both planar solutions of each marker's corners, then of its refined corners.

    Rotations (N, K, 3, 3) and translations (N, K, 3); K is 2 or 4.
    """
    found = [detections.corners, *([refined_corners(detections)] if refined else [])]
    solved = [
        solver.both_planar_solutions(quads, detections.cameras, detections.size_m)
        for quads in found
    ]
    rotations, translations = zip(*solved, strict=True)
    return np.concatenate(rotations, axis=1), np.concatenate(translations, axis=1)


def board_poses(one: Detections, *, refined: bool) -> tuple[Floats, Floats]:
    """Return poses of a board from its corners, and from those after ``cv2.cornerSubPix``.

    Rotations (K, 3, 3) and translations (K, 3). The poses from the corners of all markers, and that
    of the marker on which most of the others agree: one marker that is wrong spoils the former.
    """
    poses: list[solver.Pose] = []
    points = one.objects_m.reshape(-1, 3)
    for corners in (one.corners, refined_corners(one)) if refined else (one.corners,):
        pixels = corners.reshape(-1, 2)
        guard = solver.GuardedPoints.of(points, pixels, one.cameras)
        poses += guard.poses(cv2.SOLVEPNP_IPPE) + guard.poses(cv2.SOLVEPNP_ITERATIVE)
        if len(corners) > 1:
            each = solver.poses_of_each_marker(points, pixels, one.cameras)
            away = [_typical_error_px(pose, one, corners) for pose in each]
            poses += [each[k] for k in np.argsort(away)[:1].tolist() if math.isfinite(away[k])]
    rotations, translations = zip(*poses, strict=True) if poses else ((), ())
    return np.reshape(rotations, (-1, 3, 3)), np.reshape(translations, (-1, 3))


def _typical_error_px(pose: solver.Pose, one: Detections, corners: Floats) -> float:
    """Return the median of the markers' reprojection errors; NaN becomes infinite."""
    errors = [
        solver.reprojection_px(*pose, objects, pixels, one.cameras)
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


def start_states(poses: tuple[Floats, Floats], middle: Floats, spread_px: float) -> Floats:
    """Return the states (K, 18) of a target's middle at the finite ones of some poses."""
    rotations, translations = poses
    states = np.zeros((len(rotations), likelihood.STATE_LENGTH))
    states[:, likelihood.ROTATION] = rotations.reshape(-1, 9)
    states[:, POSITION] = translations + rotations @ middle
    states[:, likelihood.SPREAD] = spread_px
    return states[np.isfinite(states).all(axis=1)]


def first_side_m(detections: Detections, row: int) -> float:
    """Return the assumed side of a target's first marker."""
    target = detections.targets[row]
    if target.is_marker:
        return float(detections.size_m[row])
    return float(detections.scale[row]) * unit_m(target) * module_count(target.dictionary)


def window_of(detections: Detections, row: int, poses: tuple[Floats, Floats]) -> list[int]:
    """Return the fitted part of a target's image: left, top, right, bottom.

    Of a marker its quiet zone, as a share of the corners' extent, and half of that for perspective;
    of a board its sheet in any of the poses (K, 3, 3), (K, 3).
    """
    target = detections.targets[row]
    modules = module_count(target.dictionary)
    margin = likelihood.BACKGROUND_MARGIN_PX
    if target.is_marker:
        low, high = detections.corners[row].min(axis=0), detections.corners[row].max(axis=0)
        margin = margin + 1.5 * (target.margin or 0.0) / modules * (high - low)
    else:
        scale = first_side_m(detections, row) / modules
        sheet = (
            box_corners(extent_of(target).target[None]) * scale if target.is_planar
            else sheets_m(target)[: own_sheets(target)].reshape(1, -1, 3)
            * (scale / unit_m(target))
        )
        camera = detections.cameras.take(np.array([row]))
        pixels = np.concatenate([
            camera.project(transform_points(sheet, rotation[None], translation[None]))[0]
            for rotation, translation in zip(*poses, strict=True)
        ])
        pixels = pixels[np.isfinite(pixels).all(axis=1)]
        if not len(pixels):
            return [0, 0, 0, 0]
        low, high = pixels.min(axis=0), pixels.max(axis=0)
    height, width = detections.images[row].shape
    origin = detections.origins[row]
    left, top = (low - margin - origin).tolist()
    right, bottom = (high + margin - origin).tolist()
    # Origins are whole numbers: the part begins and ends at whole pixels of the frame.
    return [
        min(max(math.floor(left), 0), width), min(max(math.floor(top), 0), height),
        min(max(math.ceil(right) + 1, 0), width), min(max(math.ceil(bottom) + 1, 0), height),
    ]


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

#: Logarithm of the odds against the other minimum up to which a pose is ambiguous. Odds of 1e5 are
#: those of normal errors; on photographs of markers of 20 px the flip of about one in 25 of those
#: that are wrong has more, and with odds of 1e2 one in six.
CLEAR_LOG_ODDS = math.log(1e5)

#: Standard deviation of a turn from which a pose is ambiguous, in radians.
CLEAR_STD_RAD = math.radians(5.0)


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
        if markers and len(detections):
            planar = marker_poses(detections, refined=self.refined)
        points = 4 * np.bincount(detections.owner, minlength=len(detections))
        for i in range(len(detections)):
            if points[i] < solver.MIN_POINTS:
                out.status[i] = EstimateStatus.too_few_points
                continue
            poses = (
                (planar[0][i], planar[1][i]) if markers
                else board_poses(detections.take(np.array([i])), refined=self.refined)
            )
            middle = float(detections.scale[i]) * likelihood.middle_m(detections.targets[i])
            states = self._fitted(detections, i, poses, middle, out)
            if states is None:
                continue
            (rotation, position), (turned, moved) = (
                (likelihood.rotation_of(state), state[POSITION]) for state in states
            )
            out.rotation[i], out.translation[i] = rotation, position
            out.alternative_rotation[i], other_translation[i] = turned, moved - turned @ middle
            out.point_count[i] = points[i]
            arm = -rotation @ middle
            if arm.any():
                out.translation[i] += arm
                out.covariance[i] = covariance_elsewhere(out.covariance[i], arm)
        out.reprojection_px[:] = detections.reprojection_px(out.rotation, out.translation)
        out.alternative_reprojection_px[:] = detections.reprojection_px(
            out.alternative_rotation, other_translation)
        return out

    def _fitted(
        self, detections: Detections, row: int, poses: tuple[Floats, Floats], middle: Floats,
        out: Estimates,
    ) -> tuple[Floats, Floats] | None:
        """Write all but poses of a row's estimate; return the states of the best and next minimum.

        Returns None if there is no pose. The fit starts at ``poses``, rotations (K, 3, 3) and
        translations (K, 3); ``middle`` (3,) is what states are the pose of.
        """
        noise_grey, blur_px = float(detections.noise_grey[row]), float(detections.blur_px[row])
        spread = max(blur_px, LIKELY_SPREAD_PX) if self.spread_free else blur_px
        starts = start_states(poses, middle, spread)
        if not len(starts):
            return None
        left, top, right, bottom = window_of(detections, row, poses)
        if right - left < 2 or bottom - top < 2:
            return None
        image = detections.images[row][top:bottom, left:right].astype(np.float64)
        if len(detections.beside):
            image[detections.beside[row][top:bottom, left:right]] = np.nan
        free = POSE + 1 if self.spread_free else POSE
        information = np.empty((free, free))
        target = detections.targets[row]

        def seen_from(pose: solver.Pose) -> likelihood.MarkerView:
            return likelihood.marker_view(
                target, first_side_m(detections, row), detections.cameras.optics(row),
                detections.origins[row] + np.array([left, top]),
                likelihood.noise_variance(noise_grey), pose,
            )

        view = seen_from((poses[0][0], poses[1][0]))
        state, level, reached, other, freedom = (
            likelihood.locate_exactly(image, starts, view, information) if target.is_planar
            else likelihood.locate_in_sight(image, starts, view, seen_from, information)
        )
        if not math.isfinite(level) or freedom < 1:
            return None
        if not reached:
            out.status[row] = EstimateStatus.not_converged
            return None
        chi_square = level / view.variance
        out.status[row] = (
            EstimateStatus.solved if likelihood.explains(chi_square, freedom, noise_grey)
            else EstimateStatus.not_explained
        )
        covariance, exists = pose_covariance(information, view.variance, abs(state[DEPTH]))
        if exists:
            out.covariance[row] = covariance
        out.residual_ratio[row] = chi_square / freedom
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
        self, detections: Detections, row: int, poses: tuple[Floats, Floats], middle: Floats,
        out: Estimates,
    ) -> tuple[Floats, Floats] | None:
        # The first of the two planar solutions of each set of corners: the other one is its mirror.
        starts = start_states((poses[0][::2], poses[1][::2]), middle, FIRST_SPREAD_PX)
        target, on_board = detections.targets[row], detections.on_board
        view = photograph_view(
            target, on_board[row] if on_board else None, float(detections.size_m[row]),
            detections.corners[row], detections.cameras.optics(row), detections.images[row],
            detections.origins[row], self.tone,
        ) if len(starts) and target.is_marker else None
        if view is None:
            return None
        covariance = np.empty((POSE, POSE))
        state, level, reached, other, freedom, misfit = locate_photograph(view, starts, covariance)
        if not math.isfinite(level):
            return None
        if not reached:
            out.status[row] = EstimateStatus.not_converged
            return None
        largest = math.inf if math.isnan(misfit) else covariance.diagonal()[:3].max()
        if abs(state[WHITE] - state[BLACK]) < MIN_CONTRAST or not largest < math.pi**2:
            return None
        out.status[row] = (
            EstimateStatus.not_explained if misfit > MAX_MISFIT_PX else EstimateStatus.solved
        )
        out.covariance[row], out.misfit_px[row] = covariance, misfit
        clear = log_odds(view, state, other) > CLEAR_LOG_ODDS and largest < CLEAR_STD_RAD**2
        out.ambiguous[row] = Ambiguous.clear if clear else Ambiguous.ambiguous
        noise = likelihood.noise_variance(float(detections.noise_grey[row]))
        out.residual_ratio[row] = level / (noise * freedom)
        return state, other
