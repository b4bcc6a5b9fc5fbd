"""``sweep run``."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from typing import TYPE_CHECKING

from sweep.cli.arguments import (
    add_json,
    add_pipeline,
    add_precision,
    add_workers,
    read_pipeline,
)
from sweep.cli.command import CONTINUES, Command, Example
from sweep.cli.output import print_json, say, say_next

if TYPE_CHECKING:
    from sweep.execution.progress import Progress
    from sweep.execution.summary import Summary
    from sweep.isolation.child_process import Child
    from sweep.plan.experiment import Pipeline


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_pipeline(parser)
    add_precision(parser)
    parser.add_argument(
        "--store", metavar="STORE", help="path or URL of the store (default: runs/NAME.zarr)"
    )
    add_workers(parser)
    parser.add_argument("--scheduler", metavar="ADDRESS", help="address of a Dask scheduler")
    parser.add_argument(
        "--reuse", action="append", default=[], metavar="STORE",
        help="copy the finished cells that this store shares with the experiment; may be repeated",
    )
    parser.add_argument(
        "--time-limit", type=float, metavar="S", dest="time_limit_s",
        help="block timeout in seconds (default: 600, or ten times a block's work)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing store")
    parser.add_argument(
        "--retry-failed", action="store_true",
        help="compute the blocks again in which cells failed or crashed, also of a finished store",
    )
    parser.add_argument(
        "--durable", action="store_true",
        help="flush each block to the disk before it counts: nothing committed is lost when the "
        "power fails",
    )
    parser.add_argument(
        "--yes", action="store_true",
        help="run also what would take more than a day, or more than is free on the disk",
    )
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.execution import BLOCK_TASK  # noqa: PLC0415
    from sweep.isolation.child_process import Child  # noqa: PLC0415

    # It imports its packages while this process does.
    with Child(BLOCK_TASK) as child:
        return _execute_beside(child, options)


def _execute_beside(child: Child, options: argparse.Namespace) -> int:
    pipeline = read_pipeline(options)
    from sweep.cli.first_use import announce_compilation  # noqa: PLC0415
    from sweep.execution.progress import progress_display  # noqa: PLC0415
    from sweep.execution.runner import execute  # noqa: PLC0415
    from sweep.plan.camera_facts import camera_facts  # noqa: PLC0415
    from sweep.store.stored_pipeline import names_store  # noqa: PLC0415

    announce_compilation(pipeline)
    store = options.store or (options.pipeline if names_store(options.pipeline) else None)
    options.stopped = "stopped before anything was computed" if options.overwrite else CONTINUES
    camera = [] if options.json else [f"camera: {camera_facts(pipeline).line()}"]

    watched = sys.stdout is not None and sys.stdout.isatty()

    def report(progress: Progress) -> None:
        if options.overwrite:  # there is a new store
            options.stopped = CONTINUES.replace("command", "command without --overwrite")
        while camera and watched:  # once the run is not refused; a pipe gets it with the results
            say(camera.pop())
        display(progress)

    with progress_display() as display:
        summary = execute(
            pipeline, store, workers=options.workers, scheduler=options.scheduler,
            reuse=options.reuse, overwrite=options.overwrite, retry_failed=options.retry_failed,
            durable=options.durable, yes=options.yes, time_limit_s=options.time_limit_s,
            progress=report, child=child,
        )
    if options.json:
        print_json(dataclasses.asdict(summary))
        return int(summary.nothing_computed)
    for line in camera:
        say(line)
    if summary.retried:
        say(f"{summary.retried:,} failed cells tried again, {summary.recovered:,} computed now")
    elif options.retry_failed and summary.computed_blocks == 0:
        say(f"{summary.store}: no cell failed or crashed; nothing is tried again")
    elif summary.computed_blocks == 0:
        failed = " and --retry-failed what failed" if summary.failures else ""
        say(f"{summary.store} is already finished; --overwrite recomputes it{failed}")
    rate = summary.computed_scenes / max(summary.seconds, 1e-3)
    say(
        f"{_poses(summary)}, {summary.detected:,} detected"
        + (f", {summary.seconds:.1f} s ({rate:,.0f} poses/s)" if rate else "")
    )
    say(f'xarray.open_zarr("{summary.data}")')
    for line in summary.warnings:
        say(line)
    if summary.advice:
        say_next(summary.advice)
    else:
        say_next(_requiring_command(pipeline, summary.store) if pipeline.requirements
                 else f"sweep report {shlex.quote(summary.store)}")
    return int(summary.nothing_computed)


def _poses(summary: Summary) -> str:
    """Return how many poses and results there are; of a run in waves, how many it needed."""
    if summary.needed is None:
        return f"{summary.poses:,} poses, {summary.results:,} results"
    settled = (summary.conditions or 0) - (summary.unsettled or 0)
    return (
        f"{settled:,} of {summary.conditions:,} conditions settled with {summary.needed:,} poses "
        f"({summary.poses:,} with all trials)"
    )


def _requiring_command(pipeline: Pipeline, url: str) -> str:
    """Return the command that decides on the pipeline's requirements.

    A store keeps those that it was made with: others are given.
    """
    from sweep.store.lifecycle import open_store  # noqa: PLC0415

    stored = open_store(url).pipeline
    if (stored.requirements, stored.require_per) == (pipeline.requirements, pipeline.require_per):
        return f"sweep require {shlex.quote(url)}"
    say("the store keeps the requirements that it was made with; the next line has the new ones")
    per = [name for name in pipeline.require_per if pipeline.axis(name) is not None]
    return shlex.join(["sweep", "require", url, *pipeline.requirements,
                       *(["--per", ",".join(per)] if per else [])])


RUN = Command(
    "run", "run a pipeline into a store, or continue an interrupted run",
    "sweep/execution/README.md",
    (
        Example("sweep run pipelines/smoke.toml", "writes runs/smoke.zarr"),
        Example(
            "sweep run pipelines/smoke.toml --set 'tilt_deg=[0, 30, 60]' --store runs/tilts.zarr",
            "runs the same experiment at other tilts",
        ),
    ),
    _add_arguments, _execute,
)
