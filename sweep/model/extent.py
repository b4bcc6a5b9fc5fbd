"""The extent of targets in the image, their areas and visibility, at rest and in motion."""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.model import lens as lens_model
from sweep.model.board import (
    along_sides,
    extent_of,
    in_space,
    own_sheets,
    rectangles,
    sheets_m,
    sheets_of,
    unseen_markers,
)
from sweep.model.coverage import REACH
from sweep.model.exposure import (
    BEHIND,
    CHORDS_PER_SIDE,
    MEANINGLESS,
    MIN_INSTANTS,
    largest_spread_px,
    scene_sheet,
    seen_sheets,
    sheet_folds,
    sheet_outline_px,
    solid_planes,
    target_outline,
    track,
)
from sweep.model.polygon import half_plane, is_curved, signed_areas
from sweep.model.pose import transform_points
from sweep.model.scene import Scenes
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# The extent of the markers in the image, their areas, and whether they are visible.

WARP_PX_PER_MODULE = 10
"""Resolution of the bitmap that the ``warp`` renderer maps (the paper's)."""


def _outlines(scenes: Scenes, rows: NDArray[np.intp], per_side: int) -> Floats:
    """Return points (n, 4 · per_side, 3) along all that is printed, in the camera frame."""
    boxes = scenes.targets.each(lambda board: extent_of(board).sheet)[rows]
    return in_space(boxes, scenes.plane[rows], per_side)


def _squares_px(scenes: Scenes, rows: NDArray[np.intp], per_side: int) -> Floats:
    """Return points (n, 4 · per_side, 2) along the images of what is black.

    It is as large as ``size_m`` says, not as it is printed.
    """
    ink = scenes.targets.each(lambda board: extent_of(board).ink)[rows]
    origin = scenes.targets.each(lambda board: extent_of(board).origin)[rows]
    larger = 1 / scenes.effects["marker_scale"][rows] - 1
    boxes = ink + (ink - np.tile(origin, 2)) * larger[:, None]
    return scenes.cameras.take(rows).project(in_space(boxes, scenes.plane[rows], per_side))


def marker_boxes(scenes: Scenes) -> NDArray[np.int64]:
    """Return the boxes (N, 4) left, top, right, bottom (half-open) of pixels a marker may touch.

    Clipped at the frame; empty (all zero) if no part of the marker is in it. Of a board on several
    sheets those count that the frame sees. Each effect that is active widens them as it declares.
    """
    low, high = scenes.outline_px.min(axis=1), scenes.outline_px.max(axis=1)
    solid, limit = scenes.solid, scenes.frame.astype(np.float64)
    bulging = scenes.cameras.distorted & np.isfinite(low).all(axis=1)
    lenses = np.flatnonzero(bulging & ~solid)
    if len(lenses):
        points = scenes.cameras.take(lenses).project(_outlines(scenes, lenses, CHORDS_PER_SIDE))
        low[lenses], high[lenses] = points.min(axis=1) - 2, points.max(axis=1) + 2
    for row in np.flatnonzero((bulging & solid) | scenes.effects.outlines("curved")).tolist():
        points = sheet_outline_px(scenes, row)
        if not len(points):
            continue
        low[row], high[row] = points.min(axis=0) - 2, points.max(axis=0) + 2
    warp_rows = np.flatnonzero([name == "warp" for name in scenes.renderer])
    if len(warp_rows):
        low[warp_rows], high[warp_rows] = _warp_extent(scenes, warp_rows)
    for row in np.flatnonzero(((low < 0) | (high > limit - 1)).any(axis=1)).tolist():
        low[row], high[row] = _in_frame(scenes, row, low[row], high[row])
    for row in np.flatnonzero(scenes.effects.active & np.isfinite(low).all(axis=1)).tolist():
        low[row], high[row] = _exposed_extent(scenes, row, low[row], high[row])
    block = np.ones((len(scenes), 1))
    for effect in scenes.effects.present:
        if effect.reach_px or effect.block_px > 1:
            active = effect.is_active(scenes.effects[effect.switch])[:, None]
            low, high = low - effect.reach_px * active, high + effect.reach_px * active
            block = np.where(active, effect.block_px, block)
    with np.errstate(invalid="ignore"):
        start = np.clip(np.floor(low + 0.5), 0, limit) // block * block
        stop = np.minimum(-(-np.clip(np.ceil(high + 0.5), 0, limit) // block) * block, limit)
        inside = (stop > start).all(axis=1)
    boxes = np.concatenate([start, stop], axis=1)
    return np.where(inside[:, None], boxes, 0.0).astype(np.int64)


def _in_frame(scenes: Scenes, row: int, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return the extent, from ``low`` to ``high`` (2,), of the sheets that the frame can see."""
    target = scenes.target(row)
    if (
        len(sheets_of(target)) == 1 or scenes.renderer[row] == "warp"
        or any(each.outline != "kept" for each in scenes.effects.active_in(row))
    ):
        return low, high
    reach = 0.0
    if scenes.effects.active[row]:
        reach = REACH * largest_spread_px(scenes, row) + max(
            each.reach_px for each in scenes.effects.plugins.all_effects
        )
    per_side = CHORDS_PER_SIDE if scenes.cameras.distorted[row] else 1
    sides = along_sides(sheets_m(target) * scenes.effects["marker_scale"][row], per_side)
    points = scenes.cameras.take(np.array([row])).project(
        sides.reshape(1, -1, 3) @ scenes.rotation[row].T + scenes.translation[row]
    ).reshape(len(sides), -1, 2)
    least, most = points.min(axis=1) - 2, points.max(axis=1) + 2
    seen = ((most + reach > 0) & (least - reach < scenes.frame[row])).all(axis=1)
    if not seen.any():
        return low, high
    return np.maximum(low, least[seen].min(axis=0)), np.minimum(high, most[seen].max(axis=0))


def _warp_extent(scenes: Scenes, rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return the least and greatest pixels (n, 2) that the ``warp`` renderer may touch.

    It maps bitmap to image by the homography of the black square's corners, distorted by the lens,
    so that its quiet zone ends elsewhere than the marker's. Interpolation spreads it by half a
    pixel of the bitmap. If the homography's horizon crosses it, it may touch every pixel.
    """
    low, high = np.full((len(rows), 2), np.nan), np.full((len(rows), 2), np.nan)
    for i, row in enumerate(rows.tolist()):
        corners = scenes.corners_px[row]
        if not np.isfinite(corners).all():
            continue
        extent = extent_of(scenes.target(row))
        square = rectangles(extent.ink[None])[0].astype(np.float32)
        transform = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
        half_px = 0.5 / WARP_PX_PER_MODULE * np.array([-1.0, -1.0, 1.0, 1.0])
        (points,) = in_space(extent.sheet[None] + half_px, np.array([transform], dtype=np.float64))
        if (points[:, 2] > 0).all():
            flat = points[:, :2] / points[:, 2:]
            low[i], high[i] = flat.min(axis=0) - 1, flat.max(axis=0) + 1
        else:
            low[i], high[i] = -0.5, scenes.frame[row] - 0.5
    return low, high


MAX_INSTANTS = 8193
"""Most instants at which a moving target's extent is computed; a step is added on all sides."""

_COARSE_TURN = math.pi / 8
"""Turn between two instants above which the marker may point anywhere between them."""


def _exposed_extent(
    scenes: Scenes, row: int, low: Floats, high: Floats
) -> tuple[Floats, Floats]:
    """Return the extent, from ``low`` to ``high`` (2,) at rest, under motion and blur.

    NaN if the image has no meaning while rows that see the marker are exposed. At an instant a
    marker is seen by those rows that it covers and that are exposed then.
    """
    motion, sheet = scenes.motion(row), scene_sheet(scenes, row)
    reach = largest_spread_px(scenes, row) * REACH
    reach = reach + 1 if reach > 0 else 0.0
    if not motion.moves:
        return low - reach, high + reach
    if is_curved(sheet):
        reach += sheet.largest_px + 2
    row_time_s = motion.row_time_s
    begin, end = motion.exposed(0, int(scenes.frame[row, 1]))
    turn = float(np.linalg.norm(motion.velocity[3:])) * (end - begin)
    wanted = max(MIN_INSTANTS, (end - begin) / row_time_s if row_time_s > 0 else 0.0)
    count = int(min(max(wanted, 2 * turn / _COARSE_TURN), MAX_INSTANTS))
    times = np.linspace(begin, end, count)
    extents, states = track(
        scenes.projection(row), target_outline(scenes, row), scenes.target(row).is_flat, motion,
        times,
    )
    front = states != BEHIND
    with np.errstate(invalid="ignore"):
        step = np.abs(np.diff(extents, axis=0))
    margin = np.zeros(count)
    for side in (np.s_[:-1], np.s_[1:]):
        margin[side] = np.maximum(margin[side], np.nan_to_num(step, posinf=0.0).max(axis=1))
    if turn > _COARSE_TURN * (count - 1):
        margin += np.where(front, np.abs(extents[:, 2:] - extents[:, :2]).max(axis=1), 0.0)
    margin += 1 + reach
    top, bottom = extents[:, 1] - margin, extents[:, 3] + margin
    if row_time_s > 0:
        spare = motion.exposure_s / 2 + times[1] - times[0]
        first, last = (
            (times + shift) / row_time_s + motion.middle_row for shift in (-spare, spare)
        )
        seen = front & (first <= bottom) & (last >= top)
        top, bottom = np.maximum(top, first - 1), np.minimum(bottom, last + 1)
    else:
        seen = front
    if not seen.any():
        return low, low
    crossing = seen & (states == MEANINGLESS)
    crossing[:-1] |= seen[:-1] & ~front[1:]
    crossing[1:] |= seen[1:] & ~front[:-1]
    if crossing.any():
        return np.full(2, np.nan), np.full(2, np.nan)
    left, right = extents[seen, 0] - margin[seen], extents[seen, 2] + margin[seen]
    return (
        np.array([left.min(), top[seen].min()]), np.array([right.max(), bottom[seen].max()])
    )


def areas_px(scenes: Scenes) -> Floats:
    """Return the projected black square's area (N,) in px², along its curved edges."""
    points = scenes.corners_px
    area = signed_areas(points)
    curved = np.flatnonzero(scenes.cameras.distorted & np.isfinite(area))
    if len(curved):
        area[curved] = signed_areas(_squares_px(scenes, curved, 256))
    return np.abs(area)


EDGE_ON = 1e-12
"""Sine of the angle to the line of sight below which a marker is seen edge on."""


def hidden(scenes: Scenes) -> NDArray[np.bool_]:
    """Return (N,) whether a marker is seen from behind or edge on, or has a corner at z <= 0.

    The quiet zone's corners count, since the marker is drawn with it; not what is beside a board.
    """
    towards = np.sum(scenes.rotation[:, :, 2] * scenes.translation, axis=1)
    # A tilt of 90° is not quite one in double precision.
    facing = towards < -EDGE_ON * np.linalg.norm(scenes.translation, axis=1)
    for row in np.flatnonzero(scenes.solid).tolist():
        facing[row] = any(
            each.number < own_sheets(scenes.target(row)) for each in seen_sheets(scenes, row)
        )
    behind: Masks = np.asarray(~np.isfinite(scenes.outline_px).all(axis=(1, 2)))
    for row in np.flatnonzero(behind).tolist():
        target = scenes.target(row)
        if target.distractors and scenes.solid[row]:
            behind[row] = not np.isfinite(scenes.corners_px[row]).all()
        elif target.distractors:
            own = in_space(extent_of(target).target[None], scenes.plane[[row]])
            behind[row] = (own[..., 2] <= 0).any()
    return np.asarray(~facing | behind)


def outside_frame(scenes: Scenes, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return (n,) whether the black square of scenes ``rows`` lies wholly outside the frame."""
    def curved(i: int) -> Floats:
        return np.asarray(_squares_px(scenes, rows[i : i + 1], CHORDS_PER_SIDE)[0])

    return _outside(scenes, rows, scenes.corners_px[rows], curved)


def unseen_squares(scenes: Scenes, row: int, corners_m: Floats, corners_px: Floats) -> Masks:
    """Return (M,) which squares of the board of one scene cannot be seen.

    They lie wholly outside the frame, show their back, or are wholly behind another's sheet.
    ``corners_m`` (M, 4, 3) are their corners on the board, ``corners_px`` (M, 4, 2) the images.
    """
    rows, count = np.full(len(corners_m), row), len(corners_m)

    def in_camera(points: Floats) -> Floats:
        moved = transform_points(points, scenes.rotation[[row]], scenes.translation[[row]])
        return np.asarray(moved[0])

    def curved(i: int) -> Floats:
        points = in_camera(along_sides(corners_m[i : i + 1], CHORDS_PER_SIDE))
        return np.asarray(scenes.cameras.take(rows[:1]).project(points[None])[0])

    unseen = _outside(scenes, rows, corners_px, curved)
    if scenes.solid[row]:
        printed = corners_m.reshape(1, -1, 3) * scenes.effects["marker_scale"][row]
        corners = in_camera(printed).reshape(count, 4, 3)
        unseen |= unseen_markers(scenes.target(row), solid_planes(scenes, row), corners)
    return unseen


def _outside(
    scenes: Scenes, rows: NDArray[np.intp], corners: Floats, curved: Callable[[int], Floats]
) -> Masks:
    """Return (n,) which squares with ``corners`` (n, 4, 2) lie wholly outside the frames of rows.

    ``curved(i)`` returns points along the image of a square's sides, for those under a lens.
    """
    limit, distorted = scenes.frame[rows] - 0.5, scenes.cameras.distorted[rows]
    before: Masks = np.asarray(corners < -0.5)
    beyond: Masks = np.asarray(corners > limit[:, None])
    aside: Masks = np.asarray(before.all(axis=1) | beyond.all(axis=1))
    outside, cut = np.asarray(~distorted & aside.any(axis=1)), np.asarray(before | beyond)
    for i in np.flatnonzero(cut.any(axis=(1, 2)) & ~outside).tolist():
        outside[i] = not _meets_frame(curved(i) if distorted[i] else corners[i], limit[i])
    return outside


def _meets_frame(polygon: Floats, limit: Floats) -> bool:
    """Return whether a polygon (M, 2) has a part of positive area in [-0.5, limit]."""
    for axis in (0, 1):
        for sign, bound in ((1.0, -0.5), (-1.0, -limit[axis])):
            polygon = half_plane(polygon, sign * polygon[:, axis] - bound)
            if len(polygon) < 3:
                return False
    return bool(np.abs(signed_areas(polygon[None])[0]) > 0)


def not_modelled(scenes: Scenes) -> NDArray[np.bool_]:
    """Return (N,) whether the image has no meaning.

    That is so if the lens model folds on the marker, or if during the exposure it does so, or the
    marker comes behind the camera or shows its back; and if a bent marker hides a part of itself,
    or shifts fold its image, in the middle of the exposure. What is beside a board counts, too.
    """
    folded: Masks = np.asarray(~np.isfinite(scenes.outline_px).all(axis=(1, 2)))
    bulging = scenes.cameras.distorted & ~folded
    for row in np.flatnonzero(scenes.effects.outlines("curved")).tolist():
        folded[row] = folded[row] or sheet_folds(scenes, row)
    for row in np.flatnonzero(scenes.effects.outlines("moving")).tolist():
        low, high = scenes.outline_px[row].min(axis=0), scenes.outline_px[row].max(axis=0)
        if np.isfinite(low).all() and scenes.motion(row).moves:
            folded[row] |= not np.isfinite(_exposed_extent(scenes, row, low, high)).all()
    for row in np.flatnonzero(bulging & scenes.solid).tolist():
        quads = np.array([each.corners for each in seen_sheets(scenes, row)]).reshape(-1, 4, 3)
        lenses = np.repeat(scenes.cameras.lenses[row : row + 1], len(quads), axis=0)
        folded[row] |= lens_model.folds(quads[..., :2] / quads[..., 2:], lenses).any()
    rows = np.flatnonzero(bulging & ~scenes.solid)
    if len(rows):
        points = _outlines(scenes, rows, 1)
        folded[rows] |= lens_model.folds(
            points[..., :2] / points[..., 2:], scenes.cameras.lenses[rows]
        )
    return folded
