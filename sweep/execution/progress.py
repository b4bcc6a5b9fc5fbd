"""How far a run is, while it runs: the event after each block, and its display on stderr."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from sweep.errors import ArgumentError
from sweep.messages import duration, notice

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
    if sys.stderr is not None and sys.stderr.isatty():
        from rich.console import Console  # noqa: PLC0415  (slow to import)
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn  # noqa: PLC0415
        from rich.progress import Progress as Bar  # noqa: PLC0415

        bar = Bar(
            TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
            console=Console(stderr=True), transient=True,
        )
        with bar:
            task = bar.add_task("starting", total=1.0)
            yield lambda what, share: bar.update(task, description=what, completed=share)
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
    terminal = sys.stderr is not None and sys.stderr.isatty()
    with _bar() if terminal else _lines(ends=ends) as display:
        yield display


@contextlib.contextmanager
def _bar() -> Iterator[ProgressReport]:
    """Show a bar on stderr; it disappears at the end."""
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

        def report(progress: Progress) -> None:
            if progress.conditions is not None:
                bar.update(
                    task, description="running", total=progress.conditions,
                    completed=progress.settled, count=_of_conditions(progress),
                )
                return
            bar.update(
                task, description="running", total=progress.total, completed=progress.done,
                count=f"{progress.done:,} of {progress.total:,} poses",
            )

        yield report


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
