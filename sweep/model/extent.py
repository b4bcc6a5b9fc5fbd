"""The extent of targets in the image, their areas and visibility, at rest and in motion."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model import lens as lens_model
from sweep.model.coverage import REACH
from sweep.model.lens import distort, jacobian
from sweep.model.polygon import Projection, half_plane, signed_areas
from sweep.model.pose import transform_points
from sweep.model.printed import extent_of
from sweep.model.scene import Box, Scenes
from sweep.model.scene_sheet import (
    board_faces,
    curved_rows,
    extent_in_frame,
    facing_sheets,
    scene_sheet,
    sheet_folds,
    sheet_outline_px,
    sheet_outlines_px,
)
from sweep.model.sensor import BLOCK_PX, REACH_PX
from sweep.model.sheet import bent_point, plane_normal
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# A marker that moves at constant linear and angular velocity while its image is taken.

class Motion(NamedTuple):
    """A marker's motion in the camera frame.

    Attributes
    ----------
    translation
        (3,) position of its centre at time 0, in metres.
    velocity
        (6,) linear in m/s and angular in rad/s.
    """

    translation: Floats
    velocity: Floats


class MovingMarker(NamedTuple):
    """A moving marker seen by a camera.

    Attributes
    ----------
    projection
        The camera, and the marker's plane at time 0.
    motion
        How the marker moves.
    outline
        (M, 3) points of its outline: column, row, and height over the plane in modules.
    """

    projection: Projection
    motion: Motion
    outline: Floats


@compiled
def moved_plane(plane: Floats, motion: Motion, time_s: float) -> Floats:
    """Return the plane (3, 3) of a marker after ``time_s``.

    ``plane`` takes module coordinates to the camera frame. The rotation about the centre is
    Rodrigues' formula for the vector angular velocity · time.
    """
    translation, velocity = motion
    x, y, z = velocity[3] * time_s, velocity[4] * time_s, velocity[5] * time_s
    angle = math.sqrt(x * x + y * y + z * z)
    sine, versine = 1.0, 0.5
    if angle > 0.0:
        half = math.sin(angle / 2) / angle
        sine, versine = math.sin(angle) / angle, 2 * half * half
    after = np.empty((3, 3))
    for k in range(3):
        px, py, pz = plane[0, k], plane[1, k], plane[2, k]
        if k == 2:
            px, py, pz = px - translation[0], py - translation[1], pz - translation[2]
        cx, cy, cz = y * pz - z * py, z * px - x * pz, x * py - y * px
        dx, dy, dz = y * cz - z * cy, z * cx - x * cz, x * cy - y * cx
        after[0, k] = px + sine * cx + versine * dx
        after[1, k] = py + sine * cy + versine * dy
        after[2, k] = pz + sine * cz + versine * dz
    for k in range(3):
        after[k, 2] += translation[k] + velocity[k] * time_s
    return after


VISIBLE, BEHIND, MEANINGLESS = 0, 1, 2
"""States of a moving marker: in front of the camera; wholly behind it; or without a meaningful
image, since it crosses the camera's plane, shows its back, or lies where the lens folds."""


@compiled
def outline_extent(
    projection: Projection, outline: Floats, extent: Floats
) -> tuple[int, bool]:
    """Write left, top, right, bottom in px of an outline's image to ``extent`` (4,).

    The extent is that of the points (M, 3), in modules, that are in front of the camera.
    Returns how many are behind it, and whether the lens folds at one of the others.
    """
    plane, optics = projection.plane, projection.optics
    intrinsics, lens = optics.intrinsics, optics.lens
    behind, folds = 0, False
    extent[0] = extent[1] = math.inf
    extent[2] = extent[3] = -math.inf
    normal = plane_normal(plane)
    for j in range(len(outline)):
        height = outline[j, 2]
        z = plane[2, 0] * outline[j, 0] + plane[2, 1] * outline[j, 1] + plane[2, 2]
        z += height * normal[2]
        if not z > 0.0:
            behind += 1
            continue
        x = plane[0, 0] * outline[j, 0] + plane[0, 1] * outline[j, 1] + plane[0, 2]
        y = plane[1, 0] * outline[j, 0] + plane[1, 1] * outline[j, 1] + plane[1, 2]
        x, y = (x + height * normal[0]) / z, (y + height * normal[1]) / z
        if optics.distorted:
            a, b, c, d = jacobian(x, y, lens)
            folds = folds or not (math.hypot(x, y) < lens[23] and a * d - b * c > 0.0)
            x, y = distort(x, y, lens)
        u, v = intrinsics[0] * x + intrinsics[2], intrinsics[1] * y + intrinsics[3]
        extent[0], extent[2] = min(extent[0], u), max(extent[2], u)
        extent[1], extent[3] = min(extent[1], v), max(extent[3], v)
    return behind, folds


@compiled
def track(marker: MovingMarker, times_s: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Return the extents (T, 4) left, top, right, bottom in px of a marker, and its states (T,)."""
    projection, motion = marker.projection, marker.motion
    extents = np.empty((len(times_s), 4))
    states = np.zeros(len(times_s), dtype=np.int64)
    for k in range(len(times_s)):
        p = moved_plane(projection.plane, motion, times_s[k])
        behind, folds = outline_extent(
            Projection(p, projection.optics), marker.outline, extents[k]
        )
        if folds:
            states[k] = MEANINGLESS
        # The sign of the line of sight along the normal, which is the columns' cross product.
        facing = 0.0
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            normal = p[a, 0] * p[b, 1] - p[b, 0] * p[a, 1]
            facing += normal * (motion.translation[i] + motion.velocity[i] * times_s[k])
        if behind == len(marker.outline):
            states[k] = BEHIND
        elif behind > 0 or not facing > 0.0:
            states[k] = MEANINGLESS
    return extents, states


def row_times(
    top: int, bottom: int, height: int, exposure_s: float, row_time_s: float
) -> tuple[float, float]:
    """Return when the exposure of rows [top, bottom) begins and ends.

    Time 0 is the middle of the middle row's exposure.
    """
    middle = (height - 1) / 2
    return (
        row_time_s * (top - middle) - exposure_s / 2,
        row_time_s * (bottom - 1 - middle) + exposure_s / 2,
    )


# --------------------------------------------------------------------------------------------------
# The extent of the markers in the image, their areas, and whether they are visible.

WARP_PX_PER_MODULE = 10
"""Resolution of the bitmap that the ``warp`` renderer maps (the paper's)."""


def _rectangle(boxes: Floats, per_side: int) -> Floats:
    """Return points (n, 4 · per_side, 2) along boxes (n, 4): left, top, right, bottom."""
    t = np.arange(per_side) / per_side
    left, top, right, bottom = (np.repeat(side[:, None], per_side, 1) for side in boxes.T)
    columns = np.concatenate(
        [left + t * (right - left), right, right - t * (right - left), left], axis=1
    )
    lines = np.concatenate(
        [top, top + t * (bottom - top), bottom, bottom - t * (bottom - top)], axis=1
    )
    return np.stack([columns, lines], axis=2)


def _outline(scenes: Scenes, rows: NDArray[np.intp], quiet: bool, per_side: int) -> Floats:
    """Return points (n, 4 · per_side, 2) along the images of the outline or the black square.

    The outline is that of all that is printed, the black square that of ``size_m``.
    """
    boxes = scenes.sheet[rows] if quiet else _unscaled(scenes, rows)
    rectangle = _rectangle(boxes, per_side)
    flat = np.concatenate([rectangle, np.ones_like(rectangle[..., :1])], axis=2)
    return scenes.cameras.take(rows).project(
        np.ascontiguousarray(flat @ np.swapaxes(scenes.plane[rows], 1, 2))
    )


def _unscaled(scenes: Scenes, rows: NDArray[np.intp]) -> Floats:
    """Return what is black (n, 4) as large as ``size_m`` says, in modules of the printed one."""
    ink = scenes.ink[rows]
    if scenes.effects is None:
        return ink
    larger = 1 / scenes.effects["marker_scale"][rows] - 1
    return np.asarray(ink + (ink - np.tile(scenes.origin[rows], 2)) * larger[:, None])


CHORDS_PER_SIDE = 32
"""Points of a side at which a curved outline is sampled for its extent: between them it bulges by
less than 1/1000 of the side's bulge, well inside the 2 px that :func:`marker_boxes` adds."""


def marker_boxes(scenes: Scenes) -> NDArray[np.int64]:
    """Return the boxes (N, 4) left, top, right, bottom (half-open) of pixels a marker may touch.

    Clipped at the frame; empty (all zero) if no part of the marker is in it. Of a board on several
    sheets those count that the frame sees.
    """
    low, high = scenes.outline_px.min(axis=1), scenes.outline_px.max(axis=1)
    bulging = scenes.cameras.distorted & np.isfinite(low).all(axis=1)
    for row in np.flatnonzero(bulging & scenes.solid).tolist():
        points = sheet_outlines_px(scenes, row, CHORDS_PER_SIDE)
        low[row], high[row] = points.min(axis=0) - 2, points.max(axis=0) + 2
    curved = np.flatnonzero(bulging & ~scenes.solid)
    if len(curved):
        points = _outline(scenes, curved, quiet=True, per_side=CHORDS_PER_SIDE)
        low[curved], high[curved] = points.min(axis=1) - 2, points.max(axis=1) + 2
    for row in curved_rows(scenes).tolist():
        points = sheet_outline_px(scenes, row, _outline_on_sheet(scenes, row, CHORDS_PER_SIDE))
        low[row], high[row] = points.min(axis=0) - 2, points.max(axis=0) + 2
    warp_rows = np.flatnonzero([name == "warp" for name in scenes.renderer])
    if len(warp_rows):
        low[warp_rows], high[warp_rows] = _warp_extent(scenes, warp_rows)
    limit = scenes.frame.astype(np.float64)
    for row in np.flatnonzero(((low < 0) | (high > limit - 1)).any(axis=1)).tolist():
        affected = scenes.affected[row]
        reach_px = REACH_PX + REACH * _largest_spread_px(scenes, row) if affected else 0.0
        extent = low[row], high[row], reach_px
        low[row], high[row] = extent_in_frame(scenes, row, *extent, CHORDS_PER_SIDE)
    for row in np.flatnonzero(scenes.affected & np.isfinite(low).all(axis=1)).tolist():
        low[row], high[row] = _exposed_extent(scenes, row, low[row], high[row])
    if scenes.effects is not None:
        reach = np.where(scenes.effects["bayer"] > 0, REACH_PX, 0.0)[:, None]
        low, high = low - reach, high + reach
    with np.errstate(invalid="ignore"):
        start = np.clip(np.floor(low + 0.5), 0, limit)
        stop = np.clip(np.ceil(high + 0.5), 0, limit)
        if scenes.effects is not None:
            block = np.where(scenes.effects["jpeg_quality"] > 0, BLOCK_PX, 1)[:, None]
            start, stop = start // block * block, np.minimum(-(-stop // block) * block, limit)
        inside = (stop > start).all(axis=1)
    boxes = np.concatenate([start, stop], axis=1)
    return np.where(inside[:, None], boxes, 0.0).astype(np.int64)


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
        square = _rectangle(scenes.ink[row : row + 1], 1)[0].astype(np.float32)
        transform = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
        half_px = 0.5 / WARP_PX_PER_MODULE * np.array([-1.0, -1.0, 1.0, 1.0])
        outline = _rectangle(scenes.sheet[row : row + 1] + half_px, 1)
        points = np.column_stack([outline[0], np.ones(4)]) @ np.asarray(transform).T
        if (points[:, 2] > 0).all():
            flat = points[:, :2] / points[:, 2:]
            low[i], high[i] = flat.min(axis=0) - 1, flat.max(axis=0) + 1
        else:
            low[i], high[i] = -0.5, scenes.frame[row] - 0.5
    return low, high


MIN_INSTANTS, MAX_INSTANTS = 65, 8193
"""Instants at which a moving marker's extent is computed; a step is added on all sides."""

_COARSE_TURN = math.pi / 8
"""Turn between two instants above which the marker may point anywhere between them."""


def _outline_on_sheet(scenes: Scenes, row: int, per_side: int) -> Floats:
    """Return points (M, 2) of a marker's outline in modules, before its sheet is bent."""
    return np.asarray(_rectangle(scenes.sheet[row : row + 1], per_side)[0])


def outline_modules(scenes: Scenes, row: int) -> Floats:
    """Return points (M, 3) of a marker's outline: column, row, and height in modules.

    Its corners, or more under a lens or on a bent sheet.
    """
    sheet = scene_sheet(scenes, row)
    curved = scenes.cameras.distorted[row] or sheet is not None
    outline = _outline_on_sheet(scenes, row, CHORDS_PER_SIDE if curved else 1)
    if sheet is None:
        return np.column_stack([outline, np.zeros(len(outline))])
    return np.array([bent_point(column, line, sheet) for column, line in outline.tolist()])


def moving_marker(scenes: Scenes, row: int, velocity: Floats) -> MovingMarker:
    """Return the marker of one scene with a velocity (6,) as compiled functions take it."""
    return MovingMarker(
        scenes.projection(row), Motion(scenes.translation[row], velocity),
        outline_modules(scenes, row),
    )


def _exposed_extent(
    scenes: Scenes, row: int, low: Floats, high: Floats
) -> tuple[Floats, Floats]:
    """Return the extent, from ``low`` to ``high`` (2,) at rest, under motion and blur.

    NaN if the image has no meaning while rows that see the marker are exposed. At an instant a
    marker is seen by those rows that it covers and that are exposed then.
    """
    motion = scenes.motion(row)
    reach = _largest_spread_px(scenes, row) * REACH
    reach = reach + 1 if reach > 0 else 0.0
    if motion is None:
        return low - reach, high + reach
    sheet = scene_sheet(scenes, row)
    if sheet is not None:
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


def _largest_spread_px(scenes: Scenes, row: int) -> float:
    """Return the largest point spread on the marker, at one of its outline's corners.

    Of sharpening it is that of the negative lobe.
    """
    effect = scenes.effect(row)
    added_px = effect["sharpening_px"] if effect["sharpening"] != 0 else 0.0
    return float(spread_px(scenes, row, 1 / corner_depths(scenes, row), added_px).max())


def spread_px(
    scenes: Scenes, row: int, inverse_depth: Floats, added_px: float = 0.0
) -> Floats:
    """Return the point spread's standard deviation in px at inverse depths (...) in 1/m.

    The circle of confusion of a thin lens has the diameter fx · aperture · |1/focus - 1/z| in
    pixels; a disk's standard deviation along an axis is a quarter of its diameter. ``added_px`` is
    that of one more point spread.
    """
    effect = scenes.effect(row)
    blur_px = math.hypot(effect["blur_px"], added_px)
    if math.isnan(effect["aperture_mm"]):
        return np.full(inverse_depth.shape, blur_px)
    aperture_px = scenes.cameras.view[row, 0] * effect["aperture_mm"] * 1e-3
    diameter = aperture_px * (1 / effect["focus_distance_m"] - inverse_depth)
    return np.asarray(np.hypot(blur_px, diameter / 4))


def corner_depths(scenes: Scenes, row: int) -> Floats:
    """Return the depths (4,) in metres of the quiet zone's corners."""
    (corners,) = _rectangle(scenes.sheet[row : row + 1], 1)
    depth = scenes.plane[row][2]
    return np.asarray(corners @ depth[:2] + depth[2])


def path_px(scenes: Scenes, row: int, box: Box) -> float:
    """Return the longest path of a moving marker's corner, in px, while a row is exposed."""
    motion = scenes.motion(row)
    if motion is None or motion[0] == 0.0:
        return 0.0
    exposure_s, row_time_s, velocity = motion
    marker = moving_marker(scenes, row, velocity * np.array([1.0, 1, 1, 0, 0, 0]))
    longest = 0.0
    for line in (box[1], (box[1] + box[3]) // 2, box[3] - 1):
        times = np.linspace(
            *row_times(line, line + 1, int(scenes.frame[row, 1]), exposure_s, row_time_s),
            MIN_INSTANTS,
        )
        extents, states = track(marker, times)
        extents = extents[states != BEHIND]
        if not len(extents):
            continue
        along = np.hypot(*np.abs(np.diff(extents, axis=0)).reshape(-1, 2, 2).max(axis=1).T).sum()
        around = np.hypot(*(extents[:, 2:] - extents[:, :2]).max(axis=0)) * exposure_s
        longest = max(longest, float(along + np.linalg.norm(velocity[3:]) * around))
    return longest


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
        facing[row] = board_faces(scenes, row)
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
    (corners,), depth = _rectangle(target[None], 1), scenes.plane[row][2]
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
    t = np.arange(CHORDS_PER_SIDE)[:, None, None] / CHORDS_PER_SIDE
    camera = scenes.cameras.take(np.array([row]))
    for i in np.flatnonzero(cut):
        polygon = corners_px[i]
        if scenes.cameras.distorted[row]:
            sides = corners_m[i] + t * (np.roll(corners_m[i], -1, axis=0) - corners_m[i])
            points = np.ascontiguousarray(np.swapaxes(sides, 0, 1)).reshape(1, -1, 3)
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
    for row in np.flatnonzero(scenes.affected).tolist():
        low, high = scenes.outline_px[row].min(axis=0), scenes.outline_px[row].max(axis=0)
        if np.isfinite(low).all() and scenes.motion(row) is not None:
            folded[row] |= not np.isfinite(_exposed_extent(scenes, row, low, high)).all()
    bulging = scenes.cameras.distorted & np.isfinite(scenes.outline_px).all((1, 2))
    for row in np.flatnonzero(bulging & scenes.solid).tolist():
        quads = facing_sheets(scenes, row)
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
