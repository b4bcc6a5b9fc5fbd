"""The likelihood of a marker's pixels: fitted to an image, and how sharp it is at the truth.

Pixels are exact levels plus independent Gaussian noise. The pose (and the point spread, where it
is asked for) is moved by Levenberg-Marquardt; the three grey levels enter linearly and are solved
for at every step (Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least
squares problems whose variables separate", SIAM J. Numer. Anal. 10, 1973).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model.derivatives import LEVELS, POSE, differentiate, normal_equations
from sweep.model.marker import MarkerKey, edges, module_count
from sweep.model.pose import rotations, vectors
from sweep.typing import Floats

STATE = 16
"""Length of a state: rotation (9, row by row), translation (3), point spread, levels (3)."""

SPREAD, FIRST_LEVEL = 12, 13
"""Where in a state the point spread and the levels are."""

MIN_SPREAD_PX = 0.1
"""The sharpest point spread that is estimated; a sharper one is none, and stays so."""

MAX_TURN = 0.3
MAX_SHIFT = 0.1
"""Largest step: radians, and share of the distance."""

SETTLED, NEARLY_SETTLED = 1e-4, 1e-2
"""Squared standard deviations that an undamped step may still go: then it is the last. Where the
second minimum has just vanished steps get ever shorter: the larger will do for these."""

MIN_NOISE = 0.5
"""Grey levels of noise below which quantisation is no noise of its own, uniform and independent."""

QUANTISATION_VARIANCE = 1 / 12
"""Variance in squared grey levels that rounding to whole levels adds."""

BACKGROUND_MARGIN_PX = 4
"""Pixels of background around the marker that tell its level."""

PATIENCE = 2
"""Steps in a row that must foresee an end above what is worth while, to give up."""


class MarkerView(NamedTuple):
    """What is known of an image beside its pixels: the marker, its size, and the camera.

    ``ends`` (E, 4) and ``sides`` (E, 2) are the marker's edges, ``corner`` (2,) the least and the
    greatest column of its outline, all in modules; ``intrinsics`` (4,) are fx, fy and the
    principal point, relative to the first pixel; ``variance`` is that of a pixel's noise.
    """

    ends: Floats
    sides: NDArray[np.int64]
    corner: Floats
    modules: float
    size_m: float
    intrinsics: Floats
    lens: Floats
    distorted: bool
    variance: float


class Work(NamedTuple):
    """Scratch of one image size: ``shares`` zero and ``place`` -1 between calls."""

    shares: Floats
    place: NDArray[np.int32]
    slopes: Floats


@compiled
def work_space(height: int, width: int) -> Work:
    """Return the scratch for an image."""
    return Work(
        np.zeros((2, height, width + 2)),
        np.full((height, width), -1, dtype=np.int32),
        np.empty((height * width, POSE + 1)),
    )


def sight_of(
    marker: MarkerKey, size_m: float, view: Floats, lens: Floats, distorted: bool,
    corner: NDArray[np.int64], variance: float,
) -> MarkerView:
    """Return what is known of a marker's image whose first pixel is ``corner`` (2,)."""
    outlines, modules = edges(*marker), module_count(marker[0])
    local = view.copy()
    local[2:] -= corner
    return MarkerView(
        outlines.ends, outlines.sides, np.array([-marker[2], modules + marker[2]]),
        float(modules), float(size_m), local, lens, bool(distorted), float(variance),
    )


def noise_variance(noise_grey: float) -> float:
    """Return the variance of a pixel in squared grey levels: its noise and its rounding."""
    return noise_grey**2 + QUANTISATION_VARIANCE


def state_of(rotation: Floats, translation: Floats, spread_px: float, levels: Floats) -> Floats:
    """Return the state (16,) of a pose (3, 3), (3,), a point spread, and levels (3,)."""
    return np.concatenate([rotation.ravel(), translation, [spread_px], levels])


@compiled
def solve_positive(matrix: Floats, right: Floats) -> bool:
    """Solve matrix · x = right in place for a positive definite matrix; False where it is not.

    Scaled to a unit diagonal, then by Cholesky's factors; a pivot below 1e-11 is none.
    """
    n = matrix.shape[0]
    scale, factor = np.empty(n), np.empty((n, n))
    for i in range(n):
        if not (matrix[i, i] > 0.0 and matrix[i, i] < math.inf):
            return False
        scale[i] = 1.0 / math.sqrt(matrix[i, i])
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 1e-11:
                factor[i, i] = math.sqrt(total)
            else:
                return False
    for column in range(right.shape[1]):
        for i in range(n):
            total = right[i, column] * scale[i]
            for k in range(i):
                total -= factor[i, k] * right[k, column]
            right[i, column] = total / factor[i, i]
        for i in range(n - 1, -1, -1):
            total = right[i, column]
            for k in range(i + 1, n):
                total -= factor[k, i] * right[k, column]
            right[i, column] = total / factor[i, i]
        for i in range(n):
            right[i, column] *= scale[i]
    return True


@compiled
def plane_of(state: Floats, sight: MarkerView) -> Floats:
    """Return what takes module coordinates to the camera frame (3, 3), as ``Scenes.plane``."""
    module, half = sight.size_m / sight.modules, 0.5 * sight.size_m
    plane = np.empty((3, 3))
    for i in range(3):
        right, up = state[3 * i], state[3 * i + 1]
        plane[i, 0], plane[i, 1] = right * module, -up * module
        plane[i, 2] = state[9 + i] - (right - up) * half
    return plane


@compiled
def is_before_camera(state: Floats, sight: MarkerView) -> bool:
    """Tell whether the marker faces the camera, with all of its outline in front of it."""
    plane = plane_of(state, sight)
    facing = 0.0
    for i in range(3):
        facing += state[3 * i + 2] * state[9 + i]
    low, high = sight.corner
    nearest = min(
        plane[2, 0] * low + plane[2, 1] * low, plane[2, 0] * low + plane[2, 1] * high,
        plane[2, 0] * high + plane[2, 1] * low, plane[2, 0] * high + plane[2, 1] * high,
    ) + plane[2, 2]
    return facing < 0.0 and nearest > 0.0


@compiled
def curvature(
    image: Floats, state: Floats, sight: MarkerView, work: Work, spread_free: bool,
    information: Floats, gradient: Floats,
) -> float:
    """Solve for the levels at a state; write the Fisher information of what else is free.

    The free parameters are the pose's six, ω in radians and τ as a share of the distance, and
    with ``spread_free`` the point spread's variance in px². Levels are eliminated: the information
    (free, free) is what is left for the others, times the noise's variance. ``gradient`` (free,)
    is that of half the squared residuals, downhill. ``state`` gets its levels; the slopes are for
    the levels that it came with. Returns vectorᵀ · levels: the sum of squares that is explained.
    """
    free = information.shape[0]
    matrix, vector = np.empty((free + LEVELS, free + LEVELS)), np.empty(free + LEVELS)
    count = differentiate(
        work.shares, work.place, work.slopes, sight.ends, sight.sides, state[FIRST_LEVEL:],
        plane_of(state, sight), state[9:12], sight.intrinsics, sight.lens, sight.distorted,
        state[SPREAD],
    )
    distance = abs(state[11])
    for slot in range(count):
        for k in range(3, POSE):
            work.slopes[slot, k] *= distance
        if spread_free and state[SPREAD] > 0.0:
            work.slopes[slot, POSE] /= 2.0 * state[SPREAD]
    normal_equations(image, work.shares, work.place, work.slopes, free, matrix, vector)
    levels = np.empty((LEVELS, LEVELS))
    right = np.empty((LEVELS, free + 1))
    for k in range(LEVELS):
        right[k, free] = vector[free + k]
        for m in range(LEVELS):
            levels[k, m] = matrix[free + k, free + m]
        if not levels[k, k] > 0.0:
            # An area that is not seen has no level: 0.
            levels[k, k] = 1.0
        for m in range(free):
            right[k, m] = matrix[free + k, m]
    if not solve_positive(levels, right):
        information[:] = 0.0
        gradient[:] = 0.0
        return 0.0
    explained = 0.0
    for k in range(LEVELS):
        state[FIRST_LEVEL + k] = right[k, free]
        explained += right[k, free] * vector[free + k]
    for i in range(free):
        gradient[i] = vector[i]
        for k in range(LEVELS):
            gradient[i] -= matrix[i, free + k] * right[k, free]
        for j in range(free):
            information[i, j] = matrix[i, j]
            for k in range(LEVELS):
                information[i, j] -= matrix[i, free + k] * right[k, j]
    if spread_free and not state[SPREAD] > 0.0:
        # No point spread: it is left alone.
        information[POSE, POSE] = 1.0
    return explained


@compiled
def moved_state(state: Floats, step: Floats, most: float) -> Floats:
    """Return the state after a step, shortened to the largest turn and shift times ``most``."""
    turn = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    shift = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    shrink = min(1.0, most * MAX_TURN / max(turn, 1e-300))
    shrink = min(shrink, most * MAX_SHIFT / max(shift, 1e-300))
    moved = state.copy()
    rotation = rotations(shrink * step[:3].copy().reshape(1, 3))[0]
    for i in range(3):
        for j in range(3):
            moved[3 * i + j] = 0.0
            for k in range(3):
                moved[3 * i + j] += rotation[i, k] * state[3 * k + j]
        moved[9 + i] = state[9 + i] + shrink * step[3 + i] * abs(state[11])
    if len(step) > POSE:
        squared = state[SPREAD] ** 2
        # At most to four times the variance, or a quarter of it, and a third of a pixel more.
        wanted = min(squared + shrink * step[POSE], 4.0 * squared + 0.1)
        wanted = max(wanted, 0.25 * squared)
        moved[SPREAD] = math.sqrt(wanted) if wanted >= MIN_SPREAD_PX**2 else 0.0
    return moved


@compiled
def fit(
    image: Floats, square_sum: float, state: Floats, sight: MarkerView, work: Work,
    spread_free: bool, most_steps: int, settled: float, worth: float, information: Floats,
) -> tuple[float, bool]:
    """Move ``state`` to the nearest maximum of the likelihood.

    Returns chi-square and whether the maximum was reached: an undamped Newton step would go less
    than ``settled`` squared standard deviations, and is gone; less than ``NEARLY_SETTLED`` after
    ``most_steps``, or where no step leads down. Given up where that step foresees an end above a
    chi-square of ``worth``. ``information`` (free, free) is left as :func:`curvature`
    gives it there; its inverse times the variance is the covariance.
    """
    free = POSE + 1 if spread_free else POSE
    gradient = np.empty(free)
    trial_information, trial_gradient = np.empty((free, free)), np.empty(free)
    state[FIRST_LEVEL:] = 0.0
    curvature(image, state, sight, work, spread_free, information, gradient)
    explained = curvature(image, state, sight, work, spread_free, information, gradient)
    chi_square = (square_sum - explained) / sight.variance
    damping = 1e-3
    above = 0
    decrement = math.inf
    for _ in range(most_steps):
        newton = np.empty((free, 1))
        newton[:, 0] = gradient
        whole = solve_positive(information, newton)
        decrement = math.inf
        if whole:
            decrement = 0.0
            for k in range(free):
                decrement += gradient[k] * newton[k, 0]
            above = above + 1 if chi_square - decrement / sight.variance > worth else 0
            if above > PATIENCE:
                return chi_square, False
            if decrement < settled * sight.variance:
                last = moved_state(state, newton[:, 0], 1.0)
                state[:] = last
                return chi_square, True
        accepted = False
        for _attempt in range(10):
            damped = information.copy()
            step = np.empty((free, 1))
            step[:, 0] = gradient
            for k in range(free):
                damped[k, k] += damping * information[k, k] + 1e-300
            if not solve_positive(damped, step):
                damping = max(10.0 * damping, 1e-3)
                continue
            trial = moved_state(state, step[:, 0], 1.0)
            if is_before_camera(trial, sight):
                explained = curvature(
                    image, trial, sight, work, spread_free, trial_information, trial_gradient
                )
                trial_chi_square = (square_sum - explained) / sight.variance
                if trial_chi_square < chi_square:
                    accepted = True
                    break
            damping = max(8.0 * damping, 1e-3)
        if not accepted:
            break
        chi_square = trial_chi_square
        state[:] = trial
        information[:] = trial_information
        gradient[:] = trial_gradient
        damping *= 0.1
    return chi_square, decrement < NEARLY_SETTLED * sight.variance


@compiled
def binned(image: Floats) -> Floats:
    """Return the means of 2 x 2 pixels; an odd last row or column is left out."""
    half = np.empty((image.shape[0] // 2, image.shape[1] // 2))
    for i in range(half.shape[0]):
        for j in range(half.shape[1]):
            half[i, j] = 0.25 * (
                image[2 * i, 2 * j] + image[2 * i, 2 * j + 1]
                + image[2 * i + 1, 2 * j] + image[2 * i + 1, 2 * j + 1]
            )
    return half


@compiled
def binned_sight(sight: MarkerView) -> MarkerView:
    """Return the sight of an image of 2 x 2 pixels' means: the exact model holds for it too."""
    view = np.empty(4)
    for k in range(2):
        view[k] = 0.5 * sight.intrinsics[k]
        view[2 + k] = 0.5 * (sight.intrinsics[2 + k] + 0.5) - 0.5
    return MarkerView(
        sight.ends, sight.sides, sight.corner, sight.modules, sight.size_m, view, sight.lens,
        sight.distorted, 0.25 * sight.variance,
    )


@compiled
def mirrored_state(state: Floats) -> Floats:
    """Return the state with the other planar solution's rotation, as ``pose.mirrored``."""
    mirror = state.copy()
    length = math.sqrt(state[9] ** 2 + state[10] ** 2 + state[11] ** 2)
    for j in range(3):
        sign = -1.0 if j == 2 else 1.0
        along = 0.0
        for k in range(3):
            along += state[9 + k] / length * sign * state[3 * k + j]
        for i in range(3):
            mirror[3 * i + j] = sign * state[3 * i + j] - 2.0 * state[9 + i] / length * along
    return mirror


@compiled
def squares(image: Floats) -> float:
    """Return the sum of squared levels."""
    total = 0.0
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            total += image[i, j] * image[i, j]
    return total


@compiled
def turn_between(state: Floats, other: Floats) -> float:
    """Return the angle between two states' rotations in radians, stable where it is small."""
    difference = np.zeros((1, 3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                difference[0, i, j] += state[3 * i + k] * other[3 * j + k]
    turn = vectors(difference)[0]
    return math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)


@compiled
def pose_covariance(information: Floats, variance: float, distance: float) -> tuple[Floats, bool]:
    """Return the covariance (6, 6) of the pose in radians and metres, and whether there is one."""
    free = information.shape[0]
    inverse = np.eye(free)
    found = solve_positive(information, inverse)
    for i in range(POSE):
        for j in range(POSE):
            unit = (distance if i >= 3 else 1.0) * (distance if j >= 3 else 1.0)
            inverse[i, j] *= variance * unit
    return inverse[:POSE, :POSE].copy(), found
