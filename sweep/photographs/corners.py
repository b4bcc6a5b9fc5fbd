"""Corners of a board in a photograph, without a model of the camera.

Of a board with a chessboard they are the chessboard's inner corners: the neighbouring markers'
homography says where they are about, and ``cv2.cornerSubPix`` measures them. Of other boards they
are the markers' corners, as OpenCV refines them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.measure.detector import DetectorSetting
from sweep.measure.detectors import FindFunction, make_detector
from sweep.model.board import Board
from sweep.typing import Floats, Integers

NEIGHBOURS = 4
"""Markers whose corners give the homography around a corner of the chessboard."""

WINDOW_SHARE = 0.8
"""Half window of the search, as a share of the distance to the nearest corner of a marker."""

MIN_WINDOW, MAX_WINDOW = 2, 11
"""Half windows, in pixels."""

REFERENCE = DetectorSetting(cornerRefinementMethod="subpix")
"""The detector that finds the corners of boards: whatever is under test, truth is the same."""


@dataclass(frozen=True, slots=True, eq=False)
class FoundCorners:
    """What was found of a board in a photograph.

    Attributes
    ----------
    points, pixels
        (n, 3) in the board's frame in m, and (n, 2) px.
    number
        (n,) numbers of the corners: of the chessboard's, or 4 · marker + corner.
    marker, quads
        (k,) indices of the detected markers in the board, and their corners (k, 4, 2) px.
    unknown
        IDs that were detected and the board does not have.
    """

    points: Floats
    pixels: Floats
    number: Integers
    marker: Integers
    quads: Floats
    unknown: tuple[int, ...]


def reference_detector() -> FindFunction:
    """Return the detector that finds the corners of boards."""
    return make_detector(REFERENCE)


def detect_markers(
    find: FindFunction, image: NDArray[np.uint8], dictionary: str
) -> tuple[Integers, Floats]:
    """Return IDs (k,) and corners (k, 4, 2) of the markers in an image, each ID once."""
    quads, ids, _ = find(image, dictionary, max(image.shape))
    if ids is None:
        return np.empty(0, dtype=np.int64), np.empty((0, 4, 2))
    numbers = np.asarray(ids).ravel().astype(np.int64)
    corners = np.concatenate(list(quads)).astype(np.float64).reshape(-1, 4, 2)
    once = np.array([np.count_nonzero(numbers == each) == 1 for each in numbers.tolist()])
    return numbers[once], corners[once]


def find_corners(find: FindFunction, image: NDArray[np.uint8], board: Board) -> FoundCorners:
    """Return the corners of a board in an image."""
    ids, quads = detect_markers(find, image, board.dictionary)
    index = {marker_id: k for k, marker_id in enumerate(board.marker_ids)}
    known = np.array([each in index for each in ids.tolist()], dtype=bool)
    marker = np.array([index[each] for each in ids[known].tolist()], dtype=np.int64)
    quads, unknown = quads[known], tuple(ids[~known].tolist())
    if len(board.chessboard_m):
        number, pixels = _chessboard(image, board, marker, quads)
        points = board.chessboard_m[number]
    else:
        number = (4 * marker[:, None] + np.arange(4)).ravel()
        pixels, points = quads.reshape(-1, 2), board.corners_m[marker].reshape(-1, 3)
    return FoundCorners(points, pixels, number, marker, quads, unknown)


def _chessboard(
    image: NDArray[np.uint8], board: Board, marker: Integers, quads: Floats
) -> tuple[Integers, Floats]:
    """Return numbers (n,) and pixels (n, 2) of the chessboard's corners between markers."""
    if len(marker) < 2:
        return np.empty(0, dtype=np.int64), np.empty((0, 2))
    flat = board.corners_m[marker][..., :2]
    centres = flat.mean(axis=1)
    pitch = _pitch(board)
    height, width = image.shape
    numbers, pixels = [], []
    for number, point in enumerate(board.chessboard_m[:, :2]):
        distance = np.abs(centres - point).max(axis=1)
        near = np.argsort(distance, kind="stable")[:NEIGHBOURS]
        near = near[distance[near] < 2.1 * pitch]
        if len(near) < 2 or distance[near[0]] > 1.01 * pitch:
            continue
        transform, _ = cv2.findHomography(flat[near].reshape(-1, 2), quads[near].reshape(-1, 2))
        if transform is None:
            continue
        mapped = np.asarray(transform) @ [*point, 1.0]
        start = mapped[:2] / mapped[2]
        offset = np.abs(quads[near].reshape(-1, 2) - start).max(axis=1).min()
        half = int(np.clip(WINDOW_SHARE * offset, MIN_WINDOW, MAX_WINDOW))
        border = half + 2
        if not (border <= start[0] < width - border and border <= start[1] < height - border):
            continue
        found = cv2.cornerSubPix(
            image, start.astype(np.float32).reshape(1, 1, 2), (half, half), (-1, -1),
            (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3),
        ).reshape(2).astype(np.float64)
        if np.abs(found - start).max() < half:
            numbers.append(number)
            pixels.append(found)
    return np.array(numbers, dtype=np.int64), np.array(pixels).reshape(-1, 2)


def _pitch(board: Board) -> float:
    """Return the side of a chessboard's square in m."""
    points = board.chessboard_m[:, :2]
    if len(points) < 2:
        return float(np.abs(board.corners_m[..., :2]).max())
    return float(np.linalg.norm(points[1:] - points[0], axis=1).min())


def own_corners(board: Board) -> list[set[int]]:
    """Return the numbers of each marker's own corners: those that are left out of its truth.

    Of a chessboard they are the corners of the marker's square.
    """
    if not len(board.chessboard_m):
        return [{4 * k + corner for corner in range(4)} for k in range(len(board))]
    own = []
    for corners in board.corners_m:
        distance = np.abs(board.chessboard_m - corners.mean(axis=0)).max(axis=1)
        own.append(set(np.flatnonzero(distance < 0.51 * _pitch(board) * 1.2).tolist()))
    return own
