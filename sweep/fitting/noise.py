"""Noise of photographs, from the residuals of pixels far from edges.

A fit takes a part of the noise into its parameters. With Q the orthonormal columns of its
derivatives and R the correlation of the noise between pixels, the residuals' correlation is
(1 - QQᵀ) R (1 - QQᵀ): what is missing of variance and of lagged products is computed and added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sweep.fitting.marker_state import MarkerState, products
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.typing import Floats, Masks

FLAT_PER_PX, FLAT_SHARE = 5e-3, 0.03
"""Slope of the share of white, and its distance from 0 or 1, below which a pixel is flat."""

MIN_PIXELS = 100
"""Flat pixels of a photograph, of one colour, from which its noise is estimated."""

MIN_VARIANCE = 0.02
"""Variance of the noise in squared grey levels below which it has no correlation to be seen."""

SMALLEST_WEIGHT = 1e-4
"""Correlation at which that of farther pixels is left out."""

ROUNDS = 3


@dataclass(frozen=True, slots=True)
class PhotographNoise:
    """The noise of one photograph.

    Attributes
    ----------
    black_variance, white_variance
        Of pixels on black and white, in squared grey levels, without that of rounding; NaN where
        too few pixels are flat.
    correlation
        Of neighbouring pixels; NaN without noise.
    edge_ratio
        Root mean square of all residuals over that of flat pixels.
    """

    black_variance: float
    white_variance: float
    correlation: float
    edge_ratio: float


@dataclass(frozen=True, slots=True, eq=False)
class _Residuals:
    """Residuals (h, w) of a marker, its flat pixels by colour, and its derivatives (k, h, w)."""

    values: Floats
    areas: tuple[Masks, Masks]
    basis: Floats
    used: Masks

    @property
    def flat(self) -> Masks:
        return self.areas[0] | self.areas[1]


def photograph_noise(states: Sequence[MarkerState]) -> PhotographNoise:
    """Return the noise of a photograph from the fits of its markers."""
    markers = [_residuals(state) for state in states]
    counts = [sum(int(each.areas[k].sum()) for each in markers) for k in range(2)]
    squares = [
        sum(float((each.values[each.areas[k]] ** 2).sum()) for each in markers) for k in range(2)
    ]
    if max(counts) < MIN_PIXELS:
        return PhotographNoise(np.nan, np.nan, np.nan, np.nan)
    correlation, rounding = 0.0, 0.0
    variance = np.array([
        square / count if count >= MIN_PIXELS else np.nan
        for square, count in zip(squares, counts, strict=True)
    ])
    for _ in range(ROUNDS):
        weights = kernel(correlation)
        lost = np.zeros(2)
        products_sum, lost_product, pairs = 0.0, 0.0, 0
        for each in markers:
            scaled = _scaled(each, variance)
            spread = (1 - rounding) * smoothed(each.basis, weights) + rounding * each.basis
            spread *= each.used
            inner = np.tensordot(each.basis, spread, axes=([1, 2], [1, 2]))
            projected = 2 * spread - np.tensordot(inner, each.basis, axes=1)
            for k, area in enumerate(each.areas):
                lost[k] += float((each.basis * projected)[:, area].sum())
            for axis in range(2):
                first, second = _neighbours(axis)
                both = each.flat[first] & each.flat[second]
                products_sum += float((scaled[first] * scaled[second])[both].sum())
                taken = (
                    each.basis[:, *first] * projected[:, *second]
                    + each.basis[:, *second] * projected[:, *first]
                ).sum(axis=0) / 2
                lost_product += float(taken[both].sum())
                pairs += int(both.sum())
        variance = np.array([
            square / (count - gone) if count >= MIN_PIXELS else np.nan
            for square, count, gone in zip(squares, counts, lost, strict=True)
        ])
        true = max(float(np.nanmean(variance)) - QUANTISATION_VARIANCE, 0.0)
        if true < MIN_VARIANCE or not pairs:
            correlation = np.nan
            break
        rounding = 1 - true / float(np.nanmean(variance))
        correlation = (products_sum + lost_product) / pairs / (1 - rounding)
        correlation = float(np.clip(correlation, -0.9, 0.95))
    every = np.concatenate([state.residuals[state.marker.used] for state in states])
    flat = np.sqrt(sum(squares) / sum(counts))
    black, white = (variance - QUANTISATION_VARIANCE).tolist()
    ratio = float(np.sqrt(np.mean(every**2)) / flat) if flat > 0 else np.nan
    return PhotographNoise(black, white, correlation, ratio)


def kernel(correlation: float) -> Floats:
    """Return the correlations along a row at lags from -n to n: correlation ** d², d the lag."""
    size = abs(correlation)
    if size < SMALLEST_WEIGHT:
        return np.ones(1)
    reach = int(np.ceil(np.sqrt(np.log(SMALLEST_WEIGHT) / np.log(size))))
    lags = np.abs(np.arange(-reach, reach + 1))
    return np.asarray(np.sign(correlation) ** lags * size ** (lags**2.0))


def smoothed(fields: Floats, weights: Floats) -> Floats:
    """Return fields (k, h, w), or (h, w), summed with weights along rows and along columns."""
    if len(weights) == 1:
        return fields
    rows = ndimage.correlate1d(fields, weights, axis=-1, mode="constant")
    return np.asarray(ndimage.correlate1d(rows, weights, axis=-2, mode="constant"))


def _neighbours(axis: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the parts of an image that are a pixel and the next one, down or right."""
    whole, first, second = slice(None), slice(None, -1), slice(1, None)
    return ((first, whole), (second, whole)) if axis == 0 else ((whole, first), (whole, second))


def _residuals(state: MarkerState) -> _Residuals:
    used = state.marker.used
    columns = np.hstack([state.own, state.shared])
    columns = columns[:, np.abs(columns).max(axis=0) > 0]
    scale = np.sqrt((columns**2).sum(axis=0))
    sums = products(columns / scale)
    values, vectors = np.linalg.eigh(sums)
    kept = values > 1e-9 * values.max()
    basis = np.zeros((int(kept.sum()), *used.shape))
    basis[:, used] = ((columns / scale) @ (vectors[:, kept] / np.sqrt(values[kept]))).T
    flat = used & (np.hypot(*state.slope) < FLAT_PER_PX) & (state.scale != 0)
    areas = (
        flat & (np.abs(state.share) < FLAT_SHARE), flat & (np.abs(state.share - 1) < FLAT_SHARE)
    )
    return _Residuals(state.residuals, areas, basis, used)


def _scaled(each: _Residuals, variance: Floats) -> Floats:
    """Return the residuals in standard deviations of their colour's."""
    scaled = np.zeros_like(each.values)
    for area, value in zip(each.areas, variance.tolist(), strict=True):
        if value > 0:
            scaled[area] = each.values[area] / np.sqrt(value)
    return scaled
