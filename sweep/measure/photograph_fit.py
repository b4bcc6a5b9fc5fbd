"""The fit of a printed plane to a photograph: pose, point spread, and what cameras do to levels.

The linear parameters of the model (:mod:`sweep.measure.photograph_model`) are solved for at each
step, as in :mod:`sweep.measure.likelihood`; the pose and the point spread's variance are moved by
Levenberg-Marquardt.
"""

from __future__ import annotations

import math

import numpy as np

from sweep.compilation import compiled, compiled_inline
from sweep.measure.likelihood import SPREAD, is_before_camera, moved_state, overwrite
from sweep.measure.photograph_model import (
    AMOUNT,
    CONTRAST,
    MOVED,
    OUTSIDE_VALUE,
    TONE,
    Nuisances,
    PhotographView,
    System,
    draw,
    linear_count,
    pixel_count,
    write_columns,
)
from sweep.measure.positive_definite import solve_positive
from sweep.model.derivatives import POSE
from sweep.typing import Floats

MIN_SPREAD_PX = 0.2
"""Smallest point spread that is estimated."""

MAX_SPREAD_RATIO = 1.5
"""Largest ratio of the point spreads before and after a step."""

MAX_AMOUNT_CHANGE = 0.25
"""Change of the amount of sharpening above which slopes are computed with the new one at once."""

MIN_OUTSIDE_PX = 1.0
"""Pixels of the area outside, by squares of its shares, below which its level stays as it is."""

MAX_OUTSIDE = 2.0
"""Largest level outside, from black, as a share of the contrast."""

GROUP, TILE = 128, 4
"""Pixels whose columns are multiplied at once, and the side of the tiles of their products."""

NEARLY_SETTLED = 0.25
"""Squared standard deviations of the pose's part of the last undamped step, if no step is found
that lowers the squares, or after all steps: the point spread and the amount of sharpening may be
almost the same."""

SLACK = 0.02
"""Rise of the squares that a step may bring, as a share: tone and sharpening are multiplied in the
model, and each evaluation takes one of the factors from the evaluation before."""


@compiled
def normal_equations(
    view: PhotographView, state: Floats, nuisances: Nuisances, work: System, matrix: Floats
) -> None:
    """Sum up JᵀJ, Jᵀy and yᵀy over the used pixels into ``matrix`` (n + 1, n + 1)."""
    size = matrix.shape[0]
    tiles = (size + TILE - 1) // TILE
    columns, sums = np.zeros((GROUP, TILE * tiles)), np.zeros((TILE * tiles, TILE * tiles))
    filled = 0
    for i in range(len(view.spans)):
        first, last = view.spans[i]
        while first < last:
            count = min(last - first, GROUP - filled)
            write_columns(
                view, state, nuisances, work.images, i, first, columns[filled : filled + count]
            )
            filled += count
            first += count
            if filled == GROUP:
                add_products(columns, filled, sums)
                filled = 0
    add_products(columns, filled, sums)
    for k in range(size):
        for m in range(k + 1):
            matrix[k, m] = matrix[m, k] = sums[k, m]


@compiled
def add_products(columns: Floats, count: int, sums: Floats) -> None:
    """Add the products of the columns of ``count`` pixels to the tiles of the lower triangle."""
    for k in range(0, sums.shape[0], TILE):
        for m in range(0, k + 1, TILE):
            add_tile(columns, k, columns, m, count, sums)


@compiled_inline
def add_tile(left: Floats, k: int, right: Floats, m: int, count: int, sums: Floats) -> None:
    """Add products of four columns of ``left`` from the k-th on with four of ``right``."""
    s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = 0.0
    s20 = s21 = s22 = s23 = s30 = s31 = s32 = s33 = 0.0
    for p in range(count):
        row, other = left[p], right[p]
        a0, a1, a2, a3 = row[k], row[k + 1], row[k + 2], row[k + 3]
        b0, b1, b2, b3 = other[m], other[m + 1], other[m + 2], other[m + 3]
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
    end = free + count
    matrix = np.empty((end + 1, end + 1))
    inner, right = np.empty((count, count)), np.empty((count, free + 1))
    for _ in range(2):
        draw(view, state, nuisances, work)
        normal_equations(view, state, nuisances, work, matrix)
        for k in range(count):
            right[k, free] = matrix[free + k, end]
            for m in range(count):
                inner[k, m] = matrix[free + k, free + m]
            for m in range(free):
                right[k, m] = matrix[free + k, m]
            # What covers no pixel is 0, and what cannot be told from the rest stays small.
            inner[k, k] = inner[k, k] * (1.0 + 1e-9) if inner[k, k] > 0.0 else 1.0
        if nuisances.outside and inner[2, 2] < MIN_OUTSIDE_PX:
            for m in range(count):
                inner[2, m] = inner[m, 2] = 0.0
            for m in range(free + 1):
                right[2, m] = 0.0
            inner[2, 2] = 1.0
        if not solve_positive(inner, right):
            return math.inf
        for k in range(count):
            linear[k] = right[k, free]
        amount = state[AMOUNT]
        keep_linear(state, nuisances, linear)
        if not abs(state[AMOUNT] - amount) > MAX_AMOUNT_CHANGE:
            break
    squares = matrix[end, end]
    for k in range(count):
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
        # The squares fall beyond the limit.
        for k in range(free):
            information[POSE, k] = information[k, POSE] = 0.0
        information[POSE, POSE] = 1.0
        gradient[POSE] = 0.0
    return max(float(squares), 0.0)


@compiled
def keep_linear(state: Floats, nuisances: Nuisances, linear: Floats) -> None:
    """Write what slopes depend on of the linear parameters to a state."""
    contrast = linear[1]
    divisor = contrast if contrast != 0.0 else 1.0
    kept = state[CONTRAST:]
    kept[0], kept[1], kept[2] = contrast, 0.0, 0.0
    k = 2
    if nuisances.outside:
        change = min(max(linear[k] / divisor, -1.0), 1.0)
        state[OUTSIDE_VALUE] = min(max(state[OUTSIDE_VALUE] + change, -1.0), MAX_OUTSIDE)
        k += 1
    if nuisances.tone:
        state[TONE] = linear[k] / divisor
        k += 1
    if nuisances.sharpening:
        state[AMOUNT] = linear[k] / divisor
        k += 1
    if nuisances.light:
        kept[1], kept[2] = linear[k + 2], linear[k + 3]


@compiled
def stepped(state: Floats, step: Floats) -> Floats:
    """Return the state after a step of the moved parameters."""
    moved = moved_state(state, step, 1.0)
    least, most = state[SPREAD] / MAX_SPREAD_RATIO, state[SPREAD] * MAX_SPREAD_RATIO
    moved[SPREAD] = max(min(max(moved[SPREAD], least), most), MIN_SPREAD_PX)
    return moved


@compiled
def fit_photograph(
    view: PhotographView, state: Floats, nuisances: Nuisances, work: System, most_steps: int,
    settled: float, information: Floats, linear: Floats,
) -> tuple[float, bool]:
    """Move ``state`` to the nearest minimum of the sum of squared residuals.

    Returns that sum, and whether the minimum was reached: the undamped Newton step is shorter than
    ``settled`` squared standard deviations (of residuals as noise), and is taken. The sum after it
    is the one that it predicts.
    """
    free, count = MOVED, linear_count(nuisances)
    freedom = max(pixel_count(view) - free - count, 1)
    gradient = np.empty(free)
    trial_information, trial_gradient = np.empty((free, free)), np.empty(free)
    trial_linear = np.empty(count)
    squares = evaluate(view, state, nuisances, work, information, gradient, linear)
    damping = 1e-3
    of_pose = math.inf
    last_change = 0.0
    for _ in range(most_steps):
        if not squares < math.inf:
            break
        newton = gradient.copy().reshape(free, 1)
        regular = information.copy()
        for k in range(free):
            regular[k, k] = regular[k, k] * (1.0 + 1e-9) + 1e-300
        regular_spread = regular[POSE, POSE]
        if solve_positive(regular, newton):
            decrement = 0.0
            for k in range(free):
                decrement += gradient[k] * newton[k, 0]
            # The rest is the step of the point spread at the pose that it is best for.
            of_pose = decrement - gradient[POSE] ** 2 / regular_spread
            if decrement < settled * (squares / freedom):
                moved = stepped(state, newton[:, 0])
                if is_before_camera(moved, view.marker):
                    overwrite(state, moved)
                return squares - decrement, True
        accepted = False
        for _attempt in range(8):
            damped = information.copy()
            step = gradient.copy().reshape(free, 1)
            for k in range(free):
                damped[k, k] += damping * information[k, k] + 1e-300
            if not solve_positive(damped, step):
                damping = max(10.0 * damping, 1e-3)
                continue
            if step[POSE, 0] * last_change < 0.0 and abs(step[POSE, 0]) > 0.5 * abs(last_change):
                # Sharpening and point spread are almost the same: the step may be twice too long.
                step[POSE, 0] *= 0.5
            trial = stepped(state, step[:, 0])
            if is_before_camera(trial, view.marker):
                trial_squares = evaluate(
                    view, trial, nuisances, work, trial_information, trial_gradient, trial_linear
                )
                if trial_squares < squares * (1.0 + SLACK):
                    accepted = True
                    break
            damping = max(8.0 * damping, 1e-3)
        if not accepted:
            break
        squares, last_change = trial_squares, trial[SPREAD] ** 2 - state[SPREAD] ** 2
        overwrite(state, trial)
        overwrite(gradient, trial_gradient)
        overwrite(linear, trial_linear)
        for k in range(free):
            overwrite(information[k], trial_information[k])
        damping *= 0.1
    return squares, of_pose < NEARLY_SETTLED * (squares / freedom)
