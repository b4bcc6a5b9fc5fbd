"""What OpenCV finds on a board beside its markers: missed markers, and a chessboard's corners."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.declaration import parameter
from sweep.measure.detector import DetectorOutput
from sweep.model.board import Board
from sweep.model.marker import opencv_dictionary
from sweep.typing import Floats, Integers


@dataclass(frozen=True, slots=True)
class BoardDetectorSetting:
    """How OpenCV uses what it knows of a board, by its own names and defaults."""

    refineDetectedMarkers: bool = parameter(
        False, "boards: cv2.aruco.ArucoDetector.refineDetectedMarkers takes rejected candidates "
        "for the markers that are expected where they lie",
    )
    minMarkers: int = parameter(
        2, "charuco: markers beside a corner of the chessboard that must be detected for it to be "
        "interpolated", low=0, high=2,
    )


class BoardOutput(NamedTuple):
    """What is found on a board in one image: markers, and a chessboard's corners.

    Attributes
    ----------
    markers
        The detector's output, with the markers that were found by means of the board.
    chessboard_ids, chessboard_px
        (C,) and (C, 2) indices and pixels of the chessboard's corners that were found.
    """

    markers: DetectorOutput
    chessboard_ids: Integers
    chessboard_px: Floats


_NO_IDS, _NO_CORNERS = np.zeros(0, dtype=np.int64), np.zeros((0, 2))


class BoardDetector:
    """What OpenCV does with markers when it knows the board, by one setting.

    Parameters
    ----------
    setting
        How it uses the board.
    parameters
        Those of the detector of markers, of which it takes the refinement of corners.
    """

    def __init__(
        self, setting: BoardDetectorSetting, parameters: cv2.aruco.DetectorParameters
    ) -> None:
        self._setting = setting
        self._parameters = parameters
        self._refining: dict[str, cv2.aruco.ArucoDetector] = {}
        self._charuco: dict[Board, cv2.aruco.CharucoDetector] = {}

    def complete(
        self, image: NDArray[np.uint8], board: Board, markers: DetectorOutput
    ) -> BoardOutput:
        """Return what is found on a board in an image (h, w) in which ``markers`` were detected.

        ``cv2.aruco.ArucoDetector.refineDetectedMarkers`` and
        ``cv2.aruco.CharucoDetector.detectBoard`` are called without a camera: their homographies
        are local.
        """
        corners, ids, rejected = markers
        if ids is None or not len(ids):
            return BoardOutput(markers, _NO_IDS, _NO_CORNERS)
        if self._setting.refineDetectedMarkers and rejected:
            refine: Any = self._refining_detector(board.dictionary).refineDetectedMarkers
            corners, ids, rejected, _ = refine(
                image, _opencv_board(board), list(corners), ids, list(rejected)
            )
            markers = list(corners), ids, list(rejected)
        if board.chessboard is None:
            return BoardOutput(markers, _NO_IDS, _NO_CORNERS)
        pixels, found, _, _ = self._charuco_detector(board).detectBoard(
            image, markerCorners=list(corners), markerIds=ids
        )
        if found is None or not len(found):
            return BoardOutput(markers, _NO_IDS, _NO_CORNERS)
        return BoardOutput(
            markers, np.asarray(found, dtype=np.int64).ravel(),
            np.asarray(pixels, dtype=np.float64).reshape(-1, 2),
        )

    def _refining_detector(self, dictionary: str) -> cv2.aruco.ArucoDetector:
        if dictionary not in self._refining:
            self._refining[dictionary] = cv2.aruco.ArucoDetector(
                opencv_dictionary(dictionary), self._parameters
            )
        return self._refining[dictionary]

    def _charuco_detector(self, board: Board) -> cv2.aruco.CharucoDetector:
        if board not in self._charuco:
            parameters = cv2.aruco.CharucoParameters()
            parameters.minMarkers = self._setting.minMarkers
            self._charuco[board] = cv2.aruco.CharucoDetector(
                charuco_board(board), parameters, self._parameters
            )
        return self._charuco[board]


@lru_cache(maxsize=64)
def _opencv_board(board: Board) -> Any:
    ids = np.array(board.marker_ids, dtype=np.int32)
    if board.chessboard is not None:
        return charuco_board(board)
    corners: Any = board.corners_m.astype(np.float32)
    return cv2.aruco.Board(corners, opencv_dictionary(board.dictionary), ids)


def charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    """Return a ChArUco board as OpenCV has it; ValueError for another board."""
    squares = board.chessboard
    if squares is None:
        raise ValueError("the board has no chessboard")
    charuco = cv2.aruco.CharucoBoard(
        (squares.squares_x, squares.squares_y), squares.square_m, squares.marker_m,
        opencv_dictionary(board.dictionary), np.array(board.marker_ids, dtype=np.int32),
    )
    charuco.setLegacyPattern(squares.legacy_pattern)
    return charuco
