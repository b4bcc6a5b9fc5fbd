"""The commands of your camera and of other programs: photos, fit, export, score, plugins."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sweep import library
from sweep.cli.command import (
    CONTINUES,
    SESSION,
    announce_compilation,
    command,
    executed,
    findings,
    quiet_matplotlib,
    read_pipeline,
    summarised,
)
from sweep.errors import ArgumentError
from sweep.messages import byte_count, notice, quoted

if TYPE_CHECKING:
    from sweep.conformance.check import ConformanceReport
    from sweep.report.table import Findings


@command("pipelines/photographs/README.md", {
    "sweep photos shots --camera camera.yaml --board BOARD.toml":
        "compares each marker with the board without it; writes runs/shots.zarr",
    "sweep photos shots --camera calibrate --board BOARD.toml "
    "--set 'cornerRefinementMethod=[\"none\", \"subpix\"]'":
        "calibrates the camera from the same photographs; compares two refinements"})
def photos(
    folders: Sequence[str], *, camera: str | None = None, board: str | None = None,
    poses: str | None = None, stereo: str | None = None, settings: Sequence[str] = (),
    store: str | None = None, overwrite: bool = False, workers: int | None = None,
) -> Findings:
    """Measure detectors and estimators on photographs of markers.

    Parameters
    ----------
    folders : FOLDER
        Photographs (PNG, JPEG, BMP, PGM) of one camera; with --stereo two folders, or one of
        images whose halves are the left and the right camera's.
    camera : --camera FILE
        File of the camera's calibration, or `calibrate`: from the board in the photographs.
    board : --board FILE
        TOML file of the board; the truth of a marker is the pose by all corners but its own.
    poses : --poses FILE
        The true poses, CSV as `sweep score` reads it.
    stereo : --stereo FILE
        Calibration of a stereo camera (K1, D1, K2, D2, R, T); the truth is the pose in the other
        camera's image.
    settings : --set KEY=VALUE
        Set a parameter of detector or estimator; a list compares its values; may be repeated.
    store : --store STORE
        Path or URL of the store (default: runs/NAME.zarr with the folder's name).
    overwrite, workers
        As for `run`.
    """
    SESSION.stopped = "stopped before anything was computed"
    home, name = library.prepare.record_home(store)
    prepared = library.prepare.prepare(
        folders, camera, board=board, poses=poses, stereo=stereo, settings=settings, home=home,
        name=name, overwrite=overwrite)
    summary = executed(
        prepared.pipeline, store or str(Path(home) / f"{prepared.pipeline.name}.zarr"),
        prepared.lines, workers, overwrite=overwrite)
    count = prepared.pipeline.size(library.parameters.Stage.detection)
    each = f" with {count} detector settings" if count > 1 else ""
    return summarised(
        summary, f"{prepared.markers:,} markers in {prepared.photographs:,} photographs: "
        f"{summary.detected_line}{each}", photographs=prepared.lines)


@command("pipelines/photographs/README.md", {
    "sweep fit shots --camera camera.yaml --board BOARD.toml":
        "writes scene.toml: blur, sharpening, tone, noise, geometry, print",
    "sweep fit shots --camera calibrate --board BOARD.toml -o webcam.toml":
        "calibrates the camera from the same photographs"})
def fit(
    folders: Sequence[str], *, camera: str | None = None, board: str | None = None,
    poses: str | None = None, stereo: str | None = None, settings: Sequence[str] = (),
    markers: int = 12, check: bool = True, output: str = "scene.toml",
) -> Findings:
    """Estimate a camera's [scene] from photographs.

    Parameters
    ----------
    folders, camera, board, poses, stereo
        As for `photos`.
    settings : --set KEY=VALUE
        Dictionary and size_m of single markers; detectors and estimators whose errors are compared
        (default: two refinements); may be repeated.
    markers : --markers N
        The most markers of a photograph that are fitted, well spread over the frame (default: 12).
    check
        Do not hold half of the photographs out, to see which effects bring errors nearer to theirs.
    output : -o --output FILE
        Pipeline file to write (default: scene.toml).
    """
    path = Path(output)
    library.output_file.check_output_file(path)
    fitted = library.folders.fit_folder(
        folders, camera, board=board, poses=poses, stereo=stereo, settings=settings,
        markers=markers, check=check)
    for line in fitted.lines:
        notice(line)
    library.output_file.write_output_file(path, fitted.text.encode())
    found, gap = fitted.found, fitted.gap
    rows = [
        (each.name, each.parameter, library.table.Value(
            each.estimate.value, each.estimate.low, each.estimate.high)
         if math.isfinite(each.estimate.low) else each.estimate.value,
         f"{'kept' if each.kept else 'left out'}{': ' if each.reason else ''}{each.reason}")
        for each in found.terms]
    lines = [library.table.Table.of(
        f"{found.markers} markers in {found.photographs} photographs; 95 % intervals by photograph",
        ("term", "parameter", "value", ""), rows, stub=2, words=True),
        *(f"- {line}" for line in found.lines)]
    held_out = None if gap is None else library.comparison_tables.gap_table(gap)
    if held_out is not None:
        lines += ["", "Half of the photographs, simulated with the scene of the others:", held_out]
    store = f"runs/{fitted.pipeline.name}.zarr"
    following = quoted("sweep", "compare", store, output)
    if library.locations.exists(store):
        lines.append(f"beside the photographs: {following}")
    else:
        given = {"--camera": camera, "--board": board, "--poses": poses, "--stereo": stereo}
        words = [word for flag, value in given.items() if value is not None
                 for word in (flag, value)]
        words += [word for setting in settings for word in ("--set", setting)]
        lines.append(f"measures the photographs, for {following}: "
                     f"{quoted('sweep', 'photos', *folders, *words)}")
    return findings(lines, {
        "scene": found.scene, "photographs": found.photographs, "markers": found.markers,
        "terms": [each.as_json() for each in found.terms], "lines": list(found.lines),
        "check": [] if held_out is None else held_out.as_json()["rows"], "output": output,
    }, 0, f"sweep run {quoted(output)}", "simulates this camera")


@command("pipelines/diagnose/README.md", {
    "sweep diagnose rows.csv --camera camera.yaml --set size_m=0.153":
        "ranks the causes of wrong distances, and says what to measure next",
    "sweep diagnose rows.csv --set dictionary=tagStandard41h12 -o residuals.png":
        "draws what each cause leaves unexplained"})
def diagnose(
    observations: str, *, camera: str | None = None, settings: Sequence[str] = (),
    output: str | None = None,
) -> Findings:
    """Find why poses differ from what a tape says.

    Parameters
    ----------
    observations : OBSERVATIONS
        CSV file with a row a pose: what the program said (tvec_x_m, tvec_y_m, tvec_z_m or range_m)
        and what was measured (tape_m, or x_m, y_m, z_m).
    camera : --camera FILE
        File of the calibration that the program believes.
    settings : --set KEY=VALUE
        What the program believes: size_m, dictionary, refinement; zero_sd_m of the tape's zero
        point; compared, z or range; may be repeated.
    output : -o --output FIGURE
        Draw the residuals of each cause into this PNG or SVG file.
    """
    quiet_matplotlib()
    return library.diagnosis.diagnose(
        observations, camera=camera, output=output, **library.observations.settings_of(settings))


@command("sweep/exchange/README.md", {
    "sweep export pipelines/smoke.toml images": "writes every image as a whole frame",
    "sweep export runs/smoke.zarr windows --windows":
        "writes the marker's surroundings alone, of the experiment of a store"})
def export(
    pipeline: str, folder: str, *, settings: Sequence[str] = (), windowed: bool = False,
    workers: int | None = None, yes: bool = False,
) -> Findings:
    """Write an experiment's images and truth for other programs.

    Parameters
    ----------
    pipeline, settings
        As for `run`.
    folder : DIR
        New or empty folder, or one to continue.
    windowed : --windows
        Images of the marker's surroundings, as a run searches them (default: whole frames).
    workers : --workers N
        Number of processes that render (default: 1).
    yes
        Export also what takes more than 10 GB, or more than is free on the disk.
    """
    read = read_pipeline(pipeline, settings)
    announce_compilation(read)
    SESSION.stopped = CONTINUES
    watched = sys.stderr is not None and sys.stderr.isatty()

    def report(done: int, count: int) -> None:
        if watched:
            end = "\n" if done == count else ""
            print(f"\r{done:,} of {count:,} scenes", end=end, file=sys.stderr, flush=True)

    result = library.export.export(
        read, folder, windowed=windowed, workers=workers, yes=yes, progress=report)
    without = f", {result.invisible:,} scenes without" if result.invisible else ""
    lines = [f"{result.folder}: {result.images:,} images, {byte_count(result.bytes)}{without}"]
    if result.kept:
        lines.append(f"{result.kept:,} were there already, {result.written:,} written now")
    if result.damaged:
        lines.append(f"{result.damaged:,} were missing or changed, and are written again")
    place = quoted(result.folder)
    return findings(lines, result, 0, f"sweep score {place} detections.csv",
                    f"{place}/README.md has the conventions")


@command("sweep/exchange/README.md", {
    "sweep score images detections.csv --name mine":
        "compares them with the truth; writes runs/mine.zarr",
    "sweep score images tags.csv --pixel-center 0.5 --corner-order 'TR TL BL BR' --beside":
        "in other conventions, and beside the experiment's own detector"})
def score(
    folder: str, files: Sequence[str], *, names: Sequence[str] = (), pixel_center: float = 0.0,
    corner_order: str = "TL TR BR BL", frame: str = "right up out",
    doubled: Literal["refuse", "nearest"] = "refuse", beside: bool = False,
    settings: Sequence[str] = (), store: str | None = None, overwrite: bool = False,
    workers: int | None = None,
) -> Findings:
    """Score what another program detected in an export's images.

    Parameters
    ----------
    folder : DIR
        An export, made by `sweep export`.
    files : FILE
        Detections or poses, CSV; several files are compared on the same images.
    names : --name NAME
        Name of the program that made a file (default: the file's); may be repeated.
    pixel_center : --pixel-center C
        Coordinate of the centre of the first pixel: 0 (default), or 0.5.
    corner_order : --corner-order ORDER
        Order of the corners, as OpenCV draws the marker (default: TL TR BR BL).
    frame : --frame XYZ
        Directions of the marker's x, y, z for a viewer (default: right up out).
    doubled
        What an ID counts that is twice in an image: refuse (default), or nearest.
    beside
        Also search the images with the experiment's own detector.
    settings, store, overwrite, workers
        As for `run`.
    """
    scored = library.score.prepare(
        folder, files, names=names,
        conventions=library.answers.Conventions(pixel_center, corner_order, frame),
        doubled=doubled, beside=beside, settings=settings)
    summary = executed(
        scored.pipeline, store or f"runs/{scored.name}.zarr", scored.lines, workers,
        overwrite=overwrite)
    return summarised(
        summary, f"{summary.poses:,} poses, {summary.detected_line}", answers=scored.lines)


@command("pipelines/plugins/README.md", {
    "sweep plugins pyapriltags": "imports one, and lists its settings",
    "sweep plugins check mine:SOLVER": "tries SOLVER of mine.py in this folder"})
def plugins(
    name: str | None = None, tried: str | None = None, *, settings: Sequence[str] = (),
    dictionary: str | None = None, time_limit_s: float = 120.0,
) -> Findings:
    """List, describe or check detectors and solvers of other packages.

    Parameters
    ----------
    name : NAME
        A plug-in to describe: the name of an installed one, or file:name in this folder; or the
        word check, and the plug-in to try behind it.
    tried : TRIED
        Behind check: a detector or a solver, also opencv or one of our solvers.
    settings : --set KEY=VALUE
        Check: give a setting of it this TOML value; may be repeated.
    dictionary : --dictionary DICTIONARY
        Check: dictionary of the markers (default: DICT_APRILTAG_36h11, or a detector's first).
    time_limit_s : --time-limit S
        Check: seconds after which one of its steps is taken for endless (default: 120).
    """
    if name == "check" and tried is not None:
        return _checked(library.check.check_plugin(
            tried, dictionary, settings, time_limit_s=time_limit_s))
    if tried is not None:
        raise ArgumentError(
            "tried", tried, f"expected one name; `sweep plugins check {tried}` tries it")
    if settings or dictionary:
        raise ArgumentError(
            "settings" if settings else "dictionary", "", "expected `check` and a name")
    if name is None:
        every = library.declared.installed()
        lines = [f"{each['kind']:10} {each['name']:20} of {each['distribution']}"
                 for each in every]
        return findings(lines or ["no plug-in is installed"], {"plugins": every}, 0,
                        "sweep plugins NAME", "describes one, and says whether it can be used")
    found = [plugin.to_json() for plugin in library.declared.described(name)]
    return findings(
        [line for plugin in found for line in _plugin_lines(plugin)], {"plugins": found})


def _plugin_lines(plugin: dict[str, Any]) -> list[str]:
    """Return the distributions, dictionaries and settings of a plug-in."""
    meaning = f": {plugin['meaning']}" if plugin["meaning"] else ""
    known = [f"  knows      {', '.join(plugin['dictionaries'])}"] if plugin["dictionaries"] else []
    return [
        f"{plugin['kind']} {plugin['name']}{meaning}",
        *(f"  needs      {name} {version}" for name, version in plugin["versions"].items()),
        *known,
        *(f"  setting    {each['name']} = {each['default']}"
          f"{' ' + each['unit'] if 'unit' in each else ''}: {each['meaning']}"
          for each in plugin["settings"])]


def _checked(report: ConformanceReport) -> Findings:
    """Return the findings of a check of a plug-in."""
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    whole = f"{report.kind} {report.name}{f' ({versions})' if versions else ''}"
    conforms = "conforms" if report.conforms else "does not conform"
    lines = [f"{whole} on {report.dictionary}: {conforms}",
             *(f"  {each.verdict:5}  {each.check:22}  {each.text}" for each in report.findings)]
    key = "detector" if report.kind == "detector" else "solver"
    chosen = shlex.quote(f'{key}="{report.name}"')
    then = (f"sweep run PIPELINE --set {chosen}", "measures it on your scenes")
    return findings(lines, {
        "name": report.name, "kind": report.kind, "dictionary": report.dictionary,
        "versions": report.versions, "conforms": report.conforms, **report.numbers,
        "findings": [{"check": each.check, "verdict": each.verdict, "text": each.text}
                     for each in report.findings],
    }, int(not report.conforms), *(then if report.conforms else ("", "")))
