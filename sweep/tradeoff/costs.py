"""Costs of configurations and renderers, timed in pairs on a sample of scenes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from sweep.evaluation import search
from sweep.evaluation.block import detections_for
from sweep.evaluation.opencv_threads import single_threaded
from sweep.experiment.grid import TRIAL
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Interrupts
from sweep.measure.detectors import AnyDetectorSetting, DetectorSetting, full_frame_reason
from sweep.measure.estimation import Detections, PoseEstimator
from sweep.measure.estimators import EstimatorSetting, build
from sweep.measure.flags import DetectionStatus
from sweep.measure.sources import DetectionSource
from sweep.model.renderers import render_all
from sweep.typing import Floats, Grey

# --------------------------------------------------------------------------------------------------
# Paired timing: parts are timed in turns, in random order, until their ratios are known.
#
# Each round times every part once, in a new order, so that changes of the machine (clock, cache,
# neighbours) affect all of them. The ratio of two parts is the median over rounds, with the
# interval of order statistics. Another process, with another layout of its memory, gives ratios
# that differ by a little more than the rounds of one process show: :data:`PROCESS_SHARE` is added
# to the intervals on both sides.

#: Difference of ratios between processes: standard deviations of 0.3 to 1.5 % were measured.
PROCESS_SHARE = 0.025

MIN_ROUNDS, MAX_ROUNDS = 12, 2000

#: Rounds where the time limit does not allow more: the fewest with a 95 % interval of a median.
LEAST_ROUNDS = 6

#: Width of a ratio's 95 % interval, as a share of it, that is narrow enough.
NARROW = 0.03


def time_in_turns(
    parts: Sequence[Callable[[], Any]], ratios: Callable[[Floats], Floats], limit_s: float,
    interrupts: Interrupts, progress: Callable[[float], None] | None = None,
    clock: Callable[[], float] | None = None,
) -> Floats:
    """Time P parts in R rounds, each round in a random order of its own.

    Parameters
    ----------
    parts
        Functions without arguments.
    ratios
        (R, P) seconds -> (R, ...) ratios; rounds end once the interval of each ratio's median is
        narrower than :data:`NARROW`, or the ratio is NaN.
    limit_s
        Time limit in seconds; :data:`LEAST_ROUNDS` rounds are measured in any case.
    interrupts
        Checked between two parts.
    progress
        Called after each round with the share of the time limit that is used.
    clock
        Returns the seconds that are counted (default: this thread's own time).

    Returns
    -------
    (R, P) seconds of the clock, without the first round, which warms up.
    """
    clock = clock or time.thread_time
    generator = np.random.Generator(np.random.PCG64(0))
    rounds = np.zeros((MAX_ROUNDS, len(parts)))
    started = time.perf_counter()
    for count in range(MAX_ROUNDS):
        for part in generator.permutation(len(parts)):
            interrupts.check()
            begun = clock()
            parts[part]()
            rounds[count, part] = clock() - begun
        used_s = time.perf_counter() - started
        if progress is not None:
            progress(min(used_s / limit_s, 1.0))
        if count >= LEAST_ROUNDS and used_s + used_s / (count + 1) > limit_s:
            break
        if count >= MIN_ROUNDS:
            value, low, high = median_interval(ratios(rounds[1 : count + 1]))
            if not (high - low > NARROW * value).any():
                break
    return rounds[1 : count + 1]


def median_interval(values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the median of (R, ...) values along the first axis, and its 95 % interval.

    The interval ends at the order statistics that cover the median with a probability of at least
    95 % (David and Nagaraja, "Order Statistics", 3rd edition, section 7.1).

    Returns
    -------
    Median, low and high end, each (...).
    """
    ordered = np.sort(values, axis=0)
    count = len(ordered)
    lowest = int(stats.binom.ppf(0.025, count, 0.5))
    lowest = min(max(lowest - 1, 0), count - 1)
    return np.median(ordered, axis=0), ordered[lowest], ordered[count - 1 - lowest]


def any_process_interval(ratio: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the median ratio of (R, ...) rounds, and the interval over processes.

    The interval of the baseline, whose ratio is 1 in each round, stays [1, 1].
    """
    value, low, high = median_interval(ratio)
    spare = np.where(high > low, PROCESS_SHARE * value, 0.0)
    return value, low - spare, high + spare


# --------------------------------------------------------------------------------------------------
# The scenes on which costs are measured: a seeded sample of each condition.

Indices = NDArray[np.intp]

#: Scenes of each condition: fewer if whole frames are searched.
MIN_SCENES, MAX_SCENES = 12, 48

#: Pixels of images that are kept, over all conditions: 134 MB.
MAX_PX = 1 << 27


def whole_frames_of(pipeline: Pipeline) -> list[bool]:
    """Return whether whole frames are searched, for each detector setting."""
    whole = pipeline.any_value("window", lambda value: value == "full")
    whole |= pipeline.any_value("background", lambda value: isinstance(value, str))
    return [
        whole or full_frame_reason(setting) is not None for setting in pipeline.experiment.detectors
    ]


def sample_scenes(
    pipeline: Pipeline, fixed: Mapping[str, int], conditions: int
) -> list[Indices]:
    """Return a seeded sample of the scenes of a condition: (n,) indices along each scene axis.

    The cells of the axes that are not fixed have equal shares, or are drawn if they are more than
    the sample has scenes; trials are drawn.

    Parameters
    ----------
    pipeline
        Its grid is sampled; its frames decide how many scenes fit into memory.
    fixed
        Scene axis -> the index along it that makes the condition.
    conditions
        Number of conditions. The size of the sample follows from it and the pipeline alone, so that
        the same scenes are measured each time.
    """
    generator = np.random.Generator(np.random.PCG64(0))
    frame = max(pipeline.values_of("width_px")) * max(pipeline.values_of("height_px"))
    count = MIN_SCENES if any(whole_frames_of(pipeline)) else MAX_SCENES
    count = int(min(max(MAX_PX // (frame * conditions), 1), count))
    axes = pipeline.experiment.scene_axes
    lengths = [
        1 if axis.name in fixed or axis.name == TRIAL else len(axis) for axis in axes
    ]
    cells = math.prod(lengths)
    numbers = (
        np.arange(count) * cells // count if cells <= count
        else generator.integers(0, cells, count)
    )
    indices = []
    for axis, index in zip(axes, np.unravel_index(numbers, lengths) if axes else (), strict=True):
        if axis.name in fixed:
            index = np.full(count, fixed[axis.name])  # noqa: PLW2901
        elif axis.name == TRIAL:
            index = generator.integers(0, len(axis), count)  # noqa: PLW2901
        indices.append(index.astype(np.intp))
    return indices


# --------------------------------------------------------------------------------------------------
# The cost of each configuration: of its detection, and of its estimation, a frame.
#
# All are measured on the same images, by paired timing in one process. Frames are searched one at
# a time, as a user does. Estimators solve :data:`BATCH` detections in one call, so that the
# overhead of a call is a run's.

#: Detections that an estimator gets in one call.
BATCH = 16

#: Scenes of each condition that are timed first, to see how many the time limit allows.
TRIAL_SCENES = 2


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
        (C,) images that were measured, NaN if no scene is visible.
    """

    detection: Floats
    estimation: Floats
    frames: Floats

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
        `sweep.tradeoff.costs.LEAST_ROUNDS` rounds, fewer scenes of each condition are
        measured.
    interrupts
        Checked between two measurements.
    progress
        Called after each round with the share of the time limit that is used.
    """
    started = time.perf_counter()
    settings = pipeline.experiment.detectors
    estimators = [(setting, build(setting)) for setting in pipeline.experiment.estimators]
    shape = (len(conditions), len(settings), 1 + len(estimators))
    # How long a round takes, of few scenes: estimates once more, their code is compiled before.
    parts, frames, detected_share = _prepared(
        pipeline, conditions, estimators, TRIAL_SCENES, interrupts)
    spent = np.zeros(len(parts))
    for number, part in enumerate(parts):
        for _ in range(2 if number % shape[2] else 1):
            interrupts.check()
            begun = time.perf_counter()
            part()
            spent[number] = time.perf_counter() - begun
    search_s = max(spent[:: shape[2]].sum(), 1e-6)
    estimation_s = spent.sum() - spent[:: shape[2]].sum()
    left_s = limit_s - (time.perf_counter() - started) - (1 + LEAST_ROUNDS) * estimation_s
    # Beside the rounds, each scene is rendered and searched once.
    most = max(int(TRIAL_SCENES * left_s / ((3 + LEAST_ROUNDS) * search_s)), 1)
    parts, frames, detected_share = _prepared(pipeline, conditions, estimators, most, interrupts)

    def costs(seconds: Floats) -> Costs:
        each = seconds.reshape(-1, *shape)
        share = np.where(np.isnan(frames)[:, None], np.nan, detected_share)[..., None]
        return Costs(each[..., 0] / frames[:, None], each[..., 1:] / BATCH * share, frames)

    left_s = max(limit_s - (time.perf_counter() - started), 0.1)
    return costs(time_in_turns(
        parts, lambda seconds: costs(seconds).ratio, left_s, interrupts, progress,
        clock_of(settings)))


def clock_of(settings: Sequence[AnyDetectorSetting]) -> Callable[[], float]:
    """Return the clock that counts all that detectors do.

    OpenCV's own works in this thread, plug-ins may have threads of their own.
    """
    of_opencv = all(isinstance(setting, DetectorSetting) for setting in settings)
    return time.thread_time if of_opencv else time.process_time


def _prepared(
    pipeline: Pipeline, conditions: Sequence[Sequence[Indices]],
    estimators: Sequence[tuple[EstimatorSetting, PoseEstimator]], most: int,
    interrupts: Interrupts,
) -> tuple[list[Callable[[], Any]], Floats, Floats]:
    """Return the timed calls: the search of all scenes of a condition, then each estimator.

    With it, of C conditions and D detector settings, (C,) frames, at most ``most``, NaN if no
    scene is visible, and the (C, D) share of them with a detection.
    """
    parts: list[Callable[[], Any]] = []
    frames, detected_share = [], []
    for indices in conditions:
        interrupts.check()
        batch, searches = _searched(pipeline, indices, most)
        count = len(batch.scenes)
        frames.append(count if len(searches[0].images) else np.nan)
        for source, found in zip(search.detection_sources(batch), searches, strict=True):
            rows = np.flatnonzero(found.flags == DetectionStatus.detected)
            detected_share.append(len(rows) / count)
            rows = np.resize(rows, BATCH if len(rows) else 0)
            parts.append(partial(_search_all, source, found.images))
            parts += [partial(_estimate_all, estimate, detections_for(setting, batch, found, rows))
                      for setting, estimate in estimators]
    return parts, np.array(frames), np.reshape(detected_share, (len(conditions), -1))


def _search_all(source: DetectionSource, images: Mapping[int, Grey]) -> None:
    for row, image in images.items():
        # If it raises, the run has flagged the pose; the attempt has a cost as well. A view is
        # another object: the source remembers what it found in the image that it saw last.
        with suppress(Exception):
            source(row, image[:])


def _estimate_all(estimator: PoseEstimator, detections: Detections) -> None:
    with suppress(Exception):
        if len(detections.corners):
            estimator(detections)


def _searched(
    pipeline: Pipeline, indices: Sequence[Indices], most: int
) -> tuple[search.SceneBatch, list[search.SearchResult]]:
    """Render a condition's visible scenes, and search each once with each setting.

    Of more than ``most`` scenes, so many are taken from all over the sample.
    """
    batch = search.scenes_at(pipeline.experiment, indices)
    visible = np.flatnonzero(batch.visible)
    rows = visible if len(visible) else np.arange(len(batch.scenes))
    if len(rows) > most:
        rows = rows[(2 * np.arange(most) + 1) * len(rows) // (2 * most)]
    if len(rows) < len(batch.scenes):
        batch = search.scenes_at(pipeline.experiment, [index[rows] for index in indices])
    wanted = np.full((len(rows), len(pipeline.experiment.detectors)), len(visible) > 0)
    return batch, search.detections_of(batch, wanted, [], keep=True)


# --------------------------------------------------------------------------------------------------
# The cost of each renderer, and how far its images differ from a reference's.

@single_threaded()
def measure_renderers(
    pipeline: Pipeline, samples: Sequence[Sequence[Indices]], reference: int, limit_s: float,
    interrupts: Interrupts,
) -> tuple[Floats, Floats, Floats]:
    """Measure K renderers on the same scenes.

    Parameters
    ----------
    pipeline
        A pipeline whose renderer is an axis.
    samples
        For each renderer, (n,) indices along each scene axis; equal apart from the renderer's.
    reference
        Number of the renderer with which the others are compared.
    limit_s
        Time limit in seconds.
    interrupts
        Checked between two measurements.

    Returns
    -------
    (R, K) seconds an image in R rounds; (K,) RMS and (K,) largest difference from the reference's
    images, in grey levels, over the pixels that the marker covers there. NaN if no scene is
    visible.
    """
    batches = [search.scenes_at(pipeline.experiment, indices) for indices in samples]
    rows = np.flatnonzero(batches[reference].visible)
    if not len(rows):
        unknown = np.full(len(batches), np.nan)
        return unknown[None], unknown, unknown
    boxes = [batch.boxes[rows] for batch in batches]
    windows = np.concatenate(
        [np.min([box[:, :2] for box in boxes], axis=0),
         np.max([box[:, 2:] for box in boxes], axis=0)], axis=1)
    parts = [partial(render_all, batch.scenes, rows, box, windows)
             for batch, box in zip(batches, boxes, strict=True)]
    images = [part() for part in parts]
    inner = (boxes[reference] - np.tile(windows[:, :2], 2)).tolist()
    differences = [np.concatenate([
        (image.astype(np.float64) - true)[top:bottom, left:right].ravel()
        for image, true, (left, top, right, bottom) in zip(
            of_one, images[reference], inner, strict=True)]) for of_one in images]
    seconds = time_in_turns(
        parts, lambda spent: np.asarray(spent / spent[:, [reference]]), limit_s, interrupts)
    return (seconds / len(rows), np.sqrt([np.mean(each**2) for each in differences]),
            np.array([np.abs(each).max() for each in differences]))
