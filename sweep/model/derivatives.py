"""The exact image's derivatives by the marker's pose, by the point spread and by the grey levels.

If an edge moves, the level of a pixel changes by the edge's jump times the integral of the edge's
normal velocity over its part in the pixel. Under a homography that velocity is linear along the
edge's image, so that length times the value in the middle of each part is exact: twelve numbers an
edge, the velocities of its two ends under six pose parameters.

A pose moves by δ = (ω, τ): rotation to exp(ω) R, translation to t + τ, in the camera frame, in
radians and metres: the same six numbers as ``rotation_error_rad`` and ``translation_error_m``.

The box begins at pixel (0, 0): the principal point is given relative to the box.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled, compiled_inline
from sweep.model.coverage import (
    MIN_PANEL_PX,
    NODES,
    REACH,
    WEIGHTS,
    MarkerEdges,
    accumulate,
    spread_below,
)
from sweep.model.lens import distort, jacobian
from sweep.model.polygon import (
    ModuleEdge,
    Optics,
    Projection,
    chord_count,
    clip,
    distorted_point,
    homogeneous_pixel,
)
from sweep.typing import Floats

POSE = 6
"""Parameters of a pose; the point spread, if its derivative is requested, is one more."""

LEVELS = 3
"""Unknown grey levels: outside, black, white."""


class Work(NamedTuple):
    """Scratch space of one image size; ``shares`` is 0 and ``slot`` is -1 between calls.

    Attributes
    ----------
    shares
        (2, height, width + 2): accumulators of the areas that black and white cover.
    slot
        (height, width): the row of ``slopes`` of each pixel, -1 for a pixel without slopes.
    slopes
        (height · width, 7): d(level)/d(pose) and, for a positive point spread, d(level)/d(sigma).
    """

    shares: Floats
    slot: NDArray[np.int32]
    slopes: Floats


@compiled
def work_space(height: int, width: int) -> Work:
    """Return the scratch space for an image."""
    return Work(
        np.zeros((2, height, width + 2)),
        np.full((height, width), -1, dtype=np.int32),
        np.empty((height * width, POSE + 1)),
    )


class MovingSegment(NamedTuple):
    """The image of an edge or of a chord of it, in pixels, from (xa, ya) to (xb, yb).

    ``at_a`` and ``at_b`` (6,) are the normal velocities of its ends under the pose parameters,
    times the segment's length.
    """

    xa: float
    ya: float
    xb: float
    yb: float
    at_a: Floats
    at_b: Floats


@compiled
def _slot(work: Work, count: int, i: int, j: int) -> int:
    """Return the row of ``slopes`` of a pixel, the next free one (``count``) if it has none."""
    slot = work.slot[i, j]
    if slot < 0:
        work.slot[i, j] = count
        work.slopes[count] = 0.0
        return count
    return int(slot)


@compiled
def _add_sharp(work: Work, count: int, jump: float, segment: MovingSegment) -> int:
    """Add the slopes of a segment to ``work``, pixel by pixel.

    ``count`` rows of ``slopes`` are in use; returns how many are afterwards.
    """
    xa, ya, xb, yb, at_a, at_b = segment
    height, width = work.slot.shape
    slopes = work.slopes
    dx, dy = xb - xa, yb - ya
    line_x = math.floor(xa) + 1.0 if dx > 0.0 else math.ceil(xa) - 1.0
    line_y = math.floor(ya) + 1.0 if dy > 0.0 else math.ceil(ya) - 1.0
    step_x, step_y = math.copysign(1.0, dx), math.copysign(1.0, dy)
    next_x = (line_x - xa) / dx if dx != 0.0 else 2.0
    next_y = (line_y - ya) / dy if dy != 0.0 else 2.0
    t = 0.0
    while t < 1.0:
        end = min(next_x, next_y, 1.0)
        if end > t:
            middle = 0.5 * (t + end)
            j, i = math.floor(xa + middle * dx), math.floor(ya + middle * dy)
            if 0 <= i < height and 0 <= j < width:
                slot = _slot(work, count, i, j)
                count = max(count, slot + 1)
                share = jump * (end - t)
                for k in range(POSE):
                    slopes[slot, k] -= share * (at_a[k] + middle * (at_b[k] - at_a[k]))
            t = end
        if next_x <= end:
            line_x += step_x
            next_x = (line_x - xa) / dx
        if next_y <= end:
            line_y += step_y
            next_y = (line_y - ya) / dy
    return count


@compiled
def _add_spread(
    work: Work, count: int, jump: float, sigma: float, segment: MovingSegment
) -> int:
    """As :func:`_add_sharp` through a Gaussian point spread, with the slope by ``sigma``.

    The point spread obeys the heat equation, dK/dsigma = sigma · (Laplacian of K), so that the
    slope by sigma is an integral along the edge, too: that of sigma times K's normal derivative.
    """
    xa, ya, xb, yb, at_a, at_b = segment
    height, width = work.slot.shape
    slopes = work.slopes
    reach = REACH * sigma + 0.5
    dx, dy = xb - xa, yb - ya
    panels = math.ceil(math.hypot(dx, dy) / max(1.5 * sigma, MIN_PANEL_PX))
    most = int(2 * reach) + 3
    near, slope = np.empty((2, most)), np.empty((2, most))
    normal = 1.0 / (sigma * math.sqrt(2.0 * math.pi))
    first = np.zeros(2, dtype=np.int64)
    last = np.zeros(2, dtype=np.int64)
    for panel in range(panels):
        for node in range(3):
            weight = WEIGHTS[node] / panels
            t = (panel + NODES[node]) / panels
            at = (xa + t * dx, ya + t * dy)
            for axis in range(2):
                size = width if axis == 0 else height
                first[axis] = max(math.floor(at[axis] - reach), 0)
                last[axis] = min(math.floor(at[axis] + reach) + 1, size - 1)
                # The share of the point spread that falls on each pixel, and its slope.
                d = first[axis] - at[axis]
                below, density = spread_below(d, sigma), normal * math.exp(-0.5 * (d / sigma) ** 2)
                for j in range(last[axis] - first[axis] + 1):
                    d += 1.0
                    above = spread_below(d, sigma)
                    higher = normal * math.exp(-0.5 * (d / sigma) ** 2)
                    near[axis, j], slope[axis, j] = above - below, density - higher
                    below, density = above, higher
            for i in range(last[1] - first[1] + 1):
                for j in range(last[0] - first[0] + 1):
                    slot = _slot(work, count, first[1] + i, first[0] + j)
                    count = max(count, slot + 1)
                    share = jump * weight * near[0, j] * near[1, i]
                    for k in range(POSE):
                        slopes[slot, k] -= share * (at_a[k] + t * (at_b[k] - at_a[k]))
                    slopes[slot, POSE] += jump * weight * sigma * (
                        near[0, j] * slope[1, i] * dx - slope[0, j] * near[1, i] * dy
                    )
    return count


@compiled
def velocity(
    x: float, y: float, z: float, translation: Floats, optics: Optics, rates: Floats
) -> tuple[float, float]:
    """Return the pixel of a point in space; write its velocities to ``rates`` (2, 6).

    The velocities are those of u and of v under the six pose parameters.
    """
    intrinsics, lens = optics.intrinsics, optics.lens
    px, py, pz = x - translation[0], y - translation[1], z - translation[2]
    xn, yn = x / z, y / z
    a, b, c, d = 1.0, 0.0, 0.0, 1.0
    u, v = xn, yn
    if optics.distorted:
        a, b, c, d = jacobian(xn, yn, lens)
        u, v = distort(xn, yn, lens)
    for k in range(POSE):
        if k == 0:
            rx, ry, rz = 0.0, -pz, py
        elif k == 1:
            rx, ry, rz = pz, 0.0, -px
        elif k == 2:
            rx, ry, rz = -py, px, 0.0
        else:
            rx, ry, rz = 1.0 * (k == 3), 1.0 * (k == 4), 1.0 * (k == 5)
        x_rate, y_rate = (rx - xn * rz) / z, (ry - yn * rz) / z
        rates[0, k] = intrinsics[0] * (a * x_rate + b * y_rate)
        rates[1, k] = intrinsics[1] * (c * x_rate + d * y_rate)
    return intrinsics[0] * u + intrinsics[2] + 0.5, intrinsics[1] * v + intrinsics[3] + 0.5


@compiled
def differentiate(
    work: Work, edges: MarkerEdges, levels: Floats, projection: Projection, translation: Floats,
    sigma: float, count: int,
) -> int:
    """Draw a marker's image and its derivatives; return how many pixels have slopes.

    Parameters
    ----------
    work
        Gets the accumulators of the areas of black and white
        (:func:`sweep.model.coverage.accumulate`), and the slopes.
    edges, projection, sigma
        As :func:`sweep.model.coverage.accumulate`.
    levels
        (3,) grey levels of outside, black and white that the slopes are for.
    translation
        (3,) position of the marker's centre, about which ω turns it.
    count
        Pixels that have slopes already, of sheets in other planes.
    """
    for area in range(2):
        # Black is 1 and all else 0, then white.
        area_levels = np.zeros(LEVELS)
        area_levels[1 + area] = 1.0
        accumulate(work.shares[area], edges, area_levels, projection, 0, 0, sigma)
    plane, optics = projection.plane, projection.optics
    ends, sides = edges.ends, edges.sides
    height, width = work.slot.shape
    margin = REACH * sigma + 0.5 if sigma > 0.0 else 0.0
    rates = np.empty((4, POSE))
    at_a, at_b = np.empty(POSE), np.empty(POSE)
    shift_x, shift_y = optics.intrinsics[2] + 0.5 + margin, optics.intrinsics[3] + 0.5 + margin
    far_x, far_y = width + 2.0 * margin, height + 2.0 * margin
    for e in range(ends.shape[0]):
        jump = levels[sides[e, 1]] - levels[sides[e, 0]]
        if jump == 0.0:
            continue
        a, b, c, d = ends[e, 0], ends[e, 1], ends[e, 2], ends[e, 3]
        edge = ModuleEdge(a, b, c, d)
        chords = chord_count(projection, edge) if optics.distorted else 1
        for chord in range(chords):
            t0, t1 = chord / chords, (chord + 1.0) / chords
            if not optics.distorted:
                # Clip to the box and its margin before division, as the image is.
                x0, y0, z0 = homogeneous_pixel(projection, shift_x, shift_y, a, b)
                x1, y1, z1 = homogeneous_pixel(projection, shift_x, shift_y, c, d)
                t0, t1 = clip(x0, x1, t0, t1)
                t0, t1 = clip(y0, y1, t0, t1)
                t0, t1 = clip(far_x * z0 - x0, far_x * z1 - x1, t0, t1)
                t0, t1 = clip(far_y * z0 - y0, far_y * z1 - y1, t0, t1)
            else:
                u0, v0 = distorted_point(t0, projection, edge)
                u1, v1 = distorted_point(t1, projection, edge)
                if (
                    max(u0, u1) + 0.5 < -margin or min(u0, u1) + 0.5 > width + margin
                    or max(v0, v1) + 0.5 < -margin or min(v0, v1) + 0.5 > height + margin
                ):
                    continue
            if not t0 < t1:
                continue
            ca, cb, da, db = a + t0 * (c - a), a + t1 * (c - a), b + t0 * (d - b), b + t1 * (d - b)
            xa, ya = velocity(
                plane[0, 0] * ca + plane[0, 1] * da + plane[0, 2],
                plane[1, 0] * ca + plane[1, 1] * da + plane[1, 2],
                plane[2, 0] * ca + plane[2, 1] * da + plane[2, 2],
                translation, optics, rates[:2],
            )
            xb, yb = velocity(
                plane[0, 0] * cb + plane[0, 1] * db + plane[0, 2],
                plane[1, 0] * cb + plane[1, 1] * db + plane[1, 2],
                plane[2, 0] * cb + plane[2, 1] * db + plane[2, 2],
                translation, optics, rates[2:],
            )
            for k in range(POSE):
                at_a[k] = rates[0, k] * (yb - ya) - rates[1, k] * (xb - xa)
                at_b[k] = rates[2, k] * (yb - ya) - rates[3, k] * (xb - xa)
            segment = MovingSegment(xa, ya, xb, yb, at_a, at_b)
            if sigma > 0.0:
                count = _add_spread(work, count, jump, sigma, segment)
            else:
                count = _add_sharp(work, count, jump, segment)
    return count


@compiled_inline
def _add_column(
    matrix: Floats, vector: Floats, column: Floats, first: int, pixels: float, total: float
) -> None:
    """Add a number of pixels, the sum of whose levels is ``total``, with columns from ``first`` on.

    To the lower triangle of ``matrix``; the columns before ``first`` are 0.
    """
    for k in range(first, len(column)):
        vector[k] += total * column[k]
        for m in range(first, k + 1):
            matrix[k, m] += pixels * column[k] * column[m]


@compiled
def normal_equations(
    image: Floats, work: Work, free: int, matrix: Floats, vector: Floats
) -> None:
    """Sum up JᵀJ and Jᵀ·image over the pixels of a box, and clear ``work``.

    J's columns are the first ``free`` slopes and the areas of outside, black and white; pixels that
    are NaN are left out. ``matrix`` (free + 3, free + 3) and ``vector`` (free + 3,) are
    overwritten.
    """
    shares, slots, slopes = work
    size = free + LEVELS
    matrix[:] = 0.0
    vector[:] = 0.0
    column = np.empty(size)
    height, width = slots.shape
    for i in range(height):
        black = white = 0.0
        pixels = total = 0.0
        for j in range(width):
            more_black, more_white, slot = shares[0, i, j], shares[1, i, j], slots[i, j]
            level = image[i, j]
            known = not math.isnan(level)
            if more_black == 0.0 and more_white == 0.0 and slot < 0 and known:
                pixels += 1.0
                total += level
                continue
            # A run of pixels with the same areas ends.
            column[free], column[free + 1], column[free + 2] = 1.0 - black - white, black, white
            _add_column(matrix, vector, column, free, pixels, total)
            black += more_black
            white += more_white
            shares[0, i, j] = shares[1, i, j] = 0.0
            if not known:
                slots[i, j] = -1
                pixels = total = 0.0
                continue
            if slot < 0:
                pixels, total = 1.0, level
                continue
            pixels = total = 0.0
            slots[i, j] = -1
            column[free], column[free + 1], column[free + 2] = 1.0 - black - white, black, white
            for k in range(free):
                column[k] = slopes[slot, k]
            _add_column(matrix, vector, column, 0, 1.0, level)
        column[free], column[free + 1], column[free + 2] = 1.0 - black - white, black, white
        _add_column(matrix, vector, column, free, pixels, total)
        shares[0, i, width:] = 0.0
        shares[1, i, width:] = 0.0
    for k in range(size):
        for m in range(k):
            matrix[m, k] = matrix[k, m]


@compiled
def known_pixels(image: Floats) -> int:
    """Return how many pixels are not NaN."""
    count = 0
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            count += not math.isnan(image[i, j])
    return count
