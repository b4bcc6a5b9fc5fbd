"""What is fitted of photographs: markers spread over the frame, their pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import TruthSource
from sweep.measure.surroundings import BoardMarker, clear_modules, edges_alone, surroundings
from sweep.model import coverage
from sweep.model.board import Board
from sweep.model.camera import Column
from sweep.model.coverage import MarkerEdges
from sweep.model.image_file import photograph_image
from sweep.model.lens import undistort
from sweep.model.marker import OUTSIDE, module_count, overhang
from sweep.model.polygon import Optics, Projection
from sweep.model.pose import angles_of_rotation
from sweep.model.scene import Scenes, build_scenes
from sweep.photographs.folder import find_corners, reference_detector
from sweep.photographs.pose_fit import Lens
from sweep.photographs.truth import board_poses
from sweep.typing import Floats, Grey, Integers, Masks

# --------------------------------------------------------------------------------------------------
# The scenes of photographs: their images, and where their markers are.

@dataclass(frozen=True, slots=True, eq=False)
class PhotographScenes:
    """The scenes of photographs: all markers in all of them, photograph by photograph.

    Attributes
    ----------
    scenes
        The N scenes.
    trial, source
        (N,) numbers of the photographs, and where the poses come from
        (:class:`~sweep.measure.flags.TruthSource`).
    """

    scenes: Scenes
    trial: Integers
    source: NDArray[np.uint8]

    @property
    def shown(self) -> Masks:
        """Which scenes have a true pose, (N,)."""
        return np.asarray(np.isfinite(self.scenes.corners_px).all(axis=(1, 2)))

    @property
    def frame(self) -> Floats:
        """Width and height of the photographs in px, (2,)."""
        return np.asarray(self.scenes.frame[0], dtype=np.float64)

    def lens(self, row: int) -> Lens:
        """Return the camera of a scene."""
        cameras = self.scenes.cameras
        return Lens(cameras.matrix(row), cameras.lenses[row, :14])


def photograph_scenes(pipeline: Pipeline, board: Board | None) -> PhotographScenes:
    """Return the scenes of the pipeline of photographs; of a stereo camera the left one's.

    A board that is in them says better where its markers are than the other camera, whose poses
    have the error of a single marker.
    """
    axes = pipeline.experiment.scene_axes
    lengths = [1 if axis.name == "stereo_camera" else len(axis) for axis in axes]
    indices = [each.ravel() for each in np.indices(lengths)]
    count = len(indices[0])
    trial = next(
        (index for axis, index in zip(axes, indices, strict=True) if axis.name == "trial"),
        np.zeros(count, dtype=np.int64),
    )
    values = pipeline.experiment.scene_values(indices)
    taken = PhotographScenes(
        build_scenes(values, count), trial, values["truth"].broadcast(count, np.uint8)
    )
    stereo = (taken.source == TruthSource.stereo_partner).any()
    return _by_board(taken, values, board) if stereo and board is not None else taken


def _by_board(
    taken: PhotographScenes, values: Mapping[str, Column], board: Board
) -> PhotographScenes:
    """Return the scenes with the poses of the board's markers, by its other corners."""
    find, scenes, count = reference_detector(), taken.scenes, len(taken.trial)
    rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    for number in np.unique(taken.trial).tolist():
        rows = np.flatnonzero(taken.trial == number)
        image = photograph_image(str(scenes.background[rows[0]]))
        poses = board_poses(
            board, taken.lens(rows[0]), image.shape[::-1], [find_corners(find, image, board)]
        ).poses
        for row in rows.tolist():
            marker = board.marker_ids.index(scenes.marker_id[row])
            rotation[row] = poses.rotation[0, marker]
            translation[row] = poses.translation[0, marker]
    with np.errstate(invalid="ignore"):
        angles = [np.degrees(each) for each in angles_of_rotation(rotation)]
    names = "resolved_tilt_deg", "resolved_azimuth_deg", "resolved_roll_deg"
    known = np.isfinite(translation[:, 2])
    source = np.where(known, TruthSource.board_without_this_marker, TruthSource.none)
    posed = {**values, **{
        name: Column.of(each) for name, each in zip(
            (*names, "x_m", "y_m", "distance_m"), (*angles, *translation.T), strict=True
        )
    }}
    return PhotographScenes(build_scenes(posed, count), taken.trial, source.astype(np.uint8))


# --------------------------------------------------------------------------------------------------
# The simulator's exact image of what is printed, drawn from the corners of a marker.

@compiled
def _rays(pixels: Floats, optics: Optics) -> Floats:
    """Return the undistorted directions x/z, y/z (n, 2) of pixels (n, 2)."""
    rays = np.empty_like(pixels)
    fx, fy, cx, cy = optics.intrinsics
    for k in range(len(pixels)):
        x, y = (pixels[k, 0] - cx) / fx, (pixels[k, 1] - cy) / fy
        if optics.distorted:
            x, y, _ = undistort(x, y, optics.lens)
        rays[k, 0], rays[k, 1] = x, y
    return rays


def module_plane(corners_px: Floats, modules: int, optics: Optics) -> Floats:
    """Return a plane (3, 3) that takes a square of modules to four corners (4, 2) in pixels."""
    rays = _rays(np.ascontiguousarray(corners_px), optics)
    square = modules * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rows = []
    for (u, v), (x, y) in zip(square.tolist(), rays.tolist(), strict=True):
        rows.append([u, v, 1, 0, 0, 0, -x * u, -x * v])
        rows.append([0, 0, 0, u, v, 1, -y * u, -y * v])
    solution = np.linalg.solve(np.array(rows), rays.ravel())
    return np.append(solution, 1.0).reshape(3, 3)


def module_points(plane: Floats, optics: Optics, height: int, width: int) -> Floats:
    """Return the column and row in modules (2, height, width) of the pixels of a box."""
    columns, rows = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    rays = _rays(np.stack([columns.ravel(), rows.ravel()], axis=1), optics)
    flat = cv2.perspectiveTransform(rays[None], np.linalg.inv(plane))[0]
    return np.asarray(flat.T.reshape(2, height, width), dtype=np.float64)


def shares(
    edges: MarkerEdges, values: Floats, plane: Floats, optics: Optics, size: tuple[int, int],
    blur_px: float, shift: tuple[float, float] = (0.0, 0.0),
) -> Floats:
    """Return the image (height, width) of values (3,) of outside, black and white.

    ``shift`` moves it right and down, in px. Beyond the edges is the value of black.
    """
    height, width = size
    intrinsics = optics.intrinsics.copy()
    intrinsics[2:] += shift
    cover, image = np.zeros((height, width + 2)), np.empty(size)
    coverage.accumulate(
        cover, edges, values, Projection(plane, Optics(intrinsics, optics.lens, optics.distorted)),
        0, 0, blur_px,
    )
    coverage.sum_levels(cover, float(values[1]), image)
    return image


# --------------------------------------------------------------------------------------------------
# What is fitted of photographs: the pixels of some markers, well spread over each frame.

RING_MODULES = 1.5
"""Widest part of the quiet zone that is fitted, in modules."""

MODELLED_PX = 10.0
"""Pixels around the fitted ones within which print is in the model: what blur and sharpening
carry inwards."""

OUTSIDE_BLUR_PX, OUTSIDE_SHARE = 2.0, 1e-3
"""Pixels that get more than this share from outside the print through that point spread are left
out: nothing is known of what lies there."""

SATURATED = 254.0
"""Level from which white is taken to be cut off; compression moves it a little."""

MIN_SIDE_PX = 12.0
"""Side of a marker below which its pixels say too little."""


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class FittedMarker:
    """The pixels of one marker in one photograph, and what is known of them.

    Attributes
    ----------
    levels, used
        (h, w) grey levels of a box, and which pixels are fitted.
    optics
        The camera; its principal point is relative to the box.
    edges
        What is printed, in modules; black beyond.
    modules
        Along the side of the black square.
    corners_px
        (4, 2) the true corners of the black square in the box: TL, TR, BR, BL.
    shape
        (4, h, w) the share of each corner in the shift of a pixel.
    frame_px
        (2,) first pixel of the box in the frame.
    row
        Number of its scene.
    ground
        Median level around the marker and what is its own quiet zone.
    """

    levels: Floats
    used: Masks
    optics: Optics
    edges: MarkerEdges
    modules: int
    corners_px: Floats
    shape: Floats
    frame_px: Integers
    row: int
    ground: float

    @property
    def modules_at(self) -> Floats:
        """Column and row of the pixels as shares of the black square's side, (2, h, w)."""
        return np.stack([self.shape[1] + self.shape[2], self.shape[2] + self.shape[3]])


@dataclass(frozen=True, slots=True, eq=False)
class FittedPhotograph:
    """The fitted markers of one photograph, and its number."""

    number: int
    markers: tuple[FittedMarker, ...]


def photograph_views(
    taken: PhotographScenes, board: Board | None, most: int
) -> list[FittedPhotograph]:
    """Return what is fitted of each photograph that shows a marker: at most ``most`` markers.

    They are those farthest from one another, beginning with the one nearest the frame's centre.
    """
    scenes, views = taken.scenes, []
    for number in np.unique(taken.trial).tolist():
        rows = np.flatnonzero(taken.shown & (taken.trial == number))
        if not len(rows):
            continue
        image = photograph_image(str(scenes.background[rows[0]]))
        fitted = [
            view for row in _spread(scenes, rows, most)
            if (view := marker_view(scenes, row, board, image)) is not None
        ]
        if fitted:
            views.append(FittedPhotograph(number, tuple(fitted)))
    return views


def _spread(scenes: Scenes, rows: Integers, most: int) -> list[int]:
    """Return at most ``most`` of some scenes, the farthest from one another in the frame."""
    corners = scenes.corners_px[rows]
    side = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).min(axis=1)
    rows, corners = rows[side >= MIN_SIDE_PX], corners[side >= MIN_SIDE_PX]
    if len(rows) <= most:
        return list(map(int, rows))
    centres = corners.mean(axis=1)
    middle = scenes.frame[rows[0]] / 2
    chosen = [int(np.argmin(np.linalg.norm(centres - middle, axis=1)))]
    while len(chosen) < most:
        distance = np.linalg.norm(centres[:, None] - centres[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return [int(rows[k]) for k in sorted(chosen)]


def marker_view(
    scenes: Scenes, row: int, board: Board | None, image: Grey
) -> FittedMarker | None:
    """Return the pixels of the marker of a scene in a photograph (height, width); None for few."""
    marker = scenes.target(row)
    dictionary, marker_id = marker.dictionary, marker.marker_ids[0]
    modules = module_count(dictionary)
    on_board = None
    if board is not None and marker_id in board.marker_ids:
        on_board = BoardMarker(board, board.marker_ids.index(marker_id))
    corners = scenes.corners_px[row]
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
    clear = marker.margin or 0.0 if on_board is None else clear_modules(on_board)
    ring = min(max(clear, overhang(dictionary) + 0.5), overhang(dictionary) + RING_MODULES)
    extent = np.ceil(4.0 * (ring + MODELLED_PX * modules / side)) / 4.0
    edges = (
        edges_alone(marker, extent) if on_board is None
        else surroundings(on_board, extent)
    )
    to_pixels = cv2.getPerspectiveTransform(
        (modules * SQUARE).astype(np.float32), corners.astype(np.float32)
    )
    outline, beyond = (
        cv2.perspectiveTransform((modules * SQUARE + wide * (2 * SQUARE - 1))[None], to_pixels)[0]
        for wide in (ring, clear + 1.0)
    )
    frame = np.array(image.shape[::-1])
    low = np.maximum(np.floor(outline.min(axis=0)).astype(np.int64) - 1, 0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(np.int64) + 2, frame)
    if (high - low < 4).any():
        return None
    optics = scenes.cameras.optics(row)
    local = optics.intrinsics.copy()
    local[2:] -= low
    optics = Optics(local, optics.lens, optics.distorted)
    width, height = (high - low).tolist()
    plane = module_plane(corners - low, modules, optics)
    points = module_points(plane, optics, height, width)
    used = np.asarray(((points > -ring) & (points < modules + ring)).all(axis=0))
    if (edges.sides == OUTSIDE).any():
        values = np.zeros(3)
        values[OUTSIDE] = 1.0
        outer = shares(edges, values, plane, optics, (height, width), OUTSIDE_BLUR_PX)
        used &= outer < OUTSIDE_SHARE
    if used.sum() < MIN_SIDE_PX**2:
        return None
    x, y = points / modules
    shape = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y])
    return FittedMarker(
        image[low[1] : high[1], low[0] : high[0]].astype(np.float64), used, optics, edges, modules,
        corners - low, shape, low, row, _along(image, beyond),
    )


def _along(image: Grey, outline: Floats) -> float:
    """Return the median level along an outline (4, 2) in pixels; NaN outside the image."""
    t = np.linspace(0.0, 1.0, 20, endpoint=False)[:, None, None]
    points = np.rint((1 - t) * outline + t * np.roll(outline, -1, axis=0)).reshape(-1, 2)
    inside = ((points >= 0) & (points < image.shape[::-1])).all(axis=1)
    columns, rows = points[inside].astype(np.int64).T
    return float(np.median(image[rows, columns])) if inside.any() else np.nan


def is_saturated(photograph: FittedPhotograph) -> bool:
    """Return whether the brightest tenth of a photograph's fitted pixels is cut off at 255."""
    levels = np.concatenate([each.levels[each.used] for each in photograph.markers])
    return float(np.quantile(levels, 0.9)) >= SATURATED
