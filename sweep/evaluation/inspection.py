"""A single scene in detail: its image, detections and estimate, as ``sweep show`` draws it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError, RunError
from sweep.evaluation.block import assumed_cameras, run_cells
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import (
    RecordedSearch,
    detection_source,
    is_recorded,
    search_windows,
    visibility_flags,
    whole_frames,
)
from sweep.experiment.experiment import largest_board, scene_plugins
from sweep.experiment.grid import (
    board_settings,
    detector_settings,
    estimators,
    image_keys,
    scene_values,
)
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import variables_of
from sweep.measure.classify import target_scenes
from sweep.measure.detectors import SearchOutput
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.camera import Column
from sweep.model.extent import marker_boxes
from sweep.model.pose import rotation_of_vector, transform_points
from sweep.model.renderers import render
from sweep.model.scene import Scenes, build_scenes
from sweep.typing import Floats, Grey, Integers, Masks


@dataclass(frozen=True, slots=True)
class SceneInspection:
    """A single scene in detail, as ``sweep show`` draws it.

    Attributes
    ----------
    image
        (h, w) grey levels of ``window``: left, top, right, bottom in the frame.
    true_corners
        (4, 2) px of the marker, or of a board's black rectangle.
    true_markers, markers
        (M, 4, 2) px: the true corners of each marker, and those that were detected, or NaN.
    chessboard
        (C, 2) px of the corners of a chessboard that were found, or NaN.
    decoded, rejected
        The detector's quadrilaterals: (ID, corners (4, 2)) and corners (4, 2), px.
    detection, estimate
        The flags.
    axes_px
        (4, 2) images of the origin and of the ends of x, y and z (half a side long, of a board
        half its smaller side) of the estimated pose; NaN if there is none.
    errors
        Name -> value (or norm) of the estimation's error variables.
    values
        Name -> value of every variable, as a store holds it.
    """

    image: Grey
    window: tuple[int, int, int, int]
    true_corners: Floats
    true_markers: Floats
    markers: Floats
    chessboard: Floats
    area_px: float
    decoded: list[tuple[int, Floats]]
    rejected: list[Floats]
    detection: DetectionStatus
    estimate: EstimateStatus
    axes_px: Floats
    errors: dict[str, float]
    values: dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class _Rendered:
    """A pipeline's single scene: parameters, geometry, image and the image's window."""

    values: dict[str, Column]
    scenes: Scenes
    boxes: Integers
    invisible: Masks
    window: tuple[int, int, int, int]
    image: Grey


def _rendered(pipeline: Pipeline, *, whole_frame: bool) -> _Rendered:
    indices = [np.zeros(1, dtype=np.intp) for _ in pipeline.axes_of(Stage.scene)]
    values = scene_values(pipeline, indices)
    scenes = build_scenes(values, 1, scene_plugins(pipeline))
    boxes = marker_boxes(scenes)
    full = whole_frames(values, 1) | whole_frame
    invisible = visibility_flags(scenes) != DetectionStatus.not_run
    setting = detector_settings(pipeline)[0]
    left, top, right, bottom = search_windows(scenes, boxes, setting, full | invisible)[0].tolist()
    drawn = np.zeros_like(boxes[0]) if invisible[0] else boxes[0]
    window = (left, top, right, bottom)
    return _Rendered(values, scenes, boxes, invisible, window, render(scenes, 0, drawn, window))


@single_threaded()
def scene_image(pipeline: Pipeline, *, whole_frame: bool = False) -> Grey:
    """Return the image (h, w) of a pipeline's single scene; it is not searched."""
    return _rendered(pipeline, whole_frame=whole_frame).image


@single_threaded()
def inspect_scene(pipeline: Pipeline, *, whole_frame: bool = False) -> SceneInspection:
    """Return a pipeline's single scene in detail.

    Parameters
    ----------
    pipeline
        Every axis but ``trial`` must be fixed, as
        :func:`sweep.experiment.cell_selection.cell` does.
    whole_frame
        Whether the image is the whole frame; the searched window is that of a run all the same.

    Raises
    ------
    RunError
        If the scene's computation raises.
    """
    indices = [np.zeros(1, dtype=np.intp) for _ in pipeline.axes_of(Stage.scene)]
    result = run_cells(pipeline, indices)
    if result.failures:
        raise RunError(result.failures[0].text.strip().splitlines()[-1])
    rendered = _rendered(pipeline, whole_frame=whole_frame)
    values, scenes, image = rendered.values, rendered.scenes, rendered.image
    left, top, _, _ = rendered.window
    setting, estimator = detector_settings(pipeline)[0], estimators(pipeline)[0]
    # Searched in its own window, as in a run, even if the whole frame is shown.
    full = whole_frames(values, 1) | rendered.invisible
    searched = search_windows(scenes, rendered.boxes, setting, full)
    x0, y0, x1, y1 = searched[0].tolist()
    boards = values["board"].listed(1) if "board" in values else None
    targets = target_scenes(
        scenes, visibility_flags(scenes), boards,
        (1, 0) if boards is None else largest_board(pipeline),
    )
    keys = image_keys(pipeline, indices) if is_recorded(setting) else None
    source = detection_source(setting, scenes, targets, keys, board_settings(pipeline)[0])
    output, origin = SearchOutput([], None, []), np.zeros(2)
    if isinstance(source, RecordedSearch):  # in pixels of the frame
        with suppress(PluginError):  # flagged "failed" by the run
            output = source(0)
    else:
        origin = np.array([x0, y0], dtype=np.float64)
        output = source(0, image[y0 - top : y1 - top, x0 - left : x1 - left])
    columns = {name: parts[0][0] for name, parts in result.columns.items()}
    chessboard, length = np.zeros((0, 2)), float(scenes.size_m[0])
    true_markers = targets.corners_px[0]
    if boards is None:
        markers = true_markers + columns["corner_error_px"]
    else:
        markers = true_markers + columns["marker_corner_error_px"]
        if "chessboard_corner_error_px" in columns:
            chessboard = targets.chessboard_px[0] + columns["chessboard_corner_error_px"]
        length = float(np.ptp(boards[0].corners_m.reshape(-1, 3), axis=0)[:2].min())
    axes_px = np.full((4, 2), np.nan)
    if columns["estimate"] == EstimateStatus.solved:
        cameras, _ = assumed_cameras(estimator, values, scenes)
        vector = columns["rotation_error_rad"]
        rotation = rotation_of_vector(vector) @ scenes.rotation[0]
        position = scenes.translation[0] + columns["translation_error_m"]
        ends = np.concatenate([np.zeros((1, 3)), np.eye(3)]) * length / 2
        axes_px = cameras.project(transform_points(ends[None], rotation[None], position[None]))[0]
    return SceneInspection(
        image=image,
        window=rendered.window,
        true_corners=scenes.corners_px[0],
        true_markers=true_markers,
        markers=markers,
        chessboard=chessboard,
        area_px=float(columns["marker_area_px"]),
        decoded=[
            (int(marker_id), quad[0] + origin)
            for marker_id, quad in zip(
                () if output.ids is None else output.ids.ravel(), output.corners, strict=True
            )
        ],
        rejected=[quad[0] + origin for quad in output.rejected],
        detection=DetectionStatus(int(columns["detection"])),
        estimate=EstimateStatus(int(columns["estimate"])),
        axes_px=axes_px,
        errors={
            v.name: float(np.linalg.norm(columns[v.name]))
            for v in variables_of(pipeline)
            if v.flags is None and v.inner in ((), ("xyz",)) and v.stage is Stage.estimation
        },
        values={
            v.name: np.asarray(columns[v.name], dtype=v.dtype) for v in variables_of(pipeline)
        },
    )
