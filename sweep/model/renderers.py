"""The renderers: ``exact``, ``warp`` and ``supersample-N`` behind one signature."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model import board, coverage, lens
from sweep.model.board import Board, extent_of
from sweep.model.effects import MarkerView, after_step
from sweep.model.exposure import WARP_PX_PER_MODULE, marker_exposure
from sweep.model.image_file import decode_grey, photograph_image
from sweep.model.marker import modules, overhang
from sweep.model.polygon import Optics, Projection
from sweep.model.scene import RENDERERS, SUPERSAMPLE, Box, Scenes
from sweep.model.sensor import BLOCK_PX, bloomed, compressed, digitise
from sweep.typing import Floats, Grey, Masks

# --------------------------------------------------------------------------------------------------
# From the light on the pixels to the image: the sensor, then the camera's own processing.

def sensed_window(scenes: Scenes, row: int, window: Box) -> Box:
    """Return the pixels that must be computed for those of ``window`` to be the frame's own.

    Whole blocks of the effects that have them, counted from the frame's corner, and around them
    what demosaicing needs, from an even column and row on; clipped at the frame.
    """
    for effect in reversed(scenes.effects.active_in(row)):
        if effect.reach_px or effect.block_px > 1:
            left, top, right, bottom = window
            window = _aligned(scenes, row, (
                left - effect.reach_px, top - effect.reach_px,
                right + effect.reach_px, bottom + effect.reach_px,
            ), max(effect.block_px, 2))
    return window


def _aligned(scenes: Scenes, row: int, window: Box, step: int) -> Box:
    """Return a window that begins and ends at multiples of ``step``, or with the frame."""
    left, top, right, bottom = window
    width, height = scenes.frame[row].tolist()
    return (
        max(left // step * step, 0), max(top // step * step, 0),
        min(-(-right // step) * step, width), min(-(-bottom // step) * step, height),
    )


def sensed(
    scenes: Scenes, row: int, levels: Floats, overshoot: Floats | None, computed: Box, window: Box
) -> Grey:
    """Return the image of ``window``, from levels of light (h, w) of the pixels ``computed``.

    In this order: uneven light; electrons, gain and noise; plug-ins' effects on the signal;
    demosaicing; ``overshoot`` (h, w), what sharpening adds to the levels of light; tone; noise by
    level; quantisation; JPEG. Sharpening is linear: it commutes with gain and, for even light, with
    all before it but the noise, which it leaves as it is.

    ``computed`` is :func:`sensed_window` of ``window``.
    """
    effects = scenes.effects.active_in(row)
    patch = scenes.patch(row, *computed[:2])
    light = after_step(effects, "light", levels, patch)
    if overshoot is not None:
        # An effect on the light changes the contrast: sharpening, which follows it, sees that.
        overshoot = after_step(effects, "light", levels + overshoot, patch) - light
    levels = after_step(effects, "signal", light, patch)
    levels = after_step(effects, "colour", levels, patch)
    if overshoot is not None:
        levels = levels + patch.values["gain"] * overshoot
    levels = after_step(effects, "response", levels, patch)
    image = np.empty(levels.shape, dtype=np.uint8)
    digitise(levels, int(patch.values["bit_depth"]), image)
    quality = int(patch.values["jpeg_quality"])
    if quality:
        blocks = _aligned(scenes, row, window, BLOCK_PX)
        image, computed = compressed(_cut(image, computed, blocks), quality), blocks
    return _cut(image, computed, window)


def _cut(image: Grey, computed: Box, window: Box) -> Grey:
    """Return the pixels of ``window`` from those of ``computed`` around it."""
    left, top = computed[:2]
    return np.ascontiguousarray(
        image[window[1] - top : window[3] - top, window[0] - left : window[2] - left]
    )


# --------------------------------------------------------------------------------------------------
# The renderers: ``exact``, ``warp`` and ``supersample-N`` behind one signature.

#: Renderer of scenes whose background is a photograph that shows the marker already.
PHOTOGRAPH = "photograph"


@lru_cache(maxsize=16)
def background_image(path: str) -> Grey:
    """Return an image file as grey levels (height, width); raises ValueError if it is not one."""
    grey = decode_grey(path)
    grey.setflags(write=False)
    return grey


def quantise(levels: NDArray[Any]) -> Grey:
    """Return grey levels rounded to 8 bits (half up, as ``coverage.sum_grey``) and clipped."""
    shifted = levels + (0.5 + coverage.ROUNDING_SNAP)
    return np.clip(shifted, 0.0, 255.0).astype(np.uint8)


def render(scenes: Scenes, row: int, marker_box: NDArray[np.int64], window: Box) -> Grey:
    """Return the image of one scene; as :func:`render_all`."""
    return render_all(scenes, np.array([row]), marker_box[None], np.array([window]))[0]


def render_all(
    scenes: Scenes, rows: NDArray[np.intp], boxes: NDArray[np.int64], windows: NDArray[np.int64]
) -> list[Grey]:
    """Return the images of scenes ``rows`` (n,) in their ``windows`` (n, 4), quantised once.

    ``boxes`` (n, 4) hold all pixels that the markers may touch; the renderer sees only them, so
    that no image depends on its window. Raises ValueError if a window does not hold its box.
    """
    lost = ((boxes[:, :2] < windows[:, :2]) | (boxes[:, 2:] > windows[:, 2:])).any(axis=1)
    lost &= boxes[:, 2] > boxes[:, 0]
    if lost.any():
        window, box = windows[lost][0].tolist(), boxes[lost][0].tolist()
        raise ValueError(f"window {window} does not hold the marker's box {box}")
    plain = scenes.plain(rows)
    if plain.all():
        return _draw(scenes, rows, boxes, windows)
    return [
        _draw(scenes, rows[i : i + 1], boxes[i : i + 1], windows[i : i + 1])[0] if plain[i]
        else _compose(scenes, int(rows[i]), boxes[i].tolist(), windows[i].tolist())
        for i in range(len(rows))
    ]


def _compose(scenes: Scenes, row: int, box: Sequence[int], window: Sequence[int]) -> Grey:
    """Return the image of a scene with any renderer and any background."""
    asked = window[0], window[1], window[2], window[3]
    background, active = scenes.background[row], bool(scenes.effects.active[row])
    if scenes.renderer[row] == PHOTOGRAPH:
        photograph = photograph_image(str(background))
        if window == [0, 0, photograph.shape[1], photograph.shape[0]]:
            return photograph  # the same array for all its markers: it is searched once
        return photograph[window[1] : window[3], window[0] : window[2]].copy()
    left, top, right, bottom = computed = sensed_window(scenes, row, asked) if active else asked
    x0, y0, x1, y1 = marker_box = (box[0], box[1], box[2], box[3])
    inner = np.s_[y0 - top : y1 - top, x0 - left : x1 - left]
    even = not isinstance(background, str)
    behind = (
        np.full((bottom - top, right - left), float(background)) if even
        else background_image(str(background))[top:bottom, left:right]
    )
    if not active:
        image = quantise(behind)
        if x1 > x0:
            image[inner] = (
                _warp_grey(scenes, row, marker_box) if even and scenes.renderer[row] == "warp"
                else quantise(_exposed(scenes, row, marker_box, behind[inner]))
            )
        return image
    levels, overshoot, effect = behind.astype(np.float64), None, scenes.effects.of(row)
    if x1 > x0:
        plain = _exposed(scenes, row, marker_box, levels[inner])
        if effect["sharpening"] != 0:
            wide = _exposed(scenes, row, marker_box, levels[inner], blurred=True)
            overshoot = np.zeros(levels.shape)
            overshoot[inner] = effect["sharpening"] * (plain - wide)
        levels[inner] = plain
    if effect["bloom"] != 0:
        _, black, white = scenes.levels[row].tolist()
        levels = bloomed(levels, black, white, effect["bloom"])
    return sensed(scenes, row, levels, overshoot, computed, asked)


def _exposed(
    scenes: Scenes, row: int, box: Box, behind: NDArray[Any], blurred: bool = False
) -> NDArray[np.float64]:
    """Return the levels (h, w) of ``box`` over those ``behind`` it, with the effects on edges.

    With ``blurred`` those that sharpening subtracts.
    """
    if scenes.renderer[row] == "exact" and not isinstance(scenes.background[row], str):
        areas = np.array([*scenes.levels[row], scenes.effects["occluder"][row]])
        return marker_exposure(scenes, row, box, areas, blurred)
    mean, share = marker_levels(scenes, row, box, blurred)
    return np.asarray(mean + (1.0 - share) * behind)


def _draw(
    scenes: Scenes, rows: NDArray[np.intp], boxes: NDArray[np.int64], windows: NDArray[np.int64]
) -> list[Grey]:
    """Return the exact images on a plain background, all in one call: the common, fast case."""
    size = windows[:, 2:] - windows[:, :2]
    stops = np.cumsum(size[:, 0] * size[:, 1])
    starts = stops - size[:, 0] * size[:, 1]
    images = np.empty(stops[-1], dtype=np.uint8)
    box = boxes[:, 2:] - boxes[:, :2]
    scratch = np.zeros(int(((box[:, 0] + 2) * box[:, 1]).max()))
    cameras = scenes.cameras
    coverage.draw_greys(
        images, starts, windows, boxes, scratch, rows, *board.edge_table(scenes.targets.boards),
        scenes.targets.number, scenes.levels, scenes.plane, cameras.view, cameras.lenses,
        cameras.distorted if cameras.distorted.any() else None,
    )
    heights = size[:, 1].tolist()
    return [
        images[start:stop].reshape(height, -1)
        for start, stop, height in zip(starts.tolist(), stops.tolist(), heights, strict=True)
    ]


def marker_levels(
    scenes: Scenes, row: int, box: Box, blurred: bool = False
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the marker's levels before quantisation, and its share of each pixel of ``box``.

    Both (height, width); the part of a pixel that the marker does not cover counts as level 0.
    """
    renderer, target = scenes.renderer[row], scenes.targets[row]
    black, white = scenes.levels[row, 1:].tolist()
    if renderer in scenes.effects.plugins.renderers:
        return scenes.effects.plugins.renderers[renderer](_marker_view(scenes, row, box))
    if renderer == "exact":
        areas = np.array([0.0, black, white, scenes.effects["occluder"][row]])
        ones = np.array([0.0, 1.0, 1.0, 1.0])
        mean, share = (
            marker_exposure(scenes, row, box, levels, blurred) for levels in (areas, ones)
        )
    elif renderer == "warp":
        mean, share = (
            _warped(scenes, row, box, warp_bitmap(target, *levels)).astype(np.float64)
            for levels in ((black, white), (1.0, 1.0))
        )
    else:
        match = SUPERSAMPLE.fullmatch(renderer)
        if match is None:
            raise ValueError(f"renderer = {renderer!r}: expected {RENDERERS}")
        mean, share = np.empty((2, box[3] - box[1], box[2] - box[0]))
        supersample(
            mean, share, _sampled_marker(scenes, row), int(match[1]), match[2] is not None,
            box[0], box[1],
        )
    return mean, share


_NO_MODULES = np.empty((0, 0), dtype=bool)
_NO_EDGES = np.empty((0, 6))


def _sampled_marker(scenes: Scenes, row: int) -> SampledMarker:
    """Return the marker or the board of a scene as samples see it."""
    key = scenes.targets[row]
    inverse = np.linalg.inv(scenes.plane[row])
    levels, optics = scenes.levels[row], scenes.cameras.optics(row)
    if key.margin is None:
        return SampledMarker(_NO_MODULES, 0.0, *_board_table(key), levels, inverse, optics)
    beyond = overhang(key.dictionary)
    inverse[:2] += beyond * inverse[2]
    bits = modules(key.dictionary, key.marker_ids[0])
    return SampledMarker(bits, key.margin - beyond, _NO_EDGES, _NO_EDGES, levels, inverse, optics)


@lru_cache(maxsize=16)
def _board_table(target: Board) -> tuple[Floats, Floats]:
    """Return the edges (E, 6) and the prints (P, 6) of a board, as `SampledMarker` has them."""
    tables, prints, first = [], [], 0
    for each in (*target.prints, *target.distractors):
        outline = board.edges_on_sheet([each])
        ends = outline.ends / board.unit_m(target)
        points = ends.reshape(-1, 2)
        tables.append(np.hstack([ends, outline.sides]))
        prints.append([first, first + len(ends), *points.min(axis=0), *points.max(axis=0)])
        first += len(ends)
    return np.concatenate(tables), np.array(prints, dtype=np.float64)


def _marker_view(scenes: Scenes, row: int, box: Box) -> MarkerView:
    """Return the marker of a scene as renderers of plug-ins get it."""
    _, black, white = scenes.levels[row].tolist()
    distorted = bool(scenes.cameras.distorted[row])
    key = scenes.targets[row]
    beyond = overhang(key.dictionary)
    from_whole = np.array([[1.0, 0.0, -beyond], [0.0, 1.0, -beyond], [0.0, 0.0, 1.0]])
    return MarkerView(
        np.array(modules(key.dictionary, key.marker_ids[0])),
        (key.margin or 0.0) - beyond, black, white, scenes.plane[row] @ from_whole,
        scenes.cameras.matrix(row), scenes.cameras.lenses[row, :14].copy() if distorted else None,
        box, {name: float(scenes.effects[name][row]) for name in scenes.effects.plugins.settings},
    )


#: The most pixels of a board's bitmap, which take 0.5 GB while it is drawn.
MAX_BITMAP_PX = 25_000_000

#: The longest side of what ``cv2.warpPerspective`` takes, whose coordinates are 16-bit integers.
MAX_BITMAP_SIDE = 32_766


@lru_cache(maxsize=1024)
def warp_bitmap(target: Board, black: float, white: float) -> NDArray[np.float32]:
    """Return a print's bitmap (height, width) at 10 px a module, for ``renderer = "warp"``.

    Pixels on edges have the mean of their area, beside the print 0. ValueError if it would be too
    large.
    """
    left, top, right, bottom = extent_of(target).sheet.tolist()
    scale = float(WARP_PX_PER_MODULE)
    height, width = (math.ceil(scale * each) for each in (bottom - top, right - left))
    if max(height, width) > MAX_BITMAP_SIDE or height * width > MAX_BITMAP_PX:
        raise ValueError(f"warp draws bitmaps of at most {MAX_BITMAP_PX:,} pixels and a side of "
                         f"{MAX_BITMAP_SIDE:,}; this board takes {width:,} x {height:,}")
    plane = np.array([
        [scale, 0.0, -left * scale - 0.5], [0.0, scale, -top * scale - 0.5], [0.0, 0.0, 1.0]
    ])
    cover, bitmap = np.zeros((height, width + 2)), np.empty((height, width))
    optics = Optics(np.array([1.0, 1.0, 0.0, 0.0]), lens.pack(()), False)
    coverage.accumulate(
        cover, board.edges_of(target), np.array([0.0, black, white]), Projection(plane, optics),
        0, 0, None, None,
    )
    coverage.sum_levels(cover, 0.0, bitmap)
    return bitmap.astype(np.float32)


@lru_cache(maxsize=1024)
def _grey_bitmap(target: Board, black: float, white: float, behind: float) -> Grey:
    """As :func:`warp_bitmap`, in 8 bits; ``behind`` is the level between a board's sheets."""
    share = warp_bitmap(target, 1.0, 1.0)
    return quantise(warp_bitmap(target, black, white).astype(np.float64) + (1.0 - share) * behind)


def _warped(
    scenes: Scenes, row: int, box: Box, bitmap: NDArray[Any], border: int = 0
) -> NDArray[Any]:
    """Take the paper's steps 7 and 8: OpenCV warps the bitmap to the corners projected in step 6.

    A bitmap's pixels have their edges at halves; beyond it is the level ``border``.
    """
    extent, corners = extent_of(scenes.targets[row]), scenes.corners_px[row] - box[:2]
    square = (extent.ink - np.tile(extent.sheet[:2], 2)) * WARP_PX_PER_MODULE - 0.5
    transform = cv2.getPerspectiveTransform(
        board.rectangles(square[None])[0].astype(np.float32), corners.astype(np.float32)
    )
    return cv2.warpPerspective(
        bitmap, transform, (box[2] - box[0], box[3] - box[1]), flags=cv2.INTER_LINEAR,
        borderValue=(border,),
    )


def _warp_grey(scenes: Scenes, row: int, box: Box) -> Grey:
    """Take the paper's steps 5-8: only the corners are projected, and OpenCV warps the bitmap."""
    background, black, white = scenes.levels[row].tolist()
    target = scenes.targets[row]
    bitmap = _grey_bitmap(target, black, white, 0.0 if target.is_marker else background)
    border = int(background + (0.5 + coverage.ROUNDING_SNAP))
    return np.asarray(_warped(scenes, row, box, bitmap, border))


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
    bits = coverage.mixed(np.uint64(key) * np.uint64(0x9E3779B97F4A7C15))
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
    cells, quiet, _, _, levels, inverse, optics = marker
    intrinsics, distortion = optics.intrinsics, optics.lens
    n = cells.shape[0]
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
                    x, y, converged = lens.undistort(x, y, distortion)
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
                    white = cells[int(line), int(column)]
                level += levels[2] if white else levels[1]
            mean[i, j] = level / total
            share[i, j] = hits / total


# --------------------------------------------------------------------------------------------------
# Which pixels show what stands beside a target.

#: Share of a pixel that counts: less is rounding.
_SHARE = 1e-9


def beside_pixels(scenes: Scenes, row: int, box: Box) -> Masks:
    """Return (height, width) which pixels of a box of one scene a distractor touches.

    With blur and motion, and the pixels next to these: to renderers that are not exact, and to
    what mixes neighbours, it is not sharper.
    """
    key = scenes.targets[row]
    if not key.distractors:
        return np.zeros((box[3] - box[1], box[2] - box[0]), dtype=bool)
    share = marker_exposure(scenes, row, box, np.array([0.0, 1.0, 1.0, 0.0]), beside=True)
    touched = (np.abs(share) > _SHARE).astype(np.uint8)
    return np.asarray(cv2.dilate(touched, np.ones((3, 3), dtype=np.uint8)) > 0)
