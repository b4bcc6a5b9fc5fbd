"""``sweep limit``."""

from __future__ import annotations

import argparse
import shlex
from typing import TYPE_CHECKING

from sweep.cli.arguments import add_json, add_pipeline, add_workers
from sweep.cli.command import CONTINUES, Command, Example
from sweep.cli.output import print_json, quiet_matplotlib, say, say_next

if TYPE_CHECKING:
    from sweep.isolation.child_process import Child


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_pipeline(parser)
    parser.add_argument(
        "--require", action="append", default=[], metavar="REQUIREMENT",
        help="what must hold, in quotes: 'detection >= 0.9'; may be repeated, all hold together "
        "(default: the section [limit], else [require], of the file)",
    )
    parser.add_argument(
        "--along", default="", metavar="AXIS",
        help="the axis of the scene that is searched, such as distance_m",
    )
    parser.add_argument(
        "--per", metavar="AXES",
        help="axes of which each combination of values has its own limit, such as "
        "tilt_deg,noise_grey (default: all; with '' none); others are pooled",
    )
    parser.add_argument(
        "--at-all", metavar="AXES",
        help="axes at all of whose values the requirements must hold",
    )
    parser.add_argument(
        "--max-trials", type=int, metavar="N",
        help="the most trials of a cell (default: that of [limit], else 2400)",
    )
    parser.add_argument(
        "--coarse-trials", type=int, metavar="N",
        help="trials of every cell in the coarse scan (default: as many as make 40 draws of a "
        "value)",
    )
    parser.add_argument(
        "--store", metavar="STORE",
        help="path or URL of the store (default: runs/NAME-limit-AXIS.zarr)",
    )
    add_workers(parser)
    parser.add_argument("--scheduler", metavar="ADDRESS", help="address of a Dask scheduler")
    parser.add_argument(
        "--reuse", action="append", default=[], metavar="STORE",
        help="copy the finished cells that this store shares with the search; may be repeated",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing store")
    parser.add_argument(
        "--yes", action="store_true",
        help="run also what would take more than a day, or more than is free on the disk",
    )
    parser.add_argument(
        "-o", "--output", metavar="FIGURE", help="draw the limits into this PNG or SVG file"
    )
    form = parser.add_mutually_exclusive_group()
    add_json(form)
    form.add_argument("--markdown", action="store_true", help="print a Markdown table")


def _execute(options: argparse.Namespace) -> int:
    quiet_matplotlib()
    from sweep.execution import BLOCK_TASK  # noqa: PLC0415
    from sweep.isolation.child_process import Child  # noqa: PLC0415

    # It imports its packages while this process does.
    with Child(BLOCK_TASK) as child:
        return _execute_beside(child, options)


def _execute_beside(child: Child, options: argparse.Namespace) -> int:
    from sweep.cli.first_use import announce_compilation  # noqa: PLC0415
    from sweep.execution.limit_search import search_limits  # noqa: PLC0415
    from sweep.execution.progress import progress_display  # noqa: PLC0415
    from sweep.messages import notice  # noqa: PLC0415
    from sweep.report.output_file import figure_file, write_output_file  # noqa: PLC0415

    output = figure_file(options.output)
    options.stopped = CONTINUES
    with progress_display() as display:
        limits, summary = search_limits(
            options.pipeline, require=options.require, along=options.along,
            per=_names(options.per), at_all=_names(options.at_all), max_trials=options.max_trials,
            coarse_trials=options.coarse_trials, settings=options.settings, store=options.store,
            begin=announce_compilation, workers=options.workers, scheduler=options.scheduler,
            reuse=options.reuse, overwrite=options.overwrite, yes=options.yes, progress=display,
            child=child)
    for line in summary.warnings if summary is not None else ():
        notice(line)
    store = str(limits.attrs["store"])
    from sweep.report.limit_table import (  # noqa: PLC0415
        as_json,
        limit_table,
        summary_lines,
        table_text,
    )

    if output is not None:
        from sweep.report.limit_figure import figure_bytes  # noqa: PLC0415

        write_output_file(output, figure_bytes(limits, output.suffix.lower()))
    if options.json:
        print_json({**as_json(limits), "store": store})
        return 0
    table = limit_table(limits)
    if options.markdown:
        say(table.markdown())
        say()
        say("\n".join(f"- {line}" for line in summary_lines(limits)))
        return 0
    say(table.caption)
    say()
    say(table_text(table))
    say()
    for line in summary_lines(limits):
        say(line)
    say_next(f"sweep report {shlex.quote(store)}")
    return 0


def _names(text: str | None) -> list[str] | None:
    if text is None:
        return None
    return [name for part in text.split(",") if (name := part.strip())]


LIMIT = Command(
    "limit", "find how far along an axis requirements are met",
    "pipelines/limits/README.md",
    (
        Example(
            "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' "
            "--along distance_m",
            "finds from how far a marker is detected, at each tilt",
        ),
        Example(
            "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' "
            "--along distance_m --at-all tilt_deg -o limit.svg",
            "finds up to which distance it is at all tilts, with a figure",
        ),
    ),
    _add_arguments, _execute,
)
