"""Polygons: sides, areas, half planes; the projection of planes and bent sheets into the image."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled, compiled_inline
from sweep.model.lens import distort
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Polygons: their sides and areas, and what a half plane leaves of them.

def following(points: NDArray[Any]) -> NDArray[Any]:
    """Return the next point of each point of polygons (N, M, D): the first after the last."""
    return np.concatenate([points[:, 1:], points[:, :1]], axis=1)


def side_lengths(points: NDArray[np.floating[Any] | np.integer[Any]]) -> Floats:
    """Return the lengths (N, M) of the sides of polygons (N, M, D), from each point to the next."""
    return np.asarray(np.linalg.norm(following(points) - points, axis=2))


def signed_areas(points: Floats) -> Floats:
    """Return the signed areas (N,) of polygons (N, M, 2)."""
    local = points - points[:, :1]
    after = following(local)
    with np.errstate(over="ignore", invalid="ignore"):
        doubled = local[..., 0] * after[..., 1] - local[..., 1] * after[..., 0]
        return np.asarray(0.5 * doubled.sum(axis=1))


def half_plane(polygon: Floats, inside: Floats) -> Floats:
    """Clip a polygon (M, D) to the half space in which a linear function is not negative.

    ``inside`` (M,) are the function's values at the polygon's points.
    """
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if inside[i] >= 0:
            kept.append(polygon[i])
        if (inside[i] >= 0) != (inside[j] >= 0):
            t = inside[i] / (inside[i] - inside[j])
            kept.append(polygon[i] + t * (polygon[j] - polygon[i]))
    return np.array(kept).reshape(-1, polygon.shape[1])


# --------------------------------------------------------------------------------------------------
# The projection of a marker's plane into the image, for compiled code.
#
# Module coordinates (column right, row down, origin at the black square's top left corner) are
# taken to the camera frame by a plane, and from there to pixels by the camera's optics.

#: Largest distance of a chord from the curved edge that it replaces; 0.03 grey levels at most.
CHORD_TOLERANCE_PX = 1e-4


class Optics(NamedTuple):
    """One camera.

    Attributes
    ----------
    intrinsics
        (4,) fx, fy, cx, cy in pixels.
    lens
        (24,) packed lens (:func:`sweep.model.lens.pack`); read only if ``distorted``.
    distorted
        Whether the camera has a lens model; without one no lens code runs.
    """

    intrinsics: Floats
    lens: Floats
    distorted: bool


class Projection(NamedTuple):
    """One camera and the plane of one marker.

    Attributes
    ----------
    plane
        (3, 3) takes module coordinates to the camera frame: (x, y, z) = plane · (column, row, 1).
    optics
        The camera.
    """

    plane: Floats
    optics: Optics


class ModuleEdge(NamedTuple):
    """A straight edge in module coordinates, from (column, row) to (to_column, to_row)."""

    column: float
    row: float
    to_column: float
    to_row: float


@compiled_inline
def plane_point(plane: Floats, column: float, row: float) -> tuple[float, float, float]:
    """Return a point of a plane in the camera frame."""
    return (
        plane[0, 0] * column + plane[0, 1] * row + plane[0, 2],
        plane[1, 0] * column + plane[1, 1] * row + plane[1, 2],
        plane[2, 0] * column + plane[2, 1] * row + plane[2, 2],
    )


@compiled_inline
def homogeneous_pixel(
    projection: Projection, shift_x: float, shift_y: float, column: float, row: float
) -> tuple[float, float, float]:
    """Return the undistorted image (x, y, z) of a point of the plane: its pixel is (x/z, y/z).

    The principal point is at (``shift_x``, ``shift_y``).
    """
    intrinsics = projection.optics.intrinsics
    x, y, z = plane_point(projection.plane, column, row)
    return intrinsics[0] * x + shift_x * z, intrinsics[1] * y + shift_y * z, z


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

# --------------------------------------------------------------------------------------------------
# A printed sheet that is not flat, or whose image the camera shifts from point to point.
#
# A bent sheet keeps its tangent plane at one point, the centre: the pose is that plane's. A
# cylinder bends without stretching; a saddle stands h = -k (a² - b²) / 2 over the tangent plane.

#: Largest turn of a bent sheet along a piece of an edge that is divided into chords on its own.
PIECE_RAD = 0.25

#: Longest such piece in correlation lengths of the shift.
PIECE_LENGTHS = 0.5

MAX_PIECES = 256

#: Least number of cells along a marker's side whose images are checked for folds.
FOLD_CELLS = 8

#: Largest turn of a bent sheet from cell to cell; a fold between them covers 1/2,000 of the radius
#: of curvature at most.
FOLD_RAD = 0.05

MAX_FOLD_CELLS = 256


class Sheet(NamedTuple):
    """A sheet in the units of a plane (:class:`Projection`).

    Attributes
    ----------
    centre_column, centre_row
        The point whose tangent plane it keeps.
    curvature
        Per unit; positive if it bulges towards the viewer; 0 for a flat sheet.
    cosine, sine
        The direction in which it curves, right and down.
    saddle
        Whether it curves as much the other way across.
    waves
        (2, M, 4) of the shifts right and down: wave numbers right and down in 1/px, and the
        factors of cosine and sine in px. M is 0 without shift.
    largest_px
        What no shift exceeds, right or down.
    piece_px
        Longest piece of an edge on which the shift varies slowly.
    """

    centre_column: float
    centre_row: float
    curvature: float
    cosine: float
    sine: float
    saddle: bool
    waves: Floats
    largest_px: float
    piece_px: float

    @property
    def is_curved(self) -> bool:
        """Whether it is bent, or its image shifted."""
        return self.curvature != 0 or self.waves.shape[1] > 0


@compiled_inline
def flat_sheet() -> Sheet:
    """Return a sheet without bend and shift."""
    return Sheet(0.0, 0.0, 0.0, 1.0, 0.0, False, np.zeros((2, 0, 4)), 0.0, math.inf)


@compiled_inline
def bent_point(column: float, row: float, sheet: Sheet) -> tuple[float, float, float]:
    """Return where a point of the flat sheet is: column, row, and height towards the viewer."""
    across, down = column - sheet.centre_column, row - sheet.centre_row
    a = across * sheet.cosine + down * sheet.sine
    b = down * sheet.cosine - across * sheet.sine
    curvature = sheet.curvature
    if curvature == 0.0:
        return column, row, 0.0
    if sheet.saddle:
        return column, row, -0.5 * curvature * (a * a - b * b)
    half = math.sin(0.5 * curvature * a)
    height = -2.0 * half * half / curvature
    a = math.sin(curvature * a) / curvature
    return (
        sheet.centre_column + a * sheet.cosine - b * sheet.sine,
        sheet.centre_row + a * sheet.sine + b * sheet.cosine,
        height,
    )


@compiled_inline
def plane_normal(plane: Floats) -> tuple[float, float, float]:
    """Return the vector of one unit out of a plane, towards the viewer."""
    x = plane[2, 0] * plane[1, 1] - plane[1, 0] * plane[2, 1]
    y = plane[0, 0] * plane[2, 1] - plane[2, 0] * plane[0, 1]
    z = plane[1, 0] * plane[0, 1] - plane[0, 0] * plane[1, 1]
    unit = math.sqrt(plane[0, 0] ** 2 + plane[1, 0] ** 2 + plane[2, 0] ** 2)
    return x / unit, y / unit, z / unit


@compiled
def edge_pixel(
    t: float, edge: ModuleEdge, projection: Projection, sheet: Sheet
) -> tuple[float, float]:
    """Return the pixel of the point at parameter t of an edge: bent, through the lens, shifted.

    NaN if it is not before the camera.
    """
    column = edge.column + t * (edge.to_column - edge.column)
    row = edge.row + t * (edge.to_row - edge.row)
    at_column, at_row, height = bent_point(column, row, sheet)
    x, y, z = plane_point(projection.plane, at_column, at_row)
    if height != 0.0:
        normal = plane_normal(projection.plane)
        x, y, z = x + height * normal[0], y + height * normal[1], z + height * normal[2]
    if not z > 0.0:
        return math.nan, math.nan
    x, y = x / z, y / z
    optics = projection.optics
    if optics.distorted:
        x, y = distort(x, y, optics.lens)
    intrinsics = optics.intrinsics
    u, v = intrinsics[0] * x + intrinsics[2], intrinsics[1] * y + intrinsics[3]
    waves = sheet.waves
    right = down = 0.0
    for wave in range(waves.shape[1]):
        phase = waves[0, wave, 0] * u + waves[0, wave, 1] * v
        right += waves[0, wave, 2] * math.cos(phase) + waves[0, wave, 3] * math.sin(phase)
        phase = waves[1, wave, 0] * u + waves[1, wave, 1] * v
        down += waves[1, wave, 2] * math.cos(phase) + waves[1, wave, 3] * math.sin(phase)
    return u + right, v + down


@compiled_inline
def sheet_pixel(
    column: float, row: float, projection: Projection, sheet: Sheet
) -> tuple[float, float]:
    """Return the pixel of a point of the flat sheet; as :func:`edge_pixel`."""
    return edge_pixel(0.0, ModuleEdge(column, row, column, row), projection, sheet)


@compiled_inline
def chord_count(
    edge: ModuleEdge, piece: int, pieces: int, ends: tuple[float, float, float, float],
    projection: Projection, sheet: Sheet,
) -> int:
    """Return the number of equal chords that replace the curved image of one of an edge's pieces.

    ``ends`` are the pixels of the piece's ends. A chord's distance from a smooth curve falls with
    the square of their number.
    """
    x0, y0, x1, y1 = ends
    distance, length = 0.0, math.hypot(x1 - x0, y1 - y0)
    for quarter in range(1, 4):
        x, y = edge_pixel((piece + 0.25 * quarter) / pieces, edge, projection, sheet)
        # From the straight line through the ends, or from the one point that both are.
        away = math.hypot(x - x0, y - y0)
        if length != 0.0:
            away = abs((x - x0) * (y1 - y0) - (y - y0) * (x1 - x0)) / length
        distance = max(distance, away)
    return min(max(math.ceil(math.sqrt(distance / CHORD_TOLERANCE_PX)), 1), 4096)


@compiled
def sheet_pixels(points: Floats, projection: Projection, sheet: Sheet) -> Floats:
    """Return the pixels (M, 2) of points (M, 2) of the flat sheet; as :func:`sheet_pixel`."""
    pixels = np.empty_like(points)
    for i in range(len(points)):
        pixels[i, 0], pixels[i, 1] = sheet_pixel(points[i, 0], points[i, 1], projection, sheet)
    return pixels


@compiled
def piece_count(edge: ModuleEdge, projection: Projection, sheet: Sheet) -> int:
    """Return the parts of an edge on each of which bend and shift vary slowly."""
    turn = abs(sheet.curvature) * math.hypot(edge.to_column - edge.column, edge.to_row - edge.row)
    pieces = turn / PIECE_RAD
    if sheet.waves.shape[1] > 0:
        u0, v0 = sheet_pixel(edge.column, edge.row, projection, sheet)
        u1, v1 = sheet_pixel(edge.to_column, edge.to_row, projection, sheet)
        pieces = max(pieces, math.hypot(u1 - u0, v1 - v0) / sheet.piece_px)
    return min(max(math.ceil(pieces), 1), MAX_PIECES)


def fold_cells(sheet: Sheet, side: float, extent_px: float) -> int:
    """Return the cells in which folds of a rectangle are searched, of a side in units and in px."""
    cells = max(abs(sheet.curvature) * side / FOLD_RAD, 2 * extent_px / sheet.piece_px)
    return int(min(FOLD_CELLS + cells, MAX_FOLD_CELLS))


@compiled
def folds_over(low: Floats, high: Floats, cells: int, projection: Projection, sheet: Sheet) -> bool:
    """Return whether the image of a rectangle of the sheet folds over, or lies behind the camera.

    ``low`` and ``high`` (2,) are its corners in units. A part of the sheet that is seen from
    behind hides others, and turns the sense of rotation: on a lattice of ``cells`` by ``cells``,
    two triangles a cell, no sense may turn.
    """
    previous = np.empty((cells + 1, 2))
    line = np.empty((cells + 1, 2))
    for i in range(cells + 1):
        row = low[1] + (high[1] - low[1]) * i / cells
        for j in range(cells + 1):
            column = low[0] + (high[0] - low[0]) * j / cells
            line[j, 0], line[j, 1] = sheet_pixel(column, row, projection, sheet)
            if math.isnan(line[j, 0]):
                return True
            if i == 0 or j == 0:
                continue
            ax, ay = line[j, 0] - previous[j - 1, 0], line[j, 1] - previous[j - 1, 1]
            bx, by = previous[j, 0] - previous[j - 1, 0], previous[j, 1] - previous[j - 1, 1]
            cx, cy = line[j - 1, 0] - previous[j - 1, 0], line[j - 1, 1] - previous[j - 1, 1]
            if not (bx * ay - by * ax > 0.0 and ax * cy - ay * cx > 0.0):
                return True
        previous, line = line, previous
    return False
