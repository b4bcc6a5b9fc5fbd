"""``sweep photos``."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
import sys
from pathlib import Path

from sweep.cli.arguments import add_json, add_workers
from sweep.cli.command import CONTINUES, Command, Example
from sweep.cli.output import print_json, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folders", metavar="FOLDER", nargs="+",
        help="photographs (PNG, JPEG, BMP, PGM) of one camera; with --stereo two folders, or one "
        "of images whose halves are the left and the right camera's",
    )
    parser.add_argument(
        "--camera", metavar="FILE",
        help="file of the camera's calibration, or `calibrate`: from the board in the photographs",
    )
    parser.add_argument(
        "--board", metavar="FILE",
        help="TOML file of the board; the truth of a marker is the pose by all corners but its own",
    )
    parser.add_argument(
        "--poses", metavar="FILE",
        help="the true poses, CSV or JSON Lines as `sweep score` reads them",
    )
    parser.add_argument(
        "--stereo", metavar="FILE",
        help="calibration of a stereo camera (K1, D1, K2, D2, R, T); the truth is the pose in the "
        "other camera's image",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="set a parameter of detector or estimator; a list compares its values; may be "
        "repeated",
    )
    parser.add_argument(
        "--store", metavar="STORE",
        help="path or URL of the store (default: runs/NAME.zarr with the folder's name)",
    )
    add_workers(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing store")
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.cli.first_use import announce_compilation  # noqa: PLC0415
    from sweep.execution.progress import progress_display  # noqa: PLC0415
    from sweep.execution.runner import execute  # noqa: PLC0415
    from sweep.messages import notice  # noqa: PLC0415
    from sweep.photographs.prepare import prepare  # noqa: PLC0415
    from sweep.photographs.record_files import record_home  # noqa: PLC0415
    from sweep.plan.parameters import Stage  # noqa: PLC0415

    options.stopped = "stopped before anything was computed"
    home, name = record_home(options.store)
    prepared = prepare(
        options.folders, options.camera, board=options.board, poses=options.poses,
        stereo=options.stereo, settings=options.settings, home=home, name=name,
        overwrite=options.overwrite,
    )
    announce_compilation(prepared.pipeline)
    for line in prepared.lines:
        notice(line)
    store = options.store or str(Path(home) / f"{prepared.pipeline.name}.zarr")
    options.stopped = CONTINUES
    with progress_display() as display:
        summary = execute(
            prepared.pipeline, store, workers=options.workers, overwrite=options.overwrite,
            progress=display,
        )
    if options.json:
        print_json({**dataclasses.asdict(summary), "photographs": prepared.lines})
        return int(summary.nothing_computed)
    if summary.computed_blocks == 0:
        say(f"{summary.store} is already finished; --overwrite measures it again")
    configurations = prepared.pipeline.size(Stage.detection, Stage.estimation)
    say(
        f"{prepared.markers:,} markers in {prepared.photographs:,} photographs: "
        f"{summary.detected:,} of {prepared.markers * configurations:,} detected"
    )
    say(f'xarray.open_zarr("{summary.data}")')
    for line in summary.warnings:
        say(line)
    say_next(summary.advice or f"sweep report {shlex.quote(summary.store)}")
    sys.stdout.flush()
    return int(summary.nothing_computed)


PHOTOS = Command(
    "photos", "measure detectors and estimators on photographs of markers",
    "pipelines/photographs/README.md",
    (
        Example(
            "sweep photos shots --camera camera.yaml --board BOARD.toml",
            "compares each marker with the board without it; writes runs/shots.zarr",
        ),
        Example(
            "sweep photos shots --camera calibrate --board BOARD.toml "
            "--set 'cornerRefinementMethod=[\"none\", \"subpix\"]'",
            "calibrates the camera from the same photographs; compares two refinements",
        ),
    ),
    _add_arguments, _execute,
)
