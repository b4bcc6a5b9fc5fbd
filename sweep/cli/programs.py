"""The commands for other programs: export, score, plugins."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys

from sweep import library
from sweep.cli.command import (
    CONTINUES,
    Command,
    Example,
    add_json,
    add_new_store,
    add_pipeline,
    add_settings,
    print_json,
    read_pipeline,
    say,
    say_next,
)
from sweep.cli.prepared import announce_compilation, run_prepared, say_summary
from sweep.errors import ArgumentError
from sweep.messages import byte_count, quoted

# --------------------------------------------------------------------------------------------------
# ``sweep export``.

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

    announce_compilation(pipeline)
    options.stopped = CONTINUES
    watched = sys.stderr is not None and sys.stderr.isatty()

    def report(done: int, count: int) -> None:
        if watched:
            end = "\n" if done == count else ""
            print(f"\r{done:,} of {count:,} scenes", end=end, file=sys.stderr, flush=True)

    result = library.export.export(
        pipeline, options.folder, windowed=options.windowed, workers=options.workers,
        yes=options.yes, progress=report,
    )
    if options.json:
        print_json(result)
        return 0
    without = f", {result.invisible:,} scenes without" if result.invisible else ""
    say(f"{result.folder}: {result.images:,} images, {byte_count(result.bytes)}{without}")
    if result.kept:
        say(f"{result.kept:,} were there already, {result.written:,} written now")
    if result.damaged:
        say(f"{result.damaged:,} were missing or changed, and are written again")
    folder = quoted(result.folder)
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


# --------------------------------------------------------------------------------------------------
# ``sweep score``.

def _add_arguments_score(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", help="an export, made by `sweep export`")
    parser.add_argument(
        "files", metavar="FILE", nargs="+",
        help="detections or poses, CSV; several files are compared on the same images",
    )
    parser.add_argument(
        "--name", action="append", default=[], dest="names", metavar="NAME",
        help="name of the program that made a file (default: the file's); may be repeated",
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
    add_settings(parser, "replace a value of the experiment, such as solver=ippe")
    add_new_store(parser)
    add_json(parser)


def _execute_score(options: argparse.Namespace) -> int:
    conventions = library.answers.Conventions.of(
        options.pixel_center, options.corner_order, options.frame
    )
    scored = library.score.prepare(
        options.folder, options.files, names=options.names, conventions=conventions,
        doubled=options.doubled, beside=options.beside, settings=options.settings,
    )
    with scored.withdrawn_if_refused():
        summary = run_prepared(
            options, scored.pipeline, options.store or f"runs/{scored.name}.zarr", scored.lines)
    if options.json:
        print_json({**dataclasses.asdict(summary), "answers": scored.lines})
    else:
        say_summary(summary, f"{summary.poses:,} poses, {summary.detected_line}")
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
    _add_arguments_score, _execute_score,
)


# --------------------------------------------------------------------------------------------------
# ``sweep plugins``.

def _add_arguments_plugins(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name", metavar="NAME", nargs="?",
        help="a plug-in to describe: the name of an installed one, or file:name in this folder; or "
        "the word check, and the plug-in to try behind it",
    )
    parser.add_argument(
        "tried", metavar="TRIED", nargs="?",
        help="behind check: a detector or a solver, also opencv or one of our solvers",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="check: give a setting of it this TOML value; may be repeated",
    )
    parser.add_argument(
        "--dictionary", metavar="DICTIONARY",
        help="check: dictionary of the markers (default: DICT_APRILTAG_36h11, or a detector's "
        "first)",
    )
    parser.add_argument(
        "--time-limit", type=float, default=120.0, metavar="S", dest="time_limit_s",
        help="check: seconds after which one of its steps is taken for endless (default: 120)",
    )
    add_json(parser)


def _execute_plugins(options: argparse.Namespace) -> int:
    if options.name == "check" and options.tried is not None:
        return _check(options)
    if options.tried is not None:
        raise ArgumentError(
            "tried", options.tried, f"expected one name; `sweep plugins check {options.tried}` "
            "tries it"
        )
    if options.settings or options.dictionary:
        raise ArgumentError(
            "settings" if options.settings else "dictionary", "", "expected `check` and a name")
    if options.name is None:
        every = library.declared.installed()
        if options.json:
            print_json({"plugins": every})
            return 0
        for each in every:
            say(f"{each['kind']:10} {each['name']:20} of {each['distribution']}")
        if not every:
            say("no plug-in is installed")
        say_next("sweep plugins NAME", "describes one, and says whether it can be used")
        return 0
    found = [plugin.to_json() for plugin in library.declared.described(options.name)]
    if options.json:
        print_json({"plugins": found})
        return 0
    for plugin in found:
        say(f"{plugin['kind']} {plugin['name']}" + (
            f": {plugin['meaning']}" if plugin["meaning"] else ""
        ))
        for distribution, version in plugin["versions"].items():
            say(f"  needs      {distribution} {version}")
        if plugin["dictionaries"]:
            say(f"  knows      {', '.join(plugin['dictionaries'])}")
        for setting in plugin["settings"]:
            unit = f" {setting['unit']}" if "unit" in setting else ""
            say(f"  setting    {setting['name']} = {setting['default']}{unit}: "
                f"{setting['meaning']}")
    return 0


def _check(options: argparse.Namespace) -> int:
    report = library.check.check_plugin(
        options.tried, options.dictionary, options.settings, time_limit_s=options.time_limit_s
    )
    if options.json:
        print_json({
            "name": report.name, "kind": report.kind, "dictionary": report.dictionary,
            "versions": report.versions, "conforms": report.conforms, **report.numbers,
            "findings": [
                {"check": each.check, "verdict": each.verdict, "text": each.text}
                for each in report.findings
            ],
        })
        return 0 if report.conforms else 1
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    say(f"{report.kind} {report.name}{f' ({versions})' if versions else ''} on "
        f"{report.dictionary}: {'conforms' if report.conforms else 'does not conform'}")
    for each in report.findings:
        say(f"  {each.verdict:5}  {each.check:22}  {each.text}")
    if report.conforms:
        key = "detector" if report.kind == "detector" else "solver"
        chosen = shlex.quote(f'{key}="{report.name}"')
        say_next(f"sweep run PIPELINE --set {chosen}", "measures it on your scenes")
    return 0 if report.conforms else 1


PLUGINS = Command(
    "plugins", "list, describe or check detectors and solvers of other packages",
    "pipelines/plugins/README.md",
    (
        Example("sweep plugins pyapriltags", "imports one, and lists its settings"),
        Example("sweep plugins check mine:SOLVER", "tries SOLVER of mine.py in this folder"),
    ),
    _add_arguments_plugins, _execute_plugins,
)
