"""One block of the experiment: the nested stages scene -> image -> detection -> estimate.

The paper's eleven steps (Poroykov et al., 2020) are found by name: steps 1-6 in
:func:`sweep.model.scene.build_scenes`, 7-8 in :mod:`sweep.model.renderers`, 9 in
:mod:`sweep.measure.detector` and :mod:`sweep.measure.solver`, 10 in
:mod:`sweep.measure.accuracy`; step 11 is the block. A scene is rendered once for all detector
settings, and a detection is shared by all estimators.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.measure.accuracy import pose_error, rotation_difference
from sweep.measure.bound import bounds
from sweep.measure.classify import classify
from sweep.measure.covariance import squared_deviations
from sweep.measure.detector import (
    NOISE_MARGIN_PX,
    UNEVEN_LIGHT_CONSTANT,
    Detector,
    DetectorSetting,
    Found,
    full_frame_reason,
    margin_px,
    windows,
)
from sweep.measure.estimation import Detections, Estimates, PoseEstimator
from sweep.measure.estimators import build
from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus, Flipped
from sweep.measure.solver import EstimatorSetting
from sweep.model.camera import Cameras
from sweep.model.columns import Column, map_columns
from sweep.model.derivatives import POSE
from sweep.model.extent import (
    areas_px,
    hidden,
    marker_boxes,
    not_modelled,
    outside_frame,
)
from sweep.model.lens import pack
from sweep.model.pose import vector_of_rotation
from sweep.model.renderers import Grey, render_all
from sweep.model.scene import Scenes, build_scenes
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, block_indices, detector_settings, estimators, scene_values
from sweep.plan.parameters import Stage
from sweep.plan.schema import SCHEMA, Variable
from sweep.typing import Floats


@dataclass(frozen=True, slots=True)
class Failure:
    """What became of a cell that raised, or of which the process died.

    Attributes
    ----------
    scene
        Which scene of the block.
    stage
        "scene", "detection" or "estimation".
    text
        The traceback; of a cell that ended the process, how it did.
    setting, estimator
        Which of the detector settings and estimators, where the stage has them.
    crashed
        Whether the process died.
    """

    scene: int
    stage: str
    text: str
    setting: int | None = None
    estimator: int | None = None
    crashed: bool = False


MAX_TRACEBACKS = 1000
"""Failures whose traceback is kept; of the others only the last line is."""


def _told(failures: Sequence[Failure]) -> str:
    """Return the text of the exception that is being handled."""
    text = traceback.format_exc()
    return text if len(failures) < MAX_TRACEBACKS else text.strip().rpartition("\n")[2]


@dataclass(slots=True)
class CellsResult:
    """What N scene cells gave.

    Attributes
    ----------
    columns
        Variable -> one array (N, ...) per treatment of its stage, the last axis fastest.
    seconds
        Time spent: "scene", then "detection" and "estimation" per treatment.
    row_seconds
        (N,) time spent on rendering and searching each scene.
    failures
        The exceptions that were raised; their cells are flagged ``failed``.
    """

    columns: dict[str, list[NDArray[Any]]]
    seconds: dict[str, list[float]]
    row_seconds: Floats
    failures: list[Failure] = field(default_factory=list)


@dataclass(slots=True)
class BlockResult:
    """What a block gave: variable -> array in the template's dimensions, and as above."""

    values: dict[str, NDArray[Any]]
    seconds: dict[str, list[float]]
    failures: list[Failure] = field(default_factory=list)


@dataclass(slots=True)
class SearchResult:
    """What one detector setting gave on N scenes: flags (N,), found corners (N, 4, 2) px.

    ``images`` has what was searched of each scene, where that was to be kept; its first pixel in
    the frame is in ``origins`` (N, 2).
    """

    flags: NDArray[np.uint8]
    corners: Floats
    seconds: float
    images: dict[int, Grey]
    origins: NDArray[np.int64]


def single_thread() -> None:
    """Keep OpenCV to one thread in this process: parallelism is over blocks."""
    cv2.setNumThreads(1)


def run_block(pipeline: Pipeline, block: Block) -> BlockResult:
    """Render, detect and estimate every scene of a block."""
    cells = run_cells(pipeline, block_indices(block))
    return BlockResult(
        {v.name: shaped(v, pipeline, block, cells.columns[v.name]) for v in SCHEMA},
        cells.seconds,
        cells.failures,
    )


def run_cells(
    pipeline: Pipeline,
    indices: Sequence[NDArray[np.intp]],
    need: NDArray[np.bool_] | None = None,
    search_too: NDArray[np.bool_] | None = None,
) -> CellsResult:
    """Render, detect and estimate the scenes at ``indices`` (N,) along each scene axis.

    ``need`` (N, detector settings, estimators) restricts the work to what is asked for, and
    ``search_too`` (N, detector settings) tells what is searched although nothing is estimated
    there; the rest is flagged ``not_run``.
    """
    single_thread()
    count = len(indices[0]) if indices else 1
    settings = detector_settings(pipeline)
    estimating = estimators(pipeline)
    if need is None:
        need = np.ones((count, len(settings), len(estimating)), dtype=bool)
    if search_too is None:
        search_too = np.zeros((count, len(settings)), dtype=bool)
    searched = need.any(axis=2) | search_too
    most = _most_kept(pipeline, estimating)
    if count > most:
        return joined(
            [
                run_cells(pipeline, [index[at : at + most] for index in indices],
                          need[at : at + most], search_too[at : at + most])
                for at in range(0, count, most)
            ]
        )
    failures: list[Failure] = []
    start = time.perf_counter()
    values = scene_values(pipeline, indices)
    scenes = build_scenes(values, count)
    visibility = visibility_flags(scenes)
    to_search = searched & (visibility == DetectionStatus.not_run)[:, None]
    geometry_s = time.perf_counter() - start

    builds = [build(estimator) for estimator in estimating]
    keep = any(one.needs_images for one in builds)
    searches, render_s, row_s = search(
        scenes, to_search, settings, whole_frames(values, count), failures, keep=keep
    )
    seconds: dict[str, list[float]] = {
        "scene": [geometry_s + render_s],
        "detection": [found.seconds for found in searches],
        "estimation": [],
    }
    out: dict[str, list[NDArray[Any]]] = {v.name: [] for v in SCHEMA}
    out["true_rvec"] = [vector_of_rotation(scenes.rotation)]
    out["true_tvec_m"] = [scenes.translation]
    out["marker_area_px"] = [areas_px(scenes)]
    begun = time.perf_counter()
    for name, column in _bounded(values, scenes, visibility).items():
        out[name] = [column]
    seconds["scene"][0] += time.perf_counter() - begun
    for k, found in enumerate(searches):
        flags = np.where(visibility == DetectionStatus.not_run, found.flags, visibility)
        flags[~searched[:, k]] = DetectionStatus.not_run
        out["detection"].append(flags.astype(np.uint8))
        out["corner_error_px"].append(found.corners - scenes.corners_px)
        for j, estimator in enumerate(estimating):
            rows = np.flatnonzero((flags == DetectionStatus.detected) & need[:, k, j])
            begun = time.perf_counter()
            seen = sightings(estimator, values, scenes, found, rows)
            raised = len(failures)
            estimates = _estimated(seen, builds[j], rows, failures)
            failures[raised:] = [
                dataclasses.replace(failure, setting=k, estimator=j)
                for failure in failures[raised:]
            ]
            measured = _measured(estimates, scenes, rows)
            measured["estimate"][~need[:, k, j]] = EstimateStatus.not_run
            measured["flipped"][~need[:, k, j]] = Flipped.not_run
            seconds["estimation"].append(time.perf_counter() - begun)
            for name, column in measured.items():
                out[name].append(column)
    return CellsResult(out, seconds, row_s, failures)


KEPT_PX = 1 << 26
"""Pixels of images that are kept for the estimators: 67 MB of memory, were they whole frames."""


def _most_kept(pipeline: Pipeline, estimating: Sequence[EstimatorSetting]) -> int:
    """Return how many scenes are computed at a time: fewer where their images must be kept."""
    if not any(build(estimator).needs_images for estimator in estimating):
        return sys.maxsize
    frame = max(pipeline.values_of("width_px")) * max(pipeline.values_of("height_px"))
    return int(max(KEPT_PX // frame, 1))


def joined(parts: Sequence[CellsResult]) -> CellsResult:
    """Return the results of runs of some scenes each as one."""
    starts = np.cumsum([0, *(len(part.row_seconds) for part in parts)]).tolist()

    def each(pieces: Sequence[Any], join: Callable[[Sequence[Any]], Any]) -> dict[str, list[Any]]:
        return {
            name: [join(column) for column in zip(*(piece[name] for piece in pieces), strict=True)]
            for name in pieces[0]
        }

    return CellsResult(
        each([part.columns for part in parts], np.concatenate),
        each([part.seconds for part in parts], sum),
        np.concatenate([part.row_seconds for part in parts]),
        [
            dataclasses.replace(failure, scene=failure.scene + start)
            for start, part in zip(starts, parts, strict=False) for failure in part.failures
        ],
    )


def _bounded(
    values: Mapping[str, Column], scenes: Scenes, visibility: NDArray[np.uint8]
) -> dict[str, NDArray[Any]]:
    """Return the bound's variables, for the scenes that ask for it."""
    count = len(scenes)
    out: dict[str, NDArray[Any]] = {
        "bound": np.full(count, BoundStatus.not_run, dtype=np.uint8),
        "bound_std": np.broadcast_to(np.nan, (count, POSE)),
        "bound_kappa": np.broadcast_to(np.nan, count),
        "mirror_distance": np.broadcast_to(np.nan, count),
    }
    asked = values["bound"].broadcast(count, np.str_)
    if (asked == "none").all():
        return out
    out = {name: column.copy() for name, column in out.items()}
    out["bound"][asked != "none"] = BoundStatus.not_visible
    boxes = marker_boxes(scenes)
    for unknown in ("known_blur", "unknown_blur"):
        rows = np.flatnonzero((asked == unknown) & (visibility == DetectionStatus.not_run))
        found = bounds(scenes, rows, boxes[rows], unknown == "unknown_blur")
        out["bound"][rows], out["bound_std"][rows] = found.status, found.std
        out["bound_kappa"][rows], out["mirror_distance"][rows] = found.kappa, found.mirror_distance
    return out


def whole_frames(values: Mapping[str, Column], count: int) -> NDArray[np.bool_]:
    """Return (N,) which scenes are rendered as whole frames: as asked, or on a background image."""
    whole = map_columns(
        lambda window, background: window == "full" or isinstance(background, str),
        [values["window"], values["background"]],
    )
    return whole.broadcast(count, np.bool_)


def visibility_flags(scenes: Scenes) -> NDArray[np.uint8]:
    """Return not_visible, not_modelled, or not_run for scenes (N,) that must be looked at."""
    flags = np.full(len(scenes), DetectionStatus.not_run, dtype=np.uint8)
    behind = hidden(scenes)
    flags[behind] = DetectionStatus.not_visible
    flags[not_modelled(scenes) & ~behind] = DetectionStatus.not_modelled
    open_rows = np.flatnonzero(flags == DetectionStatus.not_run)
    flags[open_rows[outside_frame(scenes, open_rows)]] = DetectionStatus.not_visible
    return flags


def search_windows(
    scenes: Scenes, boxes: NDArray[np.int64], setting: DetectorSetting, full: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return the windows (N, 4) that a setting searches: a function of scene and setting alone."""
    margin = margin_px(setting) + NOISE_MARGIN_PX * scenes.noisy[:, None].astype(np.int64)
    cut = windows(boxes, scenes.frame, margin)
    whole = full | (full_frame_reason(setting) is not None)
    whole |= setting.adaptiveThreshConstant < UNEVEN_LIGHT_CONSTANT * scenes.uneven_gain
    frame = np.concatenate([np.zeros_like(scenes.frame), scenes.frame], axis=1)
    return np.where(whole[:, None], frame, cut)


def search(
    scenes: Scenes,
    wanted: NDArray[np.bool_],
    settings: Sequence[DetectorSetting],
    full: NDArray[np.bool_],
    failures: list[Failure],
    *,
    keep: bool = False,
) -> tuple[list[SearchResult], float, Floats]:
    """Render scenes once each and search them with the settings ``wanted`` (N, settings).

    ``full`` (N,) tells which are rendered and searched as whole frames, ``keep`` whether the images
    are kept. Returns what each setting gave, the seconds spent on rendering, and the seconds spent
    on each scene (N,).
    """
    boxes = marker_boxes(scenes)
    cut = [search_windows(scenes, boxes, setting, full) for setting in settings]
    widest = np.concatenate(
        [
            np.min([window[:, :2] for window in cut], axis=0),
            np.max([window[:, 2:] for window in cut], axis=0),
        ],
        axis=1,
    )
    # Where a setting's windows are those that are rendered, nothing is cut out of them.
    crops = [
        None if (window == widest).all() else (window - np.tile(widest[:, :2], 2)).tolist()
        for window in cut
    ]
    hits = [_Hits(Detector(setting).find) for setting in settings]
    dictionary, sides = scenes.dictionary, scenes.frame.max(axis=1).tolist()
    render_s = 0.0
    row_s = [0.0] * len(scenes)
    clock = time.perf_counter
    asked = wanted.T.tolist()
    for rows in _chunks(np.flatnonzero(wanted.any(axis=1)), widest, scenes.plain):
        begun = clock()
        images = _rendered(scenes, rows, boxes, widest, failures)
        now = clock()
        render_s += now - begun
        for row in rows.tolist():
            row_s[row] = (now - begun) / len(rows)
        for k, (hit, crop, ask) in enumerate(zip(hits, crops, asked, strict=True)):
            find, note = hit.find, hit.found.append
            begun = now = clock()
            for row, image in zip(rows.tolist(), images, strict=True):
                if not ask[row]:
                    continue
                start = now
                if image is None:
                    hit.failed.append(row)
                    continue
                seen = image
                if crop is not None:
                    x0, y0, x1, y1 = crop[row]
                    seen = image[y0:y1, x0:x1]
                if keep:
                    hit.images[row] = seen
                try:
                    note((row, *find(seen, dictionary[row], sides[row])))
                except Exception:
                    failures.append(Failure(row, "detection", _told(failures), k))
                    hit.failed.append(row)
                now = clock()
                row_s[row] += now - start
            hit.seconds += now - begun

    searches = []
    marker_id = np.array(scenes.marker_id, dtype=np.int64)
    for hit, window in zip(hits, cut, strict=True):
        start = clock()
        flags, found_corners = classify(
            scenes.corners_px, marker_id, hit.found, window[:, :2].astype(np.float64)
        )
        flags[hit.failed] = DetectionStatus.failed
        searches.append(
            SearchResult(
                flags, found_corners, hit.seconds + clock() - start, hit.images, window[:, :2]
            )
        )
    return searches, render_s, np.array(row_s)


@dataclass(slots=True)
class _Hits:
    """How one setting searches, what it found so far, and the rows for which it raised."""

    find: Callable[[Grey, str, int], Found]
    found: list[tuple[int, *Found]] = field(default_factory=list)
    images: dict[int, Grey] = field(default_factory=dict)
    failed: list[int] = field(default_factory=list)
    seconds: float = 0.0


CHUNK_PX = 1 << 24
"""Pixels that are rendered, in one call, before they are searched: 17 MB of memory."""


def _chunks(
    rows: NDArray[np.intp], windows: NDArray[np.int64], plain: NDArray[np.bool_]
) -> Iterator[NDArray[np.intp]]:
    """Cut rows into runs whose windows have about ``CHUNK_PX`` pixels, at least one each.

    What is not ``plain`` (N,) is rendered alone, so that its time is its own.
    """
    if not len(rows):
        return
    size = windows[rows, 2:] - windows[rows, :2]
    number = np.cumsum(size[:, 0] * size[:, 1]) // CHUNK_PX
    alone = ~plain[rows]
    cuts = (np.diff(number) != 0) | alone[1:] | alone[:-1]
    yield from np.split(rows, np.flatnonzero(cuts) + 1)


def _rendered(
    scenes: Scenes, rows: NDArray[np.intp], boxes: NDArray[np.int64],
    windows: NDArray[np.int64], failures: list[Failure],
) -> Sequence[Grey | None]:
    """Return the images of ``rows`` in their windows; None where rendering raised."""
    try:
        return render_all(scenes, rows, boxes[rows], windows[rows])
    except Exception:
        images: list[Grey | None] = []
        for row in rows.tolist():
            one = np.array([row])
            try:
                images += render_all(scenes, one, boxes[one], windows[one])
            except Exception:
                failures.append(Failure(row, "scene", _told(failures)))
                images.append(None)
        return images


def believed(
    estimator: EstimatorSetting, values: Mapping[str, Column], scenes: Scenes
) -> tuple[Cameras, Floats]:
    """Return cameras and sizes (N,) as the estimator believes them."""
    view, size = scenes.cameras.view, scenes.size_m
    lenses, distorted = scenes.cameras.lenses, scenes.cameras.distorted

    def belief(name: str) -> Any:
        drawn = name in values and not values[name].constant
        return values[name].values if drawn else getattr(estimator, name)

    for k, name in enumerate(("fx_px", "fy_px", "cx_px", "cy_px")):
        value = belief(f"believed_{name}")
        if value is not None:
            view = view.copy() if view is scenes.cameras.view else view
            view[:, k] = value
    if belief("believed_size_m") is not None:
        size = np.array(np.broadcast_to(belief("believed_size_m"), size.shape), dtype=np.float64)
    if estimator.believed_distortion is not None:
        packed = pack(estimator.believed_distortion)
        lenses = np.repeat(packed[None], len(scenes), axis=0)
        distorted = np.full(len(scenes), bool(packed[:14].any()))
    return Cameras(view, lenses, distorted), size


def sightings(
    estimator: EstimatorSetting, values: Mapping[str, Column], scenes: Scenes, found: SearchResult,
    rows: NDArray[np.intp],
) -> Detections:
    """Return what an estimator gets of the scenes ``rows`` (n,), as it believes them."""
    cameras, size = believed(estimator, values, scenes)
    truth = {"noise_grey": 0.0, "blur_px": 0.0} if scenes.effects is None else scenes.effects
    noise, blur = (
        np.broadcast_to(truth[name] if belief is None else belief, len(scenes))
        for name, belief in (
            ("noise_grey", estimator.believed_noise_grey), ("blur_px", estimator.believed_blur_px)
        )
    )
    return Detections(
        found.corners[rows], cameras.take(rows), size[rows], noise[rows], blur[rows],
        [scenes.markers[k] for k in scenes.marker[rows]],
        [found.images[row] for row in rows.tolist()] if found.images else [],
        found.origins[rows],
    )


def _estimated(
    seen: Detections, estimator: PoseEstimator, rows: NDArray[np.intp], failures: list[Failure]
) -> Estimates:
    """Estimate poses (n,); where the batch raises, one by one, so that one costs only itself."""
    try:
        return estimator(seen)
    except Exception:
        parts = []
        for i in range(len(rows)):
            try:
                parts.append(estimator(seen.take(np.array([i]))))
            except Exception:
                failures.append(Failure(int(rows[i]), "estimation", _told(failures)))
                parts.append(Estimates.none(1, EstimateStatus.failed))
        return Estimates.joined(parts)


def _measured(
    estimates: Estimates, scenes: Scenes, rows: NDArray[np.intp]
) -> dict[str, NDArray[Any]]:
    """Return the estimation variables over all N scenes from estimates of ``rows`` (n,)."""
    count = len(scenes)
    truth = scenes.rotation[rows]
    error = pose_error(estimates.rotation, estimates.translation, truth, scenes.translation[rows])
    other = rotation_difference(estimates.alternative_rotation, truth)

    def spread(column: NDArray[Any], fill: float) -> NDArray[Any]:
        whole = np.full((count, *column.shape[1:]), fill, dtype=column.dtype)
        whole[rows] = column
        return whole

    solved = estimates.status == EstimateStatus.solved
    flipped = np.where(error.flipped, Flipped.flipped, Flipped.not_flipped)
    return {
        "estimate": spread(estimates.status, EstimateStatus.no_detection),
        "translation_error_m": spread(error.translation_m, np.nan),
        "rotation_error_rad": spread(error.rotation_rad, np.nan),
        "rotation_error_deg": spread(np.degrees(error.rotation_angle_rad), np.nan),
        "normal_error_deg": spread(np.degrees(error.normal_angle_rad), np.nan),
        "reprojection_error_px": spread(estimates.reprojection_px, np.nan),
        "alternative_rotation_error_deg": spread(
            np.degrees(np.linalg.norm(other, axis=1)), np.nan
        ),
        "alternative_reprojection_error_px": spread(
            estimates.alternative_reprojection_px, np.nan
        ),
        "predicted_std": spread(
            np.sqrt(np.diagonal(estimates.covariance, axis1=1, axis2=2)), np.nan
        ),
        "nees": spread(
            squared_deviations(error.rotation_rad, error.translation_m, estimates.covariance),
            np.nan,
        ),
        "residual_variance_ratio": spread(estimates.residual_ratio, np.nan),
        "flipped": spread(
            np.where(solved, flipped, Flipped.no_estimate).astype(np.uint8), Flipped.no_estimate
        ),
    }


def shaped(
    variable: Variable, pipeline: Pipeline, block: Block, parts: list[NDArray[Any]]
) -> NDArray[Any]:
    """Return a variable in the template's dimensions from one array (N, ...) per treatment."""
    outer = pipeline.axes_of(Stage.scene)
    treatment = variable.treatment_axes(pipeline)
    stacked = np.stack(parts, axis=1).astype(variable.dtype)
    shaped = stacked.reshape(
        (*block.shape, *(len(axis) for axis in treatment), *variable.inner_shape)
    )
    made = [axis.name for axis in itertools.chain(outer, treatment)] + list(variable.inner)
    wanted = variable.dimensions(pipeline)
    return shaped.transpose([made.index(name) for name in wanted]).copy(order="C")
