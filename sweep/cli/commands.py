"""The commands, by group: experiments, answers, your camera, other programs, reference."""

from __future__ import annotations

import dataclasses
import math
import resource
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal

from rich import filesize

import sweep
from sweep import library
from sweep.cli import command as cli
from sweep.cli.command import Names, Numbers
from sweep.errors import ArgumentError, check_positive
from sweep.isolation.child_process import Child, default_workers
from sweep.messages import plain, quoted

if TYPE_CHECKING:
    from sweep.evaluation.inspection import SceneInspection
    from sweep.experiment.pipeline import Pipeline
    from sweep.experiment.sampling import StoppingRule
    from sweep.integrity.verification import Reproduction
    from sweep.report.table import Findings

# --------------------------------------------------------------------------------------------------
# ``sweep run``.


@cli.command("experiments", "sweep/execution/README.md", {
    "sweep run --example smoke": "writes runs/smoke.zarr, from a pipeline of the package",
    "sweep run pipelines/smoke.toml --set 'tilt_deg=[0, 30, 60]' --store runs/tilts.zarr":
        "runs the same experiment at other tilts"})
def run(
    pipeline: str | None = None, *, example: Literal["smoke"] | None = None,
    settings: Sequence[str] = (), precision: Sequence[str] = (), max_trials: int | None = None,
    store: str | None = None, overwrite: bool = False, workers: int | None = None,
    reuse: Sequence[str] = (), yes: bool = False, scheduler: str | None = None,
    time_limit_s: float | None = None, retry_failed: bool = False,
) -> Findings:
    """Run a pipeline into a store, or continue an interrupted run.

    Parameters
    ----------
    pipeline : PIPELINE
        TOML file of the experiment, or a store that was made from it.
    example
        A pipeline that is installed with the package, in place of a file.
    settings : --set KEY=VALUE
        Replace a value of the file by this TOML value; a list makes an axis; may be repeated.
    precision : --precision NAME=WIDTH
        Compute trials until the interval of this quantity is as narrow at each condition:
        half-width of a rate, of another quantity as a share of it, such as 'detection_rate = 0.02'
        or 'rotation_error_rmse_deg = 5 %'; may be repeated.
    max_trials : --max-trials N
        The most trials of a condition.
    store : --store STORE
        Path or URL of the store (default: runs/NAME.zarr).
    overwrite
        Replace an existing store.
    workers : --workers N
        Number of worker processes (default: one for each processor).
    reuse : --reuse STORE
        Copy the finished cells that this store shares with the experiment; may be repeated.
    yes
        Run also what would take more than a day, or more than is free on the disk.
    scheduler : --scheduler ADDRESS
        Address of a Dask scheduler, or `local`: a Dask cluster on this machine.
    time_limit_s : --time-limit S
        Block timeout in seconds (default: 600, or ten times a block's work).
    retry_failed
        Compute the blocks again in which cells failed or crashed, also of a finished store.
    """
    if (pipeline is None) == (example is None):
        raise ArgumentError("pipeline", pipeline or "",
                            "expected a TOML file, a store, or --example smoke")
    source = pipeline or str(Path(library.__file__).parent / "examples" / f"{example}.toml")
    with Child() as child, library.progress.progress_display() as display:
        read = cli.read_pipeline(source, settings, precision, max_trials)
        cli.SESSION.stopped = cli.CONTINUES + (", without --overwrite" if overwrite else "")
        summary = library.runner.execute(
            read, library.lifecycle.store_of(source, store), workers=workers, scheduler=scheduler,
            reuse=reuse, overwrite=overwrite, retry_failed=retry_failed, yes=yes,
            time_limit_s=time_limit_s, progress=display, child=child)
    poses = f"{summary.poses:,} poses"
    if summary.needed is not None:
        settled = (summary.conditions or 0) - (summary.unsettled or 0)
        poses = (f"{settled:,} of {summary.conditions:,} conditions settled with "
                 f"{summary.needed:,} poses ({summary.poses:,} with all trials)")
    rate = summary.computed_scenes / max(summary.seconds, 1e-3)
    speed = f", {summary.seconds:.1f} s ({rate:,.0f} poses/s)" if rate else ""
    notes = [f"camera: {read.facts.camera_line}"]
    if summary.retried:
        notes.append(
            f"{summary.retried:,} failed cells tried again, {summary.recovered:,} computed now")
    elif retry_failed and not summary.computed_blocks:
        notes.append(f"{summary.store}: no cell failed or crashed; nothing is tried again")
    then = ""
    if read.requirements and not summary.advice:
        # They are given, for a store keeps those that it was made with.
        per = ",".join(_conditions(read))
        then = quoted("sweep", "require", summary.store, *read.requirements,
                      *(["--per", per] if per else []))
    return cli.summarised(
        summary, f"{poses}, {cli.detected_line(summary)}{speed}", notes, then)


def _conditions(pipeline: Pipeline) -> list[str]:
    """Return the axes at each of whose values the pipeline's requirements must hold."""
    return [name for name in pipeline.require_per if pipeline.axis(name) is not None]


# --------------------------------------------------------------------------------------------------
# ``sweep plan``.


@cli.command("experiments", "pipelines/README.md", {
    "sweep plan pipelines/smoke.toml": "shows the grid, memory and time",
    "sweep plan pipelines/smoke.toml --set trial=1000 --workers 16 --json":
        "shows the same of a larger run, as JSON"})
def plan(
    pipeline: str, *, settings: Sequence[str] = (), precision: Sequence[str] = (),
    max_trials: int | None = None, workers: int | None = None,
) -> Findings:
    """Show a pipeline's grid, active parts and expected cost.

    Parameters
    ----------
    pipeline, settings, precision, max_trials, workers
        As for `run`.
    """
    read = cli.read_pipeline(pipeline, settings, precision, max_trials)
    library.runner.announce_compilation(read)
    facts, listed = read.facts, read.facts.parts
    expected = forecast(read, workers)
    bound = library.block.bound_notes(read)
    sections = {
        "Camera": [facts.camera_line, *facts.camera_notes],
        "Poses": [facts.pose_line, *facts.pose_notes, *facts.detector_notes, *bound],
        "Dimensions": _dimensions(read),
        "Required": _required(read),
        "Trials": [] if read.stopping is None else _rule_lines(read.stopping),
        "Parts": [
            f"{part.name:17} {'on ' if part.active else 'off'}  {part.reason}" for part in listed],
        "Expected": _expected(read, expected),
    }
    lines = [read.heading]
    for title, texts in sections.items():
        lines += ["", title, *(f"  {text}" for text in texts)] if texts else []
    lines += [f"warning: the run {line}" for line in expected.objections]
    words = [*_set([*settings, *cli.precision_settings(precision, max_trials)]),
             *(["--yes"] if expected.objections else [])]
    return cli.findings(lines, {
        "title": read.title, "camera": facts.camera, "notes": [*facts.notes, *bound],
        "views": facts.view_ranges,
        "dimensions": {axis.name: len(axis) for axis in read.axes},
        "require": {"all": list(read.requirements), "per": list(read.require_per)},
        **vars(expected),
        "parts": [dataclasses.asdict(part) for part in listed],
    }, 0, quoted("sweep", "run", pipeline, *words))


def forecast(pipeline: Pipeline, workers: int | None = None) -> SimpleNamespace:
    """Return the expected cost of a run into its own store; nothing is written.

    A seeded sample of scenes is measured in a child process, for a few seconds at most,
    compilation not counted.

    Returns
    -------
    ``poses`` and ``results``: cells of the scene axes, and estimates; ``block`` and ``blocks``:
    scenes of a block along each scene axis, and their number; ``worker_bytes`` of a worker's
    memory; ``pose_s``: mean seconds a pose, all configurations included, of so many ``sampled``
    ones, and whether the measurement was abandoned since a pose takes ``over`` that; ``workers``
    (default: as a run has them); ``least_share`` of the poses that is computed in any case: of a
    run in waves the first wave. ``files``, ``bytes``, ``seconds`` and ``objections`` as
    `sweep.execution.forecast.forecast_of`. All else is that of all poses: how many a run in waves
    needs, nobody knows.

    Raises
    ------
    ArgumentError
        If there are no workers.
    """
    check_positive("workers", workers)
    costs = library.forecast
    with Child() as child:
        timing = costs.measure(child, pipeline)
    count = costs.process_count(pipeline, timing, workers)
    blocks = costs.blocks_of(pipeline, timing.pose_s, count)
    expected = costs.forecast_of(
        f"runs/{pipeline.name}.zarr", pipeline, timing, blocks, min(count, default_workers()),
        len(blocks))
    # Of a child that ended, the memory was at most this.
    process = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    stages = library.parameters.Stage
    return SimpleNamespace(
        poses=pipeline.size(stages.scene),
        results=pipeline.size(*stages),
        block=blocks.extents,
        blocks=len(blocks),
        **timing._asdict(),
        **vars(expected),
        worker_bytes=process + 3 * pipeline.experiment.bytes_of(math.prod(blocks.extents)),
        workers=count,
        least_share=costs.least_share(library.rules.make_rule(pipeline)),
    )


def _dimensions(pipeline: Pipeline) -> list[str]:
    """Return a line for each axis."""
    width = max((len(axis.name) for axis in pipeline.axes), default=0)
    return [
        f"{axis.name:{width}}  {len(axis):>11,}  {axis.stage.name:10}  {axis.values[0]}"
        + (f" ... {axis.values[-1]}" if len(axis) > 1 else "")
        + (f" {axis.unit}" if axis.unit else "")
        for axis in pipeline.axes]


def _required(pipeline: Pipeline) -> list[str]:
    """Return the requirements, and their conditions."""
    if not pipeline.requirements:
        return []
    rule, names = pipeline.stopping, _conditions(pipeline)
    if rule is not None and not names:
        names = [*rule.at_all, *rule.per]
    elif not names:
        names = ["value of the axes of size, angle, dictionaries and boards"]
    return [*pipeline.requirements,
            f"at each {', '.join(names)}" if names else "pooled over all axes of the scene"]


def _rule_lines(rule: StoppingRule) -> list[str]:
    """Return the section by which sampling stops, in words."""
    lines = [f"in waves until [search] is answered, at most {rule.max_trials:,}"]
    if rule.precision:
        lines += [f"{name} to {width:g}" for name, width in rule.precision]
        lines.append(f"at each {', '.join(rule.per)}" if rule.per else "of all poses together")
    return lines


def _expected(pipeline: Pipeline, expected: SimpleNamespace) -> list[str]:
    """Return poses, results, blocks, bytes, memory and time that a run is expected to take."""
    most = "" if pipeline.stopping is None else "at most "
    poses = f"{most}{expected.poses:,}"
    if pipeline.stopping is not None:
        poses = f"at least {round(expected.least_share * expected.poses):,}, {poses}"
    over, ended = ("over ", ", then the measurement was ended") if expected.over else ("", "")
    sampled = f"{expected.sampled} sampled" if expected.sampled else (
        "assumed: a sampled one raises or ends its process")
    how = "in one process" if expected.workers == 1 else f"with {expected.workers} workers"
    rows = {
        "poses": poses,
        "results": f"{most}{expected.results:,}",
        "blocks": f"{expected.blocks:,} of {' x '.join(map(str, expected.block)) or '1'} poses",
        "store": f"{filesize.decimal(expected.bytes)} before compression, "
                 f"in {expected.files:,} files",
        "memory": f"{filesize.decimal(expected.worker_bytes)} a worker",
        "cost": f"{over}{1e3 * expected.pose_s:.3g} ms a pose ({sampled}{ended})",
        "time": f"{most}{over}{cli.duration(expected.seconds)} {how}",
    }
    return [f"{name:8} {text}" for name, text in rows.items()]


def _set(settings: Sequence[str]) -> list[str]:
    """Return the words of a command line that give settings."""
    return [word for setting in settings for word in ("--set", setting)]


# --------------------------------------------------------------------------------------------------
# ``sweep show`` and ``sweep repro``: one cell.

#: Suffixes of the file of a picture; without one, that of a device.
PNG = (".png", "")


@cli.command("experiments", "pipelines/README.md", {
    "sweep show pipelines/smoke.toml --at distance_m=0.3,tilt_deg=45":
        "draws this pose into scene.png",
    "sweep show pipelines/faults.toml --full --plain -o frame.png":
        "writes the whole frame of the first pose, without annotations"})
def show(
    pipeline: str, *, settings: Sequence[str] = (), at: Sequence[str] = (),
    output: str = "scene.png", plain: bool = False, full: bool = False,
) -> Findings:
    """Draw the image of one pose with the detections in it.

    Parameters
    ----------
    pipeline, settings
        As for `run`.
    at : --at NAME=VALUE,...
        The pose and its configuration; an axis that is not named takes its first value; may be
        repeated, with other names.
    output : -o --output PNG
        File to write the image to (default: scene.png).
    plain
        Draw the image without annotations.
    full
        Draw the whole frame instead of the marker's surroundings.
    """
    read = cli.read_pipeline(pipeline, settings)
    library.output_file.figure_file(output, PNG)
    single = library.pipeline.cell(read, ",".join(at))
    scene = library.inspection.inspect_scene(single, whole_frame=full)
    _write_image(output, scene.image, None if plain else scene, read, single)
    return cli.findings(
        [f"{output}: {scene.detection.name}, {scene.estimate.name}"],
        {"output": output, "detection": scene.detection, "estimate": scene.estimate,
         "area_px2": scene.area_px, **scene.errors},
        0, quoted("sweep", "plan", pipeline, *_set(settings)))


@cli.command("experiments", "sweep/integrity/README.md", {
    "sweep repro runs/smoke.zarr --at distance_m=0.3,tilt_deg=45 -o cell.png":
        "prints both values of each variable, and draws the image into cell.png",
    "sweep repro runs/faults.zarr --time-limit 10":
        "recomputes the first cell, for 10 seconds at most"})
def repro(
    store: str, *, at: Sequence[str] = (), output: str | None = None, plain: bool = False,
    full: bool = False, time_limit_s: float = 60.0,
) -> Findings:
    """Recompute one cell of a store, compared with the stored one.

    Parameters
    ----------
    store : STORE
        Path or URL of the store.
    at : --at NAME=VALUE,...
        The cell; an axis that is not named takes its first value; may be repeated.
    output : -o --output PNG
        File to write the image to (default: no file is written).
    plain, full
        As for `show`.
    time_limit_s : --time-limit S
        Timeout in seconds for each cell (default: 60).
    """
    if not 0 < time_limit_s < math.inf:
        raise ArgumentError("time_limit_s", time_limit_s, "expected seconds above 0")
    chosen = list(at) or [""]
    if output is None and (plain or full):
        raise ArgumentError("output", "is missing", "--plain and --full are for the file of -o")
    if output is not None and len(chosen) > 1:
        raise ArgumentError("output", output, "expected one --at beside it")
    library.output_file.figure_file(output, PNG)
    cells = library.verification.reproduce(
        store, chosen, whole_frame=full, time_limit_s=time_limit_s)
    lines = [line for again in cells for line in ("", *_cell_lines(again))][1:]
    last, status = cells[-1], int(any(each.difference for each in cells))
    if output is not None and last.image is None:
        lines.append("no image: rendering failed")
    elif output is not None:
        _write_image(output, last.image, None if plain else last.inspection, last.pipeline,
                     library.pipeline.cell(last.pipeline, last.at))
        lines.append(f"{output}: image of the cell")
    url = quoted(store)
    then = f"sweep verify {url}", "checks the rest of the store"
    if status:
        then = f"sweep verify {url} --repair", "recomputes the blocks that differ"
    elif output is None and last.inspection is not None:
        where = f" --at {quoted(last.at)}" if last.at else ""
        then = f"sweep repro {url}{where} -o scene.png", "draws the cell"
    shown = ("at", "stored", "recomputed", "difference", "exact", "seconds", "failures", "changes")
    return cli.findings(
        lines, {"store": store, "cells": [
            {name: getattr(each, name) for name in shown} for each in cells]}, status, *then)


def _cell_lines(again: Reproduction) -> Iterator[Any]:
    """Yield the recomputed values, as lines and a table, and whether they are the stored ones."""
    yield f"--at {again.at}"
    for line in again.changes:
        yield f"changed since the store was created: {line}"
    yield library.scenes.value_table(
        again.pipeline.experiment.variables, again.recomputed, again.stored)
    if again.inspection is not None:
        left, top, right, bottom = again.inspection.window
        ids = ", ".join(str(marker_id) for marker_id, _ in again.inspection.decoded) or "none"
        yield (f"columns {left} to {right - 1}, rows {top} to {bottom - 1} of the frame; "
               f"IDs decoded: {ids}; candidates rejected: {len(again.inspection.rejected)}")
    yield "time: " + ", ".join(
        f"{stage} {1e3 * seconds:.3g} ms" for stage, seconds in again.seconds.items())
    for failure in again.failures:
        kind = "the process died" if failure.crashed else "an exception was raised"
        yield f"{failure.stage}: {kind}:"
        yield from (plain(line, 1000) for line in failure.text.strip().splitlines())
    if again.unneeded:
        yield "the store does not hold this cell: the run settled its condition with fewer trials"
    elif again.stored is None:
        yield "the store does not hold this cell yet"
    elif again.difference:
        yield f"differs from the store: {again.difference}"
    else:
        how = "bit for bit" if again.exact else (
            "within the tolerances for another processor or version")
        yield f"agrees with the store {how}"


def _write_image(
    output: str, image: Any, scene: SceneInspection | None, pipeline: Pipeline, cell: Pipeline
) -> None:
    """Write the image of a cell as PNG, with what was found in its scene unless that is None."""
    import cv2  # noqa: PLC0415

    content = cv2.imencode(".png", image)[1].tobytes() if scene is None else (
        library.scenes.scene_png(scene, library.pipeline.coordinates_text(pipeline, cell)))
    library.output_file.write_output_file(Path(output), content)


# --------------------------------------------------------------------------------------------------
# ``sweep status`` and ``sweep verify``: a store.


@cli.command("experiments", "sweep/execution/README.md", {
    "sweep status runs/smoke.zarr": "shows the progress, also of a run in progress",
    "sweep status runs/smoke.zarr --json": "prints the same as JSON"})
def status(store: str) -> Findings:
    """Show how far a run is, its rate, and the cells that failed.

    Parameters
    ----------
    store
        As for `repro`.
    """
    state = library.status.status(store)
    what = "finished" if state.finished else "being written" if state.being_written else "stopped"
    rows = {"blocks": f"{state.blocks_done:,} of {state.blocks:,}"}
    if state.conditions is None:
        rows["poses"] = f"{state.poses_done:,} of {state.poses:,}"
    else:
        how = "settled" if state.finished else "done"
        rows["conditions"] = f"{state.settled:,} of {state.conditions:,} {how}"
        rows["poses"] = f"{state.needed:,}, of {state.poses:,} with all trials"
    rows["looked for"] = f"{state.looked_for:,}"
    for name, counts in (("detection", state.detection), ("estimate", state.estimate)):
        rows[name] = ", ".join(
            f"{flag} {count:,}" for flag, count in counts.items()) or "nothing yet"
    if state.poses_per_s is not None:
        rows["rate"] = f"{state.poses_per_s:,.0f} poses/s"
    if state.seconds_left is not None:
        rows["time left"] = cli.duration(state.seconds_left)
    lines = [f"{state.title}: {what}", *(f"  {name:11} {text}" for name, text in rows.items())]
    for kind, cells in (("crashed", state.crashed), ("failed", state.failed)):
        lines += cli.listed(
            [f"  {kind:11} --at {quoted(cell['at'])}  {cell['stage']}: "
             f"{plain(library.blocks.reason_of(cell['text']), 300)}" for cell in cells],
            f"  {kind:11} and more; --json lists the first 1,000")
    then = state.advice or f"sweep report {quoted(store)}"
    if not state.finished:
        then = f"sweep {'status' if state.being_written else 'run'} {quoted(store)}"
    return cli.findings([*lines, *state.warnings], vars(state), 0, then)


@cli.command("experiments", "sweep/integrity/README.md", {
    "sweep verify runs/smoke.zarr": "checks every file, and recomputes 20 scenes",
    "sweep verify runs/smoke.zarr --repair --sample 100":
        "repairs what is damaged, and recomputes 100 scenes"})
def verify(
    store: str, *, repair: bool = False, sample: int = 20, workers: int | None = None
) -> Findings:
    """Check a store's integrity; optionally repair it.

    Parameters
    ----------
    store
        As for `repro`.
    repair
        Recompute damaged blocks, and rewrite or delete other damaged files.
    sample : --sample N
        Number of scenes to recompute and compare, beside all that failed (default: 20); 0
        recomputes nothing.
    workers
        As for `run`.
    """
    if repair:
        cli.SESSION.stopped = cli.CONTINUES
        report = library.verification.repair(store, sample, workers=workers)
    else:
        if workers is not None:
            raise ArgumentError("workers", workers, "expected --repair, which alone uses them")
        report = library.verification.verify(store, sample)
    lines, damaged = [], report.damage
    for what, damages in (("repaired", report.repaired), ("damaged", damaged)):
        lines += cli.listed(
            [f"{what:9} {plain(each.where, 300)}: {plain(each.what, 300)}" for each in damages],
            f"{what:9} and {len(damages) - cli.MAX_LINES:,} more; --json lists all")
    if report.unstable:
        lines.append(f"not deterministic: {plain(report.unstable, 300)}: scenes that were "
                     "recomputed twice on the same images differ")
    again = f"{report.sampled} scenes recomputed" if report.sampled else (
        f"no scene recomputed ({report.not_sampled})")
    state = "damaged" if damaged else "not deterministic" if report.unstable else "sound"
    lines.append(
        f"{report.store}: {state}{'' if report.finished else ', unfinished'}: "
        f"{report.blocks_done:,} of {report.blocks:,} blocks, {report.files:,} files, {again}"
        + (f"; damaged: {len(damaged):,}" if damaged else ""))
    lines += library.results.differing_processors(report.processors, "blocks")
    url = quoted(store)
    if report.unstable and not damaged:
        then = f"sweep plugins check {quoted(report.unstable)}", "tries it on its own"
    elif damaged and not repair:
        then = f"sweep verify {url} --repair", "repairs it"
    elif damaged:
        then = f"sweep run {url} --overwrite", "computes all of it again"
    else:
        then = f"sweep {'report' if report.finished else 'status'} {url}", ""
    return cli.findings(lines, report, int(bool(damaged or report.unstable)), *then)


# --------------------------------------------------------------------------------------------------
# Answers, your camera, other programs, reference.

@cli.command("answers", "sweep/analysis/README.md", {
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
        Also write each figure into DIR, as SVG and PNG, and each scene as PNG.
    requirements : --require REQUIREMENT
        What is required, in quotes: 'detection >= 0.99', 'range_error_p95_percent <= 1'; the
        report begins with whether it is met; may be repeated (default: the section [require] of
        the store's pipeline).
    per
        As for `require`.
    error_model : --error-model FILE
        Also write the error models as JSON, as `sweep error-model` does.
    """
    if cli.SESSION.form == "json" and library.output_file.standard_stream(Path(output or "")):
        raise ArgumentError("json", "", "and the report both go to standard output; choose -o FILE")
    return sweep.write_report(
        store, output, require=requirements, per=per, form=form, figures=figures,
        error_model=error_model, command=cli.command_line())


@cli.command("answers", "sweep/analysis/README.md", {
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
        axes of size, angle, dictionaries and boards).
    pipeline : --pipeline FILE
        Take [require] from this TOML file in place of the store's pipeline.
    at : --at NAME=VALUE,...
        Judge these values of axes alone, such as solver=ippe_square; may be repeated.
    against : --against STORE
        Also compare pose by pose with this older store: significantly worse is not met.
    """
    return sweep.require(
        store, requirements, per=per, at=at, pipeline=pipeline, against=against,
        every=cli.SESSION.form == "markdown")


@cli.command("answers", "pipelines/sizes/README.md", {
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
    read = cli.read_pipeline(pipeline, settings)
    cli.SESSION.stopped = cli.CONTINUES
    with library.progress.progress_display() as bar:
        choice = sweep.size(
            read, store=library.lifecycle.store_of(pipeline, store), limit_s=limit_s, progress=bar,
            workers=workers, reuse=reuse, overwrite=overwrite, yes=yes)
    return library.findings.choice_findings(choice)


@cli.command("answers", "pipelines/limits/README.md", {
    "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' --along distance_m":
        "finds from how far a marker is detected, at each tilt",
    "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' "
    "--along distance_m --at-all tilt_deg -o limit.svg":
        "finds up to which distance it is at all tilts, with a figure"})
def limit(
    pipeline: str, *, settings: Sequence[str] = (), requirements: Sequence[str] = (),
    along: str = "", per: Names = None, at_all: Names = None, max_trials: int | None = None,
    store: str | None = None, overwrite: bool = False, workers: int | None = None,
    reuse: Sequence[str] = (), yes: bool = False, scheduler: str | None = None,
    output: str | None = None,
) -> Findings:
    """Find how far along an axis requirements are met.

    Parameters
    ----------
    pipeline, settings, overwrite, workers, reuse, yes, scheduler
        As for `run`.
    requirements : --require REQUIREMENT
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
    figure = library.output_file.figure_file(output)
    cli.SESSION.stopped = cli.CONTINUES
    with library.progress.progress_display() as display:
        limits = sweep.limit(
            pipeline, require=requirements, along=along, per=per, at_all=at_all,
            max_trials=max_trials, settings=settings, store=store, workers=workers,
            scheduler=scheduler, reuse=reuse, overwrite=overwrite, yes=yes, progress=display)
    if figure is not None:
        library.figure.write_figure([library.findings.limit_figure(limits)], figure)
    return library.findings.limit_findings(limits)


@cli.command("answers", "sweep/tradeoff/README.md", {
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
    if source.lower().endswith(".toml"):
        cli.SESSION.stopped = cli.CONTINUES
    return sweep.measure_tradeoff(
        source, per=per or (), criterion=criterion, limit_s=limit_s, budget_ms=budget_ms,
        output=output, progress=True)


@cli.command("answers", "pipelines/diagnose/README.md", {
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
    return library.diagnosis.diagnose(
        observations, camera=camera, output=output, **library.observations.settings_of(settings))


@cli.command("answers", "sweep/analysis/README.md", {
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
    files = library.findings.error_model_files(error_model or ["error_model.json"])
    data = library.report_data.read_report_data(store)
    results = library.findings.selected(data.results, at, data.pipeline)
    return library.findings.model_findings(dataclasses.replace(data, results=results), files)


@cli.command("answers", "pipelines/calibration/README.md", {
    "sweep calibration runs/calibration.zarr": "errors and coverage for 10, 20 and 40 views",
    "sweep calibration runs/calibration.zarr --views 5,20 --coefficients 2":
        "fewer views, and a lens of two coefficients"})
def calibration(
    store: str, *, views: Numbers = (10, 20, 40),
    points: Literal["chessboard", "markers"] | None = None, coefficients: int = 5,
    target_m: float = 3.0,
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
    found = library.camera_calibration.camera_calibrations(
        library.lifecycle.open_dataset(store), views, points=points,
        coefficients=coefficients, target_m=target_m)
    return library.findings.calibration_findings(
        library.camera_calibration.calibration_summary(found), quoted(store))


@cli.command("your camera", "pipelines/photographs/README.md", {
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
    cli.SESSION.stopped = "stopped before anything was computed"
    prepared = library.prepare.prepare(
        folders, camera, board=board, poses=poses, stereo=stereo, settings=settings, store=store,
        overwrite=overwrite)
    summary = cli.executed(
        prepared.pipeline, prepared.store, prepared.lines, workers, overwrite=overwrite)
    count = prepared.pipeline.size(library.parameters.Stage.detection)
    each = f" with {count} detector settings" if count > 1 else ""
    return cli.summarised(
        summary, f"{cli.detected_line(summary)}{each}", photographs=prepared.lines)


@cli.command("your camera", "pipelines/photographs/README.md", {
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
    fitted = sweep.fit(
        *folders, camera=camera, board=board, poses=poses, stereo=stereo, settings=settings,
        markers=markers, check=check)
    library.output_file.write_output_file(path, fitted.text.encode())
    found, gap = fitted.found, fitted.gap
    rows = [
        (each.name, each.parameter, library.table.Value(
            each.estimate.value, each.estimate.low, each.estimate.high)
         if math.isfinite(each.estimate.low) else each.estimate.value,
         f"{'kept' if each.kept else 'left out'}{': ' if each.reason else ''}{each.reason}")
        for each in found.terms]
    size = next(each.estimate for each in found.terms if each.parameter == "marker_scale")
    line = (f"markers are {size.value:.4f} [{size.low:.4f}, {size.high:.4f}] times as large as "
            "their file says: measure the print")
    # What no caliper shows is not said.
    told = "marker_scale" in found.scene and math.isfinite(size.low) and abs(size.value - 1) >= 5e-4
    said = [line] if told else []
    lines = [library.table.Table.of(
        f"{found.markers} markers in {found.photographs} photographs; 95 % intervals by photograph,"
        " from 4 on", ("term", "parameter", "value", ""), rows, stub=2, words=True),
        *(f"- {line}" for line in said)]
    held_out = None if gap is None else library.findings.gap_table(gap)
    if held_out is not None:
        lines += ["", "Half of the photographs, simulated with the scene of the others:", held_out]
    store = f"runs/{fitted.pipeline.name}.zarr"
    then = f"sweep run {quoted(output)}", "simulates this camera"
    if path.suffix.lower() == ".toml" and library.locations.exists(store):
        then = quoted("sweep", "compare", store, output), "simulates the photographs with it"
    return cli.findings(lines, {
        "scene": found.scene, "photographs": found.photographs, "markers": found.markers,
        "terms": [each.as_json() for each in found.terms], "lines": said,
        "check": [] if held_out is None else held_out.as_json()["rows"], "output": output,
    }, 0, *then)


@cli.command("your camera", "pipelines/photographs/README.md", {
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
        Draw rates and errors of both into this PNG or SVG file.
    """
    cli.SESSION.stopped = cli.CONTINUES
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


@cli.command("other programs", "sweep/exchange/README.md", {
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
    read = cli.read_pipeline(pipeline, settings)
    library.runner.announce_compilation(read)
    cli.SESSION.stopped = cli.CONTINUES
    with library.progress.stage_display() as stage:
        result = library.export.export(
            read, folder, windowed=windowed, workers=workers, yes=yes,
            progress=lambda done, count: stage(f"rendering {count:,} scenes", done / count))
    without = f", {result.invisible:,} scenes without" if result.invisible else ""
    size = filesize.decimal(result.bytes)
    lines = [f"{result.folder}: {result.images:,} images, {size}{without}"]
    if result.kept:
        lines.append(f"{result.kept:,} were there already, {result.written:,} written now")
    if result.damaged:
        lines.append(f"{result.damaged:,} were missing or changed, and are written again")
    place = quoted(result.folder)
    return cli.findings(lines, result, 0, f"sweep score {place} detections.csv",
                    f"{place}/README.md has the conventions")


@cli.command("other programs", "sweep/exchange/README.md", {
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
        doubled=doubled, beside=beside, settings=settings, overwrite=overwrite)
    summary = cli.executed(
        scored.pipeline, store or f"runs/{scored.pipeline.name}.zarr", scored.lines, workers,
        overwrite=overwrite)
    return cli.summarised(
        summary, f"{summary.poses:,} poses, {cli.detected_line(summary)}", answers=scored.lines)


@cli.command("other programs", "pipelines/plugins/README.md", {
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
    tried : NAME
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
    if settings or dictionary or name == "check":
        raise ArgumentError("settings" if settings else "dictionary" if dictionary else "tried", "",
                            "expected `sweep plugins check NAME`")
    if name is None:
        every = library.loading.installed()
        lines = [f"{each['kind']:10} {each['name']:20} of {each['distribution']}"
                 for each in every]
        return cli.findings(lines or ["no plug-in is installed"], {"plugins": every}, 0,
                        "sweep plugins NAME", "describes one, and says whether it can be used")
    found = [plugin.to_json() for plugin in library.loading.described(name)]
    return cli.findings(
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


def _checked(report: Any) -> Findings:
    """Return the findings of a check of a plug-in, a DataFrame with the names in ``attrs``."""
    what = report.attrs
    versions = ", ".join(f"{name} {version}" for name, version in what["versions"].items())
    whole = f"{what['kind']} {what['name']}{f' ({versions})' if versions else ''}"
    conforms = "conforms" if what["conforms"] else "does not conform"
    lines = [f"{whole} on {what['dictionary']}: {conforms}",
             *(f"  {verdict:5}  {check:22}  {text}"
               for check, verdict, text in report.itertuples(index=False))]
    key = "detector" if what["kind"] == "detector" else "solver"
    chosen = shlex.quote(f'{key}="{what["name"]}"')
    then = (f"sweep run PIPELINE --set {chosen}", "measures it on your scenes")
    return cli.findings(lines, {**what, "findings": report.to_dict("records")},
                    int(not what["conforms"]), *(then if what["conforms"] else ("", "")))


@cli.command("help", "pipelines/README.md", {
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
