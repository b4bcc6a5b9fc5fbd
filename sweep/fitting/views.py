"""Pixels of photographs that are fitted: markers spread over the frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.experiment.pipeline import Pipeline
from sweep.measure.photograph import add_plane, system
from sweep.measure.surroundings import BoardMarker, clear_modules, ring_modules, surroundings
from sweep.model.board import Board
from sweep.model.coverage import MarkerEdges
from sweep.model.image_file import photograph_image
from sweep.model.marker import OUTSIDE, module_count, overhang
from sweep.model.polygon import Optics, Projection, side_lengths
from sweep.model.scene import Scenes, build_scenes
from sweep.photographs.pose_fit import Lens, cameras_of
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


def photograph_scenes(pipeline: Pipeline) -> PhotographScenes:
    """Return the scenes of a pipeline of one camera's photographs."""
    axes = pipeline.experiment.scene_axes
    indices = [each.ravel() for each in np.indices([len(axis) for axis in axes])]
    count = len(indices[0])
    trial = next(
        (index for axis, index in zip(axes, indices, strict=True) if axis.name == "trial"),
        np.zeros(count, dtype=np.int64),
    )
    values = pipeline.experiment.scene_values(indices)
    return PhotographScenes(
        build_scenes(values, count), trial, values["truth"].broadcast(count, np.uint8)
    )


# --------------------------------------------------------------------------------------------------
# The image of printed edges in pixels, and its slopes.

#: Values of outside, black and white in the image of the share of white.
WHITE_SHARE = np.array([0.0, 0.0, 1.0])

#: The projection of edges that are given in pixels.
IN_PIXELS = Projection(
    np.eye(3), Optics(np.array([1.0, 1.0, 0.0, 0.0]), np.zeros(24), distorted=False)
)

#: Least length of the pieces in which edges are integrated.
PANEL_PX = 0.4


class Drawn(NamedTuple):
    """The share of white (h, w), its slopes along x, along y and by the point spread's variance.

    And the share of the area outside the print.
    """

    white: Floats
    by_x: Floats
    by_y: Floats
    by_variance: Floats
    outside: Floats


def drawn(ends: Floats, sides: Integers, size: tuple[int, int], sigma_px: float) -> Drawn:
    """Return the image (height, width) of edges in pixels, (E, 2, 2), through a point spread."""
    height, width = size
    space = system(height, width)
    edges = MarkerEdges(np.ascontiguousarray(ends.reshape(-1, 4)), sides)
    add_plane(space, edges, WHITE_SHARE, IN_PIXELS, sigma_px, PANEL_PX)
    steps = space.rates.reshape(height, width + 1, 4)[:, :width]
    return Drawn(
        np.cumsum(steps[..., 0], axis=1), steps[..., 1], steps[..., 2], steps[..., 3],
        np.cumsum(space.outside[:, :width], axis=1),
    )


# --------------------------------------------------------------------------------------------------
# Pixels that are fitted: of some markers, well spread over each frame.

#: Pixels around the fitted ones within which print is in the model: what blur and sharpening carry
#: inwards.
MODELLED_PX = 10.0

#: Pixels that get more than this share from outside the print through that point spread are left
#: out: nothing is known of what lies there.
OUTSIDE_BLUR_PX, OUTSIDE_SHARE = 2.0, 1e-3

#: Level from which white is taken to be cut off; compression moves it a little.
SATURATED = 254.0

#: Side of a marker below which its pixels say too little.
MIN_SIDE_PX = 12.0


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class FittedMarker:
    """The pixels of one marker in one photograph, with its true pose and print.

    Attributes
    ----------
    levels, used
        (h, w) grey levels of a box, and which pixels are fitted.
    ends, sides
        (E, 2, 2) start and end of the print's edges at its true pose, in px of the box,
        none longer than a module; (E, 2) the areas beside them. Black beyond.
    ends_at, at
        (E, 2, 2) of these points and (2, h, w) of the pixels: column and row as shares of the black
        square's side.
    corners_px
        (4, 2) the true corners of the black square in the box: TL, TR, BR, BL.
    modules, module_px
        Along the side of the black square, and the mean length of one in the image.
    reach
        How far the marker's own print reaches beyond the square, and half a module, as a share of
        its side.
    frame_px
        (2,) first pixel of the box in the frame.
    row
        Number of its scene.
    ground
        Median level around the marker and its own quiet zone.
    """

    levels: Floats
    used: Masks
    ends: Floats
    sides: Integers
    ends_at: Floats
    at: Floats
    corners_px: Floats
    modules: int
    module_px: float
    reach: float
    frame_px: Integers
    row: int
    ground: float


@dataclass(frozen=True, slots=True, eq=False)
class FittedPhotograph:
    """The fitted markers of one photograph, and its number."""

    number: int
    markers: tuple[FittedMarker, ...]


def photograph_views(
    taken: PhotographScenes, board: Board | None, most: int
) -> list[FittedPhotograph]:
    """Return the fitted pixels of each photograph that shows a marker: at most ``most`` markers.

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
            if (view := marker_view(taken, row, board, image)) is not None
        ]
        if fitted:
            views.append(FittedPhotograph(number, tuple(fitted)))
    return views


def _spread(scenes: Scenes, rows: Integers, most: int) -> list[int]:
    """Return at most ``most`` of some scenes, the farthest from one another in the frame."""
    corners = scenes.corners_px[rows]
    rows, corners = (each[side_lengths(corners).min(axis=1) >= MIN_SIDE_PX]
                     for each in (rows, corners))
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
    taken: PhotographScenes, row: int, board: Board | None, image: Grey
) -> FittedMarker | None:
    """Return the pixels of the marker of a scene in a photograph (height, width); None for few."""
    scenes, lens = taken.scenes, taken.lens(row)
    marker, corners = scenes.targets[row], scenes.corners_px[row]
    dictionary, marker_id = marker.dictionary, marker.marker_ids[0]
    modules = module_count(dictionary)
    module_px = float(side_lengths(corners[None]).mean()) / modules
    on_board = None
    if board is not None and marker_id in board.marker_ids:
        on_board = BoardMarker(board, board.marker_ids.index(marker_id))
    clear = marker.margin or 0.0 if on_board is None else clear_modules(on_board)
    ring = ring_modules(marker, on_board)
    extent = np.ceil(4.0 * (ring + MODELLED_PX / module_px)) / 4.0
    edges = surroundings(on_board or marker, float(extent))

    def pixels(points: Floats) -> Floats:
        """Return the true images (n, 2) of columns and rows (n, 2) in modules."""
        flat = (points / modules - 0.5) * scenes.size_m[row] * [1.0, -1.0]
        return lens.project(
            np.column_stack([flat, np.zeros(len(flat))]), scenes.rotation[row],
            scenes.translation[row],
        )

    outline, beyond = (
        pixels(modules * SQUARE + wide * (2.0 * SQUARE - 1.0)) for wide in (ring, clear + 1.0)
    )
    low = np.maximum(np.floor(outline.min(axis=0)).astype(np.int64) - 1, 0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(np.int64) + 2, image.shape[::-1])
    if (high - low < 4).any():
        return None
    width, height = (high - low).tolist()
    columns, rows = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    rays = cameras_of(lens, 1).normalise(
        np.stack([columns, rows], axis=2).reshape(1, -1, 2).astype(np.float64))
    to_modules = np.linalg.inv(scenes.plane[row])
    at = cv2.perspectiveTransform(rays, to_modules).reshape(height, width, 2)
    used = np.asarray(((at > -ring) & (at < modules + ring)).all(axis=2))
    pieces, sides = _split(edges)
    ends = pixels(pieces.reshape(-1, 2)).reshape(-1, 2, 2) - low
    if (sides == OUTSIDE).any():
        used &= drawn(ends, sides, used.shape, OUTSIDE_BLUR_PX).outside < OUTSIDE_SHARE
    if used.sum() < MIN_SIDE_PX**2:
        return None
    return FittedMarker(
        image[low[1] : high[1], low[0] : high[0]].astype(np.float64), used, ends, sides,
        pieces / modules, np.moveaxis(at, 2, 0) / modules, corners - low, modules, module_px,
        (overhang(dictionary) + 0.5) / modules, low, row, _along(image, beyond),
    )


def _split(edges: MarkerEdges) -> tuple[Floats, Integers]:
    """Return the pieces (E, 2, 2) of edges, none longer than a module, and their sides (E, 2)."""
    start, stop = edges.ends[:, :2], edges.ends[:, 2:]
    count = np.ceil(np.linalg.norm(stop - start, axis=1)).astype(np.int64).clip(min=1)
    edge = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    t = np.stack([number, number + 1], axis=1) / count[edge, None]
    pieces = start[edge, None] + t[..., None] * (stop - start)[edge, None]
    return pieces, np.ascontiguousarray(edges.sides[edge])


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
