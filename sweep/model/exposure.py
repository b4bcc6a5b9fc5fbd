"""Targets while their image is taken: where they are in it, whether seen, and the exact image."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model import board, coverage, polygon
from sweep.model.board import along_sides, extent_of, rectangles
from sweep.model.coverage import NODES, REACH, WEIGHTS, MarkerEdges
from sweep.model.lens import distort, folds, jacobian
from sweep.model.polygon import Optics, Projection, Sheet, bent_point, plane_normal
from sweep.model.pose import transform_points
from sweep.model.scene import Box, Motion, Scenes, kept_for_row
from sweep.model.sensor import standard_normals
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# A target that moves at constant linear and angular velocity while its image is taken.

@compiled
def moved_plane(plane: Floats, motion: Motion, time_s: float) -> Floats:
    """Return the plane (3, 3) of a marker after ``time_s``.

    ``plane`` takes module coordinates to the camera frame. The rotation about the centre is
    Rodrigues' formula for the vector angular velocity · time.
    """
    translation, velocity = motion.translation, motion.velocity
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


#: States of a moving marker: in front of the camera; wholly behind it; or without a meaningful
#: image, since it crosses the camera's plane, shows its back, or lies where the lens folds.
VISIBLE, BEHIND, MEANINGLESS = 0, 1, 2


@compiled
def outline_extent(projection: Projection, outline: Floats, extent: Floats) -> tuple[int, bool]:
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
        x, y, z = polygon.plane_point(plane, outline[j, 0], outline[j, 1])
        z += height * normal[2]
        if not z > 0.0:
            behind += 1
            continue
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
def track(
    projection: Projection, outline: Floats, flat: bool, motion: Motion, times_s: Floats
) -> tuple[Floats, NDArray[np.int64]]:
    """Return the extents (T, 4) left, top, right, bottom in px of a target, and its states (T,).

    ``projection`` has its plane at time 0. ``flat``: it has a back, which has no image.
    """
    extents = np.empty((len(times_s), 4))
    states = np.zeros(len(times_s), dtype=np.int64)
    for k in range(len(times_s)):
        p = moved_plane(projection.plane, motion, times_s[k])
        behind, folds = outline_extent(Projection(p, projection.optics), outline, extents[k])
        if folds:
            states[k] = MEANINGLESS
        # The sign of the line of sight along the normal, which is the columns' cross product.
        towards = 0.0
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            normal = p[a, 0] * p[b, 1] - p[b, 0] * p[a, 1]
            towards += normal * (motion.translation[i] + motion.velocity[i] * times_s[k])
        if behind == len(outline):
            states[k] = BEHIND
        elif behind > 0 or (flat and not towards > 0.0):
            states[k] = MEANINGLESS
    return extents, states


#: Least number of instants at which a moving target's extent is computed.
MIN_INSTANTS = 65


# --------------------------------------------------------------------------------------------------
# Shifts of an image that vary slowly over the frame.
#
# They are a Gaussian random field with the covariance s² exp(-d² / (2 l²)), made of plane waves
# (Rahimi and Recht, "Random features for large-scale kernel machines", 2007): a smooth function
# of the pixel, whatever part of the frame is computed.

#: Waves of each coordinate's shift. Given their directions, the field is exactly Gaussian; their
#: directions are drawn, so that the covariance of one frame deviates from the formula by 1/8 of its
#: height.
WAVES = 32

def shift_waves(std_px: float, length_px: float, key: np.uint64) -> Floats:
    """Return the waves (2, M, 4) of a field of shifts (:class:`sweep.model.polygon.Sheet`).

    Parameters
    ----------
    std_px, length_px
        Standard deviation of each coordinate's shift, and its correlation length.
    key
        Of the field's random numbers in the frame.
    """
    normals = np.empty((8, WAVES))
    standard_normals(key, 0, 0, 0, normals)
    waves = np.stack([normals[:4].T, normals[4:].T])
    waves[:, :, :2] /= length_px
    waves[:, :, 2:] *= std_px / math.sqrt(WAVES)
    return waves


# --------------------------------------------------------------------------------------------------
# The sheets of scenes: where they are, how they are bent, and how their image is shifted.

#: Points of a side at which a curved outline is sampled for its extent: between them it bulges by
#: less than 1/1000 of the side's bulge, well inside the 2 px that are added around it.
CHORDS_PER_SIDE = 32


class SeenSheet(NamedTuple):
    """A sheet that faces the camera: left, top, right, bottom (4,) in units, and its plane."""

    number: int
    box: Floats
    plane: Floats

    @property
    def corners(self) -> Floats:
        """Its corners (4, 3) in the camera frame, in metres."""
        return np.asarray(board.in_space(self.box[None], self.plane[None])[0])


def solid_planes(scenes: Scenes, row: int) -> Floats:
    """Return the planes (P, 3, 3) of the sheets of one scene's board."""
    return board.sheet_planes(
        scenes.targets[row], scenes.rotation[row], scenes.translation[row],
        float(scenes.effects["marker_scale"][row]),
    )


def seen_sheets(scenes: Scenes, row: int) -> list[SeenSheet]:
    """Return the sheets of one scene that face the camera: one of a target in one plane."""
    target = scenes.targets[row]
    if target.is_flat:
        return [SeenSheet(0, extent_of(target).sheet, scenes.plane[row])]
    planes, boxes = solid_planes(scenes, row), board.sheet_boxes(target)
    numbers = np.flatnonzero(board.facing(target, planes)).tolist()
    return [SeenSheet(k, boxes[k], planes[k]) for k in numbers]


@kept_for_row
def scene_sheet(scenes: Scenes, row: int) -> Sheet:
    """Return how the sheets of one scene are bent, in modules, and how their image is shifted."""
    effect, flat = scenes.effects.of(row), polygon.flat_sheet()
    waves, length_px = flat.waves, math.inf
    for field in ("geometry", "edge"):
        if effect[f"{field}_px"] != 0:
            own_px = effect[f"{field}_length_px"]
            key = scenes.patch(row, 0, 0).stream_key(f"{field}_px")
            added = shift_waves(effect[f"{field}_px"], own_px, key)
            # The sum of both fields has the waves of both.
            waves, length_px = np.concatenate([waves, added], axis=1), min(length_px, own_px)
    x, y = extent_of(scenes.targets[row]).origin.tolist()
    direction = math.radians(effect["bend_deg"])
    return Sheet(
        x, y, effect["curvature_per_m"] * float(np.linalg.norm(scenes.plane[row][:, 0])),
        math.cos(direction), -math.sin(direction),
        effect["bend"] == "saddle", waves,
        float(np.hypot(waves[:, :, 2], waves[:, :, 3]).sum(axis=1).max(initial=0.0)),
        polygon.PIECE_LENGTHS * length_px,
    )


def sheet_folds(scenes: Scenes, row: int) -> bool:
    """Return whether a part of a sheet of one scene hides another, or is not before the camera.

    Also if shifts that vary too steeply fold the image.
    """
    bend, optics = scene_sheet(scenes, row), scenes.cameras.optics(row)
    extent = float(np.ptp(scenes.outline_px[row], axis=0).max()) if len(bend.waves[0]) else 0.0
    for each in seen_sheets(scenes, row):
        low, high = each.box[:2], each.box[2:]
        cells = polygon.fold_cells(bend, float((high - low).max()), extent)
        if polygon.folds_over(low, high, cells, Projection(each.plane, optics), bend):
            return True
    return False


@kept_for_row
def target_outline(scenes: Scenes, row: int) -> Floats:
    """Return points (M, 3) around the target of one scene: column, row, height over its plane.

    In modules: its sheets' corners, or more points under a lens or on a bent sheet.
    """
    target, bend = scenes.targets[row], scene_sheet(scenes, row)
    per_side = CHORDS_PER_SIDE if scenes.cameras.distorted[row] or bend.is_curved else 1
    if target.is_flat:
        (points,) = rectangles(extent_of(target).sheet[None], per_side)
        if not bend.is_curved:
            return np.column_stack([points, np.zeros(len(points))])
        return np.array([bent_point(column, line, bend) for column, line in points.tolist()])
    corners = board.sheets_m(target) / board.unit_m(target) * [1.0, -1.0, 1.0]
    return along_sides(corners, per_side).reshape(-1, 3)


# --------------------------------------------------------------------------------------------------
# The point spread.

def spread_px(scenes: Scenes, row: int, inverse_depth: Floats, blurred: bool = False) -> Floats:
    """Return the point spread's standard deviation in px at inverse depths (...) in 1/m.

    With ``blurred`` that of the image that sharpening subtracts.
    """
    effect, focal_px = scenes.effects.of(row), float(scenes.cameras.view[row, 0])
    spread = np.zeros(inverse_depth.shape)
    for each in scenes.effects.active_in(row):
        if each.spread_px is not None and (blurred or each.switch != "sharpening"):
            spread = np.hypot(spread, each.spread_px(effect, focal_px, inverse_depth))
    return spread


def largest_spread_px(scenes: Scenes, row: int) -> float:
    """Return the largest point spread on the target, at a corner of a sheet, with sharpening's."""
    if all(each.spread_px is None for each in scenes.effects.active_in(row)):
        return 0.0
    depths = np.concatenate([[], *(each.corners[:, 2] for each in seen_sheets(scenes, row))])
    return float(spread_px(scenes, row, 1 / depths, blurred=True).max(initial=0.0))


def is_defocused(scenes: Scenes, row: int) -> bool:
    """Return whether the point spread of one scene depends on depth."""
    return any(each.by_depth for each in scenes.effects.active_in(row))


def defocus_px(
    scenes: Scenes, row: int, sheet: SeenSheet, box: Box, blurred: bool = False
) -> Floats:
    """Return the point spread's standard deviation in px of the pixels (height, width) of a box.

    The depth is that of the sheet's plane (of a bent one, the tangent plane at its centre) in each
    pixel's direction; its inverse is linear in the image.
    """
    if not is_defocused(scenes, row):
        even = spread_px(scenes, row, np.zeros(1), blurred)[0]
        return np.full((box[3] - box[1], box[2] - box[0]), even)
    fx, fy, cx, cy = scenes.cameras.view[row]
    normal = np.cross(sheet.plane[:, 0], sheet.plane[:, 1])
    x = (np.arange(box[0], box[2]) - cx) / fx
    y = (np.arange(box[1], box[3]) - cy) / fy
    inverse = (normal[0] * x + normal[1] * y[:, None] + normal[2]) / (normal @ sheet.plane[:, 2])
    # Beyond the sheet its plane may come near the camera, or end; nothing is blurred there.
    depth = sheet.corners[:, 2]
    return spread_px(scenes, row, np.clip(inverse, 1 / depth.max(), 1 / depth.min()), blurred)


# --------------------------------------------------------------------------------------------------
# The extent of the markers in the image, their areas, and whether they are visible.

#: Resolution of the bitmap that the ``warp`` renderer maps (the paper's).
WARP_PX_PER_MODULE = 10


def _outlines(scenes: Scenes, rows: NDArray[np.intp], per_side: int) -> Floats:
    """Return points (n, 4 · per_side, 3) along all that is printed, in the camera frame."""
    boxes = scenes.targets.each(lambda target: extent_of(target).sheet)[rows]
    return board.in_space(boxes, scenes.plane[rows], per_side)


def _squares_px(scenes: Scenes, rows: NDArray[np.intp], per_side: int) -> Floats:
    """Return points (n, 4 · per_side, 2) along the images of what is black.

    It is as large as ``size_m`` says, not as it is printed.
    """
    ink = scenes.targets.each(lambda target: extent_of(target).ink)[rows]
    origin = scenes.targets.each(lambda target: extent_of(target).origin)[rows]
    larger = 1 / scenes.effects["marker_scale"][rows] - 1
    boxes = ink + (ink - np.tile(origin, 2)) * larger[:, None]
    return scenes.cameras.take(rows).project(board.in_space(boxes, scenes.plane[rows], per_side))


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
        # Points along the images of the sheets; NaN if not before the camera.
        optics, bend = scenes.cameras.optics(row), scene_sheet(scenes, row)
        points = np.concatenate([np.empty((0, 2)), *(
            polygon.sheet_pixels(rectangles(each.box[None], CHORDS_PER_SIDE)[0],
                                 Projection(each.plane, optics), bend)
            for each in seen_sheets(scenes, row)
        )])
        if not len(points):
            continue
        low[row], high[row] = points.min(axis=0) - 2, points.max(axis=0) + 2
    for row in np.flatnonzero([name == "warp" for name in scenes.renderer]).tolist():
        low[row], high[row] = _warp_extent(scenes, row)
    for row in np.flatnonzero(((low < 0) | (high > limit - 1)).any(axis=1)).tolist():
        low[row], high[row] = _in_frame(scenes, row, low[row], high[row])
    widened = scenes.effects.any_active(
        lambda effect: effect.spread_px is not None or effect.outline == "moving")
    for row in np.flatnonzero(widened & np.isfinite(low).all(axis=1)).tolist():
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
    target = scenes.targets[row]
    if (
        len(board.sheets_of(target)) == 1 or scenes.renderer[row] == "warp"
        or any(each.outline != "kept" for each in scenes.effects.active_in(row))
    ):
        return low, high
    reach = 0.0
    if scenes.effects.active[row]:
        reach = REACH * largest_spread_px(scenes, row) + max(
            each.reach_px for each in scenes.effects.plugins.effects
        )
    per_side = CHORDS_PER_SIDE if scenes.cameras.distorted[row] else 1
    sides = along_sides(board.sheets_m(target) * scenes.effects["marker_scale"][row], per_side)
    points = scenes.cameras.take(np.array([row])).project(
        sides.reshape(1, -1, 3) @ scenes.rotation[row].T + scenes.translation[row]
    ).reshape(len(sides), -1, 2)
    least, most = points.min(axis=1) - 2, points.max(axis=1) + 2
    seen = ((most + reach > 0) & (least - reach < scenes.frame[row])).all(axis=1)
    if not seen.any():
        return low, high
    return np.maximum(low, least[seen].min(axis=0)), np.minimum(high, most[seen].max(axis=0))


def _warp_extent(scenes: Scenes, row: int) -> tuple[Floats, Floats]:
    """Return the least and greatest pixels (2,) that the ``warp`` renderer may touch.

    It maps bitmap to image by the homography of the black square's corners, distorted by the lens,
    so that its quiet zone ends elsewhere than the marker's. Interpolation spreads it by half a
    pixel of the bitmap. If the homography's horizon crosses it, it may touch every pixel.
    """
    corners, extent = scenes.corners_px[row], extent_of(scenes.targets[row])
    if not np.isfinite(corners).all():
        return np.full(2, np.nan), np.full(2, np.nan)
    square = rectangles(extent.ink[None])[0].astype(np.float32)
    transform = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    half_px = 0.5 / WARP_PX_PER_MODULE * np.array([-1.0, -1.0, 1.0, 1.0])
    plane = np.array([transform], dtype=np.float64)
    (points,) = board.in_space(extent.sheet[None] + half_px, plane)
    if (points[:, 2] > 0).all():
        flat = points[:, :2] / points[:, 2:]
        return flat.min(axis=0) - 1, flat.max(axis=0) + 1
    return np.full(2, -0.5), scenes.frame[row] - 0.5


#: Most instants at which a moving target's extent is computed; a step is added on all sides.
MAX_INSTANTS = 8193

#: Turn between two instants above which the marker may point anywhere between them.
_COARSE_TURN = math.pi / 8


def _exposed_extent(scenes: Scenes, row: int, low: Floats, high: Floats) -> tuple[Floats, Floats]:
    """Return the extent, from ``low`` to ``high`` (2,) at rest, under motion and blur.

    NaN if the image has no meaning while rows that see the marker are exposed. At an instant a
    marker is seen by those rows that it covers and that are exposed then.
    """
    motion = scenes.motion(row)
    reach = largest_spread_px(scenes, row) * REACH
    reach = reach + 1 if reach > 0 else 0.0
    if not motion.moves:
        return low - reach, high + reach
    sheet = scene_sheet(scenes, row)
    if sheet.is_curved:
        reach += sheet.largest_px + 2
    row_time_s = motion.row_time_s
    begin, end = motion.exposed(0, int(scenes.frame[row, 1]))
    turn = float(np.linalg.norm(motion.velocity[3:])) * (end - begin)
    wanted = max(MIN_INSTANTS, (end - begin) / row_time_s if row_time_s > 0 else 0.0)
    count = int(min(max(wanted, 2 * turn / _COARSE_TURN), MAX_INSTANTS))
    times = np.linspace(begin, end, count)
    extents, states = track(
        scenes.projection(row), target_outline(scenes, row), scenes.targets[row].is_flat, motion,
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
    area = polygon.signed_areas(points)
    curved = np.flatnonzero(scenes.cameras.distorted & np.isfinite(area))
    if len(curved):
        area[curved] = polygon.signed_areas(_squares_px(scenes, curved, 256))
    return np.abs(area)


#: Sine of the angle to the line of sight below which a marker is seen edge on.
EDGE_ON = 1e-12


def hidden(scenes: Scenes) -> NDArray[np.bool_]:
    """Return (N,) whether a marker is seen from behind or edge on, or has a corner at z <= 0.

    The quiet zone's corners count, since the marker is drawn with it; not what is beside a board.
    """
    towards = np.sum(scenes.rotation[:, :, 2] * scenes.translation, axis=1)
    # A tilt of 90° is not quite one in double precision.
    shown = towards < -EDGE_ON * np.linalg.norm(scenes.translation, axis=1)
    for row in np.flatnonzero(scenes.solid).tolist():
        shown[row] = any(
            each.number < board.own_sheets(scenes.targets[row]) for each in seen_sheets(scenes, row)
        )
    behind: Masks = np.asarray(~np.isfinite(scenes.outline_px).all(axis=(1, 2)))
    for row in np.flatnonzero(behind).tolist():
        target = scenes.targets[row]
        if target.distractors and scenes.solid[row]:
            behind[row] = not np.isfinite(scenes.corners_px[row]).all()
        elif target.distractors:
            own = board.in_space(extent_of(target).target[None], scenes.plane[[row]])
            behind[row] = (own[..., 2] <= 0).any()
    return np.asarray(~shown | behind)


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
        unseen |= board.unseen_markers(scenes.targets[row], solid_planes(scenes, row), corners)
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


def _meets_frame(outline: Floats, limit: Floats) -> bool:
    """Return whether a polygon (M, 2) has a part of positive area in [-0.5, limit]."""
    for axis in (0, 1):
        for sign, bound in ((1.0, -0.5), (-1.0, -limit[axis])):
            outline = polygon.half_plane(outline, sign * outline[:, axis] - bound)
            if len(outline) < 3:
                return False
    return bool(np.abs(polygon.signed_areas(outline[None])[0]) > 0)


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
        folded[row] |= folds(quads[..., :2] / quads[..., 2:], lenses).any()
    rows = np.flatnonzero(bulging & ~scenes.solid)
    if len(rows):
        points = _outlines(scenes, rows, 1)
        folded[rows] |= folds(
            points[..., :2] / points[..., 2:], scenes.cameras.lenses[rows]
        )
    return folded


# --------------------------------------------------------------------------------------------------
# The visible prints of a target while its image is taken.

def _path_px(scenes: Scenes, row: int, motion: Motion, begin: float, end: float) -> float:
    """Return the longest path of a corner, in px, from a time to another."""
    linear = motion._replace(velocity=motion.velocity * np.array([1.0, 1, 1, 0, 0, 0]))
    extents, states = track(
        scenes.projection(row), target_outline(scenes, row), scenes.targets[row].is_flat, linear,
        np.linspace(begin, end, MIN_INSTANTS),
    )
    extents = extents[states != BEHIND]
    if not len(extents):
        return 0.0
    along = np.hypot(*np.abs(np.diff(extents, axis=0)).reshape(-1, 2, 2).max(axis=1).T).sum()
    around = np.hypot(*(extents[:, 2:] - extents[:, :2]).max(axis=0)) * (end - begin)
    return float(along + np.linalg.norm(motion.velocity[3:]) * around)


class Layer(NamedTuple):
    """The visible part of one sheet during a part of the exposure.

    Attributes
    ----------
    sheet
        The sheet at time 0.
    edges
        Edges of the visible part of its print.
    outline
        (M, 3) points around it: column, row, and height over its plane.
    begin_s, end_s
        The part of the time.
    """

    sheet: SeenSheet
    edges: MarkerEdges
    outline: Floats
    begin_s: float
    end_s: float


#: Path of a target in several planes between the instants at which is computed which sheets hide
#: which: an edge of a shadow lies where it does in the middle of the time, so that half of this
#: times the share by which one sheet moves against the other is its largest error.
OCCLUSION_PX = 0.5

MAX_SHADOWS = 512


def _layers(scenes: Scenes, row: int, motion: Motion, box: Box, beside: bool) -> list[Layer]:
    """Return the visible sheets of a scene in the rows of a box; ``beside``: distractors alone."""
    target, effect = scenes.targets[row], scenes.effects.of(row)
    if target.is_flat:
        (sheet,) = seen_sheets(scenes, row)
        edges = (
            board.beside_edges(target) if beside
            else board.occluded_edges(target, effect["occlusion"], effect["occlusion_deg"])
            if effect["occlusion"] > 0 else board.edges_of(target)
        )
        return [Layer(sheet, edges, target_outline(scenes, row), -math.inf, math.inf)]
    planes, boxes = solid_planes(scenes, row), board.sheet_boxes(target)
    begin_s, end_s = motion.exposed(box[1], box[3])
    path = _path_px(scenes, row, motion, begin_s, end_s) if motion.moves else 0.0
    count = min(max(math.ceil(path / OCCLUSION_PX), 1), MAX_SHADOWS)
    times = np.linspace(begin_s, end_s, count + 1)
    times[0], times[-1] = -math.inf, math.inf
    per_side = CHORDS_PER_SIDE if scenes.cameras.distorted[row] else 1
    layers = []
    for k in range(count):
        middle = begin_s + (k + 0.5) / count * (end_s - begin_s)
        moved = planes
        if motion.moves:
            moved = np.array([moved_plane(each, motion, middle) for each in planes])
        for seen in board.visible_prints(target, moved, board.own_sheets(target) if beside else 0):
            sheet = SeenSheet(seen.number, boxes[seen.number], planes[seen.number])
            (points,) = rectangles(sheet.box[None], per_side)
            around = np.column_stack([points, np.zeros(len(points))])
            layers.append(Layer(sheet, seen.edges, around, times[k], times[k + 1]))
    return layers


# --------------------------------------------------------------------------------------------------
# The exact image, unquantised.

#: Path of a corner between groups of three instants: the error at kinks of the mean over the
#: exposure is then at most 0.12 grey levels.
SHARP_PANEL_PX = 3 / 16

MAX_PANELS = 4093
#: Most panels of an exposure, and of each row's; primes, so that they resonate with no turn.
MAX_ROW_PANELS = 509

#: Smallest point spread that is computed if defocus varies over the image (a quarter of it if it
#: does not); between 0 and this the image is interpolated, with an error of at most 0.8 (0.2) grey
#: levels in single pixels.
SHARPEST_PX = 0.05

#: Ratio of neighbouring point spreads if defocus varies; the error of cubic interpolation in their
#: logarithm is then at most 0.1 grey levels.
SPREAD_RATIO = 1.4


def marker_exposure(
    scenes: Scenes, row: int, box: Box, levels: Floats, blurred: bool = False, beside: bool = False
) -> Floats:
    """Return the levels (height, width) of ``box``, from levels (4,) of the four areas.

    The areas are outside, black, white and the occluding sheet. With ``blurred`` it is the image
    that sharpening subtracts; with ``beside`` only what stands beside the target is drawn. Each
    sheet has the point spread of its own depth: where one hides another, the spreads of both meet
    at the edge.
    """
    shape = (box[3] - box[1], box[2] - box[0])
    if 0 in shape:
        return np.empty(shape)
    optics, bend = scenes.cameras.optics(row), scene_sheet(scenes, row)
    motion, curved = scenes.motion(row), bend if bend.is_curved or optics.distorted else None
    path, most = 0.0, MAX_PANELS if motion.row_time_s == 0 else MAX_ROW_PANELS
    if motion.exposure_s > 0:
        path = max(
            _path_px(scenes, row, motion, *motion.exposed(line, line + 1))
            for line in (box[1], (box[1] + box[3]) // 2, box[3] - 1)
        )
    cover = np.zeros((shape[0], shape[1] + 2))

    def draw(some: list[Layer], sigma: float, outside: float) -> Floats:
        """Return the image of layers with one point spread, over the level outside."""
        panels = math.ceil(min(path / max(SHARP_PANEL_PX, 1.5 * sigma), most))
        for layer in some:
            _expose(cover, layer, optics, motion, panels, levels, box[0], box[1], sigma, curved)
        image = np.empty(shape)
        coverage.sum_levels(cover, outside, image)
        return image

    # Layers with the same point spread in each pixel are drawn together.
    groups: dict[int, list[Layer]] = {}
    for layer in _layers(scenes, row, motion, box, beside):
        number = layer.sheet.number if is_defocused(scenes, row) else 0
        groups.setdefault(number, []).append(layer)
    parts: list[Floats] = []
    for some in groups.values():
        wanted = defocus_px(scenes, row, some[0].sheet, box, blurred)
        spreads, varies = _spreads(wanted)
        outside = 0.0 if parts else float(levels[0])
        images = np.array([draw(some, sigma, outside) for sigma in spreads])
        parts.append(_focused(images, np.array(spreads), wanted) if varies else images[0])
    return np.sum(parts, axis=0) if parts else np.full(shape, levels[0])


@compiled
def _expose(
    cover: Floats, layer: Layer, optics: Optics, motion: Motion, panels: int, levels: Floats,
    left: int, top: int, sigma: float, sheet: Sheet | None,
) -> None:
    """Add a layer's edges to ``cover``, averaged over each row's exposure.

    By three Gauss-Legendre nodes on each of ``panels`` parts of the exposure; without a part, at
    its middle alone. Instants at which the exposed rows see no part of the layer cost next to
    nothing.
    """
    at_rest, extent, margin = layer.sheet.plane, np.empty(4), REACH * sigma + 2.0
    margin += 0.0 if sheet is None else sheet.largest_px
    groups = cover.shape[0] if motion.row_time_s > 0.0 else 1
    for group in range(groups):
        rows = cover[group : group + 1] if motion.row_time_s > 0.0 else cover
        begin = motion.row_time_s * (top + group - motion.middle_row)
        for panel in range(max(panels, 1)):
            for node in range(3 if panels > 0 else 1):
                offset, weight = NODES[node], WEIGHTS[node]
                if panels == 0:
                    offset, weight = 0.5, 1.0
                instant = begin + motion.exposure_s * ((panel + offset) / max(panels, 1) - 0.5)
                if not layer.begin_s <= instant < layer.end_s:
                    continue
                plane = moved_plane(at_rest, motion, instant) if instant != 0.0 else at_rest
                projection = Projection(plane, optics)
                behind, _ = outline_extent(projection, layer.outline, extent)
                if (
                    behind == 0
                    and extent[2] - left > -margin
                    and extent[0] - left < rows.shape[1] - 2 + margin
                    and extent[3] - (top + group) > -margin
                    and extent[1] - (top + group) < rows.shape[0] + margin
                ):
                    coverage.accumulate(
                        rows, layer.edges, levels * (weight / max(panels, 1)), projection, left,
                        top + group, sigma, sheet,
                    )


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
