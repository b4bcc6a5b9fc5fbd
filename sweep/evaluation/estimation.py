"""Detections to poses: what an estimator assumes; a failure in a batch costs one pose only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.board_search import BoardScenes
from sweep.evaluation.machine_faults import raise_machine_fault
from sweep.evaluation.results import Failure, exception_text
from sweep.evaluation.search import SearchResult
from sweep.measure.board_solver import BoardDetections
from sweep.measure.estimation import Detections, Estimates
from sweep.measure.estimators import EstimatorSetting
from sweep.measure.flags import EstimateStatus
from sweep.model.beside import beside_pixels
from sweep.model.calibration_error import COEFFICIENTS, VIEW
from sweep.model.camera import Cameras
from sweep.model.columns import Column
from sweep.model.lens import pack, pack_once
from sweep.model.scene import Scenes
from sweep.plan.beliefs import CALIBRATED
from sweep.typing import Floats, Masks


def assumed_cameras(
    estimator: EstimatorSetting, values: Mapping[str, Column], scenes: Scenes
) -> tuple[Cameras, Floats]:
    """Return the N cameras and marker sizes (N,) in m that an estimator assumes.

    Those of the scenes, but for the ``believed_`` parameters: of ``values`` if they are drawn,
    else of the estimator. A believed calibration is drawn.
    """
    view, size = scenes.cameras.view, scenes.size_m
    lenses, distorted = scenes.cameras.lenses, scenes.cameras.distorted

    def assumed(name: str) -> Any:
        drawn = name in values and not values[name].constant
        return values[name].values if drawn else getattr(estimator, name)

    if assumed("believed_focal_scale") is not None:
        view = view.copy()
        view[:, :2] *= np.reshape(assumed("believed_focal_scale"), (-1, 1))
    calibrated = estimator.believed == "calibration"
    for k, name in enumerate(VIEW):
        value = (
            values[CALIBRATED + name].values if calibrated else assumed(f"believed_{name}")
        )
        if value is not None:
            view = view.copy() if view is scenes.cameras.view else view
            view[:, k] = value
    if assumed("believed_size_m") is not None:
        size = np.array(np.broadcast_to(assumed("believed_size_m"), size.shape), dtype=np.float64)
    coefficients = [CALIBRATED + name for name in COEFFICIENTS if CALIBRATED + name in values]
    if calibrated and coefficients:
        each = np.stack([values[name].values for name in coefficients], axis=1)
        lenses = np.array([pack_once(tuple(row)) for row in each.tolist()])
        distorted = np.asarray(lenses[:, :14].any(axis=1))
    if estimator.believed_distortion is not None:
        packed = pack(estimator.believed_distortion)
        lenses = np.repeat(packed[None], len(scenes), axis=0)
        distorted = np.full(len(scenes), bool(packed[:14].any()))
    return Cameras(view, lenses, distorted), size


def _assumed_noise_and_blur(
    estimator: EstimatorSetting, scenes: Scenes
) -> tuple[Floats, Floats]:
    """Return the noise of a pixel in grey levels and the point spread in px, (N,) each."""
    truth = {"noise_grey": 0.0, "blur_px": 0.0} if scenes.effects is None else scenes.effects
    noise, blur = (
        np.broadcast_to(truth[name] if assumed is None else assumed, len(scenes))
        for name, assumed in (
            ("noise_grey", estimator.believed_noise_grey), ("blur_px", estimator.believed_blur_px)
        )
    )
    return noise, blur


def detections_for(
    estimator: EstimatorSetting, values: Mapping[str, Column], scenes: Scenes,
    result: SearchResult, rows: NDArray[np.intp],
) -> Detections:
    """Return the detections of the scenes ``rows`` (n,), with what an estimator assumes of them."""
    cameras, size = assumed_cameras(estimator, values, scenes)
    noise, blur = _assumed_noise_and_blur(estimator, scenes)
    on_board = values["on_board"].values if "on_board" in values else None
    return Detections(
        result.corners[rows], cameras.take(rows), size[rows], noise[rows], blur[rows],
        [scenes.markers[k] for k in scenes.marker[rows]],
        [result.images[row] for row in rows.tolist()] if result.images else [],
        result.origins[rows],
        None if result.poses is None else result.poses.rotation[rows],
        None if result.poses is None else result.poses.translation[rows],
        None if on_board is None else [on_board[row] for row in rows.tolist()],
    )


def board_detections_for(
    estimator: EstimatorSetting, values: Mapping[str, Column], scenes: Scenes,
    boards: BoardScenes, result: SearchResult, rows: NDArray[np.intp],
) -> BoardDetections:
    """Return what was found of the boards of scenes ``rows`` (n,), and what is assumed of them."""
    if result.boards is None:
        raise TypeError("no boards were searched")
    cameras, size = assumed_cameras(estimator, values, scenes)
    noise, blur = _assumed_noise_and_blur(estimator, scenes)
    images = [result.images[row] for row in rows.tolist()] if result.images else []
    beside: list[Masks] = []
    if images and any(boards.boards[row].distractors for row in rows.tolist()):
        for row, image in zip(rows.tolist(), images, strict=True):
            left, top = result.origins[row].tolist()
            box = left, top, left + image.shape[1], top + image.shape[0]
            beside.append(beside_pixels(scenes, row, box))
    return BoardDetections(
        [boards.boards[row] for row in rows.tolist()],
        [result.boards.points[row] for row in rows.tolist()],
        cameras.take(rows), noise[rows], blur[rows], (size / scenes.size_m)[rows], images,
        result.origins[rows], beside,
    )


def estimate_poses(
    detections: Any, estimator: Callable[[Any], Estimates], rows: NDArray[np.intp],
    failures: list[Failure],
) -> Estimates:
    """Return estimates (n,) of the scenes ``rows``; one by one if the batch raises.

    The exceptions of single scenes are appended to ``failures``.
    """
    try:
        return estimator(detections)
    except Exception as batch_error:
        raise_machine_fault(batch_error)
        parts = []
        for i in range(len(rows)):
            try:
                parts.append(estimator(detections.take(np.array([i]))))
            except Exception as error:
                raise_machine_fault(error)
                failures.append(Failure(int(rows[i]), "estimation", exception_text(failures)))
                parts.append(Estimates.none(1, EstimateStatus.failed))
        return Estimates.concatenate(parts)
