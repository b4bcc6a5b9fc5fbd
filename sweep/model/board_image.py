"""The exact image of a board: the sum over the edges of all that is printed on it.

Each print is drawn in its own plane, as a marker alone is, into one accumulator; prints outside
the frame cost nothing. A board may be bent, and its image shifted, as those of markers alone.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled
from sweep.model import lens as lens_model
from sweep.model.board import Board
from sweep.model.coverage import MarkerEdges, accumulate, accumulate_curved, sum_levels
from sweep.model.extent import CHORDS_PER_SIDE
from sweep.model.point_spread import REACH
from sweep.model.projection import Optics, Projection
from sweep.model.sheet import (
    NO_WAVES,
    Shape,
    Sheet,
    fold_cells,
    folds_over,
    sheet_of,
    sheet_pixels,
)
from sweep.typing import Floats, Integers


class BoardPose(NamedTuple):
    """A board's pose in the camera frame: ``rotation`` (3, 3), ``translation`` (3,) in metres."""

    rotation: Floats
    translation: Floats


class Curvature(NamedTuple):
    """How a board departs from its plane, and its image from the camera's.

    Attributes
    ----------
    shape
        The bent sheet, tangent at the board's origin.
    waves, length_px
        The shift of the image (:func:`sweep.model.image_shift.shift_waves`), and its correlation
        length.
    """

    shape: Shape = Shape()
    waves: Floats = NO_WAVES
    length_px: float = math.inf


class _Prints(NamedTuple):
    """A board's prints as compiled functions take them.

    Attributes
    ----------
    edges, spans
        The edges of all P prints, and (P, 2) the first and past-the-end row of each print's.
    outlines
        (P, 4 · CHORDS_PER_SIDE, 2) points along the rectangle that encloses each, in its units.
    """

    edges: MarkerEdges
    spans: Integers
    outlines: Floats


@lru_cache(maxsize=16)
def _prints(board: Board) -> _Prints:
    each = [one.edges for one in board.prints]
    stops = np.cumsum([len(edges.ends) for edges in each])
    t = np.arange(CHORDS_PER_SIDE)[:, None] / CHORDS_PER_SIDE
    around = np.concatenate([
        np.hstack([t, 0 * t]), np.hstack([1 + 0 * t, t]), np.hstack([1 - t, 1 + 0 * t]),
        np.hstack([0 * t, 1 - t]),
    ])
    points = [edges.ends.reshape(-1, 2) for edges in each]
    low = np.array([ends.min(axis=0) for ends in points])
    high = np.array([ends.max(axis=0) for ends in points])
    return _Prints(
        MarkerEdges(
            np.concatenate([edges.ends for edges in each]),
            np.concatenate([edges.sides for edges in each]),
        ),
        np.stack([np.concatenate([[0], stops[:-1]]), stops], axis=1).astype(np.int64),
        low[:, None] + around * (high - low)[:, None],
    )


def render_board(
    board: Board, optics: Optics, frame: tuple[int, int], pose: BoardPose, *, black: float = 0.0,
    white: float = 255.0, background: float | Floats = 0.0, blur_px: float = 0.0,
    curvature: Curvature | None = None,
) -> Floats:
    """Return the levels (height, width) of a frame with a board, before noise and quantisation.

    Parameters
    ----------
    board, optics, frame, pose
        What is seen, by which camera, the frame's width and height in pixels, and from where.
    black, white, background
        Grey levels; the background may also be an image (height, width) of the frame.
    blur_px
        Standard deviation of the lens' Gaussian point spread.
    curvature
        Of a bent board or a shifted image; None for neither.

    Raises
    ------
    ValueError
        If a part of the board is not before the camera, if the board shows its back, or if the
        lens, a bend or shifts fold it: then it has no image that could be computed.
    """
    planes = np.array([one.plane(*pose) for one in board.prints])
    pixels = _outlines_px(board, planes, optics, pose)
    sheets = None
    if curvature is not None:
        sheets = _sheets(board, curvature)
        pixels = _curved_outlines_px(board, planes, optics, pose, curvature, sheets)
    reach = REACH * blur_px + 1 if blur_px > 0 else 0.0
    low = pixels.min(axis=1) - reach
    high = pixels.max(axis=1) + reach
    if optics.distorted or curvature is not None:
        low, high = low - 2, high + 2
    limit = np.array(frame, dtype=np.float64)
    start = np.clip(np.floor(low + 0.5), 0, limit)
    stop = np.clip(np.ceil(high + 0.5), 0, limit)
    seen = np.flatnonzero((stop > start).all(axis=1))
    image = np.empty((frame[1], frame[0]))
    image[:] = background
    if not len(seen):
        return image
    left, top = start[seen].min(axis=0).astype(int).tolist()
    right, bottom = stop[seen].max(axis=0).astype(int).tolist()
    cover = np.zeros((bottom - top, right - left + 2))

    def summed(levels: Floats) -> Floats:
        sums = np.empty((bottom - top, right - left))
        prints = _prints(board)
        if sheets is None:
            _accumulate_prints(
                cover, prints.edges, prints.spans, planes, seen, levels, optics, left, top, blur_px
            )
        else:
            for row in seen.tolist():
                first, last = prints.spans[row]
                accumulate_curved(
                    cover, MarkerEdges(
                        prints.edges.ends[first:last], prints.edges.sides[first:last]
                    ), levels,
                    Projection(planes[row], optics), left, top, blur_px, sheets[row],
                )
        sum_levels(cover, levels[0], sums)
        return sums

    inner = image[top:bottom, left:right]
    if isinstance(background, np.ndarray):
        share = summed(np.array([0.0, 1.0, 1.0]))
        inner[:] = summed(np.array([0.0, black, white])) + (1 - share) * inner
    else:
        inner[:] = summed(np.array([float(background), black, white]))
    return image


def _outlines_px(board: Board, planes: Floats, optics: Optics, pose: BoardPose) -> Floats:
    """Return the image (P, M, 2) of the prints' outlines; as :func:`render_board` raises."""
    outlines = _prints(board).outlines
    flat = np.concatenate([outlines, np.ones_like(outlines[..., :1])], axis=2)
    points = flat @ np.swapaxes(planes, 1, 2)
    if not (points[..., 2] > 0).all():
        raise ValueError("a part of the board lies behind the camera")
    if not float(pose.rotation[:, 2] @ pose.translation) < 0:
        raise ValueError("the board shows its back to the camera")
    points = points[..., :2] / points[..., 2:]
    if optics.distorted:
        corners = np.ascontiguousarray(points[:, ::CHORDS_PER_SIDE])
        lenses = np.repeat(optics.lens[None], len(points), axis=0)
        if lens_model.folds(corners, lenses).any():
            raise ValueError("the lens model folds on the board")
        points = lens_model.distort_points(np.ascontiguousarray(points), lenses)
    return np.asarray(points * optics.intrinsics[:2] + optics.intrinsics[2:])


def _sheets(board: Board, curvature: Curvature) -> list[Sheet]:
    """Return the board's sheet in the units of each print."""
    sheets = []
    for one in board.prints:
        flat = one.plane(np.eye(3), np.zeros(3))[:2]
        origin = np.linalg.solve(flat[:, :2], -flat[:, 2])
        shape = curvature.shape._replace(
            direction_rad=curvature.shape.direction_rad - one.roll_rad
        )
        sheets.append(sheet_of(
            shape, one.unit_m, (origin[0], origin[1]), curvature.waves, curvature.length_px
        ))
    return sheets


def _curved_outlines_px(
    board: Board, planes: Floats, optics: Optics, pose: BoardPose, curvature: Curvature,
    sheets: list[Sheet],
) -> Floats:
    """As :func:`_outlines_px`, of a board that is bent or shifted."""
    outlines = _prints(board).outlines
    on_board = np.concatenate([
        points @ flat[:2, :2].T + flat[:2, 2]
        for points, flat in zip(
            outlines, (one.plane(np.eye(3), np.zeros(3)) for one in board.prints), strict=True
        )
    ]) * [1.0, -1.0]
    low, high = on_board.min(axis=0), on_board.max(axis=0)
    whole = Projection(
        np.stack([pose.rotation[:, 0], -pose.rotation[:, 1], pose.translation], axis=1), optics
    )
    sheet = sheet_of(curvature.shape, 1.0, (0.0, 0.0), curvature.waves, curvature.length_px)
    pixels = np.array([
        sheet_pixels(points, Projection(plane, optics), each)
        for points, plane, each in zip(outlines, planes, sheets, strict=True)
    ])
    extent = np.ptp(pixels.reshape(-1, 2), axis=0).max()
    side = float((high - low).max())
    if not np.isfinite(extent) or folds_over(
        low, high, fold_cells(sheet, side, extent), whole, sheet
    ):
        raise ValueError("the bent board hides a part of itself, or shifts fold its image")
    return pixels


@compiled
def _accumulate_prints(
    cover: Floats, edges: MarkerEdges, spans: Integers, planes: Floats, rows: NDArray[np.intp],
    levels: Floats, optics: Optics, left: int, top: int, sigma: float,
) -> None:
    """Add the edges of prints ``rows`` to ``cover``, in their order."""
    for row in rows:
        first, last = spans[row, 0], spans[row, 1]
        accumulate(
            cover, MarkerEdges(edges.ends[first:last], edges.sides[first:last]), levels,
            Projection(planes[row], optics), left, top, sigma,
        )
