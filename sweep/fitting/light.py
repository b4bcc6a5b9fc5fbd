"""Levels of photographs, and how the light varies over the frame, from the levels of markers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.fitting.estimates import Estimate, estimate
from sweep.fitting.marker_state import MarkerState
from sweep.typing import Floats

MIN_MARKERS = 4
"""Markers of a photograph from which the light's gradient follows, and how well."""

ONE_DIRECTION_DEG = 40.0
"""Standard deviation of the light's directions below which there is one."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotographLight:
    """The levels of one photograph.

    Attributes
    ----------
    black, white
        At the middle of the frame.
    variances
        (2,) of these, from the spread of the markers.
    gradient
        (2,) relative change of the light across the frame's width, right and down; NaN with too
        few markers.
    gradient_variance
        Sum of the variances of both.
    """

    black: float
    white: float
    variances: Floats
    gradient: Floats
    gradient_variance: float


def photograph_light(states: Sequence[MarkerState], frame: Floats) -> PhotographLight:
    """Return the levels of a photograph; ``frame`` (2,) is the frame's width and height in px."""
    at = np.array([each.marker.centre_px for each in states])
    at = (at - (frame - 1) / 2) / frame[0]
    levels = np.array([each.levels[0] + np.array([0.0, each.levels[1]]) for each in states])
    count = len(states)
    none = np.full(2, np.nan)
    if count < MIN_MARKERS or np.linalg.matrix_rank(at - at.mean(axis=0), tol=1e-3) < 2:
        black, white = levels.mean(axis=0).tolist()
        return PhotographLight(black, white, none, none, math.nan)
    design = np.column_stack([np.ones(count), at])
    inverse = np.linalg.inv(design.T @ design)
    solution = inverse @ design.T @ levels[:, 1]
    residuals = levels[:, 1] - design @ solution
    variance = float(residuals @ residuals) / (count - 3)
    white, gradient = float(solution[0]), solution[1:] / solution[0]
    dark = levels[:, 0] / (1 + at @ gradient)
    own = np.array([dark.var(ddof=1) / count, variance * inverse[0, 0]])
    return PhotographLight(
        float(dark.mean()), white, own, gradient,
        variance * float(np.trace(inverse[1:, 1:])) / white**2,
    )


def gradient_square(lights: Sequence[PhotographLight]) -> Estimate:
    """Return the mean square of the light's gradient, without what errors of levels add."""
    return estimate(np.array([
        each.gradient @ each.gradient - each.gradient_variance for each in lights
    ]))


def gradient_size(lights: Sequence[PhotographLight]) -> Estimate:
    """Return the light's gradient: the root of the mean square, and its spread."""
    square = gradient_square(lights)
    lengths = np.array([np.linalg.norm(each.gradient) for each in lights])
    variances = np.array([each.gradient_variance / 2 for each in lights])
    spread = estimate(lengths, variances).spread
    value, low, high = (
        math.sqrt(max(end, 0.0)) if math.isfinite(end) else math.nan
        for end in (square.value, square.low, square.high)
    )
    return Estimate(value, low, high, spread)


def gradient_direction(lights: Sequence[PhotographLight]) -> Estimate | None:
    """Return the direction in which the light grows, in degrees; None if there is not one."""
    gradients = np.array([each.gradient for each in lights if np.isfinite(each.gradient).all()])
    if not len(gradients):
        return None
    units = gradients / np.linalg.norm(gradients, axis=1, keepdims=True)
    mean = math.degrees(math.atan2(*units.sum(axis=0)[::-1]))
    angles = np.degrees(np.arctan2(gradients[:, 1], gradients[:, 0]))
    deviations = (angles - mean + 180.0) % 360.0 - 180.0
    if not math.sqrt(float(np.mean(deviations**2))) < ONE_DIRECTION_DEG:
        return None
    errors = np.array([
        each.gradient_variance / 2 / max(float(each.gradient @ each.gradient), 1e-12)
        for each in lights if np.isfinite(each.gradient).all()
    ])
    around = estimate(deviations, np.degrees(np.sqrt(errors)) ** 2)
    return Estimate(mean + around.value, mean + around.low, mean + around.high, around.spread)
