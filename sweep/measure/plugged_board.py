"""A plug-in's solver of boards: its poses are checked on the markers that were detected."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from sweep.measure.board_solver import BoardDetections, BoardPoints, reprojection_px
from sweep.measure.covariance import point_covariance
from sweep.measure.plugged_estimator import PluggedEstimator
from sweep.typing import Floats


class PluggedBoardEstimator(PluggedEstimator):
    """One setting of a plug-in's solver of boards in this process.

    Errors and covariances are those of the corners of all decoded markers with an ID of the board,
    whichever of them the plug-in uses.
    """

    def _copied(self, detections: BoardDetections) -> BoardDetections:
        copied: BoardDetections = super()._copied(detections)
        points = [
            BoardPoints(
                each.marker.copy(), each.corners_px.copy(), each.chessboard.copy(),
                each.chessboard_px.copy(),
            )
            for each in copied.points
        ]
        return dataclasses.replace(copied, points=points)

    def _point_counts(self, detections: BoardDetections) -> Floats:
        return np.array([4.0 * len(each.marker) for each in detections.points])

    def _covariance(
        self, rotation: Floats, translation: Floats, detections: BoardDetections, noise_px: float
    ) -> Floats:
        return np.array([
            point_covariance(*pose, _corners_m(one), one.cameras, noise_px)
            for pose, one in zip(
                zip(rotation, translation, strict=True), _each(detections), strict=True
            )
        ])

    def _reprojection_px(
        self, rotation: Floats, translation: Floats, detections: BoardDetections
    ) -> Floats:
        with np.errstate(invalid="ignore", over="ignore"):
            return np.array([
                reprojection_px(
                    *pose, _corners_m(one), one.points[0].corners_px.reshape(-1, 2), one.cameras
                )
                for pose, one in zip(
                    zip(rotation, translation, strict=True), _each(detections), strict=True
                )
            ])

    def _is_credible(
        self, reprojection_px: Floats, detections: BoardDetections
    ) -> NDArray[np.bool_]:
        side_px = np.array([
            np.linalg.norm(
                np.roll(each.corners_px, -1, axis=1) - each.corners_px, axis=2
            ).mean() if len(each.marker) else np.nan
            for each in detections.points
        ])
        with np.errstate(invalid="ignore"):
            return np.asarray(reprojection_px <= self._limit * side_px)


def _each(detections: BoardDetections) -> list[BoardDetections]:
    return [detections.take(np.array([row])) for row in range(len(detections.boards))]


def _corners_m(one: BoardDetections) -> Floats:
    """Return the corners (k, 3) of a board's detected markers, of the size that is believed."""
    corners = one.boards[0].corners_m[one.points[0].marker].reshape(-1, 3)
    return np.asarray(corners * one.scale[0])
