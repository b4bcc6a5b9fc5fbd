"""What the rest of a run takes: its work, and what it has to be confirmed for."""

from __future__ import annotations

import math
import statistics
from collections.abc import Set as AbstractSet
from typing import TYPE_CHECKING

from sweep.execution.affordability import Demand, files_per_block
from sweep.execution.calibration import Calibration
from sweep.execution.limits import BLOCK_S
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Blocks, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.schema import bytes_per_block
from sweep.sampling.rules import make_rule
from sweep.store.blocks import receipts
from sweep.store.run_store import RunStore

if TYPE_CHECKING:
    from distributed import Client

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
    pipeline: Pipeline, calibration: Calibration, threads: int, extents: tuple[int, ...]
) -> Demand:
    """Return what a whole run takes, in blocks of ``extents``."""
    poses = pipeline.size(Stage.scene)
    blocks = len(Blocks(tuple(len(axis) for axis in scene_axes(pipeline)), extents))
    return Demand(
        poses * calibration.scene_s / threads, threads, bytes_per_block(pipeline, poses),
        blocks * files_per_block(pipeline),
    )


def demand_left(
    store: RunStore, done: AbstractSet[int], calibration: Calibration | None,
    client: Client | None,
) -> Demand:
    """Return what the blocks take that are not committed, those ``done``."""
    threads = thread_count_of(client)
    left = len(store.blocks) - len(done)
    poses = store.pipeline.size(Stage.scene) * left // max(len(store.blocks), 1)
    return Demand(
        left * block_s_of(store, done, calibration) / threads if done or calibration else 0.0,
        threads,
        bytes_per_block(store.pipeline, poses), left * files_per_block(store.pipeline),
    )


def block_s_of(
    store: RunStore, done: AbstractSet[int], calibration: Calibration | None = None
) -> float:
    """Return the mean seconds of some committed blocks; without any, what is expected of them."""
    some = sorted(done)[:SAMPLED_RECEIPTS]
    spent = [receipt.wall_s for _, receipt in receipts(store, some)]
    if spent:
        return statistics.fmean(spent)
    return BLOCK_S if calibration is None else len(store.blocks[0]) * calibration.scene_s
