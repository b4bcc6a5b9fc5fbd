"""The status of a store: progress, counts of flags, rate, time left; also while it is written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from sweep.execution.settled import condition_count
from sweep.execution.waiting import InWaves
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plan.parameters import Stage
from sweep.sampling.rules import make_rule
from sweep.store.blocks import committed, receipts
from sweep.store.failures import MAX_ROWS, FailedCell, failed_cells
from sweep.store.lifecycle import open_store
from sweep.store.lock import holder
from sweep.store.outcome import FailureGroup, first_cell, outcome_of
from sweep.store.run_store import RunStore

RATE_S = 60.0
"""Seconds over which the rate is measured, up to the last block that was written."""

RATE_BLOCKS = 10
"""At least so many times the longest block is measured: with many workers, blocks come in waves."""

RATE_RECEIPTS = 1000
"""Blocks of which the longest counts for that."""

PAUSE_S = 2.0
"""Seconds in which no block was computed: the run was stopped and continued in between."""


@dataclass(frozen=True, slots=True)
class Status:
    """A store's status, from the receipts of its committed blocks.

    Attributes
    ----------
    store, title
        The store's URL; the pipeline's title or name.
    finished
        Whether every block is committed and the store is closed.
    writer
        The process that holds the store's lock, None if nobody does.
    blocks, blocks_done, poses, poses_done
        Sizes of the grid, and how much of it is committed.
    detection, estimate
        Cells by flag; flags without cells are left out.
    poses_per_s, seconds_left
        Rate of the run that writes now, over its last minute; time to the end at that rate. Of a
        store that nobody writes, the rate of the last minute of work, and None. None if unknown.
    crashed, failed
        Cells whose process died and cells that raised, at most 1,000 of each.
    needed, settled, conditions
        Of a run to a precision, how many of the committed poses were needed, and how many of the
        conditions need no more trials; None of a run of fixed trials.
    nothing_computed, failed_share, failures, warnings, advice
        As `sweep.execution.summary.Summary` has them, of the committed blocks.
    """

    store: str
    title: str
    finished: bool
    writer: str | None
    blocks: int
    blocks_done: int
    poses: int
    poses_done: int
    detection: dict[str, int]
    estimate: dict[str, int]
    poses_per_s: float | None
    seconds_left: float | None
    crashed: list[FailedCell]
    failed: list[FailedCell]
    nothing_computed: bool
    failed_share: float
    failures: list[FailureGroup]
    warnings: list[str]
    advice: str
    needed: int | None = None
    settled: int | None = None
    conditions: int | None = None


def status(url: str) -> Status:
    """Return the status of a store.

    Raises
    ------
    StoreError
        If there is no store, or it cannot be read.
    """
    store = open_store(url)
    detection: Counter[str] = Counter()
    estimate: Counter[str] = Counter()
    written: list[WrittenBlock] = []
    cells: dict[str, list[FailedCell]] = {"crashed": [], "failed": []}
    done = poses = needed = 0
    for number, receipt in receipts(store, committed(store)):
        done += 1
        poses += receipt.scenes
        needed += receipt.scenes_needed
        for flags, counts, counter in (
            (DetectionStatus, receipt.detection, detection),
            (EstimateStatus, receipt.estimate, estimate),
        ):
            for flag, count in zip(flags, counts, strict=False):
                counter[flag.name] += count
        written.append(WrittenBlock(receipt.written, receipt.wall_s, receipt.scenes_needed))
        for cell in failed_cells(store, number, receipt):
            if len(cells[cell.kind]) < MAX_ROWS:
                cells[cell.kind].append(cell)
    total = store.pipeline.size(Stage.scene)
    writer = holder(store.storage)
    rate = poses_per_second(written, writer.get("since", 0.0) if writer else 0.0)
    outcome = outcome_of(
        url, [detection[flag.name] for flag in DetectionStatus],
        [estimate[flag.name] for flag in EstimateStatus],
        [*cells["failed"], *cells["crashed"]], first_cell(store),
    )
    return Status(
        store=url,
        title=store.pipeline.heading,
        finished=store.finished,
        writer=f"process {writer.get('pid')} on {writer.get('host')}" if writer else None,
        blocks=len(store.blocks),
        blocks_done=done,
        poses=total,
        poses_done=poses,
        detection={name: count for name, count in detection.items() if count},
        estimate={name: count for name, count in estimate.items() if count},
        poses_per_s=rate,
        seconds_left=(
            (total - poses) / rate if rate and writer and store.pipeline.stopping is None else None
        ),
        crashed=cells["crashed"],
        failed=cells["failed"],
        nothing_computed=outcome.nothing_computed,
        failed_share=round(outcome.failed_share, 6),
        failures=outcome.failures,
        warnings=outcome.warnings,
        advice=outcome.advice,
        needed=None if store.pipeline.stopping is None else needed,
        settled=_settled(store),
        conditions=None if store.pipeline.stopping is None else condition_count(store.pipeline),
    )


def _settled(store: RunStore) -> int | None:
    """Return how many conditions need no more trials; None of a run of fixed trials."""
    rule, sampling = store.pipeline.stopping, make_rule(store.pipeline)
    if rule is None or sampling is None:
        return None
    count = condition_count(store.pipeline)
    if store.finished and (sampled := store.run_metadata["counts"].get("sampled")):
        return count - int(sampled["unsettled"])
    waves = InWaves(store, rule, sampling)
    return int(waves.settled / waves.cells * count)


@dataclass(frozen=True, slots=True)
class WrittenBlock:
    """A committed block: when it was written (s since 1970), the seconds it took, its scenes."""

    at: float
    took_s: float
    scenes: int


def poses_per_second(blocks: Iterable[WrittenBlock], since: float = 0.0) -> float | None:
    """Return the rate at the last of some blocks, None if it is not known.

    Parameters
    ----------
    blocks
        Committed blocks, in any order.
    since
        When the run that writes took the store over (s since 1970); what was written before counts
        only where nothing was written since.

    Examples
    --------
    >>> poses_per_second([WrittenBlock(at, 2.0, 100) for at in (12.0, 14.0, 9000.0, 9002.0)])
    50.0
    """
    ordered = sorted(blocks, key=lambda block: -block.at)
    if not ordered or ordered[0].at < since:
        return None
    last = ordered[0].at
    window_s = max(RATE_S, RATE_BLOCKS * max(block.took_s for block in ordered[:RATE_RECEIPTS]))
    earliest = max(since, last - window_s)
    begin, scenes = last, 0
    for block in ordered:
        if block.at < max(earliest, begin - PAUSE_S):
            break
        begin = min(begin, block.at - block.took_s)
        scenes += block.scenes
    begin = max(begin, earliest)
    return scenes / (last - begin) if last > begin else None
