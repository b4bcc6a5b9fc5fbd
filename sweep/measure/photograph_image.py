"""A printed plane's blurred image and its slopes, as a photograph is fitted by them.

The level of a pixel is that of area coverage through a Gaussian point spread, as in
:mod:`sweep.model.coverage`. Its slopes along x and along y, and by the point spread's variance, are
integrals along the same edges. All edges lie in one plane, so that the image's slope by a parameter
of the pose is the slope along x and y times the velocity of the plane's point at the pixel: three
numbers a pixel in place of seven, where :mod:`sweep.model.derivatives` is exact. The point
spread mixes velocities of neighbouring points, which are the same up to its width over the
marker's side; that changes the direction of a step, not the pose at which the fit ends.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sweep.compilation import compiled
from sweep.model.coverage import MarkerEdges
from sweep.model.point_spread import NODES, WEIGHTS
from sweep.model.projection import (
    ModuleEdge,
    Projection,
    chord_count,
    distorted_point,
    homogeneous_pixel,
)
from sweep.typing import Floats

REACH = 3.5
"""Standard deviations at which the point spread is cut off; 5e-4 of it lies beyond."""

PANEL = 2.0
"""Length of one panel of the quadrature in standard deviations of the point spread: 4e-4 of the
jump."""

MAX_PANELS = 4096
"""Most panels of one straight segment."""

_STEPS = 64
_AT = np.arange(-6 * _STEPS, 6 * _STEPS + 2) / _STEPS
_DENSITY = np.exp(-0.5 * _AT**2) / math.sqrt(2.0 * math.pi)
_BELOW = np.array([0.5 * math.erfc(-at / math.sqrt(2.0)) for at in _AT.tolist()])
_BELOW_SUM = _AT * _BELOW + _DENSITY
"""The normal distribution, its integral, and the integral of that, in steps of 1/64 standard
deviations."""


class Slopes(NamedTuple):
    """A box's image and its slopes; all are 0 between calls.

    Attributes
    ----------
    rates
        (height, 4 · (width + 1)): of each pixel the image's step from the pixel before, its
        slopes by x and by y, and that by the point spread's variance.
    outside
        (height, width + 1) steps of the area outside.
    """

    rates: Floats
    outside: Floats


@compiled
def slope_space(height: int, width: int) -> Slopes:
    """Return the scratch space for a box."""
    return Slopes(np.zeros((height, 4 * (width + 1))), np.zeros((height, width + 1)))


@compiled
def _add_segment(
    out: Slopes, jump: float, outside: float, sigma: float, shortest: float,
    xa: float, ya: float, xb: float, yb: float,
) -> None:
    """Add a straight segment from (xa, ya) to (xb, yb) px of the box.

    ``jump`` is the image's step across it, ``outside`` that of the area outside.
    """
    rates, outsides = out
    height, width = outsides.shape[0], outsides.shape[1] - 1
    reach = REACH * sigma + 0.5
    if min(xa, xb) > width + reach or min(ya, yb) > height + reach or max(ya, yb) < -reach:
        return
    panels = min(
        max(math.ceil(math.hypot(xb - xa, yb - ya) / max(PANEL * sigma, shortest)), 1), MAX_PANELS
    )
    dx, dy = (xb - xa) / panels, (yb - ya) / panels
    most = int(2.0 * reach) + 3
    basis, along_y, steps = np.empty(4 * most), np.zeros(4 * most), np.empty(most)
    scale = _STEPS / sigma
    for panel in range(panels):
        for node in range(3):
            t = panel + NODES[node]
            x, y = xa + t * dx, ya + t * dy
            first, last = math.floor(x - reach), math.floor(x + reach) + 1
            top, bottom = max(math.floor(y - reach), 0), min(math.floor(y + reach), height - 1)
            if first >= width or top > bottom:
                continue
            weight_x, weight_y = WEIGHTS[node] * jump * dy, WEIGHTS[node] * jump * dx
            curved_x, curved_y = 0.5 * weight_x / sigma, 0.5 * weight_y / sigma
            begin, end = max(first, 0), min(last, width - 1)
            # Columns left of the box are one step at its first column.
            passed = before = low = low_sum = low_density = 0.0
            at = (first - x) * scale + 6.0 * _STEPS
            if at > 0.0:
                k = int(at)
                low, low_sum, low_density = _BELOW[k], sigma * _BELOW_SUM[k], _DENSITY[k]
            for j in range(first, end + 1):
                at = (j + 1.0 - x) * scale + 6.0 * _STEPS
                if at >= 12.0 * _STEPS:
                    high, high_sum, high_density = 1.0, j + 1.0 - x, 0.0
                elif at <= 0.0:
                    high, high_sum, high_density = 0.0, 0.0, 0.0
                else:
                    k = int(at)
                    part = at - k
                    high = _BELOW[k] + part * (_BELOW[k + 1] - _BELOW[k])
                    high_sum = sigma * (_BELOW_SUM[k] + part * (_BELOW_SUM[k + 1] - _BELOW_SUM[k]))
                    high_density = _DENSITY[k] + part * (_DENSITY[k + 1] - _DENSITY[k])
                share = 1.0 if j == last else high_sum - low_sum
                if j < 0:
                    passed += share - before
                else:
                    m = j - begin
                    near = high - low
                    steps[m] = share - before
                    basis[4 * m] = weight_x * (share - before)
                    basis[4 * m + 1] = weight_x * near
                    basis[4 * m + 2] = -weight_y * near
                    basis[4 * m + 3] = curved_x * (high_density - low_density)
                    along_y[4 * m + 3] = curved_y * near
                before, low, low_sum, low_density = share, high, high_sum, high_density
            at = (top - y) * scale + 6.0 * _STEPS
            low, low_density = 0.0, 0.0
            if at > 0.0:
                k = int(at)
                low, low_density = _BELOW[k], _DENSITY[k]
            count, start = max(end - begin + 1, 0), 4 * begin
            for i in range(top, bottom + 1):
                at = (i + 1.0 - y) * scale + 6.0 * _STEPS
                if at >= 12.0 * _STEPS:
                    high, high_density = 1.0, 0.0
                elif at <= 0.0:
                    high, high_density = 0.0, 0.0
                else:
                    k = int(at)
                    part = at - k
                    high = _BELOW[k] + part * (_BELOW[k + 1] - _BELOW[k])
                    high_density = _DENSITY[k] + part * (_DENSITY[k + 1] - _DENSITY[k])
                share, change = high - low, low_density - high_density
                low, low_density = high, high_density
                row = rates[i]
                for m in range(4 * count):
                    row[start + m] += share * basis[m] + change * along_y[m]
                if passed != 0.0:
                    rates[i, 0] += share * weight_x * passed
                if outside != 0.0:
                    factor = share * outside * WEIGHTS[node] * dy
                    outsides[i, 0] += factor * passed
                    for m in range(count):
                        outsides[i, begin + m] += factor * steps[m]


@compiled
def add_plane(
    out: Slopes, edges: MarkerEdges, values: Floats, projection: Projection, sigma: float,
    shortest: float,
) -> None:
    """Add the edges of a printed plane to ``out``.

    Parameters
    ----------
    out
        A box whose first pixel is (0, 0) of the projection.
    edges
        The edges of what is printed, in modules.
    values
        (3,) values of the image on the areas outside, black and white.
    projection
        The plane, and the camera.
    sigma
        The point spread's standard deviation in px, positive.
    shortest
        Least length of a panel of the quadrature in px.
    """
    intrinsics = projection.optics.intrinsics
    shift_x, shift_y = intrinsics[2] + 0.5, intrinsics[3] + 0.5
    ends, sides = edges.ends, edges.sides
    for e in range(ends.shape[0]):
        jump = values[sides[e, 1]] - values[sides[e, 0]]
        outside = 1.0 * (sides[e, 1] == 0) - 1.0 * (sides[e, 0] == 0)
        if jump == 0.0 and outside == 0.0:
            continue
        edge = ModuleEdge(ends[e, 0], ends[e, 1], ends[e, 2], ends[e, 3])
        if not projection.optics.distorted:
            x0, y0, z0 = homogeneous_pixel(projection, shift_x, shift_y, edge.column, edge.row)
            x1, y1, z1 = homogeneous_pixel(
                projection, shift_x, shift_y, edge.to_column, edge.to_row
            )
            _add_segment(
                out, jump, outside, sigma, shortest, x0 / z0, y0 / z0, x1 / z1, y1 / z1
            )
            continue
        chords = chord_count(projection, edge)
        x, y = distorted_point(0.0, projection, edge)
        for chord in range(1, chords + 1):
            u, v = distorted_point(chord / chords, projection, edge)
            _add_segment(
                out, jump, outside, sigma, shortest, x + 0.5, y + 0.5, u + 0.5, v + 0.5
            )
            x, y = u, v
