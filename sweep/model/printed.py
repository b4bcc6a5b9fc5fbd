"""What a scene shows in one plane: a marker, or a board of several; its edges and its extent.

Lengths are in units: modules of a marker, those of its first one for a board. Columns count to the
right and rows downwards, from the top left corner of a marker's square or from a board's origin.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sweep.model.board import Board, edges_on_sheet
from sweep.model.coverage import MarkerEdges
from sweep.model.marker import (
    BLACK,
    OCCLUDER,
    OUTSIDE,
    MarkerKey,
    edges,
    module_count,
    overhang,
)
from sweep.typing import Floats

PrintKey: TypeAlias = MarkerKey | Board
"""A marker or a board: it determines what is printed."""


class Extent(NamedTuple):
    """Where a print's parts end, in units.

    Attributes
    ----------
    sheet
        Left, top, right, bottom of all that is printed, the white around it included.
    target
        The same without what stands beside a board.
    ink
        The same of a marker's black square, or of a board's markers and squares.
    modules_beyond
        How far data extends beyond ``ink``.
    origin
        (2,) the pose's origin.
    modules
        Units along the black square's side.
    """

    sheet: Floats
    target: Floats
    ink: Floats
    modules_beyond: float
    origin: Floats
    modules: float


@lru_cache(maxsize=8192)
def extent_of(key: PrintKey) -> Extent:
    """Return where the parts of a print end."""
    if isinstance(key, Board):
        outline = target_edges(key)
        black = (outline.sides == BLACK).any(axis=1)
        return Extent(
            _box(edges_of(key).ends), _box(outline.ends), _box(outline.ends[black]), 0.0,
            np.zeros(2), float(module_count(key.dictionary)),
        )
    n, margin = float(module_count(key[0])), key[2]
    sheet = np.array([-margin, -margin, n + margin, n + margin])
    return Extent(
        sheet, sheet, np.array([0.0, 0.0, n, n]), float(overhang(key[0])),
        np.array([n / 2, n / 2]), n,
    )


def _box(ends: Floats) -> Floats:
    """Return left, top, right, bottom of edges with ends (E, 4)."""
    points = ends.reshape(-1, 2)
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


def box_corners(boxes: Floats) -> Floats:
    """Return the corners (n, 4, 3) of boxes (n, 4): TL, TR, BR, BL; x right, y up."""
    left, top, right, bottom = boxes.T
    across = np.stack([left, right, right, left], axis=1)
    up = -np.stack([top, top, bottom, bottom], axis=1)
    return np.stack([across, up, np.zeros_like(up)], axis=2)


def unit_m(board: Board) -> float:
    """Return the unit of a board in metres: a module of its first marker."""
    side = float(np.linalg.norm(board.corners_m[0, 1] - board.corners_m[0, 0]))
    return side / module_count(board.dictionary)


def side_m(key: PrintKey, size_m: float) -> float:
    """Return the side of a print's first marker in metres: ``size_m`` unless it has its own."""
    if not isinstance(key, Board):
        return size_m
    side = unit_m(key) * module_count(key.dictionary)
    return size_m if math.isclose(side, size_m, rel_tol=1e-9) else side


def sides_m(keys: Sequence[PrintKey], number: NDArray[np.intp], size_m: Floats) -> Floats:
    """Return :func:`side_m` of N prints, ``keys[number]`` with sizes (N,)."""
    if not any(isinstance(key, Board) for key in keys):
        return size_m
    each = zip(number.tolist(), size_m.tolist(), strict=True)
    return np.array([side_m(keys[k], size) for k, size in each])


@lru_cache(maxsize=64)
def target_edges(board: Board) -> MarkerEdges:
    """Return the edges of a board, without what stands beside it, in units."""
    outline = board.edges()
    return MarkerEdges(outline.ends / unit_m(board), outline.sides)


@lru_cache(maxsize=64)
def _board_edges(board: Board) -> MarkerEdges:
    own = target_edges(board)
    if not board.distractors:
        return own
    beside = edges_on_sheet(board.distractors)
    return MarkerEdges(
        np.concatenate([own.ends, beside.ends / unit_m(board)]),
        np.concatenate([own.sides, beside.sides]),
    )


def edges_of(key: PrintKey) -> MarkerEdges:
    """Return the edges of all that is printed, beside a board too, in units."""
    return _board_edges(key) if isinstance(key, Board) else edges(*key)


@lru_cache(maxsize=64)
def edge_table(prints: tuple[PrintKey, ...]) -> tuple[MarkerEdges, NDArray[np.int64]]:
    """Return the edges of K prints in one table, and (K, 2) first and last + 1 row of each."""
    each = [edges_of(key) for key in prints]
    stops = np.cumsum([len(outline.ends) for outline in each])
    starts = np.concatenate([[0], stops[:-1]])
    table = MarkerEdges(
        np.concatenate([outline.ends for outline in each]),
        np.concatenate([outline.sides for outline in each]),
    )
    return table, np.stack([starts, stops], axis=1).astype(np.int64)


@lru_cache(maxsize=8192)
def occluded_edges(key: PrintKey, occlusion: float, occlusion_deg: float) -> MarkerEdges:
    """Return the edges of a print under a sheet that hides everything beyond a straight line.

    Parts of edges under the sheet are projected onto its edge at a right angle: they then enclose
    the visible part of their area, since the projection moves nothing else. The sheet ends where
    the print does.
    """
    extent = extent_of(key)
    angle = math.radians(occlusion_deg)
    towards = np.array([math.cos(angle), -math.sin(angle)])
    # Rows count downwards; the sheet's edge lies where towards · (column, row) = limit.
    hideable = extent.ink[2:] - extent.ink[:2] + 2 * extent.modules_beyond
    middle = (extent.ink[:2] + extent.ink[2:]) / 2
    width = float(hideable @ np.abs(towards))
    limit = float(towards @ middle) + width * (0.5 - occlusion)

    def split(edge: Sequence[float], hidden: bool) -> list[list[float]]:
        """Return the parts of an edge beside the sheet, and those under it projected (or not)."""
        a, b = np.array(edge[:2], dtype=np.float64), np.array(edge[2:], dtype=np.float64)
        deep = float(towards @ a - limit), float(towards @ b - limit)
        cuts = [a, b]
        if min(deep) < 0 < max(deep):
            cuts = [a, a + deep[0] / (deep[0] - deep[1]) * (b - a), b]
        parts = []
        for start, stop in itertools.pairwise(cuts):
            inside = float(towards @ (start + stop) / 2 - limit) * (-1 if hidden else 1)
            ends = [
                point - max(sign * float(towards @ point - limit), 0.0) * sign * towards
                if inside > 0 else point
                for point in (start, stop) for sign in (-1.0 if hidden else 1.0,)
            ]
            parts.append([*ends[0], *ends[1]])
        return parts

    ends: list[list[float]] = []
    sides: list[tuple[int, int]] = []
    plain = edges_of(key)
    for edge, codes in zip(plain.ends.tolist(), plain.sides.tolist(), strict=True):
        parts = split(edge, hidden=False)
        ends += parts
        sides += [tuple(codes)] * len(parts)
    left, top, right, bottom = extent.sheet.tolist()
    # Down, right, up, left: the sheet is at greater x of the edge that goes down.
    around = ((left, top), (left, bottom), (right, bottom), (right, top), (left, top))
    for start, stop in itertools.pairwise(around):
        parts = split([*start, *stop], hidden=True)
        ends += parts
        sides += [(OUTSIDE, OCCLUDER)] * len(parts)
    return MarkerEdges(np.array(ends, dtype=np.float64), np.array(sides, dtype=np.int64))
