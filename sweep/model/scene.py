"""Scenes: cameras, markers and poses put together, and what of them can be seen."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.model import lens as lens_model
from sweep.model.camera import VIEW_PARAMETERS, Cameras, intrinsics
from sweep.model.declaration import parameter
from sweep.model.marker import MarkerKey, marker_corners, module_count
from sweep.model.pose import placed, rotation_of_angles

Floats = NDArray[np.float64]
Key = TypeVar("Key")

WARP_PX_PER_MODULE = 10
"""Resolution of the bitmap that the ``warp`` renderer maps (the paper's)."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What surrounds the marker, and how its image is made."""

    renderer: str = parameter(
        "exact",
        "exact: area coverage; warp: the paper's, 10 px a module, INTER_LINEAR; supersample-N: "
        "N x N regular samples a pixel; supersample-N-jittered: at random within their cells",
    )
    window: str = parameter(
        "auto",
        "auto: render and search what the marker can influence; full: the whole frame",
        choices=("auto", "full"),
    )
    black: float = parameter(
        0.0, "level of black", unit="grey level", low=0, high=255, drawable=True
    )
    white: float = parameter(
        255.0, "level of white", unit="grey level", low=0, high=255, drawable=True
    )
    background: float | str = parameter(
        0.0,
        "level beside the marker, or an image file of exactly the frame's size (path relative to "
        "the pipeline file)",
        unit="grey level", low=0, high=255, drawable=True,
    )


@dataclass(frozen=True, slots=True)
class Scenes:
    """N scenes as arrays.

    Attributes
    ----------
    frame
        (N, 2) width and height in pixels.
    dictionary, marker_id, quiet_zone, renderer, background
        One value for each scene; the quiet zone is 0 where the background has its level.
    markers, marker
        The distinct markers (dictionary, ID, quiet zone), and (N,) which one a scene has.
    modules
        (N,) modules along the black square's side.
    size_m
        (N,) side of the black square.
    rotation, translation
        (N, 3, 3) and (N, 3): the true pose, metres, camera frame.
    plane
        (N, 3, 3) takes module coordinates (column, row, 1) to the camera frame.
    levels
        (N, 3) grey levels of the background (0 where it is an image), black and white.
    plain
        (N,) whether the image is an exact one on a background of one level.
    corners_px, outline_px
        (N, 4, 2) images of the black square's and of the quiet zone's corners; NaN at z <= 0.
    """

    cameras: Cameras
    frame: NDArray[np.int64]
    dictionary: Sequence[str]
    marker_id: Sequence[int]
    quiet_zone: Floats
    markers: tuple[MarkerKey, ...]
    marker: NDArray[np.int64]
    modules: Floats
    size_m: Floats
    rotation: Floats
    translation: Floats
    plane: Floats
    levels: Floats
    corners_px: Floats
    outline_px: Floats
    renderer: Sequence[str]
    background: Sequence[float | str]
    plain: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.frame)


def build_scenes(values: Mapping[str, Any], count: int) -> Scenes:
    """Return ``count`` scenes from parameter values, each one value for all or one a scene.

    ``values`` has every parameter of camera, marker, pose and scene (``distance_m`` resolved,
    ``distortion`` canonical) and ``shift_u_px``, ``shift_v_px``: the drawn jitter.
    """
    def numbers(name: str) -> Floats:
        column = np.asarray(values[name], dtype=np.float64)
        return np.ascontiguousarray(np.broadcast_to(column, (count,)))

    def mapped(function: Callable[..., Any], *names: str) -> list[Any]:
        """Return a function of some values for each scene, called once where all are the same."""
        given = [values[name] for name in names]
        if not any(isinstance(value, (list, np.ndarray)) for value in given):
            return [function(*given)] * count
        each = [
            value if isinstance(value, (list, np.ndarray)) else itertools.repeat(value)
            for value in given
        ]
        return [function(*row) for row in itertools.islice(zip(*each, strict=False), count)]

    fx, fy, cx, cy = (
        np.broadcast_to(np.asarray(number, dtype=np.float64), (count,))
        for number in intrinsics(
            *(None if values[name] is None else numbers(name) for name in VIEW_PARAMETERS)
        )
    )
    lenses, lens = distinct(mapped(tuple, "distortion"))
    cameras = Cameras(
        np.stack([fx, fy, cx, cy], axis=1),
        np.array([lens_model.pack(coefficients) for coefficients in lenses])[lens],
        np.array([len(coefficients) > 0 for coefficients in lenses], dtype=bool)[lens],
    )

    # Step 4: the pose.
    rotation = rotation_of_angles(
        *(np.radians(numbers(name)) for name in ("tilt_deg", "azimuth_deg", "roll_deg"))
    )
    distance = numbers("distance_m")
    translation = np.stack(
        [
            distance * (np.tan(np.radians(numbers("bearing_x_deg"))) + numbers("shift_u_px") / fx),
            distance * (np.tan(np.radians(numbers("bearing_y_deg"))) + numbers("shift_v_px") / fy),
            distance,
        ],
        axis=1,
    )

    # Steps 2, 3, 5, 6: the corners, moved by the pose and projected.
    size = numbers("size_m")
    # A quiet zone on a background of its own level cannot be seen: it is not modelled.
    keys = mapped(
        lambda dictionary, marker_id, width, white, background: (
            dictionary, int(marker_id), 0.0 if background == white else float(width)
        ),
        "dictionary", "marker_id", "quiet_zone_modules", "white", "background",
    )
    markers, marker = distinct(keys)
    modules = np.array([module_count(key[0]) for key in markers], dtype=np.float64)[marker]
    quiet = np.array([key[2] for key in markers])[marker]
    half, module = size / 2, size / modules
    plane = np.empty((count, 3, 3))
    plane[:, :, 0] = rotation[:, :, 0] * module[:, None]
    plane[:, :, 1] = -rotation[:, :, 1] * module[:, None]
    plane[:, :, 2] = (
        translation - (rotation[:, :, 0] - rotation[:, :, 1]) * half[:, None]
    )
    outline_size = size * (1 + 2 * quiet / modules)
    corners_px, outline_px = (
        cameras.project(placed(marker_corners(side), rotation, translation))
        for side in (size, outline_size)
    )

    levels = np.stack(
        [
            np.array(mapped(lambda b: 0.0 if isinstance(b, str) else float(b), "background")),
            numbers("black"),
            numbers("white"),
        ],
        axis=1,
    )
    return Scenes(
        cameras=cameras,
        frame=np.stack([numbers("width_px"), numbers("height_px")], axis=1).astype(np.int64),
        dictionary=[key[0] for key in keys],
        marker_id=[key[1] for key in keys],
        quiet_zone=quiet,
        markers=markers,
        marker=marker,
        modules=modules,
        size_m=size,
        rotation=rotation,
        translation=translation,
        plane=plane,
        levels=levels,
        corners_px=corners_px,
        outline_px=outline_px,
        renderer=mapped(str, "renderer"),
        background=mapped(lambda level: level, "background"),
        plain=np.array(
            mapped(lambda name, level: name == "exact" and not isinstance(level, str),
                   "renderer", "background"), dtype=bool,
        ),
    )


def distinct(keys: Sequence[Key]) -> tuple[tuple[Key, ...], NDArray[np.int64]]:
    """Return the distinct ones of N keys in order of appearance, and (N,) which one each is."""
    number: dict[Key, int] = {}
    index = [number.setdefault(key, len(number)) for key in keys]
    return tuple(number), np.array(index, dtype=np.int64)


def _outline(scenes: Scenes, rows: NDArray[np.intp], quiet: bool, per_side: int) -> Floats:
    """Return points (n, 4 · per_side, 2) along the images of the outline or the black square."""
    modules = scenes.modules[rows]
    margin = scenes.quiet_zone[rows] if quiet else np.zeros(len(rows))
    low, high = -margin[:, None], (modules + margin)[:, None]
    t = np.arange(per_side) / per_side
    ahead, back = low + t * (high - low), high - t * (high - low)
    columns = np.concatenate([ahead, np.repeat(high, per_side, 1), back,
                              np.repeat(low, per_side, 1)], axis=1)
    lines = np.concatenate([np.repeat(low, per_side, 1), ahead,
                            np.repeat(high, per_side, 1), back], axis=1)
    flat = np.stack([columns, lines, np.ones_like(columns)], axis=2)
    return scenes.cameras.take(rows).project(
        np.ascontiguousarray(flat @ np.swapaxes(scenes.plane[rows], 1, 2))
    )


CHORDS_PER_SIDE = 32
"""Points at which a bent outline is looked at for its extent: its bulge between them is less
than 1/1000 of the side's, well inside the 2 px that :func:`marker_boxes` adds under a lens."""


def marker_boxes(scenes: Scenes) -> NDArray[np.int64]:
    """Return the boxes (N, 4) left, top, right, bottom (half-open) of pixels a marker may touch.

    Clipped at the frame; empty (all zero) where nothing of the marker is in it.
    """
    low, high = scenes.outline_px.min(axis=1), scenes.outline_px.max(axis=1)
    bent = np.flatnonzero(scenes.cameras.distorted & np.isfinite(low).all(axis=1))
    if len(bent):
        points = _outline(scenes, bent, quiet=True, per_side=CHORDS_PER_SIDE)
        low[bent], high[bent] = points.min(axis=1) - 2, points.max(axis=1) + 2
    warped = np.flatnonzero([name == "warp" for name in scenes.renderer])
    if len(warped):
        low[warped], high[warped] = _warp_extent(scenes, warped)
    limit = scenes.frame.astype(np.float64)
    with np.errstate(invalid="ignore"):
        start = np.clip(np.floor(low + 0.5), 0, limit)
        stop = np.clip(np.ceil(high + 0.5), 0, limit)
        inside = (stop > start).all(axis=1)
    boxes = np.concatenate([start, stop], axis=1)
    return np.where(inside[:, None], boxes, 0.0).astype(np.int64)


def _warp_extent(scenes: Scenes, rows: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return the least and greatest pixels (n, 2) that the ``warp`` renderer may touch.

    It maps bitmap to image by the homography of the black square's corners, bent ones under a
    lens, so its quiet zone ends elsewhere than the marker's. Interpolation spreads it by half a
    pixel of the bitmap. Where the homography's horizon crosses it, it reaches everywhere.
    """
    low, high = np.full((len(rows), 2), np.nan), np.full((len(rows), 2), np.nan)
    for i, row in enumerate(rows.tolist()):
        corners = scenes.corners_px[row]
        if not np.isfinite(corners).all():
            continue
        n = scenes.modules[row]
        margin = scenes.quiet_zone[row] + 0.5 / WARP_PX_PER_MODULE
        square = np.array([[0, 0], [n, 0], [n, n], [0, n]], dtype=np.float32)
        transform = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
        outline = square + np.sign(square - n / 2) * margin
        points = np.column_stack([outline, np.ones(4)]) @ np.asarray(transform).T
        if (points[:, 2] > 0).all():
            flat = points[:, :2] / points[:, 2:]
            low[i], high[i] = flat.min(axis=0) - 1, flat.max(axis=0) + 1
        else:
            low[i], high[i] = -0.5, scenes.frame[row] - 0.5
    return low, high


def areas_px(scenes: Scenes) -> Floats:
    """Return the projected black square's area (N,) in px², bent edges followed."""
    points = scenes.corners_px
    area = _shoelace(points)
    bent = np.flatnonzero(scenes.cameras.distorted & np.isfinite(area))
    if len(bent):
        area[bent] = _shoelace(_outline(scenes, bent, quiet=False, per_side=256))
    return np.abs(area)


def _shoelace(points: Floats) -> Floats:
    """Return the signed areas (N,) of polygons (N, M, 2)."""
    local = points - points[:, :1]
    following = np.roll(local, -1, axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        doubled = local[..., 0] * following[..., 1] - local[..., 1] * following[..., 0]
        return np.asarray(0.5 * doubled.sum(axis=1))


def hidden(scenes: Scenes) -> NDArray[np.bool_]:
    """Tell (N,) where a marker is seen from behind or edge on, or has a corner at z <= 0.

    The quiet zone's corners count, for the marker is drawn with it.
    """
    facing = np.sum(scenes.rotation[:, :, 2] * scenes.translation, axis=1) < 0
    return np.asarray(~facing | ~np.isfinite(scenes.outline_px).all(axis=(1, 2)))


def outside_frame(scenes: Scenes, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Tell (n,) for scenes ``rows`` (n,) where the black square lies wholly outside the frame."""
    corners, limit = scenes.corners_px[rows], scenes.frame[rows] - 0.5
    outside = np.zeros(len(rows), dtype=bool)
    cut = ((corners < -0.5) | (corners > limit[:, None])).any(axis=(1, 2))
    for i in np.flatnonzero(cut):
        polygon = corners[i]
        if scenes.cameras.distorted[rows[i]]:
            polygon = _outline(scenes, rows[i : i + 1], False, CHORDS_PER_SIDE)[0]
        outside[i] = not _meets_frame(polygon, limit[i])
    return outside


def _meets_frame(polygon: Floats, limit: Floats) -> bool:
    """Tell whether a polygon (M, 2) has a part of positive area in [-0.5, limit]."""
    for axis in (0, 1):
        for sign, bound in ((1.0, -0.5), (-1.0, -limit[axis])):
            polygon = _half_plane(polygon, sign * polygon[:, axis] - bound)
            if len(polygon) < 3:
                return False
    return bool(np.abs(_shoelace(polygon[None])[0]) > 0)


def _half_plane(polygon: Floats, inside: Floats) -> Floats:
    """Clip a polygon (M, 2) to where the linear function ``inside`` (M,) is not negative."""
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if inside[i] >= 0:
            kept.append(polygon[i])
        if (inside[i] >= 0) != (inside[j] >= 0):
            t = inside[i] / (inside[i] - inside[j])
            kept.append(polygon[i] + t * (polygon[j] - polygon[i]))
    return np.array(kept).reshape(-1, 2)


def not_modelled(scenes: Scenes) -> NDArray[np.bool_]:
    """Tell (N,) where the lens model folds on the marker, so that its image has no meaning."""
    folded = np.zeros(len(scenes), dtype=bool)
    rows = np.flatnonzero(scenes.cameras.distorted & np.isfinite(scenes.outline_px).all((1, 2)))
    if len(rows):
        widened = 1 + 2 * scenes.quiet_zone[rows] / scenes.modules[rows]
        outline = marker_corners(scenes.size_m[rows] * widened)
        points = placed(outline, scenes.rotation[rows], scenes.translation[rows])
        folded[rows] = lens_model.folds(
            np.ascontiguousarray(points[..., :2] / points[..., 2:]),
            scenes.cameras.lenses[rows],
        )
    return folded
