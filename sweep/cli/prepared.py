"""What commands do before they run something: compile, prepare, announce."""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from sweep import library
from sweep.cli.command import CONTINUES, say, say_next
from sweep.execution import BLOCK_TASK
from sweep.isolation.child_process import Child
from sweep.messages import notice, quoted

if TYPE_CHECKING:
    from sweep.execution.status import Summary
    from sweep.experiment.pipeline import Pipeline


# --------------------------------------------------------------------------------------------------
# What is said before code is compiled for the first time.

COMPILATION_S = 8
"""Seconds that the renderer takes to compile, which every run needs."""

PHOTOGRAPH_S = 20
"""Seconds that `photometric_real` takes beyond that."""

LIKELIHOOD_S = 10
"""Seconds that the bound and `photometric` take beyond that."""


def announce_compilation(pipeline: Pipeline) -> None:
    """Say in a line on stderr that a pipeline's functions are compiled, if they have not been."""
    fits = "photometric" in pipeline.values_of("solver")
    fits = fits or bool(set(pipeline.values_of("bound")) - {"none"})
    seconds = (
        0 if library.compilation.is_cached("sweep.model.coverage", "accumulate") else COMPILATION_S
    )
    if fits and not library.compilation.is_cached("sweep.measure.likelihood", "fit"):
        seconds += LIKELIHOOD_S
    real = "photometric_real" in pipeline.values_of("solver")
    if real and not library.compilation.is_cached("sweep.measure.photometric", "locate_photograph"):
        seconds += PHOTOGRAPH_S
    if seconds:
        notice(f"compiling, once for this version: about {seconds} s")


# --------------------------------------------------------------------------------------------------
# Runs of commands: beside a child, and of pipelines made of photographs or answers.

def beside_child(
    execute: Callable[[argparse.Namespace, Child], int]
) -> Callable[[argparse.Namespace], int]:
    """Return a command that runs beside a child, which imports its packages meanwhile."""
    @functools.wraps(execute)
    def begun(options: argparse.Namespace) -> int:
        with Child(BLOCK_TASK) as child:
            return execute(options, child)

    return begun


def store_of(options: argparse.Namespace) -> str | None:
    """Return the store that a command was told to write, or to continue; None for the default."""
    return options.store or (
        options.pipeline if library.lifecycle.names_store(options.pipeline) else None
    )


def run_prepared(
    options: argparse.Namespace, pipeline: Pipeline, store: str, lines: Sequence[str]
) -> Summary:
    """Run a pipeline into a store, after lines on stderr on what it was made of.

    Raises
    ------
    SweepError
        As :func:`sweep.execution.runner.execute`.
    """
    announce_compilation(pipeline)
    for line in lines:
        notice(line)
    options.stopped = CONTINUES
    with library.progress.progress_display() as display:
        return library.runner.execute(
            pipeline, store, workers=options.workers, overwrite=options.overwrite,
            progress=display,
        )


def say_summary(summary: Summary, line: str) -> None:
    """Print what became of a run: ``line``, the dataset, warnings, and what to do next."""
    if summary.computed_blocks == 0:
        say(f"{summary.store} is already finished; --overwrite measures it again")
    say(line)
    say(f'xarray.open_zarr("{summary.data}")')
    for warning in summary.warnings:
        say(warning)
    say_next(summary.advice or f"sweep report {quoted(summary.store)}")
    sys.stdout.flush()
