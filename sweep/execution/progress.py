"""What the caller of a run says and hears: the run's options, and its progress on stderr."""

from __future__ import annotations

import contextlib
import inspect
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, TypeVar, cast

from sweep.errors import ArgumentError
from sweep.messages import nearest, notice, plain

if TYPE_CHECKING:
    from distributed import Client
    from distributed.deploy.cluster import Cluster

# --------------------------------------------------------------------------------------------------
# How far a run is, while it runs: the event after each block, and its display on stderr.

#: Seconds between two lines of progress where stderr is not a terminal.
LINE_INTERVAL_S = 30.0


class Progress(NamedTuple):
    """How far a run is; passed to the caller before the first block and after each one.

    Attributes
    ----------
    done
        Poses that are committed, by earlier runs into the store, too.
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
    def shown(self) -> tuple[str, float]:
        """Progress in words, and the share that is done.

        How many poses a run in waves will need is not known.
        """
        if self.conditions is None:
            return f"{self.done:,} of {self.total:,} poses", self.done / self.total
        line = f"{self.settled:,} of {self.conditions:,} conditions done, {self.needed:,} poses"
        return line, (self.settled or 0) / self.conditions


ProgressReport = Callable[[Progress], None]

#: Called with the current step, and the share of it that is done.
StageReport = Callable[[str, float], None]


def progress_report(
    progress: bool | ProgressReport | None,
) -> contextlib.AbstractContextManager[ProgressReport | None]:
    """Return a context of the function that is called with a run's progress.

    Parameters
    ----------
    progress
        True for a display on stderr: a bar on a terminal, lines elsewhere; None or False for
        nothing; a function is called as it is.

    Raises
    ------
    ArgumentError
        If it is none of these.
    """
    if progress is True:
        return progress_display(ends=True)
    if progress and not callable(progress):
        raise ArgumentError("progress", progress, "expected True, False, None or a function")
    return contextlib.nullcontext(progress or None)


@contextlib.contextmanager
def progress_display(*, ends: bool = False) -> Iterator[ProgressReport]:
    """Show progress on stderr: a bar on a terminal, else a line every :data:`LINE_INTERVAL_S`.

    ``ends``: with a line for the beginning and one for the end, however short the run is.
    """
    with _display(LINE_INTERVAL_S, ends=ends) as show:
        yield lambda progress: show(*progress.shown)


def stage_display() -> contextlib.AbstractContextManager[StageReport]:
    """Show the current step on stderr: a bar on a terminal, else a line for each new step."""
    return _display(0.0, ends=True)


@contextlib.contextmanager
def _display(every_s: float, *, ends: bool) -> Iterator[StageReport]:
    """Show what is done, and which share of it, on stderr.

    On a terminal, that is a bar, which disappears at the end; elsewhere new lines ``every_s``, and
    with ``ends`` at once and at the end.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        told, told_s = "", -math.inf if ends else time.monotonic()

        def line(what: str, share: float) -> None:
            nonlocal told, told_s
            now = time.monotonic()
            if what != told and (now >= told_s + every_s or (ends and share == 1.0)):
                notice(what)
                told, told_s = what, now

        yield line
        return
    from rich import progress as rich  # noqa: PLC0415  (slow to import)
    from rich.console import Console  # noqa: PLC0415

    columns = (rich.TextColumn("{task.description}"), rich.BarColumn(), rich.TimeElapsedColumn(),
               rich.TimeRemainingColumn())
    with rich.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None)
        yield lambda what, share: bar.update(task, description=what, completed=share, total=1.0)


# --------------------------------------------------------------------------------------------------
# The options of a run, declared once for all functions that run a pipeline.

class RunOptions(TypedDict, total=False):
    """Options of a run that are not its pipeline and store; `sweep.run` says what they mean."""

    workers: int | None
    client: Client | Cluster | None
    scheduler: str | None
    reuse: Sequence[str | os.PathLike[str]]
    overwrite: bool
    retry_failed: bool
    yes: bool
    progress: bool | ProgressReport | None
    time_limit_s: float | None


#: The value of each option that is not given.
DEFAULTS: RunOptions = {
    "workers": None, "client": None, "scheduler": None, "reuse": (), "overwrite": False,
    "retry_failed": False, "yes": False, "progress": None, "time_limit_s": None}

Function = TypeVar("Function", bound=Callable[..., Any])


def taking_run_options(function: Function) -> Function:
    """Show the options of a run in the signature of a function whose last parameter they are.

    Completion and help read the signature. The function is called with all options, and raises
    ArgumentError for a keyword that it does not take, before it does anything.
    """
    own = inspect.signature(function)
    options = (
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default,
                          annotation=RunOptions.__annotations__[name].__forward_arg__)
        for name, default in DEFAULTS.items())
    known = own.replace(parameters=[*[*own.parameters.values()][:-1], *options])

    @wraps(function)
    def checked(*given: Any, **keywords: Any) -> Any:
        for name in keywords.keys() - known.parameters.keys():
            raise ArgumentError(
                name, plain(keywords[name], 60), "unknown; expected one of "
                f"{', '.join(known.parameters)}{nearest(name, known.parameters)}")
        return function(*given, **DEFAULTS | keywords)

    vars(checked)["__signature__"] = known
    return cast("Function", checked)
