"""Shifts of markers beside the camera's model: how large they are, and how far they reach.

The fitted centres of a photograph's markers minus those of the board's pose, fitted to the same
centres, are (1 - P) (shifts + noise), P being the projection on what a pose explains. The shifts
are a Gaussian field of covariance s² exp(-d² / (2 l²)), as :mod:`sweep.model.image_shift` draws it;
s and l maximise the likelihood of these residuals (restricted maximum likelihood: Patterson and
Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika 58, 1971).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from sweep.analysis.intervals import TAIL
from sweep.fitting.estimates import Estimate
from sweep.fitting.marker_state import CORNERS, MarkerState, products
from sweep.fitting.noise import PhotographNoise, kernel, smoothed
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.typing import Floats

LENGTHS = np.geomspace(0.01, 0.4, 32)
"""Correlation lengths that are compared, as shares of the frame's width. A pose takes up most of
longer ones: their size cannot be said."""

SIZES_PX = np.geomspace(0.003, 3.0, 281)
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
        :data:`LENGTHS`.
    """

    values: Floats
    noise: Floats
    fields: Floats

    @property
    def log_likelihoods(self) -> Floats:
        """Logarithms of the likelihood (lengths, sizes)."""
        out = np.empty((len(LENGTHS), len(SIZES_PX)))
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
    return _Centre(
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
        (n, 2) px of the fitted centres from the true ones.
    explained
        (2 n, m) how the centres, x and y in turn, change with what the truth was fitted to; (2 n,
        0) if it was not fitted to the photograph.
    width_px
        Of the frame.
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
    for length in LENGTHS * width_px:
        covariance = np.exp(-0.5 * squares / length**2)
        fields.append(sum(each @ covariance @ each.T for each in linear))
    return Residuals(
        basis.T @ shifts.ravel(),
        basis.T @ noises.reshape(2 * count, -1) @ basis, np.array(fields),
    )


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
    """Return the field of shifts that fits the residuals of n photographs best.

    The intervals are those of the profile likelihood, the other parameter at its best for each
    value; with Student's quantile for n photographs in the place of the normal distribution's.
    """
    surface = np.array([one.log_likelihoods for one in residuals]).sum(axis=0)
    fall = 0.5 * float(special.stdtrit(len(residuals) - 1, 1 - TAIL)) ** 2
    best = int(np.argmax(surface.max(axis=1)))
    squares = np.array([one.mean_square(best) for one in residuals])
    return Shifts(
        _profile(SIZES_PX, surface.max(axis=0), fall),
        _profile(LENGTHS * width_px, surface.max(axis=1), fall), squares,
    )


def _profile(values: Floats, likelihood: Floats, fall: float) -> Estimate:
    """Return the best of increasing values, and where the likelihood has fallen on both sides."""
    best = int(np.argmax(likelihood))
    limit = likelihood[best] - fall
    below, above = np.flatnonzero(likelihood[:best] < limit), np.flatnonzero(
        likelihood[best:] < limit
    )
    low = values[below[-1]] if len(below) else 0.0
    high = values[best + above[0]] if len(above) else math.inf
    return Estimate(float(values[best]), float(low), float(high))
