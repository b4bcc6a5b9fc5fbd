"""What each treatment costs, measured on the same images, in turns, in this one process.

Each round measures every treatment once, in a new order; what the machine does meanwhile (clock,
cache, neighbours) it does to all of them. A treatment's ratio to the baseline is the median over
rounds, with the order statistics' interval; rounds go on until all of these are narrow.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from sweep.kernel import (
    Search,
    search,
    search_windows,
    sightings,
    single_thread,
    visibility_flags,
    whole_frames,
)
from sweep.measure.detector import Detector, Found
from sweep.measure.estimators import build
from sweep.measure.flags import Detection
from sweep.model.extent import marker_boxes
from sweep.model.renderers import Grey, render_all
from sweep.model.scene import Scenes, build_scenes
from sweep.plan.grid import detector_settings, estimators, scene_axes, scene_values
from sweep.plan.pipeline import Pipeline

Floats = NDArray[np.float64]

FEWEST_SCENES, MOST_SCENES = 6, 48
"""Scenes whose costs are measured in each regime: fewer where they are slow."""

ROUNDS_IN_TIME = 60
"""Rounds of searching that the time limit is to hold."""

MOST_PX = 1 << 27
"""Pixels of images that are kept, over all regimes: 134 MB."""

FEWEST_ROUNDS, MOST_ROUNDS = 12, 2000
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
    images: list[list[Grey]]
    """What each detector setting searches of each scene."""
    found: list[Search]
    """What each detector setting finds."""


def measure(
    pipeline: Pipeline, regimes: Sequence[Sequence[NDArray[np.intp]]], limit_s: float
) -> Costs:
    """Measure detection and estimation of every treatment on the scenes of each regime.

    ``regimes`` holds indices (n,) along each scene axis for each. At most ``limit_s`` seconds
    beside preparation, but at least :data:`FEWEST_ROUNDS` rounds.
    """
    single_thread()
    settings, estimating = detector_settings(pipeline), estimators(pipeline)
    prepared = [_prepare(pipeline, indices) for indices in regimes]
    searched_s = sum(found.seconds for regime in prepared for found in regime.found)
    share = limit_s / (ROUNDS_IN_TIME * max(searched_s, 1e-9))
    if share < 1.0:
        # Few frames and many rounds tell more than many frames and few rounds.
        fewer = [
            [index[: max(math.ceil(share * len(index)), FEWEST_SCENES)] for index in indices]
            for indices in regimes
        ]
        prepared = [_prepare(pipeline, indices) for indices in fewer]
    finders = [Detector(setting).find for setting in settings]
    builds = [build(estimator) for estimator in estimating]
    seen = [
        [
            [
                sightings(
                    estimator, regime.values, regime.scenes, found,
                    np.flatnonzero(found.flags == Detection.detected),
                )
                for estimator in estimating
            ]
            for found in regime.found
        ]
        for regime in prepared
    ]
    shape = (len(prepared), len(settings), len(builds))
    parts: list[Callable[[], Any]] = []
    for g, regime in enumerate(prepared):
        sides = regime.scenes.frame.max(axis=1).tolist()
        for d, find in enumerate(finders):
            parts.append(partial(_search_all, find, regime.images[d], regime.scenes, sides))
            parts += [
                partial(one, seen[g][d][e]) if len(seen[g][d][e].corners) else _nothing
                for e, one in enumerate(builds)
            ]
    frames = np.array([len(regime.scenes) for regime in prepared])

    def costs(seconds: Floats) -> Costs:
        each = seconds.reshape(-1, *shape[:2], 1 + shape[2]) / frames[:, None, None]
        return Costs(each[..., 0], each[..., 1:], frames)

    def ratios(seconds: Floats) -> Floats:
        return costs(seconds).ratio

    return costs(in_turns(parts, ratios, limit_s))


def _search_all(
    find: Callable[[Grey, str, int], Found], images: Sequence[Grey], scenes: Scenes,
    sides: Sequence[int],
) -> None:
    # A regime without a visible scene has no images.
    for image, name, side in zip(images, scenes.dictionary, sides, strict=False):
        find(image, name, side)


def _nothing() -> None:
    """Cost nothing, as an estimator for which nothing was detected."""


def in_turns(
    parts: Sequence[Callable[[], Any]], ratios: Callable[[Floats], Floats], limit_s: float
) -> Floats:
    """Return the seconds (R, P) that P parts took in R rounds, each in a random order of its own.

    It ends when the medians of ``ratios``, of (R, P) to (R, ...), are known to :data:`NARROW`, or
    after ``limit_s`` seconds. Time is this thread's own.
    """
    generator = np.random.Generator(np.random.PCG64(0))
    clock = time.thread_time
    rounds = np.zeros((MOST_ROUNDS, len(parts)))
    started = time.perf_counter()
    # The first round warms up.
    for count in range(MOST_ROUNDS):
        for place in generator.permutation(len(parts)):
            begun = clock()
            parts[place]()
            rounds[count, place] = clock() - begun
        if count >= FEWEST_ROUNDS:
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
    rows = np.flatnonzero(visibility_flags(scenes) == Detection.not_run)
    if 0 < len(rows) < count:
        return _prepare(pipeline, [index[rows] for index in indices])
    settings = detector_settings(pipeline)
    whole = whole_frames(values, count)
    boxes = marker_boxes(scenes)
    cut = [search_windows(scenes, boxes, setting, whole) for setting in settings]
    # Each setting's images lie in memory by themselves, as a user's frame does.
    images = [render_all(scenes, rows, boxes, window) if len(rows) else [] for window in cut]
    wanted = np.full((count, len(settings)), len(rows) > 0)
    found, _, _ = search(scenes, wanted, settings, whole, [], keep=True)
    return _Regime(scenes, values, images, found)


def measure_renderers(
    pipeline: Pipeline, samples: Sequence[Sequence[NDArray[np.intp]]], reference: int,
    limit_s: float,
) -> tuple[Floats, tuple[Floats, Floats]]:
    """Measure K renderers on the same scenes.

    ``samples`` holds indices (n,) along each scene axis for each, equal but for the renderer's.
    Returns seconds an image (R, K), and the RMS (K,) and the largest (K,) difference in grey levels
    from the images of the ``reference``, over the pixels that the marker touches there.
    """
    single_thread()
    count = len(samples[0][0])
    scenes = [build_scenes(scene_values(pipeline, indices), count) for indices in samples]
    rows = np.flatnonzero(visibility_flags(scenes[reference]) == Detection.not_run)
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
        parts, lambda spent: np.asarray(spent / spent[:, reference : reference + 1]), limit_s
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


def sample_cells(
    pipeline: Pipeline, fixed: dict[str, int], regimes: int
) -> list[NDArray[np.intp]]:
    """Return indices (n,) along each scene axis: a seeded random sample of scenes of a regime.

    ``fixed`` has the indices of the axes that make the regime; there are as many scenes as
    :data:`MOST_PX` allows for so many regimes.
    """
    generator = np.random.Generator(np.random.PCG64(0))
    frame = max(pipeline.values_of("width_px")) * max(pipeline.values_of("height_px"))
    settings = len(detector_settings(pipeline))
    count = int(min(max(MOST_PX // (frame * regimes * settings), 4), MOST_SCENES))
    return [
        np.full(count, fixed[axis.name], dtype=np.intp) if axis.name in fixed
        else generator.integers(0, len(axis), count).astype(np.intp)
        for axis in scene_axes(pipeline)
    ]
