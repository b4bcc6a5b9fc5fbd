"""Boards in scenes: where their markers and corners are, and what a search found of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.measure.board_detector import BoardOutput
from sweep.measure.board_solver import BoardPoints
from sweep.measure.classify import Quads, classify_decoded, flag_rejected, stacked
from sweep.measure.detector import DetectorOutput
from sweep.measure.flags import DetectionStatus
from sweep.model.board import Board
from sweep.model.extent import outside_of_frame
from sweep.model.pose import transform_points
from sweep.model.scene import Scenes
from sweep.model.solid_board import unseen_markers
from sweep.model.solid_scene import solid_planes
from sweep.typing import Floats, Integers


@dataclass(frozen=True, slots=True)
class BoardScenes:
    """The boards of N scenes, padded to the most markers M and chessboard corners C.

    Attributes
    ----------
    boards
        Each scene's.
    marker_id
        (N, M) IDs; -1 beyond a board's markers.
    corners_px, chessboard_px
        (N, M, 4, 2) and (N, C, 2) true images; NaN beyond a board's.
    flags
        (N, M) why a marker is not searched; ``not_run`` for those that are.
    """

    boards: Sequence[Board]
    marker_id: Integers
    corners_px: Floats
    chessboard_px: Floats
    flags: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class BoardFindings:
    """What one detector setting found of N boards.

    Attributes
    ----------
    flags
        (N,) of the boards: ``detected`` if a marker is, else the flag of the marker that came
        nearest to it.
    marker_flags, marker_corners, chessboard_px
        (N, M), (N, M, 4, 2) and (N, C, 2) px of the frame; NaN for what was not found.
    points
        What estimators get of each board: all decoded markers with an ID that it has, false ones
        included, as OpenCV's ``Board.matchImagePoints`` takes them.
    """

    flags: NDArray[np.uint8]
    marker_flags: NDArray[np.uint8]
    marker_corners: Floats
    chessboard_px: Floats
    points: list[BoardPoints]


_NOT_FOUND = (
    DetectionStatus.wrong_id, DetectionStatus.rejected, DetectionStatus.no_candidate,
    DetectionStatus.not_visible, DetectionStatus.not_modelled,
)
"""Flags of a marker in the order in which they tell most about a board of which none is found."""


def board_scenes(
    scenes: Scenes, boards: Sequence[Board], visibility: NDArray[np.uint8], shape: tuple[int, int]
) -> BoardScenes:
    """Return the boards of N scenes; ``shape`` are the most markers and chessboard corners.

    ``visibility`` (N,) are the flags of the boards as a whole.
    """
    count, (most, corners) = len(scenes), shape
    ids = np.full((count, most), -1, dtype=np.int64)
    corners_px = np.full((count, most, 4, 2), np.nan)
    chessboard_px = np.full((count, corners, 2), np.nan)
    flags = np.full((count, most), DetectionStatus.not_on_board, dtype=np.uint8)
    for board in dict.fromkeys(boards):
        rows = np.flatnonzero([each is board for each in boards])
        size = len(board)
        points = np.concatenate([board.corners_m.reshape(-1, 3), board.chessboard_m])
        pixels = scenes.cameras.take(rows).project(transform_points(
            np.broadcast_to(points, (len(rows), *points.shape)), scenes.rotation[rows],
            scenes.translation[rows],
        ))
        ids[rows, :size] = board.marker_ids
        corners_px[rows, :size] = pixels[:, : 4 * size].reshape(-1, size, 4, 2)
        chessboard_px[rows, : len(board.chessboard_m)] = pixels[:, 4 * size :]
        flags[rows, :size] = visibility[rows, None]
        for row in rows[visibility[rows] == DetectionStatus.not_run].tolist():
            outside = outside_of_frame(scenes, row, board.corners_m, corners_px[row, :size])
            flags[row, :size][outside] = DetectionStatus.not_visible
            if scenes.solid[row]:
                unseen = unseen_markers(board, solid_planes(scenes, row))
                flags[row, :size][unseen] = DetectionStatus.not_visible
    return BoardScenes(boards, ids, corners_px, chessboard_px, flags)


def findings(
    boards: BoardScenes, searched: Sequence[tuple[int, *DetectorOutput]],
    completed: dict[int, BoardOutput], origin: Floats,
) -> BoardFindings:
    """Return what was found of N boards.

    Parameters
    ----------
    boards
        The boards.
    searched, origin
        As :func:`sweep.measure.classify.classify` takes them.
    completed
        Row -> what was found by means of the board.
    """
    count = len(boards.boards)
    marker_flags = boards.flags.copy()
    marker_flags[marker_flags == DetectionStatus.not_run] = DetectionStatus.no_candidate
    marker_corners = np.full_like(boards.corners_px, np.nan)
    chessboard_px = np.full_like(boards.chessboard_px, np.nan)
    none = BoardPoints(
        np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros(0, dtype=np.int64),
        np.zeros((0, 2)),
    )
    points = [none] * count
    numbers = {
        board: {each: k for k, each in enumerate(board.marker_ids)}
        for board in dict.fromkeys(boards.boards)
    }
    visible = boards.flags == DetectionStatus.not_run
    # Markers as one list, whichever board they are on.
    first = np.concatenate([[0], np.cumsum(visible.sum(axis=1))])
    decoded, rejected = [], []
    for row, quads, ids, others in searched:
        true_px = boards.corners_px[row, visible[row]]
        read = stacked(quads) + origin[row]
        claimed = np.full(len(read), -1) if ids is None else np.ravel(ids)
        decoded.append(_at(true_px, read, claimed, first[row]))
        missed = stacked(others) + origin[row]
        rejected.append(_at(true_px, missed, np.full(len(missed), -1), first[row]))
        points[row] = _points(
            numbers[boards.boards[row]], read, claimed, completed.get(row), origin[row]
        )
        chessboard_px[row, points[row].chessboard] = points[row].chessboard_px
    corners_px = boards.corners_px[visible]
    found, marker_corners[visible] = classify_decoded(
        corners_px, boards.marker_id[visible], _joined(decoded)
    )
    flag_rejected(found, corners_px, _joined(rejected))
    marker_flags[visible] = found
    flags = np.full(count, DetectionStatus.not_visible, dtype=np.uint8)
    for flag in (*reversed(_NOT_FOUND), DetectionStatus.detected):
        flags[(marker_flags == flag).any(axis=1)] = flag
    return BoardFindings(flags, marker_flags, marker_corners, chessboard_px, points)


def _at(
    corners_px: Floats, quads: Floats, ids: NDArray[np.integer[Any]], first: int
) -> Quads:
    """Return quadrilaterals (Q, 4, 2) at each of M markers, whose rows begin with ``first``.

    Those whose centre lies in a marker's bounding box.
    """
    low, high = corners_px.min(axis=1) - 1, corners_px.max(axis=1) + 1
    centres = quads.mean(axis=1)
    inside = ((centres >= low[:, None]) & (centres <= high[:, None])).all(axis=2)
    marker, quad = np.nonzero(inside)
    return Quads(marker + first, quads[quad], ids[quad].astype(np.int64))


def _joined(parts: Sequence[Quads]) -> Quads:
    """Return the quadrilaterals of all parts."""
    none = Quads(np.zeros(0, dtype=np.intp), np.zeros((0, 4, 2)), np.zeros(0, dtype=np.int64))
    return Quads(*(np.concatenate(column) for column in zip(none, *parts, strict=True)))


def _points(
    numbers: Mapping[int, int], quads: Floats, ids: NDArray[np.integer[Any]],
    completed: BoardOutput | None, origin: Floats,
) -> BoardPoints:
    """Return the decoded markers with an ID of the board, and the chessboard's corners."""
    marker = np.array([numbers.get(each, -1) for each in ids.tolist()], dtype=np.int64)
    chessboard = np.zeros(0, dtype=np.int64) if completed is None else completed.chessboard_ids
    pixels = np.zeros((0, 2)) if completed is None else completed.chessboard_px + origin
    known = marker >= 0
    return BoardPoints(marker[known], quads[known], chessboard, pixels)
