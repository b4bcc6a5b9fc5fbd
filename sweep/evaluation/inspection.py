"""A single scene in detail: its image, detections and estimate, as ``sweep show`` draws it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import RunError
from sweep.evaluation.block import assumed_cameras, run_cells
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import SceneBatch, detections_of, scenes_at, searched_windows
from sweep.experiment.experiment import Experiment
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import SearchOutput
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.pose import rotation_of_vector, transform_points
from sweep.model.renderers import render
from sweep.typing import Floats, Grey


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


def _indices(experiment: Experiment) -> list[NDArray[np.intp]]:
    return [np.zeros(1, dtype=np.intp) for _ in experiment.scene_axes]


def _rendered(batch: SceneBatch, *, whole_frame: bool) -> tuple[Grey, tuple[int, int, int, int]]:
    """Return the image (h, w) of a single scene and its window: the one that is searched.

    The whole frame if that is asked for, or if the target is not seen.
    """
    right, bottom = batch.scenes.frame[0].tolist()
    window, box = (0, 0, right, bottom), np.zeros_like(batch.boxes[0])
    if batch.visible[0]:
        box = batch.boxes[0]
        if not whole_frame:
            left, top, right, bottom = searched_windows(batch)[0][0].tolist()
            window = left, top, right, bottom
    return render(batch.scenes, 0, box, window), window


@single_threaded()
def scene_image(pipeline: Pipeline, *, whole_frame: bool = False) -> Grey:
    """Return the image (h, w) of a pipeline's single scene; it is not searched."""
    experiment = pipeline.experiment
    return _rendered(scenes_at(experiment, _indices(experiment)), whole_frame=whole_frame)[0]


@single_threaded()
def inspect_scene(pipeline: Pipeline, *, whole_frame: bool = False) -> SceneInspection:
    """Return a pipeline's single scene in detail.

    Parameters
    ----------
    pipeline
        Every axis but ``trial`` must be fixed, as
        :func:`sweep.experiment.pipeline.cell` does.
    whole_frame
        Whether the image is the whole frame; the searched window is a run's all the same.

    Raises
    ------
    RunError
        If the scene's computation raises.
    """
    experiment = pipeline.experiment
    result = run_cells(experiment, _indices(experiment))
    if result.failures:
        raise RunError(result.failures[0].text.strip().splitlines()[-1])
    columns = {name: column[0, 0] for name, column in result.columns.items()}
    batch = scenes_at(experiment, _indices(experiment))
    scenes, target = batch.scenes, batch.targets.targets[0]
    image, window = _rendered(batch, whole_frame=whole_frame)
    (searched,) = detections_of(batch, batch.visible[:, None], [])
    output = searched.outputs.get(0, SearchOutput([], None, []))
    ids, origin = () if output.ids is None else output.ids.ravel(), searched.output_origins[0]
    length = float(scenes.size_m[0])
    if not target.is_marker:
        length = float(np.ptp(target.corners_m.reshape(-1, 3), axis=0)[:2].min())
    axes_px = np.full((4, 2), np.nan)
    if columns["estimate"] == EstimateStatus.solved:
        cameras, _ = assumed_cameras(experiment.estimators[0], batch.values, scenes)
        rotation = rotation_of_vector(columns["rotation_error_rad"]) @ scenes.rotation[0]
        position = scenes.translation[0] + columns["translation_error_m"]
        ends = np.concatenate([np.zeros((1, 3)), np.eye(3)]) * length / 2
        axes_px = cameras.project(transform_points(ends[None], rotation[None], position[None]))[0]
    return SceneInspection(
        image=image,
        window=window,
        true_corners=scenes.corners_px[0],
        true_markers=batch.targets.corners_px[0],
        markers=searched.found.marker_corners[0],
        chessboard=searched.found.chessboard_px[0],
        area_px=float(columns["marker_area_px"]),
        decoded=[
            (int(number), quad[0] + origin)
            for number, quad in zip(ids, output.corners, strict=True)
        ],
        rejected=[quad[0] + origin for quad in output.rejected],
        detection=DetectionStatus(int(columns["detection"])),
        estimate=EstimateStatus(int(columns["estimate"])),
        axes_px=axes_px,
        errors={
            v.name: float(np.linalg.norm(columns[v.name]))
            for v in experiment.variables
            if v.flags is None and v.inner in ((), ("xyz",)) and v.stage is Stage.estimation
        },
        values={v.name: np.asarray(columns[v.name], dtype=v.dtype) for v in experiment.variables},
    )
