"""The exact grey level of every pixel: analytic area coverage of the projected edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model.polygon import (
    ModuleEdge,
    Optics,
    Projection,
    Sheet,
    chords_within_tolerance,
    clip,
    distance_from_chord,
    flat_sheet,
    homogeneous_pixel,
    piece_count,
    sheet_pixel,
)
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The Gaussian point spread: its integrals, and the quadrature along an edge seen through it.

REACH = 5.0
"""Standard deviations at which the point spread is cut off; 6e-7 of it lies beyond."""

MIN_PANEL_PX = 0.015
"""Shortest piece of an edge that is integrated on its own."""

NODES = (0.1127016653792583, 0.5, 0.8872983346207417)
WEIGHTS = (0.2777777777777778, 0.4444444444444444, 0.2777777777777778)
"""Three Gauss-Legendre nodes on [0, 1], and their weights."""

_STEPS = 256
_AT = np.arange(-6 * _STEPS, 6 * _STEPS + 2) / _STEPS
_BELOW = np.array([0.5 * math.erfc(-at / math.sqrt(2.0)) for at in _AT.tolist()])
_BELOW_SUM = _AT * _BELOW + np.exp(-0.5 * _AT**2) / math.sqrt(2.0 * math.pi)
"""The normal distribution's integral, and the integral of that, in steps of 1/256 standard
deviations: interpolated linearly they are accurate to 8e-7."""


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

ROUNDING_SNAP = 1e-9
"""Levels this close below a half round up, so that the last bits of a sum never decide."""


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
def _add_in_row(
    row: Floats, jump: float, xa: float, xb: float, dy: float
) -> None:
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
def _add_segment(
    cover: Floats, jump: float, x0: float, y0: float, x1: float, y1: float
) -> None:
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
def _clamped_pixel(
    t: float, width: float, height: float, segment: Segment
) -> tuple[float, float]:
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
        _, ya = _clamped_pixel(lower, width, height, segment)
        _, yb = _clamped_pixel(upper, width, height, segment)
        _add_segment(cover, jump, 0.0, ya, 0.0, yb)
        return
    if inner_lower > lower:
        _, ya = _clamped_pixel(lower, width, height, segment)
        _, yb = _clamped_pixel(inner_lower, width, height, segment)
        _add_segment(cover, jump, 0.0, ya, 0.0, yb)
    if inner_upper < upper:
        _, ya = _clamped_pixel(inner_upper, width, height, segment)
        _, yb = _clamped_pixel(upper, width, height, segment)
        _add_segment(cover, jump, 0.0, ya, 0.0, yb)
    lower, upper = clip(width * z0 - x0, width * z1 - x1, inner_lower, inner_upper)
    if lower >= upper:
        return
    xa, ya = _clamped_pixel(lower, width, height, segment)
    xb, yb = _clamped_pixel(upper, width, height, segment)
    _add_segment(cover, jump, xa, ya, xb, yb)


@compiled
def _add_left(
    cover: Floats, jump: float, ya: float, yb: float, sigma: float
) -> None:
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
def accumulate_curved(
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
        columns, rows = edge.to_column - edge.column, edge.to_row - edge.row
        pieces = piece_count(edge, projection, sheet)
        x, y = sheet_pixel(edge.column, edge.row, projection, sheet)
        for piece in range(pieces):
            distance = 0.0
            t = (piece + 1.0) / pieces
            u1, v1 = sheet_pixel(
                edge.column + t * columns, edge.row + t * rows, projection, sheet
            )
            for quarter in range(1, 4):
                t = (piece + 0.25 * quarter) / pieces
                u, v = sheet_pixel(
                    edge.column + t * columns, edge.row + t * rows, projection, sheet
                )
                distance = max(distance, distance_from_chord(u, v, x, y, u1, v1))
            chords = chords_within_tolerance(distance)
            for chord in range(1, chords + 1):
                u, v = u1, v1
                if chord < chords:
                    t = (piece + chord / chords) / pieces
                    u, v = sheet_pixel(
                        edge.column + t * columns, edge.row + t * rows, projection, sheet
                    )
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
    sigma: float,
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
        Standard deviation in pixels of a Gaussian point spread; 0 for none.
    """
    if projection.optics.distorted:
        accumulate_curved(cover, edges, levels, projection, left, top, sigma, flat_sheet())
        return
    intrinsics = projection.optics.intrinsics
    shift_x, shift_y = intrinsics[2] + (0.5 - left), intrinsics[3] + (0.5 - top)
    ends, sides = edges.ends, edges.sides
    for e in range(ends.shape[0]):
        jump = levels[sides[e, 1]] - levels[sides[e, 0]]
        if jump == 0.0:
            continue
        x0, y0, z0 = homogeneous_pixel(projection, shift_x, shift_y, ends[e, 0], ends[e, 1])
        x1, y1, z1 = homogeneous_pixel(projection, shift_x, shift_y, ends[e, 2], ends[e, 3])
        segment = Segment(x0, y0, z0, x1, y1, z1)
        if sigma > 0.0:
            _add_blurred(cover, jump, sigma, segment)
        else:
            _add_projected(cover, jump, segment)


@compiled
def sum_levels(
    cover: Floats, outside: float, levels: Floats
) -> None:
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


class Canvas(NamedTuple):
    """The windows of n scenes, which are drawn one after another.

    Attributes
    ----------
    images
        The pixels of all windows in one vector.
    starts
        (n,) index of each window's first pixel in ``images``.
    windows, boxes
        (n, 4) left, top, right, bottom of the windows and of the pixels that the markers may
        touch.
    scratch
        A vector of zeros of at least (width + 2) · height of the largest box, left as zeros.
    """

    images: NDArray[np.uint8]
    starts: NDArray[np.int64]
    windows: NDArray[np.int64]
    boxes: NDArray[np.int64]
    scratch: Floats


class DrawnScenes(NamedTuple):
    """All scenes of a block as far as :func:`draw_greys` needs them.

    Attributes
    ----------
    edges, spans
        The edges of all markers, and (K, 2) the first and past-the-end row of each marker's.
    marker
        (N,) index of each scene's marker.
    levels, plane, intrinsics, lenses, distorted
        (N, 3), (N, 3, 3), (N, 4), (N, 24), (N,), of each scene as
        :func:`sweep.model.coverage.accumulate` takes them.
    """

    edges: MarkerEdges
    spans: NDArray[np.int64]
    marker: NDArray[np.int64]
    levels: Floats
    plane: Floats
    intrinsics: Floats
    lenses: Floats
    distorted: NDArray[np.bool_]


@compiled
def draw_greys(canvas: Canvas, scenes: DrawnScenes, rows: NDArray[np.int64]) -> None:
    """Draw scenes ``rows`` (n,) into their windows of ``canvas``, quantised to 8 bits."""
    for i in range(rows.shape[0]):
        row = rows[i]
        window, box = canvas.windows[i], canvas.boxes[i]
        width, height = window[2] - window[0], window[3] - window[1]
        image = canvas.images[canvas.starts[i] : canvas.starts[i] + width * height]
        image[:] = np.uint8(scenes.levels[row, 0] + (0.5 + ROUNDING_SNAP))
        left, top, right, bottom = box[0], box[1], box[2], box[3]
        if left == right:
            continue
        cover = canvas.scratch[: (bottom - top) * (right - left + 2)].reshape(
            bottom - top, right - left + 2
        )
        first, last = scenes.spans[scenes.marker[row], 0], scenes.spans[scenes.marker[row], 1]
        accumulate(
            cover, MarkerEdges(scenes.edges.ends[first:last], scenes.edges.sides[first:last]),
            scenes.levels[row],
            Projection(
                scenes.plane[row],
                Optics(scenes.intrinsics[row], scenes.lenses[row], scenes.distorted[row]),
            ),
            left, top, 0.0,
        )
        grey = image.reshape(height, width)[
            top - window[1] : bottom - window[1], left - window[0] : right - window[0]
        ]
        sum_grey(cover, scenes.levels[row, 0], grey)


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
