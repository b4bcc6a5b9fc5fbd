"""``sweep export``."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys

from sweep.cli.arguments import add_json, add_pipeline, read_pipeline
from sweep.cli.command import CONTINUES, Command, Example
from sweep.cli.output import print_json, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_pipeline(parser)
    parser.add_argument("folder", metavar="DIR", help="new or empty folder, or one to continue")
    parser.add_argument(
        "--windows", action="store_true", dest="windowed",
        help="images of the marker's surroundings, as a run searches them (default: whole frames)",
    )
    parser.add_argument(
        "--workers", type=int, metavar="N", help="number of processes that render (default: 1)"
    )
    parser.add_argument(
        "--yes", action="store_true",
        help="export also what takes more than 10 GB, or more than is free on the disk",
    )
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    pipeline = read_pipeline(options)
    from sweep.cli.first_use import announce_compilation  # noqa: PLC0415
    from sweep.exchange.export import export  # noqa: PLC0415
    from sweep.messages import byte_count  # noqa: PLC0415

    announce_compilation(pipeline)
    options.stopped = CONTINUES
    watched = sys.stderr is not None and sys.stderr.isatty()

    def report(done: int, count: int) -> None:
        if watched:
            end = "\n" if done == count else ""
            print(f"\r{done:,} of {count:,} scenes", end=end, file=sys.stderr, flush=True)

    result = export(
        pipeline, options.folder, windowed=options.windowed, workers=options.workers,
        yes=options.yes, progress=report,
    )
    if options.json:
        print_json(dataclasses.asdict(result))
        return 0
    without = f", {result.invisible:,} scenes without" if result.invisible else ""
    say(f"{result.folder}: {result.images:,} images, {byte_count(result.bytes)}{without}")
    if result.kept:
        say(f"{result.kept:,} were there already, {result.written:,} written now")
    if result.damaged:
        say(f"{result.damaged:,} were missing or changed, and are written again")
    folder = shlex.quote(result.folder)
    say_next(f"sweep score {folder} detections.csv", f"{folder}/README.md has the conventions")
    return 0


EXPORT = Command(
    "export", "write an experiment's images and truth for other programs",
    "sweep/exchange/README.md",
    (
        Example("sweep export pipelines/smoke.toml images", "writes every image as a whole frame"),
        Example(
            "sweep export runs/smoke.zarr windows --windows",
            "writes the marker's surroundings alone, of the experiment of a store",
        ),
    ),
    _add_arguments, _execute,
)
