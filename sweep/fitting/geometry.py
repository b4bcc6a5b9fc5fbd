"""Shifts of markers beside the camera's model: how large they are, and how far they reach.

The fitted centres of a photograph's markers minus those of the board's pose, fitted to the same
centres, are (1 - P) (shifts + noise), P being the projection on what a pose explains. The shifts
are a Gaussian field of covariance s² exp(-d² / (2 l²)), as :mod:`sweep.model.image_shift` draws it;
s and l maximise the likelihood of these residuals (restricted maximum likelihood: Patterson and
Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika 58, 1971).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.fitting.marker_state import CORNERS, MarkerState, products
from sweep.fitting.noise import PhotographNoise, kernel, smoothed
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.typing import Floats

LENGTHS_PX = np.geomspace(8.0, 800.0, 24)
"""Correlation lengths that are compared."""

SIZES_PX = np.geomspace(0.005, 2.0, 49)
"""Standard deviations that are compared."""

CELLS = 5
"""Cells along each side of a marker in which the field is taken as constant."""

MIN_FREEDOM = 4
"""Components of a photograph's residuals from which they say something."""


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Independent components of the shifts of one photograph's markers.

    Attributes
    ----------
    values
        (k,) px.
    noise
        (k, k) their covariance by the pixels' noise.
    fields
        (lengths, k, k) their covariance by a field of standard deviation 1, for each of
        :data:`LENGTHS_PX`.
    """

    values: Floats
    noise: Floats
    fields: Floats

    @property
    def log_likelihoods(self) -> Floats:
        """Logarithms of the likelihood (lengths, sizes)."""
        out = np.empty((len(LENGTHS_PX), len(SIZES_PX)))
        for k, field in enumerate(self.fields):
            inverse = np.linalg.inv(np.linalg.cholesky(self.noise))
            shares, vectors = np.linalg.eigh(inverse @ field @ inverse.T)
            white = vectors.T @ inverse @ self.values
            spread = 1.0 + SIZES_PX[:, None] ** 2 * np.maximum(shares, 0.0)
            out[k] = -0.5 * (np.log(spread) + white**2 / spread).sum(axis=1)
        return out

    def mean_square(self, length: int) -> float:
        """Return an unbiased estimate of s², px², for one of the lengths."""
        free = float(np.trace(self.fields[length]))
        return float((self.values @ self.values - np.trace(self.noise)) / free)


@dataclass(frozen=True, slots=True, eq=False)
class _Centre:
    """How a marker's fitted centre follows from its pixels.

    Attributes
    ----------
    noise
        (2, 2) covariance of the centre by the pixels' noise, px².
    points, weights
        (n, 2) points in px of the frame, and (2, 2, n): what shifts there, right and down, add
        to the shift of the centre, right and down.
    """

    noise: Floats
    points: Floats
    weights: Floats


def _centre(state: MarkerState, noise: PhotographNoise) -> _Centre:
    """Return a marker's centre: the mean of its fitted corners.

    The noise is that of flat pixels, raised to what the residuals of all pixels are.
    """
    marker, used = state.marker, state.marker.used
    of_centre = np.zeros((state.own.shape[1], 2))
    of_centre[:CORNERS:2, 0] = of_centre[1:CORNERS:2, 1] = 1 / 4
    influence = state.own @ (np.linalg.pinv(products(state.own), hermitian=True) @ of_centre)
    share = np.clip(state.share[used], 0.0, 1.0)
    black, white = noise.black_variance, noise.white_variance
    black, white = (value if np.isfinite(value) else other
                    for value, other in ((black, white), (white, black)))
    variance = np.maximum((1 - share) * black + share * white, 0.0) + QUANTISATION_VARIANCE
    fields = np.zeros((2, *used.shape))
    fields[:, used] = influence.T * np.sqrt(variance) * max(noise.edge_ratio, 1.0)
    correlated = smoothed(fields, kernel(np.nan_to_num(noise.correlation)))
    cells = np.clip((marker.across[:, used] + 1) / 2 * CELLS, 0, CELLS - 1).astype(np.int64)
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
    return _Centre(
        np.tensordot(fields, correlated, axes=([1, 2], [1, 2])),
        points.T + marker.frame_px, weights,
    )


def residuals_of(
    states: Sequence[MarkerState], noise: PhotographNoise, shifts: Floats, explained: Floats
) -> Residuals | None:
    """Return the residuals of a photograph's n markers; None if they say nothing.

    Parameters
    ----------
    states, noise
        Of the photograph.
    shifts
        (n, 2) px of the fitted centres from the true ones.
    explained
        (2 n, m) how the centres, x and y in turn, change with what the truth was fitted to; (2 n,
        0) if it was not fitted to the photograph.
    """
    count = len(states)
    # The left null space of what is explained.
    basis = np.eye(2 * count)
    if explained.shape[1]:
        q, _ = np.linalg.qr(explained, mode="complete")
        basis = q[:, explained.shape[1]:]
    if basis.shape[1] < MIN_FREEDOM:
        return None
    centres = [_centre(each, noise) for each in states]
    noises, weights = np.zeros((count, 2, count, 2)), np.zeros((2, count, 2, count, CELLS**2))
    for k, each in enumerate(centres):
        noises[k, :, k, :] = each.noise
        weights[:, k, :, k] = np.moveaxis(each.weights, 1, 0)
    linear = basis.T @ weights.reshape(2, 2 * count, -1)
    points = np.concatenate([each.points for each in centres])
    squares = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    fields = []
    for length in LENGTHS_PX:
        covariance = np.exp(-0.5 * squares / length**2)
        fields.append(sum(each @ covariance @ each.T for each in linear))
    return Residuals(
        basis.T @ shifts.ravel(),
        basis.T @ noises.reshape(2 * count, -1) @ basis, np.array(fields),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Shifts:
    """Shifts of all photographs: values of each without one of them, as the jackknife needs them.

    Attributes
    ----------
    size_px, length_px
        Standard deviation and correlation length.
    without_size_px, without_length_px
        (n,) the same without each photograph.
    squares
        (n,) unbiased estimates of the squared standard deviation by each photograph.
    """

    size_px: float
    length_px: float
    without_size_px: Floats
    without_length_px: Floats
    squares: Floats


def shifts_of(residuals: Sequence[Residuals]) -> Shifts:
    """Return the field of shifts that fits the residuals of n photographs best."""
    each = np.array([one.log_likelihoods for one in residuals])
    total = each.sum(axis=0)
    size, length = _highest(total)
    without = np.array([_highest(total - one) for one in each])
    nearest = int(np.argmin(np.abs(np.log(LENGTHS_PX / length))))
    squares = np.array([one.mean_square(nearest) for one in residuals])
    return Shifts(size, length, without[:, 0], without[:, 1], squares)


def _highest(surface: Floats) -> tuple[float, float]:
    """Return size and length at the maximum of (lengths, sizes), between the points."""
    i, j = divmod(int(np.argmax(surface)), surface.shape[1])
    i = min(max(i, 1), surface.shape[0] - 2)
    j = min(max(j, 1), surface.shape[1] - 2)
    near = surface[i - 1 : i + 2, j - 1 : j + 2]
    slope = np.array([near[2, 1] - near[0, 1], near[1, 2] - near[1, 0]]) / 2
    cross = (near[2, 2] - near[2, 0] - near[0, 2] + near[0, 0]) / 4
    curvature = np.array([
        [near[2, 1] - 2 * near[1, 1] + near[0, 1], cross],
        [cross, near[1, 2] - 2 * near[1, 1] + near[1, 0]],
    ])
    step = np.zeros(2)
    if np.linalg.det(curvature) > 0 > curvature[0, 0]:
        step = np.clip(-np.linalg.solve(curvature, slope), -1.0, 1.0)
    by_length, by_size = np.log(LENGTHS_PX[1] / LENGTHS_PX[0]), np.log(SIZES_PX[1] / SIZES_PX[0])
    return (
        float(SIZES_PX[j] * np.exp(step[1] * by_size)),
        float(LENGTHS_PX[i] * np.exp(step[0] * by_length)),
    )
