"""The status of a store: progress, counts of flags, rate, time left; also while it is written."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plan.parameters import Stage
from sweep.store.blocks import committed, receipts
from sweep.store.failures import MAX_ROWS, FailedCell, failed_cells
from sweep.store.lifecycle import open_store
from sweep.store.lock import holder

RATE_BLOCKS = 50
"""The rate is measured over this many blocks, those written last."""


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
        Rate over the last blocks; time to the end if somebody writes. None if unknown.
    crashed, failed
        Cells whose process died and cells that raised, at most 1,000 of each.
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
    written: list[tuple[float, int]] = []
    cells: dict[str, list[FailedCell]] = {"crashed": [], "failed": []}
    done = poses = 0
    for number, receipt in receipts(store, committed(store)):
        done += 1
        poses += receipt.scenes
        for flags, counts, counter in (
            (DetectionStatus, receipt.detection, detection),
            (EstimateStatus, receipt.estimate, estimate),
        ):
            for flag, count in zip(flags, counts, strict=False):
                counter[flag.name] += count
        written.append((receipt.written, receipt.scenes))
        for cell in failed_cells(store, number, receipt):
            if len(cells[cell.kind]) < MAX_ROWS:
                cells[cell.kind].append(cell)
    total = store.pipeline.size(Stage.scene)
    writer = holder(store.storage)
    rate = _rate(written)
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
        seconds_left=(total - poses) / rate if rate and writer else None,
        **cells,
    )


def _rate(written: list[tuple[float, int]]) -> float | None:
    """Return poses per second over the last blocks, None if there are too few.

    ``written`` has the time at which each block was written, in seconds, and its scenes.
    """
    last = sorted(written)[-RATE_BLOCKS:]
    if len(last) < 2 or last[-1][0] <= last[0][0]:
        return None
    return sum(scenes for _, scenes in last[1:]) / (last[-1][0] - last[0][0])
