"""Pose from the pixels of a real image: what else is printed, light and camera are in the model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sweep.compilation import compiled, compiled_inline
from sweep.measure.estimation import Detections, Estimates
from sweep.measure.flags import EstimateStatus
from sweep.measure.likelihood import (
    DEPTH,
    POSITION,
    SPREAD,
    is_before_camera,
    mirrored_state,
    moved_state,
    noise_variance,
    overwrite,
    rotation_of,
    solve_positive,
    turn_between,
)
from sweep.measure.photograph_model import (
    AMOUNT,
    CONTRAST,
    MOVED,
    OUTSIDE_VALUE,
    STATE_LENGTH,
    TONE,
    Nuisances,
    PhotographView,
    System,
    binned_photograph,
    draw,
    linear_count,
    photograph_view,
    pixel_count,
    system,
    write_columns,
)
from sweep.measure.photometric import refined_corners
from sweep.measure.solver import both_planar_solutions, reprojection_errors_px
from sweep.model.derivatives import POSE
from sweep.model.marker import OUTSIDE
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The fit of a printed plane to a photograph: pose, point spread, and what cameras do to levels.
#
# The linear parameters of the model (:mod:`sweep.measure.photograph_model`) are solved for at
# each step, as in :mod:`sweep.measure.likelihood`; the pose and the point spread's variance are
# moved by Levenberg-Marquardt.

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


# --------------------------------------------------------------------------------------------------
# What residuals of a fitted photograph say: noise, its correlation, and misfit of the geometry.
#
# Least squares need no model of the noise for the pose, but for its covariance. The residuals
# tell two sources. Noise of pixels is correlated from pixel to pixel, as cameras smooth, sharpen
# and compress: its covariance between pixels is taken as variance · x^|columns| · y^|rows|, with
# x and y the correlations of neighbours. The rest is geometry: parts of the marker lie beside the
# plane's image (lens, rolling shutter, bent sheet, rows of a screen). A field of shifts, bilinear
# between :data:`NODES` x :data:`NODES` nodes over the marker, accounts for it: both components
# have the standard deviation s and the correlation exp(-distance / :data:`CORRELATED`), R. On
# photographs a marker as a whole is shifted about as much as its parts are against each other,
# and only the latter are in residuals. s² is estimated by moments: with D the levels' slopes by
# the nodes' shifts after those by the fitted parameters have been eliminated, S = DᵀD, and u =
# Dᵀr of residuals r, E uᵀu = s² tr(S R S) + noise. ``misfit_px`` is what the parts are shifted
# against each other, the same with R = 1.
#
# The covariance of the pose is A⁻¹ Jᵀ (N + s² E R Eᵀ) J A⁻¹ with A = JᵀJ, N the noise's
# covariance and E the slopes by the shifts as such: White, "A heteroskedasticity-consistent
# covariance matrix estimator and a direct test for heteroskedasticity", Econometrica 48, 1980,
# for the form.

NODES = 4
"""Nodes of the field of shifts along each side of the marker."""

CORRELATED = 1.0
"""Distance at which the correlation of shifts is 1/e, in halves of the marker's extent. With 1 the
squared errors of poses on photographs of boards are about those expected; if shifts were
independent, they would be two to three times that."""

LARGEST_SHIFT_PX = 1.0
"""Standard deviation of shifts before the residuals are seen; keeps what they do not tell small."""

SIGNIFICANT = 2.0
"""Standard deviations by which shifts must exceed what noise brings about."""

MAX_CORRELATION = 0.9
"""Largest correlation of neighbouring pixels that is assumed."""

HELD = 8
"""Components of nodes that move a pixel's level: two of each of the four nodes around it."""

WIDE, RESIDUAL = 2 * TILE, POSE
"""Numbers kept of each pixel: the pose's six changes by its level, and its residual."""


class Judgement(NamedTuple):
    """What residuals say beside the covariance.

    Attributes
    ----------
    exists
        Whether the covariance exists.
    noise
        Standard deviation of a pixel in grey levels.
    across, along
        Its correlation with the next pixel along x, and along y.
    misfit_px
        Standard deviation of the shifts of the marker's parts against each other.
    """

    exists: bool
    noise: float
    across: float
    along: float
    misfit_px: float


@compiled
def _node(at: float) -> int:
    """Return the node before a coordinate from -1 to 1."""
    return min(int(min(max(0.5 * (at + 1.0), 0.0), 1.0) * (NODES - 1)), NODES - 2)


@compiled
def _component(cell: int, k: int) -> int:
    """Return the number, among all components, of the k-th of those that a cell holds."""
    row, column = cell // (NODES - 1), cell % (NODES - 1)
    return 2 * ((row + k // 4) * NODES + column + k // 2 % 2) + k % 2


@compiled
def _write_shifts(
    view: PhotographView, state: Floats, images: Floats, i: int, first: int, cell: int,
    columns: Floats, k: int,
) -> None:
    """Write the slopes by the components of a cell's nodes as columns (n, ...) from the k-th on."""
    top, left = float(cell // (NODES - 1)), float(cell % (NODES - 1))
    for j in range(len(columns)):
        at_x, at_y = view.at[0, i, first + j], view.at[1, i, first + j]
        scale = state[CONTRAST] + state[CONTRAST + 1] * at_x + state[CONTRAST + 2] * at_y
        right = min(max(0.5 * (at_x + 1.0), 0.0), 1.0) * (NODES - 1) - left
        down = min(max(0.5 * (at_y + 1.0), 0.0), 1.0) * (NODES - 1) - top
        by_x, by_y = -scale * images[2, i, first + j], -scale * images[3, i, first + j]
        column = columns[j]
        column[k], column[k + 1] = (1 - down) * (1 - right) * by_x, (1 - down) * (1 - right) * by_y
        column[k + 2], column[k + 3] = (1 - down) * right * by_x, (1 - down) * right * by_y
        column[k + 4], column[k + 5] = down * (1 - right) * by_x, down * (1 - right) * by_y
        column[k + 6], column[k + 7] = down * right * by_x, down * right * by_y


@compiled
def _run_of_a_cell(view: PhotographView, i: int, first: int, last: int) -> tuple[int, int]:
    """Return the cell of nodes of a row's pixel, and the pixel after the last of that cell."""
    row, column = _node(view.at[1, i, first]), _node(view.at[0, i, first])
    stop = first + 1
    while (
        stop < min(last, first + GROUP)
        and _node(view.at[0, i, stop]) == column and _node(view.at[1, i, stop]) == row
    ):
        stop += 1
    return row * (NODES - 1) + column, stop


@compiled
def _write_cell(
    view: PhotographView, state: Floats, nuisances: Nuisances, images: Floats, i: int, first: int,
    size: int, columns: Floats,
) -> tuple[int, int]:
    """Write the columns of a row's pixels of one cell: by parameters, the level, by shifts.

    ``first`` is the first pixel. Returns the cell, and the pixel after the last.
    """
    cell, stop = _run_of_a_cell(view, i, first, view.spans[i, 1])
    group = columns[: stop - first]
    write_columns(view, state, nuisances, images, i, first, group)
    _write_shifts(view, state, images, i, first, cell, group, size + 1)
    return cell, stop


@compiled
def _products(
    view: PhotographView, state: Floats, nuisances: Nuisances, images: Floats, size: int
) -> Floats:
    """Return the products (cells, n, n) of the columns of each cell's pixels.

    Columns are those by the ``size`` parameters, the level, and those by the nodes' components.
    """
    tiles = (size + 1 + HELD + TILE - 1) // TILE
    sums = np.zeros(((NODES - 1) ** 2, TILE * tiles, TILE * tiles))
    columns = np.zeros((GROUP, TILE * tiles))
    for i in range(len(view.spans)):
        first, last = view.spans[i]
        while first < last:
            cell, stop = _write_cell(view, state, nuisances, images, i, first, size, columns)
            add_products(columns, stop - first, sums[cell])
            first = stop
    return sums


@compiled
def _correlated_products(
    field: Floats, view: PhotographView, across: float, along: float
) -> Floats:
    """Return the sum (6, 6) over pairs of pixels of their products times the noise's correlation.

    ``field`` (height, width, WIDE) has the six numbers of each pixel; those not fitted are 0. The
    sum over pairs is that over a pixel's own row and the rows above, and its transpose.
    """
    height, width, _ = field.shape
    above, pairs = np.zeros((width, WIDE)), np.zeros((width, WIDE))
    passed, sums = np.empty((width, POSE)), np.zeros((WIDE, WIDE))
    for i in range(height):
        row = field[i]
        a = b = c = d = e = f = 0.0
        for j in range(width):
            at, before = row[j], passed[j]
            before[0], before[1], before[2], before[3], before[4], before[5] = a, b, c, d, e, f
            a, b, c = across * (a + at[0]), across * (b + at[1]), across * (c + at[2])
            d, e, f = across * (d + at[3]), across * (e + at[4]), across * (f + at[5])
        a = b = c = d = e = f = 0.0
        for j in range(width - 1, -1, -1):
            at, before, sum_above, pair = row[j], passed[j], above[j], pairs[j]
            a, b, c, d, e, f = a + at[0], b + at[1], c + at[2], d + at[3], e + at[4], f + at[5]
            before[0], before[1], before[2] = before[0] + a, before[1] + b, before[2] + c
            before[3], before[4], before[5] = before[3] + d, before[4] + e, before[5] + f
            a, b, c = across * a, across * b, across * c
            d, e, f = across * d, across * e, across * f
            for m in range(POSE):
                weighted = along * sum_above[m]
                sum_above[m] = weighted + before[m]
                pair[m] = 2.0 * weighted + before[m]
        first, last = view.spans[i]
        for k in range(0, WIDE, TILE):
            for m in range(0, WIDE, TILE):
                add_tile(row[first:last], k, pairs[first:last], m, last - first, sums)
    products = np.empty((POSE, POSE))
    for k in range(POSE):
        for m in range(POSE):
            products[k, m] = 0.5 * (sums[k, m] + sums[m, k])
    return products


@compiled
def _lagged(field: Floats, view: PhotographView, down: int, right: int) -> float:
    """Return the mean product of residuals of fitted pixels a lag apart."""
    total, count = 0.0, 0
    for i in range(len(field) - down):
        first = max(view.spans[i, 0], view.spans[i + down, 0] - right)
        last = min(view.spans[i, 1], view.spans[i + down, 1] - right)
        row, other = field[i], field[i + down]
        for j in range(first, last):
            total += row[j, RESIDUAL] * other[j + right, RESIDUAL]
        count += max(last - first, 0)
    return total / max(count, 1)


@compiled
def _ratio(lagged: float, variance: float) -> float:
    """Return a correlation within bounds."""
    if not variance > 0.0:
        return 0.0
    return min(max(lagged / variance, -MAX_CORRELATION), MAX_CORRELATION)


@compiled
def _correlations() -> Floats:
    """Return the correlations (n, n) of the components of the nodes' shifts."""
    count = 2 * NODES * NODES
    correlations = np.zeros((count, count))
    for a in range(count):
        for b in range(count):
            if a % 2 == b % 2:
                across = a // 2 % NODES - b // 2 % NODES
                down = a // 2 // NODES - b // 2 // NODES
                distance = 2.0 / (NODES - 1) * math.sqrt(across**2 + down**2)
                correlations[a, b] = math.exp(-distance / CORRELATED)
    return correlations


@compiled
def judge(
    view: PhotographView, state: Floats, nuisances: Nuisances, work: System, covariance: Floats
) -> Judgement:
    """Write the pose's covariance (6, 6) in radians and metres at a fitted state.

    ``work.images`` are those of the state, or of the last evaluation before it.
    """
    size = MOVED + linear_count(nuisances)
    height, width = view.levels.shape
    pixels, nodes = pixel_count(view), 2 * NODES * NODES
    none = Judgement(False, math.nan, math.nan, math.nan, math.nan)
    sums = _products(view, state, nuisances, work.images, size)
    matrix, levels = np.zeros((size, size)), np.zeros((size, 1))
    crossed, inner, pull = np.zeros((size, nodes)), np.zeros((nodes, nodes)), np.zeros((nodes, 1))
    for cell in range(len(sums)):
        of_cell = sums[cell]
        for k in range(size):
            levels[k, 0] += of_cell[size, k]
            for m in range(size):
                matrix[k, m] += of_cell[max(k, m), min(k, m)]
        for a in range(HELD):
            at = _component(cell, a)
            row = of_cell[size + 1 + a]
            pull[at, 0] += row[size]
            for k in range(size):
                crossed[k, at] += row[k]
            for b in range(HELD):
                inner[at, _component(cell, b)] += of_cell[
                    size + 1 + max(a, b), size + 1 + min(a, b)
                ]
    inverse = np.eye(size)
    for k in range(size):
        matrix[k, k] = matrix[k, k] * (1.0 + 1e-9) if matrix[k, k] > 0.0 else 1.0
    freedom = pixels - size - nodes
    if freedom < 1 or not solve_positive(matrix, inverse):
        return none
    influence, fitted = _product(inverse, crossed), _product(inverse, levels)
    schur = inner - _product(crossed.T, influence)
    pull -= _product(crossed.T, fitted)
    shifts, ridged = pull.copy(), schur.copy()
    mean_square = 0.0
    for cell in range(len(sums)):
        mean_square += sums[cell, size, size] / pixels
    for k in range(size):
        mean_square -= fitted[k, 0] * levels[k, 0] / pixels
    for k in range(nodes):
        ridged[k, k] += max(mean_square, 0.0) / LARGEST_SHIFT_PX**2 + 1e-12
    if not solve_positive(ridged, shifts):
        return none
    # What is left after the best field of shifts is noise.
    fitted -= _product(influence, shifts)
    field = np.zeros((height, width, WIDE))
    _write_residuals(view, state, nuisances, work.images, inverse, fitted, shifts, field)
    variance = _lagged(field, view, 0, 0)
    across = _ratio(_lagged(field, view, 0, 1), variance)
    along = _ratio(_lagged(field, view, 1, 0), variance)
    variance *= pixels / freedom
    products = _correlated_products(field, view, across, along)
    for m in range(POSE):
        for k in range(POSE):
            covariance[m, k] = variance * products[m, k]
    raised = 0.0
    for m in range(POSE):
        raised += covariance[m, m] / (variance * inverse[m, m] * POSE) if variance > 0.0 else 0.0
    correlations = _correlations()
    spread = _product(schur, schur)
    noise_pull = expected = trace = square_trace = 0.0
    for a in range(nodes):
        noise_pull += pull[a, 0] ** 2
        trace += schur[a, a]
        for b in range(nodes):
            expected += correlations[a, b] * spread[a, b]
            square_trace += schur[a, b] ** 2
    # The noise alone gives a pull of that mean, and of this standard deviation.
    excess = noise_pull - raised * variance * trace
    chance = SIGNIFICANT * raised * variance * math.sqrt(2.0 * square_trace)
    shift_variance = excess / expected if excess > chance else 0.0
    misfit = math.sqrt(excess / square_trace) if excess > chance else 0.0
    of_pose = influence[:POSE]
    shifted = _product(of_pose, _product(correlations, of_pose.T))
    distance = abs(state[DEPTH])
    for m in range(POSE):
        for k in range(POSE):
            covariance[m, k] += shift_variance * shifted[m, k]
            covariance[m, k] *= (distance if m >= 3 else 1.0) * (distance if k >= 3 else 1.0)
    return Judgement(True, math.sqrt(variance), across, along, misfit)


@compiled
def _write_residuals(
    view: PhotographView, state: Floats, nuisances: Nuisances, images: Floats, inverse: Floats,
    fitted: Floats, shifts: Floats, field: Floats,
) -> None:
    """Write the pose's changes by the pixels' levels, and residuals, to ``field``."""
    size = len(fitted)
    columns, weights = np.empty((GROUP, size + 1 + HELD)), np.zeros((size + 1, WIDE))
    of_cell = np.empty(HELD)
    weights[size, RESIDUAL] = 1.0
    for k in range(size):
        weights[k, RESIDUAL] = -fitted[k, 0]
        for m in range(POSE):
            weights[k, m] = inverse[k, m]
    for i in range(len(view.spans)):
        first, last = view.spans[i]
        while first < last:
            cell, stop = _write_cell(view, state, nuisances, images, i, first, size, columns)
            for a in range(HELD):
                of_cell[a] = shifts[_component(cell, a), 0]
            for j in range(stop - first):
                column, out = columns[j], field[i, first + j]
                s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = 0.0
                for k in range(size + 1):
                    value, weight = column[k], weights[k]
                    s0, s1 = s0 + value * weight[0], s1 + value * weight[1]
                    s2, s3 = s2 + value * weight[2], s3 + value * weight[3]
                    s4, s5 = s4 + value * weight[4], s5 + value * weight[5]
                    s6, s7 = s6 + value * weight[6], s7 + value * weight[7]
                for a in range(HELD):
                    s6 -= column[size + 1 + a] * of_cell[a]
                out[0], out[1], out[2], out[3] = s0, s1, s2, s3
                out[4], out[5], out[6], out[7] = s4, s5, s6, s7
            first = stop


@compiled
def _product(left: Floats, right: Floats) -> Floats:
    """Return the product of two matrices, summed in the order of their rows."""
    product = np.zeros((left.shape[0], right.shape[1]))
    for i in range(left.shape[0]):
        for k in range(left.shape[1]):
            for j in range(right.shape[1]):
                product[i, j] += left[i, k] * right[k, j]
    return product


# --------------------------------------------------------------------------------------------------
# Pose from the pixels of a real image: what else is printed, light and camera are in the model.
#
# Least squares on the pixels of the marker and of its own quiet zone
# (:mod:`sweep.measure.photograph`). Starts are both planar solutions of the detected corners;
# each is first fitted to the means of 2 x 2 pixels with the levels and the point spread alone,
# the best is fitted to the pixels, and so is its mirror unless the coarse fits rule it out.

COARSE_STEPS, FINE_STEPS = 10, 30
SETTLED, COARSELY_SETTLED = 16.0, 4.0
"""Squared standard deviations of the last undamped step, of the pixels and of their means. The step
is taken: near the minimum the one after it is a hundredth as long, or with sharpening a quarter.
Poses on boards of 50 px differ by 0.02 standard deviations, root mean square, from those of a fit
that goes on to the end."""

FIRST_SPREAD_PX = 0.7
"""Point spread at which fits start."""

SAME_TURN_RAD = 1e-3
"""Poses whose rotations differ by less than this are the same."""

CONTEST = 50.0
"""Excess of chi-square over the best coarse fit's above which a mirrored pose is given up. Of poses
on photographs of boards, fits of all pixels chose the mirror at an excess of at most 44."""

MIN_CONTRAST = 1.0
"""Difference of white and black in grey levels below which there is no marker in the pixels."""

MAX_MISFIT_PX = 0.5
"""Standard deviation of the shifts of the marker's parts above which a pose is not explained."""


class Located(NamedTuple):
    """The pose at which a fit ended.

    Attributes
    ----------
    state, other
        The best state, and that of the next minimum; NaN if there is none.
    squares
        Sum of squared residuals; infinite without a pose.
    reached
        Whether the minimum was.
    freedom
        Fitted pixels less parameters.
    contrast
        White minus black in grey levels.
    judgement
        What the residuals say.
    """

    state: Floats
    other: Floats
    squares: float
    reached: bool
    freedom: int
    contrast: float
    judgement: Judgement


@compiled
def locate_photograph(
    view: PhotographView, starts: Floats, tried: int, nuisances: Nuisances, covariance: Floats
) -> Located:
    """Fit a view's pixels; ``covariance`` (6, 6) gets the pose's in radians and metres.

    ``starts`` (K, STATE_LENGTH) are states: the first ``tried`` are, the others if none of those
    comes to a minimum.
    """
    best, other = np.full(STATE_LENGTH, math.nan), np.full(STATE_LENGTH, math.nan)
    judgement = Judgement(False, math.nan, math.nan, math.nan, math.nan)
    freedom = pixel_count(view) - MOVED - linear_count(nuisances)
    if freedom < 1:
        return Located(best, other, math.inf, False, freedom, 0.0, judgement)
    coarse = binned_photograph(view)
    coarse_work = system(coarse.levels.shape[0], coarse.levels.shape[1])
    work = system(view.levels.shape[0], view.levels.shape[1])
    simple = Nuisances(nuisances.outside, False, nuisances.tone, nuisances.sharpening,
                       0.5 * nuisances.radius_px)
    information = np.empty((MOVED, MOVED))
    plain = Nuisances(nuisances.outside, False, False, False, 1.0)
    coarse_linear, plain_linear = np.empty(linear_count(simple)), np.empty(linear_count(plain))
    linear, trial_linear = np.empty(linear_count(nuisances)), np.empty(linear_count(nuisances))

    def coarse_fit(state: Floats) -> tuple[float, bool]:
        """Fit a state to the means of 2 x 2 pixels, whose point spread is half as wide."""
        state[SPREAD] *= 0.5
        start = state.copy()
        level, settled = fit_photograph(
            coarse, state, simple, coarse_work, COARSE_STEPS, COARSELY_SETTLED, information,
            coarse_linear,
        )
        if not settled:
            # Far from the pose, sharpening and tone lead astray.
            overwrite(state, start)
            fit_photograph(
                coarse, state, plain, coarse_work, COARSE_STEPS, COARSELY_SETTLED, information,
                plain_linear,
            )
            level, settled = fit_photograph(
                coarse, state, simple, coarse_work, COARSE_STEPS, COARSELY_SETTLED, information,
                coarse_linear,
            )
        state[SPREAD] *= 2.0
        return level, settled

    first, lowest, any_settled = best.copy(), math.inf, False
    contrast = _first_contrast(view)
    for k in range(len(starts)):
        if k >= tried and any_settled:
            break
        if is_before_camera(starts[k], view.marker):
            state = starts[k].copy()
            state[CONTRAST] = contrast
            level, settled = coarse_fit(state)
            any_settled = any_settled or settled
            if level < lowest:
                lowest = level
                overwrite(first, state)
    if not lowest < math.inf:
        return Located(best, other, math.inf, False, freedom, 0.0, judgement)
    rival = mirrored_state(first)
    excess = math.inf
    if is_before_camera(rival, view.marker):
        away = turn_between(rival, first)
        level, _ = coarse_fit(rival)
        if turn_between(rival, first) > 0.5 * away:
            excess = (level / lowest - 1.0) * pixel_count(coarse)
            if level < lowest:
                excess = (lowest / level - 1.0) * pixel_count(coarse)
                state = first.copy()
                overwrite(first, rival)
                overwrite(rival, state)
    overwrite(best, first)
    squares, reached = fit_photograph(
        view, best, nuisances, work, FINE_STEPS, SETTLED, information, linear
    )
    if excess < math.inf:
        overwrite(other, rival)
    if excess < CONTEST:
        level, rival_reached = fit_photograph(
            view, rival, nuisances, work, FINE_STEPS, SETTLED, information, trial_linear
        )
        overwrite(other, np.full(STATE_LENGTH, math.nan))
        draw(view, best, nuisances, work)
        if turn_between(rival, best) > SAME_TURN_RAD:
            overwrite(other, rival)
            if level < squares and (rival_reached or not reached):
                overwrite(other, best)
                overwrite(best, rival)
                overwrite(linear, trial_linear)
                squares, reached = level, rival_reached
                draw(view, best, nuisances, work)
    if reached:
        judgement = judge(view, best, nuisances, work, covariance)
    return Located(best, other, squares, reached, freedom, linear[1], judgement)


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
        positions = np.full((count, 2, 3), np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):  # three corners on a line
            squares = from_unit_square(detections.corners)
        # The first of the two solutions of each set of corners, then the others.
        order = np.argsort(np.arange(turns.shape[1]) % 2, kind="stable")
        reach = math.ceil(3 * self.radius_px) if self.sharpening else 0
        for i in range(count):
            starts = _starts(turns[i, order], shifts[i, order])
            view = photograph_view(detections, i, squares[i], reach) if len(starts) else None
            if view is not None:
                self._estimate(detections, i, view, starts, len(sets), out, positions)
        for turn, position, error in (
            (out.rotation, positions[:, 0], out.reprojection_px),
            (out.alternative_rotation, positions[:, 1], out.alternative_reprojection_px),
        ):
            known = np.flatnonzero(np.isfinite(position).all(axis=1))
            if len(known):
                error[known] = reprojection_errors_px(
                    turn[known], position[known], detections.size_m[known],
                    detections.corners[known], detections.cameras.take(known),
                )
        return out

    def _estimate(
        self, detections: Detections, i: int, view: PhotographView, starts: Floats, tried: int,
        out: Estimates, positions: Floats,
    ) -> None:
        """Write the estimate of one detection to ``out``, and the positions of both poses."""
        outside = bool((view.marker.edges.sides == OUTSIDE).any())
        nuisances = Nuisances(outside, self.light, self.tone, self.sharpening, self.radius_px)
        covariance = np.empty((6, 6))
        found = locate_photograph(view, starts, tried, nuisances, covariance)
        if not math.isfinite(found.squares):
            return
        if not found.reached:
            out.status[i] = EstimateStatus.not_converged
            return
        judgement = found.judgement
        largest = covariance.diagonal()[:3].max() if judgement.exists else math.inf
        if abs(found.contrast) < MIN_CONTRAST or not largest < math.pi**2:
            return
        out.status[i] = (
            EstimateStatus.not_explained if judgement.misfit_px > MAX_MISFIT_PX
            else EstimateStatus.solved
        )
        out.rotation[i], out.translation[i] = rotation_of(found.state), found.state[POSITION]
        out.alternative_rotation[i] = rotation_of(found.other)
        positions[i] = found.state[POSITION], found.other[POSITION]
        out.covariance[i] = covariance
        out.misfit_px[i] = judgement.misfit_px
        out.residual_ratio[i] = found.squares / (
            noise_variance(float(detections.noise_grey[i])) * found.freedom
        )


@compiled
def _first_contrast(view: PhotographView) -> float:
    """Return a contrast to begin with: twice the standard deviation, as if half were white."""
    total = squares = 0.0
    for i in range(len(view.spans)):
        for j in range(view.spans[i, 0], view.spans[i, 1]):
            total += view.levels[i, j]
            squares += view.levels[i, j] ** 2
    count = pixel_count(view)
    return 2.0 * math.sqrt(max(squares / count - (total / count) ** 2, 0.0)) + 1e-3


def _starts(rotation: Floats, translation: Floats) -> Floats:
    """Return the states (K, STATE_LENGTH) of the finite ones of M poses (M, 3, 3), (M, 3)."""
    states = np.zeros((len(rotation), STATE_LENGTH))
    states[:, :9], states[:, POSITION] = rotation.reshape(-1, 9), translation
    states[:, SPREAD] = FIRST_SPREAD_PX
    return np.asarray(states[np.isfinite(states).all(axis=1)])


def from_unit_square(quads: Floats) -> Floats:
    """Return the homographies (P, 3, 3) of the unit square to quadrilaterals (P, 4, 2).

    (0, 0), (1, 0), (1, 1), (0, 1) become the corners in their order. From Heckbert, "Fundamentals
    of texture mapping and image warping" (1989), section 2.2.3.
    """
    p0, p1, p2, p3 = (quads[:, k] for k in range(4))
    d1, d2, total = p1 - p2, p3 - p2, p0 - p1 + p2 - p3

    def cross(a: Floats, b: Floats) -> Floats:
        return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])

    area = cross(d1, d2)
    g, h = (cross(total, d2) / area)[:, None], (cross(d1, total) / area)[:, None]
    out = np.ones((len(quads), 3, 3))
    out[:, :2, 0], out[:, :2, 1], out[:, :2, 2] = p1 - p0 + g * p1, p3 - p0 + h * p3, p0
    out[:, 2, :2] = np.column_stack([g, h])
    return out
