"""``sweep score``."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys

from sweep.cli.arguments import add_json, add_workers
from sweep.cli.command import CONTINUES, Command, Example
from sweep.cli.output import print_json, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", help="an export, made by `sweep export`")
    parser.add_argument(
        "files", metavar="FILE", nargs="+",
        help="detections or poses, CSV or JSON Lines; several files are compared on the same "
        "images",
    )
    parser.add_argument(
        "--name", action="append", default=[], dest="names", metavar="NAME",
        help="name of the program that made a file (default: the file's); may be repeated",
    )
    parser.add_argument(
        "--store", metavar="STORE", help="path or URL of the store (default: runs/NAME.zarr)"
    )
    parser.add_argument(
        "--pixel-center", default="0", metavar="C",
        help="coordinate of the centre of the first pixel: 0 (default), or 0.5",
    )
    parser.add_argument(
        "--corner-order", default="TL TR BR BL", metavar="ORDER",
        help="order of the corners, as OpenCV draws the marker (default: TL TR BR BL)",
    )
    parser.add_argument(
        "--frame", default="right up out", metavar="XYZ",
        help="directions of the marker's x, y, z for a viewer (default: right up out)",
    )
    parser.add_argument(
        "--doubled", default="refuse", metavar="HOW",
        help="what an ID counts that is twice in an image: refuse (default), or nearest",
    )
    parser.add_argument(
        "--beside", action="store_true",
        help="also search the images with the experiment's own detector",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="replace a value of the experiment, such as solver=ippe; may be repeated",
    )
    add_workers(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing store")
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.cli.first_use import announce_compilation  # noqa: PLC0415
    from sweep.exchange.conventions import Conventions  # noqa: PLC0415
    from sweep.exchange.score import prepare  # noqa: PLC0415
    from sweep.execution.progress import progress_display  # noqa: PLC0415
    from sweep.execution.runner import execute  # noqa: PLC0415
    from sweep.messages import notice  # noqa: PLC0415

    conventions = Conventions.of(options.pixel_center, options.corner_order, options.frame)
    scored = prepare(
        options.folder, options.files, names=options.names, conventions=conventions,
        doubled=options.doubled, beside=options.beside, settings=options.settings,
    )
    announce_compilation(scored.pipeline)
    options.stopped = CONTINUES
    for line in scored.lines:
        notice(line)
    store = options.store or f"runs/{scored.name}.zarr"
    with progress_display() as display, scored.withdrawn_if_refused():
        summary = execute(
            scored.pipeline, store, workers=options.workers, overwrite=options.overwrite,
            progress=display,
        )
    if options.json:
        print_json({**dataclasses.asdict(summary), "answers": scored.lines})
        return int(summary.nothing_computed)
    if summary.computed_blocks == 0:
        say(f"{summary.store} is already finished; --overwrite scores it again")
    say(f"{summary.poses:,} poses, {summary.results:,} results, {summary.detected:,} detected")
    for line in summary.warnings:
        say(line)
    say_next(summary.advice or f"sweep report {shlex.quote(summary.store)}")
    sys.stdout.flush()
    return int(summary.nothing_computed)


SCORE = Command(
    "score", "score what another program detected in an export's images",
    "sweep/exchange/README.md",
    (
        Example(
            "sweep score images detections.csv --name mine",
            "compares them with the truth; writes runs/mine.zarr",
        ),
        Example(
            "sweep score images tags.csv --pixel-center 0.5 --corner-order 'TR TL BL BR' --beside",
            "in other conventions, and beside the experiment's own detector",
        ),
    ),
    _add_arguments, _execute,
)
