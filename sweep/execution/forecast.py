"""What a run will take: time and disk, and whether it can be afforded."""

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
from typing import TYPE_CHECKING

import numpy as np

from sweep.errors import ArgumentError, RunError, StoreError
from sweep.evaluation.block import run_cells
from sweep.execution.calibration import (
    COMPILATION_LIMIT_S,
    Calibration,
    Pilot,
    block_extents,
    calibrate_in,
    pilot_in,
    sample,
)
from sweep.execution.cluster import default_workers
from sweep.execution.limits import (
    BLOCK_S,
    CALIBRATION_S,
    PLAN_LIMIT_S,
    PLAN_SCENES_LIMIT_S,
    SMALL_RUN_S,
)
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError, last_line
from sweep.isolation.watchdog import compilation_s
from sweep.messages import byte_count, duration
from sweep.plan.experiment import effects_of
from sweep.plan.grid import Blocks, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.pipeline import Pipeline
from sweep.plan.schema import bytes_per_block, variables_of
from sweep.sampling.rules import make_rule
from sweep.store.blocks import RunStore, receipts
from sweep.store.locations import is_remote

if TYPE_CHECKING:
    from distributed import Client


# --------------------------------------------------------------------------------------------------
# Runs that are refused unless they are confirmed: longer than a day, or larger than the disk.

MAX_S = 86_400.0
"""Seconds from which on a run has to be confirmed."""


@dataclass(frozen=True, slots=True)
class Demand:
    """What the rest of a run would take.

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


def files_of(pipeline: Pipeline, blocks: int, share: float = 1.0) -> int:
    """Return how many files some blocks make: a chunk of each variable, and the receipt.

    Those of which nothing is needed, all but a ``share``, have no chunks but those of flags.
    """
    variables = variables_of(pipeline)
    flags = sum(variable.flags is not None for variable in variables)
    return blocks * (flags + 1) + math.ceil(share * blocks) * (len(variables) - flags)


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


def check_affordable(url: str, demand: Demand) -> None:
    """Raise StoreError if a run into a store has to be confirmed."""
    found = objections(demand, free_disk(url))
    if found:
        raise StoreError(
            f"{url}: the run {' and '.join(found)}; make it smaller, or confirm it with "
            "`--yes` (in Python, yes=True)"
        )


# --------------------------------------------------------------------------------------------------
# The forecast of a run: blocks, bytes, memory and time, from a short calibration.

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


# --------------------------------------------------------------------------------------------------
# What the rest of a run takes: its work, and what it has to be confirmed for.

PILOT_S = 3.0
"""Seconds in which a pilot computes poses, where all poses would be too many."""

SAMPLED_RECEIPTS = 100
"""Committed blocks from which the work that is left is estimated."""


def work_s(
    pipeline: Pipeline, unfinished: RunStore | None, done: AbstractSet[int],
    calibration: Calibration | None,
) -> float:
    """Return the estimated seconds of work that are left when the blocks ``done`` are committed.

    In waves, at least the first one is left.
    """
    if unfinished is not None:
        return (len(unfinished.blocks) - len(done)) * block_s_of(unfinished, done, calibration)
    if calibration is None:
        return math.inf
    rule = make_rule(pipeline)
    share = 1.0 if rule is None else rule.ends[0] / rule.ends[-1]
    return share * pipeline.size(Stage.scene) * calibration.scene_s


def thread_count_of(client: Client | None) -> int:
    """Return how many threads compute, at least 1: that of the child without a cluster."""
    if client is None:
        return 1
    from sweep.execution.cluster import thread_count  # noqa: PLC0415  (slow to import)

    return max(thread_count(client), 1)


def demand_of(
    pipeline: Pipeline, calibration: Calibration, threads: int, extents: tuple[int, ...],
    share: float = 1.0,
) -> Demand:
    """Return what a whole run takes, in blocks of ``extents``, if it needs a share of the poses."""
    poses = math.ceil(share * pipeline.size(Stage.scene))
    blocks = len(Blocks(tuple(len(axis) for axis in scene_axes(pipeline)), extents))
    return Demand(
        poses * calibration.scene_s / threads, threads, bytes_per_block(pipeline, poses),
        files_of(pipeline, blocks, share),
    )


def check_new(
    url: str, pipeline: Pipeline, calibration: Calibration, threads: int,
    extents: tuple[int, ...], child: Child | None,
) -> None:
    """Raise StoreError if a run into a new store has to be confirmed.

    One whose sampling stops is judged by a pilot, if all its poses were too many.
    """
    demand = demand_of(pipeline, calibration, threads, extents)
    share = _needed_share(url, demand, pipeline, calibration.scene_s, child)
    check_affordable(url, demand if share is None else demand_of(
        pipeline, calibration, threads, extents, share))


def check_rest(
    store: RunStore, done: AbstractSet[int], calibration: Calibration | None,
    client: Client | None, child: Child | None,
) -> None:
    """Raise StoreError if the blocks that are not committed, those ``done``, are too many."""
    threads, pipeline = thread_count_of(client), store.pipeline
    left = len(store.blocks) - len(done)
    poses = pipeline.size(Stage.scene) * left // max(len(store.blocks), 1)
    each_s = block_s_of(store, done, calibration) if done or calibration else 0.0
    demand = Demand(
        left * each_s / threads, threads, bytes_per_block(pipeline, poses),
        files_of(pipeline, left))
    scene_s = each_s / len(store.blocks[0])
    share = _needed_share(store.url, demand, pipeline, scene_s, child)
    if share is not None:
        needed = sum(receipt.scenes_needed for _, receipt in receipts(store, done))
        poses = max(math.ceil(share * pipeline.size(Stage.scene)) - needed, 0)
        demand = Demand(
            poses * scene_s / threads, threads, bytes_per_block(pipeline, poses),
            files_of(pipeline, left, share))
    check_affordable(store.url, demand)


def _needed_share(
    url: str, whole: Demand, pipeline: Pipeline, scene_s: float, child: Child | None
) -> float | None:
    """Return the share of the poses that a run in waves needs, by a pilot.

    None without waves, where even all poses are affordable, or if a pilot takes too long.
    """
    if child is None or pipeline.stopping is None or not objections(whole, free_disk(url)):
        return None
    try:
        found = pilot_in(child, pipeline, scene_s, PILOT_S)
    except ChildRaisedError:
        return None
    except ChildDiedError:
        child.restart()
        return None
    return None if found is None else found.share


def block_s_of(
    store: RunStore, done: AbstractSet[int], calibration: Calibration | None = None
) -> float:
    """Return the mean seconds of some committed blocks; without any, what is expected of them."""
    some = sorted(done)[:SAMPLED_RECEIPTS]
    spent = [receipt.wall_s for _, receipt in receipts(store, some)]
    if spent:
        return statistics.fmean(spent)
    return BLOCK_S if calibration is None else len(store.blocks[0]) * calibration.scene_s
