"""What a run takes, from a few scenes that are timed: its blocks, its time, its disk."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import resource
import statistics
import time
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError, MachineFaultError, RunError, StoreError
from sweep.evaluation.block import compute_block, run_cells
from sweep.execution.limits import (
    BLOCK_S,
    BLOCKS_PER_S,
    BLOCKS_PER_WORKER,
    MAX_BLOCK_BYTES,
    MAX_BLOCK_S,
    MAX_BLOCK_SCENES,
    MAX_BLOCK_SHARE,
    MAX_BLOCKS,
    MIN_BLOCK_S,
    PLAN_EFFECTS_S,
    PLAN_SCENES_S,
    SMALL_RUN_S,
    TIME_LIMIT_S,
    TIMING_LIMIT_S,
    TIMING_S,
    WAVE_BLOCK_S,
)
from sweep.experiment.axes import TRIAL, Axis
from sweep.experiment.grid import Block, Blocks
from sweep.experiment.parameters import Stage
from sweep.experiment.photographs import along_photographs, shows_photographs
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import bytes_per_block
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError, last_line
from sweep.isolation.machine import default_workers
from sweep.isolation.watchdog import compilation_s
from sweep.messages import byte_count, duration
from sweep.sampling.rules import (
    GroupResults,
    Stopping,
    block_unit,
    condition_axes,
    in_order_of_results,
    make_rule,
)
from sweep.store.blocks import RunStore, receipts
from sweep.store.locations import is_remote
from sweep.typing import Floats, Masks

# --------------------------------------------------------------------------------------------------
# What a scene takes: a seeded random batch of scenes is timed in a child process.

MAX_BATCH = 1536
"""Most scenes of a batch."""

GROWTH = 8
"""By how much a batch may exceed the one before: a few scenes may cost far more than the others."""

COMPILATION_LIMIT_S = 900.0
"""How long a measurement may compile; its own limit stands still meanwhile."""

UNMEASURED_S = 0.01
"""Assumed cost of a scene if the measurement crashed."""

MIN_ROUNDS = 3
"""How often pipelines are timed at least that are compared."""


@dataclass(frozen=True, slots=True)
class Timing:
    """What a scene takes.

    Attributes
    ----------
    scene_s
        Mean seconds a scene, all configurations included.
    sampled
        Scenes that were timed.
    over
        Whether these took too long and were abandoned: a scene takes more than ``scene_s``.
    """

    scene_s: float
    sampled: int
    over: bool = False


def seconds_of(
    pipelines: Sequence[Pipeline], count: int, budget_s: float = 0.0
) -> tuple[list[float], int]:
    """Return the seconds that each pipeline takes for the same scenes, and the number of scenes.

    Seconds are those of this thread, since others use the processors meanwhile, and compilation
    does not count. Several pipelines are timed in turns, and the median counts.

    Parameters
    ----------
    pipelines
        Pipelines of the same grid.
    count
        Scenes of the sample; of photographs all markers of one.
    budget_s
        Seconds in which further turns begin.
    """
    indices = _sample(pipelines[0], count)
    spent: list[list[float]] = []
    rounds = MIN_ROUNDS if len(pipelines) > 1 else 1
    while len(spent) < rounds or sum(map(sum, spent)) < budget_s:
        spent.append([])
        for pipeline in pipelines:
            begun, compiled = time.thread_time(), compilation_s()
            run_cells(pipeline, indices)
            took_s = time.thread_time() - begun - (compilation_s() - compiled)
            spent[-1].append(max(took_s, 1e-9))
    number = len(indices[0]) if indices else 1
    return [statistics.median(each) for each in zip(*spent, strict=True)], number


def _sample(pipeline: Pipeline, count: int) -> list[NDArray[np.intp]]:
    """Return the indices of a random sample of scenes: of photographs all markers of one."""
    axes = pipeline.experiment.scene_axes
    generator = np.random.Generator(np.random.PCG64(count))
    if not shows_photographs(pipeline):
        return [generator.integers(0, len(axis), count).astype(np.intp) for axis in axes]
    each = [
        generator.integers(0, len(axis), 1) if along else np.arange(len(axis))
        for axis, along in zip(axes, along_photographs(axes), strict=True)
    ]
    return [grid.ravel().astype(np.intp) for grid in np.meshgrid(*each, indexing="ij")]


def measure(
    child: Child, pipeline: Pipeline, budget_s: float = TIMING_S, limit_s: float = TIMING_LIMIT_S
) -> Timing:
    """Time a batch of scenes in a child process, for about ``budget_s`` seconds.

    One scene is computed first, so that code is compiled and caches are filled; batches grow until
    one takes as long. A batch that takes longer than ``limit_s`` is abandoned, and the child ends.

    Raises
    ------
    ChildDiedError, ChildRaisedError
        If a scene crashes the child, or raises.
    """
    count, warm = 1, False
    while True:
        try:
            (spent_s,), sampled = child.call(
                seconds_of, [pipeline], count, limit_s=limit_s, grace_s=COMPILATION_LIMIT_S)
        except ChildDiedError as error:
            if not error.timed_out:
                raise
            return Timing(limit_s / count, count, over=True)
        scene_s = spent_s / sampled
        wanted = min(int(budget_s / scene_s), MAX_BATCH)
        if warm and wanted <= 2 * count:
            return Timing(scene_s, sampled)
        count, warm = min(max(wanted, 1), GROWTH * count) if warm else 1, True


def measured_or_assumed(child: Child, pipeline: Pipeline, limit_s: float) -> Timing:
    """Time scenes, which may crash or raise: then :data:`UNMEASURED_S` is assumed.

    Also if this machine is at fault: whether the workers' are is seen by their blocks.
    """
    try:
        return measure(child, pipeline, limit_s=min(limit_s, TIMING_LIMIT_S))
    except (ChildDiedError, ChildRaisedError, MachineFaultError):
        return Timing(UNMEASURED_S, 0)


# --------------------------------------------------------------------------------------------------
# The blocks of a run: about two seconds of work each.

LARGER = 1.2
"""By how much blocks are made larger until there are few enough."""


def block_work_s(total_s: float, workers: int, time_limit_s: float | None = None) -> float:
    """Return the seconds of work in a block of a run that takes ``total_s`` of one worker.

    About 2; more for large clusters and for long runs; less if there is little to do, or if the
    user gives a time limit of which it would be too large a share.
    """
    wanted = max(BLOCK_S, workers / BLOCKS_PER_S, total_s / MAX_BLOCKS)
    share = max(MIN_BLOCK_S, total_s / (workers * BLOCKS_PER_WORKER))
    return min(wanted, longest_block_s(time_limit_s), share)


def longest_block_s(time_limit_s: float | None) -> float:
    """Return the seconds of work that a block may take, under the user's time limit if any."""
    if time_limit_s is None:
        return MAX_BLOCK_S
    return min(max(BLOCK_S, MAX_BLOCK_SHARE * time_limit_s), MAX_BLOCK_S)


def block_time_limit_s(time_limit_s: float | None, work_s: float) -> float:
    """Return the timeout of blocks of ``work_s``: the user's if there is one, else 600 s or more.

    >>> block_time_limit_s(None, 2.0), block_time_limit_s(None, 500.0), block_time_limit_s(40, 2.0)
    (600.0, 5000.0, 40)
    """
    return max(TIME_LIMIT_S, work_s / MAX_BLOCK_SHARE) if time_limit_s is None else time_limit_s


def blocks_of(
    pipeline: Pipeline, scene_s: float, workers: int, block_s: float | None = None,
    time_limit_s: float | None = None,
) -> Blocks:
    """Return the blocks of a run.

    Trials are cut first, then the first axis of the file, so that all blocks have the same
    conditions, and about the same cost, as far as possible.

    Parameters
    ----------
    pipeline
        The grid.
    scene_s
        Seconds that a scene takes.
    workers
        Threads that share the work.
    block_s
        Seconds of work in a block (default: :func:`block_work_s`).
    time_limit_s
        Block timeout in seconds, if the user gave one.
    """
    axes = pipeline.experiment.scene_axes
    lengths = tuple(len(axis) for axis in axes)
    if shows_photographs(pipeline):  # each is searched once, for all its markers
        along = along_photographs(axes)
        return Blocks(lengths, tuple(
            1 if each else length for each, length in zip(along, lengths, strict=True)))
    total_s = pipeline.size(Stage.scene) * scene_s
    rule = make_rule(pipeline)
    if rule is not None:
        # What is written of a block costs as much if few of its scenes are needed.
        total_s = max(total_s * rule.ends[0] / rule.ends[-1], WAVE_BLOCK_S * BLOCKS_PER_WORKER)
    work_s = block_work_s(total_s, workers, time_limit_s) if block_s is None else block_s
    most = min(MAX_BLOCK_SCENES, MAX_BLOCK_BYTES // bytes_per_block(pipeline, 1))
    target = max(min(int(work_s / scene_s), most), 1)
    blocks = Blocks(lengths, _cut(axes, target, rule))
    if block_s is None:
        # Blocks that fit into the axes are smaller than wanted, so that there may be more.
        most = min(most, int(longest_block_s(time_limit_s) / scene_s))
        while target < most and len(blocks) > MAX_BLOCKS:
            target = min(math.ceil(LARGER * target), most)
            blocks = Blocks(lengths, _cut(axes, target, rule))
    return blocks


def _cut(axes: Sequence[Axis], target: int, rule: Stopping | None) -> tuple[int, ...]:
    """Return the extents of blocks of at most ``target`` scenes.

    With a rule, the trials of a block are those of a wave, or an equal part of them.
    """
    order = sorted(range(len(axes)), key=lambda k: (axes[k].name != TRIAL, k), reverse=True)
    extents = [1] * len(axes)
    if rule is not None:
        trial = order.pop()
        unit = block_unit(rule.ends)
        extents[trial] = max(k for k in range(1, min(unit, target) + 1) if unit % k == 0)
        order.sort(key=lambda k: axes[k].name not in rule.coupled)
        if extents[trial] < unit:
            order = []
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


# --------------------------------------------------------------------------------------------------
# What a run in waves will need, from a small pilot: some conditions, their first wave.
#
# The trials of the pilot are drawn again (the bootstrap) in the place of those to come, and the
# rule of stopping is applied wave by wave. So it is one method for every rule.

PILOT_S = 3.0
"""Seconds in which a pilot computes poses."""

PILOT_LIMIT_S = 8.0
"""Seconds after which a pilot is ended: its rule may be slow to decide."""

MAX_CONDITIONS = 40
"""Conditions of the pilot; pooled cells are a condition together."""

MAX_VALUES = 20_000_000
"""Values of a variable that are simulated: with many trials or configurations, fewer conditions."""


@dataclass(frozen=True, slots=True)
class Pilot:
    """What a run in waves is expected to need.

    Attributes
    ----------
    conditions
        Conditions that were sampled.
    share
        Share of the grid's poses that is needed.
    unsettled
        Share of the conditions that need more than ``max_trials``.
    """

    conditions: int
    share: float
    unsettled: float


def pilot(pipeline: Pipeline, scene_s: float, budget_s: float) -> Pilot | None:
    """Compute the first wave of some conditions and return what a run is expected to need.

    Parameters
    ----------
    pipeline
        One with a rule of stopping.
    scene_s
        Seconds that a scene takes.
    budget_s
        Seconds of computation; None is returned if they are too short for one condition.
    """
    whole = make_rule(pipeline)
    if whole is None:
        raise TypeError(pipeline.stopping)
    pooled = math.prod(
        len(axis) for axis in condition_axes(pipeline) if axis.name in whole.coupled)
    most = min(
        budget_s / (scene_s * whole.ends[0] * pooled), MAX_CONDITIONS,
        MAX_VALUES / (whole.ends[-1] * pooled * pipeline.size(Stage.detection, Stage.estimation)),
    )
    if most < 1:
        return None
    part = _part(pipeline, whole, int(most))
    rule = make_rule(part)
    if rule is None:
        raise TypeError(part.stopping)
    trials, mask = _simulated(part, rule, _first_wave(part, rule))
    coupled = tuple(
        k for k, axis in enumerate(condition_axes(part)) if axis.name in rule.coupled)
    unsettled = mask.any(axis=coupled)
    return Pilot(unsettled.size, float(trials.mean()) / rule.ends[-1], float(unsettled.mean()))


def pilot_in(child: Child, pipeline: Pipeline, scene_s: float, budget_s: float) -> Pilot | None:
    """Return a pilot that is made in a child process; None also if its rule takes too long.

    Raises
    ------
    ChildDiedError, ChildRaisedError
        If a scene crashes the process, or raises.
    """
    try:
        found: Pilot | None = child.call(
            pilot, pipeline, scene_s, budget_s, limit_s=PILOT_LIMIT_S, grace_s=COMPILATION_LIMIT_S)
    except ChildDiedError as error:
        child.restart()
        if not error.timed_out:
            raise
        return None
    return found


def _part(pipeline: Pipeline, rule: Stopping, most: int) -> Pipeline:
    """Return a pipeline with some values of the axes that are not coupled, evenly spread."""
    counts = {axis.name: len(axis) for axis in condition_axes(pipeline)
              if axis.name not in rule.coupled}
    while math.prod(counts.values()) > most:
        longest = max(counts, key=lambda name: counts[name])
        counts[longest] -= 1
    return dataclasses.replace(pipeline, axes=tuple(
        _some(axis, counts[axis.name]) if axis.name in counts else axis for axis in pipeline.axes
    ))


def _some(axis: Axis, count: int) -> Axis:
    """Return an axis with so many of its values: the middles of equal parts."""
    chosen = [int((k + 0.5) * len(axis) / count) for k in range(count)]

    def taken(values: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(values[k] for k in chosen)

    return dataclasses.replace(
        axis, values=taken(axis.values),
        zipped=tuple((name, taken(values)) for name, values in axis.zipped),
    )


def _first_wave(pipeline: Pipeline, rule: Stopping) -> dict[str, NDArray[Any]]:
    """Return the results of the first wave of all conditions."""
    axes = pipeline.experiment.scene_axes
    block = Block((0,) * len(axes), tuple(
        rule.ends[0] if axis.name == TRIAL else len(axis) for axis in axes))
    values = compute_block(pipeline, block)
    return {
        variable.name: in_order_of_results(pipeline, variable, values[variable.name])
        for variable in pipeline.experiment.variables
        if variable.name in {"detection", *rule.variables}
    }


def _simulated(
    pipeline: Pipeline, rule: Stopping, first: dict[str, NDArray[Any]]
) -> tuple[Floats, Masks]:
    """Return the trials that each scene needs, and which need more; over the condition axes."""
    names = [axis.name for axis in condition_axes(pipeline)]
    shape, along = tuple(len(axis) for axis in condition_axes(pipeline)), len(names)
    generator = np.random.Generator(np.random.PCG64(0))
    drawn = generator.integers(0, rule.ends[0], rule.ends[-1])
    drawn[: rule.ends[0]] = np.arange(rule.ends[0])
    variables = {variable.name: variable for variable in pipeline.experiment.variables}
    values = {name: np.take(array, drawn, axis=along) for name, array in first.items()}
    trials = np.full(shape, float(rule.ends[0]))
    mask = np.ones(shape, dtype=bool)
    for wave in range(1, len(rule.ends) + 1):
        done = rule.ends[wave - 1]
        results = GroupResults(
            pipeline, (0,) * along, shape, wave, done,
            {name: np.take(values[name], range(done), axis=along) for name in rule.variables},
        )
        mask = np.array(rule.needed(results), dtype=bool)
        if wave == len(rule.ends) or not mask.any():
            break
        trials[mask] += rule.ends[wave] - done
        for name, array in values.items():
            array[~mask, done : rule.ends[wave]] = variables[name].not_needed
    return trials, mask


# --------------------------------------------------------------------------------------------------
# Time and disk of a run, which is refused if it takes longer than a day, or more than the disk has.

MAX_S = 86_400.0
"""Seconds from which on a run has to be confirmed."""

SAMPLED_RECEIPTS = 100
"""Committed blocks from which the cost of a scene is estimated."""


@dataclass(frozen=True, slots=True)
class Demand:
    """What a run takes.

    Attributes
    ----------
    seconds, workers
        Time, with so many workers.
    bytes
        What it writes, before compression.
    files
        How many files it makes.
    """

    seconds: float
    workers: int
    bytes: int
    files: int


@dataclass(frozen=True, slots=True)
class FreeDisk:
    """What is free on a disk; ``files`` is None where their number is not limited."""

    bytes: int
    files: int | None


def free_disk(url: str) -> FreeDisk | None:
    """Return what is free on the disk of a local store; None if that is not known."""
    if is_remote(url):
        return None
    path = Path(url).absolute()
    with contextlib.suppress(OSError):
        folder = next(each for each in (path, *path.parents) if each.exists())
        state = os.statvfs(folder)
        return FreeDisk(
            state.f_bavail * state.f_frsize, state.f_favail if state.f_files else None
        )
    return None


def demand_of(
    pipeline: Pipeline, scene_s: float, workers: int, blocks: int, left: int, share: float = 1.0
) -> Demand:
    """Return what the ``left`` of a run's blocks take, if a share of their poses is needed.

    A block has a file for each variable, and its receipt.
    """
    poses = math.ceil(share * pipeline.size(Stage.scene) * left / max(blocks, 1))
    files = left * (len(pipeline.experiment.variables) + 1)
    return Demand(poses * scene_s / workers, workers, bytes_per_block(pipeline, poses), files)


def objections(demand: Demand, free: FreeDisk | None) -> list[str]:
    """Return why a run has to be confirmed; nothing if it need not be.

    Examples
    --------
    >>> objections(Demand(3e5, 2, 10**13, 9), FreeDisk(10**12, None))
    ['takes about 3.5 days with 2 workers', 'writes 10 TB before compression, and 1 TB are free']
    >>> objections(Demand(60, 2, 10**9, 9), FreeDisk(10**12, None))
    []
    """
    found = []
    if demand.seconds > MAX_S:
        workers = f"{demand.workers} worker{'s' if demand.workers > 1 else ''}"
        found.append(f"takes about {duration(demand.seconds)} with {workers}")
    if free is not None and demand.bytes > free.bytes:
        found.append(
            f"writes {byte_count(demand.bytes)} before compression, and {byte_count(free.bytes)} "
            "are free"
        )
    if free is not None and free.files is not None and demand.files > free.files:
        found.append(f"makes {demand.files:,} files, and the disk has room for {free.files:,}")
    return found


def check_affordable(
    url: str, pipeline: Pipeline, scene_s: float, workers: int, blocks: int, left: int,
    child: Child,
) -> None:
    """Raise StoreError if the ``left`` of a run's blocks have to be confirmed.

    A run whose sampling stops is judged by a pilot, if all its poses were too many.
    """
    run = pipeline, scene_s, workers, blocks, left
    found = objections(demand_of(*run), free_disk(url))
    if found and pipeline.stopping is not None:
        with contextlib.suppress(ChildDiedError, ChildRaisedError):
            expected = pilot_in(child, pipeline, scene_s, PILOT_S)
            if expected is not None:
                found = objections(demand_of(*run, expected.share), free_disk(url))
    if found:
        raise StoreError(
            f"{url}: the run {' and '.join(found)}; make it smaller, or confirm it with "
            "`--yes` (in Python, yes=True)"
        )


def scene_s_of(store: RunStore, done: AbstractSet[int], timing: Timing | None = None) -> float:
    """Return the mean seconds a scene of some committed blocks; without any, what was measured."""
    some = sorted(done)[:SAMPLED_RECEIPTS]
    spent = [receipt.wall_s / receipt.scenes for _, receipt in receipts(store, some)]
    if spent:
        return statistics.fmean(spent)
    return BLOCK_S / len(store.blocks[0]) if timing is None else timing.scene_s


# --------------------------------------------------------------------------------------------------
# The forecast of a run: blocks, bytes, memory and time, and what each effect costs.

EFFECT_SCENES = 24
"""Most scenes on which effects are measured."""

PILOT_SHARE = 0.6
"""Share of the time for effects in which a pilot computes poses."""

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


def forecast(
    pipeline: Pipeline, workers: int | None = None, switches: Sequence[str] = ()
) -> tuple[Forecast, dict[str, float]]:
    """Return what a run would take, and the seconds that effects add to a pose; write nothing.

    A seeded sample of scenes is measured in a child process, for a few seconds at most,
    compilation not counted. There are no costs of effects if that is too short.

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
    count = default_workers() if workers is None else workers
    if count < 1:
        raise ArgumentError("workers", workers, "expected at least 1")
    costs: dict[str, float] = {}
    expected: Pilot | None = None
    try:
        with Child("sweep.execution.forecast") as child:
            timing = measure(child, pipeline, limit_s=PLAN_SCENES_S)
            left_s = PLAN_EFFECTS_S
            if not timing.over and pipeline.stopping is not None:
                expected = pilot_in(child, pipeline, timing.scene_s, PILOT_SHARE * left_s)
                left_s *= 1 - PILOT_SHARE
            if not timing.over and switches:
                costs = _effect_costs(child, pipeline, switches, timing.scene_s, left_s)
    except (ChildDiedError, ChildRaisedError) as error:
        raise RunError(
            f"a measured scene crashed its process ({last_line(error)}); `sweep run` isolates it "
            "and computes the others"
        ) from None
    poses = pipeline.size(Stage.scene)
    share = 1.0 if expected is None else expected.share
    small = workers is None and share * poses * timing.scene_s < SMALL_RUN_S
    blocks = blocks_of(pipeline, timing.scene_s, 1 if small else count)
    busy = 1 if small else min(count, default_workers(), len(blocks))
    demand = demand_of(pipeline, timing.scene_s, busy, len(blocks), len(blocks), share)
    # The child ended: its memory was at most this.
    process = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    return Forecast(
        poses=poses,
        results=pipeline.size(*Stage),
        block=blocks.extents,
        blocks=len(blocks),
        files=demand.files,
        bytes=demand.bytes,
        worker_bytes=process + 3 * bytes_per_block(pipeline, math.prod(blocks.extents)),
        pose_s=timing.scene_s,
        sampled=timing.sampled,
        over=timing.over,
        workers=count,
        seconds=(SMALL_START_S if small else START_S) + demand.seconds,
        small=small,
        pilot=expected,
    ), costs


def _effect_costs(
    child: Child, pipeline: Pipeline, switches: Sequence[str], pose_s: float, budget_s: float
) -> dict[str, float]:
    """Return the seconds that each effect adds to a pose; none if poses take too long.

    All other parameters stay as they are, so that effects that multiply one another's work are
    each charged with all of it.
    """
    variants = [pipeline, *(without_effect(pipeline, switch) for switch in switches)]
    count = min(int(budget_s / (len(variants) * MIN_ROUNDS * pose_s)), EFFECT_SCENES)
    if count < 1:
        return {}
    try:
        spent, number = child.call(
            seconds_of, variants, count, budget_s, limit_s=2 * budget_s,
            grace_s=COMPILATION_LIMIT_S)
    except ChildDiedError as error:
        if not error.timed_out:
            raise
        return {}
    # A difference below 0 is measurement noise.
    return {switch: max(spent[0] - without_s, 0.0) / number
            for switch, without_s in zip(switches, spent[1:], strict=True)}


def without_effect(pipeline: Pipeline, switch: str) -> Pipeline:
    """Return the pipeline with an effect switched off everywhere, on the same grid."""
    off = next(each.off for each in pipeline.experiment.effects if each.switch == switch)
    return dataclasses.replace(
        pipeline,
        fixed={**pipeline.fixed, switch: off},
        distributions={k: v for k, v in pipeline.distributions.items() if k != switch},
        axes=tuple(
            axis.replaced(switch, off) if switch in axis.columns else axis
            for axis in pipeline.axes
        ),
    )
