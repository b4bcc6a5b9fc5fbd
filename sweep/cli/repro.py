"""``sweep repro``."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from sweep.cli.arguments import add_cell, add_picture, add_store
from sweep.cli.command import Command, Example
from sweep.cli.output import check_png, say, say_next, write_png

if TYPE_CHECKING:
    from sweep.integrity.reproduction import Reproduction


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_store(parser)
    add_cell(parser, "the cell", several=True)
    add_picture(parser)
    parser.add_argument(
        "--time-limit", type=float, default=60.0, metavar="S", dest="time_limit_s",
        help="timeout in seconds for each cell (default: 60)",
    )


def _execute(options: argparse.Namespace) -> int:
    import math  # noqa: PLC0415

    from sweep.errors import ArgumentError  # noqa: PLC0415

    if not 0 < options.time_limit_s < math.inf:
        raise ArgumentError("time_limit_s", options.time_limit_s, "expected seconds above 0")
    chosen: list[str] = options.at or [""]
    if options.output is None and (options.plain or options.full):
        raise ArgumentError("output", "is missing", "--plain and --full are for the file of -o")
    if options.output is not None:
        if len(chosen) > 1:
            raise ArgumentError("output", options.output, "expected one --at beside it")
        check_png(options.output)
    from sweep.integrity.reproduction import check_selection, reproduce  # noqa: PLC0415

    check_selection(options.store, chosen)
    status = 0
    for number, at in enumerate(chosen):
        if number:
            say()
        again = reproduce(
            options.store, at, whole_frame=options.full, time_limit_s=options.time_limit_s
        )
        _print_cell(again)
        _write_image(again, options)
        status = max(status, _print_verdict(again))
    _say_next(options, again, status)
    return status


def _print_cell(again: Reproduction) -> None:
    from sweep.messages import plain  # noqa: PLC0415
    from sweep.report.scene_values import value_lines  # noqa: PLC0415

    say(f"--at {again.at}")
    for line in again.changes:
        say(f"changed since the store was created: {line}")
    say("\n".join(value_lines(again.variables, again.recomputed, again.stored)))
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
    if again.image is None:
        say("no image: rendering failed")
        return
    from sweep.plan.cell_selection import coordinates_text  # noqa: PLC0415
    from sweep.report.scene_drawing import draw_scene  # noqa: PLC0415

    image = again.image
    if again.inspection is not None and not options.plain:
        image = draw_scene(again.inspection, coordinates_text(again.pipeline, again.cell_pipeline))
    write_png(options.output, image)
    say(f"{options.output}: image of the cell")


def _print_verdict(again: Reproduction) -> int:
    """Print whether the values are the stored ones; return the exit status."""
    if again.unneeded:
        say("the store does not hold this cell: the run settled its condition with fewer trials")
        return 0
    if again.stored is None:
        say("the store does not hold this cell yet")
        return 0
    if again.difference:
        say(f"differs from the store: {again.difference}")
        return 1
    how = "bit for bit" if again.exact else (
        "within the tolerances for another processor or version")
    say(f"agrees with the store {how}")
    return 0


def _say_next(options: argparse.Namespace, again: Reproduction, status: int) -> None:
    import shlex  # noqa: PLC0415

    store = shlex.quote(options.store)
    if status:
        say_next(f"sweep verify {store} --repair", "recomputes the blocks that differ")
    elif options.output is None and again.inspection is not None:
        at = f" --at {shlex.quote(again.at)}" if again.at else ""
        say_next(f"sweep repro {store}{at} -o scene.png", "draws the cell")
    else:
        say_next(f"sweep verify {store}", "checks the rest of the store")


REPRO = Command(
    "repro", "recompute one cell of a store, compared with the stored one",
    "sweep/integrity/README.md",
    (
        Example(
            "sweep repro runs/smoke.zarr --at distance_m=0.3,tilt_deg=45 -o cell.png",
            "prints both values of each variable, and draws the image into cell.png",
        ),
        Example(
            "sweep repro runs/faults.zarr --time-limit 10",
            "recomputes the first cell, for 10 seconds at most",
        ),
    ),
    _add_arguments, _execute,
)
