"""``sweep size``."""

from __future__ import annotations

import argparse
import shlex
from typing import TYPE_CHECKING

from sweep.cli.arguments import add_json, add_workers, read_pipeline
from sweep.cli.command import CONTINUES, Command, Example
from sweep.cli.output import print_json, say, say_next

if TYPE_CHECKING:
    from sweep.isolation.child_process import Child

UNDECIDED = 3
"""Exit status where the most trials do not tell whether any choice will do."""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "pipeline", metavar="PIPELINE",
        help="TOML file with the sections [require] and [choose], or the store of a search",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="replace a value of the file by this TOML value, such as choose.max_trials=2000; "
        "may be repeated",
    )
    parser.add_argument(
        "--store", metavar="STORE", help="path or URL of the store (default: runs/NAME.zarr)"
    )
    add_workers(parser)
    parser.add_argument(
        "--reuse", action="append", default=[], metavar="STORE",
        help="copy the finished cells that this store shares with the search; may be repeated",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing store")
    parser.add_argument(
        "--seconds", type=float, default=20.0, metavar="S", dest="limit_s",
        help="time limit of the measurement of costs, in seconds (default: 20)",
    )
    parser.add_argument(
        "--yes", action="store_true",
        help="run also what would take more than a day, or more than is free on the disk",
    )
    form = parser.add_mutually_exclusive_group()
    add_json(form)
    form.add_argument("--markdown", action="store_true", help="print Markdown")


def _execute(options: argparse.Namespace) -> int:
    from sweep.execution import BLOCK_TASK  # noqa: PLC0415
    from sweep.isolation.child_process import Child  # noqa: PLC0415

    # It imports its packages while this process does.
    with Child(BLOCK_TASK) as child:
        return _execute_beside(child, options)


def _execute_beside(child: Child, options: argparse.Namespace) -> int:
    import math  # noqa: PLC0415

    from sweep.cli import size_lines as lines  # noqa: PLC0415
    from sweep.cli.first_use import announce_compilation  # noqa: PLC0415
    from sweep.errors import ArgumentError  # noqa: PLC0415
    from sweep.execution.progress import progress_display, stage_display  # noqa: PLC0415
    from sweep.store.stored_pipeline import names_store  # noqa: PLC0415
    from sweep.tradeoff.choice_search import chosen_by, search_choice  # noqa: PLC0415

    if not 0 < options.limit_s < math.inf:
        raise ArgumentError("limit_s", options.limit_s, "expected a finite number above 0")
    pipeline = read_pipeline(options)
    chosen_by(pipeline)
    announce_compilation(pipeline)
    options.stopped = CONTINUES
    store = options.store or (options.pipeline if names_store(options.pipeline) else None)
    with progress_display() as bar, stage_display() as stage:
        choice = search_choice(
            pipeline, store, limit_s=options.limit_s, progress=bar, stage=stage, child=child,
            workers=options.workers, reuse=options.reuse, overwrite=options.overwrite,
            yes=options.yes)
    status = 0 if choice.best is not None else UNDECIDED if choice.is_undecided else 1
    if options.json:
        print_json(lines.as_json(choice))
        return status
    if options.markdown:
        say(lines.markdown(choice))
        return status
    for line in lines.text(choice):
        say(line)
    for note in choice.notes:
        say(note)
    say_next(f"sweep report {shlex.quote(choice.store)}")
    return status


SIZE = Command(
    "size", "find the smallest or cheapest choice that will do",
    "pipelines/sizes/README.md",
    (
        Example(
            "sweep size pipelines/sizes/smallest_marker.toml",
            "how large a marker must be, and by which condition the next smaller one fails",
        ),
        Example(
            "sweep size pipelines/sizes/smallest_marker.toml --set choose.max_trials=2000 "
            "--store runs/quick.zarr --markdown",
            "with fewer trials of a condition at most; prints Markdown",
        ),
    ),
    _add_arguments, _execute,
)
