"""Shifts of markers beside the camera's model: how large they are, and how far they reach.

The fitted corners of a photograph's markers minus those of the board's pose, fitted to the same
corners, are (1 - P) (shifts + noise), P being the projection on what a pose explains. The shifts
are a Gaussian field of covariance s² exp(-d² / (2 l²)), as :mod:`sweep.model.image_shift` draws it.
Two mean squares say s and l (the method of moments): that of the markers' centres, and that of
their corners beside the centres, which turn a pose. The farther the field reaches, the smaller is
the second one beside the first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.fitting.estimates import Estimate, estimate, jackknife
from sweep.fitting.marker_state import CORNERS, MarkerState, products
from sweep.fitting.noise import PhotographNoise, kernel, smoothed
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.typing import Floats

LENGTHS = np.geomspace(0.01, 0.4, 24)
"""Correlation lengths that are compared, as shares of the frame's width. A pose takes up most of
longer ones: their size cannot be said."""

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
    """

    squares: Floats
    fields: Floats


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
    linear = [part @ moved for part in parts]
    fields = np.empty((2, len(LENGTHS)))
    for k, length in enumerate(LENGTHS * width_px):
        covariance = np.exp(-0.5 * distances / length**2)
        fields[:, k] = [float(((part @ covariance) * part).sum()) for part in linear]
    squares = [
        float(((part @ shifts.ravel()) ** 2).sum() - ((part @ added) * part).sum())
        for part in parts
    ]
    return Residuals(np.array(squares), fields)


@dataclass(frozen=True, slots=True, eq=False)
class Shifts:
    """Shifts of all photographs.

    Attributes
    ----------
    size_px, length_px
        Standard deviation and correlation length; their intervals are the jackknife's, of
        logarithms.
    squares
        (n,) unbiased estimates of the squared standard deviation by each photograph.
    """

    size_px: Estimate
    length_px: Estimate
    squares: Floats


def shifts_of(residuals: Sequence[Residuals], width_px: float) -> Shifts:
    """Return the field of shifts that has the mean squares of n photographs' residuals."""
    squares = np.array([each.squares for each in residuals])
    fields = np.array([each.fields for each in residuals])
    size, length = _matched(squares.sum(axis=0), fields.sum(axis=0))
    without = np.array([
        _matched(squares.sum(axis=0) - one, fields.sum(axis=0) - other)
        for one, other in zip(squares, fields, strict=True)
    ])
    sizes, lengths = (
        estimate(jackknife(full, each)).mapped(math.exp)
        for full, each in zip((size, length), without.T, strict=True)
    )
    own = np.array([
        np.interp(length, np.log(LENGTHS), each.sum(axis=0)) for each in fields
    ])
    return Shifts(
        sizes, lengths.mapped(lambda share: share * width_px), squares.sum(axis=1) / own
    )


def _matched(squares: Floats, fields: Floats) -> tuple[float, float]:
    """Return the logarithms of size in px and length, a share of the width."""
    at = np.log(LENGTHS)
    ratio = np.log(fields[1] / fields[0])
    wanted = np.log(max(squares[1], 1e-12) / max(squares[0], 1e-12))
    # The ratio falls with the length.
    length = float(np.interp(-wanted, -ratio, at))
    total = np.interp(length, at, fields.sum(axis=0))
    return 0.5 * math.log(max(float(squares.sum()), 1e-12) / total), length
