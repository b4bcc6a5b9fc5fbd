"""What residuals of a fitted photograph say: noise, its correlation, and misfit of the geometry.

Least squares need no model of the noise for the pose, but for its covariance. The residuals tell
two sources. Noise of pixels is correlated from pixel to pixel, as cameras smooth, sharpen and
compress: its covariance between pixels is taken as variance · x^|columns| · y^|rows|, with x and y
the correlations of neighbours. The rest is geometry: parts of the marker lie beside the plane's
image (lens, rolling shutter, bent sheet, rows of a screen). A field of shifts, bilinear between
:data:`NODES` x :data:`NODES` nodes over the marker, accounts for it: both components have the
standard deviation s and the correlation exp(-distance / :data:`CORRELATED`), R. On photographs a
marker as a whole is shifted about as much as its parts are against each other, and only the latter
are in residuals. s² is estimated by moments: with D the levels' slopes by the nodes' shifts after
those by the fitted parameters have been eliminated, S = DᵀD, and u = Dᵀr of residuals r,
E uᵀu = s² tr(S R S) + noise. ``misfit_px`` is what the parts are shifted against each other, the
same with R = 1.

The covariance of the pose is A⁻¹ Jᵀ (N + s² E R Eᵀ) J A⁻¹ with A = JᵀJ, N the noise's covariance
and E the slopes by the shifts as such: White, "A heteroskedasticity-consistent covariance matrix
estimator and a direct test for heteroskedasticity", Econometrica 48, 1980, for the form.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sweep.compilation import compiled
from sweep.measure.likelihood import DEPTH
from sweep.measure.photograph_fit import GROUP, TILE, add_products
from sweep.measure.photograph_model import (
    CONTRAST,
    MOVED,
    Nuisances,
    PhotographView,
    System,
    linear_count,
    pixel_count,
    write_columns,
)
from sweep.measure.positive_definite import solve_positive
from sweep.model.derivatives import POSE
from sweep.typing import Floats

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
            cell, stop = _run_of_a_cell(view, i, first, last)
            group = columns[: stop - first]
            write_columns(view, state, nuisances, images, i, first, group)
            _write_shifts(view, state, images, i, first, cell, group, size + 1)
            add_products(columns, stop - first, sums[cell])
            first = stop
    return sums


@compiled
def _summed(field: Floats, across: float, along: float) -> None:
    """Replace fields (height, width, n) by their sums with weights across^|Δx| · along^|Δy|."""
    height, width, count = field.shape
    before = np.empty((width, count))
    for i in range(height):
        row = field[i]
        for j in range(width):
            for k in range(count):
                before[j, k] = row[j, k]
                if j > 0:
                    before[j, k] += across * before[j - 1, k]
        # The sums over the pixels before, the pixel itself included, and over those after it.
        for j in range(width - 2, -1, -1):
            for k in range(count):
                row[j, k] += across * row[j + 1, k]
        for j in range(1, width):
            for k in range(count):
                row[j, k] += across * before[j - 1, k]
    flat = field.reshape(height, width * count)
    passed = flat.copy()
    for i in range(1, height):
        for j in range(width * count):
            passed[i, j] += along * passed[i - 1, j]
    for i in range(height - 2, -1, -1):
        for j in range(width * count):
            flat[i, j] += along * flat[i + 1, j]
    for i in range(1, height):
        for j in range(width * count):
            flat[i, j] += along * passed[i - 1, j]


@compiled
def _lagged(residuals: Floats, view: PhotographView, down: int, right: int) -> float:
    """Return the mean product of residuals of fitted pixels a lag apart; others are 0."""
    total, count = 0.0, 0
    for i in range(len(residuals) - down):
        first = max(view.spans[i, 0], view.spans[i + down, 0] - right)
        last = min(view.spans[i, 1], view.spans[i + down, 1] - right)
        row, other = residuals[i], residuals[i + down]
        for j in range(first, last):
            total += row[j] * other[j + right]
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
    for i in range(height):
        for j in range(view.spans[i, 0], view.spans[i, 1]):
            mean_square += view.levels[i, j] ** 2 / pixels
    for k in range(size):
        mean_square -= fitted[k, 0] * levels[k, 0] / pixels
    for k in range(nodes):
        ridged[k, k] += max(mean_square, 0.0) / LARGEST_SHIFT_PX**2 + 1e-12
    if not solve_positive(ridged, shifts):
        return none
    # What is left after the best field of shifts is noise.
    fitted -= _product(influence, shifts)
    residuals = np.zeros((height, width))
    influences = np.zeros((height, width, POSE))
    _write_residuals(
        view, state, nuisances, work.images, inverse, fitted, shifts, residuals, influences
    )
    variance = _lagged(residuals, view, 0, 0)
    across = _ratio(_lagged(residuals, view, 0, 1), variance)
    along = _ratio(_lagged(residuals, view, 1, 0), variance)
    variance *= pixels / freedom
    fields = influences.copy()
    _summed(fields, across, along)
    covariance[:] = 0.0
    for i in range(height):
        for j in range(view.spans[i, 0], view.spans[i, 1]):
            for m in range(POSE):
                for k in range(POSE):
                    covariance[m, k] += variance * fields[i, j, m] * influences[i, j, k]
    raised = 0.0
    for m in range(POSE):
        raised += covariance[m, m] / (variance * inverse[m, m] * POSE) if variance > 0.0 else 0.0
    correlations = _correlations()
    spread = _product(schur, _product(correlations, schur))
    noise_pull = expected = trace = square_trace = 0.0
    for a in range(nodes):
        noise_pull += pull[a, 0] ** 2
        expected += spread[a, a]
        trace += schur[a, a]
        for b in range(nodes):
            square_trace += schur[a, b] ** 2
    # The noise alone gives a pull of that mean, and of this standard deviation.
    excess = noise_pull - raised * variance * trace
    chance = SIGNIFICANT * raised * variance * math.sqrt(2.0 * square_trace)
    shift_variance = excess / expected if excess > chance else 0.0
    misfit = math.sqrt(excess / square_trace) if excess > chance else 0.0
    shifted = _product(influence, _product(correlations, influence.T))
    distance = abs(state[DEPTH])
    for m in range(POSE):
        for k in range(POSE):
            covariance[m, k] += shift_variance * shifted[m, k]
            covariance[m, k] *= (distance if m >= 3 else 1.0) * (distance if k >= 3 else 1.0)
    return Judgement(True, math.sqrt(variance), across, along, misfit)


@compiled
def _write_residuals(
    view: PhotographView, state: Floats, nuisances: Nuisances, images: Floats, inverse: Floats,
    fitted: Floats, shifts: Floats, residuals: Floats, influences: Floats,
) -> None:
    """Write residuals (height, width), and the pose's changes by them (height, width, 6)."""
    size = len(fitted)
    columns, weights = np.empty((GROUP, size + 1 + HELD)), np.empty((size, POSE))
    for k in range(size):
        for m in range(POSE):
            weights[k, m] = inverse[k, m]
    for i in range(len(view.spans)):
        first, last = view.spans[i]
        while first < last:
            cell, stop = _run_of_a_cell(view, i, first, last)
            group = columns[: stop - first]
            write_columns(view, state, nuisances, images, i, first, group)
            _write_shifts(view, state, images, i, first, cell, group, size + 1)
            for j in range(stop - first):
                column, changes = group[j], influences[i, first + j]
                residual = column[size]
                for k in range(size):
                    residual -= column[k] * fitted[k, 0]
                    for m in range(POSE):
                        changes[m] += column[k] * weights[k, m]
                for a in range(HELD):
                    residual -= column[size + 1 + a] * shifts[_component(cell, a), 0]
                residuals[i, first + j] = residual
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
