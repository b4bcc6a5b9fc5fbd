"""Shifts of markers beside the camera's model: how large they are, and how far they reach.

The fitted corners of a photograph's markers minus those of the board's pose, fitted to the same
corners, are (1 - P) (shifts + noise), P being the projection on what a pose explains. The shifts
are a Gaussian field of covariance s² exp(-d² / (2 l²)), as :mod:`sweep.model.image_shift` draws it.
Two sums of squares say s and l (the method of moments): that of the markers' centres, and that of
their corners beside the centres, which turn a pose. The farther the field reaches, the smaller is
the second one beside the first.

Their covariance follows from the field, too: that of xᵀAx and xᵀBx is 2 tr(AVBV) for normal x of
covariance V (Searle, "Linear Models", 1971, section 2.5). The interval has the sizes and lengths
that the logarithms of the sums do not refuse. An interval from the spread of the sums would end too
early where they are small: their spread is then small, too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import interpolate, special

from sweep.analysis.intervals import LEVEL
from sweep.fitting.estimates import Estimate
from sweep.fitting.marker_state import CORNERS, MarkerState, products
from sweep.fitting.noise import PhotographNoise, kernel, smoothed
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.typing import Floats

LENGTHS = np.geomspace(0.01, 0.4, 24)
"""Correlation lengths that are compared, as shares of the frame's width. A pose takes up most of
longer ones: their size cannot be said."""

SIZES_PX, FINER = np.geomspace(3e-3, 10.0, 400), 8
"""Sizes that are tried for the interval, and how many lengths from one of :data:`LENGTHS` to the
next."""

CELLS = 6
"""Cells along each side of a marker in which the field is taken as constant."""

MIN_MARKERS = 3
"""Markers of a photograph from which their shifts are seen beside the pose's."""


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Sums of squares of the shifts of one photograph's markers: of centres, and beside these.

    Attributes
    ----------
    squares, noise
        (2,) px², and what the pixels' noise is expected to add to them.
    fields
        (2, lengths) what a field of standard deviation 1 px adds, for each of :data:`LENGTHS`.
    covariance
        (3, lengths, 2, 2) of both sums: of the noise alone, and the factors of s² and s⁴.
    """

    squares: Floats
    noise: Floats
    fields: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Corners:
    """How a marker's fitted corners follow from its pixels.

    Attributes
    ----------
    noise
        (8, 8) covariance of the corners, x and y in turn, by the pixels' noise, px².
    points, weights
        (n, 2) points in px of the frame, and (8, 2, n): what shifts there, right and down, add
        to the corners.
    """

    noise: Floats
    points: Floats
    weights: Floats


def _corners(state: MarkerState, noise: PhotographNoise) -> _Corners:
    """Return a marker's corners.

    The noise is that of flat pixels, raised to what the residuals of all pixels are.
    """
    marker, used = state.marker, state.marker.used
    inverse = np.linalg.pinv(products(state.own), hermitian=True)
    influence = state.own @ inverse[:, :CORNERS]
    share = np.clip(state.share[used], 0.0, 1.0)
    black, white = noise.black_variance, noise.white_variance
    black, white = (value if np.isfinite(value) else other
                    for value, other in ((black, white), (white, black)))
    variance = np.maximum((1 - share) * black + share * white, 0.0) + QUANTISATION_VARIANCE
    fields = np.zeros((CORNERS, *used.shape))
    fields[:, used] = influence.T * np.sqrt(variance) * max(noise.edge_ratio, 1.0)
    correlated = smoothed(fields, kernel(np.nan_to_num(noise.correlation)))
    cells = np.clip(marker.modules_at[:, used] * CELLS, 0, CELLS - 1).astype(np.int64)
    number = cells[1] * CELLS + cells[0]
    moved = (state.scale * state.slope)[:, used]
    weights = np.array([
        [np.bincount(number, one * each, minlength=CELLS**2) for each in moved]
        for one in influence.T
    ])
    # A cell's point is where its edges are, most of them at a side of the marker.
    edge = (moved**2).sum(axis=0) + 1e-12
    mass = np.bincount(number, edge, minlength=CELLS**2)
    rows, columns = np.nonzero(used)
    points = np.array([
        np.bincount(number, edge * each, minlength=CELLS**2) for each in (columns, rows)
    ]) / np.maximum(mass, 1e-12)
    return _Corners(
        np.tensordot(fields, correlated, axes=([1, 2], [1, 2])),
        points.T + marker.frame_px, weights,
    )


def residuals_of(
    states: Sequence[MarkerState], noise: PhotographNoise, shifts: Floats, explained: Floats,
    width_px: float,
) -> Residuals | None:
    """Return the residuals of a photograph's n markers; None if they say nothing.

    Parameters
    ----------
    states, noise
        Of the photograph.
    shifts
        (n, 4, 2) px of the fitted corners from the true ones.
    explained
        (8 n, m) how the corners, x and y in turn, change with what the truth was fitted to; (8 n,
        0) if it was not fitted to the photograph.
    width_px
        Of the frame.
    """
    count, size = len(states), CORNERS * len(states)
    if count < MIN_MARKERS:
        return None
    q, _ = np.linalg.qr(explained)
    residual = np.eye(size) - q @ q.T
    centres = np.kron(np.eye(count), np.tile(np.eye(2), 4) / 2)
    parts = (centres @ residual, residual - centres.T @ centres @ residual)
    corners = [_corners(each, noise) for each in states]
    noises = np.zeros((count, CORNERS, count, CORNERS))
    weights = np.zeros((2, count, CORNERS, count, CELLS**2))
    for k, each in enumerate(corners):
        noises[k, :, k, :] = each.noise
        weights[:, k, :, k] = np.moveaxis(each.weights, 1, 0)
    added, moved = noises.reshape(size, size), weights.reshape(2, size, -1)
    points = np.concatenate([each.points for each in corners])
    distances = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    forms = [part.T @ part for part in parts]
    by_noise = [form @ added for form in forms]
    fields, covariance = np.empty((2, len(LENGTHS))), np.empty((3, len(LENGTHS), 2, 2))
    for k, length in enumerate(LENGTHS * width_px):
        field = np.exp(-0.5 * distances / length**2)
        shifted = sum(each @ field @ each.T for each in moved)
        by_field = [form @ shifted for form in forms]
        fields[:, k] = [np.trace(each) for each in by_field]
        mixed = _traces(by_noise, by_field)
        covariance[:, k] = (
            _traces(by_noise, by_noise), mixed + mixed.T, _traces(by_field, by_field)
        )
    flat = shifts.ravel()
    return Residuals(
        np.array([flat @ form @ flat for form in forms]),
        np.array([np.trace(each) for each in by_noise]), fields, covariance,
    )


def _traces(first: Sequence[Floats], second: Sequence[Floats]) -> Floats:
    """Return twice the traces (2, 2) of the products of two matrices with two others."""
    return np.array([[2.0 * float((one * other.T).sum()) for other in second] for one in first])


@dataclass(frozen=True, slots=True, eq=False)
class Shifts:
    """Shifts of all photographs.

    Attributes
    ----------
    size_px, length_px
        Standard deviation and correlation length.
    squares
        (n,) unbiased estimates of the squared standard deviation by each photograph.
    """

    size_px: Estimate
    length_px: Estimate
    squares: Floats


def shifts_of(residuals: Sequence[Residuals], width_px: float) -> Shifts:
    """Return the field of shifts that has the sums of squares of n photographs' residuals."""
    total = Residuals(*(
        np.sum([getattr(each, name) for each in residuals], axis=0)
        for name in ("squares", "noise", "fields", "covariance")
    ))
    size, length = _matched(total.squares - total.noise, total.fields)
    first, last = np.log(LENGTHS[[0, -1]]).tolist()
    finer = np.linspace(first, last, FINER * (len(LENGTHS) - 1) + 1)
    expected, covariance = _expected(total, SIZES_PX[:, None], finer)
    refused = _distance(
        np.log(total.squares / expected),
        covariance / (expected[..., None] * expected[..., None, :]),
    ) / _excess(residuals, math.exp(size), length)
    limit = float(special.chdtri(1, 1 - LEVEL))
    sizes, lengths = (
        Estimate(value, *_ends(grid, refused.min(axis=axis), limit)).mapped(math.exp)
        for value, grid, axis in ((size, np.log(SIZES_PX), 1), (length, finer, 0))
    )
    return Shifts(sizes, lengths.mapped(lambda share: share * width_px), np.array([
        float((each.squares - each.noise).sum()) / np.interp(
            length, np.log(LENGTHS), each.fields.sum(axis=0)
        ) for each in residuals
    ]))


def _expected(
    sums: Residuals, size_px: Floats | float, length: Floats | float
) -> tuple[Floats, Floats]:
    """Return what sums of squares are (..., 2), and their covariance (..., 2, 2), with a field.

    ``length`` has the logarithms of shares of the width.
    """
    at, square = np.log(LENGTHS), np.asarray(size_px)[..., None] ** 2
    fields = interpolate.interp1d(at, sums.fields.T, axis=0)(length)
    none, mixed, both = interpolate.interp1d(at, sums.covariance, axis=1)(length)
    square2 = square[..., None]
    return sums.noise + square * fields, none + square2 * (mixed + square2 * both)


def _distance(deviations: Floats, covariance: Floats) -> Floats:
    """Return the squares (...) of deviations (..., 2), in units of their covariance."""
    first, second = deviations[..., 0], deviations[..., 1]
    one, both, other = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.asarray(
        (first**2 * other - 2 * first * second * both + second**2 * one) / (one * other - both**2)
    )


def _excess(residuals: Sequence[Residuals], size_px: float, length: float) -> float:
    """Return how many times as much photographs vary as photographs with one field do; 1 or more.

    It is 1 if chance does it with more than 5 %.
    """
    total = 0.0
    for each in residuals:
        expected, covariance = _expected(each, size_px, length)
        total += float(_distance(each.squares - expected, covariance))
    freedom = 2 * len(residuals) - 2
    return total / freedom if total > special.chdtri(freedom, 1 - LEVEL) else 1.0


def _ends(grid: Floats, distance: Floats, limit: float) -> tuple[float, float]:
    """Return the first and the last point of a grid within the limit; where lines cross it."""
    inside = np.flatnonzero(distance <= limit)
    if not len(inside):
        return math.nan, math.nan
    ends = []
    for k, step in ((int(inside[0]), -1), (int(inside[-1]), 1)):
        if not 0 <= k + step < len(grid):
            ends.append(float(grid[k]))
            continue
        share = (limit - distance[k]) / (distance[k + step] - distance[k])
        ends.append(float(grid[k] + share * (grid[k + step] - grid[k])))
    return ends[0], ends[1]


def _matched(squares: Floats, fields: Floats) -> tuple[float, float]:
    """Return the logarithms of size in px and length, a share of the width."""
    at = np.log(LENGTHS)
    ratio = np.log(fields[1] / fields[0])
    wanted = np.log(max(squares[1], 1e-12) / max(squares[0], 1e-12))
    # The ratio falls with the length.
    length = float(np.interp(-wanted, -ratio, at))
    total = np.interp(length, at, fields.sum(axis=0))
    return 0.5 * math.log(max(float(squares.sum()), 1e-12) / total), length
