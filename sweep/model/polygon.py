"""Polygons: sides, areas, half planes; and the projection of a plane into the image."""

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

def side_lengths(points: NDArray[np.floating[Any] | np.integer[Any]]) -> Floats:
    """Return the lengths (N, M) of the sides of polygons (N, M, D), from each point to the next."""
    return np.asarray(np.linalg.norm(np.roll(points, -1, axis=1) - points, axis=2))


def signed_areas(points: Floats) -> Floats:
    """Return the signed areas (N,) of polygons (N, M, 2)."""
    local = points - points[:, :1]
    following = np.roll(local, -1, axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        doubled = local[..., 0] * following[..., 1] - local[..., 1] * following[..., 0]
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

CHORD_TOLERANCE_PX = 1e-4
"""Largest distance of a chord from the curved edge that it replaces; 0.03 grey levels at most."""


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
def homogeneous_pixel(
    projection: Projection, shift_x: float, shift_y: float, column: float, row: float
) -> tuple[float, float, float]:
    """Return the undistorted image (x, y, z) of a point of the plane: its pixel is (x/z, y/z).

    The principal point is at (``shift_x``, ``shift_y``).
    """
    plane, intrinsics = projection.plane, projection.optics.intrinsics
    z = plane[2, 0] * column + plane[2, 1] * row + plane[2, 2]
    x = intrinsics[0] * (plane[0, 0] * column + plane[0, 1] * row + plane[0, 2]) + shift_x * z
    y = intrinsics[1] * (plane[1, 0] * column + plane[1, 1] * row + plane[1, 2]) + shift_y * z
    return x, y, z


@compiled_inline
def distorted_point(t: float, projection: Projection, edge: ModuleEdge) -> tuple[float, float]:
    """Return the pixel of the point at parameter t of an edge, seen through the lens."""
    plane, optics = projection.plane, projection.optics
    column = edge.column + t * (edge.to_column - edge.column)
    row = edge.row + t * (edge.to_row - edge.row)
    z = plane[2, 0] * column + plane[2, 1] * row + plane[2, 2]
    x, y = distort(
        (plane[0, 0] * column + plane[0, 1] * row + plane[0, 2]) / z,
        (plane[1, 0] * column + plane[1, 1] * row + plane[1, 2]) / z,
        optics.lens,
    )
    intrinsics = optics.intrinsics
    return intrinsics[0] * x + intrinsics[2], intrinsics[1] * y + intrinsics[3]


@compiled
def distance_from_chord(
    px: float, py: float, x0: float, y0: float, x1: float, y1: float
) -> float:
    """Return the distance of a point from the straight line through two others."""
    length = math.hypot(x1 - x0, y1 - y0)
    if length == 0.0:
        return math.hypot(px - x0, py - y0)
    return abs((px - x0) * (y1 - y0) - (py - y0) * (x1 - x0)) / length


@compiled_inline
def chords_within_tolerance(distance: float) -> int:
    """Return the chords that replace a curve whose single chord is ``distance`` px from it."""
    return min(max(math.ceil(math.sqrt(distance / CHORD_TOLERANCE_PX)), 1), 4096)


@compiled
def chord_count(projection: Projection, edge: ModuleEdge) -> int:
    """Return the number of equal chords that replace an edge's curved image.

    A chord's distance from a smooth curve falls with the square of their number.
    """
    u0, v0 = distorted_point(0.0, projection, edge)
    u1, v1 = distorted_point(1.0, projection, edge)
    distance = 0.0
    for quarter in range(1, 4):
        u, v = distorted_point(0.25 * quarter, projection, edge)
        distance = max(distance, distance_from_chord(u, v, u0, v0, u1, v1))
    return chords_within_tolerance(distance)


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
