"""The commands of questions to stores: decisions, report, costs, comparisons, models."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import sweep
from sweep import library
from sweep.cli.command import (
    CONTINUES,
    SESSION,
    Names,
    announce_compilation,
    command,
    command_line,
    quiet_matplotlib,
    read_pipeline,
    store_of,
)
from sweep.errors import ArgumentError
from sweep.execution import BLOCK_TASK
from sweep.isolation.child_process import Child
from sweep.messages import notice, quoted

if TYPE_CHECKING:
    from sweep.report.table import Findings


@command("sweep/analysis/README.md", {
    "sweep require runs/smoke.zarr 'detection >= 0.2'":
        "exits with 0 if it is met, 1 if it is not, 3 if draws are too few to tell",
    "sweep require runs/smoke.zarr 'detection >= 0.2' --per tilt_deg --markdown":
        "prints a table of all tilts, for the summary of a job"})
def require(
    store: str, requirements: Sequence[str] = (), *, per: Names = None,
    pipeline: str | None = None, at: Sequence[str] = (), against: str | None = None,
) -> Findings:
    """Decide whether a store's results meet requirements.

    Parameters
    ----------
    store
        As for `repro`.
    requirements : REQUIREMENT
        What is required, in quotes: 'detection >= 0.95', 'range_error_p95_percent <= 1' (default:
        the section [require] of the store's pipeline).
    per : --per AXES
        Axes whose values are conditions, at each of which all must hold, such as
        distance_m,tilt_deg; others are pooled, with '' all (default: those of [require], else the
        axes of size, angle and boards).
    pipeline : --pipeline FILE
        Take [require] from this TOML file in place of the store's pipeline.
    at : --at NAME=VALUE,...
        Judge these values of axes alone, such as solver=ippe_square; may be repeated.
    against : --against STORE
        Also compare pose by pose with this older store: significantly worse is not met.
    """
    return sweep.require(
        store, requirements, per=per, at=at, pipeline=pipeline, against=against,
        every=SESSION.form == "markdown")


@command("pipelines/sizes/README.md", {
    "sweep size pipelines/sizes/smallest_marker.toml":
        "how large a marker must be, and by which condition the next smaller one fails",
    "sweep size pipelines/sizes/smallest_marker.toml --set search.max_trials=2000 "
    "--store runs/quick.zarr --markdown":
        "with fewer trials of a condition at most; prints Markdown"})
def size(
    pipeline: str, *, settings: Sequence[str] = (), store: str | None = None,
    overwrite: bool = False, workers: int | None = None, reuse: Sequence[str] = (),
    yes: bool = False, limit_s: float = 20.0,
) -> Findings:
    """Find the smallest or cheapest choice that will do.

    Parameters
    ----------
    pipeline : PIPELINE
        TOML file with the sections [require] and [search], or the store of a search.
    settings, store, overwrite, workers, reuse, yes
        As for `run`.
    limit_s : --seconds S
        Time limit of the measurement of costs, in seconds (default: 20).
    """
    read = read_pipeline(pipeline, settings)
    library.choice_search.chosen_by(read)
    announce_compilation(read)
    SESSION.stopped = CONTINUES
    with library.progress.progress_display() as bar:
        choice = sweep.size(
            read, store=store_of(pipeline, store), limit_s=limit_s, progress=bar,
            workers=workers, reuse=reuse, overwrite=overwrite, yes=yes)
    return library.decisions.choice_findings(choice)


@command("pipelines/limits/README.md", {
    "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' --along distance_m":
        "finds from how far a marker is detected, at each tilt",
    "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' "
    "--along distance_m --at-all tilt_deg -o limit.svg":
        "finds up to which distance it is at all tilts, with a figure"})
def limit(
    pipeline: str, *, settings: Sequence[str] = (), require: Sequence[str] = (), along: str = "",
    per: Names = None, at_all: Names = None, max_trials: int | None = None,
    store: str | None = None, overwrite: bool = False, workers: int | None = None,
    reuse: Sequence[str] = (), yes: bool = False, scheduler: str | None = None,
    output: str | None = None,
) -> Findings:
    """Find how far along an axis requirements are met.

    Parameters
    ----------
    pipeline, settings, overwrite, workers, reuse, yes, scheduler
        As for `run`.
    require : --require REQUIREMENT
        What must hold, in quotes: 'detection >= 0.9'; may be repeated, all hold together (default:
        the section [require] of the file).
    along : --along AXIS
        The axis of the scene that is searched, such as distance_m.
    per : --per AXES
        Axes of which each combination of values has its own limit, such as tilt_deg,noise_grey
        (default: all; with '' none); others are pooled.
    at_all : --at-all AXES
        Axes at all of whose values the requirements must hold.
    max_trials : --max-trials N
        The most trials of a cell (default: that of [search], else 2400).
    store : --store STORE
        Path or URL of the store (default: runs/NAME-limit-AXIS.zarr).
    output : -o --output FIGURE
        Draw the limits into this PNG or SVG file.
    """
    quiet_matplotlib()
    figure = library.output_file.figure_file(output)
    SESSION.stopped = CONTINUES
    with Child(BLOCK_TASK) as child, library.progress.progress_display() as display:
        limits, summary = library.runner.search_limits(
            pipeline, require=require, along=along, per=per, at_all=at_all, max_trials=max_trials,
            settings=settings, store=store, begin=announce_compilation, workers=workers,
            scheduler=scheduler, reuse=reuse, overwrite=overwrite, yes=yes, progress=display,
            child=child)
    for line in summary.warnings if summary is not None else ():
        notice(line)
    if figure is not None:
        library.figure.write_figure([library.decisions.limit_figure(limits)], figure)
    return library.decisions.limit_findings(limits)


@command("sweep/analysis/README.md", {
    "sweep report runs/smoke.zarr --require 'detection >= 0.9'":
        "writes report.html, which begins with how far that is met",
    "sweep report runs/smoke.zarr -o answer.md --figures figures":
        "writes Markdown, and each figure as SVG and PNG"})
def report(
    store: str, *, output: str | None = None, form: Literal["html", "md"] | None = None,
    figures: str | None = None, requirements: Sequence[str] = (), per: Names = None,
    error_model: Sequence[str] = (),
) -> Findings:
    """Write a report of a store: answer, figures, example scenes.

    Parameters
    ----------
    store
        As for `repro`.
    output : -o --output FILE
        File to write (default: report.html, or report.md with --format md).
    form : --format
        One HTML page, or Markdown with a folder of figures (default: by FILE's suffix).
    figures : --figures DIR
        Also write each figure into DIR, as SVG and PNG.
    requirements : --require REQUIREMENT
        What is required, in quotes: 'detection >= 0.99', 'range_error_p95_percent <= 1'; the
        report begins with whether it is met; may be repeated (default: the section [require] of
        the store's pipeline).
    per
        As for `require`.
    error_model : --error-model FILE
        Also write the error models as JSON, as `sweep error-model` does.
    """
    quiet_matplotlib()
    if SESSION.form == "json" and library.output_file.is_standard_stream(Path(output or "")):
        raise ArgumentError("json", "", "and the report both go to standard output; choose -o FILE")
    return sweep.write_report(
        store, output, require=requirements, per=per, form=form, figures=figures,
        error_model=error_model, command=command_line())


@command("sweep/tradeoff/README.md", {
    "sweep tradeoff runs/tradeoff.zarr --per side_px -o trade.svg":
        "compares the configurations at each size of the marker, with a figure",
    "sweep tradeoff pipelines/tradeoff.toml --criterion range_p95_percent --markdown":
        "runs the pipeline first; ranks by the range error; prints Markdown"})
def tradeoff(
    source: str, *, per: Names = None, criterion: str = "rotation_p95_deg",
    limit_s: float = 60.0, budget_ms: float | None = None, output: str | None = None,
) -> Findings:
    """Compare configurations: cost and accuracy on the same images.

    Parameters
    ----------
    source : STORE|PIPELINE
        A finished store, or a TOML file, which is run into its default store first.
    per : --per AXIS
        Scene axis whose values are separate conditions, such as side_px; may be repeated.
    criterion : --criterion NAME
        Error that ranks the configurations (default: rotation_p95_deg).
    limit_s : --seconds S
        Time limit of the cost measurement, in seconds (default: 60).
    budget_ms : --budget-ms MS
        Name the most accurate configuration that costs at most so many ms a frame.
    output : -o --output FIGURE
        Draw a figure into this PNG or SVG file.
    """
    quiet_matplotlib()
    if source.lower().endswith(".toml"):
        SESSION.stopped = CONTINUES
    return sweep.measure_tradeoff(
        source, per=per or (), criterion=criterion, limit_s=limit_s, budget_ms=budget_ms,
        output=output, progress=True)


@command("pipelines/photographs/README.md", {
    "sweep compare runs/shots.zarr scene.toml":
        "simulates each marker at its pose with this scene; prints the gaps",
    "sweep compare runs/opencv4.zarr runs/opencv5.zarr":
        "counts what differs between versions of OpenCV on the same images"})
def compare(
    photographs: str, scene: str, *, bins: Sequence[str] = (), repeats: int = 1,
    store: str | None = None, workers: int | None = None, overwrite: bool = False,
    output: str | None = None,
) -> Findings:
    """Compare photographs with a simulation, or two stores.

    Parameters
    ----------
    photographs : STORE
        Store of photographs, as `sweep photos` makes it; or any store, to be compared with another
        one of the same pipeline.
    scene : SIMULATION
        Store of a simulation, or a TOML file with a section [scene], such as `sweep fit` writes:
        the photographs' markers are then simulated with it, at the same poses; or a store that
        another version of OpenCV made of the first store's pipeline.
    bins : --bins NAME=EDGES
        Compare in bins of a variable of the scene, such as side_px=15,20,30,50; may be repeated
        (default: none for simulated photographs, else quarters of side_px).
    repeats : --repeats N
        How often each photograph is simulated (default: 1).
    store : --store STORE
        Path or URL of the store of what is simulated (default: beside the photographs', with the
        names of both).
    workers, overwrite
        As for `run`.
    output : -o --output FIGURE
        Draw the distributions of the errors into this PNG or SVG file.
    """
    quiet_matplotlib()
    SESSION.stopped = CONTINUES
    return sweep.compare(
        photographs, scene, bins=dict(map(_edges, bins)), output=output, repeats=repeats,
        store=store, workers=workers, overwrite=overwrite, progress=True)


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


@command("sweep/analysis/README.md", {
    "sweep error-model runs/tags.zarr": "writes error_model.json and prints a table",
    "sweep error-model runs/tags.zarr --at solver=ippe_square -o tag.json":
        "writes the models of one solver"})
def error_model(
    store: str, *, error_model: Sequence[str] = (), at: Sequence[str] = ()
) -> Findings:
    """Write models of the pose's error as JSON.

    Parameters
    ----------
    store
        As for `repro`.
    error_model : -o --output FILE
        JSON file to write: formula, coefficients, units, the region that was seen (default:
        error_model.json).
    at : --at NAME=VALUE,...
        Only these values of an axis, such as solver=ippe; may be repeated.
    """
    outputs = error_model or ["error_model.json"]
    for output in outputs:
        library.error_model_file.check_error_model_file(output)
    data = library.report_data.read_report_data(store)
    results = library.decisions.selected(data.results, at, data.pipeline)
    data = dataclasses.replace(data, results=results)
    return library.error_model_file.model_findings(data, outputs)


VIEWS = "10,20,40"


@command("pipelines/calibration/README.md", {
    "sweep calibration runs/calibration.zarr": "errors and coverage for 10, 20 and 40 views",
    "sweep calibration runs/calibration.zarr --views 5,20 --coefficients 2":
        "fewer views, and a lens of two coefficients"})
def calibration(
    store: str, *, views: str = VIEWS, points: Literal["chessboard", "markers"] | None = None,
    coefficients: int = 5, target_m: float = 3.0,
) -> Findings:
    """Calibrate cameras from views of a board, and judge them.

    Parameters
    ----------
    store
        As for `repro`.
    views : --views N,...
        Numbers of views in a calibration (default: 10,20,40).
    points
        Points of the board that are used (default: the chessboard's if there is one).
    coefficients : --coefficients N
        Lens coefficients that are estimated: 0, 1 (k1), 2 (k2), 4 (p1, p2), 5 (k3) (default: 5).
    target_m : --target-m M
        Distance of the target whose depth is estimated with each camera (default: 3).
    """
    try:
        counts = [int(each) for each in views.split(",")]
    except ValueError:
        raise ArgumentError(
            "views", views, f"expected whole numbers, such as {VIEWS}") from None
    found = library.camera_calibration.camera_calibrations(
        library.lifecycle.open_dataset(store), counts, points=points,
        coefficients=coefficients, target_m=target_m)
    return library.comparison_tables.calibration_findings(
        library.camera_calibration.calibration_summary(found), quoted(store))


@command("pipelines/README.md", {
    "sweep reference": "lists the subjects: sections of a pipeline, effects, variables, ...",
    "sweep reference camera tilt_deg": "prints the parameters of [camera], and tilt_deg"})
def reference(names: Sequence[str] = ()) -> Findings:
    """Explain parameters, effects, solvers, variables and flags.

    Parameters
    ----------
    names : NAME
        A subject, or a parameter.
    """
    return sweep.reference(*names)
