"""Classification of detections: which of a target's squares were detected, or why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.measure.detectors import SearchOutput
from sweep.measure.flags import DetectionStatus
from sweep.model.board import Board
from sweep.model.exposure import unseen_squares
from sweep.model.polygon import following
from sweep.model.pose import transform_points
from sweep.model.scene import Scenes, Targets
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# The targets of scenes: where the images of their squares and corners are.

@dataclass(frozen=True, slots=True)
class TargetScenes:
    """The targets of N scenes, padded to the most squares M and chessboard corners C.

    Attributes
    ----------
    targets
        Markers, which have one square, or boards.
    marker_id
        (N, M) IDs; -1 beyond a target's squares.
    corners_px, chessboard_px
        (N, M, 4, 2) and (N, C, 2) true images; NaN beyond a target's.
    flags
        (N, M) why a square is not searched; ``not_run`` for those that are.
    """

    targets: Targets
    marker_id: Integers
    corners_px: Floats
    chessboard_px: Floats
    flags: NDArray[np.uint8]


def target_scenes(
    scenes: Scenes, visibility: NDArray[np.uint8], boards: Sequence[Board] | None = None,
    shape: tuple[int, int] = (1, 0),
) -> TargetScenes:
    """Return the targets of N scenes: markers, or the boards that are given.

    ``visibility`` (N,) are the flags of the targets as a whole; ``shape`` are the most squares and
    chessboard corners of a board.
    """
    count, (most, corners) = len(scenes), shape
    if boards is None:
        return TargetScenes(
            scenes.targets, scenes.marker_id[:, None], scenes.corners_px[:, None],
            np.empty((count, 0, 2)), visibility[:, None],
        )
    ids = np.full((count, most), -1, dtype=np.int64)
    corners_px = np.full((count, most, 4, 2), np.nan)
    chessboard_px = np.full((count, corners, 2), np.nan)
    flags = np.full((count, most), DetectionStatus.not_on_board, dtype=np.uint8)
    targets = Targets.of(boards)
    for number, board in enumerate(targets.boards):
        rows = np.flatnonzero(targets.number == number)
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
            unseen = unseen_squares(scenes, row, board.corners_m, corners_px[row, :size])
            flags[row, :size][unseen] = DetectionStatus.not_visible
    return TargetScenes(targets, ids, corners_px, chessboard_px, flags)


# --------------------------------------------------------------------------------------------------
# Results of a search for targets: flags, corners, and detections for estimators.

@dataclass(frozen=True, slots=True)
class Findings:
    """The detections of N targets by one detector setting.

    Attributes
    ----------
    flags
        (N,) of the targets: ``detected`` if a square is, else the flag of the square that came
        nearest to it.
    marker_flags, marker_corners, chessboard_px
        (N, M), (N, M, 4, 2) and (N, C, 2) px of the frame; NaN for what was not found.
    owner, square, corners
        (K,), (K,) and (K, 4, 2): the squares that estimators get, as
        :class:`sweep.measure.estimation.Detections` has them.
    """

    flags: NDArray[np.uint8]
    marker_flags: NDArray[np.uint8]
    marker_corners: Floats
    chessboard_px: Floats
    owner: Integers
    square: Integers
    corners: Floats


class Quads(NamedTuple):
    """Quadrilaterals that were found.

    Attributes
    ----------
    owner
        (Q,) the row of each: of a scene, or of a square.
    corners_px
        (Q, 4, 2) px of the frame.
    ids
        (Q,) decoded IDs; -1 for rejected candidates.
    """

    owner: NDArray[np.intp]
    corners_px: Floats
    ids: Integers


#: Flags of a square in the order in which they tell most about its target.
_NEAREST = (
    DetectionStatus.detected, DetectionStatus.wrong_id, DetectionStatus.rejected,
    DetectionStatus.no_candidate, DetectionStatus.not_visible, DetectionStatus.not_modelled,
)

#: The corners' order after each quarter turn, (4, 4).
_TURNS = np.array([np.roll(np.arange(4), -turn) for turn in range(4)])

#: Pairs of a square and a quadrilateral that are compared at a time: they fit a cache.
_MOST_PAIRS = 1 << 12


def classify(
    targets: TargetScenes, searched: Mapping[int, SearchOutput], origin: Floats
) -> Findings:
    """Return the detections of N targets.

    Parameters
    ----------
    targets
        The truth.
    searched
        Row -> the search's output, of each scene that was searched. Of several right markers the
        nearest counts.
    origin
        (N, 2) px: the top left pixel of the window that was searched.
    """
    marker_flags = targets.flags.copy()
    marker_flags[marker_flags == DetectionStatus.not_run] = DetectionStatus.no_candidate
    marker_corners = np.full_like(targets.corners_px, np.nan)
    chessboard_px = np.full_like(targets.chessboard_px, np.nan)
    for row, output in searched.items():
        if len(output.chessboard_ids):
            chessboard_px[row, output.chessboard_ids] = output.chessboard_px + origin[row]
    decoded = _in_frame(
        [(row, each.corners, each.ids) for row, each in searched.items()
         if each.ids is not None], origin
    )
    # Squares as one list, whichever target they are on.
    visible = targets.flags == DetectionStatus.not_run
    true_px, true_ids = targets.corners_px[visible], targets.marker_id[visible]
    flags = np.full(len(true_px), DetectionStatus.no_candidate, dtype=np.uint8)
    corners = np.full_like(true_px, np.nan)
    number = visible.sum(axis=1)
    first = np.cumsum(number) - number
    at = _at_squares(decoded, first, number, true_px)
    flags[at.owner] = DetectionStatus.wrong_id
    right = np.flatnonzero(at.ids == true_ids[at.owner])
    offset = at.corners_px[right][:, _TURNS] - true_px[at.owner[right]][:, None]
    squared = (offset**2).sum(axis=(2, 3))
    upright = np.argmin(squared, axis=1) == 0
    # From far to near, so that the nearest is written last.
    order = right[upright][np.argsort(-squared[upright, 0], kind="stable")]
    flags[at.owner[order]] = DetectionStatus.detected
    corners[at.owner[order]] = at.corners_px[order]
    marker_flags[visible], marker_corners[visible] = flags, corners
    missing = (marker_flags == DetectionStatus.no_candidate).any(axis=1)
    if missing.any():
        rejected = _in_frame([
            (row, each.rejected, np.full(len(each.rejected), -1)) for row, each in searched.items()
            if missing[row] and len(each.rejected)
        ], origin)
        missed = _at_squares(rejected, first, number, true_px).owner
        flags[missed[flags[missed] == DetectionStatus.no_candidate]] = DetectionStatus.rejected
        marker_flags[visible] = flags
    of_targets = np.full(len(visible), DetectionStatus.not_visible, dtype=np.uint8)
    for flag in reversed(_NEAREST):
        of_targets[(marker_flags == flag).any(axis=1)] = flag
    return Findings(
        of_targets, marker_flags, marker_corners, chessboard_px,
        *_found_squares(targets.targets, decoded, of_targets, marker_corners),
    )


def _found_squares(
    targets: Targets, decoded: Quads, flags: NDArray[np.uint8], corners: Floats
) -> tuple[Integers, Integers, Floats]:
    """Return the squares that estimators get: target, number and corners of each, by target.

    Of a marker its detection; of a board all that have an ID of it, wherever they lie.
    """
    if targets.are_markers:
        rows = np.flatnonzero(flags == DetectionStatus.detected)
        return rows, np.zeros(len(rows), dtype=np.int64), corners[rows, 0]
    numbers = [
        {each: k for k, each in enumerate(board.marker_ids)} for board in targets.boards
    ]
    square = np.array([
        numbers[of].get(each, -1) for of, each in
        zip(targets.number[decoded.owner].tolist(), decoded.ids.tolist(), strict=True)
    ], dtype=np.int64)
    known = np.flatnonzero(square >= 0)
    known = known[np.argsort(decoded.owner[known], kind="stable")]
    return decoded.owner[known], square[known], decoded.corners_px[known]


def _in_frame(
    found: Sequence[
        tuple[int, Sequence[NDArray[np.floating[Any]]], NDArray[np.integer[Any]]]
    ],
    origin: Floats,
) -> Quads:
    """Return the quadrilaterals (1, 4, 2) each that windows of rows hold, with their IDs."""
    rows = np.array([row for row, _, _ in found], dtype=np.intp)
    owner = np.repeat(rows, [len(quads) for _, quads, _ in found])
    corners = np.concatenate(
        [np.zeros((0, 4, 2)), *(quad for _, quads, _ in found for quad in quads)]
    )
    ids = np.concatenate([np.zeros(0, np.int64), *(np.ravel(each) for _, _, each in found)])
    return Quads(owner, corners + origin[owner, None], ids)


def _at_squares(quads: Quads, first: Integers, number: Integers, true_px: Floats) -> Quads:
    """Return each quadrilateral at each true, convex square of its scene in which its centre lies.

    A centre on a square's edge lies in it. Row r has the squares ``first[r]`` to
    ``first[r] + number[r]`` of those with corners ``true_px`` (S, 4, 2).
    """
    pairs, centres = number[quads.owner], quads.corners_px.mean(axis=1)
    edges = following(true_px) - true_px
    parts = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))]
    at_a_time = np.flatnonzero(np.diff(np.cumsum(pairs) // _MOST_PAIRS)) + 1
    for some in np.split(np.arange(len(pairs)), at_a_time) if len(pairs) else ():
        quad = np.repeat(some, pairs[some])
        before = np.cumsum(pairs[some]) - pairs[some]
        square = np.arange(len(quad)) + np.repeat(first[quads.owner[some]] - before, pairs[some])
        edge, to_centre = edges[square], centres[quad][:, None] - true_px[square]
        turn = edge[..., 0] * to_centre[..., 1] - edge[..., 1] * to_centre[..., 0]
        inside = (turn >= 0).all(axis=1) | (turn <= 0).all(axis=1)
        parts.append((square[inside], quad[inside]))
    square, quad = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Quads(square, quads.corners_px[quad], quads.ids[quad])
