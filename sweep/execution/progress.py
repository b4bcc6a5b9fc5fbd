"""Progress of a run: its display, and what is counted of blocks that were computed."""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

from sweep.errors import ArgumentError, RunError
from sweep.execution.executors import Failed
from sweep.execution.waves import AnyOrder, InWaves, Work, condition_count
from sweep.experiment.parameters import Stage
from sweep.measure.flags import DetectionStatus
from sweep.messages import notice
from sweep.store.blocks import RunStore, receipts
from sweep.store.outcome import MAX_ROWS
from sweep.store.receipt import Receipt

# --------------------------------------------------------------------------------------------------
# How far a run is, while it runs: the event after each block, and its display on stderr.

LINE_INTERVAL_S = 30.0
"""Seconds between two lines of progress where stderr is not a terminal."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is; passed to the caller before the first block and after each one.

    Attributes
    ----------
    done
        Poses that are committed, those of earlier runs into the store included.
    total
        Poses of the grid.
    detected
        Detections among those that are committed, over all detector settings.
    needed, settled, conditions
        Of a run in waves, how many of ``done`` were needed, and how many of the conditions are
        settled, or have all their trials; None of a run of fixed trials.
    """

    done: int
    total: int
    detected: int
    needed: int | None = None
    settled: int | None = None
    conditions: int | None = None

    @property
    def line(self) -> str:
        """In words; how many poses a run in waves will need is not known."""
        if self.conditions is None:
            return f"{self.done:,} of {self.total:,} poses"
        return f"{self.settled:,} of {self.conditions:,} conditions done, {self.needed:,} poses"


ProgressReport = Callable[[Progress], None]


StageReport = Callable[[str, float], None]
"""Called with what is being done, and the share of it that is done."""


@contextlib.contextmanager
def stage_display() -> Iterator[StageReport]:
    """Show what is being done on stderr: a bar on a terminal, else a line for each new thing."""
    printed: list[str] = []

    def report(what: str, _share: float) -> None:
        if printed[-1:] != [what]:
            printed.append(what)
            notice(what)

    if _on_terminal():
        with _bar() as update:
            yield lambda what, share: update(what, share, 1.0)
    else:
        yield report


@contextlib.contextmanager
def progress_report(progress: bool | ProgressReport | None) -> Iterator[ProgressReport | None]:
    """Return what is called with a run's progress.

    Parameters
    ----------
    progress
        True for a display on stderr: a bar on a terminal, lines elsewhere; None or False for
        nothing; a function is returned as it is.

    Raises
    ------
    ArgumentError
        If it is none of these.
    """
    if progress is None or progress is False:
        yield None
    elif progress is not True:
        if not callable(progress):
            raise ArgumentError("progress", progress, "expected True, False, None or a function")
        yield progress
    else:
        with progress_display(ends=True) as display:
            yield display


@contextlib.contextmanager
def progress_display(*, ends: bool = False) -> Iterator[ProgressReport]:
    """Show progress on stderr: a bar on a terminal, else a line every 30 s.

    ``ends``: with a line for the beginning and one for the end, however short the run is.
    """
    if not _on_terminal():
        yield ProgressLines(ends=ends)
        return
    with _bar() as update:
        def report(progress: Progress) -> None:
            if progress.conditions is None:
                update(progress.line, progress.done, progress.total)
            else:
                update(progress.line, progress.settled or 0, progress.conditions)

        yield report


def _on_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


@contextlib.contextmanager
def _bar() -> Iterator[Callable[[str, float, float], None]]:
    """Show a bar on stderr, which disappears at the end; update it by what, done, total."""
    from rich.console import Console  # noqa: PLC0415  (slow to import)
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bar  # noqa: PLC0415

    with Bar(
        TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        console=Console(stderr=True), transient=True,
    ) as bar:
        task = bar.add_task("starting", total=None)
        yield lambda what, done, total: bar.update(
            task, description=what, completed=done, total=total)


class ProgressLines:
    """Prints how far a run is every :data:`LINE_INTERVAL_S`; `sweep status` knows the rate.

    ``ends``: also the first and the last time.
    """

    def __init__(self, *, ends: bool = False) -> None:
        self._ends = ends
        self._printed: float | None = None

    def __call__(self, progress: Progress) -> None:
        """Print a line, if the last one was long ago."""
        now, first = time.monotonic(), self._printed is None
        due = self._ends and (first or progress.done == progress.total)
        due = due or (self._printed is not None and now > self._printed + LINE_INTERVAL_S)
        if due:
            notice(progress.line)
        if first or due:
            self._printed = now


# --------------------------------------------------------------------------------------------------
# What a run has done so far: its progress, counts of what was computed, failures by kind.

MAX_FAILED_BLOCKS = 10
"""Failed blocks after which a run ends."""


class Tally:
    """Counts the receipts of a run and the blocks that failed; reports progress.

    Parameters
    ----------
    store
        The store that is written.
    waiting
        Its blocks that wait: of a run in waves, they know how many conditions are settled.
    report
        Called with the progress after each block.
    """

    def __init__(
        self, store: RunStore, waiting: AnyOrder | InWaves, report: ProgressReport | None = None
    ) -> None:
        self._store, self._waiting, self._report = store, waiting, report
        self._done: Counter[str] = Counter()
        self._failures: Counter[str] = Counter()
        self._failed: list[tuple[str, bool]] = []
        self.computed: Counter[str] = Counter()
        """Blocks, scenes, detections and estimates that were computed and not reused."""

    def begin(self, done: AbstractSet[int]) -> None:
        """Count the blocks that are committed already.

        Raises
        ------
        StoreError
            If a receipt is damaged.
        """
        for _, receipt in receipts(self._store, done):
            self._count(receipt)
        self._notify()

    def add(self, work: Work, result: list[Receipt] | Failed) -> None:
        """Count what became of work.

        Raises
        ------
        RunError
            If so many blocks failed that no more are tried.
        """
        if isinstance(result, Failed):
            block = self._store.blocks[work.numbers[0]]
            self._failed.append((f"block {block}: {result.reason}", result.machine_fault))
            if len(self._failed) >= MAX_FAILED_BLOCKS:
                self.check()
            return
        for number, receipt in zip(work.numbers, result, strict=True):
            self._waiting.committed(number, receipt)
            self.computed.update({"blocks": 1, **receipt.computed})
            self._count(receipt)
            self._notify()

    def quota(self) -> Mapping[str, int]:
        """Return how many failures of each kind another receipt may list."""
        return {kind: max(MAX_ROWS - self._failures[kind], 0) for kind in ("failed", "crashed")}

    def check(self) -> None:
        """Raise RunError if blocks failed: of one line if faults of machines are all there is."""
        reasons = [reason for reason, _ in self._failed]
        if reasons and all(machine_fault for _, machine_fault in self._failed):
            more = f", and {len(reasons) - 1} blocks more likewise" if len(reasons) > 1 else ""
            raise RunError(f"{self._store.url}: {reasons[0]}{more}")
        if reasons:
            listed = "\n".join(f"  {reason}" for reason in reasons)
            raise RunError(f"{self._store.url}: {len(reasons)} blocks failed\n{listed}")

    def _count(self, receipt: Receipt) -> None:
        self._failures.update(failure.kind for failure in receipt.failures)
        detected = dict(enumerate(receipt.detection)).get(DetectionStatus.detected, 0)
        self._done.update(
            scenes=receipt.scenes, needed=receipt.scenes_needed, detected=detected)

    def _notify(self) -> None:
        if self._report is None:
            return
        waves: dict[str, Any] = {}
        if isinstance(self._waiting, InWaves):
            count = condition_count(self._store.pipeline)
            waves = {"needed": self._done["needed"], "conditions": count,
                     "settled": int(self._waiting.settled_share * count)}
        self._report(Progress(
            self._done["scenes"], self._store.pipeline.size(Stage.scene), self._done["detected"],
            **waves))
