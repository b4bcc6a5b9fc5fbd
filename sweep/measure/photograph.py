"""What the residuals of a fitted photograph say of its pose: covariance, noise and misfit."""

from __future__ import annotations

import math

import numpy as np

from sweep.compilation import compiled
from sweep.measure.likelihood import BLACK, DEPTH, WHITE, solve_positive
from sweep.measure.photograph_model import (
    GROUP,
    LINEAR,
    MOVED,
    TILE,
    PhotographView,
    System,
    add_products,
    add_tile,
    draw,
    pixel_count,
    write_columns,
)
from sweep.model.derivatives import POSE
from sweep.typing import Floats

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
# Dᵀr of residuals r, E uᵀu = s² tr(S R S) + noise. The misfit is what the parts are shifted
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
    scale = state[WHITE] - state[BLACK]
    for j in range(len(columns)):
        at_x, at_y = view.at[0, i, first + j], view.at[1, i, first + j]
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
    view: PhotographView, state: Floats, images: Floats, i: int, first: int,
    size: int, columns: Floats,
) -> tuple[int, int]:
    """Write the columns of a row's pixels of one cell: by parameters, the level, by shifts.

    ``first`` is the first pixel. Returns the cell, and the pixel after the last.
    """
    cell, stop = _run_of_a_cell(view, i, first, view.spans[i, 1])
    group = columns[: stop - first]
    write_columns(view, state, state[WHITE] - state[BLACK], images, i, first, group)
    _write_shifts(view, state, images, i, first, cell, group, size + 1)
    return cell, stop


@compiled
def _products(
    view: PhotographView, state: Floats, images: Floats, size: int
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
            cell, stop = _write_cell(view, state, images, i, first, size, columns)
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
    view: PhotographView, state: Floats, work: System, covariance: Floats
) -> float:
    """Write the pose's covariance (6, 6) in radians and metres at a fitted state.

    Returns the standard deviation in px of the shifts of the marker's parts against each other;
    NaN if there is no covariance.

    """
    draw(view, state, work)
    size = MOVED + LINEAR
    height, width = view.levels.shape
    pixels, nodes = pixel_count(view), 2 * NODES * NODES
    sums = _products(view, state, work.images, size)
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
        return math.nan
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
        return math.nan
    # What is left after the best field of shifts is noise.
    fitted -= _product(influence, shifts)
    field = np.zeros((height, width, WIDE))
    _write_residuals(view, state, work.images, inverse, fitted, shifts, field)
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
    return misfit


@compiled
def _write_residuals(
    view: PhotographView, state: Floats, images: Floats, inverse: Floats,
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
            cell, stop = _write_cell(view, state, images, i, first, size, columns)
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
