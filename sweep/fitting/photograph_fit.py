"""The fit of the simulator's own image to one photograph, and the noise of its residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.compilation import compiled
from sweep.fitting.views import FittedMarker, FittedPhotograph, module_plane, shares
from sweep.measure.likelihood import QUANTISATION_VARIANCE
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# The simulator's own image of one marker in a photograph, its residuals and derivatives.
#
# The level of a pixel of a marker is
#
#     y = b + c F(s),
#     F(s) = s + amount (s - s_wide) + bloom s (1 - s),
#
# s being the exact share of white through a Gaussian point spread, and s_wide that through one that
# is wider by the radius of the sharpening: what the simulator makes of black, white, blur,
# sharpening and bloom before it adds noise. Each marker has its own corners and levels; point
# spread, amount and bloom are the photograph's.

VARIANCE, AMOUNT, BLOOM = range(3)
"""Parameters of a photograph: variance of the point spread in px², amount of sharpening, bloom."""

RADIUS_PX = 1.0
"""Radius of the sharpening: what ``sharpening_px`` is unless it is given."""

CORNERS, OWN = 8, 10
"""Parameters of a marker: the shifts of its four corners, then b and c."""

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
        (2,) b and c.
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
        (n, OWN) and (n, 3) derivatives of the n fitted pixels.
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
        for blur in np.sqrt([variance, variance + RADIUS_PX**2])
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
    white = share[marker.used]
    sums = products(np.stack([np.ones_like(white), white, marker.levels[marker.used]], axis=1))
    levels = solved_normal(sums[:-1, :-1], sums[:-1, -1])
    return state_at(marker, marker.corners_px, levels, parameters)


def state_at(
    marker: FittedMarker, corners_px: Floats, levels: Floats, parameters: Floats,
) -> MarkerState:
    """Return a marker's residuals at its and the photograph's parameters, without derivatives."""
    images = _rendered(marker, corners_px, parameters)
    share = _combined(images, parameters)
    level = levels[0] + levels[1] * share
    residuals = np.where(marker.used, marker.levels - np.clip(level, 0.0, 255.0), 0.0)
    scale = np.where((level > 0.0) & (level < 255.0), levels[1], 0.0)
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
    inside = (state.scale != 0)[used]
    moved = [
        (state.scale * along[axis] * marker.shape[k])[used] for k in range(4) for axis in range(2)
    ]
    x, y = marker.modules_at
    state.uneven = np.stack([
        (state.scale * along[axis] * at * (1 - at))[used] for at in (x, y) for axis in range(2)
    ], axis=1)
    state.own = np.stack([*moved, inside, state.share[used] * inside], axis=1)
    share, wide = state.images
    half, half_wide = (sides.sum(axis=1) - 4 * state.images) / (2 * STEP_PX**2)
    amount = parameters[AMOUNT]
    sharpened = 1 + amount + parameters[BLOOM] * (1 - 2 * np.clip(share, 0.0, 1.0))
    derivatives = (
        sharpened * half - amount * half_wide, share - wide, _tone(share)
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
# Each marker has its own corners and levels; point spread, amount of sharpening and bloom are the
# photograph's.

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

LOW, HIGH = np.array([0.0, -0.95, -0.95]), np.array([100.0, 10.0, 0.95])
"""Range of the parameters of a photograph."""

START = np.array([0.5, 0.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class PhotographFit:
    """The fit of one photograph.

    Attributes
    ----------
    number
        The photograph's.
    parameters
        (3,) its parameters. Of those that were moved they are the minimum of the quadratic
        approximation, so that a variance of 0 may be below 0; shifts of parts of markers are
        eliminated in it, which would be taken for bloom.
    states
        Its markers.
    """

    number: int
    parameters: Floats
    states: tuple[MarkerState, ...]


Reduced = tuple[Floats, Floats, list[tuple[Floats, Floats]]]
"""Information and gradient of the moved parameters, and of each marker how its own ones follow."""


def _reduced(
    states: Sequence[MarkerState], moved: Masks, *, uneven: bool = False
) -> Reduced:
    """Return the normal equations of the photograph's parameters, the markers' own eliminated.

    ``uneven`` shifts of parts of markers are eliminated, too.
    """
    size = int(moved.sum())
    information, gradient, own = np.zeros((size, size)), np.zeros(size), []
    for state in states:
        residual = state.residuals[state.marker.used]
        local = np.hstack([state.own, state.uneven]) if uneven else state.own
        count = local.shape[1]
        sums = products(np.hstack([local, state.shared[:, moved], residual[:, None]]))
        inner, outer = sums[:count, count:], sums[count:, count:]
        solved = solved_normal(sums[:count, :count], inner)
        rest = outer - inner.T @ solved
        information += rest[:-1, :-1]
        gradient += rest[:-1, -1]
        own.append((solved[:, :-1], solved[:, -1]))
    return information, gradient, own


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
        (3,) which of the photograph's parameters are moved; the others stay as at the start.
    start
        (3,) the parameters at which it starts.
    states
        The states of an earlier fit, in the place of the true corners.
    """
    parameters = start.copy()
    if states is None:
        first = moved & (np.arange(len(start)) == VARIANCE)
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
    result = parameters.copy()
    if moved.any():
        information, gradient, _ = _reduced(current, moved, uneven=True)
        result[moved] += solved_normal(information, gradient)
    return PhotographFit(photograph.number, result, tuple(current))


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
        step, own_steps = _step(_reduced(states, moved), parameters, moved)
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


def _step(reduced: Reduced, parameters: Floats, moved: Masks) -> tuple[Floats, list[Floats]]:
    """Return the step of the moved parameters, and those of each marker's own."""
    information, gradient, own = reduced
    step = np.zeros(len(gradient))
    if len(step):
        at, low, high = parameters[moved], LOW[moved], HIGH[moved]
        free = ~(((at <= low) & (gradient < 0)) | ((at >= high) & (gradient > 0)))
        step[free] = solved_normal(information[np.ix_(free, free)], gradient[free])
        largest = np.array([max(0.5, parameters[VARIANCE]), 1.0, 0.5])[moved]
        step *= min(1.0, float((largest / np.maximum(np.abs(step), 1e-12)).min()))
    return step, [pull - crossed @ step for crossed, pull in own]


def _moved_state(state: MarkerState, step: Floats, parameters: Floats) -> MarkerState:
    shift = np.clip(step[:CORNERS].reshape(4, 2), -1.0, 1.0)
    return state_at(
        state.marker, state.corners_px + shift, state.levels + step[CORNERS:], parameters
    )


# --------------------------------------------------------------------------------------------------
# Noise of photographs, from the residuals of pixels far from edges.
#
# A fit takes a part of the noise into its parameters: of a pixel the share that its derivatives
# explain, the diagonal of QQᵀ with their orthonormal columns Q. It is computed and added.

FLAT_PER_PX, FLAT_SHARE = 5e-3, 0.03
"""Slope of the share of white, and its distance from 0 or 1, below which a pixel is flat."""

MIN_PIXELS = 100
"""Flat pixels of a photograph, of one colour, from which its noise is estimated."""


@dataclass(frozen=True, slots=True)
class PhotographNoise:
    """The noise of one photograph.

    Attributes
    ----------
    black_variance, white_variance
        Of pixels on black and white, in squared grey levels, without that of rounding; NaN where
        too few pixels are flat.
    edge_ratio
        Root mean square of all residuals over that of flat pixels.
    """

    black_variance: float
    white_variance: float
    edge_ratio: float


def photograph_noise(states: Sequence[MarkerState]) -> PhotographNoise:
    """Return the noise of a photograph from the fits of its markers."""
    squares, counts, freedom = np.zeros(2), np.zeros(2), np.zeros(2)
    for state in states:
        used, residuals = state.marker.used, state.residuals[state.marker.used]
        columns = np.hstack([state.own, state.shared])
        columns = columns[:, np.abs(columns).max(axis=0) > 0]
        columns /= np.sqrt((columns**2).sum(axis=0))
        inverse = np.linalg.pinv(products(columns), rcond=1e-9, hermitian=True)
        explained = ((columns @ inverse) * columns).sum(axis=1)
        flat = ((np.hypot(*state.slope) < FLAT_PER_PX) & (state.scale != 0))[used]
        for k in range(2):
            area = flat & (np.abs(state.share[used] - k) < FLAT_SHARE)
            squares[k] += (residuals[area] ** 2).sum()
            counts[k] += area.sum()
            freedom[k] += area.sum() - explained[area].sum()
    if counts.max() < MIN_PIXELS:
        return PhotographNoise(np.nan, np.nan, np.nan)
    variance = np.where(counts >= MIN_PIXELS, squares / np.maximum(freedom, 1.0), np.nan)
    every = np.concatenate([state.residuals[state.marker.used] for state in states])
    flat_rms = np.sqrt(squares.sum() / counts.sum())
    black, white = (variance - QUANTISATION_VARIANCE).tolist()
    ratio = float(np.sqrt(np.mean(every**2)) / flat_rms) if flat_rms > 0 else np.nan
    return PhotographNoise(black, white, ratio)
