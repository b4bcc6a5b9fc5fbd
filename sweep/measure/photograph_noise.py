"""What residuals of a fitted photograph say: noise, its correlation, and misfit of the geometry.

Least squares need no model of the noise for the pose, but for its covariance. The residuals tell
two sources. Noise of pixels is correlated from pixel to pixel, as cameras smooth, sharpen and
compress: its covariance between pixels is taken as variance · x^|columns| · y^|rows|, with x and y
the correlations of neighbours. The rest is geometry: parts of the marker lie beside the plane's
image (lens, rolling shutter, bent sheet, rows of a screen). A field of shifts, bilinear between
:data:`NODES` x :data:`NODES` nodes over the marker, with independent components of standard
deviation s, accounts for it. s² is estimated by moments: with D the levels' slopes by the nodes'
shifts after those by the fitted parameters have been eliminated, and u = Dᵀr of residuals r,
E uᵀu = s² tr(S²) + noise, S = DᵀD.

The covariance of the pose is A⁻¹ Jᵀ (N + s² E Eᵀ) J A⁻¹ with A = JᵀJ, N the noise's covariance and
E the slopes by the shifts as such: White, "A heteroskedasticity-consistent covariance matrix
estimator and a direct test for heteroskedasticity", Econometrica 48, 1980, for the form.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.measure.likelihood import DEPTH
from sweep.measure.photograph_fit import normal_equations
from sweep.measure.photograph_model import (
    CONTRAST,
    Nuisances,
    PhotographView,
    System,
    columns_at,
    counts,
    draw,
)
from sweep.measure.positive_definite import solve_positive
from sweep.model.derivatives import POSE
from sweep.typing import Floats, Integers

NODES = 4
"""Nodes of the field of shifts along each side of the marker."""

LARGEST_SHIFT_PX = 1.0
"""Standard deviation of shifts before the residuals are seen; keeps what they do not tell small."""

SIGNIFICANT = 2.0
"""Standard deviations by which shifts must exceed what noise brings about."""

LONGEST_LAG = 5
"""Pixels beyond which the noise is taken as independent."""

FLAT_PX = 1e-3
"""Slope of a pixel, as a share of the contrast, below which shifts do not move it."""

MAX_CORRELATION = 0.9
"""Largest correlation of neighbouring pixels that is assumed."""


@compiled
def _tents(at: float) -> tuple[int, float]:
    """Return the node before a coordinate from -1 to 1, and the share of the next node."""
    along = min(max(0.5 * (at + 1.0), 0.0), 1.0) * (NODES - 1)
    node = min(int(along), NODES - 2)
    return node, along - node


@compiled
def _lagged(residuals: Floats, used: NDArray[np.bool_], down: int, right: int) -> float:
    """Return the mean product of residuals of used pixels a lag apart."""
    total, count = 0.0, 0
    for i in range(residuals.shape[0] - down):
        for j in range(residuals.shape[1] - right):
            if used[i, j] and used[i + down, j + right]:
                total += residuals[i, j] * residuals[i + down, j + right]
                count += 1
    return total / max(count, 1)


@compiled
def _correlated(field: Floats, across: float, along: float) -> Floats:
    """Return a field (height, width) summed with weights across^|Δx| · along^|Δy|."""
    height, width = field.shape
    rows, out = field.copy(), np.zeros_like(field)
    for i in range(height):
        weight = 1.0
        for lag in range(1, min(LONGEST_LAG, width - 1) + 1):
            weight *= across
            for j in range(width - lag):
                rows[i, j] += weight * field[i, j + lag]
                rows[i, j + lag] += weight * field[i, j]
    for i in range(height):
        weight = 1.0
        for j in range(width):
            out[i, j] += rows[i, j]
        for lag in range(1, min(LONGEST_LAG, height - 1) + 1):
            weight *= along
            if i + lag < height:
                for j in range(width):
                    out[i, j] += weight * rows[i + lag, j]
                    out[i + lag, j] += weight * rows[i, j]
    return out


@compiled
def judge(
    view: PhotographView, state: Floats, nuisances: Nuisances, work: System, linear: Floats,
    covariance: Floats,
) -> tuple[bool, float, float, float, float]:
    """Write the pose's covariance (6, 6) in radians and metres at a fitted state.

    Returns
    -------
    tuple
        Whether the covariance exists; the noise of a pixel in grey levels; its correlations with
        the next pixel along x and along y; and the misfit in px, the standard deviation of the
        shifts of the marker's parts.
    """
    free, count = counts(nuisances)
    size = free + count
    height, width = view.used.shape
    draw(view, state, nuisances, work)
    full = np.empty((size + 1, size + 1))
    normal_equations(view, state, nuisances, work, full)
    matrix = full[:size, :size].copy()
    nodes = 2 * NODES * NODES
    crossed = np.zeros((size, nodes))
    inner = np.zeros((nodes, nodes))
    pull = np.zeros((nodes, 1))
    residuals = np.zeros((height, width))
    column = np.empty(size + 1)
    held, shares = np.empty(8, dtype=np.int64), np.empty(8)
    pixels = 0
    for i in range(height):
        for j in range(width):
            if not view.used[i, j]:
                continue
            pixels += 1
            columns_at(view, state, nuisances, work.images, i, j, column)
            residual = column[size]
            for k in range(count):
                residual -= linear[k] * column[free + k]
            residuals[i, j] = residual
            if not _shift_slopes(view, state, work, i, j, held, shares):
                continue
            for a in range(8):
                pull[held[a], 0] += shares[a] * residual
                for k in range(size):
                    crossed[k, held[a]] += shares[a] * column[k]
                for b in range(8):
                    inner[held[a], held[b]] += shares[a] * shares[b]
    inverse = np.eye(size)
    for k in range(size):
        matrix[k, k] = matrix[k, k] * (1.0 + 1e-9) if matrix[k, k] > 0.0 else 1.0
    freedom = pixels - size - nodes
    if freedom < 1 or not solve_positive(matrix, inverse):
        return False, math.nan, math.nan, math.nan, math.nan
    influence, schur = np.zeros((size, nodes)), inner.copy()
    for k in range(size):
        for m in range(size):
            for a in range(nodes):
                influence[k, a] += inverse[k, m] * crossed[m, a]
    for k in range(size):
        for a in range(nodes):
            for b in range(nodes):
                schur[a, b] -= crossed[k, a] * influence[k, b]
    total = 0.0
    for i in range(height):
        for j in range(width):
            total += residuals[i, j] ** 2
    shifts, ridged = pull.copy(), schur.copy()
    for k in range(nodes):
        ridged[k, k] += total / (pixels * LARGEST_SHIFT_PX**2) + 1e-12
    if not solve_positive(ridged, shifts):
        return False, math.nan, math.nan, math.nan, math.nan
    # What is left after the best field of shifts is noise.
    absorbed = np.zeros(size)
    for k in range(size):
        for a in range(nodes):
            absorbed[k] += influence[k, a] * shifts[a, 0]
    influences = np.zeros((POSE, height, width))
    for i in range(height):
        for j in range(width):
            if not view.used[i, j]:
                continue
            columns_at(view, state, nuisances, work.images, i, j, column)
            if _shift_slopes(view, state, work, i, j, held, shares):
                for a in range(8):
                    residuals[i, j] -= shares[a] * shifts[held[a], 0]
            for k in range(size):
                residuals[i, j] += column[k] * absorbed[k]
                for m in range(POSE):
                    influences[m, i, j] += inverse[m, k] * column[k]
    variance = _lagged(residuals, view.used, 0, 0)
    across = _ratio(_lagged(residuals, view.used, 0, 1), variance)
    along = _ratio(_lagged(residuals, view.used, 1, 0), variance)
    variance *= pixels / freedom
    plain = spread = 0.0
    for m in range(POSE):
        field = _correlated(influences[m], across, along)
        for k in range(POSE):
            product = 0.0
            for i in range(height):
                for j in range(width):
                    product += field[i, j] * influences[k, i, j]
            covariance[m, k] = variance * product
        plain += inverse[m, m] / inverse[m, m]
        spread += covariance[m, m] / (variance * inverse[m, m]) if variance > 0.0 else 1.0
    noise_pull = square_trace = trace = 0.0
    for a in range(nodes):
        noise_pull += pull[a, 0] ** 2
        trace += schur[a, a]
        for b in range(nodes):
            square_trace += schur[a, b] ** 2
    # The noise alone gives a pull of that mean, and of this standard deviation.
    effective = variance * spread / plain
    excess = noise_pull - effective * trace
    chance = SIGNIFICANT * effective * math.sqrt(2.0 * square_trace)
    misfit = math.sqrt(excess / square_trace) if excess > chance else 0.0
    distance = abs(state[DEPTH])
    for m in range(POSE):
        for k in range(POSE):
            for a in range(nodes):
                covariance[m, k] += misfit**2 * influence[m, a] * influence[k, a]
    for m in range(POSE):
        for k in range(POSE):
            covariance[m, k] *= (distance if m >= 3 else 1.0) * (distance if k >= 3 else 1.0)
    return True, math.sqrt(variance), across, along, misfit


@compiled
def _ratio(lagged: float, variance: float) -> float:
    """Return a correlation within bounds."""
    if not variance > 0.0:
        return 0.0
    return min(max(lagged / variance, -MAX_CORRELATION), MAX_CORRELATION)


@compiled
def _shift_slopes(
    view: PhotographView, state: Floats, work: System, i: int, j: int, held: Integers,
    shares: Floats,
) -> bool:
    """Write the eight components of nodes that move a pixel's level, and its slopes by them.

    Returns whether they move it by :data:`FLAT_PX` of the contrast a pixel.
    """
    if abs(work.images[2, i, j]) + abs(work.images[3, i, j]) < FLAT_PX:
        return False
    x_at, y_at = view.at[0, i, j], view.at[1, i, j]
    scale = state[CONTRAST] + state[CONTRAST + 1] * x_at + state[CONTRAST + 2] * y_at
    column, right = _tents(x_at)
    row, down = _tents(y_at)
    for k in range(4):
        node = (row + k // 2) * NODES + column + k % 2
        weight = (down if k // 2 else 1.0 - down) * (right if k % 2 else 1.0 - right)
        held[2 * k], held[2 * k + 1] = 2 * node, 2 * node + 1
        shares[2 * k] = -weight * scale * work.images[2, i, j]
        shares[2 * k + 1] = -weight * scale * work.images[3, i, j]
    return True
