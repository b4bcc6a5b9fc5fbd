"""``sweep status``."""

from __future__ import annotations

import argparse
import dataclasses

from sweep.cli.arguments import add_json, add_store
from sweep.cli.command import Command, Example
from sweep.cli.output import MAX_LINES, print_json, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_store(parser)
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    import shlex  # noqa: PLC0415

    from sweep.execution.status import status  # noqa: PLC0415
    from sweep.messages import duration, plain  # noqa: PLC0415

    state = status(options.store)
    if options.json:
        print_json(dataclasses.asdict(state))
        return 0
    if state.finished:
        what = "finished"
    elif state.writer is not None:
        what = f"being written by {plain(state.writer)}"
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
    for name, counts in (("detection", state.detection), ("estimate", state.estimate)):
        listed = ", ".join(f"{flag} {count:,}" for flag, count in counts.items())
        say(f"  {name:11} {listed or 'nothing yet'}")
    if state.poses_per_s is not None:
        say(f"  rate        {state.poses_per_s:,.0f} poses/s")
    if state.seconds_left is not None:
        say(f"  time left   {duration(state.seconds_left)}")
    for kind, cells in (("crashed", state.crashed), ("failed", state.failed)):
        for cell in cells[:MAX_LINES]:
            at = shlex.quote(cell.at)
            say(f"  {kind:11} --at {at}  {cell.stage}: {plain(cell.reason, 300)}")
        if len(cells) > MAX_LINES:
            say(f"  {kind:11} and more; --json lists the first 1,000")
    for line in state.warnings:
        say(line)
    store = shlex.quote(options.store)
    if not state.finished:
        again = f"sweep status {store}" if state.writer is not None else f"sweep run {store}"
        say_next(again)
    else:
        say_next(state.advice or f"sweep report {store}")
    return 0


STATUS = Command(
    "status", "show how far a run is, its rate, and the cells that failed",
    "sweep/execution/README.md",
    (
        Example("sweep status runs/smoke.zarr", "shows the progress, also of a run in progress"),
        Example("sweep status runs/smoke.zarr --json", "prints the same as JSON"),
    ),
    _add_arguments, _execute,
)
