"""The cost of each configuration: of its detection, and of its estimation, a frame.

All are measured on the same images, by paired timing in one process. Frames are searched one at a
time, as a user does. Estimators solve :data:`BATCH` detections in one call, so that the overhead of
a call is that of a run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.estimation import detections_for
from sweep.evaluation.foreign_search import ForeignSearch
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import SearchResult, search, visibility_flags, whole_frames
from sweep.isolation.interrupts import Interrupts
from sweep.measure.detector import DetectorSetting
from sweep.measure.detectors import AnyDetectorSetting, FindFunction, make_detector
from sweep.measure.estimation import Detections, PoseEstimator
from sweep.measure.estimators import EstimatorSetting, build
from sweep.measure.flags import DetectionStatus
from sweep.measure.foreign_detector import ForeignDetector, ForeignSetting
from sweep.model.renderers import Grey
from sweep.model.scene import Scenes, build_scenes
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import detector_settings, estimators, scene_values
from sweep.plan.scene_plugins import scene_plugins
from sweep.tradeoff.paired_timing import LEAST_ROUNDS, time_in_turns
from sweep.tradeoff.scene_sample import Indices
from sweep.typing import Floats

BATCH = 16
"""Detections that an estimator gets in one call."""

TRIAL_SCENES = 2
"""Scenes of each condition that are timed first, to see how many the time limit allows."""


@dataclass(frozen=True, slots=True)
class Costs:
    """The costs of C conditions, D detector settings and E estimators in R rounds.

    Attributes
    ----------
    detection
        (R, C, D) seconds a frame.
    estimation
        (R, C, D, E) seconds a frame, those without a detection included.
    frames
        (C,) images that were measured.
    """

    detection: Floats
    estimation: Floats
    frames: NDArray[np.int64]

    @property
    def total(self) -> Floats:
        """(R, C, D, E) seconds a frame of detection and estimation."""
        return self.detection[..., None] + self.estimation

    @property
    def ratio(self) -> Floats:
        """(R, C, D, E) cost over the first configuration's; NaN if no scene is visible."""
        total = self.total
        with np.errstate(invalid="ignore"):
            return np.asarray(total / total[:, :, :1, :1])


@dataclass(frozen=True, slots=True)
class _Condition:
    """The scenes of a condition, ready to be measured."""

    scenes: Scenes
    values: dict[str, Any]
    searches: list[SearchResult]
    """The result of each detector setting, with the image that it searches of each scene."""


@single_threaded()
def measure(
    pipeline: Pipeline, conditions: Sequence[Sequence[Indices]], limit_s: float,
    interrupts: Interrupts, progress: Callable[[float], None] | None = None,
) -> Costs:
    """Measure detection and estimation of every configuration on the scenes of each condition.

    Parameters
    ----------
    pipeline
        The pipeline whose configurations are measured.
    conditions
        For each condition, the (n,) indices of its scenes along each scene axis.
    limit_s
        Time limit in seconds. Where it does not do for
        `sweep.tradeoff.paired_timing.LEAST_ROUNDS` rounds, fewer scenes of each condition are
        measured.
    interrupts
        Checked between two measurements.
    progress
        Called after each round with the share of the time limit that is used.
    """
    started = time.perf_counter()
    settings, estimating = detector_settings(pipeline), estimators(pipeline)
    configurations = _Configurations(
        [make_detector(setting) for setting in settings], estimating,
        [build(estimator) for estimator in estimating],
    )

    def prepared_with(most: int) -> list[_Condition]:
        chosen = []
        for indices in conditions:
            interrupts.check()
            chosen.append(_prepare(pipeline, indices, most))
        return chosen

    prepared = prepared_with(TRIAL_SCENES)
    search_s, estimation_s = configurations.round_s(prepared, interrupts)
    left_s = limit_s - (time.perf_counter() - started) - (1 + LEAST_ROUNDS) * estimation_s
    # Beside the rounds, each scene is rendered and searched once.
    most = max(int(TRIAL_SCENES * left_s / ((3 + LEAST_ROUNDS) * search_s)), 1)
    if any(len(condition.scenes) == TRIAL_SCENES for condition in prepared) or most == 1:
        prepared = prepared_with(most)
    parts, detected_share = configurations.parts(prepared)
    shape = (len(prepared), len(settings), len(estimating))
    frames = np.array([len(condition.scenes) for condition in prepared])
    visible = np.array([len(condition.searches[0].images) > 0 for condition in prepared])

    def costs(seconds: Floats) -> Costs:
        each = seconds.reshape(-1, *shape[:2], 1 + shape[2])
        # A condition without a visible scene has no costs.
        count = np.where(visible, frames, np.nan)[:, None]
        estimation = each[..., 1:] / BATCH * detected_share[..., None]
        return Costs(
            each[..., 0] / count, np.where(visible[:, None, None], estimation, np.nan),
            np.where(visible, frames, 0),
        )

    def ratios(seconds: Floats) -> Floats:
        return costs(seconds).ratio

    left_s = max(limit_s - (time.perf_counter() - started), 0.1)
    return costs(time_in_turns(parts, ratios, left_s, interrupts, progress, clock_of(settings)))


def clock_of(settings: Sequence[AnyDetectorSetting]) -> Callable[[], float]:
    """Return the clock that counts all that detectors do.

    OpenCV's own works in this thread, plug-ins may have threads of their own, and the detector of
    another environment is another process.
    """
    if all(isinstance(setting, DetectorSetting) for setting in settings):
        return time.thread_time
    foreign = any(isinstance(setting, ForeignSetting) for setting in settings)
    return time.perf_counter if foreign else time.process_time


@dataclass(frozen=True, slots=True)
class _Configurations:
    """The detector settings and the estimators, ready to be timed."""

    finders: Sequence[FindFunction]
    settings: Sequence[EstimatorSetting]
    estimators: Sequence[PoseEstimator]

    def parts(
        self, conditions: Sequence[_Condition]
    ) -> tuple[list[Callable[[], Any]], Floats]:
        """Return what is timed, and the (C, D) share of scenes with a detection.

        For each condition and detector setting: the search of all scenes, then each estimator.
        """
        parts: list[Callable[[], Any]] = []
        detected_share = np.zeros((len(conditions), len(self.finders)))
        for c, condition in enumerate(conditions):
            sides = condition.scenes.frame.max(axis=1).tolist()
            for d, find in enumerate(self.finders):
                images = condition.searches[d].images
                parts.append(partial(_search_all, find, images, condition.scenes, sides))
                rows = np.flatnonzero(condition.searches[d].flags == DetectionStatus.detected)
                detected_share[c, d] = len(rows) / len(condition.scenes)
                for setting, estimate in zip(self.settings, self.estimators, strict=True):
                    detections = detections_for(
                        setting, condition.values, condition.scenes, condition.searches[d],
                        np.resize(rows, BATCH if len(rows) else 0),
                    )
                    parts.append(partial(_estimate_all, estimate, detections))
        return parts, detected_share

    def round_s(
        self, conditions: Sequence[_Condition], interrupts: Interrupts
    ) -> tuple[float, float]:
        """Return the seconds of all searches, and of all estimates; code is compiled before."""
        parts, _ = self.parts(conditions)
        spent = [0.0, 0.0]
        for number, part in enumerate(parts):
            interrupts.check()
            kind = int(number % (1 + len(self.estimators)) > 0)
            if kind:
                part()
            begun = time.perf_counter()
            part()
            spent[kind] += time.perf_counter() - begun
        return max(spent[0], 1e-6), spent[1]


def _search_all(
    find: FindFunction, images: Mapping[int, Grey], scenes: Scenes,
    sides: Sequence[int],
) -> None:
    if isinstance(find, ForeignDetector):
        # One at a time there, and together on the way, which is little of the cost then.
        foreign = ForeignSearch(
            find, 0, scenes.dictionary, sides, [0.0] * len(scenes), [], [], [], []
        )
        for row, image in images.items():
            foreign.add(row, image)
        foreign.search()
        return
    for row, image in images.items():
        # If it raises, the run has flagged the pose; the attempt has a cost as well.
        with suppress(Exception):
            find(image, scenes.dictionary[row], sides[row])


def _estimate_all(estimator: PoseEstimator, detections: Detections) -> None:
    with suppress(Exception):
        if len(detections.corners):
            estimator(detections)


def _prepare(pipeline: Pipeline, indices: Sequence[Indices], most: int) -> _Condition:
    """Render a condition's visible scenes, and search each once with each setting.

    Of more than ``most`` scenes, so many are taken from all over the sample.
    """
    count = len(indices[0]) if indices else 1
    values = scene_values(pipeline, indices)
    scenes = build_scenes(values, count, scene_plugins(pipeline))
    rows = np.flatnonzero(visibility_flags(scenes) == DetectionStatus.not_run)
    if 0 < len(rows) < count:
        return _prepare(pipeline, [index[rows] for index in indices], most)
    if count > most:
        chosen = (2 * np.arange(most) + 1) * count // (2 * most)
        return _prepare(pipeline, [index[chosen] for index in indices], most)
    settings = detector_settings(pipeline)
    wanted = np.full((count, len(settings)), len(rows) > 0)
    full = whole_frames(values, count)
    searches, _, _ = search(scenes, wanted, settings, full, [], keep=True)
    return _Condition(scenes, values, searches)
