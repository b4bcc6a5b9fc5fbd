"""The state of a store's run, its end, its retry, and the summary of a finished one."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.evaluation.block import bound_notes
from sweep.execution.waves import InWaves, condition_count, unsettled_count
from sweep.experiment.grid import Axis
from sweep.experiment.parameters import Stage
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flag, looked_for
from sweep.processor import differing_processors
from sweep.store.blocks import (
    RunStore,
    check_not_replaced,
    check_whole,
    committed,
    drop_block,
    receipts,
)
from sweep.store.lifecycle import finish, open_store, reopen
from sweep.store.lock import changing, is_written
from sweep.store.outcome import (
    MAX_ROWS,
    Outcome,
    failure_table,
    first_cell,
    outcome_of,
    outcome_of_finished,
)
from sweep.store.receipt import FailedCell, Receipt

if TYPE_CHECKING:
    import xarray as xr


# --------------------------------------------------------------------------------------------------
# What the receipts of a store add up to.

@dataclass(slots=True)
class Totals:
    """Receipts, added up.

    Attributes
    ----------
    blocks
        Number and receipt of each; without its failures, of which all are not kept in memory.
    scenes, needed
        Scenes of the blocks, and those of them that were needed.
    detection, estimate
        Counts of cells; the flag is the index.
    processors
        Blocks by the features of the processors that computed them.
    cells
        Failed and crashed cells, at most 1,000 of each kind.
    """

    blocks: list[tuple[int, Receipt]] = field(default_factory=list)
    scenes: int = 0
    needed: int = 0
    detection: list[int] = field(default_factory=lambda: [0] * len(DetectionStatus))
    estimate: list[int] = field(default_factory=lambda: [0] * len(EstimateStatus))
    processors: Counter[str] = field(default_factory=Counter)
    cells: dict[str, list[FailedCell]] = field(
        default_factory=lambda: {"failed": [], "crashed": []})

    @staticmethod
    def of(store: RunStore, numbers: Iterable[int]) -> Totals:
        """Add up the receipts of some committed blocks; StoreError if one is damaged."""
        totals = Totals()
        for number, receipt in receipts(store, numbers):
            totals.blocks.append((number, dataclasses.replace(
                receipt, failures=(), checksums={}, detection=[], estimate=[])))
            totals.scenes += receipt.scenes
            totals.needed += receipt.scenes_needed
            totals.processors.update(receipt.processors)
            for counts, added in (
                (totals.detection, receipt.detection), (totals.estimate, receipt.estimate),
            ):
                for flag, count in enumerate(added):
                    counts[flag] += count
            for cell in receipt.failures:
                if len(totals.cells[cell.kind]) < MAX_ROWS:
                    totals.cells[cell.kind].append(cell)
        return totals


# --------------------------------------------------------------------------------------------------
# Closing a complete store: tables of costs and failures, and counts of flags.

def close(store: RunStore) -> None:
    """Close a store of which every block is committed.

    Its receipts are summed up in the groups ``cost`` and ``failures``, which may be empty; then it
    is marked finished.

    Raises
    ------
    StoreError
        If a receipt is damaged, a chunk is missing, or the store cannot be written.
    """
    check_not_replaced(store)
    totals = Totals.of(store, check_whole(store, finished=True))
    counts: dict[str, Any] = {
        "detection": totals.detection, "estimate": totals.estimate,
        "processors": dict(totals.processors),
    }
    if store.pipeline.stopping is not None:
        counts["sampled"] = {
            "needed": totals.needed, "conditions": condition_count(store.pipeline),
            "unsettled": unsettled_count(store),
        }
    failures = failure_table(
        [*totals.cells["failed"], *totals.cells["crashed"]],
        lost(totals.detection, totals.estimate))
    costs = [(number, receipt.seconds) for number, receipt in totals.blocks
             if receipt.seconds["scene"]]
    finish(store, {"cost": _cost(store, costs), "failures": failures}, counts)


def lost(detection: list[int], estimate: list[int]) -> dict[str, int]:
    """Return how many cells failed and crashed, from counts by flag.

    Parameters
    ----------
    detection, estimate
        Counts of cells; the flag is the index.
    """
    def count(flags: list[int], flag: int) -> int:
        return flags[flag] if len(flags) > flag else 0

    return {
        kind: count(detection, DetectionStatus[kind]) + count(estimate, EstimateStatus[kind])
        for kind in ("crashed", "failed")
    }


def _cost(
    store: RunStore, blocks: Sequence[tuple[int, Mapping[str, Sequence[float]]]]
) -> xr.Dataset:
    """Return the cost group: seconds of each block per stage and configuration."""
    import xarray as xr  # noqa: PLC0415  (slow to import, and often not needed)

    pipeline = store.pipeline
    settings = list(pipeline.axes_of(Stage.detection))
    both = [*settings, *pipeline.axes_of(Stage.estimation)]

    def shaped(values: list[Any], axes: list[Axis]) -> Any:
        return np.asarray(values, dtype=np.float64).reshape(
            (len(blocks), *(len(axis) for axis in axes))
        )

    return xr.Dataset(
        {
            "scene_s": (("block",), shaped([s["scene"][0] for _, s in blocks], [])),
            "detection_s": (
                ("block", *(axis.name for axis in settings)),
                shaped([s["detection"] for _, s in blocks], settings),
            ),
            "estimation_s": (
                ("block", *(axis.name for axis in both)),
                shaped([s["estimation"] for _, s in blocks], both),
            ),
        },
        coords={
            "block": [number for number, _ in blocks],
            **{axis.name: axis.coordinates().astype(object)
               if axis.coordinates().dtype.kind == "T" else axis.coordinates() for axis in both},
        },
        attrs={"long_name": "seconds per stage and treatment for each block"},
    )


# --------------------------------------------------------------------------------------------------
# Failed cells, tried again: the blocks that hold them are computed as if they never had been.

@dataclass(frozen=True, slots=True)
class Retry:
    """Blocks that are computed again.

    Attributes
    ----------
    blocks
        Their numbers.
    cells
        How many of their cells had failed or crashed.
    """

    blocks: tuple[int, ...] = ()
    cells: int = 0

    def recovered(self, store: RunStore) -> int:
        """Return how many of the cells neither failed nor crashed again."""
        return self.cells - sum(_lost(receipt) for _, receipt in receipts(store, self.blocks))


def failed_blocks(store: RunStore) -> dict[int, int]:
    """Return the committed blocks in which cells failed or crashed, and how many did.

    Raises
    ------
    StoreError
        If a receipt is damaged.
    """
    return {
        number: count for number, receipt in receipts(store, committed(store))
        if (count := _lost(receipt))
    }


def drop_failed(store: RunStore) -> tuple[RunStore, Retry]:
    """Drop the committed blocks in which cells failed or crashed, so that a run computes them.

    A finished store is marked unfinished before. A kill at any instant leaves a store that another
    run continues: a block is either as it was, or computed anew as a whole.

    Returns
    -------
    The store as it is then, and what was dropped.

    Raises
    ------
    StoreError
        If a receipt is damaged, another process writes the store, or it cannot be written.
    """
    with changing(store.url, store.storage):
        failed = failed_blocks(store)
        if failed:
            if store.finished:
                reopen(store)
            for number in failed:
                drop_block(store, store.blocks[number])
    if not failed:
        return store, Retry()
    return open_store(store.url, "r+"), Retry(tuple(failed), sum(failed.values()))


def _lost(receipt: Receipt) -> int:
    return sum(lost(list(receipt.detection), list(receipt.estimate)).values())


# --------------------------------------------------------------------------------------------------
# What a run did, in one record.

@dataclass(frozen=True, slots=True, kw_only=True)
class Summary(Outcome):
    """What a run did; ``sweep run --json`` prints it.

    Attributes
    ----------
    store
        The store as it was given, or the default.
    data
        What ``xarray.open_zarr`` opens.
    poses
        Cells of the grid's scene axes.
    results
        Estimates: poses times detector settings times estimators.
    detected, looked_for
        Markers that were detected, of those that were looked for, over all detector settings: what
        is not visible, not modelled or not needed is not looked for.
    blocks
        Blocks of the store.
    computed_blocks, computed_scenes, computed_estimates
        What this run computed; the rest was committed before, or reused from other stores.
    seconds
        Duration of this run.
    crashed, failed
        Cells that are flagged so.
    needed, conditions, unsettled
        Of a run in waves, the poses that were needed, the conditions, and those of them that would
        need more than ``max_trials``; None of a run of fixed trials.
    retried, recovered
        Failed and crashed cells that were tried again, and those that did not fail again.
    """

    store: str
    data: str
    poses: int
    results: int
    detected: int
    looked_for: int
    blocks: int
    computed_blocks: int
    computed_scenes: int
    computed_estimates: int
    seconds: float
    crashed: int = 0
    failed: int = 0
    retried: int = 0
    recovered: int = 0
    needed: int | None = None
    conditions: int | None = None
    unsettled: int | None = None

    @property
    def detected_line(self) -> str:
        """Detections, of what was looked for, in words."""
        return f"detected {self.detected:,} of {self.looked_for:,} looked for"


def summary_of_complete(store: RunStore, started: float) -> Summary:
    """Return the summary of a run into a store that was finished before it began.

    Raises
    ------
    StoreError
        If blocks, or chunks of them, are missing.
    """
    check_whole(store)
    return summary_of(store, {}, time.perf_counter() - started)


def summary_of(
    store: RunStore, computed: Mapping[str, int], seconds: float, retry: Retry | None = None
) -> Summary:
    """Return the summary of a finished store from the counts that it recorded."""
    retry = retry or Retry()
    counts = store.run_metadata["counts"]
    missing = lost(counts["detection"], counts["estimate"])
    outcome = outcome_of_finished(store)
    sampled = counts.get("sampled") or {}
    return Summary(
        store=store.url,
        data=store.data_url,
        poses=store.pipeline.size(Stage.scene),
        results=math.prod(len(axis) for axis in store.pipeline.axes),
        detected=counts["detection"][DetectionStatus.detected],
        looked_for=looked_for(counts["detection"]),
        blocks=len(store.blocks),
        computed_blocks=computed.get("blocks", 0),
        computed_scenes=computed.get("scenes", 0),
        computed_estimates=computed.get("estimates", 0),
        seconds=round(seconds, 3),
        crashed=missing["crashed"],
        failed=missing["failed"],
        **_told(outcome, *bound_notes(store.pipeline), *_unsettled_lines(store, sampled)),
        retried=retry.cells,
        recovered=retry.recovered(store),
        needed=sampled.get("needed"),
        conditions=sampled.get("conditions"),
        unsettled=sampled.get("unsettled"),
    )


def _told(outcome: Outcome, *more: str) -> dict[str, Any]:
    """Return the fields of an outcome, with more warnings."""
    told = {each.name: getattr(outcome, each.name) for each in dataclasses.fields(outcome)}
    return told | {"failed_share": round(outcome.failed_share, 6),
                   "warnings": [*outcome.warnings, *more]}


def _unsettled_lines(store: RunStore, sampled: Mapping[str, Any]) -> list[str]:
    """Return a line on the conditions that would need more than ``max_trials``, if there are any.

    A search says itself what it does not know.
    """
    count, rule = sampled.get("unsettled"), store.pipeline.stopping
    if not count or rule is None or not rule.precision:
        return []
    of = f"{count:,} of {sampled['conditions']:,}"
    return [(f"warning: {of} conditions are not settled after all {rule.max_trials:,} trials; "
             "the report's table of precision names them")]


# --------------------------------------------------------------------------------------------------
# The status of a store: progress, counts of flags, rate, time left; also while it is written.

RATE_S = 60.0
"""Seconds over which the rate is measured, up to the last block that was written."""

RATE_BLOCKS = 10
"""At least so many times the longest block is measured: with many workers, blocks come in waves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Status(Outcome):
    """A store's status, from the receipts of its committed blocks.

    Attributes
    ----------
    store, title
        The store's URL; the pipeline's title or name.
    finished
        Whether every block is committed and the store is closed.
    being_written
        Whether a process writes it; on S3 also one that was killed less than two minutes ago.
    blocks, blocks_done, poses, poses_done
        Sizes of the grid, and how much of it is committed.
    detection, estimate
        Cells by flag; flags without cells are left out.
    looked_for
        Cells of the detection that count in its rates, as in `sweep.execution.status.Summary`.
    poses_per_s, seconds_left
        Rate over the last minute of work; time to the end at that rate. None if unknown, and of a
        store that nobody writes.
    crashed, failed
        Cells whose process died and cells that raised, at most 1,000 of each.
    needed, settled, conditions
        Of a run to a precision, how many of the committed poses were needed, and how many of the
        conditions need no more trials; None of a run of fixed trials.
    processors
        Blocks by the features of the processors that computed them: where there are several, the
        last digits of results differ from those of a uniform run.
    """

    store: str
    title: str
    finished: bool
    being_written: bool
    blocks: int
    blocks_done: int
    poses: int
    poses_done: int
    looked_for: int
    detection: dict[str, int]
    estimate: dict[str, int]
    poses_per_s: float | None
    seconds_left: float | None
    crashed: list[FailedCell]
    failed: list[FailedCell]
    needed: int | None = None
    settled: int | None = None
    conditions: int | None = None
    processors: dict[str, int] = field(default_factory=dict)


def status(url: str) -> Status:
    """Return the status of a store.

    Raises
    ------
    StoreError
        If there is no store, or it cannot be read.
    """
    store = open_store(url)
    totals = Totals.of(store, check_whole(store))
    poses = store.pipeline.size(Stage.scene)
    in_waves = store.pipeline.stopping is not None
    writing = not store.finished and is_written(store.storage)
    rate = poses_per_second([
        WrittenBlock(receipt.written, receipt.wall_s, receipt.scenes_needed)
        for _, receipt in totals.blocks])
    outcome = outcome_of(
        url, totals.detection, totals.estimate,
        [*totals.cells["failed"], *totals.cells["crashed"]], first_cell(store))
    return Status(
        store=url,
        title=store.pipeline.heading,
        finished=store.finished,
        being_written=writing,
        blocks=len(store.blocks),
        blocks_done=len(totals.blocks),
        poses=poses,
        poses_done=totals.scenes,
        looked_for=looked_for(totals.detection),
        detection=_by_flag(DetectionStatus, totals.detection),
        estimate=_by_flag(EstimateStatus, totals.estimate),
        poses_per_s=rate,
        seconds_left=(poses - totals.scenes) / rate if rate and writing and not in_waves else None,
        crashed=totals.cells["crashed"],
        failed=totals.cells["failed"],
        **_told(outcome, *differing_processors(totals.processors, "blocks"),
                *bound_notes(store.pipeline)),
        needed=totals.needed if in_waves else None,
        settled=_settled(store),
        conditions=condition_count(store.pipeline) if in_waves else None,
        processors=dict(totals.processors),
    )


def _by_flag(flags: type[Flag], counts: Sequence[int]) -> dict[str, int]:
    """Return counts of cells by the flags that occur."""
    return {flag.name: counts[flag] for flag in flags if counts[flag]}


def _settled(store: RunStore) -> int | None:
    """Return how many conditions need no more trials; None of a run of fixed trials."""
    if store.pipeline.stopping is None:
        return None
    count = condition_count(store.pipeline)
    if store.finished and (sampled := store.run_metadata["counts"].get("sampled")):
        return count - int(sampled["unsettled"])
    return int(InWaves(store).settled_share * count)


@dataclass(frozen=True, slots=True)
class WrittenBlock:
    """A committed block: when it was written (s since 1970), the seconds it took, its scenes."""

    at: float
    took_s: float
    scenes: int


def poses_per_second(blocks: Iterable[WrittenBlock]) -> float | None:
    """Return the rate at the last of some blocks, None if it is not known.

    Parameters
    ----------
    blocks
        Committed blocks, in any order.

    Examples
    --------
    >>> poses_per_second([WrittenBlock(at, 2.0, 100) for at in (12.0, 14.0, 9000.0, 9002.0)])
    50.0
    """
    written = list(blocks)
    if not written:
        return None
    last = max(block.at for block in written)
    recent = [block for block in written if block.at > last - RATE_S]
    window_s = max(RATE_S, RATE_BLOCKS * max(block.took_s for block in recent))
    recent = [block for block in written if block.at > last - window_s]
    begin = max(min(block.at - block.took_s for block in recent), last - window_s)
    return sum(block.scenes for block in recent) / (last - begin) if last > begin else None
