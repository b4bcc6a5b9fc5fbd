"""Detections that a test makes by itself, and poses from corners alone."""

from typing import NamedTuple

import numpy as np

from sweep.measure.estimation import Detections
from sweep.measure.solver import OPENCV_SOLVERS, PointSolver
from sweep.model.board import single_marker
from sweep.model.scene import Targets

BOARD_METHODS = tuple(name for name, each in OPENCV_SOLVERS.items() if each.of_boards)


def of_markers(corners, cameras, size_m, noise_grey, markers, images=()):
    """The detections of N markers whose corners (N, 4, 2) were all found, in whole frames."""
    count = len(corners)
    return Detections(
        corners, cameras, size_m, noise_grey, np.zeros(count), Targets.of(markers), images,
        np.zeros((count, 2), dtype=np.int64), np.arange(count), np.zeros(count, dtype=np.int64),
        np.ones(count), np.empty((count, 0, 2)),
    )


def estimate(corners, cameras, size_m, solver, guarded, limit):
    """The estimates of N markers from corners (N, 4, 2)."""
    count = len(corners)
    return PointSolver(solver, guarded, limit)(of_markers(
        corners, cameras, size_m, np.zeros(count), [single_marker("DICT_4X4_50", 0, 1.0)] * count,
    ))


class BoardPoints(NamedTuple):
    """Markers (K,) of a board with their corners (K, 4, 2), and corners of its chessboard."""

    marker: np.ndarray
    corners_px: np.ndarray
    chessboard: np.ndarray
    chessboard_px: np.ndarray


def detected(board, points, cameras):
    """The detections of a single board with one camera."""
    chessboard = np.full((1, len(board.chessboard_m), 2), np.nan)
    chessboard[0, points.chessboard] = points.chessboard_px
    return Detections(
        points.corners_px, cameras, np.ones(1), np.zeros(1), np.zeros(1), Targets.of([board]), [],
        np.zeros((1, 2), dtype=np.int64), np.zeros(len(points.marker), dtype=np.int64),
        points.marker, np.ones(1), chessboard,
    )
