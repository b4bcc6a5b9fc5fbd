"""What the rest of a run takes: its work, and what it has to be confirmed for."""

from __future__ import annotations

import math
import statistics
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING

from sweep.execution.affordability import (
    Demand,
    check_affordable,
    files_of,
    free_disk,
    objections,
)
from sweep.execution.calibration import Calibration
from sweep.execution.limits import BLOCK_S
from sweep.execution.pilot import pilot_in
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Blocks, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.schema import bytes_per_block
from sweep.sampling.rules import make_rule
from sweep.store.blocks import receipts
from sweep.store.run_store import RunStore

if TYPE_CHECKING:
    from distributed import Client

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
