"""The commands of your camera and of other programs: photos, fit, export, score, plugins."""

from __future__ import annotations

import argparse
import dataclasses
import math
import shlex
import sys
from pathlib import Path

from sweep import library
from sweep.cli.command import (
    CONTINUES,
    FORM,
    JSON,
    PHOTOGRAPHS,
    PIPELINE,
    answered,
    argument,
    command,
    figure_argument,
    new_store,
    print_json,
    quiet_matplotlib,
    read_pipeline,
    say,
    say_next,
    settings_argument,
)
from sweep.cli.prepared import announce_compilation, run_prepared, say_summary
from sweep.errors import ArgumentError
from sweep.messages import byte_count, notice, quoted

# --------------------------------------------------------------------------------------------------
# ``sweep photos``.

@command(
    "pipelines/photographs/README.md", {
        "sweep photos shots --camera camera.yaml --board BOARD.toml":
            "compares each marker with the board without it; writes runs/shots.zarr",
        "sweep photos shots --camera calibrate --board BOARD.toml "
        "--set 'cornerRefinementMethod=[\"none\", \"subpix\"]'":
            "calibrates the camera from the same photographs; compares two refinements"},
    *PHOTOGRAPHS,
    settings_argument("set a parameter of detector or estimator; a list compares its values"),
    *new_store("runs/NAME.zarr with the folder's name"), JSON)
def photos(options: argparse.Namespace) -> int:
    """Measure detectors and estimators on photographs of markers."""
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


# --------------------------------------------------------------------------------------------------
# ``sweep fit``.

@command(
    "pipelines/photographs/README.md", {
        "sweep fit shots --camera camera.yaml --board BOARD.toml":
            "writes scene.toml: blur, sharpening, tone, noise, geometry",
        "sweep fit shots --camera calibrate --board BOARD.toml -o webcam.toml":
            "calibrates the camera from the same photographs"},
    *PHOTOGRAPHS,
    settings_argument(
        "dictionary and size_m of single markers; detectors and estimators whose errors are "
        "compared (default: two refinements)"),
    argument(
        "--markers", type=int, default=12, metavar="N",
        help="the most markers of a photograph that are fitted, well spread over the frame "
        "(default: 12)"),
    argument(
        "--no-check", dest="check", action="store_false",
        help="do not hold half of the photographs out, to see which effects move their errors"),
    argument("-o", "--output", default="scene.toml", metavar="FILE",
             help="pipeline file to write (default: scene.toml)"),
    JSON)
def fit(options: argparse.Namespace) -> int:
    """Estimate a camera's [scene] from photographs."""
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
            "check": [] if fitted.gap is None
            else library.comparison_tables.gap_records(fitted.gap),
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
        say(library.comparison_tables.gap_table(fitted.gap).text())
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


# --------------------------------------------------------------------------------------------------
# ``sweep diagnose``.

@command(
    "pipelines/diagnose/README.md", {
        "sweep diagnose rows.csv --camera camera.yaml --set size_m=0.153":
            "ranks the causes of wrong distances, and says what to measure next",
        "sweep diagnose rows.csv --set dictionary=tagStandard41h12 -o residuals.png":
            "draws what each cause leaves unexplained"},
    argument(
        "observations", metavar="OBSERVATIONS",
        help="CSV file with a row a pose: what the program said (tvec_x_m, tvec_y_m, tvec_z_m or "
        "range_m) and what was measured (tape_m, or x_m, y_m, z_m)"),
    argument("--camera", metavar="FILE",
             help="file of the calibration that the program believes"),
    settings_argument(
        "what the program believes: size_m, dictionary, refinement; zero_sd_m of the tape's zero "
        "point; compared, z or range"),
    figure_argument("draw the residuals of each cause"), FORM)
def diagnose(options: argparse.Namespace) -> int:
    """Find why poses differ from what a tape says."""
    quiet_matplotlib()
    return answered(options, library.diagnosis.diagnose(
        options.observations, camera=options.camera, output=options.output,
        **library.observations.settings_of(options.settings)))


# --------------------------------------------------------------------------------------------------
# ``sweep export``.

@command(
    "sweep/exchange/README.md", {
        "sweep export pipelines/smoke.toml images": "writes every image as a whole frame",
        "sweep export runs/smoke.zarr windows --windows":
            "writes the marker's surroundings alone, of the experiment of a store"},
    *PIPELINE,
    argument("folder", metavar="DIR", help="new or empty folder, or one to continue"),
    argument(
        "--windows", action="store_true", dest="windowed",
        help="images of the marker's surroundings, as a run searches them (default: whole "
        "frames)"),
    argument("--workers", type=int, metavar="N",
             help="number of processes that render (default: 1)"),
    argument("--yes", action="store_true",
             help="export also what takes more than 10 GB, or more than is free on the disk"),
    JSON)
def export(options: argparse.Namespace) -> int:
    """Write an experiment's images and truth for other programs."""
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


# --------------------------------------------------------------------------------------------------
# ``sweep score``.

@command(
    "sweep/exchange/README.md", {
        "sweep score images detections.csv --name mine":
            "compares them with the truth; writes runs/mine.zarr",
        "sweep score images tags.csv --pixel-center 0.5 --corner-order 'TR TL BL BR' --beside":
            "in other conventions, and beside the experiment's own detector"},
    argument("folder", metavar="DIR", help="an export, made by `sweep export`"),
    argument(
        "files", metavar="FILE", nargs="+",
        help="detections or poses, CSV; several files are compared on the same images"),
    argument(
        "--name", action="append", dest="names", metavar="NAME",
        help="name of the program that made a file (default: the file's); may be repeated"),
    argument("--pixel-center", default="0", metavar="C",
             help="coordinate of the centre of the first pixel: 0 (default), or 0.5"),
    argument(
        "--corner-order", default="TL TR BR BL", metavar="ORDER",
        help="order of the corners, as OpenCV draws the marker (default: TL TR BR BL)"),
    argument(
        "--frame", default="right up out", metavar="XYZ",
        help="directions of the marker's x, y, z for a viewer (default: right up out)"),
    argument(
        "--doubled", default="refuse", metavar="HOW",
        help="what an ID counts that is twice in an image: refuse (default), or nearest"),
    argument("--beside", action="store_true",
             help="also search the images with the experiment's own detector"),
    settings_argument("replace a value of the experiment, such as solver=ippe"), *new_store(),
    JSON)
def score(options: argparse.Namespace) -> int:
    """Score what another program detected in an export's images."""
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


# --------------------------------------------------------------------------------------------------
# ``sweep plugins``.

@command(
    "pipelines/plugins/README.md", {
        "sweep plugins pyapriltags": "imports one, and lists its settings",
        "sweep plugins check mine:SOLVER": "tries SOLVER of mine.py in this folder"},
    argument(
        "name", metavar="NAME", nargs="?",
        help="a plug-in to describe: the name of an installed one, or file:name in this folder; "
        "or the word check, and the plug-in to try behind it"),
    argument("tried", metavar="TRIED", nargs="?",
             help="behind check: a detector or a solver, also opencv or one of our solvers"),
    settings_argument("check: give a setting of it this TOML value"),
    argument(
        "--dictionary", metavar="DICTIONARY",
        help="check: dictionary of the markers (default: DICT_APRILTAG_36h11, or a detector's "
        "first)"),
    argument(
        "--time-limit", type=float, default=120.0, metavar="S", dest="time_limit_s",
        help="check: seconds after which one of its steps is taken for endless (default: 120)"),
    JSON)
def plugins(options: argparse.Namespace) -> int:
    """List, describe or check detectors and solvers of other packages."""
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
