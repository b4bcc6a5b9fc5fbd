"""The fit of the simulator's own image to one photograph, and the noise of its residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sweep.compilation import compiled
from sweep.fitting.views import FittedMarker, FittedPhotograph, module_plane, shares
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# The simulator's own image of one marker in a photograph, its residuals and derivatives.
#
# The level of a pixel of a marker is
#
#     y = b + g · x + (c + h · x) F(s),
#     F(s) = s + amount (s - s_wide) + bloom s (1 - s),
#
# s being the exact share of white through a Gaussian point spread, s_wide that through one that
# is wider by the radius of the sharpening, and x (2,) the position beside the marker's centre:
# what the simulator makes of black, white, uneven light, blur, sharpening and bloom before it
# adds noise. Each marker has its own corners and levels; point spread, amount, bloom and radius
# are the photograph's.

VARIANCE, AMOUNT, BLOOM, RADIUS = range(4)
"""Parameters of a photograph: variance of the point spread in px², amount of sharpening, bloom,
and radius of the sharpening in px."""

CORNERS, OWN = 8, 14
"""Parameters of a marker: the shifts of its four corners, then b, c, g and h."""

STEP_PX = 0.25
"""Step of differences along x and y. They are inexact by (step / point spread)² / 6, which changes
the directions of steps, not where the fit ends."""

WHITE_SHARE = np.array([0.0, 0.0, 1.0])
"""Values of outside, black and white in the image of the share of white."""


@dataclass(slots=True, eq=False)
class MarkerState:
    """A marker's parameters, and what its pixels say at them.

    Attributes
    ----------
    marker
        What is fitted.
    corners_px
        (4, 2) in the box.
    levels
        (6,) b, c, g and h.
    residuals
        (h, w) levels minus the model; 0 where no pixel is fitted.
    images
        (2, h, w) s and s_wide.
    share
        (h, w) F(s).
    scale
        (h, w) derivative of the level by F(s); 0 where it is cut off at 0 or 255.
    slope
        (2, h, w) slopes of F(s) when it is moved right and down, per px.
    own, shared
        (n, OWN) and (n, 4) derivatives of the n fitted pixels.
    uneven
        (n, 4) derivatives by shifts that grow with the square of the position on the marker, which
        corners cannot take up.
    """

    marker: FittedMarker
    corners_px: Floats
    levels: Floats
    residuals: Floats
    images: Floats
    share: Floats
    scale: Floats
    slope: Floats
    own: Floats
    shared: Floats
    uneven: Floats

    @property
    def squares(self) -> float:
        """Sum of squared residuals."""
        return float((self.residuals**2).sum())

    @property
    def noise(self) -> float:
        """Standard deviation of the residuals."""
        freedom = max(int(self.marker.used.sum()) - OWN, 1)
        return float(np.sqrt(self.squares / freedom))


def _rendered(
    marker: FittedMarker, corners_px: Floats, parameters: Floats,
    shift: tuple[float, float] = (0.0, 0.0),
) -> Floats:
    """Return s and s_wide of a marker, (2, h, w), moved by ``shift`` px."""
    plane = module_plane(corners_px, marker.modules, marker.optics)
    variance = max(parameters[VARIANCE], 0.0)
    return np.stack([
        shares(
            marker.edges, WHITE_SHARE, plane, marker.optics, marker.used.shape, float(blur), shift
        )
        for blur in np.sqrt([variance, variance + parameters[RADIUS] ** 2])
    ])


def _tone(share: Floats) -> Floats:
    """Return s (1 - s), 0 beyond black and white, where rounding may lead."""
    bounded = np.clip(share, 0.0, 1.0)
    return bounded * (1.0 - bounded)


def _combined(images: Floats, parameters: Floats) -> Floats:
    """Return F(s) from s and s_wide, (2, ..., h, w)."""
    share, wide = images
    return np.asarray(
        share + parameters[AMOUNT] * (share - wide) + parameters[BLOOM] * _tone(share)
    )


def fresh_state(marker: FittedMarker, parameters: Floats) -> MarkerState:
    """Return the state of a marker at its true corners, its levels by least squares."""
    share = _combined(_rendered(marker, marker.corners_px, parameters), parameters)
    design = _level_columns(marker, share)
    sums = products(np.hstack([design, marker.levels[marker.used][:, None]]))
    levels = solved_normal(sums[:-1, :-1], sums[:-1, -1])
    return state_at(marker, marker.corners_px, levels, parameters)


def _level_columns(marker: FittedMarker, share: Floats) -> Floats:
    """Return the derivatives (n, 6) by the levels."""
    x, y = (each[marker.used] for each in marker.across)
    white = share[marker.used]
    return np.stack([np.ones_like(x), white, x, y, x * white, y * white], axis=1)


def state_at(
    marker: FittedMarker, corners_px: Floats, levels: Floats, parameters: Floats,
) -> MarkerState:
    """Return a marker's residuals at its and the photograph's parameters, without derivatives."""
    images = _rendered(marker, corners_px, parameters)
    share = _combined(images, parameters)
    x, y = marker.across
    scale = levels[1] + levels[4] * x + levels[5] * y
    level = levels[0] + levels[2] * x + levels[3] * y + scale * share
    residuals = np.where(marker.used, marker.levels - np.clip(level, 0.0, 255.0), 0.0)
    scale = np.where((level > 0.0) & (level < 255.0), scale, 0.0)
    none = np.empty(0)
    return MarkerState(
        marker, corners_px, levels, residuals, images, share, scale, none, none, none, none
    )


def differentiate(state: MarkerState, parameters: Floats) -> None:
    """Compute the derivatives of a state.

    Those by the point spread's variance follow from the heat equation: half the Laplacian.
    """
    marker, used = state.marker, state.marker.used
    sides = np.stack([
        _rendered(marker, state.corners_px, parameters, shift)
        for shift in ((STEP_PX, 0.0), (-STEP_PX, 0.0), (0.0, STEP_PX), (0.0, -STEP_PX))
    ], axis=1)
    combined = _combined(sides, parameters)
    along = np.stack([combined[0] - combined[1], combined[2] - combined[3]]) / (2 * STEP_PX)
    state.slope = along
    inside = (state.scale != 0)[used][:, None]
    moved = [
        (state.scale * along[axis] * marker.shape[k])[used] for k in range(4) for axis in range(2)
    ]
    x, y = marker.modules_at
    state.uneven = np.stack([
        (state.scale * along[axis] * at * (1 - at))[used] for at in (x, y) for axis in range(2)
    ], axis=1)
    levels = _level_columns(marker, state.share) * inside
    state.own = np.hstack([np.stack(moved, axis=1), levels])
    share, wide = state.images
    half, half_wide = (sides.sum(axis=1) - 4 * state.images) / (2 * STEP_PX**2)
    amount, radius = parameters[AMOUNT], parameters[RADIUS]
    sharpened = 1 + amount + parameters[BLOOM] * (1 - 2 * np.clip(share, 0.0, 1.0))
    derivatives = (
        sharpened * half - amount * half_wide, share - wide, _tone(share),
        -2 * amount * radius * half_wide,
    )
    state.shared = np.stack([(state.scale * each)[used] for each in derivatives], axis=1)


@compiled
def products(columns: Floats) -> Floats:
    """Return the products (k, k) of columns (n, k), in one thread."""
    count, size = columns.shape
    sums = np.zeros((size, size))
    for p in range(count):
        row = columns[p]
        for i in range(size):
            first = row[i]
            for j in range(i + 1):
                sums[i, j] += first * row[j]
    for i in range(size):
        for j in range(i):
            sums[j, i] = sums[i, j]
    return sums


def solved_normal(matrix: Floats, right: Floats) -> Floats:
    """Return the solution of normal equations; 0 for what nothing depends on."""
    scale = np.sqrt(np.diag(matrix))
    scale[scale == 0] = 1.0
    scaled = matrix / np.outer(scale, scale) + 1e-12 * np.eye(len(matrix))
    return (np.linalg.solve(scaled, (right.T / scale).T).T / scale).T


# --------------------------------------------------------------------------------------------------
# The fit of the simulator's own image to one photograph: Gauss-Newton over all its markers.
#
# Each marker has its own corners and levels; point spread, amount of sharpening, bloom and radius
# are the photograph's.

MAX_STEPS = 12

CONVERGED = 1e-3
"""Squared standard deviations of a last step."""

MAX_SHIFT_PX = 2.0
"""Markers whose corners end farther than this from the truth are left out: they are covered, or
their true pose is wrong."""

OUTLIER = 2.5
"""Markers whose residuals are so many times those of the photograph's median marker are left out;
something lies on them."""

MIN_CONTRAST = 5.0
"""Difference of white and black in grey levels below which there is no marker in the pixels."""

LOW = np.array([0.0, -0.95, -0.95, 0.5])
HIGH = np.array([100.0, 10.0, 0.95, 10.0])
"""Range of the parameters of a photograph. Sharpening narrower than half a pixel is seen as its
amount times its radius squared alone."""

START = np.array([0.5, 0.0, 0.0, 1.5])


@dataclass(frozen=True, slots=True, eq=False)
class PhotographFit:
    """The fit of one photograph.

    Attributes
    ----------
    number
        The photograph's.
    parameters
        (4,) its parameters. Of those that were moved they are the minimum of the quadratic
        approximation, so that a variance of 0 may be below 0; shifts of parts of markers are
        eliminated in it, which would be taken for bloom.
    moved
        (4,) which ones were moved.
    information
        (4, 4) of the parameters, the markers' own eliminated, in units of the noise.
    gradient
        (4,) of half of chi-square, negative, in these units.
    covariance
        (4, 4) of the moved parameters: from the spread of the markers' gradients, so that it holds
        whatever the noise is correlated with; NaN with fewer than two markers.
    states
        Its markers.
    """

    number: int
    parameters: Floats
    moved: Masks
    information: Floats
    gradient: Floats
    covariance: Floats
    states: tuple[MarkerState, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    """Normal equations of the photograph's parameters, the markers' own eliminated."""

    information: Floats
    gradients: Floats
    own: tuple[tuple[Floats, Floats], ...]

    @property
    def gradient(self) -> Floats:
        return np.asarray(self.gradients.sum(axis=0))


def _reduced(
    states: Sequence[MarkerState], moved: Masks, *, uneven: bool = False
) -> _Reduced:
    """Return the normal equations; ``uneven`` shifts of parts of markers are eliminated, too."""
    size = int(moved.sum())
    information, gradients, own = np.zeros((size, size)), [], []
    for state in states:
        residual = state.residuals[state.marker.used]
        local = np.hstack([state.own, state.uneven]) if uneven else state.own
        count = local.shape[1]
        sums = products(np.hstack([local, state.shared[:, moved], residual[:, None]]))
        inner, outer = sums[:count, count:], sums[count:, count:]
        solved = solved_normal(sums[:count, :count], inner)
        rest = outer - inner.T @ solved
        information += rest[:-1, :-1]
        gradients.append(rest[:-1, -1])
        own.append((solved[:, :-1], solved[:, -1]))
    return _Reduced(information, np.array(gradients), tuple(own))


def fit_photograph(
    photograph: FittedPhotograph, moved: Masks, start: Floats = START,
    states: Sequence[MarkerState] | None = None,
) -> PhotographFit | None:
    """Return the fit of a photograph; None if no marker fits.

    Parameters
    ----------
    photograph
        What is fitted.
    moved
        (4,) which of the photograph's parameters are moved; the others stay as at the start.
    start
        (4,) the parameters at which it starts.
    states
        The states of an earlier fit, in the place of the true corners.
    """
    parameters = start.copy()
    if states is None:
        first = moved & (np.arange(4) == VARIANCE)
        current = [fresh_state(each, parameters) for each in photograph.markers]
        current = _good([each for each in current if abs(each.levels[1]) > MIN_CONTRAST])
        if not current:
            return None
        parameters, current = _descend(current, parameters, first)
        current = _good(current)
        if not current:
            return None
    else:
        current = [
            state_at(each.marker, each.corners_px, each.levels, parameters) for each in states
        ]
    parameters, current = _descend(current, parameters, moved)
    if len(_good(current)) < len(current):
        current = _good(current)
        if not current:
            return None
        parameters, current = _descend(current, parameters, moved)
    return _finished(photograph.number, current, parameters, moved)


def _good(states: Sequence[MarkerState]) -> list[MarkerState]:
    """Return the states of markers that are no outliers."""
    if not states:
        return []
    limit = OUTLIER * float(np.median([each.noise for each in states]))
    return [
        each for each in states
        if each.noise <= max(limit, 1.0) and abs(each.levels[1]) > MIN_CONTRAST
        and np.abs(each.corners_px - each.marker.corners_px).max() < MAX_SHIFT_PX
    ]


def _descend(
    states: list[MarkerState], parameters: Floats, moved: Masks
) -> tuple[Floats, list[MarkerState]]:
    """Return parameters and states at the least squares."""
    squares = sum(each.squares for each in states)
    pixels = sum(int(each.marker.used.sum()) for each in states)
    for _ in range(MAX_STEPS):
        for state in states:
            differentiate(state, parameters)
        reduced = _reduced(states, moved)
        step, own_steps = _step(reduced, parameters, moved)
        variance = squares / max(pixels - OWN * len(states), 1)
        length = 1.0
        for _attempt in range(6):
            trial = parameters.copy()
            trial[moved] = np.clip(
                parameters[moved] + length * step, LOW[moved], HIGH[moved]
            )
            trial_states = [
                _moved_state(state, length * own, trial)
                for state, own in zip(states, own_steps, strict=True)
            ]
            trial_squares = sum(each.squares for each in trial_states)
            if trial_squares < squares * (1 + 1e-9):
                break
            length /= 4
        else:
            return parameters, states
        gain = squares - trial_squares
        parameters, states, squares = trial, trial_states, trial_squares
        if gain < CONVERGED * variance or squares == 0:
            break
    for state in states:
        differentiate(state, parameters)
    return parameters, states


def _step(reduced: _Reduced, parameters: Floats, moved: Masks) -> tuple[Floats, list[Floats]]:
    """Return the step of the moved parameters, and those of each marker's own."""
    gradient = reduced.gradient
    size = len(gradient)
    if not size:
        return np.empty(0), [own[1] for own in reduced.own]
    at, low, high = parameters[moved], LOW[moved], HIGH[moved]
    free = ~(((at <= low) & (gradient < 0)) | ((at >= high) & (gradient > 0)))
    step = np.zeros(size)
    step[free] = solved_normal(reduced.information[np.ix_(free, free)], gradient[free])
    largest = np.array([max(0.5, parameters[VARIANCE]), 1.0, 0.5, 1.0])[moved]
    step *= min(1.0, float((largest / np.maximum(np.abs(step), 1e-12)).min()))
    return step, [pull - crossed @ step for crossed, pull in reduced.own]


def _moved_state(state: MarkerState, step: Floats, parameters: Floats) -> MarkerState:
    shift = np.clip(step[:CORNERS].reshape(4, 2), -1.0, 1.0)
    return state_at(
        state.marker, state.corners_px + shift, state.levels + step[CORNERS:], parameters
    )


def _finished(
    number: int, states: Sequence[MarkerState], parameters: Floats, moved: Masks
) -> PhotographFit:
    """Return the fit with the information of all parameters."""
    every = np.ones(4, dtype=bool)
    reduced = _reduced(states, every, uneven=True)
    freedom = max(sum(int(each.marker.used.sum()) - OWN for each in states), 1)
    variance = max(sum(each.squares for each in states) / freedom, 1e-6)
    information = reduced.information / variance
    gradients = reduced.gradients / variance
    result, covariance = parameters.copy(), np.full((4, 4), np.nan)
    if moved.any():
        inner = information[np.ix_(moved, moved)]
        result[moved] += solved_normal(inner, gradients.sum(axis=0)[moved])
        if len(states) > 1:
            inverse = np.linalg.pinv(inner)
            scatter = len(states) * np.cov(gradients[:, moved].T, ddof=1).reshape(inner.shape)
            covariance[np.ix_(moved, moved)] = inverse @ scatter @ inverse
    return PhotographFit(
        number, result, moved, information, gradients.sum(axis=0), covariance, tuple(states)
    )


# --------------------------------------------------------------------------------------------------
# Noise of photographs, from the residuals of pixels far from edges.
#
# A fit takes a part of the noise into its parameters. With Q the orthonormal columns of its
# derivatives and R the correlation of the noise between pixels, the residuals' correlation is (1
# - QQᵀ) R (1 - QQᵀ): what is missing of variance and of lagged products is computed and added.

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
