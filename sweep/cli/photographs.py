"""The commands of your own camera: photos, fit."""

from __future__ import annotations

import argparse
import dataclasses
import math
from pathlib import Path

from sweep import library
from sweep.cli.command import (
    Command,
    Example,
    add_json,
    add_new_store,
    add_photographs,
    add_settings,
    print_json,
    say,
    say_next,
)
from sweep.cli.prepared import run_prepared, say_summary
from sweep.messages import notice, quoted

# --------------------------------------------------------------------------------------------------
# ``sweep photos``.

def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_photographs(parser)
    add_settings(parser, "set a parameter of detector or estimator; a list compares its values")
    add_new_store(parser, "runs/NAME.zarr with the folder's name")
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    options.stopped = "stopped before anything was computed"
    home, name = library.folder.record_home(options.store)
    prepared = library.prepare.prepare(
        options.folders, options.camera, board=options.board, poses=options.poses,
        stereo=options.stereo, settings=options.settings, home=home, name=name,
        overwrite=options.overwrite,
    )
    store = options.store or str(Path(home) / f"{prepared.pipeline.name}.zarr")
    summary = run_prepared(options, prepared.pipeline, store, prepared.lines)
    if options.json:
        print_json({**dataclasses.asdict(summary), "photographs": prepared.lines})
        return int(summary.nothing_computed)
    settings = prepared.pipeline.size(library.parameters.Stage.detection)
    each = f" with {settings} detector settings" if settings > 1 else ""
    say_summary(
        summary, f"{prepared.markers:,} markers in {prepared.photographs:,} photographs: "
        f"{summary.detected_line}{each}")
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


# --------------------------------------------------------------------------------------------------
# ``sweep fit``.

def _add_arguments_fit(parser: argparse.ArgumentParser) -> None:
    add_photographs(parser)
    add_settings(parser, "dictionary and size_m of single markers; detectors and estimators whose "
                 "errors are compared (default: two refinements)")
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


def _execute_fit(options: argparse.Namespace) -> int:
    output = Path(options.output)
    library.output_file.check_output_file(output)
    fitted = library.folders.fit_folder(
        options.folders, options.camera, board=options.board, poses=options.poses,
        stereo=options.stereo, settings=options.settings, markers=options.markers,
        check=options.check,
    )
    for line in fitted.lines:
        notice(line)
    library.output_file.write_output_file(output, fitted.text.encode())
    found = fitted.found
    if options.json:
        print_json({
            "scene": found.scene, "photographs": found.photographs, "markers": found.markers,
            "terms": [each.as_json() for each in found.terms], "lines": list(found.lines),
            "check": [] if fitted.gap is None else library.gap_figure.gap_records(fitted.gap),
            "output": str(output),
        })
        return 0
    rows = [
        (
            each.name, each.parameter, library.formatting.number(each.estimate.value),
            library.formatting.interval_text(each.estimate.low, each.estimate.high)
            if math.isfinite(each.estimate.low) else "",
            f"{'kept' if each.kept else 'left out'}{': ' if each.reason else ''}{each.reason}",
        )
        for each in found.terms
    ]
    say(library.table.Table.of(
        f"{found.markers} markers in {found.photographs} photographs; 95 % intervals by photograph",
        ("term", "parameter", "value", "interval", ""), rows, stub=2,
    ).text())
    say()
    for line in found.lines:
        say(f"- {line}")
    if fitted.gap is not None:
        say()
        say("Half of the photographs, simulated with the scene of the others:")
        say(library.gap_figure.gap_table(fitted.gap).text())
        say()
    say_next(f"sweep run {quoted(str(output))}", "simulates this camera")
    store = f"runs/{fitted.pipeline.name}.zarr"
    compare = quoted("sweep", "compare", store, str(output))
    if library.locations.exists(store):
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
    return quoted(*words)


FIT = Command(
    "fit", "estimate a camera's [scene] from photographs",
    "pipelines/photographs/README.md",
    (
        Example(
            "sweep fit shots --camera camera.yaml --board BOARD.toml",
            "writes scene.toml: blur, sharpening, tone, noise, geometry",
        ),
        Example(
            "sweep fit shots --camera calibrate --board BOARD.toml -o webcam.toml",
            "calibrates the camera from the same photographs",
        ),
    ),
    _add_arguments_fit, _execute_fit,
)
