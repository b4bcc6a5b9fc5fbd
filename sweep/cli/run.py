"""``sweep run``."""

from __future__ import annotations

import argparse
import dataclasses
from typing import TYPE_CHECKING

from sweep.cli.arguments import add_json, add_pipeline, add_workers, read_pipeline
from sweep.cli.command import Command, Example
from sweep.cli.output import print_json, say

if TYPE_CHECKING:
    from sweep.isolation.child_process import Child


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_pipeline(parser)
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
        "--time-limit", type=float, metavar="S", default=600.0, dest="time_limit_s",
        help="block timeout in seconds (default: 600)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing store")
    parser.add_argument(
        "--durable", action="store_true",
        help="flush each block to the disk before it counts: nothing committed is lost when the "
        "power fails",
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
    from sweep.execution.progress import progress_bar  # noqa: PLC0415
    from sweep.execution.runner import execute  # noqa: PLC0415
    from sweep.plan.camera_facts import camera_facts  # noqa: PLC0415

    if not options.json:
        say(f"camera: {camera_facts(pipeline).line()}")
    announce_compilation(pipeline)
    with progress_bar() as bar:
        summary = execute(
            pipeline, options.store, workers=options.workers, scheduler=options.scheduler,
            reuse=options.reuse, overwrite=options.overwrite, durable=options.durable,
            time_limit_s=options.time_limit_s, progress=bar, child=child,
        )
    if options.json:
        print_json(dataclasses.asdict(summary))
        return 0
    if summary.computed_blocks == 0:
        say(f"{summary.store} is already finished; --overwrite recomputes it")
    rate = summary.poses / summary.seconds if summary.computed_blocks else 0
    say(
        f"{summary.poses:,} poses, {summary.results:,} results, {summary.detected:,} detected"
        + (f", {summary.seconds:.1f} s ({rate:,.0f} poses/s)" if rate else "")
    )
    for flag, count in (("crashed", summary.crashed), ("failed", summary.failed)):
        if count:
            say(f"{count:,} flagged {flag}; `sweep status {summary.store}` lists them")
    say(f'xarray.open_zarr("{summary.data}")')
    return 0


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
