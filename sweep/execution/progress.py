"""How far a run is, while it runs: the event after each block, and its display on stderr."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from sweep.errors import ArgumentError

LINE_INTERVAL_S = 10.0
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
    """

    done: int
    total: int
    detected: int


ProgressReport = Callable[[Progress], None]


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
    elif sys.stderr.isatty():
        with progress_bar() as bar:
            yield bar
    else:
        yield _lines()


@contextlib.contextmanager
def progress_bar() -> Iterator[ProgressReport]:
    """Show a bar on stderr if that is a terminal; it disappears at the end."""
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
            bar.update(
                task, description="running", total=progress.total, completed=progress.done,
                count=f"{progress.done:,} of {progress.total:,} poses",
            )

        yield report


def _lines() -> ProgressReport:
    """Return a report that prints a line at most every :data:`LINE_INTERVAL_S`, and the last."""
    last = -LINE_INTERVAL_S

    def report(progress: Progress) -> None:
        nonlocal last
        now = time.monotonic()
        if now >= last + LINE_INTERVAL_S or progress.done == progress.total:
            last = now
            sys.stderr.write(f"{progress.done:,} of {progress.total:,} poses\n")
            sys.stderr.flush()

    return report
