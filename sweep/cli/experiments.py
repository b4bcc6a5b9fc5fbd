"""The commands of experiments: run, plan, show, repro, status, verify."""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sweep import library
from sweep.cli.command import (
    CONTINUES,
    JSON,
    LARGE_RUN,
    MAX_LINES,
    PIPELINE,
    PRECISION,
    SCHEDULER,
    STORE,
    WORKERS,
    argument,
    cell_argument,
    check_png,
    command,
    new_store,
    picture,
    print_json,
    read_pipeline,
    say,
    say_next,
    write_png,
)
from sweep.cli.prepared import announce_compilation, beside_child, store_of
from sweep.errors import ArgumentError
from sweep.messages import byte_count, duration, plain, quoted

if TYPE_CHECKING:
    from sweep.execution.forecast import Forecast
    from sweep.execution.progress import Progress
    from sweep.execution.status import Summary
    from sweep.experiment.pipeline import Pipeline
    from sweep.experiment.sampling import StoppingRule
    from sweep.integrity.reproduction import Reproduction
    from sweep.isolation.child_process import Child


# --------------------------------------------------------------------------------------------------
# ``sweep run``.

EXAMPLES = ("smoke",)
"""Pipelines that are installed with the package."""


@command(
    "sweep/execution/README.md", {
        "sweep run --example smoke": "writes runs/smoke.zarr, from a pipeline of the package",
        "sweep run pipelines/smoke.toml --set 'tilt_deg=[0, 30, 60]' --store runs/tilts.zarr":
            "runs the same experiment at other tilts"},
    argument("pipeline", metavar="PIPELINE", nargs="?",
             help="TOML file of the experiment, or a store that was made from it"),
    argument("--example", choices=EXAMPLES,
             help="a pipeline that is installed with the package, in place of a file"),
    PIPELINE[1], *PRECISION, *new_store(), *LARGE_RUN, SCHEDULER,
    argument(
        "--time-limit", type=float, metavar="S", dest="time_limit_s",
        help="block timeout in seconds (default: 600, or ten times a block's work)"),
    argument(
        "--retry-failed", action="store_true",
        help="compute the blocks again in which cells failed or crashed, also of a finished "
        "store"),
    JSON)
@beside_child
def run(options: argparse.Namespace, child: Child) -> int:
    """Run a pipeline into a store, or continue an interrupted run."""
    if (options.pipeline is None) == (options.example is None):
        raise ArgumentError("pipeline", options.pipeline or "",
                            "expected a TOML file, a store, or --example smoke")
    if options.example is not None:
        options.pipeline = str(Path(library.__file__).parent / "examples"
                               / f"{options.example}.toml")
    pipeline = read_pipeline(options)
    announce_compilation(pipeline)
    options.stopped = "stopped before anything was computed" if options.overwrite else CONTINUES
    camera = [] if options.json else [f"camera: {pipeline.facts.camera.line()}"]

    watched = sys.stdout is not None and sys.stdout.isatty()

    def report(progress: Progress) -> None:
        if options.overwrite:  # there is a new store
            options.stopped = CONTINUES.replace("command", "command without --overwrite")
        while camera and watched:  # once the run is not refused; a pipe gets it with the results
            say(camera.pop())
        display(progress)

    with library.progress.progress_display() as display:
        summary = library.runner.execute(
            pipeline, store_of(options), workers=options.workers, scheduler=options.scheduler,
            reuse=options.reuse, overwrite=options.overwrite, retry_failed=options.retry_failed,
            yes=options.yes, time_limit_s=options.time_limit_s,
            progress=report, child=child,
        )
    if options.json:
        print_json(summary)
        return int(summary.nothing_computed)
    for line in camera:
        say(line)
    if summary.retried:
        say(f"{summary.retried:,} failed cells tried again, {summary.recovered:,} computed now")
    elif options.retry_failed and summary.computed_blocks == 0:
        say(f"{summary.store}: no cell failed or crashed; nothing is tried again")
    elif summary.computed_blocks == 0:
        failed = " and --retry-failed what failed" if summary.failures else ""
        say(f"{summary.store} is already finished; --overwrite recomputes it{failed}")
    rate = summary.computed_scenes / max(summary.seconds, 1e-3)
    say(
        f"{_poses(summary)}, {summary.detected_line}"
        + (f", {summary.seconds:.1f} s ({rate:,.0f} poses/s)" if rate else "")
    )
    say(f'xarray.open_zarr("{summary.data}")')
    for line in summary.warnings:
        say(line)
    if summary.advice:
        say_next(summary.advice)
    else:
        say_next(_requiring_command(pipeline, summary.store) if pipeline.requirements
                 else f"sweep report {quoted(summary.store)}")
    return int(summary.nothing_computed)


def _poses(summary: Summary) -> str:
    """Return how many poses there are; of a run in waves, how many it needed."""
    if summary.needed is None:
        return f"{summary.poses:,} poses"
    settled = (summary.conditions or 0) - (summary.unsettled or 0)
    return (
        f"{settled:,} of {summary.conditions:,} conditions settled with {summary.needed:,} poses "
        f"({summary.poses:,} with all trials)"
    )


def _requiring_command(pipeline: Pipeline, url: str) -> str:
    """Return the command that decides on the pipeline's requirements.

    A store keeps those that it was made with: others are given.
    """
    stored = library.lifecycle.open_store(url).pipeline
    if (stored.requirements, stored.require_per) == (pipeline.requirements, pipeline.require_per):
        return f"sweep require {quoted(url)}"
    say("the store keeps the requirements that it was made with; the next line has the new ones")
    per = [name for name in pipeline.require_per if pipeline.axis(name) is not None]
    return quoted("sweep", "require", url, *pipeline.requirements,
                  *(["--per", ",".join(per)] if per else []))


# --------------------------------------------------------------------------------------------------
# ``sweep plan``.

@command(
    "pipelines/README.md", {
        "sweep plan pipelines/smoke.toml": "shows the grid, memory and time",
        "sweep plan pipelines/smoke.toml --set trial=1000 --workers 16 --json":
            "shows the same of a larger run, as JSON"},
    *PIPELINE, *PRECISION, WORKERS, JSON)
def plan(options: argparse.Namespace) -> int:
    """Show a pipeline's grid, active parts and expected cost."""
    pipeline = read_pipeline(options)

    announce_compilation(pipeline)
    listed = pipeline.facts.parts
    switches = [part.switch for part in listed if part.switch and part.active]
    expected, costs = library.forecast.forecast(pipeline, options.workers, switches)
    bound = library.block.bound_notes(pipeline)
    views = pipeline.facts.poses
    if options.json:
        print_json(
            {
                "title": pipeline.title,
                "camera": pipeline.facts.camera,
                "notes": [
                    *pipeline.facts.notes,
                    *bound,
                ],
                "views": views.ranges(),
                "dimensions": {axis.name: len(axis) for axis in pipeline.axes},
                "require": {
                    "all": list(pipeline.requirements),
                    "per": list(pipeline.require_per),
                },
                **dataclasses.asdict(expected),
                "parts": [
                    {**dataclasses.asdict(part), "pose_s": costs.get(part.switch)}
                    for part in listed
                ],
            }
        )
        return 0
    say(pipeline.heading)
    say(f"\nCamera\n  {pipeline.facts.camera.line()}")
    for line in pipeline.facts.camera_notes:
        say(f"  {line}")
    say(f"\nPoses\n  {views.line()}")
    for line in (*pipeline.facts.pose_notes, *pipeline.facts.detector_notes, *bound):
        say(f"  {line}")
    say("\nDimensions")
    width = max((len(axis.name) for axis in pipeline.axes), default=0)
    for axis in pipeline.axes:
        stage = axis.stage.name
        values = f"{axis.values[0]} ... {axis.values[-1]}" if len(axis) > 1 else axis.values[0]
        say(f"  {axis.name:{width}}  {len(axis):>11,}  {stage:10}  {values} {axis.unit}".rstrip())
    if pipeline.requirements:
        say("\nRequired")
        for text in pipeline.requirements:
            say(f"  {text}")
        names = [name for name in pipeline.require_per if pipeline.axis(name) is not None]
        say(f"  at each {', '.join(names)}" if names else "  pooled over all axes of the scene")
    if pipeline.stopping is not None:
        say("\nTrials")
        for line in _rule_lines(pipeline.stopping):
            say(f"  {line}")
    say("\nParts")
    for part in listed:
        cost = ""
        if part.switch in costs:
            cost = f"; {costs[part.switch] * 1e3:.3g} ms a pose"
        elif part.switch in switches:
            cost = "; cost not measured, poses take too long"
        say(f"  {part.name:17} {'on ' if part.active else 'off'}  {part.reason}{cost}")
    say("\nExpected")
    over, ended = ("over ", ", then the measurement was ended") if expected.over else ("", "")
    most = "at most " if pipeline.stopping is not None else ""
    how = "in one process" if expected.workers == 1 else f"with {expected.workers} workers"
    rows = {
        "poses": _poses_plan(pipeline, expected),
        "results": f"{expected.results:,}" if pipeline.stopping is None else (
            f"at most {expected.results:,}"),
        "blocks": f"{expected.blocks:,} of {' x '.join(map(str, expected.block)) or '1'} poses",
        "store": f"{byte_count(expected.bytes)} before compression, in {expected.files:,} files",
        "memory": f"{byte_count(expected.worker_bytes)} a worker",
        "cost": f"{over}{1e3 * expected.pose_s:.3g} ms a pose ({expected.sampled} sampled{ended})",
        "time": f"{most}{over}{duration(expected.seconds)} {how}",
    }
    for name, text in rows.items():
        say(f"  {name:8} {text}")
    demand = library.forecast.Demand(
        expected.seconds, expected.workers, expected.bytes, expected.files
    )
    refused = library.forecast.objections(
        demand, library.forecast.free_disk(f"runs/{pipeline.name}.zarr"),
        up_to=pipeline.stopping is not None,
    )
    for line in refused:
        say(f"warning: the run {line}")
    settings = [word for setting in options.settings for word in ("--set", setting)]
    settings += ["--yes"] if refused else []
    say_next(quoted("sweep", "run", options.pipeline, *settings))
    return 0


def _rule_lines(rule: StoppingRule) -> list[str]:
    """Return what a section by which sampling stops says."""
    lines = [f"in waves until [search] is answered, at most {rule.max_trials:,}"]
    if rule.precision:
        lines += [f"{name} to {width:g}" for name, width in rule.precision]
        lines.append(f"at each {', '.join(rule.per)}" if rule.per else "of all poses together")
    return lines


def _poses_plan(pipeline: Pipeline, expected: Forecast) -> str:
    """Return how many poses a run computes; in waves, how many at least and at most."""
    if pipeline.stopping is None:
        return f"{expected.poses:,}"
    least = round(expected.least_share * expected.poses)
    return f"at least {least:,}, at most {expected.poses:,}"


# --------------------------------------------------------------------------------------------------
# ``sweep show``.

@command(
    "pipelines/README.md", {
        "sweep show pipelines/smoke.toml --at distance_m=0.3,tilt_deg=45":
            "draws this pose into scene.png",
        "sweep show pipelines/faults.toml --full --plain -o frame.png":
            "writes the whole frame of the first pose, without annotations"},
    *PIPELINE, cell_argument("the pose and its configuration"), *picture("scene.png"), JSON)
def show(options: argparse.Namespace) -> int:
    """Draw the image of one pose with the detections in it."""
    pipeline = read_pipeline(options)
    check_png(options.output)

    single = library.cell_selection.cell(pipeline, ",".join(options.at))
    scene = library.inspection.inspect_scene(single, whole_frame=options.full)
    image = (
        scene.image
        if options.plain
        else library.scenes.draw_scene(
            scene, library.cell_selection.coordinates_text(pipeline, single)
        )
    )
    write_png(options.output, image)
    if options.json:
        print_json({"output": options.output, "detection": scene.detection,
                    "estimate": scene.estimate, "area_px2": scene.area_px, **scene.errors})
        return 0
    say(f"{options.output}: {scene.detection.name}, {scene.estimate.name}")
    settings = [word for setting in options.settings for word in ("--set", setting)]
    say_next(quoted("sweep", "plan", options.pipeline, *settings))
    return 0


# --------------------------------------------------------------------------------------------------
# ``sweep repro``.

@command(
    "sweep/integrity/README.md", {
        "sweep repro runs/smoke.zarr --at distance_m=0.3,tilt_deg=45 -o cell.png":
            "prints both values of each variable, and draws the image into cell.png",
        "sweep repro runs/faults.zarr --time-limit 10":
            "recomputes the first cell, for 10 seconds at most"},
    STORE, cell_argument("the cell", ""), *picture(),
    argument("--time-limit", type=float, default=60.0, metavar="S", dest="time_limit_s",
             help="timeout in seconds for each cell (default: 60)"), JSON)
def repro(options: argparse.Namespace) -> int:
    """Recompute one cell of a store, compared with the stored one."""
    if not 0 < options.time_limit_s < math.inf:
        raise ArgumentError("time_limit_s", options.time_limit_s, "expected seconds above 0")
    chosen: list[str] = options.at or [""]
    if options.output is None and (options.plain or options.full):
        raise ArgumentError("output", "is missing", "--plain and --full are for the file of -o")
    if options.output is not None:
        if len(chosen) > 1:
            raise ArgumentError("output", options.output, "expected one --at beside it")
        check_png(options.output)

    library.reproduction.check_selection(options.store, chosen)
    status, cells = 0, []
    for number, at in enumerate(chosen):
        if number and not options.json:
            say()
        again = library.reproduction.reproduce(
            options.store, at, whole_frame=options.full, time_limit_s=options.time_limit_s
        )
        status = max(status, int(bool(again.difference)))
        if options.json:
            cells.append({
                "at": again.at, "stored": again.stored, "recomputed": again.recomputed,
                "difference": again.difference, "exact": again.exact, "seconds": again.seconds,
                "failures": again.failures, "changes": again.changes})
            _write_image(again, options)
            continue
        _print_cell(again)
        _write_image(again, options)
        say(_verdict(again))
    if options.json:
        print_json({"store": options.store, "cells": cells})
    else:
        _say_next(options, again, status)
    return status


def _print_cell(again: Reproduction) -> None:
    say(f"--at {again.at}")
    for line in again.changes:
        say(f"changed since the store was created: {line}")
    say(library.scenes.value_table(again.variables, again.recomputed, again.stored).text())
    if again.inspection is not None:
        left, top, right, bottom = again.inspection.window
        ids = ", ".join(str(marker_id) for marker_id, _ in again.inspection.decoded) or "none"
        say(
            f"columns {left} to {right - 1}, rows {top} to {bottom - 1} of the frame; "
            f"IDs decoded: {ids}; candidates rejected: {len(again.inspection.rejected)}"
        )
    times = ", ".join(f"{stage} {1e3 * seconds:.3g} ms" for stage, seconds in again.seconds.items())
    say(f"time: {times}")
    for failure in again.failures:
        kind = "the process died" if failure.crashed else "an exception was raised"
        say(f"{failure.stage}: {kind}:")
        say("\n".join(plain(line, 1000) for line in failure.text.strip().splitlines()))


def _write_image(again: Reproduction, options: argparse.Namespace) -> None:
    if options.output is None:
        return
    line = "no image: rendering failed"
    if again.image is not None:
        line, image = f"{options.output}: image of the cell", again.image
        if again.inspection is not None and not options.plain:
            image = library.scenes.draw_scene(
                again.inspection,
                library.cell_selection.coordinates_text(again.pipeline, again.cell_pipeline))
        write_png(options.output, image)
    if not options.json:
        say(line)


def _verdict(again: Reproduction) -> str:
    """Return whether the values are the stored ones."""
    if again.unneeded:
        return "the store does not hold this cell: the run settled its condition with fewer trials"
    if again.stored is None:
        return "the store does not hold this cell yet"
    if again.difference:
        return f"differs from the store: {again.difference}"
    how = "bit for bit" if again.exact else (
        "within the tolerances for another processor or version")
    return f"agrees with the store {how}"


def _say_next(options: argparse.Namespace, again: Reproduction, status: int) -> None:
    store = quoted(options.store)
    if status:
        say_next(f"sweep verify {store} --repair", "recomputes the blocks that differ")
    elif options.output is None and again.inspection is not None:
        at = f" --at {quoted(again.at)}" if again.at else ""
        say_next(f"sweep repro {store}{at} -o scene.png", "draws the cell")
    else:
        say_next(f"sweep verify {store}", "checks the rest of the store")


# --------------------------------------------------------------------------------------------------
# ``sweep status``.

@command(
    "sweep/execution/README.md", {
        "sweep status runs/smoke.zarr": "shows the progress, also of a run in progress",
        "sweep status runs/smoke.zarr --json": "prints the same as JSON"},
    STORE, JSON)
def status(options: argparse.Namespace) -> int:
    """Show how far a run is, its rate, and the cells that failed."""
    state = library.status.status(options.store)
    if options.json:
        print_json(state)
        return 0
    if state.finished:
        what = "finished"
    elif state.being_written:
        what = "being written"
    else:
        what = "stopped"
    say(f"{state.title}: {what}")
    say(f"  blocks      {state.blocks_done:,} of {state.blocks:,}")
    if state.conditions is None:
        say(f"  poses       {state.poses_done:,} of {state.poses:,}")
    else:
        how = "settled" if state.finished else "done"
        say(f"  conditions  {state.settled:,} of {state.conditions:,} {how}")
        say(f"  poses       {state.needed:,}, of {state.poses:,} with all trials")
    say(f"  looked for  {state.looked_for:,}")
    for name, counts in (("detection", state.detection), ("estimate", state.estimate)):
        listed = ", ".join(f"{flag} {count:,}" for flag, count in counts.items())
        say(f"  {name:11} {listed or 'nothing yet'}")
    if state.poses_per_s is not None:
        say(f"  rate        {state.poses_per_s:,.0f} poses/s")
    if state.seconds_left is not None:
        say(f"  time left   {duration(state.seconds_left)}")
    for kind, cells in (("crashed", state.crashed), ("failed", state.failed)):
        for cell in cells[:MAX_LINES]:
            at = quoted(cell.at)
            say(f"  {kind:11} --at {at}  {cell.stage}: {plain(cell.reason, 300)}")
        if len(cells) > MAX_LINES:
            say(f"  {kind:11} and more; --json lists the first 1,000")
    for line in state.warnings:
        say(line)
    store = quoted(options.store)
    if not state.finished:
        again = f"sweep status {store}" if state.being_written else f"sweep run {store}"
        say_next(again)
    else:
        say_next(state.advice or f"sweep report {store}")
    return 0


# --------------------------------------------------------------------------------------------------
# ``sweep verify``.

@command(
    "sweep/integrity/README.md", {
        "sweep verify runs/smoke.zarr": "checks every file, and recomputes 20 scenes",
        "sweep verify runs/smoke.zarr --repair --sample 100":
            "repairs what is damaged, and recomputes 100 scenes"},
    STORE,
    argument("--repair", action="store_true",
             help="recompute damaged blocks, and rewrite or delete other damaged files"),
    argument(
        "--sample", type=int, default=20, metavar="N",
        help="number of scenes to recompute and compare, beside all that failed (default: 20); "
        "0 recomputes nothing"),
    WORKERS, JSON)
def verify(options: argparse.Namespace) -> int:
    """Check a store's integrity; optionally repair it."""
    if options.repair:
        options.stopped = CONTINUES

        report = library.repair.repair(options.store, options.sample, workers=options.workers)
    else:

        report = library.verification.verify(options.store, options.sample)
    if options.json:
        print_json(report.to_json())
        return 1 if report.damage else 0

    unstable = [each for each in report.damage if each.where == report.unstable]
    damaged = [each for each in report.damage if each not in unstable]
    for what, listed in (("repaired", report.repaired), ("damaged", damaged)):
        for damage in listed[:MAX_LINES]:
            say(f"{what:9} {plain(damage.where, 300)}: {plain(damage.what, 300)}")
        if len(listed) > MAX_LINES:
            say(f"{what:9} and {len(listed) - MAX_LINES:,} more; --json lists all")
    for each in unstable:
        say(plain(each.what, 600))
    if report.left_over:
        example = plain(report.left_over[0])
        say(f"{len(report.left_over):,} files do not belong to the store, such as {example}; "
              "--repair deletes them")
    again = f"{report.sampled} scenes recomputed" if report.sampled else (
        f"no scene recomputed ({report.not_sampled})"
    )
    state = "" if report.finished else ", unfinished"
    say(
        f"{report.store}: "
        f"{'damaged' if damaged else 'not deterministic' if unstable else 'sound'}{state}: "
        f"{report.blocks_done:,} of {report.blocks:,} blocks, {report.files:,} files, "
        f"{again}"
        + (f"; damaged: {len(damaged):,}" if damaged else "")
    )

    for line in library.processor.differing_processors(report.processors, "blocks"):
        say(line)
    store = quoted(options.store)
    if unstable and not damaged:
        say_next(f"sweep plugins check {quoted(unstable[0].where)}", "tries it on its own")
    elif (report.damage or report.left_over) and not options.repair:
        say_next(f"sweep verify {store} --repair", "repairs it")
    elif report.damage:
        say_next(f"sweep run {store} --overwrite", "computes all of it again")
    else:
        say_next(f"sweep {_following(options.store, finished=report.finished)} {store}")
    return 1 if report.damage else 0


def _following(url: str, *, finished: bool) -> str:
    """Return the command to go on with after a sound store."""
    if finished:
        return "report"

    return (
        "run"
        if not library.lock.is_written(library.lifecycle.open_store(url).storage)
        else "status"
    )
