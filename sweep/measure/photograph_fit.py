"""The fit of a printed plane to a photograph: pose, point spread, and what cameras do to levels.

The level of a pixel is modelled as

    y = F(b + c m + d p + e m (1 - m)) + gx x + gy y + (hx x + hy y) F(m),
    F(z) = z + a (z - G(z)),

m is the share of white through a Gaussian point spread, p that of the area outside the modelled
paper; b, c, d are levels, e is the tone curve, g and h are the light's gradients on black and on
white, and F is sharpening of an amount a, G being the mean over a Gaussian of ``radius_px``. b to h
enter linearly and are solved for at each step, as in :mod:`sweep.measure.likelihood`; the pose, the
point spread's variance and the amount are moved by Levenberg-Marquardt.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled, compiled_inline
from sweep.measure.likelihood import (
    DEPTH,
    SPREAD,
    MarkerView,
    is_before_camera,
    moved_state,
    overwrite,
    plane_of,
)
from sweep.measure.photograph_image import Slopes, add_plane, slope_space
from sweep.measure.positive_definite import solve_positive
from sweep.model.derivatives import POSE
from sweep.model.lens import jacobian, undistort
from sweep.model.projection import Optics, Projection
from sweep.typing import Floats

AMOUNT, OUTSIDE_VALUE, TONE = 13, 14, 15
CONTRAST = 16
STATE_LENGTH = 19
"""A state vector begins as that of :mod:`sweep.measure.likelihood`, up to the point spread; then
the amount of sharpening, and from the last solution of the linear parameters the value of outside
and the tone, both as shares of the contrast, and the contrast with its slopes along x and y."""

MIN_SPREAD_PX = 0.2
"""Smallest point spread that is estimated."""

MIN_AMOUNT, MAX_AMOUNT = -0.9, 5.0
"""Range of the amount of sharpening."""

MAX_TONE = 2.0
"""Largest tone, as a share of the contrast, for which slopes are computed."""

GROUP, TILE = 64, 4
"""Pixels whose columns are multiplied at once, and the side of the tiles of their products."""

SLACK = 0.5
"""Rise of chi-square that a step may bring: its direction is not exactly that of descent."""

LENS_STEP_PX = 8
"""Pixels between those at which the lens is inverted; between them it is interpolated."""


class Nuisances(NamedTuple):
    """Which nuisances are estimated beside the pose, the point spread and the levels.

    Attributes
    ----------
    outside, light, tone, sharpening
        The level outside the paper, light that varies linearly, the tone curve, and sharpening.
    radius_px
        Radius of the sharpening in px.
    """

    outside: bool
    light: bool
    tone: bool
    sharpening: bool
    radius_px: float


class PhotographView(NamedTuple):
    """A box of a photograph with what is known of it.

    Attributes
    ----------
    marker
        The plane's edges, the extent that they describe, and the camera; the principal point is
        relative to the box.
    levels
        (height, width) grey levels.
    used
        (height, width): whether a pixel is fitted.
    rays
        (height, width, 6) undistorted direction x/z, y/z of each pixel, and the derivatives of
        its u and v by them, row by row, in px.
    at
        (2, height, width) x and y relative to the marker's centre, in halves of its extent.
    """

    marker: MarkerView
    levels: Floats
    used: NDArray[np.bool_]
    rays: Floats
    at: Floats


class System(NamedTuple):
    """Scratch space of a fit.

    Attributes
    ----------
    slopes
        As :func:`sweep.measure.photograph_image.slope_space` returns it.
    images
        (8, height, width): the image, the tone's term, slopes by x, y and variance, the area
        outside, the difference of the image to the smoothed one; and scratch.
    scratch
        (height, width).
    """

    slopes: Slopes
    images: Floats
    scratch: Floats


@compiled
def system(height: int, width: int) -> System:
    """Return the scratch space for a box."""
    return System(
        slope_space(height, width), np.zeros((8, height, width)), np.zeros((height, width))
    )


@compiled
def rays_of(optics: Optics, height: int, width: int) -> Floats:
    """Return the rays (height, width, 6) of a box, as :class:`PhotographView` has them."""
    rays = np.empty((height, width, 6))
    fx, fy, cx, cy = optics.intrinsics
    if not optics.distorted:
        for i in range(height):
            for j in range(width):
                rays[i, j, 0], rays[i, j, 1] = (j - cx) / fx, (i - cy) / fy
                rays[i, j, 2], rays[i, j, 3], rays[i, j, 4], rays[i, j, 5] = fx, 0.0, 0.0, fy
        return rays
    rows = (height - 1) // LENS_STEP_PX + 2
    columns = (width - 1) // LENS_STEP_PX + 2
    lattice = np.empty((rows, columns, 6))
    for i in range(rows):
        for j in range(columns):
            x, y, _ = undistort(
                (j * LENS_STEP_PX - cx) / fx, (i * LENS_STEP_PX - cy) / fy, optics.lens
            )
            a, b, c, d = jacobian(x, y, optics.lens)
            lattice[i, j, 0], lattice[i, j, 1] = x, y
            lattice[i, j, 2], lattice[i, j, 3] = fx * a, fx * b
            lattice[i, j, 4], lattice[i, j, 5] = fy * c, fy * d
    for i in range(height):
        row, down = i // LENS_STEP_PX, (i % LENS_STEP_PX) / LENS_STEP_PX
        for j in range(width):
            column, right = j // LENS_STEP_PX, (j % LENS_STEP_PX) / LENS_STEP_PX
            for k in range(6):
                above = (
                    lattice[row, column, k] * (1.0 - right)
                    + lattice[row, column + 1, k] * right
                )
                below = (
                    lattice[row + 1, column, k] * (1.0 - right)
                    + lattice[row + 1, column + 1, k] * right
                )
                rays[i, j, k] = above * (1.0 - down) + below * down
    return rays


@compiled
def smooth(image: Floats, radius: float, smoothed: Floats, scratch: Floats) -> None:
    """Write an image's (height, width) mean over a Gaussian; zeros lie beyond the box."""
    height, width = image.shape
    half = math.ceil(3.0 * radius)
    kernel = np.empty(half + 1)
    total = 0.0
    for k in range(half + 1):
        kernel[k] = math.exp(-0.5 * (k / radius) ** 2)
        total += kernel[k] if k == 0 else 2.0 * kernel[k]
    for k in range(half + 1):
        kernel[k] /= total
    for i in range(height):
        row, out = image[i], scratch[i]
        for j in range(width):
            out[j] = kernel[0] * row[j]
        for k in range(1, min(half, width - 1) + 1):
            share = kernel[k]
            ahead, begin = row[k:], out[: width - k]
            behind, end = row[: width - k], out[k:]
            for j in range(width - k):
                begin[j] += share * ahead[j]
            for j in range(width - k):
                end[j] += share * behind[j]
    for i in range(height):
        out = smoothed[i]
        row = scratch[i]
        for j in range(width):
            out[j] = kernel[0] * row[j]
        for k in range(1, half + 1):
            share = kernel[k]
            if i >= k:
                above = scratch[i - k]
                for j in range(width):
                    out[j] += share * above[j]
            if i + k < height:
                below = scratch[i + k]
                for j in range(width):
                    out[j] += share * below[j]


@compiled
def draw(view: PhotographView, state: Floats, nuisances: Nuisances, work: System) -> None:
    """Write the images of a state to ``work.images``."""
    (rates, curved, outsides), images = work.slopes, work.images
    height, width = view.used.shape
    values = np.zeros(3)
    values[0], values[2] = state[OUTSIDE_VALUE] * nuisances.outside, 1.0
    add_plane(
        work.slopes, view.marker.edges, values,
        Projection(plane_of(state, view.marker), view.marker.optics), state[SPREAD],
    )
    tone = min(max(state[TONE], -MAX_TONE), MAX_TONE)
    for i in range(height):
        # Beyond the modelled extent is black.
        level, outside = 0.0, 0.0
        for j in range(width):
            level += rates[i, 4 * j]
            outside += outsides[i, j]
            images[0, i, j] = level
            images[1, i, j] = level * (1.0 - level)
            images[5, i, j] = outside
            gain = 1.0 + tone * (1.0 - 2.0 * level)
            images[2, i, j] = gain * rates[i, 4 * j + 1]
            images[3, i, j] = gain * rates[i, 4 * j + 2]
            images[4, i, j] = gain * (rates[i, 4 * j + 3] + curved[i, j])
            curved[i, j] = 0.0
        rates[i] = 0.0
        outsides[i] = 0.0
    if not nuisances.sharpening:
        return
    amount = state[AMOUNT]
    for k in range(6):
        if (k == 5 and not nuisances.outside) or (k == 1 and not nuisances.tone):
            continue
        smooth(images[k], nuisances.radius_px, images[7], work.scratch)
        share = 1.0 if k == 0 else tone
        for i in range(height):
            for j in range(width):
                difference = images[k, i, j] - images[7, i, j]
                images[k, i, j] += amount * difference
                if k == 0:
                    images[6, i, j] = difference
                elif k == 1:
                    images[6, i, j] += share * difference


@compiled_inline
def columns_at(
    view: PhotographView, state: Floats, nuisances: Nuisances, images: Floats,
    i: int, j: int, column: Floats,
) -> None:
    """Write the model's derivatives at a pixel: by what is moved, and by the linear parameters.

    The order: six of the pose, the point spread's variance, the amount; black, contrast, outside,
    tone, and the light's gradients, of those which are estimated.
    """
    rays = view.rays
    ray_x, ray_y = rays[i, j, 0], rays[i, j, 1]
    x_at, y_at = view.at[0, i, j], view.at[1, i, j]
    scale = state[CONTRAST] + state[CONTRAST + 1] * x_at + state[CONTRAST + 2] * y_at
    # The slope by the direction, from that by the pixel.
    by_x = scale * (images[2, i, j] * rays[i, j, 2] + images[3, i, j] * rays[i, j, 4])
    by_y = scale * (images[2, i, j] * rays[i, j, 3] + images[3, i, j] * rays[i, j, 5])
    # The plane's normal is the third column of the rotation matrix, position follows it.
    inverse = (state[2] * ray_x + state[5] * ray_y + state[8]) / (
        state[2] * state[9] + state[5] * state[10] + state[8] * state[11]
    )
    px = ray_x - inverse * state[9]
    py = ray_y - inverse * state[10]
    pz = 1.0 - inverse * state[11]
    by_z = ray_x * by_x + ray_y * by_y
    nearness = abs(state[DEPTH]) * inverse
    column[0] = by_y * pz + by_z * py
    column[1] = -by_x * pz - by_z * px
    column[2] = by_x * py - by_y * px
    column[3] = -by_x * nearness
    column[4] = -by_y * nearness
    column[5] = by_z * nearness
    column[6] = scale * images[4, i, j]
    k = 7
    if nuisances.sharpening:
        column[k] = scale * images[6, i, j]
        k += 1
    share = images[0, i, j]
    column[k] = 1.0
    column[k + 1] = share
    k += 2
    if nuisances.outside:
        column[k] = images[5, i, j]
        k += 1
    if nuisances.tone:
        column[k] = images[1, i, j]
        k += 1
    if nuisances.light:
        column[k], column[k + 1] = x_at, y_at
        column[k + 2], column[k + 3] = x_at * share, y_at * share
        k += 4
    column[k] = view.levels[i, j]


@compiled
def counts(nuisances: Nuisances) -> tuple[int, int]:
    """Return how many parameters are moved, and how many are linear."""
    return (
        POSE + 1 + int(nuisances.sharpening),
        2 + int(nuisances.outside) + int(nuisances.tone) + 4 * int(nuisances.light),
    )


@compiled
def normal_equations(
    view: PhotographView, state: Floats, nuisances: Nuisances, work: System, matrix: Floats
) -> None:
    """Sum up JᵀJ, Jᵀy and yᵀy over the used pixels into ``matrix`` (n + 1, n + 1)."""
    size = matrix.shape[0]
    tiles = (size + TILE - 1) // TILE
    columns, sums = np.zeros((GROUP, TILE * tiles)), np.zeros((TILE * tiles, TILE * tiles))
    height, width = view.used.shape
    filled = 0
    for i in range(height):
        for j in range(width):
            if view.used[i, j]:
                columns_at(view, state, nuisances, work.images, i, j, columns[filled])
                filled += 1
                if filled == GROUP:
                    _add_group(columns, filled, sums)
                    filled = 0
    _add_group(columns, filled, sums)
    for k in range(size):
        for m in range(k + 1):
            matrix[k, m] = matrix[m, k] = sums[k, m]


@compiled
def _add_group(columns: Floats, count: int, sums: Floats) -> None:
    """Add the products of the columns of ``count`` pixels to the tiles of the lower triangle."""
    for k in range(0, sums.shape[0], TILE):
        for m in range(0, k + 1, TILE):
            s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = 0.0
            s20 = s21 = s22 = s23 = s30 = s31 = s32 = s33 = 0.0
            for p in range(count):
                row = columns[p]
                a0, a1, a2, a3 = row[k], row[k + 1], row[k + 2], row[k + 3]
                b0, b1, b2, b3 = row[m], row[m + 1], row[m + 2], row[m + 3]
                s00, s01, s02, s03 = s00 + a0 * b0, s01 + a0 * b1, s02 + a0 * b2, s03 + a0 * b3
                s10, s11, s12, s13 = s10 + a1 * b0, s11 + a1 * b1, s12 + a1 * b2, s13 + a1 * b3
                s20, s21, s22, s23 = s20 + a2 * b0, s21 + a2 * b1, s22 + a2 * b2, s23 + a2 * b3
                s30, s31, s32, s33 = s30 + a3 * b0, s31 + a3 * b1, s32 + a3 * b2, s33 + a3 * b3
            _add_to_row(sums[k], m, s00, s01, s02, s03)
            _add_to_row(sums[k + 1], m, s10, s11, s12, s13)
            _add_to_row(sums[k + 2], m, s20, s21, s22, s23)
            _add_to_row(sums[k + 3], m, s30, s31, s32, s33)


@compiled_inline
def _add_to_row(row: Floats, m: int, a: float, b: float, c: float, d: float) -> None:
    """Add four numbers to a row from column m on."""
    row[m] += a
    row[m + 1] += b
    row[m + 2] += c
    row[m + 3] += d


@compiled
def evaluate(
    view: PhotographView, state: Floats, nuisances: Nuisances, work: System,
    information: Floats, gradient: Floats, linear: Floats,
) -> float:
    """Solve for the linear parameters at a state; return the sum of squared residuals.

    ``information`` (free, free) and ``gradient`` (free,) are those of the moved parameters, the
    linear ones eliminated; ``linear`` gets the solution, from which ``state`` gets its last
    entries. Returns infinity if the linear parameters cannot be solved for.
    """
    free, count = information.shape[0], linear.shape[0]
    matrix = np.empty((free + count + 1, free + count + 1))
    draw(view, state, nuisances, work)
    normal_equations(view, state, nuisances, work, matrix)
    end = free + count
    inner, right = np.empty((count, count)), np.empty((count, free + 1))
    for k in range(count):
        right[k, free] = matrix[free + k, end]
        for m in range(count):
            inner[k, m] = matrix[free + k, free + m]
        for m in range(free):
            right[k, m] = matrix[free + k, m]
        # What covers no pixel is 0, and what cannot be told from the rest stays small.
        inner[k, k] = inner[k, k] * (1.0 + 1e-9) if inner[k, k] > 0.0 else 1.0
    if not solve_positive(inner, right):
        return math.inf
    squares = matrix[end, end]
    for k in range(count):
        linear[k] = right[k, free]
        squares -= right[k, free] * matrix[free + k, end]
    for i in range(free):
        gradient[i] = matrix[i, end]
        for k in range(count):
            gradient[i] -= matrix[i, free + k] * right[k, free]
        for j in range(free):
            information[i, j] = matrix[i, j]
            for k in range(count):
                information[i, j] -= matrix[i, free + k] * right[k, j]
    if state[SPREAD] <= MIN_SPREAD_PX and gradient[POSE] < 0.0:
        _hold(information, gradient, POSE)
    if nuisances.sharpening:
        pull = gradient[POSE + 1]
        if (state[AMOUNT] <= MIN_AMOUNT and pull < 0.0) or (
            state[AMOUNT] >= MAX_AMOUNT and pull > 0.0
        ):
            _hold(information, gradient, POSE + 1)
    keep_linear(state, nuisances, linear)
    return max(float(squares), 0.0)


@compiled
def _hold(information: Floats, gradient: Floats, k: int) -> None:
    """Keep a parameter where it is: it is at its limit, and the squares fall beyond."""
    information[k] = 0.0
    information[:, k] = 0.0
    information[k, k] = 1.0
    gradient[k] = 0.0


@compiled
def keep_linear(state: Floats, nuisances: Nuisances, linear: Floats) -> None:
    """Write what slopes depend on of the linear parameters to a state."""
    contrast = linear[1]
    divisor = contrast if contrast != 0.0 else 1.0
    kept = state[CONTRAST:]
    kept[0], kept[1], kept[2] = contrast, 0.0, 0.0
    k = 2
    if nuisances.outside:
        state[OUTSIDE_VALUE] += min(max(linear[k] / divisor, -1.0), 1.0)
        k += 1
    if nuisances.tone:
        state[TONE] = linear[k] / divisor
        k += 1
    if nuisances.light:
        kept[1], kept[2] = linear[k + 2], linear[k + 3]


@compiled
def stepped(state: Floats, step: Floats, nuisances: Nuisances) -> Floats:
    """Return the state after a step of the moved parameters."""
    moved = moved_state(state, step[: POSE + 1], 1.0)
    moved[SPREAD] = max(moved[SPREAD], MIN_SPREAD_PX)
    if nuisances.sharpening:
        change = min(max(step[POSE + 1], -1.0), 1.0)
        moved[AMOUNT] = min(max(state[AMOUNT] + change, MIN_AMOUNT), MAX_AMOUNT)
    return moved


@compiled
def fit_photograph(
    view: PhotographView, state: Floats, nuisances: Nuisances, work: System, most_steps: int,
    settled: float, information: Floats, linear: Floats,
) -> tuple[float, bool]:
    """Move ``state`` to the nearest minimum of the sum of squared residuals.

    Returns that sum, and whether the minimum was reached: the undamped Newton step is shorter than
    ``settled`` squared standard deviations (of residuals as noise), and is taken.
    """
    free, count = counts(nuisances)
    pixels = 0
    for used in view.used.flat:
        pixels += int(used)
    freedom = max(pixels - free - count, 1)
    gradient = np.empty(free)
    trial_information, trial_gradient = np.empty((free, free)), np.empty(free)
    trial_linear = np.empty(count)
    if state[CONTRAST] == 0.0:
        # Slopes are for the levels of the evaluation before.
        evaluate(view, state, nuisances, work, information, gradient, linear)
    squares = evaluate(view, state, nuisances, work, information, gradient, linear)
    damping = 1e-3
    decrement = math.inf
    for _ in range(most_steps):
        if not squares < math.inf:
            break
        newton = gradient.copy().reshape(free, 1)
        regular = information.copy()
        for k in range(free):
            regular[k, k] = regular[k, k] * (1.0 + 1e-9) + 1e-300
        if solve_positive(regular, newton):
            decrement = 0.0
            for k in range(free):
                decrement += gradient[k] * newton[k, 0]
            if decrement < settled * (squares / freedom):
                moved = stepped(state, newton[:, 0], nuisances)
                if is_before_camera(moved, view.marker):
                    overwrite(state, moved)
                return squares, True
        accepted = False
        for _attempt in range(8):
            damped = information.copy()
            step = gradient.copy().reshape(free, 1)
            for k in range(free):
                damped[k, k] += damping * information[k, k] + 1e-300
            if not solve_positive(damped, step):
                damping = max(10.0 * damping, 1e-3)
                continue
            trial = stepped(state, step[:, 0], nuisances)
            if is_before_camera(trial, view.marker):
                trial_squares = evaluate(
                    view, trial, nuisances, work, trial_information, trial_gradient, trial_linear
                )
                if trial_squares < squares + SLACK * (squares / freedom):
                    accepted = True
                    break
            damping = max(8.0 * damping, 1e-3)
        if not accepted:
            break
        squares = trial_squares
        overwrite(state, trial)
        overwrite(gradient, trial_gradient)
        overwrite(linear, trial_linear)
        for k in range(free):
            overwrite(information[k], trial_information[k])
        damping *= 0.1
    return squares, decrement < 1e-2 * (squares / freedom)
