"""The simulator's own image of one marker in a photograph, its residuals and derivatives.

The level of a pixel of a marker is

    y = b + g · x + (c + h · x) F(s),
    F(s) = s + amount (s - s_wide) + bloom s (1 - s),

s being the exact share of white through a Gaussian point spread, s_wide that through one that is
wider by the radius of the sharpening, and x (2,) the position beside the marker's centre: what the
simulator makes of black, white, uneven light, blur, sharpening and bloom before it adds noise. Each
marker has its own corners and levels; point spread, amount, bloom and radius are the photograph's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sweep.compilation import compiled
from sweep.fitting.rendering import module_plane, shares
from sweep.fitting.views import FittedMarker
from sweep.typing import Floats

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
