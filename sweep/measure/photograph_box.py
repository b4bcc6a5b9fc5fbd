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


def photograph_view(
    detections: Detections, i: int, square: Floats, reach: float
) -> PhotographView | None:
    """Return what is fitted of one detection, and what is known of it; None if that is nothing.

    The pixels of the marker and of its quiet zone, as far as the detected corners tell: ``square``
    (3, 3) is the homography of the unit square to them. ``reach`` is how far sharpening carries in
    px.
    """
    padding = PADDING_PX + reach
    dictionary, _, margin = detections.markers[i]
    modules = module_count(dictionary)
    corners = detections.corners[i].tolist()
    side = 0.25 * sum(math.dist(corners[k - 1], corners[k]) for k in range(4))
    on_board = None if detections.on_board is None else detections.on_board[i]
    ring = margin if on_board is None else clear_modules(on_board)
    ring = min(max(ring, overhang(dictionary) + 0.5), overhang(dictionary) + RING_MODULES)
    if not np.isfinite(square).all() or np.linalg.det(square) == 0.0:
        return None
    to_pixels = square / [modules, modules, 1.0]
    to_modules = np.asarray(np.linalg.inv(to_pixels), dtype=np.float64)
    low_end, high_end = -ring, modules + ring
    outline = to_pixels @ np.array([
        [low_end, high_end, high_end, low_end], [low_end, low_end, high_end, high_end], [1.0] * 4,
    ])
    if not (outline[2] > 0.0).all():
        return None  # part of it is behind the horizon
    pixels = (outline[:2] / outline[2]).T
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
