"""Scene cells of the grid: the nested stages scene -> image -> detection -> estimate.

The paper's eleven steps (Poroykov et al., 2020) are found by name: steps 1-6 in
:func:`sweep.model.scene.build_scenes`, 7-8 in :mod:`sweep.model.renderers`, 9 in
:mod:`sweep.measure.detector` and :mod:`sweep.measure.solver`, 10 in
:mod:`sweep.measure.accuracy`; step 11 is the loop over cells. A scene is rendered once for all
detector settings, and a detection is shared by all estimators.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.board_search import board_scenes
from sweep.evaluation.estimation import board_detections_for, detections_for, estimate_poses
from sweep.evaluation.machine_faults import machine_faults_raised
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.recorded_search import any_recorded
from sweep.evaluation.results import CellsResult, Failure, concatenate
from sweep.evaluation.search import search, visibility_flags, whole_frames
from sweep.evaluation.variables import (
    BOARD_DETECTION,
    BOARD_SCENE,
    DETECTION,
    SCENE,
    BoardResults,
    DetectionResults,
    EstimationResults,
    SceneResults,
    compute,
    compute_estimation,
    photograph_variables,
)
from sweep.measure.accuracy import pose_error
from sweep.measure.board_solver import BoardDetections
from sweep.measure.bound import Bounds, bounds
from sweep.measure.estimation import Detections, Estimates
from sweep.measure.estimators import EstimatorSetting, build, build_for_boards
from sweep.measure.flags import BoundStatus, DetectionStatus
from sweep.model.columns import Column
from sweep.model.derivatives import POSE
from sweep.model.extent import marker_boxes
from sweep.model.scene import Scenes, build_scenes
from sweep.plan.alternatives import PHOTOGRAPHS
from sweep.plan.boards import largest_board
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import board_settings, detector_settings, estimators, scene_values
from sweep.plan.image_keys import image_keys
from sweep.plan.scene_plugins import scene_plugins
from sweep.plan.schema import drawn_variables, variables_of
from sweep.typing import Masks

KEPT_PX = 1 << 26
"""Pixels of images that are kept for the estimators, if all were whole frames: 67 MB of memory."""


@machine_faults_raised()
def run_cells(
    pipeline: Pipeline,
    indices: Sequence[NDArray[np.intp]],
    need: Masks | None = None,
    search_too: Masks | None = None,
) -> CellsResult:
    """Render, detect and estimate scene cells.

    Parameters
    ----------
    pipeline
        The experiment.
    indices
        Indices (N,) along each scene axis.
    need
        (N, detector settings, estimators) the estimates that are computed; all by default. The
        others are flagged ``not_run``.
    search_too
        (N, detector settings) searches that are made even if no estimate needs them; none by
        default.

    Returns
    -------
    CellsResult
        The variables, seconds and failures of the N cells.

    Raises
    ------
    MachineFaultError
        If an exception is raised that no scene's data can cause.
    """
    count = len(indices[0]) if indices else 1
    settings, estimating = detector_settings(pipeline), estimators(pipeline)
    if need is None:
        need = np.ones((count, len(settings), len(estimating)), dtype=bool)
    if search_too is None:
        search_too = np.zeros((count, len(settings)), dtype=bool)
    size = min(_batch_size(pipeline, estimating), max(count, 1))
    with single_threaded():
        parts = [
            _run_batch(
                pipeline, [index[at : at + size] for index in indices], need[at : at + size],
                search_too[at : at + size],
            )
            for at in range(0, max(count, 1), size)
        ]
    return parts[0] if len(parts) == 1 else concatenate(parts)


def _batch_size(pipeline: Pipeline, estimating: Sequence[EstimatorSetting]) -> int:
    """Return how many scenes are computed at a time: fewer if their images must be kept."""
    if not any(build(estimator).needs_images for estimator in estimating):
        return sys.maxsize
    frame = max(pipeline.values_of("width_px")) * max(pipeline.values_of("height_px"))
    return int(max(KEPT_PX // frame, 1))


def _run_batch(
    pipeline: Pipeline, indices: Sequence[NDArray[np.intp]], need: Masks, search_too: Masks
) -> CellsResult:
    """Return the results of scenes that are in memory together (arguments as `run_cells`)."""
    count = len(need)
    settings, estimating = detector_settings(pipeline), estimators(pipeline)
    searched = need.any(axis=2) | search_too
    failures: list[Failure] = []
    start = time.perf_counter()
    values = scene_values(pipeline, indices)
    scenes = build_scenes(values, count, scene_plugins(pipeline))
    visibility = visibility_flags(scenes)
    boards = None
    if "board" in values:
        boards = board_scenes(
            scenes, values["board"].listed(count), visibility, largest_board(pipeline)
        )
    to_search = searched & (visibility == DetectionStatus.not_run)[:, None]
    geometry_s = time.perf_counter() - start

    builds = [
        build(estimator) if boards is None else build_for_boards(estimator)
        for estimator in estimating
    ]
    keep = any(each.needs_images for each in builds)
    results, render_s, row_s = search(
        scenes, to_search, settings, whole_frames(values, count), failures, keep=keep,
        keys=image_keys(pipeline, indices) if any_recorded(settings) else None,
        boards=boards, board_settings=() if boards is None else board_settings(pipeline),
    )
    columns: dict[str, list[NDArray[Any]]] = {
        variable.name: [] for variable in variables_of(pipeline)
    }

    def add(computed: dict[str, NDArray[Any]]) -> None:
        for name, column in computed.items():
            columns[name].append(column)

    start = time.perf_counter()
    of_scene = compute(SCENE, SceneResults(scenes, _bounds(values, scenes, visibility)))
    add(of_scene if boards is None else of_scene | compute(BOARD_SCENE, boards))
    add({
        variable.name: values[variable.drawn_as].broadcast(count)
        for variable in drawn_variables(pipeline)
    })
    if PHOTOGRAPHS in pipeline.given:
        add(photograph_variables(scenes, values))
    seconds = {
        "scene": [geometry_s + render_s + time.perf_counter() - start],
        "detection": [result.seconds for result in results],
        "estimation": [],
    }
    for k, result in enumerate(results):
        flags = np.where(visibility == DetectionStatus.not_run, result.flags, visibility)
        flags[~searched[:, k]] = DetectionStatus.not_run
        flags = flags.astype(np.uint8)
        if result.boards is None or boards is None:
            add(compute(DETECTION, DetectionResults(scenes, flags, result.corners)))
        else:
            of_boards = {name: function for name, function in BOARD_DETECTION.items()
                         if name in columns}  # without chessboards their corners are no variable
            add(compute(of_boards, BoardResults(boards, result.boards, flags)))
        for j, estimator in enumerate(estimating):
            rows = np.flatnonzero((flags == DetectionStatus.detected) & need[:, k, j])
            start = time.perf_counter()
            detections: Detections | BoardDetections = (
                detections_for(estimator, values, scenes, result, rows) if boards is None
                else board_detections_for(estimator, values, scenes, boards, result, rows)
            )
            known = len(failures)
            estimates = estimate_poses(detections, builds[j], rows, failures)
            failures[known:] = [
                dataclasses.replace(failure, setting=k, estimator=j)
                for failure in failures[known:]
            ]
            compared = _compare(estimates, scenes, rows)
            add(compute_estimation(compared, rows, need[:, k, j], on_boards=boards is not None))
            seconds["estimation"].append(time.perf_counter() - start)
    return CellsResult(columns, seconds, row_s, failures)


def _compare(
    estimates: Estimates, scenes: Scenes, rows: NDArray[np.intp]
) -> EstimationResults:
    """Return the estimates (n,) of the scenes ``rows`` beside the truth and their errors."""
    rotation, translation = scenes.rotation[rows], scenes.translation[rows]
    error = pose_error(estimates.rotation, estimates.translation, rotation, translation)
    return EstimationResults(estimates, error, rotation, translation)


def _bounds(
    values: Mapping[str, Column], scenes: Scenes, visibility: NDArray[np.uint8]
) -> Bounds:
    """Return the accuracy bounds of the scenes that ask for one."""
    count = len(scenes)
    status = np.full(count, BoundStatus.not_run, dtype=np.uint8)
    asked = values["bound"].broadcast(count, np.str_)
    if (asked == "none").all():
        missing = np.broadcast_to(np.nan, count)
        return Bounds(status, np.broadcast_to(np.nan, (count, POSE)), missing, missing)
    status[asked != "none"] = BoundStatus.not_visible
    result = Bounds(
        status, np.full((count, POSE), np.nan), np.full(count, np.nan), np.full(count, np.nan)
    )
    boxes = marker_boxes(scenes)
    for choice in ("known_blur", "unknown_blur"):
        rows = np.flatnonzero((asked == choice) & (visibility == DetectionStatus.not_run))
        part = bounds(scenes, rows, boxes[rows], choice == "unknown_blur")
        for field in dataclasses.fields(Bounds):
            getattr(result, field.name)[rows] = getattr(part, field.name)
    return result
