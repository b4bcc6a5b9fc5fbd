"""``sweep fit``."""

from __future__ import annotations

import argparse
import math
import shlex
from pathlib import Path

from sweep.cli.arguments import add_json
from sweep.cli.command import Command, Example
from sweep.cli.output import print_json, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folders", metavar="FOLDER", nargs="+",
        help="photographs of one camera, as `sweep photos` takes them",
    )
    parser.add_argument(
        "--camera", metavar="FILE",
        help="file of the camera's calibration, or `calibrate`: from the board in the photographs",
    )
    parser.add_argument("--board", metavar="FILE", help="TOML file of the board")
    parser.add_argument(
        "--poses", metavar="FILE", help="the true poses, as `sweep photos` takes them"
    )
    parser.add_argument(
        "--stereo", metavar="FILE",
        help="calibration of a stereo camera; the left camera's scene is fitted",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="dictionary and size_m of single markers; detectors and estimators whose errors are "
        "compared (default: two refinements)",
    )
    parser.add_argument(
        "--markers", type=int, default=12, metavar="N",
        help="the most markers of a photograph that are fitted, well spread over the frame "
        "(default: 12)",
    )
    parser.add_argument(
        "--no-check", dest="check", action="store_false",
        help="do not hold half of the photographs out, to see which effects move their errors",
    )
    parser.add_argument(
        "-o", "--output", default="scene.toml", metavar="FILE",
        help="pipeline file to write (default: scene.toml)",
    )
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.fitting.folders import fit_folder  # noqa: PLC0415
    from sweep.messages import notice  # noqa: PLC0415
    from sweep.report.error_model_table import plain_table  # noqa: PLC0415
    from sweep.report.formatting import interval_text, number  # noqa: PLC0415
    from sweep.report.gap_table import gap_records, gap_table  # noqa: PLC0415
    from sweep.report.output_file import check_output_file, write_output_file  # noqa: PLC0415
    from sweep.report.table import Table  # noqa: PLC0415
    from sweep.store.locations import exists  # noqa: PLC0415

    output = Path(options.output)
    check_output_file(output)
    fitted = fit_folder(
        options.folders, options.camera, board=options.board, poses=options.poses,
        stereo=options.stereo, settings=options.settings, markers=options.markers,
        check=options.check,
    )
    for line in fitted.lines:
        notice(line)
    write_output_file(output, fitted.text.encode())
    found = fitted.found
    if options.json:
        print_json({
            "scene": found.scene, "photographs": found.photographs, "markers": found.markers,
            "terms": [each.as_json() for each in found.terms], "lines": list(found.lines),
            "check": [] if fitted.gap is None else gap_records(fitted.gap),
            "output": str(output),
        })
        return 0
    rows = [
        (
            each.name, each.parameter, number(each.estimate.value),
            interval_text(each.estimate.low, each.estimate.high)
            if math.isfinite(each.estimate.low) else "",
            number(each.estimate.spread) if each.estimate.spread > 0 else "",
            f"{'kept' if each.kept else 'left out'}{': ' if each.reason else ''}{each.reason}",
        )
        for each in found.terms
    ]
    say(plain_table(Table(
        f"{found.markers} markers in {found.photographs} photographs; 95 % intervals and spread "
        "by photograph",
        ("term", "parameter", "value", "interval", "spread", ""), rows, stub=2,
    )))
    say()
    for line in found.lines:
        say(f"- {line}")
    if fitted.gap is not None:
        say()
        say("Half of the photographs, simulated with the scene of the others:")
        say(plain_table(gap_table(fitted.gap)))
        say()
    say_next(f"sweep run {shlex.quote(str(output))}", "simulates this camera")
    store = f"runs/{fitted.pipeline.name}.zarr"
    compare = shlex.join(["sweep", "compare", store, str(output)])
    if exists(store):
        say_next(compare, "the photographs beside their simulation")
    else:
        say_next(_measuring_command(options), f"measures the photographs, for {compare}")
    return 0


def _measuring_command(options: argparse.Namespace) -> str:
    """Return the command that measures the photographs of `sweep fit`."""
    words = ["sweep", "photos", *options.folders]
    for name in ("camera", "board", "poses", "stereo"):
        if (value := getattr(options, name)) is not None:
            words += [f"--{name}", value]
    for setting in options.settings:
        words += ["--set", setting]
    return shlex.join(words)


FIT = Command(
    "fit", "estimate a camera's [scene] from photographs",
    "pipelines/photographs/README.md",
    (
        Example(
            "sweep fit shots --camera camera.yaml --board BOARD.toml",
            "writes scene.toml: blur, sharpening, tone, light, noise, geometry",
        ),
        Example(
            "sweep fit shots --camera calibrate --board BOARD.toml -o webcam.toml",
            "calibrates the camera from the same photographs",
        ),
    ),
    _add_arguments, _execute,
)
