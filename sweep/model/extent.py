"""The extent of targets in the image, their areas and visibility, at rest and in motion."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.model import lens as lens_model
from sweep.model.board import along_sides, extent_of, own_sheets, rectangles, sheets_m, sheets_of
from sweep.model.coverage import REACH
from sweep.model.exposure import (
    BEHIND,
    CHORDS_PER_SIDE,
    MEANINGLESS,
    MIN_INSTANTS,
    is_curved,
    largest_spread_px,
    moving_marker,
    row_times,
    scene_sheet,
    seen_sheets,
    sheet_folds,
    sheet_outline_px,
    track,
)
from sweep.model.polygon import half_plane, signed_areas
from sweep.model.pose import transform_points
from sweep.model.scene import Scenes
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# The extent of the markers in the image, their areas, and whether they are visible.

WARP_PX_PER_MODULE = 10
"""Resolution of the bitmap that the ``warp`` renderer maps (the paper's)."""


def _outline(scenes: Scenes, rows: NDArray[np.intp], quiet: bool, per_side: int) -> Floats:
    """Return points (n, 4 · per_side, 2) along the images of the outline or the black square.

    The outline is that of all that is printed, the black square that of ``size_m``.
    """
    boxes = (
        scenes.targets.each(lambda board: extent_of(board).sheet)[rows] if quiet
        else _unscaled(scenes, rows)
    )
    rectangle = rectangles(boxes, per_side)
    flat = np.concatenate([rectangle, np.ones_like(rectangle[..., :1])], axis=2)
    return scenes.cameras.take(rows).project(
        np.ascontiguousarray(flat @ np.swapaxes(scenes.plane[rows], 1, 2))
    )


def _unscaled(scenes: Scenes, rows: NDArray[np.intp]) -> Floats:
    """Return what is black (n, 4) as large as ``size_m`` says, in modules of the printed one."""
    ink = scenes.targets.each(lambda board: extent_of(board).ink)[rows]
    origin = scenes.targets.each(lambda board: extent_of(board).origin)[rows]
    larger = 1 / scenes.effects["marker_scale"][rows] - 1
    return np.asarray(ink + (ink - np.tile(origin, 2)) * larger[:, None])


def curved_rows(scenes: Scenes) -> NDArray[np.intp]:
    """Return the scenes (n,) whose sheets are bent or whose image is shifted."""
    return np.flatnonzero(np.any(
        [scenes.effects[name] != 0 for name in ("curvature_per_m", "geometry_px", "edge_px")],
        axis=0,
    ))


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
        points = _outline(scenes, lenses, quiet=True, per_side=CHORDS_PER_SIDE)
        low[lenses], high[lenses] = points.min(axis=1) - 2, points.max(axis=1) + 2
    for row in {*np.flatnonzero(bulging & solid).tolist(), *curved_rows(scenes).tolist()}:
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
    for effect in scenes.effects.plugins.all_effects:
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
    target, effect = scenes.target(row), scenes.effects.of(row)
    if (
        len(sheets_of(target)) == 1 or scenes.renderer[row] == "warp"
        or scenes.motion(row) is not None or effect["occlusion"] > 0
        or is_curved(scene_sheet(scenes, row))
    ):
        return low, high
    reach = 0.0
    if scenes.effects.active[row]:
        reach = REACH * largest_spread_px(scenes, row) + max(
            each.reach_px for each in scenes.effects.plugins.all_effects
        )
    per_side = CHORDS_PER_SIDE if scenes.cameras.distorted[row] else 1
    sides = along_sides(sheets_m(target) * effect["marker_scale"], per_side)
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
        square = rectangles(extent_of(scenes.target(row)).ink[None], 1)[0].astype(np.float32)
        transform = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
        half_px = 0.5 / WARP_PX_PER_MODULE * np.array([-1.0, -1.0, 1.0, 1.0])
        outline = rectangles(extent_of(scenes.target(row)).sheet[None] + half_px, 1)
        points = np.column_stack([outline[0], np.ones(4)]) @ np.asarray(transform).T
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
    motion = scenes.motion(row)
    reach = largest_spread_px(scenes, row) * REACH
    reach = reach + 1 if reach > 0 else 0.0
    if motion is None:
        return low - reach, high + reach
    sheet = scene_sheet(scenes, row)
    if is_curved(sheet):
        reach += sheet.largest_px + 2
    exposure_s, row_time_s, velocity = motion
    height = int(scenes.frame[row, 1])
    begin, end = row_times(0, height, height, exposure_s, row_time_s)
    turn = float(np.linalg.norm(velocity[3:])) * (end - begin)
    wanted = max(MIN_INSTANTS, (end - begin) / row_time_s if row_time_s > 0 else 0.0)
    count = int(min(max(wanted, 2 * turn / _COARSE_TURN), MAX_INSTANTS))
    times = np.linspace(begin, end, count)
    extents, states = track(moving_marker(scenes, row, velocity), times)
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
        spare = exposure_s / 2 + times[1] - times[0]
        middle = (height - 1) / 2
        first, last = (times - spare) / row_time_s + middle, (times + spare) / row_time_s + middle
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
        area[curved] = signed_areas(_outline(scenes, curved, quiet=False, per_side=256))
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
        if scenes.target(row).distractors:
            behind[row] = _own_sheet_behind(scenes, row)
    return np.asarray(~facing | behind)


def _own_sheet_behind(scenes: Scenes, row: int) -> bool:
    """Return whether a board has a corner at z <= 0, whatever stands beside it."""
    if scenes.solid[row]:
        return not np.isfinite(scenes.corners_px[row]).all()
    target = extent_of(scenes.target(row)).target
    (corners,), depth = rectangles(target[None], 1), scenes.plane[row][2]
    return bool((corners @ depth[:2] + depth[2] <= 0).any())


def outside_frame(scenes: Scenes, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return (n,) whether the black square of scenes ``rows`` lies wholly outside the frame."""
    corners, limit = scenes.corners_px[rows], scenes.frame[rows] - 0.5
    outside = np.zeros(len(rows), dtype=bool)
    cut = ((corners < -0.5) | (corners > limit[:, None])).any(axis=(1, 2))
    for i in np.flatnonzero(cut):
        polygon = corners[i]
        if scenes.cameras.distorted[rows[i]]:
            polygon = _outline(scenes, rows[i : i + 1], False, CHORDS_PER_SIDE)[0]
        outside[i] = not _meets_frame(polygon, limit[i])
    return outside


def outside_of_frame(scenes: Scenes, row: int, corners_m: Floats, corners_px: Floats) -> Masks:
    """Return (M,) which squares of the board of one scene lie wholly outside the frame.

    ``corners_m`` (M, 4, 3) are their corners on the board, ``corners_px`` (M, 4, 2) the images.
    """
    limit = scenes.frame[row] - 0.5
    low, high = corners_px < -0.5, corners_px > limit
    cut = (low | high).any(axis=(1, 2))
    outside = np.zeros(len(corners_m), dtype=bool)
    if not scenes.cameras.distorted[row]:
        outside = (low.all(axis=1) | high.all(axis=1)).any(axis=1)
        cut &= ~outside
    camera = scenes.cameras.take(np.array([row]))
    for i in np.flatnonzero(cut):
        polygon = corners_px[i]
        if scenes.cameras.distorted[row]:
            points = along_sides(corners_m[i : i + 1], CHORDS_PER_SIDE)
            pose = scenes.rotation[row : row + 1], scenes.translation[row : row + 1]
            polygon = camera.project(transform_points(points, *pose))[0]
        outside[i] = not _meets_frame(polygon, limit)
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
    for row in curved_rows(scenes).tolist():
        folded[row] = folded[row] or sheet_folds(scenes, row)
    for row in np.flatnonzero(scenes.effects.active).tolist():
        low, high = scenes.outline_px[row].min(axis=0), scenes.outline_px[row].max(axis=0)
        if np.isfinite(low).all() and scenes.motion(row) is not None:
            folded[row] |= not np.isfinite(_exposed_extent(scenes, row, low, high)).all()
    bulging = scenes.cameras.distorted & np.isfinite(scenes.outline_px).all((1, 2))
    for row in np.flatnonzero(bulging & scenes.solid).tolist():
        quads = np.array([
            np.column_stack([rectangles(each.box[None], 1)[0], np.ones(4)]) @ each.plane.T
            for each in seen_sheets(scenes, row)
        ]).reshape(-1, 4, 3)
        lenses = np.repeat(scenes.cameras.lenses[row : row + 1], len(quads), axis=0)
        folded[row] |= lens_model.folds(quads[..., :2] / quads[..., 2:], lenses).any()
    rows = np.flatnonzero(bulging & ~scenes.solid)
    if len(rows):
        points = scenes.outline_m[rows]
        folded[rows] |= lens_model.folds(
            np.ascontiguousarray(points[..., :2] / points[..., 2:]),
            scenes.cameras.lenses[rows],
        )
    return folded
