"""The fit of a printed plane to a photograph: pose, point spread, and what cameras do to levels.

The linear parameters of the model (:mod:`sweep.measure.photograph_model`) are solved for at each
step, as in :mod:`sweep.measure.likelihood`; the pose, the point spread's variance and the amount of
sharpening are moved by Levenberg-Marquardt.
"""

from __future__ import annotations

import math

import numpy as np

from sweep.compilation import compiled, compiled_inline
from sweep.measure.likelihood import SPREAD, is_before_camera, moved_state, overwrite
from sweep.measure.photograph_model import (
    AMOUNT,
    CONTRAST,
    OUTSIDE_VALUE,
    TONE,
    Nuisances,
    PhotographView,
    System,
    columns_at,
    counts,
    draw,
)
from sweep.measure.positive_definite import solve_positive
from sweep.model.derivatives import POSE
from sweep.typing import Floats

MIN_SPREAD_PX = 0.2
"""Smallest point spread that is estimated."""

MIN_AMOUNT, MAX_AMOUNT = -0.9, 5.0
"""Range of the amount of sharpening."""

GROUP, TILE = 64, 4
"""Pixels whose columns are multiplied at once, and the side of the tiles of their products."""

SLACK = 0.5
"""Rise of chi-square that a step may bring: its direction is not exactly that of descent."""



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
