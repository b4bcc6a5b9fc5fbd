"""The image under blur, motion, rolling shutter and occlusion, exact or by brute force."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model import coverage
from sweep.model.coverage import NODES, REACH, WEIGHTS, mixed
from sweep.model.extent import (
    MovingMarker,
    corner_depths,
    moved_plane,
    moving_marker,
    outline_extent,
    path_px,
    spread_px,
)
from sweep.model.lens import undistort
from sweep.model.polygon import Optics, Projection
from sweep.model.printed import edges_of, occluded_edges
from sweep.model.scene import Box, Scenes
from sweep.model.scene_sheet import accumulate_solid, scene_sheet
from sweep.model.sheet import FLAT, Sheet
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# The exact image of a marker under blur, motion, rolling shutter and occlusion, unquantised.

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
    key = scenes.target(row)
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


# --------------------------------------------------------------------------------------------------
# The image by brute force: N x N samples a pixel, each traced back through lens and pose.

class SampledMarker(NamedTuple):
    """A marker or a board as its samples see it.

    Attributes
    ----------
    modules
        (n, n) True for white; (0, 0) of a board.
    quiet
        Width of the quiet zone in modules.
    outlines
        (E, 6) of a board: ends of its edges, and the code of the areas on their two sides.
    prints
        (P, 6) of a board: first and past-the-end row of each print's edges, and left, top, right,
        bottom of the print.
    levels
        (3,) grey levels of outside, black and white.
    inverse
        (3, 3) takes undistorted normalised image coordinates to module coordinates.
    optics
        The camera.
    """

    modules: NDArray[np.bool_]
    quiet: float
    outlines: Floats
    prints: Floats
    levels: Floats
    inverse: Floats
    optics: Optics


@compiled
def _unit(key: int) -> float:
    """Return a number in [0, 1) that depends on ``key`` alone."""
    bits = mixed(np.uint64(key) * np.uint64(0x9E3779B97F4A7C15))
    return np.float64(bits >> np.uint64(11)) * 2.0**-53


@compiled
def _on_board(column: float, line: float, marker: SampledMarker) -> tuple[float, float]:
    """Return the level of a board's point, beside the board 0, and whether the board has it.

    The sum of the jumps at the edges to the left of the point, of the prints around it.
    """
    levels = marker.levels
    level, inside = 0.0, 0.0
    for each in marker.prints:
        if not (each[2] <= column < each[4] and each[3] <= line < each[5]):
            continue
        for k in range(int(each[0]), int(each[1])):
            x0, y0, x1, y1 = marker.outlines[k, :4]
            if not min(y0, y1) <= line < max(y0, y1):
                continue
            if x0 + (x1 - x0) * (line - y0) / (y1 - y0) <= column:
                down = 1.0 if y1 > y0 else -1.0
                a, b = int(marker.outlines[k, 4]), int(marker.outlines[k, 5])
                level += down * ((levels[b] if b > 0 else 0.0) - (levels[a] if a > 0 else 0.0))
                inside += down * (min(b, 1) - min(a, 1))
    return level, inside


@compiled
def supersample(
    mean: Floats, share: Floats, marker: SampledMarker, per_side: int, jittered: bool, left: int,
    top: int,
) -> None:
    """Write the mean level of the marker's samples to ``mean`` and their share to ``share``.

    Both are (height, width), of the box whose top left pixel is (``left``, ``top``). ``mean``
    counts samples beside the marker as level 0, so that a pixel's level is
    ``mean + (1 - share) * background``. Samples lie in the middle of N x N cells of the pixel or,
    if ``jittered``, at random within them.
    """
    modules, quiet, _, _, levels, inverse, optics = marker
    intrinsics, lens = optics.intrinsics, optics.lens
    n = modules.shape[0]
    total = per_side * per_side
    for i in range(mean.shape[0]):
        for j in range(mean.shape[1]):
            level, hits = 0.0, 0.0
            for k in range(total):
                offset_x, offset_y = 0.5, 0.5
                if jittered:
                    key = (((top + i) * 131072 + left + j) * total + k) * 2 + 1
                    offset_x, offset_y = _unit(key), _unit(key + 1)
                u = left + j - 0.5 + (k % per_side + offset_x) / per_side
                v = top + i - 0.5 + (k // per_side + offset_y) / per_side
                x, y = (u - intrinsics[2]) / intrinsics[0], (v - intrinsics[3]) / intrinsics[1]
                if optics.distorted:
                    x, y, converged = undistort(x, y, lens)
                    if not converged:
                        continue
                w = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2]
                if not w > 0.0:
                    continue
                column = (inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2]) / w
                line = (inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2]) / w
                if n == 0:
                    seen, inside = _on_board(column, line, marker)
                    level, hits = level + seen, hits + inside
                    continue
                if not (-quiet <= column < n + quiet and -quiet <= line < n + quiet):
                    continue
                hits += 1
                white = True
                if 0.0 <= column < n and 0.0 <= line < n:
                    white = modules[int(line), int(column)]
                level += levels[2] if white else levels[1]
            mean[i, j] = level / total
            share[i, j] = hits / total
