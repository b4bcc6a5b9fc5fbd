"""The commands; parsing and printing only.

Exit status: 0 done, 1 failed while running or damage found, 2 could not be run as asked,
130 stopped by Ctrl-C.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from sweep.errors import ArgumentError, DatasetError, PipelineError, StoreError, SweepError

if TYPE_CHECKING:
    from sweep.execution.progress import Progress
    from sweep.plan.experiment import Pipeline

# Heavy packages are imported by the commands that need them: `sweep --help` is quick.


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    try:
        return int(chosen.command(chosen))
    except ArgumentError as error:
        flag = FLAGS.get(error.argument, error.argument.replace("_", "-"))
        _tell(SweepError(f"--{flag} {error.value}: {error.problem}"))
        return 2
    except (PipelineError, DatasetError, StoreError) as error:
        _tell(error)
        return 2
    except SweepError as error:
        _tell(error)
        return 1
    except KeyboardInterrupt:
        without = " without --overwrite" if getattr(chosen, "overwrite", False) else ""
        print(f"stopped; the same command{without} continues", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1


def _tell(error: SweepError) -> None:
    """Print an error's lines, without what would control the terminal."""
    from sweep.messages import plain  # noqa: PLC0415

    for line in str(error).splitlines():
        print(plain(line, MAX_LINE_LENGTH), file=sys.stderr)


MAX_LINE_LENGTH = 2000

FLAGS = {"time_limit_s": "time-limit", "limit_s": "seconds"}
"""Argument of a function -> its flag, where that is no translation of ``_`` to ``-``."""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sweep",
        description="How well will I know the pose? Experiments with fiducial markers.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(
        name: str, function: Callable[[argparse.Namespace], int], text: str
    ) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text)
        added.set_defaults(command=function)
        return added

    run = command("run", _run, "run a pipeline into a store; continue where it stopped")
    _add_pipeline(run)
    run.add_argument("--store", metavar="PATH", help="default: runs/NAME.zarr")
    run.add_argument("--workers", type=int, metavar="N", help="default: the processors at hand")
    run.add_argument("--scheduler", metavar="ADDRESS", help="a running Dask scheduler")
    run.add_argument(
        "--reuse", action="append", default=[], metavar="STORE",
        help="take finished cells from this store where they agree",
    )
    run.add_argument(
        "--time-limit", type=float, metavar="S", default=600.0,
        help="seconds after which a block is taken for endless (default: 600)",
    )
    run.add_argument("--overwrite", action="store_true", help="delete a store that is there")
    run.add_argument("--json", action="store_true", help="print one JSON object")

    plan = command("plan", _plan, "say what would run, and what it would take")
    _add_pipeline(plan)
    plan.add_argument("--workers", type=int, metavar="N", help="default: the processors at hand")
    plan.add_argument("--json", action="store_true", help="print one JSON object")

    show = command("show", _show, "draw one pose's image with what was found in it")
    _add_pipeline(show)
    show.add_argument(
        "--at", default="", metavar="NAME=VALUE,...",
        help="the pose; axes that are not named take their first value",
    )
    show.add_argument("-o", "--output", default="scene.png", metavar="PNG")
    show.add_argument("--plain", action="store_true", help="the image alone")
    show.add_argument("--full", action="store_true", help="the whole frame")

    repro = command(
        "repro", _repro, "compute one scene of a store again, here, and compare with the store"
    )
    repro.add_argument("store", metavar="STORE")
    repro.add_argument(
        "--at", default="", metavar="NAME=VALUE,...",
        help="the scene and its treatment; axes that are not named take their first value",
    )
    repro.add_argument("-o", "--output", default="scene.png", metavar="PNG")
    repro.add_argument("--plain", action="store_true", help="the image alone")
    repro.add_argument("--full", action="store_true", help="the whole frame")
    repro.add_argument(
        "--time-limit", type=float, default=60.0, metavar="S",
        help="seconds after which it is taken for endless (default: 60)",
    )

    trade = command(
        "tradeoff", _tradeoff,
        "measure what each treatment costs, and how accurate it is on the same images",
    )
    trade.add_argument(
        "source", metavar="STORE|PIPELINE",
        help="a finished store, or a TOML file, which is run into its default store first",
    )
    trade.add_argument(
        "--per", action="append", default=[], metavar="AXIS",
        help="a scene axis whose values are told apart, such as side_px; may be repeated",
    )
    trade.add_argument(
        "--criterion", default="rotation_p95_deg", metavar="NAME",
        help="the error that decides (default: rotation_p95_deg)",
    )
    trade.add_argument(
        "--seconds", type=float, default=60.0, metavar="S",
        help="measure costs for about so long at most (default: 60)",
    )
    trade.add_argument("-o", "--output", metavar="FIGURE", help="draw it: a PNG or SVG file")
    form = trade.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print one JSON object")
    form.add_argument("--markdown", action="store_true", help="print Markdown tables")

    report = command("report", _report, "write a page with the answer, figures and scenes")
    report.add_argument("store", metavar="STORE", help="a finished store")
    report.add_argument(
        "-o", "--output", metavar="FILE", help="default: report.html, or report.md with --format md"
    )
    report.add_argument(
        "--format", choices=("html", "md"),
        help="one HTML page, or Markdown with a folder of figures (default: as FILE ends)",
    )
    report.add_argument("--figures", metavar="DIR", help="write each figure as SVG and PNG too")

    verify = command("verify", _verify, "check that a store is whole and right, and mend it")
    verify.add_argument("store", metavar="STORE")
    verify.add_argument(
        "--repair", action="store_true",
        help="compute damaged blocks again, and write again what else is damaged",
    )
    verify.add_argument(
        "--sample", type=int, default=20, metavar="N",
        help="scenes to compute again and compare (default: 20)",
    )
    verify.add_argument("--workers", type=int, metavar="N", help="of the repair")
    verify.add_argument("--json", action="store_true", help="print one JSON object")

    status = command("status", _status, "say how far a store is; also while it is written")
    status.add_argument("store", metavar="STORE")
    status.add_argument("--json", action="store_true", help="print one JSON object")
    return parser


def _add_pipeline(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("pipeline", metavar="PIPELINE", help="a TOML file")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="a TOML value in place of the file's; a list makes an axis",
    )


def _read(chosen: argparse.Namespace) -> Pipeline:
    from sweep.plan.experiment import Pipeline  # noqa: PLC0415

    return Pipeline.from_toml(chosen.pipeline, chosen.settings)


def _print_json(content: dict[str, Any]) -> None:
    print(json.dumps(content, indent=2))


def _run(chosen: argparse.Namespace) -> int:
    pipeline = _read(chosen)
    from sweep.execution.runner import execute  # noqa: PLC0415

    with _Bar() as bar:
        summary = execute(
            pipeline, chosen.store, workers=chosen.workers, scheduler=chosen.scheduler,
            reuse=chosen.reuse, overwrite=chosen.overwrite, time_limit_s=chosen.time_limit,
            progress=bar,
        )
    if chosen.json:
        _print_json(dataclasses.asdict(summary))
        return 0
    if summary.computed_blocks == 0:
        print(f"{summary.store} is finished; --overwrite computes it again")
    rate = summary.poses / summary.seconds if summary.computed_blocks else 0
    print(
        f"{summary.poses:,} poses, {summary.results:,} results, {summary.detected:,} detected"
        + (f", {summary.seconds:.1f} s ({rate:,.0f} poses/s)" if rate else "")
    )
    for flag, count in (("crashed", summary.crashed), ("failed", summary.failed)):
        if count:
            print(f"{count:,} flagged {flag}; `sweep status {summary.store}` lists them")
    print(f'xarray.open_zarr("{summary.data}")')
    return 0


class _Bar:
    """A progress bar on standard error, where that is a terminal."""

    def __enter__(self) -> Self:
        from rich.console import Console  # noqa: PLC0415
        from rich.progress import (  # noqa: PLC0415
            BarColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"), BarColumn(),
            TextColumn("{task.fields[count]}"),
            TimeElapsedColumn(), TimeRemainingColumn(), console=console,
            disable=not console.is_terminal, transient=True,
        )
        self._progress.start()
        self._task = self._progress.add_task("starting", total=None, count="")
        return self

    def __call__(self, progress: Progress) -> None:
        self._progress.update(
            self._task, description="running", total=progress.total, completed=progress.done,
            count=f"{progress.done:,} of {progress.total:,} poses",
        )

    def __exit__(self, *_: object) -> None:
        self._progress.stop()


def _plan(chosen: argparse.Namespace) -> int:
    pipeline = _read(chosen)
    from sweep.execution.forecast import forecast_isolated  # noqa: PLC0415
    from sweep.plan.active_parts import parts  # noqa: PLC0415

    listed = parts(pipeline)
    switches = [part.switch for part in listed if part.switch and part.active]
    expected, costs = forecast_isolated(pipeline, chosen.workers, switches)
    if chosen.json:
        _print_json(
            {
                "title": pipeline.title,
                "dimensions": {axis.name: len(axis) for axis in pipeline.axes},
                **dataclasses.asdict(expected),
                "parts": [
                    {**dataclasses.asdict(part), "pose_s": costs.get(part.switch)}
                    for part in listed
                ],
            }
        )
        return 0
    print(pipeline.title or pipeline.name)
    print("\nDimensions")
    width = max((len(axis.name) for axis in pipeline.axes), default=0)
    for axis in pipeline.axes:
        stage = axis.stage.name
        shown = f"{axis.values[0]} ... {axis.values[-1]}" if len(axis) > 1 else axis.values[0]
        print(f"  {axis.name:{width}}  {len(axis):>11,}  {stage:10}  {shown} {axis.unit}".rstrip())
    print("\nParts")
    for part in listed:
        cost = f"; {costs[part.switch] * 1e3:.3g} ms a pose" if part.switch in costs else ""
        print(f"  {part.name:17} {'on ' if part.active else 'off'}  {part.reason}{cost}")
    print("\nExpected")
    rows = {
        "poses": f"{expected.poses:,}",
        "results": f"{expected.results:,}",
        "blocks": f"{expected.blocks:,} of {' x '.join(map(str, expected.block)) or '1'} poses",
        "store": f"{_bytes(expected.bytes)} before compression",
        "memory": f"{_bytes(expected.worker_bytes)} a worker",
        "cost": f"{1e3 * expected.pose_s:.3g} ms a pose ({expected.sampled} sampled)",
        "time": f"{_duration(expected.seconds)} with {expected.workers} workers",
    }
    for name, text in rows.items():
        print(f"  {name:8} {text}")
    return 0


def _bytes(count: int) -> str:
    units = ("bytes", "kB", "MB", "GB", "TB", "PB")
    power = min(int(math.log(max(count, 1), 1000)), len(units) - 1)
    return f"{count / 1000**power:.3g} {units[power]}"


def _duration(seconds: float) -> str:
    for unit, length in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"


def _show(chosen: argparse.Namespace) -> int:
    pipeline = _read(chosen)
    from sweep.evaluation.inspection import inspect_scene  # noqa: PLC0415
    from sweep.plan.cell_selection import cell, coordinates_text  # noqa: PLC0415
    from sweep.report.scene_drawing import draw_scene  # noqa: PLC0415

    one = cell(pipeline, chosen.at)
    seen = inspect_scene(one, whole_frame=chosen.full)
    picture = seen.image if chosen.plain else draw_scene(seen, coordinates_text(pipeline, one))
    _write_png(chosen.output, picture)
    print(f"{chosen.output}: {seen.detection.name}, {seen.estimate.name}")
    return 0


def _write_png(output: str, picture: Any) -> None:
    import cv2  # noqa: PLC0415

    _, encoded = cv2.imencode(".png", picture)
    try:
        Path(output).write_bytes(encoded.tobytes())
    except OSError as error:
        raise StoreError(f"{output}: cannot be written: {error.strerror}") from None


def _repro(chosen: argparse.Namespace) -> int:
    if not 0 < chosen.time_limit < math.inf:
        raise StoreError(f"--time-limit {chosen.time_limit}: expected seconds above 0")
    from sweep.integrity.reproduction import reproduce  # noqa: PLC0415
    from sweep.messages import plain  # noqa: PLC0415
    from sweep.plan.cell_selection import coordinates_text  # noqa: PLC0415
    from sweep.report.scene_drawing import draw_scene  # noqa: PLC0415
    from sweep.report.scene_values import value_lines  # noqa: PLC0415

    again = reproduce(
        chosen.store, chosen.at, whole_frame=chosen.full, time_limit_s=chosen.time_limit
    )
    print(f"--at {again.at}")
    for line in again.others:
        print(f"other than when the store was begun: {line}")
    print("\n".join(value_lines(again.here, again.stored)))
    if again.look is not None:
        left, top, right, bottom = again.look.window
        ids = ", ".join(str(marker_id) for marker_id, _ in again.look.decoded) or "none"
        print(
            f"columns {left} to {right - 1}, rows {top} to {bottom - 1} of the frame; "
            f"IDs decoded there: {ids}; {len(again.look.rejected)} candidates rejected"
        )
    took = ", ".join(f"{stage} {1e3 * seconds:.3g} ms" for stage, seconds in again.seconds.items())
    print(f"took {took}")
    for failure in again.failures:
        kind = "ended its process" if failure.crashed else "raised"
        print(f"{failure.stage}: {kind}:")
        print("\n".join(plain(line, 1000) for line in failure.text.strip().splitlines()))
    if again.image is None:
        print("no image: rendering it fails here")
    else:
        picture = again.image
        if again.look is not None and not chosen.plain:
            picture = draw_scene(again.look, coordinates_text(again.pipeline, again.one))
        _write_png(chosen.output, picture)
        print(f"{chosen.output}: its image")
    how = "to the bit" if again.exact else "within the tolerances of another processor or version"
    if again.stored is None:
        print("the store does not have it yet")
    elif again.verdict:
        print(f"differs from the store: {again.verdict}")
        return 1
    else:
        print(f"gives what the store holds, {how}")
    return 0


def _tradeoff(chosen: argparse.Namespace) -> int:
    from sweep.report.renderer_table import renderer_lines  # noqa: PLC0415
    from sweep.report.trade_table import (  # noqa: PLC0415
        as_json,
        table_markdown,
        table_text,
    )
    from sweep.tradeoff.measurement import measure_trade  # noqa: PLC0415
    from sweep.tradeoff.pareto import CRITERIA, advice  # noqa: PLC0415

    if chosen.criterion not in CRITERIA:
        raise StoreError(f"--criterion {chosen.criterion}: expected one of {', '.join(CRITERIA)}")
    if not 0 < chosen.seconds < math.inf:
        raise StoreError(f"--seconds {chosen.seconds}: expected a finite number above 0")
    output = Path(chosen.output) if chosen.output else None
    if output is not None and output.suffix.lower() not in (".png", ".svg"):
        raise StoreError(f"{output}: expected a file that ends in .png or .svg")
    if output is not None and output.is_dir():
        raise StoreError(f"{output}: cannot be written: Is a directory")
    if output is not None and not output.absolute().parent.is_dir():
        raise StoreError(f"{output}: cannot be written: No such file or directory")
    store = chosen.source
    if store.endswith(".toml"):
        from sweep.execution.runner import execute  # noqa: PLC0415
        from sweep.plan.experiment import Pipeline  # noqa: PLC0415

        with _Bar() as bar:
            store = execute(Pipeline.from_toml(store), None, progress=bar).store
    trade, renderers = measure_trade(store, chosen.per, chosen.seconds)
    if output is not None:
        from sweep.report.trade_figure import draw_trade  # noqa: PLC0415

        try:
            draw_trade(trade, chosen.criterion, output)
        except OSError as error:
            raise StoreError(f"{output}: cannot be written: {error.strerror}") from None
    if chosen.json:
        content = as_json(trade)
        if renderers is not None:
            content["renderers"] = as_json(renderers)
        content["advice"] = advice(trade, chosen.criterion)
        _print_json(content)
        return 0
    form = table_markdown if chosen.markdown else table_text
    print(form(trade, chosen.criterion))
    if renderers is not None:
        print()
        print("\n".join(renderer_lines(renderers, markdown=chosen.markdown)))
    print()
    print("\n".join(advice(trade, chosen.criterion)))
    return 0


def _report(chosen: argparse.Namespace) -> int:
    import xarray as xr  # noqa: PLC0415

    from sweep.report.report_data import Subject, reading  # noqa: PLC0415
    from sweep.report.write_report import write_report  # noqa: PLC0415
    from sweep.store.blocks import committed  # noqa: PLC0415
    from sweep.store.lifecycle import open_dataset, open_store  # noqa: PLC0415

    for option, given in (("-o", chosen.output), ("--figures", chosen.figures)):
        if given is not None and not given.strip():
            raise StoreError(f"{option} '{given}': expected a name")
    form = chosen.format or ("md" if str(chosen.output).lower().endswith(".md") else "html")
    output = Path(chosen.output or f"report.{form}")
    figures = Path(chosen.figures) if chosen.figures else None
    store = open_store(chosen.store)
    if not store.finished:
        done, blocks = len(committed(store)), len(store.blocks)
        raise StoreError(
            f"{store.url}: unfinished: {done:,} of {blocks:,} blocks; `sweep run` continues it"
        )
    trade = None
    with reading(store.url):
        if "cost/tradeoff" in store.group:
            trade = xr.open_zarr(
                store.source, group="cost/tradeoff", consolidated=False, zarr_format=3
            ).load()
        results = open_dataset(store.url)
    subject = Subject(store.url, results, store.pipeline, store.run_metadata, trade)
    count = write_report(subject, output, form, figures)
    print(f"{output}: {count} figures, {_bytes(output.stat().st_size)}")
    return 0


MAX_LINES = 50
"""Lines of each kind that `sweep status` and `sweep verify` print."""


def _verify(chosen: argparse.Namespace) -> int:
    if chosen.repair:
        from sweep.integrity.repair import repair  # noqa: PLC0415

        found = repair(chosen.store, chosen.sample, workers=chosen.workers)
    else:
        from sweep.integrity.verification import verify  # noqa: PLC0415

        found = verify(chosen.store, chosen.sample)
    if chosen.json:
        _print_json(found.to_json())
        return 1 if found.damage else 0
    from sweep.messages import plain  # noqa: PLC0415

    for what, listed in (("repaired", found.repaired), ("damaged", found.damage)):
        for damage in listed[:MAX_LINES]:
            print(f"{what:9} {plain(damage.where, 300)}: {plain(damage.what, 300)}")
        if len(listed) > MAX_LINES:
            print(f"{what:9} and {len(listed) - MAX_LINES:,} more; --json lists all")
    if found.left_over:
        example = plain(found.left_over[0])
        print(f"{len(found.left_over):,} files are no part of it, such as {example}; "
              "--repair deletes them")
    again = f"{found.sampled} scenes computed again" if found.sampled else (
        f"no scene computed again ({found.not_sampled})"
    )
    state = "" if found.finished else ", unfinished"
    print(
        f"{found.store}: {'damaged' if found.damage else 'sound'}{state}: "
        f"{found.blocks_done:,} of {found.blocks:,} blocks, {found.files:,} files, "
        f"{again}"
        + (f"; {len(found.damage):,} damaged, `sweep verify --repair` mends them"
           if found.damage and not chosen.repair else "")
    )
    return 1 if found.damage else 0


def _status(chosen: argparse.Namespace) -> int:
    from sweep.execution.status import status  # noqa: PLC0415
    from sweep.messages import plain  # noqa: PLC0415

    state = status(chosen.store)
    if chosen.json:
        _print_json(dataclasses.asdict(state))
        return 0
    if state.finished:
        what = "finished"
    elif state.writer is not None:
        what = f"being written by {plain(state.writer)}"
    else:
        what = "stopped; `sweep run` continues it"
    print(f"{state.title}: {what}")
    print(f"  blocks      {state.blocks_done:,} of {state.blocks:,}")
    print(f"  poses       {state.poses_done:,} of {state.poses:,}")
    for name, counts in (("detection", state.detection), ("estimate", state.estimate)):
        listed = ", ".join(f"{flag} {count:,}" for flag, count in counts.items())
        print(f"  {name:11} {listed or 'nothing yet'}")
    if state.poses_per_s is not None:
        print(f"  rate        {state.poses_per_s:,.0f} poses/s")
    if state.seconds_left is not None:
        print(f"  time left   {_duration(state.seconds_left)}")
    for kind, cells in (("crashed", state.crashed), ("failed", state.failed)):
        for cell in cells[:MAX_LINES]:
            at = shlex.quote(cell.at)
            print(f"  {kind:11} --at {at}  {cell.stage}: {plain(cell.reason, 300)}")
        if len(cells) > MAX_LINES:
            print(f"  {kind:11} and more; --json lists the first 1,000")
    return 0
