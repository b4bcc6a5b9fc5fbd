"""Boards in scenes: where their markers and corners are, and what a search found of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.measure.board_detector import BoardOutput
from sweep.measure.board_solver import BoardPoints
from sweep.measure.classify import classify
from sweep.measure.detector import DetectorOutput
from sweep.measure.flags import DetectionStatus
from sweep.model.board import Board
from sweep.model.extent import outside_of_frame
from sweep.model.pose import transform_points
from sweep.model.scene import Scenes
from sweep.model.solid_board import unseen_markers
from sweep.model.solid_scene import solid_planes
from sweep.typing import Floats, Integers

Quad = NDArray[np.floating[Any]]


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
    for row, quads, ids, rejected in searched:
        visible = np.flatnonzero(boards.flags[row] == DetectionStatus.not_run)
        if len(visible):
            corners_px = boards.corners_px[row, visible]
            decoded, missed = (_near(corners_px, some, origin[row]) for some in (quads, rejected))
            marker_flags[row, visible], marker_corners[row, visible] = classify(
                corners_px, boards.marker_id[row, visible],
                [
                    (k, [quads[i] for i in decoded[k]],
                     None if ids is None or not len(decoded[k]) else ids[decoded[k]],
                     [rejected[i] for i in missed[k]])
                    for k in range(len(visible))
                ],
                np.broadcast_to(origin[row], (len(visible), 2)),
            )
        points[row] = _points(boards.boards[row], quads, ids, completed.get(row), origin[row])
        found = points[row]
        chessboard_px[row, found.chessboard] = found.chessboard_px
    flags = np.full(count, DetectionStatus.not_visible, dtype=np.uint8)
    for flag in (*reversed(_NOT_FOUND), DetectionStatus.detected):
        flags[(marker_flags == flag).any(axis=1)] = flag
    return BoardFindings(flags, marker_flags, marker_corners, chessboard_px, points)


def _near(
    corners_px: Floats, quads: Sequence[Quad], origin: Floats
) -> list[NDArray[np.intp]]:
    """Return for each of M markers the quadrilaterals whose centre lies in its bounding box."""
    if not len(quads):
        return [np.zeros(0, dtype=np.intp)] * len(corners_px)
    centres = np.array([np.reshape(quad, (4, 2)).mean(axis=0) for quad in quads]) + origin
    low, high = corners_px.min(axis=1) - 1, corners_px.max(axis=1) + 1
    inside = (centres >= low[:, None]).all(axis=2) & (centres <= high[:, None]).all(axis=2)
    return [np.flatnonzero(each) for each in inside]


def _points(
    board: Board, quads: Sequence[Quad], ids: NDArray[Any] | None, completed: BoardOutput | None,
    origin: Floats,
) -> BoardPoints:
    """Return the decoded markers with an ID of the board, and the chessboard's corners."""
    number = {each: k for k, each in enumerate(board.marker_ids)}
    decoded = [] if ids is None else [
        (number[each], np.asarray(quad, dtype=np.float64).reshape(4, 2) + origin)
        for each, quad in zip(np.ravel(ids).tolist(), quads, strict=True) if each in number
    ]
    chessboard = np.zeros(0, dtype=np.int64) if completed is None else completed.chessboard_ids
    pixels = np.zeros((0, 2)) if completed is None else completed.chessboard_px + origin
    return BoardPoints(
        np.array([k for k, _ in decoded], dtype=np.int64),
        np.array([quad for _, quad in decoded]).reshape(-1, 4, 2), chessboard, pixels,
    )
