"""Pose from pixels: maximum likelihood with the exact image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from sweep.compilation import compiled
from sweep.measure.estimation import Detections, Estimates, covariance_elsewhere
from sweep.measure.flags import EstimateStatus
from sweep.measure.likelihood import (
    BACKGROUND_MARGIN_PX,
    DEPTH,
    MIN_NOISE,
    NEARLY_SETTLED,
    POSITION,
    SETTLED,
    SPREAD,
    STATE_LENGTH,
    MarkerView,
    binned,
    binned_view,
    fit,
    is_before_camera,
    marker_view,
    middle_m,
    mirrored_state,
    noise_variance,
    overwrite,
    pose_covariance,
    rotation_of,
    squares,
    state_of,
    turn_between,
)
from sweep.measure.solver import (
    MIN_POINTS,
    Pose,
    both_planar_solutions,
    guarded_poses,
    one_by_one,
    poses_of_each_marker,
    reprojection_errors_px,
    reprojection_px,
)
from sweep.model.derivatives import LEVELS, POSE, known_pixels, work_space
from sweep.model.marker import module_count
from sweep.model.pose import transform_points
from sweep.model.printed import box_corners, extent_of, unit_m
from sweep.typing import Floats, Grey

# --------------------------------------------------------------------------------------------------
# Pose from pixels: maximum likelihood with the exact image, started from the detector's corners.
#
# The chi-square of a small image has several minima: the two planar solutions, and poses with
# edges on wrong pixels. So there are several starts. Each is first fitted to the means of 2 x 2
# pixels, for which the exact model holds as well and whose minima are wider. Starts that end far
# above the best are dropped, the others are fitted to the pixels; the best is compared with the
# minimum that is reached from its mirror. If none explains the pixels, the starts are fitted to
# them directly.

COARSE_STEPS = 15
FINE_STEPS = 30

HOPELESS = 100.0
"""Excess of chi-square over the best coarse fit's above which a start is abandoned."""

SAME_TURN_RAD = 1e-3
"""Coarse fits whose rotations differ by less than this are the same."""

LIKELY_SPREAD_PX = 0.5
"""Smallest start of an estimated point spread: 0 is a minimum of its own."""

EXCESS = 5.0
"""Deviation of the residuals' variance, in its standard deviations, above which the model does not
explain the pixels."""


@compiled
def least(values: Floats) -> float:
    """Return the least of some values; NaN if one is NaN."""
    lowest = values[0]
    for value in values:
        if not value >= lowest:
            lowest = value
        if math.isnan(lowest):
            break
    return float(lowest)


@compiled
def is_settled(chi_square: Floats, states: Floats, k: int) -> bool:
    """Return whether the k-th coarse fit is hopeless, or the same as an earlier one."""
    most = least(chi_square) + HOPELESS
    if not chi_square[k] < most:
        return True
    for m in range(k):
        same = turn_between(states[k], states[m]) < SAME_TURN_RAD
        if same and chi_square[m] < most:
            return True
    return False


@compiled
def locate(
    image: Floats, starts: Floats, view: MarkerView, spread_free: bool, information: Floats
) -> tuple[Floats, float, bool, Floats, float]:
    """Return the most likely pose, and the next minimum.

    Parameters
    ----------
    image
        (height, width) grey levels; pixels that are NaN are left out.
    starts
        (K, 16) states; those behind the camera are skipped.
    view
        The image's known parameters.
    spread_free
        Whether the point spread is estimated.
    information
        Overwritten, as by :func:`sweep.measure.likelihood.fit`.

    Returns
    -------
    tuple
        The state (16,), its chi-square, whether it is a maximum of the likelihood, and state and
        chi-square of the next best minimum; NaN if there is none.
    """
    count, free = len(starts), len(information)
    coarse, coarse_view = binned(image), binned_view(view)
    coarse_work = work_space(coarse.shape[0], coarse.shape[1])
    coarse_total = squares(coarse)
    states = starts.copy()
    trial_information = np.empty((free, free))

    def coarse_fit(state: Floats, worth: float) -> float:
        """Fit a state to the means of 2 x 2 pixels, whose point spread is half as wide."""
        state[SPREAD] *= 0.5
        level, _ = fit(
            coarse, coarse_total, state, coarse_view, coarse_work, spread_free, COARSE_STEPS,
            NEARLY_SETTLED, worth, trial_information,
        )
        state[SPREAD] *= 2.0
        return level

    chi_square = np.full(count, math.inf)
    for k in range(count):
        if is_before_camera(states[k], view):
            chi_square[k] = coarse_fit(states[k], least(chi_square) + HOPELESS)
    work = work_space(image.shape[0], image.shape[1])
    total, count_px = squares(image), known_pixels(image)
    best, other = np.full(STATE_LENGTH, math.nan), np.full(STATE_LENGTH, math.nan)
    lowest = next_lowest = math.inf
    reached = False
    freedom = count_px - free - LEVELS
    likely = freedom + EXCESS * math.sqrt(2.0 * freedom)
    for k in range(2 * count + 1):
        worth = lowest + HOPELESS
        if k < count:
            if is_settled(chi_square, states, k):
                continue
            state = states[k].copy()
        elif k == count:
            state = mirrored_state(best)
            if not is_before_camera(state, view):
                continue
            # Not worth a fit if it was reached before, or if the coarse pixels rule it out.
            away = turn_between(state, best)
            if turn_between(state, other) < 0.5 * away:
                continue
            tried, most = state.copy(), least(chi_square) + HOPELESS
            if not coarse_fit(tried, most) < most:
                continue
            if turn_between(tried, best) > 0.5 * away:
                state = tried
        else:
            # The coarse fits misled all starts, or the model is wrong.
            if lowest <= likely:
                break
            state, worth = starts[k - count - 1].copy(), math.inf
        if not is_before_camera(state, view):
            continue
        level, converged = fit(
            image, total, state, view, work, spread_free, FINE_STEPS, SETTLED,
            worth, trial_information,
        )
        same = turn_between(state, best) < SAME_TURN_RAD
        if level < lowest:
            if not same:
                overwrite(other, best)
                next_lowest = lowest
            overwrite(best, state)
            lowest, reached = level, converged
            for m in range(free):
                overwrite(information[m], trial_information[m])
        elif not same and level < next_lowest:
            overwrite(other, state)
            next_lowest = level
    return best, lowest, reached, other, next_lowest


def explains(chi_square: float, freedom: int, noise_grey: float) -> bool:
    """Return whether residuals of an expected chi-square ``freedom`` are those of the noise.

    Within :data:`EXCESS` standard deviations, sqrt(2 · freedom). Without noise the residuals are
    those of rounding, which are smaller if the levels are whole numbers: only an excess counts.
    """
    deviation = (chi_square / freedom - 1.0) * math.sqrt(freedom / 2.0)
    return abs(deviation) <= EXCESS if noise_grey >= MIN_NOISE else deviation <= EXCESS


def start_states(
    rotation: Floats, translation: Floats, spread_px: float, spread_free: bool
) -> Floats:
    """Return the states (K, 16) of the finite ones of M poses (M, 3, 3), (M, 3)."""
    spread = max(spread_px, LIKELY_SPREAD_PX) if spread_free else spread_px
    none = np.zeros(LEVELS)
    states = np.array(
        [state_of(*pose, spread, none) for pose in zip(rotation, translation, strict=True)]
    )
    return np.asarray(states[np.isfinite(states).all(axis=1)])


def write_most_likely(
    image: Floats, starts: Floats, view: MarkerView, spread_free: bool, noise_grey: float,
    out: Estimates, i: int,
) -> tuple[Floats, Floats] | None:
    """Write the most likely pose of an image as estimate ``i``, but for reprojection errors.

    Arguments as :func:`locate` and :func:`explains` take them. Returns the state (16,) and that of
    the next minimum, NaN if there is none; None if no pose was written.
    """
    free = POSE + 1 if spread_free else POSE
    information = np.empty((free, free))
    state, chi_square, reached, other, _ = locate(image, starts, view, spread_free, information)
    freedom = known_pixels(image) - free - LEVELS
    if not math.isfinite(chi_square) or freedom < 1:
        return None
    if not reached:
        out.status[i] = EstimateStatus.not_converged
        return None
    out.status[i] = (
        EstimateStatus.solved if explains(chi_square, freedom, noise_grey)
        else EstimateStatus.not_explained
    )
    out.rotation[i], out.translation[i] = rotation_of(state), state[POSITION]
    out.alternative_rotation[i] = rotation_of(other)
    covariance, exists = pose_covariance(information, view.variance, abs(state[DEPTH]))
    if exists:
        out.covariance[i] = covariance
    out.residual_ratio[i] = chi_square / freedom
    return state, other


@dataclass(frozen=True, slots=True)
class Photometric:
    """Maximum likelihood on the pixels as a pose estimator.

    Attributes
    ----------
    refined
        Whether it also starts from both planar solutions of the corners after
        ``cv2.cornerSubPix``, beside those of the corners as detected.
    spread_free
        Whether the point spread is estimated.
    """

    refined: bool
    spread_free: bool

    @property
    def needs_images(self) -> bool:
        """Whether detections must carry their images: yes."""
        return True

    def __call__(self, detections: Detections) -> Estimates:
        """Return the poses, with covariances from the curvature of the likelihood."""
        if not detections.are_markers:
            return one_by_one(detections, self._estimate)
        count = len(detections.corners)
        out = Estimates.none(count, EstimateStatus.solver_failed)
        sets = [detections.corners]
        if self.refined:
            sets.append(refined_corners(detections))
        poses = [
            both_planar_solutions(corners, detections.cameras, detections.size_m)
            for corners in sets
        ]
        turns = np.concatenate([rotation for rotation, _ in poses], axis=1)
        shifts = np.concatenate([translation for _, translation in poses], axis=1)
        windows = _windows(detections)
        for i in range(count):
            starts = start_states(
                turns[i], shifts[i], float(detections.blur_px[i]), self.spread_free
            )
            left, top, right, bottom = windows[i]
            if not len(starts) or right - left < 2 or bottom - top < 2:
                continue
            noise = float(detections.noise_grey[i])
            view = marker_view(
                detections.targets[i], detections.size_m[i], detections.cameras.optics(i),
                detections.origins[i] + (left, top), noise_variance(noise),
            )
            image = detections.images[i][top:bottom, left:right].astype(np.float64)
            fitted = write_most_likely(image, starts, view, self.spread_free, noise, out, i)
            if fitted is not None:
                state, other = fitted
                out.alternative_reprojection_px[i] = self._reprojection_px(other, detections, i)
                out.reprojection_px[i] = self._reprojection_px(state, detections, i)
        return out

    def _estimate(self, one: Detections, i: int, out: Estimates) -> None:
        """Write the estimate of a single board as number ``i``.

        Pixels that show something beside the board are left out. The starts are poses from the
        corners of all detected markers, and that of the marker on which most of the others agree:
        one marker that is wrong spoils the former.
        """
        board, scale = one.targets[0], float(one.scale[0])
        if one.corners.size < 2 * MIN_POINTS:
            out.status[i] = EstimateStatus.too_few_points
            return
        sets = [one.corners]
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
        points, pixels = one.objects_m.reshape(-1, 3), one.corners.reshape(-1, 2)
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

    @staticmethod
    def _reprojection_px(state: Floats, detections: Detections, i: int) -> float:
        """Return the RMS reprojection error of a state over the corners of one detection."""
        row = np.array([i])
        return float(
            reprojection_errors_px(
                rotation_of(state)[None], state[None, POSITION], detections.size_m[row],
                detections.corners[row], detections.cameras.take(row),
            )[0]
        )


def _windows(detections: Detections) -> list[list[int]]:
    """Return the part of each image that is fitted: left, top, right, bottom of the quiet zone.

    A share of the corners' extent as wide as the quiet zone, and half of that for perspective.
    """
    low, high = detections.corners.min(axis=1), detections.corners.max(axis=1)
    extents = [extent_of(target) for target in detections.targets]
    share = np.array([-1.5 * each.sheet[0] / each.modules for each in extents])
    margin = BACKGROUND_MARGIN_PX + share[:, None] * (high - low)
    sizes = np.array([image.shape[::-1] for image in detections.images]).reshape(-1, 2)
    low = np.clip(np.floor(low - margin) - detections.origins, 0, sizes)
    high = np.clip(np.ceil(high + margin) + 1 - detections.origins, 0, sizes)
    windows: list[list[int]] = np.concatenate([low, high], axis=1).astype(np.int64).tolist()
    return windows


def refined_corners(detections: Detections) -> Floats:
    """Return the corners (N, 4, 2) after ``cv2.cornerSubPix``, its window OpenCV's for markers."""
    refined = detections.corners.copy()
    for i, image in enumerate(detections.images):
        moved = refined_quad(
            image, detections.corners[i] - detections.origins[i],
            extent_of(detections.targets[i]).modules,
        )
        if moved is not None:
            refined[i] = moved + detections.origins[i]
    return refined


def refined_quad(image: Grey, corners: Floats, modules: float) -> Floats | None:
    """As :func:`refined_corners`, of corners (4, 2) in pixels of the image; None if one is not."""
    if not ((corners >= 0) & (corners <= np.array(image.shape[::-1]) - 1)).all():
        return None
    side = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
    half = min(5, max(1, round(0.3 * (side / modules))))
    moved = cv2.cornerSubPix(
        image, np.ascontiguousarray(corners[:, None], dtype=np.float32), (half, half),
        (-1, -1), (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 30, 0.1),
    )
    return np.asarray(moved[:, 0], dtype=np.float64)


def _starts(one: Detections, corners_px: Floats) -> list[Pose]:
    """Return poses from corners (K, 4, 2): of all together, and the one that fits most markers."""
    objects = one.objects_m
    points, pixels = objects.reshape(-1, 3), corners_px.reshape(-1, 2)
    poses = [
        pose for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_ITERATIVE)
        for pose in guarded_poses(points, pixels, one.cameras, method)
    ]
    if len(corners_px) > 1:
        each = poses_of_each_marker(points, pixels, one.cameras)
        away = [_typical_error_px(pose, one, objects, corners_px) for pose in each]
        poses += [each[k] for k in np.argsort(away)[:1].tolist() if math.isfinite(away[k])]
    return poses


def _typical_error_px(
    pose: Pose, one: Detections, objects: Floats, corners_px: Floats
) -> float:
    """Return the median of K markers' reprojection errors; NaN becomes infinite."""
    errors = [
        reprojection_px(*pose, corners, pixels, one.cameras)
        for corners, pixels in zip(objects, corners_px, strict=True)
    ]
    return float(np.median(np.nan_to_num(errors, nan=math.inf)))


def _refined(one: Detections) -> Floats:
    """Return the markers' corners (K, 4, 2) after ``cv2.cornerSubPix``."""
    modules, corners_px = module_count(one.targets[0].dictionary), one.corners
    refined = [
        refined_quad(one.images[0], corners - one.origins[0], modules) for corners in corners_px
    ]
    return np.array(
        [corners if moved is None else moved + one.origins[0]
         for corners, moved in zip(corners_px, refined, strict=True)]
    )


def _window(one: Detections, poses: list[Pose]) -> list[int]:
    """Return what is fitted of the image: left, top, right, bottom around the sheet in any pose."""
    board = one.targets[0]
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
