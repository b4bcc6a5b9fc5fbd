"""Pose from the pixels of a real image: what else is printed, light and camera are in the model.

Least squares on the pixels of the marker and of its own quiet zone
(:mod:`sweep.measure.photograph_fit`). Starts are both planar solutions of the detected corners;
each is first fitted to the means of 2 x 2 pixels with the levels and the point spread alone, the
best is fitted to the pixels, and so is its mirror unless the coarse fits rule it out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sweep.compilation import compiled
from sweep.measure.estimation import Detections, Estimates
from sweep.measure.flags import EstimateStatus
from sweep.measure.likelihood import (
    POSITION,
    SPREAD,
    MarkerView,
    is_before_camera,
    mirrored_state,
    noise_variance,
    overwrite,
    rotation_of,
    turn_between,
)
from sweep.measure.photograph_fit import fit_photograph
from sweep.measure.photograph_model import (
    STATE_LENGTH,
    Nuisances,
    PhotographView,
    counts,
    rays_of,
    system,
)
from sweep.measure.photograph_noise import judge
from sweep.measure.photometric import refined_corners
from sweep.measure.solver import both_planar_solutions, reprojection_errors_px
from sweep.measure.surroundings import clear_modules, edges_alone, surroundings
from sweep.model.marker import OUTSIDE, module_count, overhang
from sweep.model.projection import Optics
from sweep.typing import Floats

COARSE_STEPS, FINE_STEPS = 10, 30
SETTLED, NEARLY_SETTLED = 1e-2, 1.0
"""Squared standard deviations of the last undamped step, of the pixels and of their means."""

FIRST_SPREAD_PX = 0.7
"""Point spread at which fits start."""

SAME_TURN_RAD = 1e-3
"""Poses whose rotations differ by less than this are the same."""

CONTEST = 500.0
"""Excess of chi-square over the best coarse fit's above which a mirrored pose is given up. Five
times that of ``photometric``, since residuals of photographs are correlated."""

RING_MODULES = 1.5
"""Widest part of the quiet zone that is fitted, in modules: farther out nothing tells the pose."""

PADDING_PX = 2.0
"""Pixels around the fitted ones in the box, beside the reach of the sharpening."""

MODELLED_PX = 5.0
"""Pixels around the fitted ones within which print is in the model: what blur carries inwards."""

MIN_CONTRAST = 1.0
"""Difference of white and black in grey levels below which there is no marker in the pixels."""

MAX_MISFIT_PX = 0.5
"""Standard deviation of the shifts of the marker's parts above which a pose is not explained."""


@compiled
def binned_photograph(view: PhotographView) -> PhotographView:
    """Return the view of the means of 2 x 2 pixels; an odd last row or column is left out."""
    height, width = view.used.shape[0] // 2, view.used.shape[1] // 2
    intrinsics = np.empty(4)
    for k in range(2):
        intrinsics[k] = 0.5 * view.marker.optics.intrinsics[k]
        intrinsics[2 + k] = 0.5 * (view.marker.optics.intrinsics[2 + k] + 0.5) - 0.5
    optics = Optics(intrinsics, view.marker.optics.lens, view.marker.optics.distorted)
    levels, used = np.zeros((height, width)), np.zeros((height, width), dtype=np.bool_)
    at, rays = np.zeros((2, height, width)), np.zeros((height, width, 6))
    for i in range(height):
        for j in range(width):
            used[i, j] = True
            for k in range(4):
                row, column = 2 * i + k // 2, 2 * j + k % 2
                used[i, j] = used[i, j] and view.used[row, column]
                levels[i, j] += 0.25 * view.levels[row, column]
                for axis in range(2):
                    at[axis, i, j] += 0.25 * view.at[axis, row, column]
                for m in range(6):
                    rays[i, j, m] += (0.25 if m < 2 else 0.125) * view.rays[row, column, m]
    marker = MarkerView(
        view.marker.edges, view.marker.extent, view.marker.modules, view.marker.size_m, optics,
        view.marker.variance,
    )
    return PhotographView(marker, levels, used, rays, at)


@compiled
def locate_photograph(
    view: PhotographView, starts: Floats, nuisances: Nuisances, linear: Floats
) -> tuple[Floats, float, bool, Floats]:
    """Return the best state, its sum of squares, whether it was reached, and the next minimum.

    ``starts`` (K, STATE_LENGTH) are states; ``linear`` gets the solution of the linear parameters.
    """
    plain = Nuisances(nuisances.outside, False, False, False, 1.0)
    coarse = binned_photograph(view)
    coarse_work = system(coarse.used.shape[0], coarse.used.shape[1])
    work = system(view.used.shape[0], view.used.shape[1])
    coarse_free, coarse_count = counts(plain)
    coarse_information = np.empty((coarse_free, coarse_free))
    coarse_linear = np.empty(coarse_count)
    free, count = counts(nuisances)
    information, trial_linear = np.empty((free, free)), np.empty(count)

    def coarse_fit(state: Floats) -> float:
        """Fit a state to the means of 2 x 2 pixels, whose point spread is half as wide."""
        state[SPREAD] *= 0.5
        level, _ = fit_photograph(
            coarse, state, plain, coarse_work, COARSE_STEPS, NEARLY_SETTLED, coarse_information,
            coarse_linear,
        )
        state[SPREAD] *= 2.0
        return level

    coarse_pixels = 0
    for used in coarse.used.flat:
        coarse_pixels += int(used)
    best, other = np.full(STATE_LENGTH, math.nan), np.full(STATE_LENGTH, math.nan)
    first, lowest = best.copy(), math.inf
    for k in range(len(starts)):
        if is_before_camera(starts[k], view.marker):
            state = starts[k].copy()
            level = coarse_fit(state)
            if level < lowest:
                lowest = level
                overwrite(first, state)
    if not lowest < math.inf:
        return best, math.inf, False, other
    overwrite(best, first)
    squares, reached = fit_photograph(
        view, best, nuisances, work, FINE_STEPS, SETTLED, information, linear
    )
    rival = mirrored_state(first)
    if is_before_camera(rival, view.marker):
        away = turn_between(rival, first)
        level = coarse_fit(rival)
        most = lowest * (1.0 + CONTEST / max(coarse_pixels, 1))
        if level < most and turn_between(rival, first) > 0.5 * away:
            level, rival_reached = fit_photograph(
                view, rival, nuisances, work, FINE_STEPS, SETTLED, information, trial_linear
            )
            if turn_between(rival, best) > SAME_TURN_RAD:
                overwrite(other, rival)
                if level < squares and (rival_reached or not reached):
                    overwrite(other, best)
                    overwrite(best, rival)
                    overwrite(linear, trial_linear)
                    squares, reached = level, rival_reached
    return best, squares, reached, other


@dataclass(frozen=True, slots=True)
class PhotometricReal:
    """Least squares on the pixels of real images as a pose estimator.

    Attributes
    ----------
    refined
        Whether it also starts from the corners after ``cv2.cornerSubPix``.
    light, tone, sharpening
        Whether light that varies linearly, the tone curve and sharpening are estimated.
    radius_px
        Radius of the sharpening.
    """

    refined: bool
    light: bool
    tone: bool
    sharpening: bool
    radius_px: float

    @property
    def needs_images(self) -> bool:
        """Whether detections must carry their images: yes."""
        return True

    def __call__(self, detections: Detections) -> Estimates:
        """Return the poses, with covariances from the residuals."""
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
        for i in range(count):
            starts = _starts(turns[i], shifts[i])
            if len(starts):
                self._estimate(detections, i, starts, out)
        return out

    def _estimate(self, detections: Detections, i: int, starts: Floats, out: Estimates) -> None:
        """Write the estimate of one detection to ``out``."""
        padding = PADDING_PX + (math.ceil(3 * self.radius_px) if self.sharpening else 0)
        view = photograph_view(detections, i, padding)
        if view is None:
            return
        outside = bool((view.marker.edges.sides == OUTSIDE).any())
        nuisances = Nuisances(outside, self.light, self.tone, self.sharpening, self.radius_px)
        free, linear_count = counts(nuisances)
        pixels = int(view.used.sum())
        linear = np.empty(linear_count)
        if pixels <= free + linear_count:
            return
        state, squares, reached, other = locate_photograph(view, starts, nuisances, linear)
        if not math.isfinite(squares):
            return
        if not reached:
            out.status[i] = EstimateStatus.not_converged
            return
        work = system(*view.used.shape)
        covariance = np.empty((6, 6))
        exists, _, _, _, misfit = judge(view, state, nuisances, work, linear, covariance)
        turns = np.diag(covariance)[:3] if exists else np.array([math.inf])
        if abs(linear[1]) < MIN_CONTRAST or not turns.max() < math.pi**2:
            return
        out.status[i] = (
            EstimateStatus.not_explained if misfit > MAX_MISFIT_PX else EstimateStatus.solved
        )
        out.rotation[i], out.translation[i] = rotation_of(state), state[POSITION]
        out.alternative_rotation[i] = rotation_of(other)
        out.alternative_reprojection_px[i] = _reprojection_px(other, detections, i)
        out.reprojection_px[i] = _reprojection_px(state, detections, i)
        out.covariance[i] = covariance
        out.misfit_px[i] = misfit
        out.residual_ratio[i] = squares / (
            noise_variance(float(detections.noise_grey[i])) * (pixels - free - linear_count)
        )


def photograph_view(detections: Detections, i: int, padding: float) -> PhotographView | None:
    """Return what is fitted of one detection, and what is known of it; None if that is nothing.

    The pixels of the marker and of its quiet zone, as far as the detected corners tell; around
    them the box is ``padding`` px wider.
    """
    dictionary, _, margin = detections.markers[i]
    modules = module_count(dictionary)
    corners = detections.corners[i]
    side = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
    on_board = None if detections.on_board is None else detections.on_board[i]
    ring = margin if on_board is None else clear_modules(on_board)
    ring = min(max(ring, overhang(dictionary) + 0.5), overhang(dictionary) + RING_MODULES)
    to_modules = _homography(corners, modules)
    if not np.isfinite(to_modules).all() or not side > 0:
        return None
    outline = np.array([[-ring, -ring], [modules + ring, -ring], [modules + ring] * 2,
                        [-ring, modules + ring]])
    pixels = _mapped(np.asarray(np.linalg.inv(to_modules), dtype=np.float64), outline)
    image, origin = detections.images[i], detections.origins[i]
    low = np.floor(pixels.min(axis=0) - padding).astype(np.int64)
    high = np.ceil(pixels.max(axis=0) + padding).astype(np.int64) + 1
    # A detection may be much wider in the plane than the image that was searched.
    low = np.maximum(low, origin - math.ceil(padding))
    high = np.minimum(high, origin + image.shape[::-1] + math.ceil(padding))
    width, height = (high - low).tolist()
    if min(width, height) < 4:
        return None
    start = np.maximum(low, origin)
    stop = np.minimum(high, origin + image.shape[::-1])
    levels, used = np.zeros((height, width)), np.zeros((height, width), dtype=np.bool_)
    inner = tuple(
        slice(*(np.array([start[k], stop[k]]) - low[k]).tolist()) for k in (1, 0)
    )
    part = tuple(
        slice(*(np.array([start[k], stop[k]]) - origin[k]).tolist()) for k in (1, 0)
    )
    levels[inner] = image[part]
    used[inner] = True
    columns, rows = np.meshgrid(np.arange(width) + low[0], np.arange(height) + low[1])
    points = _mapped(to_modules, np.stack([columns, rows], axis=-1).astype(np.float64))
    with np.errstate(invalid="ignore"):
        used &= ((points > -ring) & (points < modules + ring)).all(axis=-1)
    optics = detections.cameras.optics(i)
    local = optics.intrinsics.copy()
    local[2:] -= low
    optics = Optics(local, optics.lens, optics.distorted)
    extent = math.ceil(4.0 * (ring + MODELLED_PX * modules / side)) / 4.0
    around = (
        edges_alone(detections.markers[i], extent) if on_board is None
        else surroundings(on_board, extent)
    )
    marker = MarkerView(
        around, np.array([-extent, modules + extent]), float(modules),
        float(detections.size_m[i]), optics, 1.0,
    )
    at = np.clip(np.moveaxis((points - modules / 2) / (modules / 2 + ring), -1, 0), -2.0, 2.0)
    return PhotographView(
        marker, levels, used, rays_of(optics, height, width),
        np.ascontiguousarray(np.nan_to_num(at)),
    )


def _homography(corners: Floats, modules: float) -> Floats:
    """Return the homography (3, 3) that takes the corners (4, 2) to the square's, in modules."""
    square = modules * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    middle = corners.mean(axis=0)
    rows = []
    for (x, y), (u, v) in zip((corners - middle).tolist(), square.tolist(), strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, v])
    system_of = np.array(rows)
    try:
        solution = np.linalg.solve(system_of[:, :8], system_of[:, 8])
    except np.linalg.LinAlgError:
        return np.full((3, 3), np.nan)
    homography = np.append(solution, 1.0).reshape(3, 3)
    homography[:, 2] -= homography[:, :2] @ middle
    return homography


def _mapped(homography: Floats, points: Floats) -> Floats:
    """Return the images (..., 2) of points (..., 2); NaN behind the horizon."""
    flat = points @ homography[:, :2].T + homography[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(flat[..., 2:] > 0, flat[..., :2] / flat[..., 2:], np.nan)


def _starts(rotation: Floats, translation: Floats) -> Floats:
    """Return the states (K, STATE_LENGTH) of the finite ones of M poses (M, 3, 3), (M, 3)."""
    states = np.zeros((len(rotation), STATE_LENGTH))
    states[:, :9], states[:, POSITION] = rotation.reshape(-1, 9), translation
    states[:, SPREAD] = FIRST_SPREAD_PX
    return np.asarray(states[np.isfinite(states).all(axis=1)])


def _reprojection_px(state: Floats, detections: Detections, i: int) -> float:
    """Return the RMS reprojection error of a state over the corners of one detection."""
    row = np.array([i])
    return float(
        reprojection_errors_px(
            rotation_of(state)[None], state[None, POSITION], detections.size_m[row],
            detections.corners[row], detections.cameras.take(row),
        )[0]
    )
