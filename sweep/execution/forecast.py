"""The forecast of a run: blocks, bytes, memory and time, from a short calibration."""

from __future__ import annotations

import dataclasses
import math
import resource
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.errors import ArgumentError, RunError
from sweep.evaluation.cells import run_cells
from sweep.execution.calibration import block_extents, calibrate, sample
from sweep.execution.cluster import default_workers
from sweep.execution.limits import CALIBRATION_S, PLAN_LIMIT_S
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError
from sweep.model.effects import SWITCHES
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Blocks, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.schema import bytes_per_block

EFFECT_SCENES = 24
"""Most scenes on which an effect is measured."""

EFFECT_S = 0.6
"""Least seconds of measurement for each effect."""

START_S = 3.0
"""Seconds of a run apart from its blocks: processes start and end, packages are imported."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a run would take.

    Attributes
    ----------
    poses, results
        Cells of the scene axes; estimates, which are poses times configurations.
    block, blocks
        Scenes of a block along each scene axis; number of blocks.
    bytes, worker_bytes
        Size of the store before compression; memory of a worker.
    pose_s, sampled
        Mean seconds a pose, all configurations included; scenes that were measured.
    workers, seconds
        Number of workers, and how long they would take.
    """

    poses: int
    results: int
    block: tuple[int, ...]
    blocks: int
    bytes: int
    worker_bytes: int
    pose_s: float
    sampled: int
    workers: int
    seconds: float


def effect_costs(
    pipeline: Pipeline, switches: Sequence[str], pose_s: float
) -> dict[str, float]:
    """Return the seconds that each effect adds to a pose: medians of pairs with and without it.

    All other parameters stay as they are, so that effects that multiply one another's work are each
    charged with all of it.

    Parameters
    ----------
    pipeline
        Measured on a seeded sample of its scenes.
    switches
        Parameters that switch an effect on.
    pose_s
        Seconds that a pose takes with all effects, from :func:`forecast`.
    """
    axes = scene_axes(pipeline)
    generator = np.random.Generator(np.random.PCG64(1))
    count = min(max(int(EFFECT_S / (6 * pose_s)), 8), EFFECT_SCENES) if axes else 1
    indices = sample(axes, generator, count)
    costs = {}
    for switch in switches:
        pair = pipeline, _without(pipeline, switch)
        differences: list[float] = []
        started = time.perf_counter()
        while len(differences) < 3 or time.perf_counter() - started < EFFECT_S:
            spent = []
            for variant in pair:
                start = time.thread_time()
                run_cells(variant, indices)
                spent.append(time.thread_time() - start)
            differences.append((spent[0] - spent[1]) / count)
        # A difference below 0 is measurement noise.
        costs[switch] = max(statistics.median(differences), 0.0)
    return costs


def _without(pipeline: Pipeline, switch: str) -> Pipeline:
    """Return the pipeline with an effect switched off everywhere, on the same grid."""
    off = SWITCHES[switch]
    return dataclasses.replace(
        pipeline,
        fixed={**pipeline.fixed, switch: off},
        distributions={k: v for k, v in pipeline.distributions.items() if k != switch},
        axes=tuple(
            dataclasses.replace(axis, values=[off] * len(axis)) if axis.name == switch else axis
            for axis in pipeline.axes
        ),
    )


def forecast_isolated(
    pipeline: Pipeline, workers: int | None, switches: Sequence[str]
) -> tuple[Forecast, dict[str, float]]:
    """Return :func:`forecast` and :func:`effect_costs`, measured in a child process.

    Raises
    ------
    RunError
        If a measured scene crashes its process, never returns, or raises.
    """
    try:
        with Child() as child:
            expected: Forecast = child.call(forecast, pipeline, workers, limit_s=PLAN_LIMIT_S)
            costs: dict[str, float] = child.call(
                effect_costs, pipeline, switches, expected.pose_s, limit_s=PLAN_LIMIT_S
            )
    except (ChildDiedError, ChildRaisedError) as error:
        reason = str(error).strip().splitlines()[-1]
        raise RunError(
            f"a measured scene crashed its process ({reason}); `sweep run` isolates it and "
            "computes the others"
        ) from None
    return expected, costs


def forecast(pipeline: Pipeline, workers: int | None = None) -> Forecast:
    """Return what a run would take; nothing is written.

    Parameters
    ----------
    pipeline
        Measured on a seeded sample of its scenes, for less than a second.
    workers
        Number of workers (default: the available processors).

    Raises
    ------
    ArgumentError
        If there are no workers.
    """
    if workers is None:
        workers = default_workers()
    if workers < 1:
        raise ArgumentError("workers", workers, "expected at least 1")
    calibration = calibrate(pipeline, CALIBRATION_S)
    extents = block_extents(pipeline, calibration, workers)
    blocks = Blocks(tuple(len(axis) for axis in scene_axes(pipeline)), extents)
    poses = pipeline.size(Stage.scene)
    busy = min(workers, default_workers(), len(blocks))
    process = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Forecast(
        poses=poses,
        results=pipeline.size(*Stage),
        block=extents,
        blocks=len(blocks),
        bytes=bytes_per_block(pipeline, poses),
        worker_bytes=process + 3 * bytes_per_block(pipeline, math.prod(extents)),
        pose_s=calibration.scene_s,
        sampled=calibration.sampled,
        workers=workers,
        seconds=START_S + poses * calibration.scene_s / busy,
    )
