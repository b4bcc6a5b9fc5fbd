"""The exact image of a marker under blur, motion, rolling shutter and occlusion, unquantised."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model import coverage
from sweep.model.extent import corner_depths, outline_modules, path_px, spread_px
from sweep.model.marker import edges, occluded_edges
from sweep.model.motion import moved, outline_extent
from sweep.model.scene import Box, Scenes
from sweep.typing import Floats

SHARP_PANEL_PX = 3 / 16
"""Path of a corner between groups of three instants: kinks of the mean over the exposure then
cost at most 0.12 grey levels."""

MAX_PANELS = 4093
MAX_ROW_PANELS = 509
"""Most panels of an exposure, and of each row's; primes, so that no turn falls in with them."""

SHARPEST_PX = 0.05
"""Least point spread that is computed where defocus varies (a quarter of it where it does not);
between it and none the image is interpolated, at a cost of at most 0.8 (0.2) grey levels in
single pixels."""

SPREAD_RATIO = 1.4
"""Ratio of neighbouring point spreads where defocus varies; cubic interpolation in their
logarithm then costs at most 0.1 grey levels."""


def marker_exposure(scenes: Scenes, row: int, box: Box, levels: Floats) -> Floats:
    """Return the levels (height, width) of ``box``, from levels (4,) of the four areas.

    The areas are what lies outside, black, white and the occluding sheet.
    """
    effect = scenes.effect(row)
    marker = scenes.markers[scenes.marker[row]]
    outlines = (
        occluded_edges(marker, effect["occlusion"], effect["occlusion_deg"])
        if effect["occlusion"] > 0 else edges(*marker)
    )
    motion = scenes.motion(row)
    plane = scenes.plane[row]
    spread, varies = _spreads(scenes, row, box)
    path = path_px(scenes, row, box)
    outline = outline_modules(scenes, row)
    shape = (len(spread), box[3] - box[1], box[2] - box[0])
    images = np.empty(shape)
    cover = np.zeros((shape[1], shape[2] + 2))
    exposure_s, row_time_s, velocity = (0.0, 0.0, np.zeros(6)) if motion is None else motion
    for image, sigma in zip(images, spread, strict=True):
        panel = max(SHARP_PANEL_PX, 1.5 * sigma)
        panels = math.ceil(min(path / panel, MAX_PANELS if row_time_s == 0 else MAX_ROW_PANELS))
        _expose(
            cover, outline, outlines.ends, outlines.sides, levels, plane, scenes.translation[row],
            scenes.cameras.view[row], scenes.cameras.lenses[row],
            bool(scenes.cameras.distorted[row]), box[0], box[1], sigma, velocity, exposure_s,
            panels, row_time_s, (scenes.frame[row, 1] - 1) / 2,
        )
        coverage.sum_levels(cover, levels[0], image)
    if not varies:
        return np.asarray(images[0])
    return _focused(images, np.array(spread), defocus_px(scenes, row, box))


@compiled
def _expose(
    cover: Floats, outline: Floats, ends: Floats, sides: NDArray[np.int64], levels: Floats,
    plane: Floats, translation: Floats, view: Floats, lens: Floats, distorted: bool, left: int,
    top: int, sigma: float, velocity: Floats, exposure_s: float, panels: int, row_time_s: float,
    middle_row: float,
) -> None:
    """Add a marker's edges to ``cover``, averaged over each row's exposure.

    By three Gauss-Legendre nodes on each of ``panels`` parts of the exposure; 0 where nothing
    moves while a row is exposed. Instants at which no part of the marker, whose ``outline`` (M, 2)
    is in module coordinates, is seen by the rows that are exposed cost next to nothing.
    """
    groups = cover.shape[0] if row_time_s > 0.0 else 1
    for group in range(groups):
        rows = cover[group : group + 1] if row_time_s > 0.0 else cover
        begin = row_time_s * (top + group - middle_row)
        for panel in range(max(panels, 1)):
            for node in range(3 if panels > 0 else 1):
                offset, weight = coverage.NODES[node], coverage.WEIGHTS[node]
                if panels == 0:
                    offset, weight = 0.5, 1.0
                instant = begin + exposure_s * ((panel + offset) / max(panels, 1) - 0.5)
                placed = moved(plane, translation, velocity, instant) if instant != 0.0 else plane
                seen = _is_seen(
                    placed, outline, view, lens, distorted, left, top + group, rows.shape[0],
                    rows.shape[1] - 2, coverage.REACH * sigma + 2.0,
                )
                if not seen:
                    continue
                coverage.accumulate(
                    rows, ends, sides, levels * (weight / max(panels, 1)), placed, view, lens,
                    distorted, left, top + group, sigma,
                )


@compiled
def _is_seen(
    plane: Floats, outline: Floats, view: Floats, lens: Floats, distorted: bool, left: int,
    top: int, height: int, width: int, margin: float,
) -> bool:
    """Tell whether a marker is in front of the camera and within ``margin`` px of a box."""
    extent = np.empty(4)
    behind, _ = outline_extent(plane, view, lens, distorted, outline, extent)
    return (
        behind == 0
        and extent[2] - left > -margin and extent[0] - left < width + margin
        and extent[3] - top > -margin and extent[1] - top < height + margin
    )


def defocus_px(scenes: Scenes, row: int, box: Box) -> Floats:
    """Return the point spread's standard deviation (height, width) at the marker's depth.

    That of its plane in a pixel's direction, whose inverse is linear in the image.
    """
    fx, fy, cx, cy = scenes.cameras.view[row]
    normal = scenes.rotation[row][:, 2]
    x = (np.arange(box[0], box[2]) - cx) / fx
    y = (np.arange(box[1], box[3]) - cy) / fy
    inverse = (normal[0] * x + normal[1] * y[:, None] + normal[2]) / (
        normal @ scenes.translation[row]
    )
    # Beyond the marker its plane may come near the camera, or end: there is nothing to be blurred.
    depth = corner_depths(scenes, row)
    return spread_px(scenes, row, np.clip(inverse, 1 / depth.max(), 1 / depth.min()))


def _spreads(scenes: Scenes, row: int, box: Box) -> tuple[list[float], bool]:
    """Return the point spreads to be computed, in order, and whether they vary over the box."""
    over = defocus_px(scenes, row, box)
    low, high = float(over.min()), float(over.max())
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
