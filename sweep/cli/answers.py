"""The commands of questions to stores: decisions, report, costs, comparisons, models."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import sweep
from sweep import library
from sweep.cli.command import (
    CONTINUES,
    FORM,
    JSON,
    LARGE_RUN,
    OVERWRITE,
    PIPELINE,
    SCHEDULER,
    STORE,
    WORKERS,
    answered,
    argument,
    command,
    command_line,
    figure_argument,
    names_of,
    new_store,
    quiet_matplotlib,
    read_pipeline,
    seconds,
    settings_argument,
)
from sweep.cli.prepared import announce_compilation, store_of
from sweep.errors import ArgumentError
from sweep.execution import BLOCK_TASK
from sweep.isolation.child_process import Child
from sweep.messages import notice, quoted

VALUES_OF_AXES = (
    "axes whose values are conditions, at each of which all must hold, such as "
    "distance_m,tilt_deg; others are pooled, with '' all (default: those of [require], else the "
    "axes of size, angle and boards)")


@command(
    "sweep/analysis/README.md", {
        "sweep require runs/smoke.zarr 'detection >= 0.2'":
            "exits with 0 if it is met, 1 if it is not, 3 if draws are too few to tell",
        "sweep require runs/smoke.zarr 'detection >= 0.2' --per tilt_deg --markdown":
            "prints a table of all tilts, for the summary of a job"},
    STORE,
    argument(
        "requirements", nargs="*", metavar="REQUIREMENT",
        help="what is required, in quotes: 'detection >= 0.95', 'range_error_p95_percent <= 1' "
        "(default: the section [require] of the store's pipeline)"),
    argument("--per", metavar="AXES", help=VALUES_OF_AXES),
    argument(
        "--pipeline", metavar="FILE",
        help="take [require] from this TOML file in place of the store's pipeline"),
    argument(
        "--at", action="append", metavar="NAME=VALUE,...",
        help="judge these values of axes alone, such as solver=ippe_square; may be repeated"),
    argument(
        "--against", metavar="STORE",
        help="also compare pose by pose with this older store: significantly worse is not met"),
    FORM)
def require(options: argparse.Namespace) -> int:
    """Decide whether a store's results meet requirements."""
    return answered(options, library.questions.require(
        options.store, options.requirements, per=names_of(options.per), at=options.at,
        pipeline=options.pipeline, against=options.against, every=options.markdown))


@command(
    "pipelines/sizes/README.md", {
        "sweep size pipelines/sizes/smallest_marker.toml":
            "how large a marker must be, and by which condition the next smaller one fails",
        "sweep size pipelines/sizes/smallest_marker.toml --set search.max_trials=2000 "
        "--store runs/quick.zarr --markdown":
            "with fewer trials of a condition at most; prints Markdown"},
    argument(
        "pipeline", metavar="PIPELINE",
        help="TOML file with the sections [require] and [search], or the store of a search"),
    settings_argument(
        "replace a value of the file by this TOML value, such as search.max_trials=2000"),
    *new_store(), *LARGE_RUN, seconds(20, "time limit of the measurement of costs"), FORM)
def size(options: argparse.Namespace) -> int:
    """Find the smallest or cheapest choice that will do."""
    pipeline = read_pipeline(options)
    library.choice_search.chosen_by(pipeline)
    announce_compilation(pipeline)
    options.stopped = CONTINUES
    with library.progress.progress_display() as bar:
        choice = sweep.size(
            pipeline, store=store_of(options), limit_s=options.limit_s, progress=bar,
            workers=options.workers, reuse=options.reuse, overwrite=options.overwrite,
            yes=options.yes)
    return answered(options, library.decisions.choice_findings(choice))


@command(
    "pipelines/limits/README.md", {
        "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' --along distance_m":
            "finds from how far a marker is detected, at each tilt",
        "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' "
        "--along distance_m --at-all tilt_deg -o limit.svg":
            "finds up to which distance it is at all tilts, with a figure"},
    *PIPELINE,
    argument(
        "--require", action="append", metavar="REQUIREMENT",
        help="what must hold, in quotes: 'detection >= 0.9'; may be repeated, all hold together "
        "(default: the section [require] of the file)"),
    argument(
        "--along", default="", metavar="AXIS",
        help="the axis of the scene that is searched, such as distance_m"),
    argument(
        "--per", metavar="AXES",
        help="axes of which each combination of values has its own limit, such as "
        "tilt_deg,noise_grey (default: all; with '' none); others are pooled"),
    argument(
        "--at-all", metavar="AXES",
        help="axes at all of whose values the requirements must hold"),
    argument(
        "--max-trials", type=int, metavar="N",
        help="the most trials of a cell (default: that of [search], else 2400)"),
    *new_store("runs/NAME-limit-AXIS.zarr"), *LARGE_RUN, SCHEDULER,
    figure_argument("draw the limits"), FORM)
def limit(options: argparse.Namespace) -> int:
    """Find how far along an axis requirements are met."""
    quiet_matplotlib()
    output = library.output_file.figure_file(options.output)
    options.stopped = CONTINUES
    with Child(BLOCK_TASK) as child, library.progress.progress_display() as display:
        limits, summary = library.limit_search.search_limits(
            options.pipeline, require=options.require, along=options.along,
            per=names_of(options.per), at_all=names_of(options.at_all),
            max_trials=options.max_trials, settings=options.settings,
            store=options.store, begin=announce_compilation, workers=options.workers,
            scheduler=options.scheduler, reuse=options.reuse, overwrite=options.overwrite,
            yes=options.yes, progress=display, child=child)
    for line in summary.warnings if summary is not None else ():
        notice(line)
    if output is not None:
        library.figure.write_figure([library.limit_figure.limit_figure(limits)], output)
    return answered(options, library.limit_figure.limit_findings(limits))


@command(
    "sweep/analysis/README.md", {
        "sweep report runs/smoke.zarr --require 'detection >= 0.9'":
            "writes report.html, which begins with how far that is met",
        "sweep report runs/smoke.zarr -o answer.md --figures figures":
            "writes Markdown, and each figure as SVG and PNG"},
    STORE,
    argument("-o", "--output", metavar="FILE",
             help="file to write (default: report.html, or report.md with --format md)"),
    argument("--format", choices=("html", "md"), dest="form",
             help="one HTML page, or Markdown with a folder of figures (default: by FILE's "
             "suffix)"),
    argument("--figures", metavar="DIR", help="also write each figure into DIR, as SVG and PNG"),
    argument(
        "--require", action="append", metavar="REQUIREMENT", dest="requirements",
        help="what is required, in quotes: 'detection >= 0.99', 'range_error_p95_percent <= 1'; "
        "the report begins with whether it is met; may be repeated (default: the section "
        "[require] of the store's pipeline)"),
    argument("--per", action="append", metavar="AXES", default=None, help=VALUES_OF_AXES),
    argument("--error-model", action="append", metavar="FILE",
             help="also write the error models as JSON, as `sweep error-model` does"),
    JSON)
def report(options: argparse.Namespace) -> int:
    """Write a report of a store: answer, figures, example scenes."""
    quiet_matplotlib()
    if options.json and library.output_file.is_standard_stream(Path(options.output or "")):
        raise ArgumentError("json", "", "and the report both go to standard output; choose -o FILE")
    return answered(options, sweep.write_report(
        options.store, options.output, require=options.requirements,
        per=names_of(None if options.per is None else ",".join(options.per)), form=options.form,
        figures=options.figures, error_model=options.error_model, command=command_line(options)))


@command(
    "sweep/tradeoff/README.md", {
        "sweep tradeoff runs/tradeoff.zarr --per side_px -o trade.svg":
            "compares the configurations at each size of the marker, with a figure",
        "sweep tradeoff pipelines/tradeoff.toml --criterion range_p95_percent --markdown":
            "runs the pipeline first; ranks by the range error; prints Markdown"},
    argument("source", metavar="STORE|PIPELINE",
             help="a finished store, or a TOML file, which is run into its default store first"),
    argument("--per", action="append", metavar="AXIS",
             help="scene axis whose values are separate conditions, such as side_px; may be "
             "repeated"),
    argument("--criterion", default="rotation_p95_deg", metavar="NAME",
             help="error that ranks the configurations (default: rotation_p95_deg)"),
    seconds(60, "time limit of the cost measurement"),
    argument("--budget-ms", type=float, metavar="MS",
             help="name the most accurate configuration that costs at most so many ms a frame"),
    figure_argument("draw a figure"), FORM)
def tradeoff(options: argparse.Namespace) -> int:
    """Compare configurations: cost and accuracy on the same images."""
    quiet_matplotlib()
    if options.source.lower().endswith(".toml"):
        options.stopped = CONTINUES
    return answered(options, sweep.measure_tradeoff(
        options.source, per=options.per, criterion=options.criterion, limit_s=options.limit_s,
        budget_ms=options.budget_ms, output=options.output, progress=True))


@command(
    "pipelines/photographs/README.md", {
        "sweep compare runs/shots.zarr scene.toml":
            "simulates each marker at its pose with this scene; prints the gaps",
        "sweep compare runs/opencv4.zarr runs/opencv5.zarr":
            "counts what differs between versions of OpenCV on the same images"},
    argument(
        "photographs", metavar="STORE",
        help="store of photographs, as `sweep photos` makes it; or any store, to be compared with "
        "another one of the same pipeline"),
    argument(
        "scene", metavar="SIMULATION",
        help="store of a simulation, or a TOML file with a section [scene], such as `sweep fit` "
        "writes: the photographs' markers are then simulated with it, at the same poses; or a "
        "store that another version of OpenCV made of the first store's pipeline"),
    argument(
        "--bins", action="append", metavar="NAME=EDGES",
        help="compare in bins of a variable of the scene, such as side_px=15,20,30,50; may be "
        "repeated (default: none for simulated photographs, else quarters of side_px)"),
    argument("--repeats", type=int, default=1, metavar="N",
             help="how often each photograph is simulated (default: 1)"),
    argument(
        "--store", metavar="STORE",
        help="path or URL of the store of what is simulated (default: beside the photographs', "
        "with the names of both)"),
    WORKERS, OVERWRITE, figure_argument("draw the distributions of the errors"), FORM)
def compare(options: argparse.Namespace) -> int:
    """Compare photographs with a simulation, or two stores."""
    quiet_matplotlib()
    options.stopped = CONTINUES
    return answered(options, sweep.compare(
        options.photographs, options.scene, bins=dict(map(_edges, options.bins)),
        output=options.output, repeats=options.repeats, store=options.store,
        workers=options.workers, overwrite=options.overwrite, progress=True))


def _edges(text: str) -> tuple[str, list[float]]:
    """Return the name and the edges of bins."""
    name, equals, edges = text.partition("=")
    try:
        numbers = [float(each) for each in edges.split(",")]
    except ValueError:
        numbers = []
    if not equals or not numbers:
        raise ArgumentError(
            "bins", text, "expected a variable and increasing edges, such as side_px=15,20,30,50"
        )
    return name.strip(), numbers


@command(
    "sweep/analysis/README.md", {
        "sweep error-model runs/tags.zarr": "writes error_model.json and prints a table",
        "sweep error-model runs/tags.zarr --at solver=ippe_square -o tag.json":
            "writes the models of one solver"},
    STORE,
    argument(
        "-o", "--output", action="append", metavar="FILE", dest="error_model",
        help="JSON file to write: formula, coefficients, units, the region that was seen "
        "(default: error_model.json)"),
    argument("--at", action="append", metavar="NAME=VALUE,...",
             help="only these values of an axis, such as solver=ippe; may be repeated"),
    FORM)
def error_model(options: argparse.Namespace) -> int:
    """Write models of the pose's error as JSON."""
    outputs = options.error_model or ["error_model.json"]
    for output in outputs:
        library.error_model_file.check_error_model_file(output)
    data = library.report_data.read_report_data(options.store)
    results = library.decisions.selected(data.results, options.at, data.pipeline)
    data = dataclasses.replace(data, results=results)
    return answered(options, library.error_model_file.model_findings(data, outputs))


VIEWS = "10,20,40"


@command(
    "pipelines/calibration/README.md", {
        "sweep calibration runs/calibration.zarr":
            "errors and coverage for 10, 20 and 40 views",
        "sweep calibration runs/calibration.zarr --views 5,20 --coefficients 2":
            "fewer views, and a lens of two coefficients"},
    STORE,
    argument("--views", default=VIEWS, metavar="N,...",
             help=f"numbers of views in a calibration (default: {VIEWS})"),
    argument("--points", choices=("chessboard", "markers"),
             help="points of the board that are used (default: the chessboard's if there is one)"),
    argument(
        "--coefficients", type=int, default=5, metavar="N",
        help="lens coefficients that are estimated: 0, 1 (k1), 2 (k2), 4 (p1, p2), 5 (k3) "
        "(default: 5)"),
    argument("--target-m", type=float, default=3.0, metavar="M",
             help="distance of the target whose depth is estimated with each camera (default: 3)"),
    FORM)
def calibration(options: argparse.Namespace) -> int:
    """Calibrate cameras from views of a board, and judge them."""
    try:
        views = [int(each) for each in options.views.split(",")]
    except ValueError:
        raise ArgumentError(
            "views", options.views, f"expected whole numbers, such as {VIEWS}"
        ) from None
    found = library.camera_calibration.camera_calibrations(
        library.lifecycle.open_dataset(options.store), views, points=options.points,
        coefficients=options.coefficients, target_m=options.target_m)
    return answered(options, library.comparison_tables.calibration_findings(
        library.camera_calibration.calibration_summary(found), quoted(options.store)))


# --------------------------------------------------------------------------------------------------
# ``sweep reference``.

@command(
    "pipelines/README.md", {
        "sweep reference": "lists the subjects: sections of a pipeline, effects, variables, ...",
        "sweep reference camera tilt_deg": "prints the parameters of [camera], and tilt_deg"},
    argument("names", metavar="NAME", nargs="*", help="a subject, or a parameter"),
    *FORM)
def reference(options: argparse.Namespace) -> int:
    """Explain parameters, effects, solvers, variables and flags."""
    return answered(options, library.reference.reference(options.names))
