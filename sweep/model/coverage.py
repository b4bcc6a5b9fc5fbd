"""The exact grey level of every pixel, by area coverage of projected edges, and its derivatives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled, compiled_inline
from sweep.model import polygon
from sweep.model.lens import distort, jacobian
from sweep.model.polygon import ModuleEdge, Optics, Projection, Sheet, clip
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The Gaussian point spread: its integrals, and the quadrature along an edge seen through it.

#: Standard deviations at which the point spread is cut off; 6e-7 of it lies beyond.
REACH = 5.0

#: Shortest piece of an edge that is integrated on its own.
MIN_PANEL_PX = 0.015

NODES = (0.1127016653792583, 0.5, 0.8872983346207417)
#: Three Gauss-Legendre nodes on [0, 1], and their weights.
WEIGHTS = (0.2777777777777778, 0.4444444444444444, 0.2777777777777778)

_STEPS = 256
_AT = np.arange(-6 * _STEPS, 6 * _STEPS + 2) / _STEPS
_BELOW = np.array([0.5 * math.erfc(-at / math.sqrt(2.0)) for at in _AT.tolist()])
#: The normal distribution's integral, and the integral of that, in steps of 1/256 standard
#: deviations: interpolated linearly they are accurate to 8e-7.
_BELOW_SUM = _AT * _BELOW + np.exp(-0.5 * _AT**2) / math.sqrt(2.0 * math.pi)


@compiled
def _interpolated(table: Floats, at: float) -> float:
    """Return a table's value between its steps."""
    k = int(at)
    return float(table[k] + (at - k) * (table[k + 1] - table[k]))


@compiled
def spread_below(t: float, sigma: float) -> float:
    """Return the share of a Gaussian of standard deviation ``sigma`` that lies below t."""
    at = (t / sigma + 6.0) * _STEPS
    if at <= 0.0:
        return 0.0
    if at >= 12.0 * _STEPS:
        return 1.0
    return _interpolated(_BELOW, at)


@compiled
def spread_below_sum(t: float, sigma: float) -> float:
    """Return the integral of :func:`spread_below` up to t."""
    at = (t / sigma + 6.0) * _STEPS
    if at <= 0.0:
        return 0.0
    if at >= 12.0 * _STEPS:
        return t
    return sigma * _interpolated(_BELOW_SUM, at)


# --------------------------------------------------------------------------------------------------
# The exact grey level of every pixel: analytic area coverage of the marker's projected edges.
#
# The method of font rasterisers (Levien, "Inside the fastest font renderer in the world", 2016):
# each edge adds its signed area and cover to the pixels of its rows, and a running sum along each
# row turns them into covered area. An edge carries the jump of the grey level across it, so that
# one pass gives the levels themselves. Errors are those of double precision.
#
# Pixel i covers [i - 0.5, i + 0.5]; the functions below shift coordinates by 0.5, so that it
# covers [i, i + 1].

#: Levels this close below a half round up, so that the last bits of a sum never decide.
ROUNDING_SNAP = 1e-9


class MarkerEdges(NamedTuple):
    """A marker's edges in module coordinates (column right, row down, origin at the TL corner).

    Attributes
    ----------
    ends
        (E, 4) column and row of the start and of the end.
    sides
        (E, 2) codes of the areas on the two sides (:mod:`sweep.model.marker`). The jump of the
        grey level across an edge is ``level[sides[1]] - level[sides[0]]``, signed for an edge
        that is traversed downwards in the image with ``sides[1]`` at greater x.
    """

    ends: Floats
    sides: NDArray[np.int64]


def joined(parts: Sequence[MarkerEdges]) -> MarkerEdges:
    """Return the edges of several prints in one table."""
    return MarkerEdges(
        np.concatenate([np.empty((0, 4)), *(part.ends for part in parts)]),
        np.concatenate([np.empty((0, 2), dtype=np.int64), *(part.sides for part in parts)]),
    )


class Segment(NamedTuple):
    """A segment in space in homogeneous pixels: the image of each end is (x/z, y/z), z > 0."""

    x0: float
    y0: float
    z0: float
    x1: float
    y1: float
    z1: float


@compiled
def _add_in_row(row: Floats, jump: float, xa: float, xb: float, dy: float) -> None:
    """Add a segment from x = xa to xb that descends by dy within one row of pixels."""
    left, right = (xa, xb) if xa <= xb else (xb, xa)
    first = int(left)
    last = int(right)
    if right == last and last > first:
        last -= 1
    if first == last:
        middle = 0.5 * (xa + xb) - first
        row[first] += jump * dy * (1.0 - middle)
        row[first + 1] += jump * dy * middle
        return
    slope = dy / (right - left)
    x = left
    for column in range(first, last + 1):
        end = right if column == last else column + 1.0
        part = slope * (end - x)
        middle = 0.5 * (x + end) - column
        row[column] += jump * part * (1.0 - middle)
        row[column + 1] += jump * part * middle
        x = end


@compiled
def _add_segment(cover: Floats, jump: float, x0: float, y0: float, x1: float, y1: float) -> None:
    """Add a segment that lies within the box [0, width] x [0, height]."""
    if not (y0 < y1 or y1 < y0) or math.isnan(x0) or math.isnan(x1):
        return
    if y0 < y1:
        sign, xa, ya, xb, yb = 1.0, x0, y0, x1, y1
    else:
        sign, xa, ya, xb, yb = -1.0, x1, y1, x0, y0
    first = int(ya)
    last = int(yb)
    if yb == last and last > first:
        last -= 1
    if first == last:
        _add_in_row(cover[first], sign * jump, xa, xb, yb - ya)
        return
    slope = (xb - xa) / (yb - ya)
    low, high = (xa, xb) if xa <= xb else (xb, xa)
    x, y = xa, ya
    for line in range(first, last + 1):
        if line == last:
            end, x_end = yb, xb
        else:
            end = line + 1.0
            x_end = min(max(xa + (end - ya) * slope, low), high)
        _add_in_row(cover[line], sign * jump, x, x_end, end - y)
        x, y = x_end, end


@compiled
def _clamped_pixel(t: float, width: float, height: float, segment: Segment) -> tuple[float, float]:
    """Return the pixel at parameter t of a segment, clamped into the box."""
    x0, y0, z0, x1, y1, z1 = segment
    if t <= 0.0:
        x, y, z = x0, y0, z0
    elif t >= 1.0:
        x, y, z = x1, y1, z1
    else:
        x, y, z = x0 + t * (x1 - x0), y0 + t * (y1 - y0), z0 + t * (z1 - z0)
    return min(max(x / z, 0.0), width), min(max(y / z, 0.0), height)


@compiled
def _add_projected(cover: Floats, jump: float, segment: Segment) -> None:
    """Add the image of a segment, clipped to the box before division.

    Parts above, below or right of the box add nothing; parts left of it cover whole rows, as the
    same segment moved onto the box's left side does. Clipping in homogeneous coordinates keeps
    points exact whose images lie far outside.
    """
    x0, y0, z0, x1, y1, z1 = segment
    height, width = cover.shape[0] * 1.0, (cover.shape[1] - 2) * 1.0
    lower, upper = clip(y0, y1, 0.0, 1.0)
    lower, upper = clip(height * z0 - y0, height * z1 - y1, lower, upper)
    if lower >= upper:
        return
    # Left of the box: on [lower, upper] minus where x >= 0.
    inner_lower, inner_upper = clip(x0, x1, lower, upper)
    if inner_lower >= inner_upper:
        inner_lower = inner_upper = upper
    for begin, end in ((lower, inner_lower), (inner_upper, upper)):
        if begin < end:
            _, ya = _clamped_pixel(begin, width, height, segment)
            _, yb = _clamped_pixel(end, width, height, segment)
            _add_segment(cover, jump, 0.0, ya, 0.0, yb)
    lower, upper = clip(width * z0 - x0, width * z1 - x1, inner_lower, inner_upper)
    if lower >= upper:
        return
    xa, ya = _clamped_pixel(lower, width, height, segment)
    xb, yb = _clamped_pixel(upper, width, height, segment)
    _add_segment(cover, jump, xa, ya, xb, yb)


@compiled
def _add_left(cover: Floats, jump: float, ya: float, yb: float, sigma: float) -> None:
    """Add a segment from y = ya to yb so far left of the box that it covers whole rows."""
    reach = REACH * sigma + 1.0
    first = max(math.floor(min(ya, yb) - reach), 0)
    last = min(math.floor(max(ya, yb) + reach), cover.shape[0] - 1)
    for i in range(first, last + 1):
        low, high = ya - i, yb - i
        share = spread_below_sum(high, sigma) - spread_below_sum(high - 1.0, sigma)
        share -= spread_below_sum(low, sigma) - spread_below_sum(low - 1.0, sigma)
        cover[i, 0] += jump * share


@compiled
def _add_blurred(cover: Floats, jump: float, sigma: float, segment: Segment) -> None:
    """As :func:`_add_projected`, seen through a Gaussian point spread of ``sigma`` px.

    By Green's theorem a segment adds to each pixel the integral over its dy of p(y)·P(x): p is
    the point spread seen by a pixel (box and Gaussian convolved), P the integral of p along x.
    Both are smooth on the scale of sigma, so three Gauss-Legendre nodes on pieces of 1.5 sigma
    leave less than 1e-4 of the jump.
    """
    x0, y0, z0, x1, y1, z1 = segment
    height, width = cover.shape[0] * 1.0, (cover.shape[1] - 2) * 1.0
    reach = REACH * sigma + 0.5
    lower, upper = clip(y0 + reach * z0, y1 + reach * z1, 0.0, 1.0)
    lower, upper = clip((height + reach) * z0 - y0, (height + reach) * z1 - y1, lower, upper)
    lower, upper = clip((width + reach) * z0 - x0, (width + reach) * z1 - x1, lower, upper)
    if lower >= upper:
        return
    inner, outer = clip(x0 + reach * z0, x1 + reach * z1, lower, upper)
    if inner >= outer:
        inner = outer = upper
    ends = (lower, inner, outer, upper)
    for part in range(3):
        t0, t1 = ends[part], ends[part + 1]
        if t0 >= t1:
            continue
        za, zb = z0 + t0 * (z1 - z0), z0 + t1 * (z1 - z0)
        xa, ya = (x0 + t0 * (x1 - x0)) / za, (y0 + t0 * (y1 - y0)) / za
        xb, yb = (x0 + t1 * (x1 - x0)) / zb, (y0 + t1 * (y1 - y0)) / zb
        if part != 1 or inner >= outer:
            _add_left(cover, jump, ya, yb, sigma)
        elif ya != yb:
            _add_spread(cover, jump, sigma, xa, ya, xb, yb)


@compiled
def _add_spread(
    cover: Floats, jump: float, sigma: float,
    xa: float, ya: float, xb: float, yb: float,
) -> None:
    """Add a blurred segment in pixels, by quadrature along it."""
    reach = REACH * sigma + 0.5
    height, width = cover.shape[0], cover.shape[1] - 2
    length = math.hypot(xb - xa, yb - ya)
    panels = math.ceil(length / max(1.5 * sigma, MIN_PANEL_PX))
    dy = (yb - ya) / panels
    steps = np.empty(width)
    for panel in range(panels):
        for node in range(3):
            weight = WEIGHTS[node]
            t = (panel + NODES[node]) / panels
            x, y = xa + t * (xb - xa), ya + t * (yb - ya)
            first = max(math.floor(x - reach), 0)
            last = min(math.floor(x + reach) + 1, width - 1)
            if first > last:
                continue
            # P at the columns' centres, as steps from one to the next.
            below = spread_below_sum(first - x, sigma)
            before = 0.0
            for j in range(first, last + 1):
                above = spread_below_sum(j + 1.0 - x, sigma)
                steps[j - first] = above - below - before
                before = above - below
                below = above
            top = max(math.floor(y - reach), 0)
            bottom = min(math.floor(y + reach) + 1, height - 1)
            below = spread_below(top - y, sigma)
            for i in range(top, bottom + 1):
                above = spread_below(i + 1.0 - y, sigma)
                scale = jump * dy * weight * (above - below)
                below = above
                for j in range(first, last + 1):
                    cover[i, j] += scale * steps[j - first]


@compiled
def _accumulate_curved(
    cover: Floats, edges: MarkerEdges, levels: Floats, projection: Projection, left: int, top: int,
    sigma: float, sheet: Sheet,
) -> None:
    """As :func:`accumulate`, of a sheet that is bent or shifted, or seen through a lens.

    Each edge is divided into pieces, and each piece into chords of which none is farther from the
    edge's image than 1e-4 px.
    """
    ends, sides = edges.ends, edges.sides
    for e in range(ends.shape[0]):
        jump = levels[sides[e, 1]] - levels[sides[e, 0]]
        if jump == 0.0:
            continue
        edge = ModuleEdge(ends[e, 0], ends[e, 1], ends[e, 2], ends[e, 3])
        pieces = polygon.piece_count(edge, projection, sheet)
        x, y = polygon.sheet_pixel(edge.column, edge.row, projection, sheet)
        for piece in range(pieces):
            u1, v1 = polygon.edge_pixel((piece + 1.0) / pieces, edge, projection, sheet)
            chords = polygon.chord_count(edge, piece, pieces, (x, y, u1, v1), projection, sheet)
            for chord in range(1, chords + 1):
                u, v = u1, v1
                if chord < chords:
                    t = (piece + chord / chords) / pieces
                    u, v = polygon.edge_pixel(t, edge, projection, sheet)
                segment = Segment(
                    x + (0.5 - left), y + (0.5 - top), 1.0, u + (0.5 - left), v + (0.5 - top), 1.0
                )
                if sigma > 0.0:
                    _add_blurred(cover, jump, sigma, segment)
                else:
                    _add_projected(cover, jump, segment)
                x, y = u, v


@compiled
def accumulate(
    cover: Floats, edges: MarkerEdges, levels: Floats, projection: Projection, left: int, top: int,
    sigma: float | None, sheet: Sheet | None,
) -> None:
    """Add a marker's edges to ``cover`` (height, width + 2).

    Parameters
    ----------
    cover
        The accumulator of the box whose top left pixel is (``left``, ``top``).
    edges
        The marker's edges.
    levels
        (3,) grey levels of outside, black and white; (4,) if a sheet occludes the marker.
    projection
        The marker's plane, and the camera.
    sigma
        Standard deviation in pixels of a Gaussian point spread; 0 for none, or None where ``sheet``
        is None.
    sheet
        How the sheet is bent or shifted; None if it is not, and the camera has no lens model.

    Numba leaves out what a caller that gives None does not need: most of the time for which the
    first run of an installation would compile.
    """
    if sheet is not None and sigma is not None and (
        projection.optics.distorted or sheet.curvature != 0.0 or sheet.waves.shape[1] > 0
    ):
        _accumulate_curved(cover, edges, levels, projection, left, top, sigma, sheet)
        return
    intrinsics = projection.optics.intrinsics
    shift_x, shift_y = intrinsics[2] + (0.5 - left), intrinsics[3] + (0.5 - top)
    ends, sides = edges.ends, edges.sides
    for e in range(ends.shape[0]):
        jump = levels[sides[e, 1]] - levels[sides[e, 0]]
        if jump == 0.0:
            continue
        x0, y0, z0 = polygon.homogeneous_pixel(projection, shift_x, shift_y, ends[e, 0], ends[e, 1])
        x1, y1, z1 = polygon.homogeneous_pixel(projection, shift_x, shift_y, ends[e, 2], ends[e, 3])
        segment = Segment(x0, y0, z0, x1, y1, z1)
        if sigma is None or not sigma > 0.0:
            _add_projected(cover, jump, segment)
        else:
            _add_blurred(cover, jump, sigma, segment)


@compiled
def sum_levels(cover: Floats, outside: float, levels: Floats) -> None:
    """Write the running sums of ``cover``, from the level ``outside``, to ``levels``.

    ``cover`` is all zero afterwards, ready for the next scene.
    """
    for i in range(levels.shape[0]):
        level = outside
        for j in range(levels.shape[1]):
            level += cover[i, j]
            cover[i, j] = 0.0
            levels[i, j] = level
        cover[i, levels.shape[1] :] = 0.0


# --------------------------------------------------------------------------------------------------
# The exact image's derivatives by the marker's pose, by the point spread and by the grey levels.
#
# If an edge moves, the level of a pixel changes by the edge's jump times the integral of the edge's
# normal velocity over its part in the pixel. Under a homography that velocity is linear along the
# edge's image, so that length times the value in the middle of each part is exact: twelve numbers
# an edge, the velocities of its two ends under six pose parameters.
#
# A pose moves by δ = (ω, τ): rotation to exp(ω) R, translation to t + τ, in the camera frame, in
# radians and metres: the same six numbers as ``rotation_error_rad`` and ``translation_error_m``.
#
# The box begins at pixel (0, 0): the principal point is given relative to the box.

#: Parameters of a pose; the point spread, if its derivative is requested, is one more.
POSE = 6

#: Unknown grey levels: outside, black, white.
LEVELS = 3


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
def _add_slopes(work: Work, count: int, jump: float, segment: MovingSegment) -> int:
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
def _add_spread_slopes(
    work: Work, count: int, jump: float, sigma: float, segment: MovingSegment
) -> int:
    """As :func:`_add_slopes` through a Gaussian point spread, with the slope by ``sigma``.

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
    moving = np.empty(POSE)
    for panel in range(panels):
        for node in range(3):
            weight = WEIGHTS[node] / panels
            t = (panel + NODES[node]) / panels
            at = (xa + t * dx, ya + t * dy)
            for k in range(POSE):
                moving[k] = at_a[k] + t * (at_b[k] - at_a[k])
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
                        slopes[slot, k] -= share * moving[k]
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
        (:func:`accumulate`), and the slopes.
    edges, projection, sigma
        As :func:`accumulate`.
    levels
        (3,) grey levels of outside, black and white that the slopes are for.
    translation
        (3,) position of the marker's centre, about which ω turns it.
    count
        Pixels that have slopes already, of sheets in other planes.
    """
    flat = polygon.flat_sheet()
    for area in range(2):
        # Black is 1 and all else 0, then white.
        area_levels = np.zeros(LEVELS)
        area_levels[1 + area] = 1.0
        accumulate(work.shares[area], edges, area_levels, projection, 0, 0, sigma, flat)
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
        edge, chords = ModuleEdge(a, b, c, d), 1
        if optics.distorted:
            u0, v0 = polygon.edge_pixel(0.0, edge, projection, flat)
            u1, v1 = polygon.edge_pixel(1.0, edge, projection, flat)
            chords = polygon.chord_count(edge, 0, 1, (u0, v0, u1, v1), projection, flat)
        for chord in range(chords):
            t0, t1 = chord / chords, (chord + 1.0) / chords
            if not optics.distorted:
                # Clip to the box and its margin before division, as the image is.
                x0, y0, z0 = polygon.homogeneous_pixel(projection, shift_x, shift_y, a, b)
                x1, y1, z1 = polygon.homogeneous_pixel(projection, shift_x, shift_y, c, d)
                t0, t1 = clip(x0, x1, t0, t1)
                t0, t1 = clip(y0, y1, t0, t1)
                t0, t1 = clip(far_x * z0 - x0, far_x * z1 - x1, t0, t1)
                t0, t1 = clip(far_y * z0 - y0, far_y * z1 - y1, t0, t1)
            else:
                u0, v0 = polygon.edge_pixel(t0, edge, projection, flat)
                u1, v1 = polygon.edge_pixel(t1, edge, projection, flat)
                if (
                    max(u0, u1) + 0.5 < -margin or min(u0, u1) + 0.5 > width + margin
                    or max(v0, v1) + 0.5 < -margin or min(v0, v1) + 0.5 > height + margin
                ):
                    continue
            if not t0 < t1:
                continue
            ca, cb, da, db = a + t0 * (c - a), a + t1 * (c - a), b + t0 * (d - b), b + t1 * (d - b)
            x, y, z = polygon.plane_point(plane, ca, da)
            xa, ya = velocity(x, y, z, translation, optics, rates[:2])
            x, y, z = polygon.plane_point(plane, cb, db)
            xb, yb = velocity(x, y, z, translation, optics, rates[2:])
            for k in range(POSE):
                at_a[k] = rates[0, k] * (yb - ya) - rates[1, k] * (xb - xa)
                at_b[k] = rates[2, k] * (yb - ya) - rates[3, k] * (xb - xa)
            segment = MovingSegment(xa, ya, xb, yb, at_a, at_b)
            if sigma > 0.0:
                count = _add_spread_slopes(work, count, jump, sigma, segment)
            else:
                count = _add_slopes(work, count, jump, segment)
    return count


@compiled_inline
def _add_run(
    matrix: Floats, vector: Floats, column: Floats, free: int, pixels: float, total: float
) -> None:
    """Add a number of pixels without slopes, the sum of whose levels is ``total``.

    To the lower triangle of ``matrix``; the columns before ``free`` are 0.
    """
    for k in range(free, len(column)):
        vector[k] += total * column[k]
        for m in range(free, k + 1):
            matrix[k, m] += pixels * column[k] * column[m]


@compiled
def normal_equations(image: Floats, work: Work, free: int, matrix: Floats, vector: Floats) -> None:
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
            if pixels > 0.0:
                # A run of pixels with the same areas ends.
                column[free], column[free + 1], column[free + 2] = 1.0 - black - white, black, white
                _add_run(matrix, vector, column, free, pixels, total)
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
            for k in range(size):  # not a function: its arguments cost as much as the sums
                vector[k] += level * column[k]
                for m in range(k + 1):
                    matrix[k, m] += column[k] * column[m]
        column[free], column[free + 1], column[free + 2] = 1.0 - black - white, black, white
        _add_run(matrix, vector, column, free, pixels, total)
        shares[0, i, width:] = 0.0
        shares[1, i, width:] = 0.0
    for k in range(size):
        for m in range(k):
            matrix[m, k] = matrix[k, m]


# --------------------------------------------------------------------------------------------------
# Exact images of many scenes on plain backgrounds, drawn in one call.

@compiled
def sum_grey(cover: Floats, outside: float, grey: NDArray[np.uint8]) -> None:
    """As ``coverage.sum_levels``, quantised to 8 bits (round half up) and clipped."""
    for i in range(grey.shape[0]):
        level = outside
        rounded = np.uint8(min(max(level + (0.5 + ROUNDING_SNAP), 0.0), 255.0))
        for j in range(grey.shape[1]):
            # Most pixels touch no edge: they repeat their neighbour at the cost of a comparison.
            if cover[i, j] != 0.0:
                level += cover[i, j]
                cover[i, j] = 0.0
                rounded = np.uint8(min(max(level + (0.5 + ROUNDING_SNAP), 0.0), 255.0))
            grey[i, j] = rounded
        cover[i, grey.shape[1] :] = 0.0


@compiled
def draw_greys(
    images: NDArray[np.uint8], starts: NDArray[np.int64], windows: NDArray[np.int64],
    boxes: NDArray[np.int64], scratch: Floats, rows: NDArray[np.int64], edges: MarkerEdges,
    spans: NDArray[np.int64], marker: NDArray[np.int64], levels: Floats, plane: Floats,
    intrinsics: Floats, lenses: Floats, distorted: NDArray[np.bool_] | None,
) -> None:
    """Draw n of N scenes into their windows, quantised to 8 bits.

    Parameters
    ----------
    images, starts
        The pixels of all windows in one vector, and (n,) index of each window's first one.
    windows, boxes
        (n, 4) left, top, right, bottom of the windows and of the pixels that the markers may
        touch.
    scratch
        A vector of zeros of at least (width + 2) · height of the largest box, left as zeros.
    rows
        (n,) the scenes.
    edges, spans
        The edges of all markers, and (K, 2) the first and past-the-end row of each marker's.
    marker
        (N,) index of each scene's marker.
    levels, plane, intrinsics, lenses, distorted
        (N, 3), (N, 3, 3), (N, 4), (N, 24), (N,), of each scene as :func:`accumulate` takes them;
        ``distorted`` is None if none is.
    """
    for i in range(rows.shape[0]):
        row, window, box = rows[i], windows[i], boxes[i]
        width, height = window[2] - window[0], window[3] - window[1]
        image = images[starts[i] : starts[i] + width * height]
        image[:] = np.uint8(levels[row, 0] + (0.5 + ROUNDING_SNAP))
        left, top, right, bottom = box[0], box[1], box[2], box[3]
        if left == right:
            continue
        cover = scratch[: (bottom - top) * (right - left + 2)].reshape(
            bottom - top, right - left + 2
        )
        first, last = spans[marker[row], 0], spans[marker[row], 1]
        own = MarkerEdges(edges.ends[first:last], edges.sides[first:last])
        if distorted is None:
            seen = Projection(plane[row], Optics(intrinsics[row], lenses[row], False))
            accumulate(cover, own, levels[row], seen, left, top, None, None)
        else:
            seen = Projection(plane[row], Optics(intrinsics[row], lenses[row], distorted[row]))
            accumulate(cover, own, levels[row], seen, left, top, 0.0, polygon.flat_sheet())
        grey = image.reshape(height, width)[
            top - window[1] : bottom - window[1], left - window[0] : right - window[0]
        ]
        sum_grey(cover, levels[row, 0], grey)


# --------------------------------------------------------------------------------------------------
# SplitMix64's mixing of bits, from which all random numbers are made.

@compiled
def mixed(bits: Any) -> Any:
    """Return 64-bit numbers, a scalar or an array, mixed so that each bit depends on all.

    SplitMix64's finaliser (Steele, Lea and Flood, "Fast splittable pseudorandom number
    generators", 2014).
    """
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))
