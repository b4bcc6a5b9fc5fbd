"""A block of cells, computed: scenes, images, detections, estimates, variables."""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

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
from sweep.evaluation.results import CellsResult, Failure, concatenate, exception_text
from sweep.evaluation.search import (
    SearchResult,
    is_recorded,
    search,
    visibility_flags,
    whole_frames,
)
from sweep.experiment.beliefs import CALIBRATED
from sweep.experiment.experiment import largest_board, scene_plugins
from sweep.experiment.grid import (
    board_settings,
    detector_settings,
    estimators,
    image_keys,
    scene_axes,
    scene_values,
)
from sweep.experiment.parameters import PHOTOGRAPHS, Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA, VARIABLES, drawn_variables, variables_of
from sweep.measure.bound import Bounds, bounds, outside_model
from sweep.measure.classify import Findings, TargetScenes, target_scenes
from sweep.measure.estimation import (
    Detections,
    Estimates,
    PoseError,
    pose_error,
    rotation_difference,
    squared_deviations,
)
from sweep.measure.estimators import EstimatorSetting, build
from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus, Flipped
from sweep.model.calibration import COEFFICIENTS, VIEW
from sweep.model.camera import Cameras, Column
from sweep.model.derivatives import POSE
from sweep.model.extent import areas_px, marker_boxes
from sweep.model.lens import pack, pack_once
from sweep.model.polygon import signed_areas
from sweep.model.pose import vector_of_rotation, viewing_angle
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


# --------------------------------------------------------------------------------------------------
# How each variable of the dataset is computed from the results of its stage.
#
# To add a variable, add its record to :data:`sweep.experiment.schema.SCHEMA` and its function to
# the table of its stage below; a variable with one but not the other is refused on import.

@dataclass(frozen=True, slots=True)
class SceneResults:
    """N scenes, their targets and their accuracy bounds."""

    scenes: Scenes
    targets: TargetScenes
    bounds: Bounds


@dataclass(frozen=True, slots=True)
class DetectionResults:
    """Detections of N scenes with one detector setting.

    Attributes
    ----------
    targets, found
        What the scenes show, and what was found of it.
    flags
        (N,) those of the targets as a whole.
    """

    targets: TargetScenes
    found: Findings
    flags: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class EstimationResults:
    """Estimates of one configuration for n scenes, those in which the marker was detected.

    Attributes
    ----------
    estimates, error
        What the estimator returned, and its errors: n of each.
    true_rotation, true_translation
        (n, 3, 3) and (n, 3) in metres, marker to camera.
    """

    estimates: Estimates
    error: PoseError
    true_rotation: Floats
    true_translation: Floats


def _of_geometry(
    function: Callable[[Scenes], NDArray[Any]]
) -> Callable[[SceneResults], NDArray[Any]]:
    return lambda results: function(results.scenes)


def _flipped(results: EstimationResults) -> NDArray[np.uint8]:
    solved = results.estimates.status == EstimateStatus.solved
    flipped = np.where(results.error.flipped, Flipped.flipped, Flipped.not_flipped)
    return np.where(solved, flipped, Flipped.no_estimate).astype(np.uint8)


def _alternative_angle_deg(results: EstimationResults) -> Floats:
    other = rotation_difference(results.estimates.alternative_rotation, results.true_rotation)
    return np.asarray(np.degrees(np.linalg.norm(other, axis=1)))


def _board_area_px(results: SceneResults) -> Floats:
    """Return the total area (N,) of the squares of a board's markers that are seen, px²."""
    targets = results.targets
    on_board = targets.marker_id >= 0
    unseen = ~on_board | (targets.flags == DetectionStatus.not_visible)
    seen = np.where(unseen[..., None, None], 0.0, targets.corners_px)
    area = np.abs(signed_areas(seen.reshape(-1, 4, 2))).reshape(unseen.shape)
    sizes = on_board.sum(axis=1)
    total = np.full(len(area), np.nan)
    for size in np.unique(sizes):  # the order of a sum is that of its length: not of other boards'
        rows = sizes == size
        total[rows] = np.nansum(area[rows, :size], axis=1)
    return np.where(unseen.all(axis=1), np.nan, total)


def _marker_flags(results: DetectionResults) -> NDArray[np.uint8]:
    """Return the flags of the markers (N, M): the target's where it was not searched."""
    searched = results.flags == results.found.flags
    known = searched[:, None] | (results.targets.flags == DetectionStatus.not_on_board)
    return np.where(known, results.found.marker_flags, results.flags[:, None])


def _marker_errors_px(results: DetectionResults) -> Floats:
    errors = results.found.marker_corners - results.targets.corners_px
    errors[_marker_flags(results) != DetectionStatus.detected] = np.nan
    return errors


def _chessboard_errors_px(results: DetectionResults) -> Floats:
    errors = results.found.chessboard_px - results.targets.chessboard_px
    errors[results.flags != DetectionStatus.detected] = np.nan
    return errors


GEOMETRY: dict[str, Callable[[Scenes], NDArray[Any]]] = {
    "true_rvec": lambda scenes: vector_of_rotation(scenes.rotation),
    "true_tvec_m": lambda scenes: scenes.translation,
    "marker_area_px": areas_px,
    "viewing_angle_deg": lambda scenes: np.degrees(
        viewing_angle(scenes.rotation, scenes.translation)
    ),
}
"""Variable that follows from camera, marker and pose -> its values (N, ...)."""

SCENE: dict[str, Callable[[SceneResults], NDArray[Any]]] = {
    **{name: _of_geometry(function) for name, function in GEOMETRY.items()},
    "bound": lambda results: results.bounds.status,
    "bound_std": lambda results: results.bounds.std,
    "bound_kappa": lambda results: results.bounds.kappa,
    "mirror_distance": lambda results: results.bounds.mirror_distance,
}
"""Variable of the scene -> its values (N, ...)."""


def photograph_variables(scenes: Scenes, values: Mapping[str, Column]) -> dict[str, NDArray[Any]]:
    """Return the variables (N, ...) that photographs have besides, by name."""
    distance = scenes.translation[:, 2]
    centre = scenes.cameras.project(scenes.translation[:, None])[:, 0]
    return {
        "side_px": scenes.cameras.view[:, 0] * scenes.size_m / distance,
        "distance_m": distance,
        "tilt_deg": values["resolved_tilt_deg"].values,
        "image_x_px": centre[:, 0], "image_y_px": centre[:, 1],
        "truth": values["truth"].values, "truth_std": values["truth_std"].values,
    }


BOARD_SCENE: dict[str, Callable[[SceneResults], NDArray[Any]]] = {
    "marker_area_px": _board_area_px,
    "board_marker_id": lambda results: np.where(
        results.targets.marker_id < 0, np.nan, results.targets.marker_id
    ),
}
"""Variable of the scene that boards have, or have otherwise -> its values (N, ...)."""

DETECTION: dict[str, Callable[[DetectionResults], NDArray[Any]]] = {
    "detection": lambda results: results.flags,
    "corner_error_px": lambda results: (
        results.found.marker_corners - results.targets.corners_px
    )[:, 0],
}
"""Variable of the detection -> its values (N, ...)."""

BOARD_DETECTION: dict[str, Callable[[DetectionResults], NDArray[Any]]] = {
    "marker_detection": _marker_flags,
    "marker_corner_error_px": _marker_errors_px,
    "chessboard_corner_error_px": _chessboard_errors_px,
}
"""Variable of the detection that boards alone have -> its values (N, ...)."""

ESTIMATION: dict[str, Callable[[EstimationResults], NDArray[Any]]] = {
    "estimate": lambda results: results.estimates.status,
    "translation_error_m": lambda results: results.error.translation_m,
    "rotation_error_rad": lambda results: results.error.rotation_rad,
    "rotation_error_deg": lambda results: np.degrees(results.error.rotation_angle_rad),
    "normal_error_deg": lambda results: np.degrees(results.error.normal_angle_rad),
    "reprojection_error_px": lambda results: results.estimates.reprojection_px,
    "alternative_rotation_error_deg": _alternative_angle_deg,
    "alternative_reprojection_error_px": (
        lambda results: results.estimates.alternative_reprojection_px
    ),
    "predicted_std": lambda results: np.sqrt(
        np.diagonal(results.estimates.covariance, axis1=1, axis2=2)
    ),
    "nees": lambda results: squared_deviations(
        results.error.rotation_rad, results.error.translation_m, results.estimates.covariance
    ),
    "residual_variance_ratio": lambda results: results.estimates.residual_ratio,
    "misfit_px": lambda results: results.estimates.misfit_px,
    "flipped": _flipped,
}
"""Variable of the estimation -> its values (n, ...) for the scenes with a detection."""

BOARD_ESTIMATION: dict[str, Callable[[EstimationResults], NDArray[Any]]] = {
    "point_count": lambda results: results.estimates.point_count,
}
"""Variable of the estimation that boards alone have -> its values (n, ...)."""

WITHOUT_DETECTION: dict[str, int] = {
    "estimate": EstimateStatus.no_detection, "flipped": Flipped.no_estimate,
}
"""Flag variable of the estimation -> its flag for scenes without a detection."""


def check_complete(tables: Mapping[Stage, Mapping[str, Any]]) -> None:
    """Raise TypeError unless each table has exactly the schema's variables of its stage."""
    for stage, table in tables.items():
        declared = {variable.name for variable in SCHEMA if variable.stage is stage}
        for name in sorted(declared ^ table.keys()):
            missing = "no function computes it" if name in declared else "the schema lacks it"
            raise TypeError(f"variable {name} of stage {stage.name}: {missing}")


check_complete({Stage.scene: SCENE, Stage.detection: DETECTION, Stage.estimation: ESTIMATION})

Results = TypeVar("Results")


def compute(
    table: Mapping[str, Callable[[Results], NDArray[Any]]], results: Results,
    names: Collection[str],
) -> dict[str, NDArray[Any]]:
    """Return every variable of a table that is among ``names``."""
    return {name: function(results) for name, function in table.items() if name in names}


def compute_estimation(
    results: EstimationResults, rows: NDArray[np.intp], needed: Masks, names: Collection[str]
) -> dict[str, NDArray[Any]]:
    """Return the estimation variables (N, ...) over all scenes.

    Parameters
    ----------
    results
        Those of the n scenes with a detection.
    rows
        (n,) their numbers among the N scenes.
    needed
        (N,) scenes whose estimate was asked for; the flags of the others are ``not_run``.
    names
        The variables that are wanted.
    """
    columns = {}
    for name, values in compute(ESTIMATION | BOARD_ESTIMATION, results, names).items():
        variable = VARIABLES[name]
        fill = WITHOUT_DETECTION.get(name, variable.fill)
        column = np.full((len(needed), *values.shape[1:]), fill, dtype=values.dtype)
        column[rows] = values
        if variable.flags is not None:
            column[~needed] = variable.fill
        columns[name] = column
    return columns


# --------------------------------------------------------------------------------------------------
# Scene cells of the grid: the nested stages scene -> image -> detection -> estimate.
#
# The paper's eleven steps (Poroykov et al., 2020) are found by name: steps 1-6 in
# :func:`sweep.model.scene.build_scenes`, 7-8 in :mod:`sweep.model.renderers`, 9 in
# :mod:`sweep.measure.detectors` and :mod:`sweep.measure.solver`, 10 in
# :mod:`sweep.measure.estimation`; step 11 is the loop over cells. A scene is rendered once for
# all detector settings, and a detection is shared by all estimators.

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
    boards = values["board"].listed(count) if "board" in values else None
    targets = target_scenes(
        scenes, visibility, boards, (1, 0) if boards is None else largest_board(pipeline)
    )
    to_search = searched & (visibility == DetectionStatus.not_run)[:, None]
    geometry_s = time.perf_counter() - start

    builds = [build(estimator) for estimator in estimating]
    results, render_s, row_s = search(
        scenes, to_search, settings, whole_frames(values, count), failures,
        keep=any(each.needs_images for each in builds), targets=targets,
        keys=image_keys(pipeline, indices) if any(map(is_recorded, settings)) else None,
        board_settings=board_settings(pipeline),
    )
    columns: dict[str, list[NDArray[Any]]] = {
        variable.name: [] for variable in variables_of(pipeline)
    }

    def add(computed: dict[str, NDArray[Any]]) -> None:
        for name, column in computed.items():
            columns[name].append(column)

    start = time.perf_counter()
    table = SCENE if boards is None else SCENE | BOARD_SCENE
    of_scenes = SceneResults(scenes, targets, _bounds(values, scenes, visibility))
    add(compute(table, of_scenes, columns))
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
        of_search = DetectionResults(targets, result.found, flags)
        add(compute(DETECTION | BOARD_DETECTION, of_search, columns))
        for j, estimator in enumerate(estimating):
            rows = np.flatnonzero((flags == DetectionStatus.detected) & need[:, k, j])
            start = time.perf_counter()
            detections = detections_for(estimator, values, scenes, result, rows)
            known = len(failures)
            estimates = estimate_poses(detections, builds[j], rows, failures)
            failures[known:] = [
                dataclasses.replace(failure, setting=k, estimator=j)
                for failure in failures[known:]
            ]
            compared = _compare(estimates, scenes, rows)
            add(compute_estimation(compared, rows, need[:, k, j], columns))
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
    lengths = [len(axis) for axis in scene_axes(pipeline)]
    total = math.prod(lengths)
    numbers = np.unique(np.linspace(0, total - 1, min(total, NOTED_SCENES)).astype(np.int64))
    indices = [np.asarray(index, dtype=np.intp) for index in np.unravel_index(numbers, lengths)] \
        if lengths else []
    values = scene_values(pipeline, indices)
    scenes = build_scenes(values, len(numbers), scene_plugins(pipeline))
    asked = np.flatnonzero(values["bound"].broadcast(len(numbers), np.str_) != "none")
    found = {outside_model(scenes, row) for row in asked.tolist()}
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
    lengths = [len(axis) for axis in scene_axes(standard)]
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
