"""A block of cells, computed: scenes, images, detections, estimates, variables."""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import MachineFaultError
from sweep.evaluation.machine_faults import (
    exception_line,
    local_fault,
    machine_faults_raised,
    raise_machine_fault,
)
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.results import (
    CellsResult,
    Failure,
    concatenate,
    exception_text,
    to_dataset_layout,
)
from sweep.evaluation.search import (
    SearchResult,
    is_recorded,
    search,
    visibility_flags,
    whole_frames,
)
from sweep.evaluation.variables import (
    DETECTION,
    SCENE,
    SceneResults,
    compared,
    compute,
    compute_estimation,
)
from sweep.experiment.draws import CALIBRATED
from sweep.experiment.grid import (
    Block,
    block_indices,
)
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.bound import Bounds, bounds, outside_model
from sweep.measure.classify import TargetScenes, target_scenes
from sweep.measure.estimation import Detections, Estimates, PoseEstimator
from sweep.measure.estimators import EstimatorSetting, build
from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus
from sweep.model.calibration import COEFFICIENTS, VIEW
from sweep.model.camera import Cameras, Column
from sweep.model.derivatives import POSE
from sweep.model.extent import marker_boxes
from sweep.model.lens import pack, pack_once
from sweep.model.renderers import beside_pixels
from sweep.model.scene import Scenes, build_scenes
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# Detections to poses: what an estimator assumes; a failure in a batch costs one pose only.

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
    truth = scenes.effects
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
    """Return what was found in scenes ``rows`` (n,), with what an estimator assumes of them."""
    cameras, size = assumed_cameras(estimator, values, scenes)
    noise, blur = _assumed_noise_and_blur(estimator, scenes)
    found, targets = result.found, result.targets.targets
    on_board = values["on_board"].values if "on_board" in values else None
    images = [result.images[row] for row in rows.tolist()] if result.images else []
    beside: list[Masks] = []
    if images and any(each.distractors for each in targets):
        for row, image in zip(rows.tolist(), images, strict=True):
            left, top = result.origins[row].tolist()
            box = left, top, left + image.shape[1], top + image.shape[0]
            beside.append(beside_pixels(scenes, row, box))
    # The detections of all scenes, of which those of the rows are taken.
    everything = Detections(
        found.corners, cameras, size, noise, blur, targets, [], result.origins, found.owner,
        found.square, size / scenes.size_m, found.chessboard_px, (),
        None if result.poses is None else result.poses.rotation,
        None if result.poses is None else result.poses.translation, on_board,
    )
    return dataclasses.replace(everything.take(rows), images=images, beside=beside)


def estimate_poses(
    detections: Detections, estimator: PoseEstimator, failures: int
) -> tuple[Estimates, list[tuple[int, str]]]:
    """Return estimates of n targets, and the numbers and exceptions of those that raise.

    One by one if the batch raises; ``failures`` are those that are known already, by whose number
    texts get shorter.
    """
    try:
        return estimator(detections), []
    except Exception as batch_error:
        raise_machine_fault(batch_error)
        parts: list[Estimates] = []
        failed: list[tuple[int, str]] = []
        for i in range(len(detections)):
            try:
                parts.append(estimator(detections.take(np.array([i]))))
            except Exception as error:
                raise_machine_fault(error)
                failed.append((i, exception_text(failures + len(failed))))
                parts.append(Estimates.none(1, EstimateStatus.failed))
        return Estimates.concatenate(parts), failed


# --------------------------------------------------------------------------------------------------
# Scene cells of the grid: scenes -> images -> detections -> estimates.
#
# The paper's eleven steps (Poroykov et al., 2020) are found by name:
#
#   steps 1-6   scenes       :func:`scenes_at`: camera, pose, what is printed
#                            (:func:`sweep.model.scene.build_scenes`)
#   steps 7-8   images       :func:`sweep.evaluation.search.rendered`
#                            (:mod:`sweep.model.renderers`)
#   step 9      detections   :func:`sweep.evaluation.search.search` (:mod:`sweep.measure.detectors`)
#               estimates    :func:`estimate_poses` (:mod:`sweep.measure.solver`)
#   step 10     errors       :mod:`sweep.evaluation.variables`, :mod:`sweep.measure.estimation`
#   step 11     the loop over cells: :func:`run_cells`
#
# A scene is rendered once for all detector settings, and a detection is shared by all estimators.

KEPT_PX = 1 << 26
"""Pixels of images that are kept for the estimators, if all were whole frames: 67 MB of memory."""


@dataclass(frozen=True, slots=True)
class SceneBatch:
    """N scenes that are in memory together.

    Attributes
    ----------
    values, scenes
        Parameters and geometry.
    visibility
        (N,) why the scenes are not searched; ``not_run`` for those that are.
    targets
        What the scenes show.
    """

    values: dict[str, Column]
    scenes: Scenes
    visibility: NDArray[np.uint8]
    targets: TargetScenes


def scenes_at(pipeline: Pipeline, indices: Sequence[NDArray[np.intp]]) -> SceneBatch:
    """Return the scenes at indices (N,) along each scene axis."""
    count = len(indices[0]) if indices else 1
    values = pipeline.experiment.scene_values(indices)
    scenes = build_scenes(values, count, pipeline.experiment.scene_plugins)
    visibility = visibility_flags(scenes)
    boards = values["board"].listed(count) if "board" in values else None
    targets = target_scenes(
        scenes, visibility, boards, (1, 0) if boards is None else pipeline.experiment.largest_board
    )
    return SceneBatch(values, scenes, visibility, targets)


def search_batch(
    pipeline: Pipeline, batch: SceneBatch, wanted: Masks, failures: list[Failure], *, keep: bool,
    keys: NDArray[np.uint64] | None = None,
) -> tuple[list[SearchResult], float, Floats]:
    """Render scenes once and search them with each detector setting of an experiment.

    All else as `sweep.evaluation.search.search`.
    """
    return search(
        batch.scenes, wanted, pipeline.experiment.detectors,
        whole_frames(batch.values, len(batch.scenes)), failures, keep=keep, keys=keys,
        targets=batch.targets, board_settings=pipeline.experiment.board_settings,
    )


def compute_block(pipeline: Pipeline, block: Block) -> dict[str, NDArray[Any]]:
    """Return every variable of a block in the dataset's dimensions: a function of cells and seed.

    Examples
    --------
    >>> pipeline = Pipeline.from_dict({"pose": {"distance_m": 0.5, "tilt_deg": 20}})
    >>> int(compute_block(pipeline, Block((), ()))["detection"])
    1
    """
    cells = run_cells(pipeline, block_indices(block))
    return {
        variable.name: to_dataset_layout(variable, pipeline, block, cells.columns[variable.name])
        for variable in pipeline.experiment.variables
    }


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
    configurations = pipeline.size(Stage.detection), pipeline.size(Stage.estimation)
    if need is None:
        need = np.ones((count, *configurations), dtype=bool)
    searched: Masks = np.asarray(need.any(axis=2))
    if search_too is not None:
        searched |= search_too
    settings = pipeline.experiment.estimators
    # Fewer scenes at a time if their images must be kept.
    size = sys.maxsize
    if any(build(setting).needs_images for setting in settings):
        frame = max(pipeline.values_of("width_px")) * max(pipeline.values_of("height_px"))
        size = max(KEPT_PX // frame, 1)
    with single_threaded():
        parts = [
            _run_batch(
                pipeline, [index[at : at + size] for index in indices], need[at : at + size],
                searched[at : at + size],
            )
            for at in range(0, max(count, 1), min(size, max(count, 1)))
        ]
    return parts[0] if len(parts) == 1 else concatenate(parts)


def _run_batch(
    pipeline: Pipeline, indices: Sequence[NDArray[np.intp]], need: Masks, searched: Masks
) -> CellsResult:
    """Return the results of scenes that are in memory together, as :func:`run_cells`.

    ``searched`` (N, detector settings) are the searches that are made.
    """
    failures: list[Failure] = []
    settings, estimating = pipeline.experiment.detectors, pipeline.experiment.estimators
    columns: dict[str, list[NDArray[Any]]] = {
        variable.name: [] for variable in pipeline.experiment.variables
    }
    drawn = {variable.name: variable.drawn_as for variable in pipeline.experiment.drawn}

    def add(computed: Mapping[str, NDArray[Any]]) -> None:
        for name, column in computed.items():
            columns[name].append(column)

    start = time.perf_counter()
    batch = scenes_at(pipeline, indices)
    visible: Masks = np.asarray(batch.visibility == DetectionStatus.not_run)
    geometry_s = time.perf_counter() - start

    builds = [build(estimator) for estimator in estimating]
    results, render_s, row_s = search_batch(
        pipeline, batch, searched & visible[:, None], failures,
        keep=any(each.needs_images for each in builds),
        keys=pipeline.experiment.image_keys(indices) if any(map(is_recorded, settings)) else None,
    )

    start = time.perf_counter()
    of_scenes = SceneResults(batch.scenes, batch.values, batch.targets, _bounds(batch))
    add(compute(SCENE, of_scenes, columns.keys() - drawn.keys()))
    add({name: batch.values[key].broadcast(len(need)) for name, key in drawn.items()})
    seconds = {
        "scene": [geometry_s + render_s + time.perf_counter() - start],
        "detection": [result.seconds for result in results],
        "estimation": [],
    }
    for k, result in enumerate(results):
        flags = np.where(visible, result.flags, batch.visibility)
        flags[~searched[:, k]] = DetectionStatus.not_run
        result.flags = flags
        add(compute(DETECTION, result, columns))
        for j, estimator in enumerate(estimating):
            rows = np.flatnonzero((result.flags == DetectionStatus.detected) & need[:, k, j])
            start = time.perf_counter()
            detections = detections_for(estimator, batch.values, batch.scenes, result, rows)
            estimates, failed = estimate_poses(detections, builds[j], len(failures))
            failures += [
                Failure(int(rows[i]), "estimation", text, setting=k, estimator=j)
                for i, text in failed
            ]
            add(compute_estimation(
                compared(estimates, batch.scenes, rows), rows, need[:, k, j], columns
            ))
            seconds["estimation"].append(time.perf_counter() - start)
    return CellsResult(columns, seconds, row_s, failures)


def _bounds(batch: SceneBatch) -> Bounds:
    """Return the accuracy bounds of the scenes that ask for one."""
    count = len(batch.scenes)
    asked = batch.values["bound"].broadcast(count, np.str_)
    status = np.full(count, BoundStatus.not_visible, dtype=np.uint8)
    status[asked == "none"] = BoundStatus.not_run
    result = Bounds(
        status, np.full((count, POSE), np.nan), np.full(count, np.nan), np.full(count, np.nan)
    )
    visible = batch.visibility == DetectionStatus.not_run
    boxes = None
    for choice in ("known_blur", "unknown_blur"):
        rows = np.flatnonzero((asked == choice) & visible)
        if not len(rows):
            continue
        boxes = marker_boxes(batch.scenes) if boxes is None else boxes
        part = bounds(batch.scenes, rows, boxes[rows], choice == "unknown_blur")
        for field in dataclasses.fields(Bounds):
            getattr(result, field.name)[rows] = getattr(part, field.name)
    return result


NOTED_SCENES = 64
"""Scenes, spread over the grid, by which it is told whether any has a bound."""

NO_BOUND = {
    BoundStatus.clipped: "a grey level is within two standard deviations of the noise of 0 or 255; "
    "move black, white and background inwards, such as black = 20 and white = 235",
    BoundStatus.no_noise: "the noise is below half a grey level; raise noise_grey",
    BoundStatus.not_in_model: "an active effect, or a background image, is not in its model",
}


def bound_notes(pipeline: Pipeline) -> list[str]:
    """Return a line if a pipeline asks for the accuracy bound and no scene can have one."""
    if set(pipeline.values_of("bound")) <= {"none"}:
        return []
    lengths = [len(axis) for axis in pipeline.experiment.scene_axes]
    total = math.prod(lengths)
    numbers = np.unique(np.linspace(0, total - 1, min(total, NOTED_SCENES)).astype(np.int64))
    indices = [np.asarray(index, dtype=np.intp) for index in np.unravel_index(numbers, lengths)] \
        if lengths else []
    batch = scenes_at(pipeline, indices)
    asked = np.flatnonzero(batch.values["bound"].broadcast(len(numbers), np.str_) != "none")
    found = {outside_model(batch.scenes, row) for row in asked.tolist()}
    if not found or BoundStatus.given in found:
        return []
    sampled = "" if len(numbers) == total else f" ({len(numbers)} of {total:,} were looked at)"
    reasons = "; ".join(f"{flag.name}: {NO_BOUND[flag]}" for flag in sorted(found))
    return [f"warning: no pose has a bound{sampled}: {reasons}"]


# --------------------------------------------------------------------------------------------------
# A standard scene, computed before any block: a machine that cannot do that computes nothing.

SOLVERS = ("ippe_square", "photometric", "photometric_real")
"""Solvers whose compiled code is loaded, if the pipeline has them; else that of the first."""

TITLE = "A standard scene"

MAX_ERROR_RAD = 0.2
"""Rotation error of the standard scene; with the supported solvers it is below 0.05."""


def warm_up(pipeline: Pipeline) -> None:
    """Load the compiled code that a pipeline needs by computing a scene of known pose with it.

    Its renderers, bounds and solvers are used, without plug-ins, but none of its scenes, which may
    end the process.

    Raises
    ------
    MachineFaultError
        If the scene cannot be computed, or the marker's pose is not what it is known to be.
    """
    renderers = sorted(
        name for name in set(pipeline.values_of("renderer"))
        if pipeline.plugin("renderer", name) is None
    )
    solvers = [name for name in SOLVERS if name in pipeline.values_of("solver")]
    standard = Pipeline.from_dict({
        "title": TITLE,
        "camera": {"width_px": 160, "height_px": 120},
        "pose": {"side_px": 60, "tilt_deg": 45},
        "scene": {"noise_grey": 1.0},
        "axes": {
            "renderer": renderers or ["exact"],
            "bound": sorted(set(pipeline.values_of("bound"))),
            "solver": solvers or [SOLVERS[0]],
        },
    })
    lengths = [len(axis) for axis in standard.experiment.scene_axes]
    indices = [index.ravel() for index in np.indices(lengths, dtype=np.intp)]
    try:
        cells = run_cells(standard, indices)
    except MachineFaultError:
        raise
    except Exception as error:
        raise local_fault(f"a standard scene raises {exception_line(error)}") from None
    for k in range(standard.size(Stage.detection, Stage.estimation)):
        error_rad = np.linalg.norm(cells.columns["rotation_error_rad"][k], axis=1)
        if not (error_rad < MAX_ERROR_RAD).all():  # NaN without a pose
            raise local_fault("the pose of a standard scene is computed wrongly")
