"""Prints around a marker of a board, in the marker's own modules.

The solver of photographs has in its model the edges of the marker and those beside it, within a
square about the marker; beyond that square everything is black.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sweep.model.board import Board, Print, edges_on_sheet, target_edges
from sweep.model.coverage import MarkerEdges, joined
from sweep.model.marker import BLACK, OUTSIDE, marker_corners, module_count, overhang, square_edges
from sweep.typing import Floats, Integers


class BoardMarker(NamedTuple):
    """One marker of a board: ``number`` counts its markers from 0."""

    board: Board
    number: int


@lru_cache(maxsize=4096)
def surroundings(marker: BoardMarker | Board, margin: float, beyond: int = BLACK) -> MarkerEdges:
    """Return the edges of the print within ``margin`` modules of a marker's square.

    Of a marker of a board, or of one alone on its sheet. In modules, from the square's top left
    corner; the square's own edges are among them. ``beyond`` is the area farther out.
    """
    if isinstance(marker, Board):
        board, around = marker, target_edges(marker)
    else:
        board = marker.board
        ends, sides = edges_on_sheet(board.prints)
        around = MarkerEdges(_in_modules(marker, ends), sides)
    return clipped(around, -margin, module_count(board.dictionary) + margin, beyond)


@lru_cache(maxsize=4096)
def with_neighbours(marker: BoardMarker, margin: float) -> Board:
    """Return a marker of a board as a target: with the prints within ``margin`` modules."""
    board, module = marker.board, 1 / module_count(marker.board.dictionary)
    printed = Print(surroundings(marker, margin, OUTSIDE), module, 0.5)
    return Board(
        board.dictionary, (board.marker_ids[marker.number],), marker_corners(np.ones(1)),
        (printed,), np.empty((0, 3)), margin=margin,
    )


@lru_cache(maxsize=4096)
def clear_modules(marker: BoardMarker) -> float:
    """Return how many modules around a marker's square nothing else is printed.

    The largest distance from the square, along the marker's rows or columns, that no other
    print's edge comes below.
    """
    board = marker.board
    others = [each for k, each in enumerate(board.prints) if k != marker.number]
    ends = _in_modules(marker, edges_on_sheet(others).ends)
    half = module_count(board.dictionary) / 2
    start, stop = ends[:, :2] - half, ends[:, 2:] - half

    def distance(t: Floats) -> Floats:
        return np.asarray(np.abs(start + t[:, None] * (stop - start)).max(axis=1))

    low, high = np.zeros(len(ends)), np.ones(len(ends))
    for _ in range(60):
        # The greater of two convex functions is convex along an edge: its least value by thirds.
        first, second = low + (high - low) / 3, high - (high - low) / 3
        left = distance(first) <= distance(second)
        low, high = np.where(left, low, first), np.where(left, second, high)
    return max(float(distance(low).min(initial=np.inf)) - half, 0.0)


#: Widest part of the quiet zone that is fitted, in modules: farther out nothing tells the pose.
RING_MODULES = 1.5


def ring_modules(marker: Board, on_board: BoardMarker | None) -> float:
    """Return how many modules around the square of a marker, alone or on a board, are fitted."""
    clear = marker.margin or 0.0 if on_board is None else clear_modules(on_board)
    beyond = overhang(marker.dictionary)
    return min(max(clear, beyond + 0.5), beyond + RING_MODULES)


def _in_modules(marker: BoardMarker, ends: Floats) -> Floats:
    """Return edges (E, 4) of a board (metres, right and down) in modules of one of its markers."""
    one = marker.board.prints[marker.number]
    plane = one.plane(np.eye(3), np.array([0.0, 0.0, 1.0]))[:2] * [[1.0], [-1.0]]
    to_modules = np.linalg.inv(plane[:, :2])
    points = (ends.reshape(-1, 2) - plane[:, 2]) @ to_modules.T
    # Metres have rounding errors that would leave slivers between touching areas.
    return np.asarray(np.round(points, 9), dtype=np.float64).reshape(-1, 4)


def clipped(edges: MarkerEdges, low: float, high: float, beyond: int) -> MarkerEdges:
    """Return the edges of what lies in the square from ``low`` to ``high``; around it ``beyond``.

    What is moved onto the square's border by clamping encloses the part inside, since the clamping
    moves nothing there; edges that cancel one another on the border are left out. ``edges`` enclose
    areas on :data:`~sweep.model.marker.OUTSIDE`.
    """
    ends, sides = edges
    for axis in range(2):
        for limit, keep in ((low, np.maximum), (high, np.minimum)):
            ends, sides = _split(ends, sides, axis, limit)
            ends = ends.copy()
            ends[:, axis::2] = keep(ends[:, axis::2], limit)
    if beyond != OUTSIDE:
        square = square_edges(low, high, beyond, OUTSIDE)
        ends, sides = joined([MarkerEdges(ends, sides), square])
    border = np.zeros(len(ends), dtype=bool)
    kept_ends, kept_sides = [], []
    for axis in range(2):
        for limit in (low, high):
            on = (ends[:, axis] == limit) & (ends[:, axis + 2] == limit) & ~border
            border |= on
            merged_ends, merged_sides = _merged(ends[on], sides[on], axis, limit)
            kept_ends.append(merged_ends)
            kept_sides.append(merged_sides)
    inner = ~border & (ends[:, :2] != ends[:, 2:]).any(axis=1)
    return MarkerEdges(
        np.concatenate([ends[inner], *kept_ends]), np.concatenate([sides[inner], *kept_sides])
    )


def _split(ends: Floats, sides: Integers, axis: int, limit: float) -> tuple[Floats, Integers]:
    """Return the edges, those that cross a line cut in two there."""
    start, stop = ends[:, axis], ends[:, axis + 2]
    crossing = (start - limit) * (stop - limit) < 0
    cut, rest = ends[crossing], ends[~crossing]
    t = (limit - cut[:, axis]) / (cut[:, axis + 2] - cut[:, axis])
    points = cut[:, :2] + t[:, None] * (cut[:, 2:] - cut[:, :2])
    points[:, axis] = limit
    return (
        np.concatenate([rest, np.hstack([cut[:, :2], points]), np.hstack([points, cut[:, 2:]])]),
        np.concatenate([sides[~crossing], sides[crossing], sides[crossing]]),
    )


def _merged(ends: Floats, sides: Integers, axis: int, limit: float) -> tuple[Floats, Integers]:
    """Return edges along one border line as ones that do not overlap."""
    start, stop = ends[:, 1 - axis], ends[:, 3 - axis]
    cuts = np.unique(np.concatenate([start, stop]))
    low, high = cuts[:-1], cuts[1:]
    middle = 0.5 * (low + high)
    forward = (start[:, None] < middle) & (middle < stop[:, None])
    backward = (stop[:, None] < middle) & (middle < start[:, None])
    direction = forward.astype(np.int64) - backward.astype(np.int64)
    parts, codes = [], []
    for k in range(len(middle)):
        net = np.zeros(4, dtype=np.int64)
        np.add.at(net, sides[:, 1], direction[:, k])
        np.add.at(net, sides[:, 0], -direction[:, k])
        # One area ends and another begins for each unit; more than one only at overlaps.
        before = np.repeat(np.arange(4), np.maximum(-net, 0))
        after = np.repeat(np.arange(4), np.maximum(net, 0))
        for pair in zip(before.tolist(), after.tolist(), strict=True):
            along = [low[k], high[k]]
            parts.append(
                [limit, along[0], limit, along[1]] if axis == 0
                else [along[0], limit, along[1], limit]
            )
            codes.append(pair)
    return (
        np.reshape(parts, (-1, 4)).astype(np.float64),
        np.reshape(codes, (-1, 2)).astype(np.int64),
    )
