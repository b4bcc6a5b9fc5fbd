"""The image of a printed sheet that is not flat, or that the camera shifts from point to point.

A bent sheet keeps its tangent plane at one point, the centre: the pose is that plane's. A cylinder
bends without stretching; a saddle stands h = -k (a² - b²) / 2 over the tangent plane.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sweep.compilation import compiled, compiled_inline
from sweep.model.lens import distort
from sweep.model.polygon import ModuleEdge, Projection
from sweep.typing import Floats

PIECE_RAD = 0.25
"""Largest turn of a bent sheet along a piece of an edge that is divided into chords on its own."""

PIECE_LENGTHS = 0.5
"""Longest such piece in correlation lengths of the shift."""

MAX_PIECES = 256

FOLD_CELLS = 8
"""Least number of cells along a marker's side whose images are checked for folds."""

FOLD_RAD = 0.05
"""Largest turn of a bent sheet from cell to cell; a fold between them covers 1/2,000 of the
radius of curvature at most."""

MAX_FOLD_CELLS = 256

NO_WAVES = np.zeros((2, 0, 4))
"""Of an image that is not shifted."""


class Sheet(NamedTuple):
    """A sheet in the units of a plane (:class:`sweep.model.polygon.Projection`).

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


class Shape(NamedTuple):
    """A sheet's shape in metres: the curvature in 1/m, and its direction.

    Attributes
    ----------
    curvature_per_m
        As :class:`Sheet`.
    direction_rad
        The direction in which it curves, from the marker's right to its top.
    saddle
        Whether it curves as much the other way across.
    """

    curvature_per_m: float = 0.0
    direction_rad: float = 0.0
    saddle: bool = False


def sheet_of(
    shape: Shape, unit_m: float, centre: tuple[float, float], waves: Floats = NO_WAVES,
    length_px: float = math.inf,
) -> Sheet:
    """Return a sheet of a shape in units of ``unit_m``, with the shift's waves and its length."""
    # Functions are compiled once for each layout of an array in memory.
    waves = np.ascontiguousarray(waves)
    return Sheet(
        float(centre[0]), float(centre[1]), shape.curvature_per_m * unit_m,
        math.cos(shape.direction_rad), -math.sin(shape.direction_rad), shape.saddle,
        waves, float(np.hypot(waves[:, :, 2], waves[:, :, 3]).sum(axis=1).max(initial=0.0)),
        PIECE_LENGTHS * length_px,
    )


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
def sheet_pixel(
    column: float, row: float, projection: Projection, sheet: Sheet
) -> tuple[float, float]:
    """Return the pixel of a point of the flat sheet: bent, through the lens, shifted.

    NaN if it is not before the camera.
    """
    plane, optics = projection.plane, projection.optics
    at_column, at_row, height = bent_point(column, row, sheet)
    x = plane[0, 0] * at_column + plane[0, 1] * at_row + plane[0, 2]
    y = plane[1, 0] * at_column + plane[1, 1] * at_row + plane[1, 2]
    z = plane[2, 0] * at_column + plane[2, 1] * at_row + plane[2, 2]
    if height != 0.0:
        normal = plane_normal(plane)
        x, y, z = x + height * normal[0], y + height * normal[1], z + height * normal[2]
    if not z > 0.0:
        return math.nan, math.nan
    x, y = x / z, y / z
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


FLAT = sheet_of(Shape(), 1.0, (0.0, 0.0))
"""A sheet without bend and shift."""
