"""The exact grey level of every pixel: analytic area coverage of the marker's projected edges.

The method of font rasterisers (Levien, "Inside the fastest font renderer in the world", 2016):
each edge adds its signed area and cover to the pixels of its rows, and a running sum along each
row turns them into covered area. An edge here carries the grey level's jump across it, so one
pass gives the levels themselves. Errors are those of double precision.

Pixel i covers [i - 0.5, i + 0.5]; inside, coordinates are shifted by 0.5 so that it covers
[i, i + 1].
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model.lens import distort

CHORD_TOLERANCE_PX = 1e-4
"""How far a chord of a bent edge may lie from the edge; 0.03 grey levels at the very most."""

ROUNDING_SNAP = 1e-9
"""Levels this close below a half round up, so that the last bits of a sum never decide."""


@compiled
def _add_in_row(
    row: NDArray[np.float64], jump: float, xa: float, xb: float, dy: float
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
    cover: NDArray[np.float64], jump: float, x0: float, y0: float, x1: float, y1: float
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
def clip(a: float, b: float, lower: float, upper: float) -> tuple[float, float]:
    """Narrow the interval [lower, upper] of t to where a + t (b - a) >= 0; empty: lower > upper."""
    if a >= 0.0 and b >= 0.0:
        return lower, upper
    if a < 0.0 and b < 0.0:
        return 1.0, 0.0
    t = a / (a - b)
    if a < 0.0:
        return max(lower, t), upper
    return lower, min(upper, t)


@compiled
def _at(
    t: float, width: float, height: float,
    x0: float, y0: float, z0: float, x1: float, y1: float, z1: float,
) -> tuple[float, float]:
    """Return the pixel at parameter t of a segment in space, clamped into the box."""
    if t <= 0.0:
        x, y, z = x0, y0, z0
    elif t >= 1.0:
        x, y, z = x1, y1, z1
    else:
        x, y, z = x0 + t * (x1 - x0), y0 + t * (y1 - y0), z0 + t * (z1 - z0)
    return min(max(x / z, 0.0), width), min(max(y / z, 0.0), height)


@compiled
def _add_projected(
    cover: NDArray[np.float64], jump: float,
    x0: float, y0: float, z0: float, x1: float, y1: float, z1: float,
) -> None:
    """Add the image (x/z, y/z) of a segment in space (z > 0), clipped to the box before division.

    What lies above, below or right of the box adds nothing; what lies left of it covers whole
    rows, as the same segment moved onto the box's left side does. Clipping in homogeneous
    coordinates keeps points exact whose images lie far outside.
    """
    height, width = cover.shape[0] * 1.0, (cover.shape[1] - 2) * 1.0
    lower, upper = clip(y0, y1, 0.0, 1.0)
    lower, upper = clip(height * z0 - y0, height * z1 - y1, lower, upper)
    if lower >= upper:
        return
    # Left of the box: on [lower, upper] minus where x >= 0.
    inner_lower, inner_upper = clip(x0, x1, lower, upper)
    if inner_lower >= inner_upper:
        _, ya = _at(lower, width, height, x0, y0, z0, x1, y1, z1)
        _, yb = _at(upper, width, height, x0, y0, z0, x1, y1, z1)
        _add_segment(cover, jump, 0.0, ya, 0.0, yb)
        return
    if inner_lower > lower:
        _, ya = _at(lower, width, height, x0, y0, z0, x1, y1, z1)
        _, yb = _at(inner_lower, width, height, x0, y0, z0, x1, y1, z1)
        _add_segment(cover, jump, 0.0, ya, 0.0, yb)
    if inner_upper < upper:
        _, ya = _at(inner_upper, width, height, x0, y0, z0, x1, y1, z1)
        _, yb = _at(upper, width, height, x0, y0, z0, x1, y1, z1)
        _add_segment(cover, jump, 0.0, ya, 0.0, yb)
    lower, upper = clip(width * z0 - x0, width * z1 - x1, inner_lower, inner_upper)
    if lower >= upper:
        return
    xa, ya = _at(lower, width, height, x0, y0, z0, x1, y1, z1)
    xb, yb = _at(upper, width, height, x0, y0, z0, x1, y1, z1)
    _add_segment(cover, jump, xa, ya, xb, yb)


REACH = 5.0
"""Standard deviations at which the point spread ends; 6e-7 of it lies beyond."""

MIN_PANEL_PX = 0.015

NODES = (0.1127016653792583, 0.5, 0.8872983346207417)
WEIGHTS = (0.2777777777777778, 0.4444444444444444, 0.2777777777777778)
"""Three Gauss-Legendre nodes on [0, 1], and their weights."""


_STEPS = 256
_AT = np.arange(-6 * _STEPS, 6 * _STEPS + 2) / _STEPS
_BELOW = np.array([0.5 * math.erfc(-at / math.sqrt(2.0)) for at in _AT.tolist()])
_BELOW_SUM = _AT * _BELOW + np.exp(-0.5 * _AT**2) / math.sqrt(2.0 * math.pi)
"""The normal distribution's integral, and the integral of that, in steps of 1/256 standard
deviations: interpolated linearly they are right to 8e-7."""


@compiled
def _interpolated(table: NDArray[np.float64], at: float) -> float:
    """Return a table's value between its steps."""
    k = int(at)
    return float(table[k] + (at - k) * (table[k + 1] - table[k]))


@compiled
def spread_below(t: float, sigma: float) -> float:
    """Return the share of the point spread, a Gaussian, that lies below t."""
    at = (t / sigma + 6.0) * _STEPS
    if at <= 0.0:
        return 0.0
    if at >= 12.0 * _STEPS:
        return 1.0
    return _interpolated(_BELOW, at)


@compiled
def _below_sum(t: float, sigma: float) -> float:
    """Return the integral of :func:`spread_below` up to t."""
    at = (t / sigma + 6.0) * _STEPS
    if at <= 0.0:
        return 0.0
    if at >= 12.0 * _STEPS:
        return t
    return sigma * _interpolated(_BELOW_SUM, at)


@compiled
def _add_left(
    cover: NDArray[np.float64], jump: float, ya: float, yb: float, sigma: float
) -> None:
    """Add a segment from y = ya to yb so far left of the box that it covers rows whole."""
    reach = REACH * sigma + 1.0
    first = max(math.floor(min(ya, yb) - reach), 0)
    last = min(math.floor(max(ya, yb) + reach), cover.shape[0] - 1)
    for i in range(first, last + 1):
        low, high = ya - i, yb - i
        share = _below_sum(high, sigma) - _below_sum(high - 1.0, sigma)
        share -= _below_sum(low, sigma) - _below_sum(low - 1.0, sigma)
        cover[i, 0] += jump * share


@compiled
def _add_blurred(
    cover: NDArray[np.float64], jump: float, sigma: float,
    x0: float, y0: float, z0: float, x1: float, y1: float, z1: float,
) -> None:
    """As :func:`_add_projected`, seen through a Gaussian point spread of ``sigma`` px.

    By Green's theorem a segment adds to each pixel the integral over its dy of p(y)·P(x): p is
    the point spread seen by a pixel (box and Gaussian convolved), P the integral of p along x.
    Both are smooth on the scale of sigma, so three Gauss-Legendre nodes on pieces of 1.5 sigma
    leave less than 1e-4 of the jump.
    """
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
    cover: NDArray[np.float64], jump: float, sigma: float,
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
            below = _below_sum(first - x, sigma)
            before = 0.0
            for j in range(first, last + 1):
                above = _below_sum(j + 1.0 - x, sigma)
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
def imaged(
    plane: NDArray[np.float64], view: NDArray[np.float64], shift_x: float, shift_y: float,
    column: float, line: float,
) -> tuple[float, float, float]:
    """Return the image of a point of the module plane in homogeneous pixels.

    The principal point is at (``shift_x``, ``shift_y``).
    """
    z = plane[2, 0] * column + plane[2, 1] * line + plane[2, 2]
    x = view[0] * (plane[0, 0] * column + plane[0, 1] * line + plane[0, 2]) + shift_x * z
    y = view[1] * (plane[1, 0] * column + plane[1, 1] * line + plane[1, 2]) + shift_y * z
    return x, y, z


@compiled
def bent(
    t: float, plane: NDArray[np.float64], lens: NDArray[np.float64], view: NDArray[np.float64],
    a: float, b: float, c: float, d: float,
) -> tuple[float, float]:
    """Return the pixel of the point at parameter t of the module-plane segment (a, b)-(c, d)."""
    column, line = a + t * (c - a), b + t * (d - b)
    z = plane[2, 0] * column + plane[2, 1] * line + plane[2, 2]
    x, y = distort(
        (plane[0, 0] * column + plane[0, 1] * line + plane[0, 2]) / z,
        (plane[1, 0] * column + plane[1, 1] * line + plane[1, 2]) / z,
        lens,
    )
    return view[0] * x + view[2], view[1] * y + view[3]


@compiled
def _off_chord(px: float, py: float, x0: float, y0: float, x1: float, y1: float) -> float:
    """Return the distance of a point from the straight line through two others."""
    length = math.hypot(x1 - x0, y1 - y0)
    if length == 0.0:
        return math.hypot(px - x0, py - y0)
    return abs((px - x0) * (y1 - y0) - (py - y0) * (x1 - x0)) / length


@compiled
def chord_count(
    plane: NDArray[np.float64], lens: NDArray[np.float64], view: NDArray[np.float64],
    a: float, b: float, c: float, d: float,
) -> int:
    """Return how many equal chords stand for the image of the segment (a, b)-(c, d) of the plane.

    A chord's distance from a smooth curve falls with the square of their number.
    """
    u0, v0 = bent(0.0, plane, lens, view, a, b, c, d)
    u1, v1 = bent(1.0, plane, lens, view, a, b, c, d)
    off = 0.0
    for quarter in range(1, 4):
        u, v = bent(0.25 * quarter, plane, lens, view, a, b, c, d)
        off = max(off, _off_chord(u, v, u0, v0, u1, v1))
    return min(max(math.ceil(math.sqrt(off / CHORD_TOLERANCE_PX)), 1), 4096)


@compiled
def accumulate(
    cover: NDArray[np.float64],
    ends: NDArray[np.float64],
    sides: NDArray[np.int64],
    levels: NDArray[np.float64],
    plane: NDArray[np.float64],
    view: NDArray[np.float64],
    lens: NDArray[np.float64],
    distorted: bool,
    left: int,
    top: int,
    sigma: float,
) -> None:
    """Add a marker's edges to ``cover`` (height, width + 2).

    Parameters
    ----------
    cover
        The accumulator of the box whose top left pixel is (``left``, ``top``).
    ends, sides
        The marker's edges (E, 4), (E, 2): :class:`sweep.model.marker.Edges`.
    levels
        (3,) grey levels of outside, black and white.
    plane
        (3, 3) takes module coordinates to the camera frame: (x, y, z) = plane · (column, row, 1).
    view
        (4,) fx, fy, cx, cy in pixels.
    lens
        (24,) packed lens; read only where ``distorted``.
    sigma
        Standard deviation in pixels of a Gaussian point spread; 0 for none.
    """
    shift_x, shift_y = view[2] + (0.5 - left), view[3] + (0.5 - top)
    for e in range(ends.shape[0]):
        jump = levels[sides[e, 1]] - levels[sides[e, 0]]
        if jump == 0.0:
            continue
        a, b, c, d = ends[e, 0], ends[e, 1], ends[e, 2], ends[e, 3]
        if not distorted:
            x0, y0, z0 = imaged(plane, view, shift_x, shift_y, a, b)
            x1, y1, z1 = imaged(plane, view, shift_x, shift_y, c, d)
            if sigma > 0.0:
                _add_blurred(cover, jump, sigma, x0, y0, z0, x1, y1, z1)
            else:
                _add_projected(cover, jump, x0, y0, z0, x1, y1, z1)
            continue
        u0, v0 = bent(0.0, plane, lens, view, a, b, c, d)
        u1, v1 = bent(1.0, plane, lens, view, a, b, c, d)
        chords = chord_count(plane, lens, view, a, b, c, d)
        x, y = u0 + (0.5 - left), v0 + (0.5 - top)
        for chord in range(1, chords + 1):
            u, v = u1, v1
            if chord < chords:
                u, v = bent(chord / chords, plane, lens, view, a, b, c, d)
            u, v = u + (0.5 - left), v + (0.5 - top)
            if sigma > 0.0:
                _add_blurred(cover, jump, sigma, x, y, 1.0, u, v, 1.0)
            else:
                _add_projected(cover, jump, x, y, 1.0, u, v, 1.0)
            x, y = u, v


@compiled
def sum_levels(
    cover: NDArray[np.float64], outside: float, levels: NDArray[np.float64]
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


@compiled
def sum_grey(cover: NDArray[np.float64], outside: float, grey: NDArray[np.uint8]) -> None:
    """As :func:`sum_levels`, quantised to 8 bits (round half up) and clipped."""
    for i in range(grey.shape[0]):
        level = outside
        rounded = np.uint8(min(max(level + (0.5 + ROUNDING_SNAP), 0.0), 255.0))
        for j in range(grey.shape[1]):
            # Most pixels meet no edge: they repeat their neighbour at the cost of a comparison.
            if cover[i, j] != 0.0:
                level += cover[i, j]
                cover[i, j] = 0.0
                rounded = np.uint8(min(max(level + (0.5 + ROUNDING_SNAP), 0.0), 255.0))
            grey[i, j] = rounded
        cover[i, grey.shape[1] :] = 0.0


@compiled
def draw_greys(
    images: NDArray[np.uint8],
    starts: NDArray[np.int64],
    windows: NDArray[np.int64],
    boxes: NDArray[np.int64],
    scratch: NDArray[np.float64],
    ends: NDArray[np.float64],
    sides: NDArray[np.int64],
    spans: NDArray[np.int64],
    marker: NDArray[np.int64],
    levels: NDArray[np.float64],
    plane: NDArray[np.float64],
    view: NDArray[np.float64],
    lenses: NDArray[np.float64],
    distorted: NDArray[np.bool_],
    rows: NDArray[np.int64],
) -> None:
    """Draw scenes ``rows`` (n,) into their windows, one after another in the vector ``images``.

    Parameters
    ----------
    images, starts
        The pixels of all windows, and (n,) where each window's begin.
    windows, boxes
        (n, 4) left, top, right, bottom of the windows and of what the markers may touch.
    scratch
        A vector of zeros of at least (width + 2) · height of the largest box, left so.
    ends, sides, spans, marker
        The edges of all markers, (K, 2) where each marker's begin and end, and (N,) which
        marker a scene has.
    levels, plane, view, lenses, distorted
        Of all scenes: (N, 3), (N, 3, 3), (N, 4), (N, 24), (N,); as :func:`accumulate`.
    """
    for i in range(rows.shape[0]):
        row = rows[i]
        width, height = windows[i, 2] - windows[i, 0], windows[i, 3] - windows[i, 1]
        image = images[starts[i] : starts[i] + width * height]
        image[:] = np.uint8(levels[row, 0] + (0.5 + ROUNDING_SNAP))
        left, top, right, bottom = boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3]
        if left == right:
            continue
        cover = scratch[: (bottom - top) * (right - left + 2)].reshape(
            bottom - top, right - left + 2
        )
        first, last = spans[marker[row], 0], spans[marker[row], 1]
        accumulate(
            cover, ends[first:last], sides[first:last], levels[row], plane[row], view[row],
            lenses[row], distorted[row], left, top, 0.0,
        )
        grey = image.reshape(height, width)[
            top - windows[i, 1] : bottom - windows[i, 1],
            left - windows[i, 0] : right - windows[i, 0],
        ]
        sum_grey(cover, levels[row, 0], grey)
