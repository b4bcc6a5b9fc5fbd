"""The commands of experiments: run, plan, show, repro, status, verify."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal

from sweep import library
from sweep.cli.command import (
    CONTINUES,
    MAX_LINES,
    SESSION,
    announce_compilation,
    check_png,
    command,
    detected_line,
    findings,
    listed,
    precision_settings,
    read_pipeline,
    summarised,
)
from sweep.errors import ArgumentError
from sweep.isolation.child_process import Child
from sweep.messages import byte_count, duration, plain, quoted

if TYPE_CHECKING:
    from sweep.evaluation.inspection import SceneInspection
    from sweep.experiment.pipeline import Pipeline
    from sweep.experiment.sampling import StoppingRule
    from sweep.integrity.verification import Reproduction
    from sweep.report.table import Findings

# --------------------------------------------------------------------------------------------------
# ``sweep run``.


@command("experiments", "sweep/execution/README.md", {
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
        read = read_pipeline(source, settings, precision, max_trials)
        announce_compilation(read)
        SESSION.stopped = f"{CONTINUES}, without --overwrite" if overwrite else CONTINUES
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
        # A store keeps the requirements that it was made with: others are given.
        words, stored = [], library.lifecycle.open_store(summary.store).pipeline
        if (stored.requirements, stored.require_per) != (read.requirements, read.require_per):
            per = ",".join(_conditions(read))
            words = [*read.requirements, *(["--per", per] if per else [])]
            notes.append("the store keeps the requirements that it was made with; the last line "
                         "has the new ones")
        then = quoted("sweep", "require", summary.store, *words)
    return summarised(
        summary, f"{poses}, {detected_line(summary)}{speed}", notes, then)


def _conditions(pipeline: Pipeline) -> list[str]:
    """Return the axes at each of whose values the pipeline's requirements must hold."""
    return [name for name in pipeline.require_per if pipeline.axis(name) is not None]


# --------------------------------------------------------------------------------------------------
# ``sweep plan``.


@command("experiments", "pipelines/README.md", {
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
    read = read_pipeline(pipeline, settings, precision, max_trials)
    announce_compilation(read)
    facts, listed = read.facts, read.facts.parts
    expected = library.forecast.forecast(read, workers)
    bound = library.block.bound_notes(read)
    refused = library.forecast.objections(
        read, expected, library.forecast.free_disk(f"runs/{read.name}.zarr"))
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
    lines += [f"warning: the run {line}" for line in refused]
    words = [*_set([*settings, *precision_settings(precision, max_trials)]),
             *(["--yes"] if refused else [])]
    return findings(lines, {
        "title": read.title, "camera": facts.camera, "notes": [*facts.notes, *bound],
        "views": facts.view_ranges,
        "dimensions": {axis.name: len(axis) for axis in read.axes},
        "require": {"all": list(read.requirements), "per": list(read.require_per)},
        **vars(expected),
        "parts": [dataclasses.asdict(part) for part in listed],
    }, 0, quoted("sweep", "run", pipeline, *words))


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
    names = ", ".join(_conditions(pipeline))
    return [*pipeline.requirements,
            f"at each {names}" if names else "pooled over all axes of the scene"]


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
        "store": f"{byte_count(expected.bytes)} before compression, in {expected.files:,} files",
        "memory": f"{byte_count(expected.worker_bytes)} a worker",
        "cost": f"{over}{1e3 * expected.pose_s:.3g} ms a pose ({sampled}{ended})",
        "time": f"{most}{over}{duration(expected.seconds)} {how}",
    }
    return [f"{name:8} {text}" for name, text in rows.items()]


def _set(settings: Sequence[str]) -> list[str]:
    """Return the words of a command line that give settings."""
    return [word for setting in settings for word in ("--set", setting)]


# --------------------------------------------------------------------------------------------------
# ``sweep show`` and ``sweep repro``: one cell.


@command("experiments", "pipelines/README.md", {
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
    read = read_pipeline(pipeline, settings)
    check_png(output)
    single = library.pipeline.cell(read, ",".join(at))
    scene = library.inspection.inspect_scene(single, whole_frame=full)
    _write_image(output, scene.image, None if plain else scene, read, single)
    return findings(
        [f"{output}: {scene.detection.name}, {scene.estimate.name}"],
        {"output": output, "detection": scene.detection, "estimate": scene.estimate,
         "area_px2": scene.area_px, **scene.errors},
        0, quoted("sweep", "plan", pipeline, *_set(settings)))


@command("experiments", "sweep/integrity/README.md", {
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
    if output is not None:
        check_png(output)
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
    return findings(
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


@command("experiments", "sweep/execution/README.md", {
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
        rows["time left"] = duration(state.seconds_left)
    lines = [f"{state.title}: {what}", *(f"  {name:11} {text}" for name, text in rows.items())]
    for kind, cells in (("crashed", state.crashed), ("failed", state.failed)):
        lines += listed(
            [f"  {kind:11} --at {quoted(cell.at)}  {cell.stage}: {plain(cell.reason, 300)}"
             for cell in cells], f"  {kind:11} and more; --json lists the first 1,000")
    then = state.advice or f"sweep report {quoted(store)}"
    if not state.finished:
        then = f"sweep {'status' if state.being_written else 'run'} {quoted(store)}"
    return findings([*lines, *state.warnings], vars(state), 0, then)


@command("experiments", "sweep/integrity/README.md", {
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
        SESSION.stopped = CONTINUES
        report = library.verification.repair(store, sample, workers=workers)
    else:
        report = library.verification.verify(store, sample)
    unstable = [each for each in report.damage if each.where == report.unstable]
    damaged = [each for each in report.damage if each not in unstable]
    lines = []
    for what, damages in (("repaired", report.repaired), ("damaged", damaged)):
        lines += listed(
            [f"{what:9} {plain(each.where, 300)}: {plain(each.what, 300)}" for each in damages],
            f"{what:9} and {len(damages) - MAX_LINES:,} more; --json lists all")
    lines += [plain(each.what, 600) for each in unstable]
    again = f"{report.sampled} scenes recomputed" if report.sampled else (
        f"no scene recomputed ({report.not_sampled})")
    state = "damaged" if damaged else "not deterministic" if unstable else "sound"
    lines.append(
        f"{report.store}: {state}{'' if report.finished else ', unfinished'}: "
        f"{report.blocks_done:,} of {report.blocks:,} blocks, {report.files:,} files, {again}"
        + (f"; damaged: {len(damaged):,}" if damaged else ""))
    lines += library.processor.differing_processors(report.processors, "blocks")
    url = quoted(store)
    if unstable and not damaged:
        then = f"sweep plugins check {quoted(unstable[0].where)}", "tries it on its own"
    elif report.damage and not repair:
        then = f"sweep verify {url} --repair", "repairs it"
    elif report.damage:
        then = f"sweep run {url} --overwrite", "computes all of it again"
    else:
        then = f"sweep {'report' if report.finished else 'status'} {url}", ""
    return findings(lines, report, int(bool(report.damage)), *then)
