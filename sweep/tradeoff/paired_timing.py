"""What each treatment costs, measured on the same images, in turns, in this one process.

Each round measures every treatment once, in a new order; what the machine does meanwhile (clock,
cache, neighbours) it does to all of them. A treatment's ratio to the baseline is the median over
rounds, with the order statistics' interval; rounds go on until all of these are narrow. Another
process, with its memory laid out otherwise, gives ratios that are off by a little more than the
rounds of one can tell: :data:`PROCESS_SHARE` is added to their intervals on both sides.

Frames are searched one at a time, as a user does. Estimators solve :data:`BATCH` sightings in one
call, so that their calls' own cost is that of a run.
"""

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

from sweep.evaluation.estimation import detections_for
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import SearchResult, search, visibility_flags, whole_frames
from sweep.isolation.interrupts import Interrupts
from sweep.measure.detector import Detector, Found, full_frame_reason
from sweep.measure.estimation import Detections, PoseEstimator
from sweep.measure.estimators import build
from sweep.measure.flags import DetectionStatus
from sweep.model.extent import marker_boxes
from sweep.model.renderers import Grey, render_all
from sweep.model.scene import Scenes, build_scenes
from sweep.plan.axes import TRIAL
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import detector_settings, estimators, scene_axes, scene_values
from sweep.typing import Floats

MIN_SCENES, MAX_SCENES = 12, 48
"""Scenes whose costs are measured in each regime: fewer where whole frames are searched."""

BATCH = 16
"""Sightings that an estimator gets in one call."""

PROCESS_SHARE = 0.025
"""By how much ratios differ between processes: standard deviations of 0.3 to 1.5 % were seen."""

MAX_PX = 1 << 27
"""Pixels of images that are kept, over all regimes: 134 MB."""

MIN_ROUNDS, MAX_ROUNDS = 12, 2000
NARROW = 0.03
"""Width of a ratio's 95 % interval, as a share of it, that is narrow enough."""


@dataclass(frozen=True, slots=True)
class Costs:
    """Seconds a frame of R rounds: ``detection`` (R, G, D) and ``estimation`` (R, G, D, E).

    G regimes, D detector settings, E estimators. ``frames`` (G,) are the images of each regime.
    """

    detection: Floats
    estimation: Floats
    frames: NDArray[np.int64]

    @property
    def total(self) -> Floats:
        """Seconds a frame of detection and estimation, (R, G, D, E)."""
        return self.detection[..., None] + self.estimation

    @property
    def ratio(self) -> Floats:
        """Cost over that of the first treatment, (R, G, D, E); NaN where nothing was to be seen."""
        total = self.total
        with np.errstate(invalid="ignore"):
            return np.asarray(total / total[:, :, :1, :1])


@dataclass(frozen=True, slots=True)
class _Regime:
    """The scenes of a regime, ready to be measured."""

    scenes: Scenes
    values: dict[str, Any]
    found: list[SearchResult]
    """What each detector setting finds, with what it searches of each scene."""


@single_threaded()
def measure(
    pipeline: Pipeline, regimes: Sequence[Sequence[NDArray[np.intp]]], limit_s: float,
    interrupts: Interrupts,
) -> Costs:
    """Measure detection and estimation of every treatment on the scenes of each regime.

    ``regimes`` holds indices (n,) along each scene axis for each. At most ``limit_s`` seconds
    beside preparation, but at least :data:`MIN_ROUNDS` rounds.
    """
    settings, estimating = detector_settings(pipeline), estimators(pipeline)
    prepared = []
    for indices in regimes:
        interrupts.check()
        prepared.append(_prepare(pipeline, indices))
    finders = [Detector(setting).find for setting in settings]
    builds = [build(estimator) for estimator in estimating]
    shape = (len(prepared), len(settings), len(builds))
    parts: list[Callable[[], Any]] = []
    found_share = np.zeros(shape[:2])
    for g, regime in enumerate(prepared):
        sides = regime.scenes.frame.max(axis=1).tolist()
        for d, find in enumerate(finders):
            parts.append(partial(_search_all, find, regime.found[d].images, regime.scenes, sides))
            rows = np.flatnonzero(regime.found[d].flags == DetectionStatus.detected)
            found_share[g, d] = len(rows) / len(regime.scenes)
            for estimator, one in zip(estimating, builds, strict=True):
                seen = detections_for(
                    estimator, regime.values, regime.scenes, regime.found[d],
                    np.resize(rows, BATCH if len(rows) else 0),
                )
                parts.append(partial(_estimate_all, one, seen))
    frames = np.array([len(regime.scenes) for regime in prepared])
    visible = np.array([len(regime.found[0].images) > 0 for regime in prepared])

    def costs(seconds: Floats) -> Costs:
        each = seconds.reshape(-1, *shape[:2], 1 + shape[2])
        # Where nothing is to be seen nothing costs anything.
        shown = np.where(visible, frames, np.nan)[:, None]
        estimation = each[..., 1:] / BATCH * found_share[..., None]
        return Costs(
            each[..., 0] / shown, np.where(visible[:, None, None], estimation, np.nan),
            np.where(visible, frames, 0),
        )

    def ratios(seconds: Floats) -> Floats:
        return costs(seconds).ratio

    return costs(in_turns(parts, ratios, limit_s, interrupts))


def _search_all(
    find: Callable[[Grey, str, int], Found], images: Mapping[int, Grey], scenes: Scenes,
    sides: Sequence[int],
) -> None:
    for row, image in images.items():
        # Where it raises, the run has flagged the pose; the attempt costs all the same.
        with suppress(Exception):
            find(image, scenes.dictionary[row], sides[row])


def _estimate_all(estimator: PoseEstimator, seen: Detections) -> None:
    with suppress(Exception):
        if len(seen.corners):
            estimator(seen)


def in_turns(
    parts: Sequence[Callable[[], Any]], ratios: Callable[[Floats], Floats], limit_s: float,
    interrupts: Interrupts,
) -> Floats:
    """Return the seconds (R, P) that P parts took in R rounds, each in a random order of its own.

    It ends when the medians of ``ratios``, of (R, P) to (R, ...), are known to :data:`NARROW`, or
    after ``limit_s`` seconds. Time is this thread's own. Ctrl-C is raised between two parts.
    """
    generator = np.random.Generator(np.random.PCG64(0))
    clock = time.thread_time
    rounds = np.zeros((MAX_ROUNDS, len(parts)))
    started = time.perf_counter()
    # The first round warms up.
    for count in range(MAX_ROUNDS):
        for place in generator.permutation(len(parts)):
            interrupts.check()
            begun = clock()
            parts[place]()
            rounds[count, place] = clock() - begun
        if count >= MIN_ROUNDS:
            value, low, high = median_interval(ratios(rounds[1 : count + 1]))
            late = time.perf_counter() - started > limit_s
            if late or not (high - low > NARROW * value).any():
                break
    return rounds[1 : count + 1]


def _prepare(pipeline: Pipeline, indices: Sequence[NDArray[np.intp]]) -> _Regime:
    """Render a regime's visible scenes, and search each once with each setting."""
    count = len(indices[0]) if indices else 1
    values = scene_values(pipeline, indices)
    scenes = build_scenes(values, count)
    rows = np.flatnonzero(visibility_flags(scenes) == DetectionStatus.not_run)
    if 0 < len(rows) < count:
        return _prepare(pipeline, [index[rows] for index in indices])
    settings = detector_settings(pipeline)
    wanted = np.full((count, len(settings)), len(rows) > 0)
    found, _, _ = search(scenes, wanted, settings, whole_frames(values, count), [], keep=True)
    return _Regime(scenes, values, found)


@single_threaded()
def measure_renderers(
    pipeline: Pipeline, samples: Sequence[Sequence[NDArray[np.intp]]], reference: int,
    limit_s: float, interrupts: Interrupts,
) -> tuple[Floats, tuple[Floats, Floats]]:
    """Measure K renderers on the same scenes.

    ``samples`` holds indices (n,) along each scene axis for each, equal but for the renderer's.
    Returns seconds an image (R, K), and the RMS (K,) and the largest (K,) difference in grey levels
    from the images of the ``reference``, over the pixels that the marker touches there.
    """
    count = len(samples[0][0])
    scenes = [build_scenes(scene_values(pipeline, indices), count) for indices in samples]
    rows = np.flatnonzero(visibility_flags(scenes[reference]) == DetectionStatus.not_run)
    boxes = [marker_boxes(one)[rows] for one in scenes]
    windows = np.concatenate(
        [np.min([box[:, :2] for box in boxes], axis=0),
         np.max([box[:, 2:] for box in boxes], axis=0)],
        axis=1,
    )
    if not len(rows):
        return np.full((1, len(scenes)), np.nan), (np.full(len(scenes), np.nan),) * 2
    images = [
        render_all(one, rows, box, windows) for one, box in zip(scenes, boxes, strict=True)
    ]
    rms, largest = np.zeros(len(scenes)), np.zeros(len(scenes))
    inner = boxes[reference] - np.tile(windows[:, :2], 2)
    for k in range(len(scenes)):
        differences = [
            (image.astype(np.float64) - true)[top:bottom, left:right].ravel()
            for image, true, (left, top, right, bottom) in zip(
                images[k], images[reference], inner.tolist(), strict=True
            )
        ]
        every = np.concatenate(differences)
        rms[k], largest[k] = np.sqrt(np.mean(every**2)), np.abs(every).max()
    parts = [
        partial(render_all, one, rows, box, windows)
        for one, box in zip(scenes, boxes, strict=True)
    ]
    seconds = in_turns(
        parts, lambda spent: np.asarray(spent / spent[:, reference : reference + 1]), limit_s,
        interrupts,
    )
    return seconds / len(rows), (rms, largest)


def median_interval(values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the median of (R, ...) along the first axis, and its 95 % interval.

    The order statistics that hold it with a probability of at least 95 % (David and Nagaraja,
    "Order statistics", 3rd edition, section 7.1).
    """
    ordered = np.sort(values, axis=0)
    count = len(ordered)
    lowest = int(stats.binom.ppf(0.025, count, 0.5))
    lowest = min(max(lowest - 1, 0), count - 1)
    return np.median(ordered, axis=0), ordered[lowest], ordered[count - 1 - lowest]


def whole_frames_of(pipeline: Pipeline) -> list[bool]:
    """Return whether whole frames are searched, for each detector setting."""
    whole = pipeline.any_value("window", lambda value: value == "full")
    whole |= pipeline.any_value("background", lambda value: isinstance(value, str))
    return [
        whole or full_frame_reason(setting) is not None for setting in detector_settings(pipeline)
    ]


def sample_cells(
    pipeline: Pipeline, fixed: dict[str, int], regimes: int
) -> list[NDArray[np.intp]]:
    """Return indices (n,) along each scene axis: a seeded sample of the scenes of a regime.

    ``fixed`` has the indices of the axes that make the regime. The cells of the other axes come in
    equal shares, or at random where they are more than there is room for; trials are random. How
    many scenes there are follows from the pipeline and the number of ``regimes`` alone, so that
    the same are measured each time.
    """
    generator = np.random.Generator(np.random.PCG64(0))
    frame = max(pipeline.values_of("width_px")) * max(pipeline.values_of("height_px"))
    count = MIN_SCENES if any(whole_frames_of(pipeline)) else MAX_SCENES
    count = int(min(max(MAX_PX // (frame * regimes), 1), count))
    axes = scene_axes(pipeline)
    lengths = [
        1 if axis.name in fixed or axis.name == TRIAL else len(axis) for axis in axes
    ]
    cells = math.prod(lengths)
    numbers = (
        np.arange(count) * cells // count if cells <= count
        else generator.integers(0, cells, count)
    )
    indices = []
    for axis, length in zip(reversed(axes), reversed(lengths), strict=True):
        numbers, index = numbers // length, numbers % length
        if axis.name in fixed:
            index = np.full(count, fixed[axis.name])
        elif axis.name == TRIAL:
            index = generator.integers(0, len(axis), count)
        indices.append(index.astype(np.intp))
    return indices[::-1]
