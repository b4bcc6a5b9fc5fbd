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
from sweep.execution.affordability import files_of
from sweep.execution.calibration import (
    COMPILATION_LIMIT_S,
    block_extents,
    calibrate_in,
    sample,
)
from sweep.execution.cluster import default_workers
from sweep.execution.limits import (
    CALIBRATION_S,
    PLAN_LIMIT_S,
    PLAN_SCENES_LIMIT_S,
    SMALL_RUN_S,
)
from sweep.execution.pilot import Pilot, pilot_in
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError, last_line
from sweep.isolation.watchdog import compilation_s
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Blocks, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.scene_plugins import effects_of
from sweep.plan.schema import bytes_per_block

EFFECT_SCENES = 24
"""Most scenes on which an effect is measured."""

EFFECT_S = 0.6
"""Seconds of measurement for each effect, if the time limit of all leaves them."""

MIN_PAIRS = 3
"""Pairs of measurements of an effect, of which the median is taken."""

PILOT_SHARE = 0.6
"""Share of the time that is left in which a pilot computes poses."""

START_S = 3.0
"""Seconds of a run apart from its blocks: processes start and end, packages are imported."""

SMALL_START_S = 1.2
"""The same of a small run, which is computed in one child process without a cluster."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a run would take.

    Attributes
    ----------
    poses, results
        Cells of the scene axes; estimates, which are poses times configurations.
    block, blocks, files
        Scenes of a block along each scene axis; number of blocks, and of the files that they make.
    bytes, worker_bytes
        Size of the store before compression; memory of a worker. Of a run to a precision, files and
        bytes are those of the poses that a pilot expects to be needed.
    pose_s, sampled
        Mean seconds a pose, all configurations included; scenes that were measured.
    over
        Whether the measurement was abandoned: a pose takes more than ``pose_s``.
    workers, seconds
        Number of workers, and how long they would take.
    small
        Whether the run is so small that one process computes it, without a cluster.
    pilot
        Of a run to a precision, what it is expected to need of the poses, after which ``seconds``
        are estimated; None of a run of fixed trials, or if poses take too long for a pilot.
    """

    poses: int
    results: int
    block: tuple[int, ...]
    blocks: int
    files: int
    bytes: int
    worker_bytes: int
    pose_s: float
    sampled: int
    over: bool
    workers: int
    seconds: float
    small: bool
    pilot: Pilot | None = None


def effect_cost(
    pipeline: Pipeline, switch: str, count: int, budget_s: float
) -> tuple[float, float]:
    """Return the seconds that an effect adds to a pose, and those that this took.

    It is the median of pairs with and without the effect. All other parameters stay as they are, so
    that effects that multiply one another's work are each charged with all of it. Compilation does
    not count.

    Parameters
    ----------
    pipeline
        Measured on a seeded sample of its scenes.
    switch
        The parameter that switches the effect on.
    count
        Scenes in the sample.
    budget_s
        Seconds of measurement; at least :data:`MIN_PAIRS` pairs are measured.
    """
    axes = scene_axes(pipeline)
    scenes = count if axes else 1
    indices = sample(axes, np.random.Generator(np.random.PCG64(1)), scenes)
    pair = pipeline, _without(pipeline, switch)
    differences: list[float] = []
    started, compiled = time.perf_counter(), compilation_s()

    def used_s() -> float:
        return time.perf_counter() - started - (compilation_s() - compiled)

    while len(differences) < MIN_PAIRS or used_s() < budget_s:
        spent = []
        for variant in pair:
            start = time.thread_time()
            run_cells(variant, indices)
            spent.append(time.thread_time() - start)
        differences.append((spent[0] - spent[1]) / scenes)
    # A difference below 0 is measurement noise.
    return max(statistics.median(differences), 0.0), used_s()


def _without(pipeline: Pipeline, switch: str) -> Pipeline:
    """Return the pipeline with an effect switched off everywhere, on the same grid."""
    off = next(each.off for each in effects_of(pipeline.plugins) if each.switch == switch)
    return dataclasses.replace(
        pipeline,
        fixed={**pipeline.fixed, switch: off},
        distributions={k: v for k, v in pipeline.distributions.items() if k != switch},
        axes=tuple(
            axis.replaced(switch, off) if switch in axis.columns else axis
            for axis in pipeline.axes
        ),
    )


def forecast(
    pipeline: Pipeline, workers: int | None = None, switches: Sequence[str] = ()
) -> tuple[Forecast, dict[str, float]]:
    """Return what a run would take, and the seconds that effects add to a pose; write nothing.

    A seeded sample of scenes is measured in a child process, for :data:`PLAN_LIMIT_S` seconds at
    most, compilation not counted. The costs lack effects for which that is too short.

    Parameters
    ----------
    pipeline
        Measured on its own grid.
    workers
        Number of workers (default: the available processors).
    switches
        Parameters that switch effects on.

    Raises
    ------
    ArgumentError
        If there are no workers.
    RunError
        If a measured scene crashes its process, or raises.
    """
    chosen = workers is not None
    if workers is None:
        workers = default_workers()
    if workers < 1:
        raise ArgumentError("workers", workers, "expected at least 1")
    costs: dict[str, float] = {}
    expected: Pilot | None = None
    try:
        with Child("sweep.execution.forecast") as child:
            started = time.monotonic()
            calibration = calibrate_in(child, pipeline, CALIBRATION_S, PLAN_SCENES_LIMIT_S)
            if not calibration.over:
                left = PLAN_LIMIT_S - min(time.monotonic() - started, PLAN_SCENES_LIMIT_S)
                if pipeline.stopping is not None:
                    begun = time.monotonic()
                    expected = pilot_in(
                        child, pipeline, calibration.scene_s, PILOT_SHARE * left)
                    left -= time.monotonic() - begun
                costs = _effect_costs(child, pipeline, switches, calibration.scene_s, left)
    except (ChildDiedError, ChildRaisedError) as error:
        raise RunError(
            f"a measured scene crashed its process ({last_line(error)}); `sweep run` isolates it "
            "and computes the others"
        ) from None
    poses = pipeline.size(Stage.scene)
    share = 1.0 if expected is None else expected.share
    work_s = share * poses * calibration.scene_s
    small = not chosen and work_s < SMALL_RUN_S
    extents = block_extents(pipeline, calibration, 1 if small else workers)
    blocks = Blocks(tuple(len(axis) for axis in scene_axes(pipeline)), extents)
    busy = 1 if small else min(workers, default_workers(), len(blocks))
    # The child ended: its memory was at most this.
    process = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    return Forecast(
        poses=poses,
        results=pipeline.size(*Stage),
        block=extents,
        blocks=len(blocks),
        files=files_of(pipeline, len(blocks), share),
        bytes=bytes_per_block(pipeline, math.ceil(share * poses)),
        worker_bytes=process + 3 * bytes_per_block(pipeline, math.prod(extents)),
        pose_s=calibration.scene_s,
        sampled=calibration.sampled,
        over=calibration.over,
        workers=workers,
        seconds=(SMALL_START_S if small else START_S) + work_s / busy,
        small=small,
        pilot=expected,
    ), costs


def _effect_costs(
    child: Child, pipeline: Pipeline, switches: Sequence[str], pose_s: float, left_s: float
) -> dict[str, float]:
    """Return the seconds that each effect adds to a pose, for as many as can be measured."""
    costs: dict[str, float] = {}
    for number, switch in enumerate(switches):
        budget_s = min(EFFECT_S, left_s / (len(switches) - number))
        count = min(int(budget_s / (2 * MIN_PAIRS * pose_s)), EFFECT_SCENES)
        if count < 1:
            break
        try:
            costs[switch], used_s = child.call(
                effect_cost, pipeline, switch, count, budget_s, limit_s=left_s,
                grace_s=COMPILATION_LIMIT_S,
            )
        except ChildDiedError as error:
            if not error.timed_out:
                raise
            break
        left_s -= used_s
    return costs
