"""``sweep plan``."""

from __future__ import annotations

import argparse
import dataclasses
import shlex
from typing import TYPE_CHECKING

from sweep.cli.arguments import (
    add_json,
    add_pipeline,
    add_precision,
    add_workers,
    read_pipeline,
)
from sweep.cli.command import Command, Example
from sweep.cli.output import print_json, say, say_next

if TYPE_CHECKING:
    from sweep.execution.forecast import Forecast
    from sweep.plan.experiment import Pipeline
    from sweep.plan.stopping import StoppingRule


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_pipeline(parser)
    add_precision(parser)
    add_workers(parser)
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    pipeline = read_pipeline(options)
    from sweep.cli.first_use import announce_compilation  # noqa: PLC0415
    from sweep.execution.affordability import Demand, free_disk, objections  # noqa: PLC0415
    from sweep.execution.forecast import forecast  # noqa: PLC0415
    from sweep.messages import byte_count, duration  # noqa: PLC0415
    from sweep.plan.active_parts import parts  # noqa: PLC0415
    from sweep.plan.camera_facts import camera_facts, notes  # noqa: PLC0415
    from sweep.plan.pose_facts import pose_facts, pose_notes  # noqa: PLC0415

    announce_compilation(pipeline)
    listed = parts(pipeline)
    switches = [part.switch for part in listed if part.switch and part.active]
    expected, costs = forecast(pipeline, options.workers, switches)
    views = pose_facts(pipeline)
    if options.json:
        print_json(
            {
                "title": pipeline.title,
                "camera": dataclasses.asdict(camera_facts(pipeline)),
                "notes": [*notes(pipeline), *pose_notes(pipeline, views)],
                "views": views.ranges(),
                "dimensions": {axis.name: len(axis) for axis in pipeline.axes},
                "require": {
                    "all": list(pipeline.requirements), "per": list(pipeline.require_per),
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
    say(f"\nCamera\n  {camera_facts(pipeline).line()}")
    for line in notes(pipeline):
        say(f"  {line}")
    say(f"\nPoses\n  {views.line()}")
    for line in pose_notes(pipeline, views):
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
    how = "in one process" if expected.small else f"with {expected.workers} workers"
    rows = {
        "poses": _poses(pipeline, expected),
        "results": f"{expected.results:,}" if pipeline.stopping is None else (
            f"at most {expected.results:,}"),
        "blocks": f"{expected.blocks:,} of {' x '.join(map(str, expected.block)) or '1'} poses",
        "store": f"{byte_count(expected.bytes)} before compression, in {expected.files:,} files",
        "memory": f"{byte_count(expected.worker_bytes)} a worker",
        "cost": f"{over}{1e3 * expected.pose_s:.3g} ms a pose ({expected.sampled} sampled{ended})",
        "time": f"{over}{duration(expected.seconds)} {how}",
    }
    for name, text in rows.items():
        say(f"  {name:8} {text}")
    for line in _pilot_lines(pipeline, expected):
        say(f"  {line}")
    demand = Demand(expected.seconds, expected.workers, expected.bytes, expected.files)
    refused = objections(demand, free_disk(f"runs/{pipeline.name}.zarr"))
    for line in refused:
        say(f"warning: the run {line}")
    settings = [word for setting in options.settings for word in ("--set", setting)]
    settings += ["--yes"] if refused else []
    say_next(shlex.join(["sweep", "run", options.pipeline, *settings]))
    return 0


def _rule_lines(rule: StoppingRule) -> list[str]:
    """Return what a section by which sampling stops says."""
    from sweep.plan.precision_rule import PrecisionRule  # noqa: PLC0415

    lines = [f"in waves until [{rule.section}] is fulfilled, at most {rule.max_trials:,}"]
    if isinstance(rule, PrecisionRule):
        lines += [f"{name} to {width:g}" for name, width in rule.wanted]
        lines.append(f"at each {', '.join(rule.per)}" if rule.per else "of all poses together")
    return lines


def _poses(pipeline: Pipeline, expected: Forecast) -> str:
    """Return how many poses a run computes; to a precision, about how many."""
    if pipeline.stopping is None:
        return f"{expected.poses:,}"
    if expected.pilot is None:
        return f"at most {expected.poses:,}"
    likely, low, high = (
        f"{float(f'{share * expected.poses:.2g}'):,.0f}" for share in (
            expected.pilot.share, expected.pilot.share_low, expected.pilot.share_high)
    )
    return f"about {likely} ({low} to {high}) of at most {expected.poses:,}"


def _pilot_lines(pipeline: Pipeline, expected: Forecast) -> list[str]:
    """Return what a pilot says of a run to a precision, or why there is none."""
    rule, pilot = pipeline.stopping, expected.pilot
    if rule is None:
        return []
    if pilot is None:
        return ["how many poses are needed was not tried, poses take too long"]
    trials = pilot.share * rule.max_trials
    lines = [f"about {trials:,.0f} trials a condition, by a pilot of {pilot.conditions} of them"]
    if pilot.unsettled:
        lines.append(f"about {100 * pilot.unsettled:.2g} % of the conditions need more than "
                     f"{rule.max_trials:,} trials")
    return lines


PLAN = Command(
    "plan", "show a pipeline's grid, active parts and expected cost",
    "pipelines/README.md",
    (
        Example("sweep plan pipelines/smoke.toml", "shows the grid, memory and time"),
        Example(
            "sweep plan pipelines/smoke.toml --set trial=1000 --workers 16 --json",
            "shows the same of a larger run, as JSON",
        ),
    ),
    _add_arguments, _execute,
)
