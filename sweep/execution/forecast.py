"""The cost of a run, from a few timed scenes: its blocks, its time, its disk."""

from __future__ import annotations

import contextlib
import math
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from rich import filesize

from sweep.errors import MachineFaultError
from sweep.evaluation.block import run_cells
from sweep.execution import TIME_LIMIT_S
from sweep.experiment.grid import TRIAL, Axis, Blocks
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Child, ChildError, default_workers
from sweep.isolation.watchdog import compilation_s
from sweep.sampling.rules import Stopping, make_rule
from sweep.store.locations import is_remote

# --------------------------------------------------------------------------------------------------
# The cost of a scene: a seeded random batch of scenes is timed in a child process.

#: Seconds of the batch of scenes that is timed before blocks are cut.
TIMING_S = 0.2

#: Seconds after which it is abandoned: it is known by then that blocks are small.
TIMING_LIMIT_S = 5.0

#: Most scenes of a batch.
MAX_BATCH = 1536

#: By how much a batch may exceed the one before: a few scenes may cost far more than the others.
GROWTH = 8

#: Assumed cost of a scene if the measurement crashes or raises.
UNMEASURED_S = 0.01


class Timing(NamedTuple):
    """The cost of a scene.

    Attributes
    ----------
    pose_s
        Mean seconds a scene, all configurations included.
    sampled
        Scenes that were timed.
    over
        Whether these took too long and were abandoned: a scene takes about ``pose_s`` or more.
    """

    pose_s: float
    sampled: int
    over: bool = False


def seconds_of(pipeline: Pipeline, count: int) -> tuple[float, int]:
    """Return the seconds of a random sample of about ``count`` scenes, and their number.

    Of photographs, all markers of one. Seconds are those of this thread, since others use the
    processors meanwhile, and compilation does not count.
    """
    generator, scenes = np.random.Generator(np.random.PCG64(count)), pipeline.experiment.all_scenes
    if pipeline.shows_photographs:
        photographs = _photographs(pipeline)
        indices = photographs[int(generator.integers(0, len(photographs)))].indices()
    else:
        indices = scenes.indices(generator.integers(0, len(scenes), count))
    begun, compiled = time.thread_time(), compilation_s()
    run_cells(pipeline.experiment, indices)
    took_s = time.thread_time() - begun - (compilation_s() - compiled)
    return max(took_s, 1e-9), len(indices[0]) if indices else 1


def _photographs(pipeline: Pipeline) -> Blocks:
    """Return blocks of one photograph, which is searched once, for all its markers."""
    axes = pipeline.experiment.scene_axes
    return Blocks(tuple(map(len, axes)), tuple(
        1 if axis.name == TRIAL or "photographs" in axis.columns else len(axis) for axis in axes))


def timed(pipeline: Pipeline) -> Timing:
    """Time a batch of scenes for about :data:`TIMING_S` seconds.

    One scene is computed first, so that code is compiled and caches are filled; batches grow until
    one takes as long.
    """
    seconds_of(pipeline, 1)
    count = 1
    while True:
        spent_s, sampled = seconds_of(pipeline, count)
        wanted = min(int(TIMING_S * sampled / spent_s), MAX_BATCH)
        if wanted <= 2 * count:
            return Timing(spent_s / sampled, sampled)
        count = min(wanted, GROWTH * count)


def measure(child: Child, pipeline: Pipeline) -> Timing:
    """Time a batch of scenes in a child process, which ends if that takes too long.

    If a scene crashes or raises, or this machine is at fault, a cost is assumed: whether machines
    are is seen by their blocks.
    """
    try:
        return child.call(timed, pipeline, limit_s=TIMING_LIMIT_S)
    except (ChildError, MachineFaultError) as error:
        over = isinstance(error, ChildError) and error.timed_out
        return Timing(TIMING_LIMIT_S, 1, over=True) if over else Timing(UNMEASURED_S, 0)


#: Work up to which a run needs one process: another takes a second to import its packages.
SMALL_RUN_S = 3.0


def process_count(
    pipeline: Pipeline, timing: Timing, workers: int | None, left: float = 1.0
) -> int:
    """Return how many processes of this machine compute a run: as asked, else by its work.

    ``left``: the share of the work that has not been done.
    """
    small = timing.sampled and left * pipeline.size(Stage.scene) * timing.pose_s < SMALL_RUN_S
    return workers or (1 if small else default_workers())


# --------------------------------------------------------------------------------------------------
# The blocks of a run: about two seconds of work each.

#: Work in a block of most runs: a lost block costs its work.
BLOCK_S = 2.0

MIN_BLOCK_S = 0.1

#: Least work in a block of a run in waves, if all its scenes are needed: soon few of them are.
WAVE_BLOCK_S = 0.5

#: Blocks that all workers together finish in a second: a scheduler does about 180 of them, so that
#: larger clusters get larger blocks.
BLOCKS_PER_S = 75

#: Blocks of a run, of about 25 files each: longer runs get larger blocks.
MAX_BLOCKS = 100_000

#: Share of a block's time limit that its work is to take: scenes may cost more than was measured. A
#: time limit that the user gives bounds the work; else the work raises the limit.
MAX_BLOCK_SHARE = 1 / 10

#: With little work, blocks are cut smaller so that every worker has some until the end.
BLOCKS_PER_WORKER = 6

MAX_BLOCK_BYTES = 256_000_000
MAX_BLOCK_SCENES = 200_000

#: By how much blocks are made larger until there are few enough.
LARGER = 1.2


def block_work_s(total_s: float, workers: int) -> float:
    """Return the seconds of work in a block of a run that takes ``total_s`` of one worker.

    About 2; more for large clusters and for long runs; less if there is little to do.
    """
    wanted = max(BLOCK_S, workers / BLOCKS_PER_S, total_s / MAX_BLOCKS)
    return min(wanted, max(MIN_BLOCK_S, total_s / (workers * BLOCKS_PER_WORKER)))


def block_time_limit_s(time_limit_s: float | None, work_s: float) -> float:
    """Return the timeout of blocks of ``work_s``: the user's if there is one, else 600 s or more.

    >>> block_time_limit_s(None, 2.0), block_time_limit_s(None, 500.0), block_time_limit_s(40, 2.0)
    (600.0, 5000.0, 40)
    """
    return max(TIME_LIMIT_S, work_s / MAX_BLOCK_SHARE) if time_limit_s is None else time_limit_s


def blocks_of(
    pipeline: Pipeline, pose_s: float, workers: int, time_limit_s: float | None = None
) -> Blocks:
    """Return the blocks of a run.

    Trials are cut first, then the first axis of the file, so that all blocks have the same
    conditions, and about the same cost, as far as possible.

    Parameters
    ----------
    pipeline
        The grid.
    pose_s
        Seconds that a scene takes.
    workers
        Threads that share the work.
    time_limit_s
        Block timeout in seconds, if the user gave one: a block takes a small share of it.
    """
    if pipeline.shows_photographs:
        return _photographs(pipeline)
    axes, rule = pipeline.experiment.scene_axes, make_rule(pipeline)
    total_s = pipeline.size(Stage.scene) * pose_s
    if rule is not None:
        # Writing a block costs as much if few of its scenes are needed.
        total_s = max(total_s * least_share(rule), WAVE_BLOCK_S * BLOCKS_PER_WORKER)
    most = max(min(MAX_BLOCK_SCENES, MAX_BLOCK_BYTES // pipeline.experiment.bytes_of(1)), 1)
    if time_limit_s is not None:
        most = min(most, max(int(max(BLOCK_S, MAX_BLOCK_SHARE * time_limit_s) / pose_s), 1))
    target = min(max(int(block_work_s(total_s, workers) / pose_s), 1), most)
    while True:
        blocks = Blocks(tuple(map(len, axes)), _cut(axes, target, rule))
        # Blocks that fit into the axes are smaller than wanted, so that there may be more.
        if len(blocks) <= MAX_BLOCKS or target >= most:
            return blocks
        target = min(math.ceil(LARGER * target), most)


def _cut(axes: Sequence[Axis], target: int, rule: Stopping | None) -> tuple[int, ...]:
    """Return the extents of blocks of at most ``target`` scenes.

    With a rule, a block has the trials of a wave, or an equal part of them.
    """
    order = sorted(range(len(axes)), key=lambda k: (axes[k].name != TRIAL, k), reverse=True)
    extents = [1] * len(axes)
    if rule is not None:
        trial = order.pop()
        unit = rule.ends[0]
        extents[trial] = max(k for k in range(1, min(unit, target) + 1) if unit % k == 0)
        order.sort(key=lambda k: axes[k].name not in rule.coupled)
        if extents[trial] < unit:
            order = []
    for k in order:
        most = max(target // math.prod(extents), 1)
        # Equal parts rather than a short last one.
        extents[k] = -(-len(axes[k]) // -(-len(axes[k]) // most))
        if extents[k] < len(axes[k]):
            break
    return tuple(extents)


def least_share(rule: Stopping | None) -> float:
    """Return the share of the poses that is computed in any case: in waves, the first wave's."""
    return 1.0 if rule is None else rule.ends[0] / rule.ends[-1]


# --------------------------------------------------------------------------------------------------
# The forecast of a run: blocks, bytes, memory and time, and why it has to be confirmed.

#: Seconds of a run apart from its blocks: processes start and end, packages are imported.
START_S = 1.5

#: Seconds from which on a run has to be confirmed: a day.
MAX_S = 86_400.0


def forecast_of(
    url: str, pipeline: Pipeline, timing: Timing, blocks: Blocks, workers: int, left: int
) -> SimpleNamespace:
    """Return the expected cost of ``left`` of a run's blocks, waves or not.

    Returns
    -------
    ``files`` and ``bytes`` (before compression) that the run writes, the ``seconds`` that it takes,
    and ``objections``: why it has to be confirmed; none if it need not be.
    """
    poses = math.ceil(pipeline.size(Stage.scene) * left / max(len(blocks), 1))
    size = pipeline.experiment.bytes_of(poses)
    seconds = START_S + poses * timing.pose_s / min(workers, max(left, 1))
    objections, free = [], free_bytes(url)
    if seconds > MAX_S:
        about = "about" if pipeline.stopping is None else "up to"
        objections.append(f"takes {about} {seconds / MAX_S:.1f} days with {workers} "
                          f"worker{'s' if workers > 1 else ''}")
    if size > free:
        objections.append(f"writes {filesize.decimal(size)} before compression, and "
                          f"{filesize.decimal(int(free))} are free")
    files = left * (len(pipeline.experiment.variables) + 1)  # and a receipt
    return SimpleNamespace(files=files, bytes=size, seconds=seconds, objections=objections)


def free_bytes(url: str) -> float:
    """Return the bytes that are free on the disk of a local store; infinite if not known."""
    with contextlib.suppress(OSError):
        if not is_remote(url):
            path = Path(url).absolute()
            return shutil.disk_usage(
                next(each for each in (path, *path.parents) if each.exists())).free
    return math.inf
