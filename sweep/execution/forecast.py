"""What a run would take: blocks, bytes, memory and time, from a short calibration."""

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
"""Scenes at most that an effect is measured on."""

START_S = 3.0
"""Seconds that a run takes beside its blocks: processes start and end, packages are imported."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What is to be expected of a run."""

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


EFFECT_S = 0.6
"""Seconds of measuring for each effect, at least."""


def effect_costs(
    pipeline: Pipeline, switches: Sequence[str], pose_s: float
) -> dict[str, float]:
    """Return what each effect adds to a pose, in seconds: with it against without it, paired.

    On a seeded sample of scenes, all other parameters as they are, so that effects which
    multiply one another's work are each charged with all of it; medians of repeated pairs.
    ``pose_s`` is what a pose takes, all in all.
    """
    axes = scene_axes(pipeline)
    generator = np.random.Generator(np.random.PCG64(1))
    count = min(max(int(EFFECT_S / (6 * pose_s)), 8), EFFECT_SCENES) if axes else 1
    indices = sample(axes, generator, count)
    costs = {}
    for switch in switches:
        pair = pipeline, _without(pipeline, switch)
        differences: list[float] = []
        begun = time.perf_counter()
        while len(differences) < 3 or time.perf_counter() - begun < EFFECT_S:
            spent = []
            for variant in pair:
                start = time.thread_time()
                run_cells(variant, indices)
                spent.append(time.thread_time() - start)
            differences.append((spent[0] - spent[1]) / count)
        # What is lost in the noise of measuring costs nothing that can be told.
        costs[switch] = max(statistics.median(differences), 0.0)
    return costs


def _without(pipeline: Pipeline, switch: str) -> Pipeline:
    """Return a pipeline on the same grid in which an effect is absent everywhere."""
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
        Where a scene that is measured ends its process, never returns, or raises.
    """
    try:
        with Child() as child:
            expected: Forecast = child.call(forecast, pipeline, workers, limit_s=PLAN_LIMIT_S)
            costs: dict[str, float] = child.call(
                effect_costs, pipeline, switches, expected.pose_s, limit_s=PLAN_LIMIT_S
            )
    except (ChildDiedError, ChildRaisedError) as error:
        why = str(error).strip().splitlines()[-1]
        raise RunError(
            f"a scene that was measured ended its process ({why}); `sweep run` finds it, and "
            "computes the others"
        ) from None
    return expected, costs


def forecast(pipeline: Pipeline, workers: int | None = None) -> Forecast:
    """Return what a run with ``workers`` processes would take; nothing is written."""
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
