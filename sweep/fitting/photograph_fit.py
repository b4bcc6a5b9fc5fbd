"""The fit of the simulator's own image to one photograph: Gauss-Newton over all its markers.

Each marker has its own corners and levels; point spread, amount of sharpening, bloom and radius
are the photograph's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.fitting.marker_state import (
    CORNERS,
    OWN,
    VARIANCE,
    MarkerState,
    differentiate,
    fresh_state,
    products,
    solved_normal,
    state_at,
)
from sweep.fitting.views import FittedPhotograph
from sweep.typing import Floats, Masks

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
