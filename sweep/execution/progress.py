"""Progress of a run: blocks that wait, results counted, conditions settled."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import sys
import threading
import time
import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import numpy as np

from sweep.errors import ArgumentError, RunError
from sweep.execution.limits import MAX_FAILED_BLOCKS
from sweep.experiment.cell_selection import selection_text
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule, digest_of
from sweep.measure.flags import DetectionStatus
from sweep.messages import duration, notice
from sweep.sampling.rules import Decider, Decision, Stopping, Waves, condition_axes
from sweep.store.blocks import RunStore, committed, receipts
from sweep.store.lifecycle import open_dataset
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


ProgressReport = Callable[[Progress], None]


StageReport = Callable[[str, float], None]
"""Called with what is being done, and the share of it that is done."""


@contextlib.contextmanager
def stage_display() -> Iterator[StageReport]:
    """Show what is being done on stderr: a bar on a terminal, else a line for each new thing."""
    if _on_terminal():
        with _bar() as update:
            yield lambda what, share: update(what, share, 1.0, "")
        return
    printed: list[str] = []

    def report(what: str, _share: float) -> None:
        if printed[-1:] != [what]:
            printed.append(what)
            notice(what)

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
        with _lines(ends=ends) as display:
            yield display
        return
    with _bar() as update:
        def report(progress: Progress) -> None:
            if progress.conditions is None:
                count = f"{progress.done:,} of {progress.total:,} poses"
                update("running", progress.done, progress.total, count)
            else:
                update("running", progress.settled or 0, progress.conditions,
                       _of_conditions(progress))

        yield report


def _on_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()


@contextlib.contextmanager
def _bar() -> Iterator[Callable[[str, float, float, str], None]]:
    """Show a bar on stderr, which disappears at the end; update it by what, done, total, count."""
    from rich.console import Console  # noqa: PLC0415  (slow to import)
    from rich.progress import (  # noqa: PLC0415
        BarColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bar  # noqa: PLC0415

    console = Console(stderr=True)
    bar = Bar(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[count]}"),
        TimeElapsedColumn(), TimeRemainingColumn(), console=console,
        disable=not console.is_terminal, transient=True,
    )
    with bar:
        task = bar.add_task("starting", total=None, count="")

        def update(what: str, done: float, total: float, count: str) -> None:
            bar.update(task, description=what, completed=done, total=total, count=count)

        yield update


def _of_conditions(progress: Progress) -> str:
    """Return how far a run in waves is: how many poses it will need is not known."""
    return (
        f"{progress.settled:,} of {progress.conditions:,} conditions done, "
        f"{progress.needed:,} poses"
    )


@contextlib.contextmanager
def _lines(*, ends: bool) -> Iterator[ProgressReport]:
    """Print a line every :data:`LINE_INTERVAL_S`, also while no block is finished."""
    lines = ProgressLines(ends=ends)
    done = threading.Event()

    def print_lines() -> None:
        while not done.wait(LINE_INTERVAL_S):
            notice(lines.line(time.monotonic()))

    thread = threading.Thread(target=print_lines, daemon=True, name="progress")
    thread.start()
    try:
        yield lines
    finally:
        done.set()
        thread.join()


class ProgressLines:
    """How far a run is, in lines: poses, rate, and time left.

    The rate is that since the first report, which a run makes before its first block.

    Examples
    --------
    >>> lines = ProgressLines()
    >>> lines.report(Progress(1000, 5000, 0), now=0.0)
    >>> lines.line(now=5.0)
    '1,000 of 5,000 poses'
    >>> lines.report(Progress(2000, 5000, 0), now=10.0)
    >>> lines.line(now=10.0)
    '2,000 of 5,000 poses (40 %), 100 poses/s, 30.0 s left'
    """

    def __init__(self, *, ends: bool = False) -> None:
        self._ends = ends
        self._first: tuple[float, int] | None = None
        self._last: Progress | None = None

    def __call__(self, progress: Progress) -> None:
        """Take a run's progress; with ``ends``, print the first and the last."""
        first = self._last is None
        self.report(progress, time.monotonic())
        if self._ends and (first or progress.done == progress.total):
            notice(_of_conditions(progress) if progress.conditions is not None
                   else f"{progress.done:,} of {progress.total:,} poses")

    def report(self, progress: Progress, now: float) -> None:
        """Take a run's progress at a time in seconds."""
        self._first = self._first or (now, _computed(progress))
        self._last = progress

    def line(self, now: float) -> str:
        """Return the line at a time in seconds."""
        if self._first is None or self._last is None:
            return "starting"
        started, before = self._first
        progress = self._last
        whole = progress.conditions is None
        line = f"{progress.done:,} of {progress.total:,} poses" if whole else (
            _of_conditions(progress))
        computed = _computed(progress) - before
        if not computed or now <= started:
            return line
        rate = computed / (now - started)
        if not whole:  # how many are needed is not known
            return f"{line}, {_rate(rate)}"
        left = duration((progress.total - progress.done) / rate)
        share = progress.done / progress.total
        return f"{line} ({100 * share:.0f} %), {_rate(rate)}, {left} left"


def _computed(progress: Progress) -> int:
    """Return how many poses were computed."""
    return progress.done if progress.needed is None else progress.needed


def _rate(rate: float) -> str:
    return f"{rate:,.0f} poses/s" if rate >= 10 else f"{rate:.2g} poses/s"


# --------------------------------------------------------------------------------------------------
# Which blocks can be computed now: all of them, or those whose earlier waves are committed.

SETTLED_AT_ONCE = 64
"""Blocks of which nothing is needed that one task writes."""


@dataclass(frozen=True, slots=True)
class Work:
    """What one task does: blocks by their numbers, and what their needed scenes follow from.

    Without a decision, all scenes are computed.
    """

    numbers: tuple[int, ...]
    decision: Decision | None = None


class Waiting(Protocol):
    """The blocks that wait to be computed."""

    def next(self) -> Work | None:
        """Return what can be computed now; None if nothing can, before more is committed."""

    def put_back(self, work: Work) -> None:
        """Take back what `next` returned and nobody began."""

    def committed(self, number: int, receipt: Receipt) -> None:
        """Note that a block is committed."""


class AnyOrder:
    """Blocks that do not depend on each other, in the order of their numbers."""

    def __init__(self, numbers: Iterable[int]) -> None:
        self._works: Iterator[Work] = (Work((number,)) for number in numbers)

    def next(self) -> Work | None:
        """Return the next block."""
        return next(self._works, None)

    def put_back(self, work: Work) -> None:
        """Return it next."""
        self._works = itertools.chain([work], self._works)

    def committed(self, number: int, receipt: Receipt) -> None:
        """Nothing follows from it."""


@dataclass(slots=True)
class _Known:
    """What is kept of a committed block's receipt."""

    basis: int | None
    content: int
    needed: int
    scenes: int


@dataclass(slots=True)
class _Group:
    """How far a group is.

    Attributes
    ----------
    wave
        The wave that is computed.
    bases
        For each wave from 1 to ``wave`` what it follows from.
    settled
        Whether nothing was needed in the wave before.
    share
        Of the scenes of the wave before, those that were needed.
    pending
        Blocks of the wave (if it is settled, of all that is left) that are not committed yet.
    """

    wave: int = 0
    bases: tuple[int, ...] = ()
    settled: bool = False
    share: float = 1.0
    pending: set[int] = field(default_factory=set)


class InWaves:
    """Blocks in waves: those of a group's next wave wait for all of the one before.

    A block is computed again if it was committed on another basis: under another rule, or on
    results that were computed again since.

    Parameters
    ----------
    store
        The store; its committed blocks are read.
    rule, sampling
        What the pipeline's section says, and the rule that samples by it.
    only
        The blocks that may be computed; all by default.
    """

    def __init__(
        self, store: RunStore, rule: StoppingRule, sampling: Stopping, *,
        only: AbstractSet[int] | None = None,
    ) -> None:
        self._rule = rule
        self._waves = Waves.of(store.pipeline, sampling, store.blocks)
        self._names = sorted({"detection", *sampling.variables})
        self._first = zlib.crc32(digest_of(rule).encode())
        self._only = only
        self._known: dict[int, _Known] = {}
        self._ready: deque[Work] = deque()
        self._groups: dict[int, _Group] = {}
        self.current: set[int] = set()
        """Numbers of the blocks that were committed on the basis that they have now."""
        self.cells = math.prod(
            length for k, length in enumerate(store.blocks.lengths) if k != self._waves.trial
        )
        """Scenes of the grid, not counting trials: conditions, and the cells that each pools."""
        self._settled_in: dict[int, int] = {}
        for number, receipt in receipts(store, committed(store)):
            self._note(number, receipt)
        begun = {self._waves.group(number) for number in self._known}
        for group in sorted(begun):
            self._groups[group] = _Group()
            self._advance(group)
        self._fresh = (group for group in range(self._waves.groups) if group not in begun)

    @property
    def settled(self) -> int:
        """How many of ``cells`` need no more trials, or have them all."""
        return sum(self._settled_in.values())

    def next(self) -> Work | None:
        """Return what can be computed now: groups that are not begun first, so that all go on."""
        while not self._ready:
            group = next(self._fresh, None)
            if group is None:
                return None
            self._groups[group] = _Group()
            self._advance(group)
        return self._ready.popleft()

    def put_back(self, work: Work) -> None:
        """Return it next."""
        self._ready.appendleft(work)

    def committed(self, number: int, receipt: Receipt) -> None:
        """Note a committed block; the last one of a wave makes the next wave ready."""
        self._note(number, receipt)
        group = self._waves.group(number)
        state = self._groups[group]
        state.pending.discard(number)
        if not state.pending:
            self._advance(group)

    def _note(self, number: int, receipt: Receipt) -> None:
        content = zlib.crc32(json.dumps(
            [number, *(receipt.checksums.get(name, 0) for name in self._names)]
        ).encode())
        self._known[number] = _Known(
            receipt.basis, content, receipt.scenes_needed, receipt.scenes
        )

    def _advance(self, group: int) -> None:
        """Make the first wave ready of which blocks are not committed as they are to be."""
        state, waves = self._groups[group], self._waves
        last = len(waves.ends) - 1
        while True:
            stop = last if state.settled else state.wave
            basis = state.bases[-1] if state.bases else None
            numbers = list(waves.numbers(group, state.wave, stop))
            waiting = [
                number for number in numbers
                if number not in self._known or self._known[number].basis != basis
            ]
            self.current.update(set(numbers).difference(waiting))
            chosen = [
                number for number in waiting
                if self._only is None or number in self._only or number in self._known
            ]
            state.pending = set(waiting)
            self._ready.extend(self._works(state, chosen))
            if waiting:
                return
            found = [self._known.pop(number) for number in numbers]
            scenes, needed = sum(e.scenes for e in found), sum(e.needed for e in found)
            if stop == last:
                self._count_settled(group, scenes, scenes)
                del self._groups[group]
                return
            self._count_settled(group, scenes - needed, scenes)
            text = json.dumps([state.bases[-1] if state.bases else self._first,
                               *(each.content for each in found)])
            state.bases = (*state.bases, zlib.crc32(text.encode()))
            state.settled = state.wave > 0 and needed == 0
            state.share = needed / scenes
            state.wave += 1

    def _count_settled(self, group: int, settled: int, scenes: int) -> None:
        """Count the cells of a group that are settled, from their share of a wave's scenes."""
        cells = self.cells_of(group)
        self._settled_in[group] = cells * settled // scenes if scenes else cells

    def cells_of(self, group: int) -> int:
        """Return how many scenes a group has, not counting trials."""
        first = next(self._waves.numbers(group, 0))
        span = self._waves.span(self._waves.blocks[first])
        return len(span) // self._waves.blocks.lengths[self._waves.trial]

    def _works(self, state: _Group, numbers: list[int]) -> Iterator[Work]:
        if not state.bases:
            yield from (Work((number,)) for number in numbers)
            return
        decision = Decision(self._rule, state.wave, state.bases, state.settled)
        size = SETTLED_AT_ONCE
        if not state.settled:
            # As much work as in a block of which all is needed, if few scenes are.
            size = min(max(int(1 / max(state.share, 1e-9)), 1), SETTLED_AT_ONCE)
        for at in range(0, len(numbers), size):
            yield Work(tuple(numbers[at : at + size]), decision)


# --------------------------------------------------------------------------------------------------
# What a run in waves came to: poses that were needed, and conditions that are not settled.

MAX_LISTED = 1000
"""Conditions that are recorded by name."""

MAX_REACHED = 3
"""Conditions of which is recorded what was reached."""


@dataclass(frozen=True, slots=True)
class SampledConditions:
    """The conditions of a finished run in waves.

    Attributes
    ----------
    needed
        Poses that were needed; those that were not are the rest of the grid.
    conditions
        How many there are.
    unsettled
        How many of them would need more than ``max_trials``.
    at
        The first of these, as ``--at`` takes them.
    reached
        Of the first of them, what was reached: the quantity that is farthest from what was wanted.
    """

    needed: int
    conditions: int
    unsettled: int
    at: list[str]
    reached: list[str]

    def to_json(self) -> dict[str, Any]:
        """Return what a store records."""
        return asdict(self)


def conditions_of(pipeline: Pipeline) -> tuple[str, ...]:
    """Return the names of the axes of which every combination of values is a condition."""
    per = getattr(pipeline.stopping, "per", None)
    return tuple(axis.name for axis in condition_axes(pipeline) if per is None or axis.name in per)


def condition_count(pipeline: Pipeline) -> int:
    """Return the number of conditions."""
    names = conditions_of(pipeline)
    return math.prod(len(axis) for axis in condition_axes(pipeline) if axis.name in names)


def sampled_conditions(store: RunStore, needed: Mapping[int, int]) -> SampledConditions | None:
    """Return what a complete store in waves came to; None for one of fixed trials.

    Parameters
    ----------
    store
        A store of which every block is committed.
    needed
        Block -> how many of its scenes were needed.
    """
    pipeline, rule = store.pipeline, store.pipeline.stopping
    if rule is None:
        return None
    decider = Decider.of(store, rule)
    waves, axes, kept = decider.waves, condition_axes(pipeline), conditions_of(pipeline)
    last = len(waves.ends) - 1
    count = 0
    listed: list[str] = []
    first: list[dict[str, int]] = []
    for group in range(waves.groups):
        numbers = list(waves.numbers(group, last))
        if not any(needed[number] for number in numbers):
            continue
        span = waves.span(store.blocks[numbers[0]])
        mask = decider.of_group(span, Decision(rule, last + 1, tuple(range(last + 1))))
        pooled = tuple(k for k, axis in enumerate(axes) if axis.name not in kept)
        mask = np.asarray(mask.any(axis=pooled, keepdims=True))
        count += int(mask.sum())
        starts = [span.starts[k] for k in range(len(span.starts)) if k != waves.trial]
        first += [
            {axis.name: start + k for axis, start, k in zip(axes, starts, index, strict=True)
             if axis.name in kept}
            for index in np.argwhere(mask)[: MAX_REACHED - len(first)].tolist()
        ]
        listed += [
            selection_text({
                axis.name: axis.values[start + k]
                for axis, start, k in zip(axes, starts, index, strict=True) if axis.name in kept
            })
            for index in np.argwhere(mask)[: MAX_LISTED - len(listed)].tolist()
        ]
    return SampledConditions(
        sum(needed.values()), condition_count(pipeline), count, listed,
        [_reached(store, index) for index in first],
    )


def _reached(store: RunStore, index: Mapping[str, int]) -> str:
    """Return what was reached at a condition, of the quantity that is farthest from its wish."""
    rule = store.pipeline.stopping
    if rule is None or not rule.precision:
        return ""
    from sweep.analysis.decisions import (  # noqa: PLC0415  (SciPy: only where conditions are told)
        Reached,
        precision_reached,
    )

    results = open_dataset(store.url).isel({name: [k] for name, k in index.items()})
    table = precision_reached(results)
    short = (table["half_width"] / table["wanted"]).where(
        table["reached"] == Reached.not_reached, -np.inf).fillna(np.inf)
    worst = table.isel(short.argmax(...))
    return (
        f"{worst['quantity'].item()} {worst['value'].item():.4g}, half-width "
        f"{worst['half_width'].item():.3g} of {worst['wanted'].item():g} wanted"
    )


# --------------------------------------------------------------------------------------------------
# What a run has done so far: its progress, counts of what was computed, failures by kind.

class Tally:
    """Counts the receipts of a run and the blocks that failed; reports progress.

    Parameters
    ----------
    store
        The store that is written.
    report
        Called with the progress after each block.
    """

    def __init__(self, store: RunStore, report: ProgressReport | None = None) -> None:
        self._store = store
        self._report = report
        self._progress = Progress(0, store.pipeline.size(Stage.scene), 0)
        self._waves: InWaves | None = None
        self._conditions = 0
        self._failures = Counter({"failed": 0, "crashed": 0})
        self._failed_blocks: list[str] = []
        self._machine_faults = 0
        self.computed: Counter[str] = Counter()
        """Blocks, scenes, detections and estimates that were computed and not reused."""

    def watch(self, waves: InWaves) -> None:
        """Report progress by conditions that are settled."""
        self._waves, self._conditions = waves, condition_count(self._store.pipeline)
        self._progress = dataclasses.replace(self._progress, needed=0)

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

    def add(self, receipt: Receipt) -> None:
        """Count a block that was committed now."""
        self.computed.update({"blocks": 1, **receipt.computed})
        self._count(receipt)
        self._notify()

    def add_failed(self, reason: str, *, machine_fault: bool = False) -> None:
        """Note why a block failed: by a machine's fault, or because it raises."""
        self._failed_blocks.append(reason)
        self._machine_faults += machine_fault

    @property
    def hopeless(self) -> bool:
        """Whether so many blocks failed that no more are tried."""
        return len(self._failed_blocks) >= MAX_FAILED_BLOCKS

    def quota(self) -> Mapping[str, int]:
        """Return how many failures of each kind another receipt may list."""
        return {kind: max(MAX_ROWS - count, 0) for kind, count in self._failures.items()}

    def check(self) -> None:
        """Raise RunError if blocks failed: of one line if faults of machines are all there is."""
        count = len(self._failed_blocks)
        if count and count == self._machine_faults:
            more = f", and {count - 1} blocks more likewise" if count > 1 else ""
            raise RunError(f"{self._store.url}: {self._failed_blocks[0]}{more}")
        if self._failed_blocks:
            raise RunError(
                f"{self._store.url}: {len(self._failed_blocks)} blocks failed\n"
                + "\n".join(f"  {reason}" for reason in self._failed_blocks)
            )

    def _count(self, receipt: Receipt) -> None:
        self._failures.update(failure.kind for failure in receipt.failures)
        counts, detected = receipt.detection, DetectionStatus.detected
        needed = self._progress.needed
        self._progress = Progress(
            self._progress.done + receipt.scenes, self._progress.total,
            self._progress.detected + (counts[detected] if len(counts) > detected else 0),
            None if needed is None else needed + receipt.scenes_needed,
        )

    def _notify(self) -> None:
        if self._report is None:
            return
        if self._waves is not None:
            share = self._waves.settled / self._waves.cells
            self._progress = dataclasses.replace(
                self._progress, settled=int(share * self._conditions), conditions=self._conditions
            )
        self._report(self._progress)
