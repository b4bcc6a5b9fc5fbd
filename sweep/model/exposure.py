"""The exact image of a marker under blur, motion, rolling shutter and occlusion, unquantised."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sweep.compilation import compiled
from sweep.model import coverage
from sweep.model.extent import corner_depths, moving_marker, path_px, spread_px
from sweep.model.motion import MovingMarker, moved_plane, outline_extent
from sweep.model.point_spread import NODES, REACH, WEIGHTS
from sweep.model.printed import edges_of, occluded_edges
from sweep.model.projection import Projection
from sweep.model.scene import Box, Scenes
from sweep.model.scene_sheet import scene_sheet
from sweep.model.sheet import FLAT, Sheet
from sweep.model.solid_scene import accumulate_solid
from sweep.typing import Floats

SHARP_PANEL_PX = 3 / 16
"""Path of a corner between groups of three instants: the error at kinks of the mean over the
exposure is then at most 0.12 grey levels."""

MAX_PANELS = 4093
MAX_ROW_PANELS = 509
"""Most panels of an exposure, and of each row's; primes, so that they resonate with no turn."""

SHARPEST_PX = 0.05
"""Smallest point spread that is computed if defocus varies over the image (a quarter of it if it
does not); between 0 and this the image is interpolated, with an error of at most 0.8 (0.2) grey
levels in single pixels."""

SPREAD_RATIO = 1.4
"""Ratio of neighbouring point spreads if defocus varies; the error of cubic interpolation in their
logarithm is then at most 0.1 grey levels."""


class Shutter(NamedTuple):
    """When the rows of a frame are exposed.

    Attributes
    ----------
    exposure_s, row_time_s
        Duration of each row's exposure, and time from one row's to the next's.
    middle_row
        The row whose exposure has its middle at time 0.
    panels
        Parts into which the exposure is divided for integration; 0 if nothing moves during it.
    """

    exposure_s: float
    row_time_s: float
    middle_row: float
    panels: int


def marker_exposure(
    scenes: Scenes, row: int, box: Box, levels: Floats, added_px: float = 0.0
) -> Floats:
    """Return the levels (height, width) of ``box``, from levels (4,) of the four areas.

    The areas are outside, black, white and the occluding sheet. ``added_px`` is a Gaussian's
    standard deviation that the point spread is widened by, in quadrature.
    """
    effect = scenes.effect(row)
    if scenes.solid[row]:
        return _solid_exposure(scenes, row, box, levels, math.hypot(effect["blur_px"], added_px))
    key = scenes.markers[scenes.marker[row]]
    outlines = (
        occluded_edges(key, effect["occlusion"], effect["occlusion_deg"])
        if effect["occlusion"] > 0 else edges_of(key)
    )
    motion = scenes.motion(row)
    wanted = defocus_px(scenes, row, box, added_px)
    spread, varies = _spreads(wanted)
    even = not varies and math.isnan(effect["aperture_mm"])
    sheet = scene_sheet(scenes, row)
    if motion is None and even and sheet is not None:
        image = np.empty((box[3] - box[1], box[2] - box[0]))
        cover = np.zeros((image.shape[0], image.shape[1] + 2))
        coverage.accumulate_curved(
            cover, outlines, levels, scenes.projection(row), box[0], box[1], spread[0], sheet
        )
        coverage.sum_levels(cover, levels[0], image)
        return image
    if motion is None and even and not scenes.cameras.distorted[row]:
        # The same blur everywhere: without the functions of moving markers, and compiling them.
        image = np.empty((box[3] - box[1], box[2] - box[0]))
        cover = np.zeros((image.shape[0], image.shape[1] + 2))
        coverage.accumulate(
            cover, outlines, levels, scenes.projection(row), box[0], box[1], spread[0]
        )
        coverage.sum_levels(cover, levels[0], image)
        return image
    path = path_px(scenes, row, box)
    shape = (len(spread), box[3] - box[1], box[2] - box[0])
    images = np.empty(shape)
    cover = np.zeros((shape[1], shape[2] + 2))
    exposure_s, row_time_s, velocity = (0.0, 0.0, np.zeros(6)) if motion is None else motion
    marker = moving_marker(scenes, row, velocity)
    for image, sigma in zip(images, spread, strict=True):
        panel = max(SHARP_PANEL_PX, 1.5 * sigma)
        panels = math.ceil(min(path / panel, MAX_PANELS if row_time_s == 0 else MAX_ROW_PANELS))
        shutter = Shutter(exposure_s, row_time_s, (scenes.frame[row, 1] - 1) / 2, panels)
        _expose(
            cover, marker, outlines, levels, shutter, box[0], box[1], sigma,
            FLAT if sheet is None else sheet, sheet is not None,
        )
        coverage.sum_levels(cover, levels[0], image)
    if not varies:
        return np.asarray(images[0])
    return _focused(images, np.array(spread), wanted)


def _solid_exposure(
    scenes: Scenes, row: int, box: Box, levels: Floats, blur_px: float
) -> Floats:
    """As :func:`marker_exposure`, of a board in several planes at rest, blurred evenly."""
    shape = (box[3] - box[1], box[2] - box[0])
    wanted = np.full(shape, blur_px)
    spread, varies = _spreads(wanted)
    images = np.empty((len(spread), *shape))
    for image, sigma in zip(images, spread, strict=True):
        cover = np.zeros((shape[0], shape[1] + 2))
        accumulate_solid(cover, scenes, row, levels[:3], box, sigma)
        coverage.sum_levels(cover, levels[0], image)
    return _focused(images, np.array(spread), wanted) if varies else np.asarray(images[0])


@compiled
def _expose(
    cover: Floats, marker: MovingMarker, edges: coverage.MarkerEdges, levels: Floats,
    shutter: Shutter, left: int, top: int, sigma: float, sheet: Sheet, curved: bool,
) -> None:
    """Add a marker's edges to ``cover``, averaged over each row's exposure.

    By three Gauss-Legendre nodes on each part of the exposure. Instants at which the exposed rows
    see no part of the marker cost next to nothing.
    """
    projection, panels = marker.projection, shutter.panels
    groups = cover.shape[0] if shutter.row_time_s > 0.0 else 1
    for group in range(groups):
        rows = cover[group : group + 1] if shutter.row_time_s > 0.0 else cover
        begin = shutter.row_time_s * (top + group - shutter.middle_row)
        for panel in range(max(panels, 1)):
            for node in range(3 if panels > 0 else 1):
                offset, weight = NODES[node], WEIGHTS[node]
                if panels == 0:
                    offset, weight = 0.5, 1.0
                instant = begin + shutter.exposure_s * ((panel + offset) / max(panels, 1) - 0.5)
                plane = (
                    moved_plane(projection.plane, marker.motion, instant) if instant != 0.0
                    else projection.plane
                )
                at_instant = Projection(plane, projection.optics)
                if _is_seen(
                    at_instant, marker.outline, left, top + group, rows.shape[0],
                    rows.shape[1] - 2, REACH * sigma + 2.0 + sheet.largest_px,
                ):
                    weighted = levels * (weight / max(panels, 1))
                    if curved:
                        coverage.accumulate_curved(
                            rows, edges, weighted, at_instant, left, top + group, sigma, sheet
                        )
                    else:
                        coverage.accumulate(
                            rows, edges, weighted, at_instant, left, top + group, sigma
                        )


@compiled
def _is_seen(
    projection: Projection, outline: Floats, left: int, top: int, height: int, width: int,
    margin: float,
) -> bool:
    """Return whether a marker is in front of the camera and within ``margin`` px of a box."""
    extent = np.empty(4)
    behind, _ = outline_extent(projection, outline, extent)
    return (
        behind == 0
        and extent[2] - left > -margin and extent[0] - left < width + margin
        and extent[3] - top > -margin and extent[1] - top < height + margin
    )


def defocus_px(scenes: Scenes, row: int, box: Box, added_px: float = 0.0) -> Floats:
    """Return the point spread's standard deviation (height, width) at the marker's depth.

    The depth is that of the marker's plane (of a bent one, the tangent plane at its centre) in each
    pixel's direction; its inverse is linear in the
    image. ``added_px`` widens the point spread, in quadrature.
    """
    fx, fy, cx, cy = scenes.cameras.view[row]
    normal = scenes.rotation[row][:, 2]
    x = (np.arange(box[0], box[2]) - cx) / fx
    y = (np.arange(box[1], box[3]) - cy) / fy
    inverse = (normal[0] * x + normal[1] * y[:, None] + normal[2]) / (
        normal @ scenes.translation[row]
    )
    # Beyond the marker its plane may come near the camera, or end; nothing is blurred there.
    depth = corner_depths(scenes, row)
    return spread_px(scenes, row, np.clip(inverse, 1 / depth.max(), 1 / depth.min()), added_px)


def _spreads(wanted: Floats) -> tuple[list[float], bool]:
    """Return the point spreads to compute, ascending, and whether they vary.

    ``wanted`` (height, width) are those of the pixels.
    """
    low, high = float(wanted.min()), float(wanted.max())
    even = high <= low * 1.001
    if even and (high == 0.0 or low >= SHARPEST_PX / 4):
        return [(low + high) / 2], False
    if even:
        return [0.0, SHARPEST_PX / 4], True
    spreads = [0.0] if low < SHARPEST_PX else []
    low, high = max(low, SHARPEST_PX), max(high, SHARPEST_PX)
    count = math.ceil(math.log(high / low) / math.log(SPREAD_RATIO)) + 1
    return spreads + np.geomspace(low, high, count).tolist(), True


def _focused(images: Floats, spread: Floats, wanted: Floats) -> Floats:
    """Return each pixel (height, width) at its own point spread, from images (K, height, width)."""
    first = int(spread[0] == 0.0)
    known = np.log(spread[first:])
    at = np.log(np.clip(wanted, spread[first], spread[-1]))
    count = min(4, len(known))
    start = np.clip(np.searchsorted(known, at) - count // 2, 0, len(known) - count)
    image = np.zeros_like(wanted)
    for a in range(count):
        weight = np.ones_like(wanted)
        for b in range(count):
            if b != a:
                weight *= (at - known[start + b]) / (known[start + a] - known[start + b])
        image += weight * np.take_along_axis(images[first:], (start + a)[None], axis=0)[0]
    if first:
        share = np.minimum(wanted / spread[1], 1.0)
        image = (1 - share) * images[0] + share * image
    return image
