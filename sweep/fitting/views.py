"""What is fitted of photographs: the pixels of some markers, well spread over each frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sweep.fitting.rendering import module_plane, module_points, shares
from sweep.fitting.scenes import PhotographScenes
from sweep.measure.surroundings import BoardMarker, clear_modules, edges_alone, surroundings
from sweep.model.board import Board
from sweep.model.coverage import MarkerEdges
from sweep.model.marker import OUTSIDE, module_count, overhang
from sweep.model.photograph import photograph_image
from sweep.model.projection import Optics
from sweep.model.scene import Scenes
from sweep.typing import Floats, Grey, Integers, Masks

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
    shape, across
        (4, h, w) the share of each corner in the shift of a pixel, and (2, h, w) px right and down
        from the marker's centre, over half its side.
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
    across: Floats
    frame_px: Integers
    row: int
    ground: float

    @property
    def modules_at(self) -> Floats:
        """Column and row of the pixels as shares of the black square's side, (2, h, w)."""
        return np.stack([self.shape[1] + self.shape[2], self.shape[2] + self.shape[3]])

    @property
    def centre_px(self) -> Floats:
        """The image of the square's centre in the frame, (2,)."""
        return marker_centre(self.corners_px) + self.frame_px


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
    dictionary, marker_id, margin = scenes.markers[scenes.marker[row]]
    modules = module_count(dictionary)
    on_board = None
    if board is not None and marker_id in board.marker_ids:
        on_board = BoardMarker(board, board.marker_ids.index(marker_id))
    corners = scenes.corners_px[row]
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())
    clear = margin if on_board is None else clear_modules(on_board)
    ring = min(max(clear, overhang(dictionary) + 0.5), overhang(dictionary) + RING_MODULES)
    extent = np.ceil(4.0 * (ring + MODELLED_PX * modules / side)) / 4.0
    edges = (
        edges_alone((dictionary, marker_id, margin), extent) if on_board is None
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
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)))
    across = (pixels - marker_centre(corners - low)[:, None, None]) / (side / 2)
    shape = np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y])
    return FittedMarker(
        image[low[1] : high[1], low[0] : high[0]].astype(np.float64), used, optics, edges, modules,
        corners - low, shape, across, low, row, _along(image, beyond),
    )


def marker_centre(corners_px: Floats) -> Floats:
    """Return the image (2,) of a square's centre: where its diagonals meet, of corners (4, 2)."""
    first, second, third, fourth = corners_px
    sides = np.stack([third - first, second - fourth], axis=1)
    return np.asarray(first + np.linalg.solve(sides, second - first)[0] * (third - first))


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
