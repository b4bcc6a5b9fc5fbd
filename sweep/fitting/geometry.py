"""Shifts of markers beside the camera's model: how large they are, and how far they reach.

The fitted corners of a photograph's markers minus those of the board's pose, fitted to the same
corners, are (1 - P) (shifts + noise), P being the projection on what a pose explains. The shifts
are a Gaussian field of covariance s² exp(-d² / (2 l²)), as :mod:`sweep.model.image_shift` draws it.
Two sums of squares say s and l (the method of moments): that of the markers' centres, and that of
their corners beside the centres, which turn a pose. The farther the field reaches, the smaller is
the second one beside the first.

Their covariance follows from the field, too: that of xᵀAx and xᵀBx is 2 tr(AVBV) for normal x of
covariance V (Searle, "Linear Models", 1971, section 2.5). Size and length that the sums do not
refuse are the interval. So it is as wide as at the values in it: a small sum has itself a small
spread, and an interval from the spread would end too early.
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
    squares
        (2,) px², without those that the pixels' noise is expected to add.
    fields
        (2, lengths) what a field of standard deviation 1 px adds, for each of :data:`LENGTHS`.
    covariance
        (3, lengths, 2, 2) of both sums: of the noise alone, and the factors of s² and s⁴.
    """

    squares: Floats
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
    squares = [
        float(flat @ form @ flat - np.trace(each))
        for form, each in zip(forms, by_noise, strict=True)
    ]
    return Residuals(np.array(squares), fields, covariance)


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
    squares = np.array([each.squares for each in residuals])
    fields = np.array([each.fields for each in residuals])
    covariance = np.array([each.covariance for each in residuals])
    size, length = _matched(squares.sum(axis=0), fields.sum(axis=0))
    first, last = np.log(LENGTHS[[0, -1]]).tolist()
    finer = np.linspace(first, last, FINER * (len(LENGTHS) - 1) + 1)
    distance = _distances(
        squares.sum(axis=0), _at_lengths(fields.sum(axis=0), finer, 1),
        _at_lengths(covariance.sum(axis=0), finer, 1), SIZES_PX[:, None],
    )
    limit = float(special.chdtri(1, 1 - LEVEL)) * _excess(
        squares, fields, covariance, math.exp(size), length
    )
    sizes, lengths = (
        Estimate(value, *_ends(grid, distance.min(axis=axis), limit)).mapped(math.exp)
        for value, grid, axis in ((size, np.log(SIZES_PX), 1), (length, finer, 0))
    )
    own = _at_lengths(fields.sum(axis=1), length, 1)
    return Shifts(
        sizes, lengths.mapped(lambda share: share * width_px), squares.sum(axis=1) / own
    )


def _at_lengths(values: Floats, length: Floats | float, axis: int) -> Floats:
    """Return values at logarithms of lengths, in the place of those at LENGTHS."""
    return np.asarray(interpolate.interp1d(np.log(LENGTHS), values, axis=axis)(length))


def _distances(squares: Floats, fields: Floats, covariance: Floats, size_px: Floats) -> Floats:
    """Return the squared standard deviations of sums from what sizes and lengths lead to.

    Sums are (..., 2), fields (2, lengths), covariances (3, lengths, 2, 2), sizes (sizes, 1).
    """
    size = size_px**2
    first, second = (squares[k] - size * fields[k] for k in range(2))
    one, both, other = (
        covariance[0, :, i, j] + size * covariance[1, :, i, j] + size**2 * covariance[2, :, i, j]
        for i, j in ((0, 0), (0, 1), (1, 1))
    )
    return np.asarray(
        (first**2 * other - 2 * first * second * both + second**2 * one) / (one * other - both**2)
    )


def _excess(
    squares: Floats, fields: Floats, covariance: Floats, size_px: float, length: float
) -> float:
    """Return how many times as much photographs vary as photographs with one field do; 1 or more.

    It is 1 if chance does it with more than 5 %.
    """
    at = np.array([length])
    total = sum(
        float(_distances(one, _at_lengths(field, at, 1), _at_lengths(each, at, 1),
                         np.array([[size_px]]))[0, 0])
        for one, field, each in zip(squares, fields, covariance, strict=True)
    )
    freedom = squares.size - 2
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
