"""The box of a photograph that is fitted: its pixels, and the same of half the resolution."""

from __future__ import annotations

import math

import numpy as np

from sweep.compilation import compiled
from sweep.measure.estimation import Detections
from sweep.measure.likelihood import MarkerView
from sweep.measure.photograph_model import PhotographView, rays_of
from sweep.measure.surroundings import clear_modules, edges_alone, surroundings
from sweep.model.marker import module_count, overhang
from sweep.model.projection import Optics
from sweep.typing import Floats, Integers

RING_MODULES = 1.5
"""Widest part of the quiet zone that is fitted, in modules: farther out nothing tells the pose."""

PADDING_PX = 2.0
"""Pixels around the fitted ones in the box, beside the reach of the sharpening."""

PANEL_PX, COARSE_PANEL_PX = 0.4, 0.8
"""Least length of the pieces in which edges are integrated, in px: of the photograph, and of means
of 2 x 2 pixels, whose fit is a start."""

MODELLED_PX = 5.0
"""Pixels around the fitted ones within which print is in the model: what blur carries inwards."""


def photograph_view(detections: Detections, i: int, reach: float) -> PhotographView | None:
    """Return what is fitted of one detection, and what is known of it; None if that is nothing.

    The pixels of the marker and of its quiet zone, as far as the detected corners tell; ``reach``
    is how far sharpening carries in px.
    """
    padding = PADDING_PX + reach
    dictionary, _, margin = detections.markers[i]
    modules = module_count(dictionary)
    corners = detections.corners[i]
    side = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())
    on_board = None if detections.on_board is None else detections.on_board[i]
    ring = margin if on_board is None else clear_modules(on_board)
    ring = min(max(ring, overhang(dictionary) + 0.5), overhang(dictionary) + RING_MODULES)
    to_modules = _homography(corners, modules)
    if not np.isfinite(to_modules).all() or not side > 0:
        return None
    outline = np.array([[-ring, -ring], [modules + ring, -ring], [modules + ring] * 2,
                        [-ring, modules + ring]])
    pixels = _mapped(np.asarray(np.linalg.inv(to_modules), dtype=np.float64), outline)
    image, origin = detections.images[i], detections.origins[i]
    low = np.floor(pixels.min(axis=0) - padding).astype(np.int64)
    high = np.ceil(pixels.max(axis=0) + padding).astype(np.int64) + 1
    # A detection may be much wider in the plane than the image that was searched.
    low = np.maximum(low, origin - math.ceil(padding))
    high = np.minimum(high, origin + image.shape[::-1] + math.ceil(padding))
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
    optics = detections.cameras.optics(i)
    local = optics.intrinsics.copy()
    local[2:] -= low
    optics = Optics(local, optics.lens, optics.distorted)
    extent = math.ceil(4.0 * (ring + MODELLED_PX * modules / side)) / 4.0
    around = (
        edges_alone(detections.markers[i], extent) if on_board is None
        else surroundings(on_board, extent)
    )
    marker = MarkerView(
        around, np.repeat([-extent, modules + extent], 2), float(modules),
        float(detections.size_m[i]), optics, 1.0,
    )
    to_modules[:, 2] += to_modules[:, :2] @ low
    at, spans = _fitted_pixels(
        to_modules, float(modules), ring, height, width, np.array([left, top, right, bottom])
    )
    return PhotographView(marker, levels, spans, rays_of(optics, height, width), at, PANEL_PX)


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


def _homography(corners: Floats, modules: float) -> Floats:
    """Return the homography (3, 3) that takes the corners (4, 2) to the square's, in modules."""
    square = modules * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    middle = corners.mean(axis=0)
    rows = []
    for (x, y), (u, v) in zip((corners - middle).tolist(), square.tolist(), strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y, u])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y, v])
    system_of = np.array(rows)
    try:
        solution = np.linalg.solve(system_of[:, :8], system_of[:, 8])
    except np.linalg.LinAlgError:
        return np.full((3, 3), np.nan)
    homography = np.append(solution, 1.0).reshape(3, 3)
    homography[:, 2] -= homography[:, :2] @ middle
    return homography


def _mapped(homography: Floats, points: Floats) -> Floats:
    """Return the images (..., 2) of points (..., 2); NaN behind the horizon."""
    flat = points @ homography[:, :2].T + homography[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(flat[..., 2:] > 0, flat[..., :2] / flat[..., 2:], np.nan)


@compiled
def binned_photograph(view: PhotographView) -> PhotographView:
    """Return the view of the means of 2 x 2 pixels; an odd last row or column is left out."""
    height, width = view.levels.shape[0] // 2, view.levels.shape[1] // 2
    intrinsics = np.empty(4)
    for k in range(2):
        intrinsics[k] = 0.5 * view.marker.optics.intrinsics[k]
        intrinsics[2 + k] = 0.5 * (view.marker.optics.intrinsics[2 + k] + 0.5) - 0.5
    optics = Optics(intrinsics, view.marker.optics.lens, view.marker.optics.distorted)
    levels, spans = np.empty((height, width)), np.empty((height, 2), dtype=np.int64)
    at, rays = np.empty((2, height, width)), np.empty((6, height, width))
    for i in range(height):
        first = max(view.spans[2 * i, 0], view.spans[2 * i + 1, 0])
        last = min(view.spans[2 * i, 1], view.spans[2 * i + 1, 1])
        spans[i, 0] = (first + 1) // 2
        spans[i, 1] = max(last // 2, spans[i, 0])
        _halve(view.levels[2 * i], view.levels[2 * i + 1], 0.25, levels[i])
        for k in range(2):
            _halve(view.at[k, 2 * i], view.at[k, 2 * i + 1], 0.25, at[k, i])
        for k in range(6):
            _halve(
                view.rays[k, 2 * i], view.rays[k, 2 * i + 1], 0.25 if k < 2 else 0.125, rays[k, i]
            )
    marker = MarkerView(
        view.marker.edges, view.marker.extent, view.marker.modules, view.marker.size_m, optics,
        view.marker.variance,
    )
    return PhotographView(marker, levels, spans, rays, at, COARSE_PANEL_PX)


@compiled
def _halve(row: Floats, other: Floats, share: float, out: Floats) -> None:
    """Write the sums of 2 x 2 neighbours of two rows, times ``share``."""
    for j in range(len(out)):
        out[j] = share * (row[2 * j] + row[2 * j + 1] + other[2 * j] + other[2 * j + 1])
