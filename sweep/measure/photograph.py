"""A photograph of a printed plane: its model, its fitted box, and its residuals."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from sweep.compilation import compiled, compiled_inline, compiled_packed
from sweep.measure import likelihood
from sweep.measure.estimation import solve_positive
from sweep.measure.likelihood import BLACK, DEPTH, OUTSIDE, OUTSIDE_SHARE, SPREAD, TONE, WHITE
from sweep.measure.surroundings import BoardMarker, ring_modules, surroundings
from sweep.model import polygon
from sweep.model.board import Board
from sweep.model.coverage import POSE, MarkerEdges
from sweep.model.lens import jacobian, undistort
from sweep.model.marker import module_count
from sweep.model.polygon import ModuleEdge, Optics, Projection
from sweep.typing import Floats, Grey, Integers

# --------------------------------------------------------------------------------------------------
# A printed plane's blurred image and its slopes, as a photograph is fitted by them.
#
# The level of a pixel is that of area coverage through a Gaussian point spread, as in
# :mod:`sweep.model.coverage`. Its slopes along x and along y, and by the point spread's variance,
# are integrals along the same edges. All edges lie in one plane, so that the image's slope by a
# parameter of the pose is the slope along x and y times the velocity of the plane's point at the
# pixel: three numbers a pixel in place of seven, where :mod:`sweep.model.coverage` is exact.
# The point spread mixes velocities of neighbouring points, which are the same up to its width
# over the marker's side; that changes the direction of a step, not the pose at which the fit
# ends.

#: Standard deviations at which the point spread is cut off; 5e-4 of it lies beyond.
REACH = 3.5

#: Most Gauss-Legendre nodes of one panel of an edge, and most panels.
MOST_NODES, MAX_PANELS = 24, 4096

#: (n, 2, k) nodes on [-1, 1] of the quadrature with n nodes, and their weights.
_GAUSS = np.zeros((MOST_NODES + 1, 2, MOST_NODES))
for _n in range(1, MOST_NODES + 1):
    _GAUSS[_n, :, :_n] = np.polynomial.legendre.leggauss(_n)

#: How far a curve through three points of an edge may be, at a quarter, from what a lens makes of
#: it; else the edge is drawn in pieces.
MOST_OFF_PX = 0.005

#: Nodes of a panel, and of each standard deviation of the point spread along it: 3e-4 of the jump.
END_NODES, NODES_A_DEVIATION = 2.0, 0.85

#: Places in a pixel, for each standard deviation, between which an edge's share is interpolated.
PHASES = 32.0

_STEPS = 64
_AT = np.arange(-6 * _STEPS, 6 * _STEPS + 2) / _STEPS
_DENSITY = np.exp(-0.5 * _AT**2) / math.sqrt(2.0 * math.pi)
_BELOW = np.array([0.5 * math.erfc(-at / math.sqrt(2.0)) for at in _AT.tolist()])
#: The normal distribution, its integral, and the integral of that, in steps of 1/64 standard
#: deviations.
_BELOW_SUM = _AT * _BELOW + _DENSITY


@compiled_inline
def _normal(distance: float, sigma: float) -> tuple[float, float, float]:
    """Return the normal distribution's integral, the integral of that in px, and its density."""
    at = min(max((distance / sigma + 6.0) * _STEPS, 0.0), 12.0 * _STEPS)
    k = int(at)
    part = at - k
    return (
        _BELOW[k] + part * (_BELOW[k + 1] - _BELOW[k]),
        max(sigma * (_BELOW_SUM[k] + part * (_BELOW_SUM[k + 1] - _BELOW_SUM[k])), distance),
        _DENSITY[k] + part * (_DENSITY[k + 1] - _DENSITY[k]),
    )


class System(NamedTuple):
    """Scratch space of a box; ``rates`` and ``outside`` are 0 between calls.

    Attributes
    ----------
    rates
        (height, 4 · (width + 1)): of each pixel the image's step from the pixel before, its
        slopes by x and by y, and that by the point spread's variance.
    outside
        (height, width + 1) steps of the area outside.
    images
        (6, height, width): the level's slopes by contrast, tone, x, y, the point spread's variance
        and the area outside, all as shares of the contrast.
    drawn
        (18,) the state that was drawn last.
    """

    rates: Floats
    outside: Floats
    images: Floats
    drawn: Floats


@compiled
def system(height: int, width: int) -> System:
    """Return the scratch space for a box."""
    return System(
        np.zeros((height, 4 * (width + 1))), np.zeros((height, width + 1)),
        np.empty((6, height, width)), np.zeros(likelihood.STATE_LENGTH),
    )


@compiled
def _taps(sigma: float) -> Floats:
    """Return what an edge's point does to the pixels around it, by its place in a pixel.

    (places, 4 · taps): of each pixel from the first in reach on the step of the share of what is
    beyond the point, its slope twice, and the slope's slope over twice the standard deviation.
    """
    reach = REACH * sigma
    most, places = int(2.0 * reach) + 3, math.ceil(PHASES / sigma)
    taps = np.empty((places + 1, 4 * most))
    for place in range(places + 1):
        row, at = taps[place], -reach - place / places
        low, low_sum, low_density = _normal(at, sigma)
        before = 0.0
        for m in range(most):
            at += 1.0
            high, high_sum, high_density = _normal(at, sigma)
            share = high_sum - low_sum
            row[4 * m] = share - before
            row[4 * m + 1] = row[4 * m + 2] = high - low
            row[4 * m + 3] = 0.5 * (high_density - low_density) / sigma
            before, low, low_sum, low_density = share, high, high_sum, high_density
    return taps


@compiled
def _add_edge(
    out: System, taps: Floats, jump: float, outside: float, sigma: float,
    ends: tuple[float, float, float, float, float, float],
) -> None:
    """Add a smooth curve, ``ends`` its first, middle and last point: x and y in px of the box.

    ``jump`` is the image's step across it, ``outside`` that of the area outside.
    """
    rates, outsides = out.rates, out.outside
    height, width = outsides.shape[0], outsides.shape[1] - 1
    xa, ya, xm, ym, xb, yb = ends
    reach, most, places = REACH * sigma, taps.shape[1] // 4, len(taps) - 1
    if min(xa, xb) > width + reach or min(ya, yb) > height + reach or max(ya, yb) < -reach:
        return
    needed = NODES_A_DEVIATION * math.hypot(xb - xa, yb - ya) / max(sigma, MIN_SPREAD_PX)
    panels = min(max(math.ceil(needed / (MOST_NODES - END_NODES)), 1), MAX_PANELS)
    count = min(math.ceil(needed / panels + END_NODES), MOST_NODES)
    # The curve through the three points: x = xa + t (slope_x + t bend_x).
    bend_x, bend_y = 2.0 * (xa + xb - 2.0 * xm), 2.0 * (ya + yb - 2.0 * ym)
    slope_x, slope_y = xb - xa - bend_x, yb - ya - bend_y
    basis, along_y = np.empty(4 * most), np.zeros(4 * most)
    for k in range(panels * count):
        panel, node = k // count, k % count
        t = (panel + 0.5 + 0.5 * _GAUSS[count, 0, node]) / panels
        weight = 0.5 * _GAUSS[count, 1, node] / panels
        left = xa + t * (slope_x + t * bend_x) - reach
        upper = ya + t * (slope_y + t * bend_y) - reach
        first, top = math.floor(left), math.floor(upper)
        begin, end = max(first, 0), min(math.ceil(left + 2.0 * reach) + 1, width)
        start, stop = max(top, 0), min(math.ceil(upper + 2.0 * reach), height)
        if first >= width or start >= stop:
            continue
        weight_x = weight * (slope_y + 2.0 * t * bend_y)
        weight_y = -weight * (slope_x + 2.0 * t * bend_x)
        place = int((left - first) * places)
        part, low, high = (left - first) * places - place, taps[place], taps[place + 1]
        # Columns left of the box are one step at its first column.
        passed = 0.0
        for m in range(min(begin - first, most)):
            passed += low[4 * m] + part * (high[4 * m] - low[4 * m])
        passed *= weight_x
        count_x = 4 * max(end - begin, 0)
        for m in range(0, count_x, 4):
            tap = m + 4 * (begin - first)
            near = low[tap + 1] + part * (high[tap + 1] - low[tap + 1])
            basis[m] = weight_x * (low[tap] + part * (high[tap] - low[tap]))
            basis[m + 1] = weight_x * near
            basis[m + 2] = along_y[m + 3] = weight_y * near
            basis[m + 3] = weight_x * (low[tap + 3] + part * (high[tap + 3] - low[tap + 3]))
        place = int((upper - top) * places)
        part, low, high = (upper - top) * places - place, taps[place], taps[place + 1]
        for i in range(start, stop):
            tap = 4 * (i - top)
            share = low[tap + 1] + part * (high[tap + 1] - low[tap + 1])
            change = low[tap + 3] + part * (high[tap + 3] - low[tap + 3])
            row, of_jump, by_y = rates[i], jump * share, jump * change
            for m in range(count_x):
                row[4 * begin + m] += of_jump * basis[m] + by_y * along_y[m]
            row[0] += of_jump * passed
            if outside != 0.0:
                outsides[i, 0] += outside * share * passed
                for m in range(0, count_x, 4):
                    outsides[i, begin + m // 4] += outside * share * basis[m]


@compiled
def add_plane(
    out: System, edges: MarkerEdges, values: Floats, projection: Projection, sigma: float
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
    """
    ends, sides, flat, taps = edges.ends, edges.sides, polygon.flat_sheet(), _taps(sigma)
    for e in range(ends.shape[0]):
        jump = values[sides[e, 1]] - values[sides[e, 0]]
        outside = 1.0 * (sides[e, 1] == 0) - 1.0 * (sides[e, 0] == 0)
        if jump == 0.0 and outside == 0.0:
            continue
        edge = ModuleEdge(ends[e, 0], ends[e, 1], ends[e, 2], ends[e, 3])
        x, y = polygon.edge_pixel(0.0, edge, projection, flat)
        u, v = polygon.edge_pixel(1.0, edge, projection, flat)
        xm, ym = polygon.edge_pixel(0.5, edge, projection, flat)
        # How far the curve is off across the edge, at a quarter: a cubic is hardly farther off.
        xq, yq = polygon.edge_pixel(0.25, edge, projection, flat)
        xq, yq = xq - 0.375 * x - 0.75 * xm + 0.125 * u, yq - 0.375 * y - 0.75 * ym + 0.125 * v
        off = abs(xq * (v - y) - yq * (u - x)) / max(math.hypot(u - x, v - y), 1e-9)
        pieces = min(1 + int((off / MOST_OFF_PX) ** (1.0 / 3.0)), MAX_PANELS)
        for piece in range(pieces):
            if pieces > 1:
                xm, ym = polygon.edge_pixel((piece + 0.5) / pieces, edge, projection, flat)
                u, v = polygon.edge_pixel((piece + 1.0) / pieces, edge, projection, flat)
            _add_edge(out, taps, jump, outside, sigma, (
                x + 0.5, y + 0.5, xm + 0.5, ym + 0.5, u + 0.5, v + 0.5))
            x, y = u, v


# --------------------------------------------------------------------------------------------------
# The model of a photograph of a printed plane: its image, and what cameras do to levels.
#
# The level of a pixel is modelled as
#
#     y = b + c (m + e m (1 - m)) + d p,
#
# m is the share of white through a Gaussian point spread, of which the area outside the modelled
# paper is a part, p the share of that area; b, c, d are levels, e is the tone curve. With c e as a
# parameter in the place of e, all but the pose and the point spread is linear. The state of a fit
# is that of :mod:`sweep.measure.likelihood`.

#: Parameters that are moved, the pose's and the point spread's variance, and the linear ones.
MOVED, LINEAR = POSE + 1, 4

#: All parameters.
SIZE = MOVED + LINEAR

#: Largest tone, as a share of the contrast, for which slopes are computed.
MAX_TONE = 5.0

#: Largest level outside, from black, as a share of the contrast.
MAX_OUTSIDE = 2.0

#: Pixels of the area outside, by squares of its shares, below which its level stays as it is.
MIN_OUTSIDE_PX = 1.0

#: Smallest point spread that is estimated.
MIN_SPREAD_PX = 0.2

#: Pixels between those at which the lens is inverted; between them it is interpolated.
LENS_STEP_PX = 8


class PhotographView(NamedTuple):
    """A box of a photograph with what is known of it.

    Attributes
    ----------
    marker
        The plane's edges, the extent that they describe, and the camera; the principal point is
        relative to the box.
    levels
        (height, width) grey levels.
    spans
        (height, 2) the first fitted pixel of each row, and the one after the last.
    rays
        (6, height, width) undistorted direction x/z, y/z of each pixel, and the derivatives of
        its u and v by them, row by row, in px.
    at
        (2, height, width) x and y relative to the marker's centre, in halves of its extent.
    toned
        Whether the tone curve is estimated.
    """

    marker: likelihood.MarkerView
    levels: Floats
    spans: Integers
    rays: Floats
    at: Floats
    toned: bool


@compiled
def pixel_count(view: PhotographView) -> int:
    """Return how many pixels are fitted."""
    return int((view.spans[:, 1] - view.spans[:, 0]).sum())


@compiled
def rays_of(optics: Optics, height: int, width: int) -> Floats:
    """Return the rays (6, height, width) of a box, as :class:`PhotographView` has them."""
    rays = np.empty((6, height, width))
    fx, fy, cx, cy = optics.intrinsics
    rows = (height - 1) // LENS_STEP_PX + 2
    columns = (width - 1) // LENS_STEP_PX + 2
    lattice = np.empty((6, rows, columns))
    for i in range(rows):
        for j in range(columns):
            x, y, _ = undistort(
                (j * LENS_STEP_PX - cx) / fx, (i * LENS_STEP_PX - cy) / fy, optics.lens
            )
            a, b, c, d = jacobian(x, y, optics.lens)
            lattice[0, i, j], lattice[1, i, j] = x, y
            lattice[2, i, j], lattice[3, i, j] = fx * a, fx * b
            lattice[4, i, j], lattice[5, i, j] = fy * c, fy * d
    blended = np.empty(columns)
    for k in range(6):
        for i in range(height):
            row, down = i // LENS_STEP_PX, (i % LENS_STEP_PX) / LENS_STEP_PX
            for j in range(columns):
                blended[j] = lattice[k, row, j] * (1.0 - down) + lattice[k, row + 1, j] * down
            for j in range(width):
                column, right = j // LENS_STEP_PX, (j % LENS_STEP_PX) / LENS_STEP_PX
                rays[k, i, j] = blended[column] * (1.0 - right) + blended[column + 1] * right
    return rays


@compiled
def draw(view: PhotographView, state: Floats, work: System) -> None:
    """Write the images of a state to ``work.images``."""
    rates, outsides, images, _ = work
    height, width = view.levels.shape
    likelihood.overwrite(work.drawn, state)
    add_plane(
        work, view.marker.edges, np.array([state[OUTSIDE_SHARE], 0.0, 1.0]),
        Projection(likelihood.plane_of(state, view.marker), view.marker.optics), state[SPREAD],
    )
    tone = min(max(state[TONE], -MAX_TONE), MAX_TONE)
    for i in range(height):
        # Beyond the modelled extent is black.
        level, outside = 0.0, 0.0
        shares, squares, by_x, by_y = images[0, i], images[1, i], images[2, i], images[3, i]
        by_spread, outer, row, steps = images[4, i], images[5, i], rates[i], outsides[i]
        for j in range(width):
            level += row[4 * j]
            outside += steps[j]
            shares[j] = level
            squares[j] = level * (1.0 - level) if view.toned else 0.0
            outer[j] = outside
            gain = 1.0 + tone * (1.0 - 2.0 * level)
            by_x[j] = gain * row[4 * j + 1]
            by_y[j] = gain * row[4 * j + 2]
            by_spread[j] = gain * row[4 * j + 3]
        row[:] = 0.0
        steps[:] = 0.0


@compiled
def write_columns(
    view: PhotographView, state: Floats, contrast: float, images: Floats, i: int, first: int,
    columns: Floats,
) -> None:
    """Write the model's derivatives at pixels of a row to ``columns`` (n, ...), from one on.

    The order: six of the pose and the point spread's variance, which are for a ``contrast``; black,
    contrast, outside, tone; the level itself.
    """
    last = first + len(columns)
    ray_x, ray_y = view.rays[0, i, first:last], view.rays[1, i, first:last]
    ux, uy = view.rays[2, i, first:last], view.rays[3, i, first:last]
    vx, vy = view.rays[4, i, first:last], view.rays[5, i, first:last]
    shares, squares, outside = (
        images[0, i, first:last], images[1, i, first:last], images[5, i, first:last]
    )
    by_u, by_v, by_spread = (
        images[2, i, first:last], images[3, i, first:last], images[4, i, first:last]
    )
    levels = view.levels[i, first:last]
    position_x, position_y, position_z = state[9], state[10], state[11]
    # The plane's normal is the third column of the rotation matrix, position follows it.
    height = state[2] * position_x + state[5] * position_y + state[8] * position_z
    normal_x, normal_y, normal_z = state[2] / height, state[5] / height, state[8] / height
    depth = abs(state[DEPTH])
    for j in range(len(columns)):
        column = columns[j]
        x, y = ray_x[j], ray_y[j]
        # The slope by the direction, from that by the pixel.
        du, dv = contrast * by_u[j], contrast * by_v[j]
        by_x = du * ux[j] + dv * vx[j]
        by_y = du * uy[j] + dv * vy[j]
        inverse = normal_x * x + normal_y * y + normal_z
        px = x - inverse * position_x
        py = y - inverse * position_y
        pz = 1.0 - inverse * position_z
        by_z = x * by_x + y * by_y
        nearness = depth * inverse
        column[0] = by_y * pz + by_z * py
        column[1] = -by_x * pz - by_z * px
        column[2] = by_x * py - by_y * px
        column[3] = -by_x * nearness
        column[4] = -by_y * nearness
        column[5] = by_z * nearness
        column[6] = contrast * by_spread[j]
        column[7] = 1.0
        column[8] = shares[j]
        column[9] = outside[j]
        column[10] = squares[j]
        column[11] = levels[j]


#: Pixels whose columns are multiplied at once, and the side of the tiles of their products.
GROUP, TILE = 128, 4


@compiled
def normal_equations(view: PhotographView, state: Floats, work: System, matrix: Floats) -> None:
    """Sum up JᵀJ, Jᵀy and yᵀy over the used pixels, for a contrast of 1, into a matrix (12, 12)."""
    size = matrix.shape[0]
    tiles = (size + TILE - 1) // TILE
    columns, sums = np.zeros((GROUP, TILE * tiles)), np.zeros((TILE * tiles, TILE * tiles))
    filled = 0
    for i in range(len(view.spans)):
        first, last = view.spans[i]
        while first < last:
            count = min(last - first, GROUP - filled)
            write_columns(view, state, 1.0, work.images, i, first, columns[filled : filled + count])
            filled += count
            first += count
            if filled == GROUP:
                add_products(columns, filled, sums)
                filled = 0
    add_products(columns, filled, sums)
    for k in range(size):
        for m in range(k + 1):
            matrix[k, m] = matrix[m, k] = sums[k, m]


@compiled_packed
def add_products(columns: Floats, count: int, sums: Floats) -> None:
    """Add the products of the columns of ``count`` pixels to the tiles of the lower triangle."""
    for k in range(0, sums.shape[0], TILE):
        for m in range(0, k + 1, TILE):
            add_tile(columns, k, columns, m, count, sums)


@compiled_inline
def add_tile(left: Floats, k: int, right: Floats, m: int, count: int, sums: Floats) -> None:
    """Add products of four columns of ``left`` from the k-th on with four of ``right``."""
    s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = 0.0
    s20 = s21 = s22 = s23 = s30 = s31 = s32 = s33 = 0.0
    for p in range(count):
        row, other = left[p, k : k + TILE], right[p, m : m + TILE]
        a0, a1, a2, a3 = row[0], row[1], row[2], row[3]
        b0, b1, b2, b3 = other[0], other[1], other[2], other[3]
        s00, s01, s02, s03 = s00 + a0 * b0, s01 + a0 * b1, s02 + a0 * b2, s03 + a0 * b3
        s10, s11, s12, s13 = s10 + a1 * b0, s11 + a1 * b1, s12 + a1 * b2, s13 + a1 * b3
        s20, s21, s22, s23 = s20 + a2 * b0, s21 + a2 * b1, s22 + a2 * b2, s23 + a2 * b3
        s30, s31, s32, s33 = s30 + a3 * b0, s31 + a3 * b1, s32 + a3 * b2, s33 + a3 * b3
    _add_to_row(sums[k, m : m + TILE], s00, s01, s02, s03)
    _add_to_row(sums[k + 1, m : m + TILE], s10, s11, s12, s13)
    _add_to_row(sums[k + 2, m : m + TILE], s20, s21, s22, s23)
    _add_to_row(sums[k + 3, m : m + TILE], s30, s31, s32, s33)


@compiled_inline
def _add_to_row(row: Floats, a: float, b: float, c: float, d: float) -> None:
    """Add four numbers to a row."""
    row[0] += a
    row[1] += b
    row[2] += c
    row[3] += d


@compiled
def _squares_of_photograph(
    view: PhotographView, state: Floats, work: System, information: Floats, gradient: Floats
) -> float:
    """As :func:`sweep.measure.likelihood.squared_residuals`, by the model of photographs."""
    draw(view, state, work)
    matrix, linear = np.empty((SIZE + 1, SIZE + 1)), np.zeros(LINEAR)
    normal_equations(view, state, work, matrix)
    outside = MOVED + 2
    if matrix[outside, outside] < MIN_OUTSIDE_PX:
        matrix[outside, :] = 0.0
        matrix[:, outside] = 0.0
    squares = matrix[SIZE, SIZE] - likelihood.eliminate(
        matrix[:SIZE, :SIZE], matrix[SIZE, :SIZE], linear, information, gradient
    )
    black, contrast, change, toned = linear[0], linear[1], linear[2], linear[3]
    # The level outside was in the image, as a share of the contrast.
    state[OUTSIDE] = black + contrast * state[OUTSIDE_SHARE] + change
    state[BLACK], state[WHITE] = black, black + contrast
    divisor = contrast if contrast != 0.0 else 1.0
    share = state[OUTSIDE_SHARE] + min(max(change / divisor, -1.0), 1.0)
    state[OUTSIDE_SHARE] = min(max(share, -1.0), MAX_OUTSIDE)
    state[TONE] = toned / divisor
    for k in range(MOVED):
        gradient[k] *= contrast
        for m in range(MOVED):
            information[k, m] *= contrast**2
    if state[SPREAD] <= MIN_SPREAD_PX and gradient[POSE] < 0.0:
        # The squares fall beyond the limit.
        for k in range(MOVED):
            information[POSE, k] = information[k, POSE] = 0.0
        information[POSE, POSE] = 1.0
        gradient[POSE] = 0.0
    return max(float(squares), 0.0)


likelihood.MODELS[PhotographView] = _squares_of_photograph


# --------------------------------------------------------------------------------------------------
# The box of a photograph that is fitted: its pixels, and the same of half the resolution.

#: Pixels around the fitted ones in the box.
PADDING_PX = 2

#: Pixels around the fitted ones within which print is in the model: what blur carries inwards.
MODELLED_PX = 5.0


def photograph_view(
    marker: Board, on_board: BoardMarker | None, size_m: float, corners: Floats, optics: Optics,
    image: Grey, origin: Integers, toned: bool,
) -> PhotographView | None:
    """Return the fitted box of one marker, with its print and camera; None if nothing is in it.

    The pixels of the marker and of its quiet zone, as far as its corners tell.

    Parameters
    ----------
    marker, on_board, size_m
        The print, and the black square's side.
    corners
        (4, 2) px of the frame.
    optics
        The camera.
    image, origin
        Grey levels, and the image's first pixel in the frame.
    toned
        Whether the tone curve is estimated.
    """
    modules = module_count(marker.dictionary)
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)
    square = cv2.getPerspectiveTransform(unit, corners.astype(np.float32))
    side = 0.25 * sum(math.dist(corners[k - 1], corners[k]) for k in range(4))
    ring = ring_modules(marker, on_board)
    if not np.isfinite(square).all() or np.linalg.det(square) == 0.0:
        return None  # three corners on a line
    to_pixels = square / [modules, modules, 1.0]
    to_modules = np.asarray(np.linalg.inv(to_pixels), dtype=np.float64)
    low_end, high_end = -ring, modules + ring
    outline = to_pixels @ np.array([
        [low_end, high_end, high_end, low_end], [low_end, low_end, high_end, high_end], [1.0] * 4,
    ])
    if not (outline[2] > 0.0).all():
        return None  # part of it is behind the horizon
    pixels = (outline[:2] / outline[2]).T
    low = np.floor(pixels.min(axis=0) - PADDING_PX).astype(np.int64)
    high = np.ceil(pixels.max(axis=0) + PADDING_PX).astype(np.int64) + 1
    # A detection may be much wider in the plane than the image that was searched.
    low = np.maximum(low, origin - PADDING_PX)
    high = np.minimum(high, origin + image.shape[::-1] + PADDING_PX)
    width, height = (high - low).tolist()
    if min(width, height) < 4:
        return None
    levels = np.zeros((height, width))
    start = np.maximum(low, origin)
    (left, top), (right, bottom) = (start - low).tolist(), (
        np.minimum(high, origin + image.shape[::-1]) - low
    ).tolist()
    (first_column, first_row) = (start - origin).tolist()
    levels[top:bottom, left:right] = image[
        first_row : first_row + bottom - top, first_column : first_column + right - left
    ]
    local = optics.intrinsics.copy()
    local[2:] -= low
    optics = Optics(local, optics.lens, optics.distorted)
    extent = math.ceil(4.0 * (ring + MODELLED_PX * modules / side)) / 4.0
    known = likelihood.MarkerView(
        surroundings(on_board or marker, extent), np.repeat([-extent, modules + extent], 2),
        float(modules), float(size_m), optics, 0.0, MIN_SPREAD_PX, likelihood.FLAT,
    )
    to_modules[:, 2] += to_modules[:, :2] @ low
    at, spans = _fitted_pixels(
        to_modules, float(modules), ring, height, width, np.array([left, top, right, bottom])
    )
    if (spans[:, 1] - spans[:, 0]).sum() <= SIZE:
        return None  # fewer pixels than parameters
    return PhotographView(
        known, levels, spans, rays_of(optics, height, width), at, toned
    )


@compiled
def _fitted_pixels(
    to_modules: Floats, modules: float, ring: float, height: int, width: int, image: Integers
) -> tuple[Floats, Integers]:
    """Return ``at`` and ``spans`` of a view.

    Fitted are pixels up to ``ring`` modules around the square, in the part of the box that is in
    the image: ``image`` (4,) left, top, right, bottom. A row's pixels are one span: both areas are
    convex.
    """
    at, spans = np.empty((2, height, width)), np.zeros((height, 2), dtype=np.int64)
    half = 0.5 * modules
    for i in range(height):
        first, last = width, 0
        for j in range(width):
            x = to_modules[0, 0] * j + to_modules[0, 1] * i + to_modules[0, 2]
            y = to_modules[1, 0] * j + to_modules[1, 1] * i + to_modules[1, 2]
            z = to_modules[2, 0] * j + to_modules[2, 1] * i + to_modules[2, 2]
            inverse = 1.0 / z if z > 0.0 else 0.0
            right, down = (x * inverse - half) / (half + ring), (y * inverse - half) / (half + ring)
            at[0, i, j], at[1, i, j] = min(max(right, -2.0), 2.0), min(max(down, -2.0), 2.0)
            inside = image[0] <= j < image[2] and image[1] <= i < image[3]
            if inside and z > 0.0 and abs(right) < 1.0 and abs(down) < 1.0:
                first, last = min(first, j), j + 1
        if first < last:
            spans[i, 0], spans[i, 1] = first, last
    return at, spans


@compiled
def binned_photograph(view: PhotographView) -> PhotographView:
    """Return the view of the means of 2 x 2 pixels; an odd last row or column is left out."""
    height, width = view.levels.shape[0] // 2, view.levels.shape[1] // 2
    levels, spans = np.empty((height, width)), np.empty((height, 2), dtype=np.int64)
    at, rays = np.empty((2, height, width)), np.empty((6, height, width))
    likelihood.halve(view.levels, 0.25, levels)
    for k in range(2):
        likelihood.halve(view.at[k], 0.25, at[k])
    for k in range(6):
        likelihood.halve(view.rays[k], 0.25 if k < 2 else 0.125, rays[k])
    for i in range(height):
        first = max(view.spans[2 * i, 0], view.spans[2 * i + 1, 0])
        last = min(view.spans[2 * i, 1], view.spans[2 * i + 1, 1])
        spans[i, 0] = (first + 1) // 2
        spans[i, 1] = max(last // 2, spans[i, 0])
    marker = likelihood.binned_view(view.marker)
    return PhotographView(marker, levels, spans, rays, at, view.toned)


# --------------------------------------------------------------------------------------------------
# Residuals of a fitted photograph: noise, its correlation, and misfit of the geometry.
#
# Least squares need no model of the noise for the pose, but for its covariance. The residuals
# tell two sources. Noise of pixels is correlated from pixel to pixel, as cameras smooth, sharpen
# and compress: its covariance between pixels is taken as variance · x^|columns| · y^|rows|, with
# x and y the correlations of neighbours. The rest is geometry: parts of the marker lie beside the
# plane's image (lens, rolling shutter, bent sheet, rows of a screen). A field of shifts, bilinear
# between :data:`SHIFT_NODES` along each side of the marker, accounts for it: both components have
# the standard deviation s and the correlation exp(-distance / :data:`CORRELATED`), R. On
# photographs a marker as a whole is shifted about as much as its parts are against each other,
# and only the latter are in residuals. s² is estimated by moments: with D the levels' slopes by
# the nodes' shifts after those by the fitted parameters have been eliminated, S = DᵀD, and u =
# Dᵀr of residuals r, E uᵀu = s² tr(S R S) + noise. The misfit is what the parts are shifted
# against each other, the same with R = 1.
#
# The covariance of the pose is A⁻¹ Jᵀ (N + s² E R Eᵀ) J A⁻¹ with A = JᵀJ, N the noise's
# covariance and E the slopes by the shifts as such: White, "A heteroskedasticity-consistent
# covariance matrix estimator and a direct test for heteroskedasticity", Econometrica 48, 1980,
# for the form.

#: Nodes of the field of shifts along each side of the marker.
SHIFT_NODES = 4

#: Distance at which the correlation of shifts is 1/e, in halves of the marker's extent. With 1 the
#: squared errors of poses on photographs of boards are about those expected; if shifts were
#: independent, they would be two to three times that.
CORRELATED = 1.0

_NODES = np.array([divmod(k, SHIFT_NODES) for k in range(SHIFT_NODES**2)])
#: (n, n) correlations of the components of the nodes' shifts: x and y of each node.
_CORRELATIONS = np.kron(np.array([
    [math.exp(-2.0 / (SHIFT_NODES - 1) * math.hypot(*apart) / CORRELATED) for apart in _NODES - at]
    for at in _NODES
]), np.eye(2)).astype(np.float64)

#: Standard deviation of shifts before the residuals are seen; keeps what they do not tell small.
LARGEST_SHIFT_PX = 1.0

#: Standard deviations by which shifts must exceed what noise brings about.
SIGNIFICANT = 2.0

#: Largest correlation of neighbouring pixels that is assumed.
MAX_CORRELATION = 0.9

#: Most turn by a fit's last step: up to there the image before it serves the pose after it. Their
#: levels differ by what is eliminated below; standard deviations did by at most 7 %, mostly by 1 %.
LAST_STEP_RAD = math.radians(1.0)

#: Components of nodes that move a pixel's level: two of each of the four nodes around it.
HELD = 8

#: Numbers kept of each pixel: the pose's six changes by its level.
WIDE = 2 * TILE


@compiled
def _node(at: float) -> int:
    """Return the node before a coordinate from -1 to 1."""
    return min(int(min(max(0.5 * (at + 1.0), 0.0), 1.0) * (SHIFT_NODES - 1)), SHIFT_NODES - 2)


@compiled
def _column(cell: int, k: int) -> int:
    """Return the number, among all columns, of the k-th of those that a cell has.

    Columns are those by the parameters, the level, and those by the nodes' components.
    """
    if k <= SIZE:
        return k
    row, column, k = cell // (SHIFT_NODES - 1), cell % (SHIFT_NODES - 1), k - SIZE - 1
    return SIZE + 1 + 2 * ((row + k // 4) * SHIFT_NODES + column + k // 2 % 2) + k % 2


@compiled
def _write_shifts(
    view: PhotographView, state: Floats, images: Floats, i: int, first: int, cell: int,
    columns: Floats, k: int,
) -> None:
    """Write the slopes by the components of a cell's nodes as columns (n, ...) from the k-th on."""
    top, left = float(cell // (SHIFT_NODES - 1)), float(cell % (SHIFT_NODES - 1))
    scale = state[WHITE] - state[BLACK]
    for j in range(len(columns)):
        at_x, at_y = view.at[0, i, first + j], view.at[1, i, first + j]
        right = min(max(0.5 * (at_x + 1.0), 0.0), 1.0) * (SHIFT_NODES - 1) - left
        down = min(max(0.5 * (at_y + 1.0), 0.0), 1.0) * (SHIFT_NODES - 1) - top
        by_x, by_y = -scale * images[2, i, first + j], -scale * images[3, i, first + j]
        column = columns[j]
        column[k], column[k + 1] = (1 - down) * (1 - right) * by_x, (1 - down) * (1 - right) * by_y
        column[k + 2], column[k + 3] = (1 - down) * right * by_x, (1 - down) * right * by_y
        column[k + 4], column[k + 5] = down * (1 - right) * by_x, down * (1 - right) * by_y
        column[k + 6], column[k + 7] = down * right * by_x, down * right * by_y


@compiled
def _write_cell(
    view: PhotographView, state: Floats, images: Floats, i: int, first: int, columns: Floats
) -> tuple[int, int]:
    """Write the columns of a row's pixels of one cell.

    ``first`` is the first pixel. Returns the cell, and the pixel after the last.
    """
    row, column, stop = _node(view.at[1, i, first]), _node(view.at[0, i, first]), first + 1
    while (
        stop < min(view.spans[i, 1], first + GROUP)
        and _node(view.at[0, i, stop]) == column and _node(view.at[1, i, stop]) == row
    ):
        stop += 1
    cell = row * (SHIFT_NODES - 1) + column
    group = columns[: stop - first]
    write_columns(view, state, state[WHITE] - state[BLACK], images, i, first, group)
    _write_shifts(view, state, images, i, first, cell, group, SIZE + 1)
    return cell, stop


@compiled
def _products(view: PhotographView, state: Floats, images: Floats) -> Floats:
    """Return the products (cells, n, n) of the columns of each cell's pixels: lower triangles."""
    tiles = (SIZE + 1 + HELD + TILE - 1) // TILE
    sums = np.zeros(((SHIFT_NODES - 1) ** 2, TILE * tiles, TILE * tiles))
    columns = np.zeros((GROUP, TILE * tiles))
    for i in range(len(view.spans)):
        first, last = view.spans[i]
        while first < last:
            cell, stop = _write_cell(view, state, images, i, first, columns)
            add_products(columns, stop - first, sums[cell])
            first = stop
    return sums


@compiled_packed
def _correlated_products(
    field: Floats, view: PhotographView, across: float, along: float
) -> Floats:
    """Return the sum (6, 6) over pairs of pixels of their products times the noise's correlation.

    ``field`` (height, width, WIDE) has the six numbers of each pixel; those not fitted are 0. The
    sum over pairs is that over a pixel's own row and the rows above, and its transpose.
    """
    height, width, _ = field.shape
    above, pairs = np.zeros((width, WIDE)), np.zeros((width, WIDE))
    passed, sums = np.empty((width, WIDE)), np.zeros((WIDE, WIDE))
    for i in range(height):
        row, carried = field[i], np.zeros(WIDE)
        for j in range(width):
            at, before = row[j], passed[j]
            for m in range(WIDE):
                before[m] = carried[m]
                carried[m] = across * (carried[m] + at[m])
        carried = np.zeros(WIDE)
        for j in range(width - 1, -1, -1):
            at, before, sum_above, pair = row[j], passed[j], above[j], pairs[j]
            for m in range(WIDE):
                total = carried[m] + at[m]
                carried[m] = across * total
                weighted = along * sum_above[m]
                sum_above[m] = weighted + (before[m] + total)
                pair[m] = 2.0 * weighted + (before[m] + total)
        first, last = view.spans[i]
        for k in range(0, WIDE, TILE):
            for m in range(0, WIDE, TILE):
                add_tile(row[first:last], k, pairs[first:last], m, last - first, sums)
    return 0.5 * (sums + sums.T)[:POSE, :POSE]


@compiled
def _lagged(residuals: Floats, view: PhotographView, down: int, right: int) -> float:
    """Return the mean product of residuals (height, width) of fitted pixels a lag apart."""
    total, count = 0.0, 0
    for i in range(len(residuals) - down):
        first = max(view.spans[i, 0], view.spans[i + down, 0] - right)
        last = min(view.spans[i, 1], view.spans[i + down, 1] - right)
        row, other = residuals[i], residuals[i + down]
        for j in range(first, last):
            total += row[j] * other[j + right]
        count += max(last - first, 0)
    return total / max(count, 1)


@compiled
def _ratio(lagged: float, variance: float) -> float:
    """Return a correlation within bounds; 0 of residuals that are all 0."""
    return min(max(lagged / max(variance, 1e-300), -MAX_CORRELATION), MAX_CORRELATION)


@compiled
def judge(
    view: PhotographView, state: Floats, work: System, covariance: Floats
) -> float:
    """Write the pose's covariance (6, 6) in radians and metres at a fitted state.

    Returns the standard deviation in px of the shifts of the marker's parts against each other;
    NaN if there is no covariance.
    """
    if likelihood.turn_between(work.drawn, state) > LAST_STEP_RAD:
        draw(view, state, work)
    height, width = view.levels.shape
    pixels, nodes = pixel_count(view), 2 * SHIFT_NODES * SHIFT_NODES
    sums = _products(view, state, work.images)
    total = np.zeros((SIZE + 1 + nodes, SIZE + 1 + nodes))
    for cell in range(len(sums)):
        for k in range(SIZE + 1 + HELD):
            for m in range(SIZE + 1 + HELD):
                total[_column(cell, k), _column(cell, m)] += sums[cell, max(k, m), min(k, m)]
    matrix, levels = total[:SIZE, :SIZE].copy(), total[:SIZE, SIZE : SIZE + 1].copy()
    crossed, pull = total[:SIZE, SIZE + 1 :].copy(), total[SIZE + 1 :, SIZE : SIZE + 1].copy()
    inverse = np.eye(SIZE)
    for k in range(SIZE):
        matrix[k, k] = matrix[k, k] * (1.0 + 1e-9) if matrix[k, k] > 0.0 else 1.0
    freedom = pixels - SIZE - nodes
    if freedom < 1 or not solve_positive(matrix, inverse):
        return math.nan
    influence, fitted = likelihood.product(inverse, crossed), likelihood.product(inverse, levels)
    schur = total[SIZE + 1 :, SIZE + 1 :] - likelihood.product(crossed.T, influence)
    pull -= likelihood.product(crossed.T, fitted)
    shifts, ridged = pull.copy(), schur.copy()
    mean_square = (total[SIZE, SIZE] - (fitted * levels).sum()) / pixels
    for k in range(nodes):
        ridged[k, k] += max(mean_square, 0.0) / LARGEST_SHIFT_PX**2 + 1e-12
    if not solve_positive(ridged, shifts):
        return math.nan
    # The rest after the best field of shifts is noise.
    fitted -= likelihood.product(influence, shifts)
    field, residuals = np.zeros((height, width, WIDE)), np.empty((height, width))
    _write_residuals(view, state, work.images, inverse, fitted, shifts, field, residuals)
    variance = _lagged(residuals, view, 0, 0)
    across = _ratio(_lagged(residuals, view, 0, 1), variance)
    along = _ratio(_lagged(residuals, view, 1, 0), variance)
    variance *= pixels / freedom
    products = _correlated_products(field, view, across, along)
    raised = 0.0
    for m in range(POSE):
        raised += products[m, m] / (inverse[m, m] * POSE)
    square_trace = (schur * schur).sum()
    # The noise alone gives a pull of that mean, and of this standard deviation.
    excess = (pull * pull).sum() - raised * variance * np.trace(schur)
    chance = SIGNIFICANT * raised * variance * math.sqrt(2.0 * square_trace)
    expected = (_CORRELATIONS * likelihood.product(schur, schur)).sum()
    shift_variance = excess / expected if excess > chance else 0.0
    misfit = math.sqrt(excess / square_trace) if excess > chance else 0.0
    of_pose = influence[:POSE]
    shifted = likelihood.product(of_pose, likelihood.product(_CORRELATIONS, of_pose.T))
    distance = abs(state[DEPTH])
    for m in range(POSE):
        for k in range(POSE):
            scale = (distance if m >= 3 else 1.0) * (distance if k >= 3 else 1.0)
            covariance[m, k] = scale * (variance * products[m, k] + shift_variance * shifted[m, k])
    return misfit


@compiled
def _write_residuals(
    view: PhotographView, state: Floats, images: Floats, inverse: Floats,
    fitted: Floats, shifts: Floats, field: Floats, residuals: Floats,
) -> None:
    """Write the pose's changes by the pixels' levels to ``field``, which is 0, and residuals."""
    columns, of_cell = np.empty((GROUP, SIZE + 1 + HELD)), np.empty(HELD)
    for i in range(len(view.spans)):
        first, last = view.spans[i]
        while first < last:
            cell, stop = _write_cell(view, state, images, i, first, columns)
            for k in range(HELD):
                of_cell[k] = shifts[_column(cell, SIZE + 1 + k) - SIZE - 1, 0]
            for j in range(stop - first):
                column, out = columns[j], field[i, first + j]
                residual = column[SIZE]
                a = b = c = d = e = f = 0.0
                for k in range(SIZE):
                    value, weight = column[k], inverse[k]
                    residual -= value * fitted[k, 0]
                    a, b, c = a + value * weight[0], b + value * weight[1], c + value * weight[2]
                    d, e, f = d + value * weight[3], e + value * weight[4], f + value * weight[5]
                out[0], out[1], out[2], out[3], out[4], out[5] = a, b, c, d, e, f
                for k in range(HELD):
                    residual -= column[SIZE + 1 + k] * of_cell[k]
                residuals[i, first + j] = residual
            first = stop


# --------------------------------------------------------------------------------------------------
# The pose in a photograph: the best minimum of several starts, and its covariance.

#: Of photographs. The last step is taken: near the minimum the one after it is a hundredth as long.
#: At an excess of 100 coarse fits ruled a mirror out that was right, one of 521; at 150 none.
REAL = likelihood.Search(4.0, 16.0, 150.0)

#: Turn between two minima, in radians, below which it does not matter which is right.
SAME_POSE_RAD = math.radians(5.0)


@compiled
def locate_photograph(
    view: PhotographView, starts: Floats, covariance: Floats
) -> tuple[Floats, float, bool, Floats, int, float]:
    """Return the result of :func:`locate` on a photograph, the freedom, and the misfit.

    ``covariance`` (6, 6) gets that of the pose in radians and metres; the misfit is NaN if there is
    none.
    """
    freedom = pixel_count(view) - SIZE
    coarse = binned_photograph(view)
    work = system(view.levels.shape[0], view.levels.shape[1])
    unused = np.empty((MOVED, MOVED))
    state, level, reached, other = likelihood.locate(
        view, work, freedom, coarse,
        system(coarse.levels.shape[0], coarse.levels.shape[1]), starts, REAL, unused)
    if likelihood.turn_between(state, other) > SAME_POSE_RAD:
        # The search ends where a minimum cannot be the best, which may be far from it.
        likelihood.descend(
            view, other, work, freedom, likelihood.COARSE_STEPS, 1.0, math.inf, unused)
        if likelihood.turn_between(state, other) <= SAME_POSE_RAD:
            other[:] = math.nan  # there is no other minimum
    misfit = judge(view, state, work, covariance) if reached else math.nan
    return state, level, reached, other, freedom, misfit


# --------------------------------------------------------------------------------------------------
# Which of two minima is the pose.
#
# With r the residuals at the pose and d the difference of both images, the squared residuals at the
# other minimum are larger by T = sum d (2 r + d). If the pose is right, T has the mean dᵀd and the
# variance 4 dᵀCd, with C the covariance of the residuals; if the other one is, the mean -dᵀd. The
# logarithm of their likelihoods' ratio is T / (2 dᵀCd / dᵀd): noise of variance v alone has
# T / (2 v). Along d residuals of photographs are larger and correlated: the images differ at edges,
# where shifts, tone and compression leave the most. So dᵀCd is that of the residuals themselves,
# the sum of products of d r of pixels by their distance, with Bartlett's weights (Newey and West,
# "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance
# matrix", Econometrica 55, 1987): a mean over squares of squared sums.

#: Side of the squares over that of the fitted area: shifts are correlated about as far.
CORRELATED_SHARE = 0.3


@compiled
def _levels_at(view: PhotographView, state: Floats) -> Floats:
    """Return the levels (height, width) of the model at a state, the linear parameters fitted."""
    fitted, work = state.copy(), system(*view.levels.shape)
    likelihood.squared_residuals(view, fitted, work, np.empty((MOVED, MOVED)), np.empty(MOVED))
    contrast, images = fitted[WHITE] - fitted[BLACK], work.images
    change = fitted[OUTSIDE] - fitted[BLACK] - contrast * state[OUTSIDE_SHARE]
    share = images[0] + fitted[TONE] * images[1]
    return np.asarray(fitted[BLACK] + contrast * share + change * images[5])


def log_odds(view: PhotographView, state: Floats, other: Floats) -> float:
    """Return the logarithm of the odds of a fitted state (18,) against another one.

    Infinite if there is no other one, or if its pose is the same to :data:`SAME_POSE_RAD`.
    """
    if not likelihood.turn_between(state, other) > SAME_POSE_RAD:
        return math.inf
    fitted, columns = _levels_at(view, state), np.arange(view.levels.shape[1])
    used = (view.spans[:, :1] <= columns) & (columns < view.spans[:, 1:])
    residual, change = (view.levels - fitted) * used, (fitted - _levels_at(view, other)) * used
    side = math.ceil(CORRELATED_SHARE * math.sqrt(used.sum()))
    products = np.pad(residual * change, side)
    sums = cv2.boxFilter(products, -1, (side, side), normalize=False)
    spread = (sums**2).sum() / side**2 / (change**2).sum()
    return float((change * (2.0 * residual + change)).sum() / (2.0 * spread))
