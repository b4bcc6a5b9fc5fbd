"""A block of cells, computed: scenes, images, detections, estimates, variables.

The paper's eleven steps (Poroykov et al., 2020) are found by name::

    steps 1-6   scenes       sweep.evaluation.search.scenes_at: camera, pose, print
                             (sweep.model.scene.build_scenes)
    steps 7-8   images       sweep.evaluation.search.images_of (sweep.model.renderers)
    step 9      detections   sweep.evaluation.search.detections_of (sweep.measure.detectors)
                estimates    estimates_of (sweep.measure.solver)
    step 10     errors       sweep.evaluation.variables, sweep.measure.estimation
    step 11     the loop over cells: run_cells, compute_block

A scene is rendered once for all detector settings, and a detection is shared by all estimators.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import MachineFaultError, local_fault
from sweep.evaluation import results, variables
from sweep.evaluation.machine_faults import machine_faults_raised
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import SceneBatch, SearchResult, detections_of, scenes_at
from sweep.experiment.draws import CALIBRATED
from sweep.experiment.experiment import Experiment
from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import PluginSetting, make_detector
from sweep.measure.estimation import Detections, Estimates, PoseEstimator
from sweep.measure.estimators import EstimatorSetting, build
from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus
from sweep.measure.likelihood import bounds, outside_model
from sweep.messages import exception_line
from sweep.model.calibration import COEFFICIENTS, VIEW
from sweep.model.camera import Cameras, Column
from sweep.model.lens import pack
from sweep.model.renderers import beside_pixels
from sweep.model.scene import Scenes
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# Detections to poses: an estimator's assumptions; a failure in a batch costs one pose only.

def assumed_cameras(
    estimator: EstimatorSetting, values: Mapping[str, Column], scenes: Scenes
) -> tuple[Cameras, Floats]:
    """Return the N cameras and marker sizes (N,) in m that an estimator assumes.

    They are the scenes' own, but for the ``believed_`` parameters: of ``values`` if they are drawn,
    else of the estimator. A believed calibration is drawn.
    """
    truth, calibrated = scenes.cameras, estimator.believed == "calibration"
    view, size, lenses, distorted = truth.view, scenes.size_m, truth.lenses, truth.distorted

    def assumed(name: str) -> Any:
        if calibrated and CALIBRATED + name in values:
            return values[CALIBRATED + name].values
        drawn = values.get(f"believed_{name}")
        if drawn is None or drawn.constant:
            return getattr(estimator, f"believed_{name}", None)
        return drawn.values

    scale, focal_and_centre = assumed("focal_scale"), [assumed(name) for name in VIEW]
    if scale is not None or any(value is not None for value in focal_and_centre):
        view = view.copy()
        view[:, :2] *= 1.0 if scale is None else np.reshape(scale, (-1, 1))
        for k, value in enumerate(focal_and_centre):
            view[:, k] = view[:, k] if value is None else value
    if (side := assumed("size_m")) is not None:
        size = np.full(len(scenes), side, dtype=np.float64)
    packed: Any = None
    if (coefficients := estimator.believed_distortion) is not None:
        packed = [pack(coefficients)] * len(scenes)
    elif drawn := [each for name in COEFFICIENTS if (each := assumed(name)) is not None]:
        packed = [pack(tuple(row)) for row in np.stack(drawn, axis=1).tolist()]
    if packed is not None:
        lenses = np.array(packed)
        distorted = np.asarray(lenses[:, :14].any(axis=1))
    return Cameras(view, lenses, distorted), size


def detections_for(
    estimator: EstimatorSetting, batch: SceneBatch, result: SearchResult, rows: NDArray[np.intp]
) -> Detections:
    """Return the detections in scenes ``rows`` (n,), with an estimator's assumptions of them."""
    values, scenes, found, targets = batch.values, batch.scenes, result.found, batch.targets.targets
    cameras, size = assumed_cameras(estimator, values, scenes)
    noise, blur = (
        np.broadcast_to(truth if believed is None else believed, len(scenes))
        for truth, believed in (
            (scenes.effects["noise_grey"], estimator.believed_noise_grey),
            (scenes.effects["blur_px"], estimator.believed_blur_px),
        )
    )
    on_board = values["on_board"].values if "on_board" in values else None
    images, beside = [], list[Masks]()
    for row in rows.tolist() if result.images else ():
        images.append(result.images[row])
        if any(each.distractors for each in targets):
            (left, top), (height, width) = result.origins[row].tolist(), images[-1].shape
            beside.append(beside_pixels(scenes, row, (left, top, left + width, top + height)))
    # The detections of all scenes, of which those of the rows are taken.
    everything = Detections(
        found.corners, cameras, size, noise, blur, targets, [], result.origins, found.owner,
        found.square, size / scenes.size_m, found.chessboard_px, (), result.poses.rotation,
        result.poses.translation, on_board,
    )
    some = everything if len(rows) == len(scenes) else everything.take(rows)
    return dataclasses.replace(some, images=images, beside=beside)


def estimates_of(
    seen: Detections, estimator: PoseEstimator, rows: NDArray[np.intp],
    failures: list[results.Failure], setting: int, number: int,
) -> Estimates:
    """Return estimates of the targets of scenes ``rows`` (n,); one by one if the batch raises.

    ``setting`` and ``number`` are the detector's and the estimator's, for the failures.
    """
    parts = results.all_or_each(
        lambda some: estimator(seen if len(some) == len(rows) else seen.take(some)),
        np.arange(len(rows)),
        lambda i: results.note_failure(failures, int(rows[i]), "estimation", setting, number),
    )
    return Estimates.concatenate([
        Estimates.none(1, EstimateStatus.failed) if part is None else part for part in parts
    ])


# --------------------------------------------------------------------------------------------------
# Scene cells of the grid: scenes -> images -> detections -> estimates -> variables.

#: Pixels of images that are kept for the estimators, if all were whole frames: 67 MB of memory.
KEPT_PX = 1 << 26


def compute_block(experiment: Experiment, block: Block) -> dict[str, NDArray[Any]]:
    """Return every variable of a block in the dataset's dimensions: a function of cells and seed.

    Examples
    --------
    >>> pipeline = Pipeline.from_dict({"pose": {"distance_m": 0.5, "tilt_deg": 20}})
    >>> int(compute_block(pipeline.experiment, Block((), ()))["detection"])
    1
    """
    cells = run_cells(experiment, block.indices())
    return {
        variable.name: results.to_dataset_layout(
            variable, experiment.grid, block, cells.columns[variable.name])
        for variable in experiment.variables
    }


@machine_faults_raised()
def run_cells(
    experiment: Experiment,
    indices: Sequence[NDArray[np.intp]],
    need: Masks | None = None,
    searched: Masks | None = None,
) -> results.CellsResult:
    """Render, detect and estimate scene cells.

    Parameters
    ----------
    experiment
        The compiled experiment.
    indices
        Indices (N,) along each scene axis.
    need
        (N, detector settings, estimators) the estimates that are computed; all by default. The
        others are flagged ``not_run``.
    searched
        (N, detector settings) the searches that are made; those for the estimates by default. By
        it a search that ends its process is told from an estimate that does.

    Returns
    -------
    CellsResult
        The variables, seconds and failures of the N cells.

    Raises
    ------
    MachineFaultError
        If an exception is raised that no scene's data can cause.
    """
    grid, count = experiment.grid, len(indices[0]) if indices else 1
    if need is None:
        need = np.ones((count, grid.size(Stage.detection), grid.size(Stage.estimation)), dtype=bool)
    if searched is None:
        searched = np.asarray(need.any(axis=2))
    builds = [build(setting) for setting in experiment.estimators]
    size = max(count, 1)
    if experiment.solvers_on_pixels:
        # Fewer scenes at a time, since their images must be kept.
        frame = max(grid.values_of("width_px")) * max(grid.values_of("height_px"))
        size = max(KEPT_PX // frame, 1)
    result = results.CellsResult.not_run(experiment, count)
    with single_threaded():
        for at in range(0, max(count, 1), size):
            part = slice(at, at + size)
            _run_batch(
                experiment, builds, [index[part] for index in indices], need[part],
                searched[part], part, result,
            )
    return result


def _run_batch(
    experiment: Experiment, builds: Sequence[PoseEstimator],
    indices: Sequence[NDArray[np.intp]], need: Masks, searched: Masks, part: slice,
    result: results.CellsResult,
) -> None:
    """Write the results of scenes that are in memory together to ``part`` of a result's scenes.

    ``need`` and ``searched`` are as in :func:`run_cells`, of these scenes.
    """
    failures: list[results.Failure] = []
    columns = {name: column[:, part] for name, column in result.columns.items()}
    drawn = {variable.name: variable.drawn_as for variable in experiment.drawn}

    start = time.perf_counter()
    batch = scenes_at(experiment, indices)
    found = detections_of(
        batch, searched & batch.visible[:, None], failures,
        keep=bool(experiment.solvers_on_pixels),
    )
    asked = batch.values["bound"].broadcast(len(need), np.str_)
    bound = bounds(batch.scenes, batch.boxes, asked, batch.visible)
    of_scenes = variables.SceneResults(batch, bound)
    computed = {name: column for name, column in columns.items() if name not in drawn}
    variables.write(computed, variables.SCENE, of_scenes, 0)
    for name, key in drawn.items():
        columns[name][0] = batch.values[key].broadcast(len(need))
    spent = time.perf_counter() - start
    result.seconds["scene"][0] += spent - sum(each.seconds for each in found)

    for k, each in enumerate(found):
        each.flags = np.where(batch.visible, each.flags, batch.visibility)
        each.flags[~searched[:, k]] = DetectionStatus.not_run
        variables.write(columns, variables.DETECTION, each, k)
        result.seconds["detection"][k] += each.seconds
        for j, setting in enumerate(experiment.estimators):
            start = time.perf_counter()
            rows = np.flatnonzero((each.flags == DetectionStatus.detected) & need[:, k, j])
            seen = detections_for(setting, batch, each, rows)
            poses = estimates_of(seen, builds[j], rows, failures, k, j)
            number = k * len(builds) + j
            for name, flag in variables.WITHOUT_DETECTION.items():
                columns[name][number, need[:, k, j]] = flag
            compared = variables.compared(poses, batch, rows)
            variables.write(columns, variables.ESTIMATION, compared, number, rows)
            result.seconds["estimation"][number] += time.perf_counter() - start
    result.failures += [
        dataclasses.replace(failure, scene=failure.scene + part.start) for failure in failures
    ]


# --------------------------------------------------------------------------------------------------
# Before a run: whether any scene can have a bound.

#: Scenes, spread over the grid, by which it is told whether any has a bound.
NOTED_SCENES = 64

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
    experiment = pipeline.experiment
    total = len(experiment.all_scenes)
    numbers = np.unique(np.linspace(0, total - 1, min(total, NOTED_SCENES)).astype(np.int64))
    batch = scenes_at(experiment, experiment.all_scenes.indices(numbers))
    asked = np.flatnonzero(batch.values["bound"].broadcast(len(numbers), np.str_) != "none")
    found = {outside_model(batch.scenes, row) for row in asked.tolist()}
    if not found or BoundStatus.given in found:
        return []
    sampled = "" if len(numbers) == total else f" ({len(numbers)} of {total:,} were looked at)"
    reasons = "; ".join(f"{flag.name}: {NO_BOUND[flag]}" for flag in sorted(found))
    return [f"warning: no pose has a bound{sampled}: {reasons}"]


# --------------------------------------------------------------------------------------------------
# Before a run: plug-ins are used once; one that cannot work refuses the run, and costs no pose.

#: Settings that are tried, of all plug-ins.
MAX_SETTINGS = 64


@single_threaded()
def try_plugins(pipeline: Pipeline) -> None:
    """Import plug-ins and make them with each of their settings; detectors search a blank frame.

    Raises
    ------
    PluginError
        If that cannot be done.
    """
    experiment = pipeline.experiment
    _ = experiment.scene_plugins
    width, height = (min(pipeline.values_of(side)) for side in ("width_px", "height_px"))
    blank = np.full((height, width), 128, dtype=np.uint8)
    searches = itertools.product(pipeline.values_of("dictionary"), (
        each for each in dict.fromkeys(experiment.detectors) if isinstance(each, PluginSetting)))
    for dictionary, setting in itertools.islice(searches, MAX_SETTINGS):
        make_detector(setting)(blank, dictionary, max(width, height))
    for solver in itertools.islice(dict.fromkeys(experiment.estimators), MAX_SETTINGS):
        build(solver)


# --------------------------------------------------------------------------------------------------
# A standard scene, computed before any block: a machine that cannot do that computes nothing.

#: Solvers whose compiled code is loaded, if the pipeline has them; else that of the first.
SOLVERS = ("ippe_square", "photometric", "photometric_real")

#: Rotation error of the standard scene; with the supported solvers it is below 0.05.
MAX_ERROR_RAD = 0.2


def warm_up(pipeline: Pipeline | None = None) -> None:
    """Load the compiled code that a pipeline needs by computing a scene of known pose with it.

    Its renderers, bounds and solvers are used, without plug-ins, but none of its scenes, which may
    end the process; a little noise, if it has effects on the image. Without a pipeline, what
    nearly all of them need.

    Raises
    ------
    MachineFaultError
        If the scene cannot be computed, or the marker's pose is not the recorded one.
    """
    scene: dict[str, Any] = {
        "title": "A standard scene", "pose": {"side_px": 60, "tilt_deg": 45},
        "camera": {"width_px": 160, "height_px": 120}}
    if pipeline is not None:
        renderers = sorted(
            name for name in set(pipeline.values_of("renderer"))
            if pipeline.plugin("renderer", name) is None
        )
        solvers = [name for name in SOLVERS if name in pipeline.values_of("solver")]
        scene["axes"] = {
            "renderer": renderers or ["exact"],
            "bound": sorted({*pipeline.values_of("bound")}),
            "solver": solvers or [SOLVERS[0]]}
        effects = any([*pipeline.values_of(each.switch)] != [each.off]
                      for each in pipeline.experiment.effects)
        scene["scene"] = {"noise_grey": float(effects)}
    standard = Pipeline.from_dict(scene)
    try:
        values = compute_block(standard.experiment, standard.experiment.all_scenes)
    except MachineFaultError:
        raise
    except Exception as error:
        raise local_fault(f"a standard scene raises {exception_line(error)}") from None
    error_rad = np.linalg.norm(values["rotation_error_rad"], axis=-1)
    if not (error_rad < MAX_ERROR_RAD).all():  # NaN without a pose
        raise local_fault("the pose of a standard scene is computed wrongly")
