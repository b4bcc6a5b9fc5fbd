"""What scenes cost, measured on a sample: for the size of blocks and for forecasts."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.cells import run_cells
from sweep.execution.limits import (
    BLOCK_S,
    BLOCKS_PER_WORKER,
    MAX_BLOCK_BYTES,
    MAX_BLOCK_SCENES,
    MIN_BLOCK_S,
)
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError
from sweep.plan.axes import Axis
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.schema import bytes_per_block

MIN_BATCH, MAX_BATCH = 24, 1536
"""Scenes measured at a time: more if they are cheap, because a call has a cost of its own."""

LONG_BATCH_S = 0.06
"""Batches that take longer are large enough."""

MAX_BATCHES = 40

UNEVEN = 0.25
"""Axes whose two halves differ in cost by more than this share are not cut if possible."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """The cost of scenes, from a sample of the grid.

    Attributes
    ----------
    scene_s
        Mean seconds a scene, all configurations included.
    error_s
        Standard error of that mean.
    sampled
        Scenes in the sample.
    unevenness
        For each scene axis, the difference of the mean costs of its two halves, as a share.
    """

    scene_s: float
    error_s: float
    sampled: int
    unevenness: tuple[float, ...]


def calibrate(pipeline: Pipeline, budget_s: float) -> Calibration:
    """Measure a seeded random sample of scenes for about ``budget_s`` seconds.

    A few scenes are computed first, so that code is compiled and caches are filled.
    """
    axes = scene_axes(pipeline)
    generator = np.random.Generator(np.random.PCG64(0))
    total = pipeline.size(Stage.scene)
    run_cells(pipeline, sample(axes, generator, min(4, total)))
    rows: list[NDArray[np.float64]] = []
    picks: list[list[NDArray[np.intp]]] = []
    total_s, batch = 0.0, MIN_BATCH
    started = time.perf_counter()
    while True:
        indices = sample(axes, generator, batch)
        wall, working = time.perf_counter(), time.thread_time()
        result = run_cells(pipeline, indices)
        # This thread's own time: the workers' processes start meanwhile and use the processors.
        spent = time.thread_time() - working
        own = result.row_seconds * (spent / (time.perf_counter() - wall))
        # Time that is not measured by scene (solving, projecting) is spread over the batch.
        count = len(own)
        rows.append(own + (spent - own.sum()) / count)
        picks.append(indices)
        total_s += spent
        if spent < LONG_BATCH_S:
            batch = min(2 * batch, MAX_BATCH)
        used = time.perf_counter() - started
        if used >= budget_s or len(rows) >= MAX_BATCHES:
            break
    cost = np.concatenate(rows)
    unevenness = []
    for k, axis in enumerate(axes):
        index = np.concatenate([chosen[k] for chosen in picks])
        low = index < len(axis) / 2
        if len(axis) < 2 or low.all() or not low.any():
            unevenness.append(0.0)
            continue
        a, b = cost[low].mean(), cost[~low].mean()
        unevenness.append(float(abs(a - b) / (a + b) * 2))
    error = float(cost.std(ddof=1) / math.sqrt(len(cost))) if len(cost) > 1 else 0.0
    return Calibration(total_s / len(cost), error, len(cost), tuple(unevenness))


UNMEASURED_S = 0.01
"""Assumed cost of a scene if the measurement crashed."""


def calibrate_isolated(
    child: Child, pipeline: Pipeline, budget_s: float, limit_s: float
) -> Calibration:
    """Call :func:`calibrate` in a child process, which a scene may crash.

    If it crashes, raises or takes longer than ``limit_s`` seconds, :data:`UNMEASURED_S` is assumed.
    """
    try:
        measured: Calibration = child.call(calibrate, pipeline, budget_s, limit_s=limit_s)
    except (ChildDiedError, ChildRaisedError):
        return Calibration(UNMEASURED_S, 0.0, 0, (0.0,) * len(scene_axes(pipeline)))
    return measured


def sample(
    axes: tuple[Axis, ...], generator: np.random.Generator, count: int
) -> list[NDArray[np.intp]]:
    """Return random indices (count,) along each scene axis."""
    return [generator.integers(0, len(axis), count).astype(np.intp) for axis in axes]


def block_extents(
    pipeline: Pipeline, calibration: Calibration, workers: int, block_s: float | None = None
) -> tuple[int, ...]:
    """Return the scenes of a block along each scene axis.

    Axes along which the cost changes are not cut if possible, so that blocks are even; of the
    others, the first axis of the file is cut first.

    Parameters
    ----------
    pipeline, calibration
        The grid, and what its scenes cost.
    workers
        Threads that share the work.
    block_s
        Seconds of work in a block (default: about 2, less if there is little to do).
    """
    axes = scene_axes(pipeline)
    total = pipeline.size(Stage.scene)
    if block_s is None:
        share = total * calibration.scene_s / (workers * BLOCKS_PER_WORKER)
        block_s = min(BLOCK_S, max(MIN_BLOCK_S, share))
    target = int(block_s / calibration.scene_s)
    target = min(target, MAX_BLOCK_SCENES, MAX_BLOCK_BYTES // bytes_per_block(pipeline, 1))
    target = max(target, 1)
    order = sorted(
        range(len(axes)),
        key=lambda k: (max(calibration.unevenness[k] - UNEVEN, 0.0), k),
        reverse=True,
    )
    extents = [1] * len(axes)
    for k in order:
        most = max(target // math.prod(extents), 1)
        length = len(axes[k])
        if most >= length:
            extents[k] = length
            continue
        # Equal parts rather than a short last one.
        extents[k] = -(-length // -(-length // most))
        break
    return tuple(extents)
