"""``sweep compare``."""

from __future__ import annotations

import argparse
import os
import shlex
from typing import TYPE_CHECKING

from sweep.cli.arguments import add_json, add_workers
from sweep.cli.command import CONTINUES, Command, Example
from sweep.cli.output import print_json, quiet_matplotlib, say, say_next

if TYPE_CHECKING:
    import xarray as xr


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "photographs", metavar="STORE", help="store of photographs, as `sweep photos` makes it",
    )
    parser.add_argument(
        "scene", metavar="SIMULATION",
        help="store of a simulation, or a TOML file with a section [scene], such as `sweep fit` "
        "writes: the photographs' markers are then simulated with it, at the same poses",
    )
    parser.add_argument(
        "--bins", action="append", default=[], metavar="NAME=EDGES",
        help="compare in bins of a variable of the scene, such as side_px=15,20,30,50; may be "
        "repeated (default: none for simulated photographs, else quarters of side_px)",
    )
    parser.add_argument(
        "--repeats", type=int, default=1, metavar="N",
        help="how often each photograph is simulated (default: 1)",
    )
    parser.add_argument(
        "--store", metavar="STORE",
        help="path or URL of the store of what is simulated (default: beside the photographs', "
        "with the names of both)",
    )
    add_workers(parser)
    parser.add_argument(
        "--overwrite", action="store_true", help="replace an existing store of the simulation"
    )
    parser.add_argument(
        "-o", "--output", metavar="FIGURE",
        help="draw the distributions of the errors into this PNG or SVG file",
    )
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table")
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.analysis import simulation_gap  # noqa: PLC0415
    from sweep.errors import ArgumentError  # noqa: PLC0415
    from sweep.report.error_model_table import plain_table  # noqa: PLC0415
    from sweep.report.gap_table import gap_lines, gap_records, gap_table  # noqa: PLC0415
    from sweep.report.output_file import figure_file, write_output_file  # noqa: PLC0415

    if options.markdown and options.json:
        raise ArgumentError("markdown", "", "expected one of --markdown and --json")
    output = figure_file(options.output)
    bins = dict(_edges(each) for each in options.bins) or None
    photographs = _opened(options.photographs)
    store = options.scene
    if store.endswith(".toml"):
        store = _simulated(options)
    simulated = _opened(store)
    gap = simulation_gap(photographs, simulated, bins).load()
    if output is not None:
        quiet_matplotlib()
        from sweep.report.gap_figure import figure_bytes, gap_panels  # noqa: PLC0415

        panels = gap_panels(photographs, simulated, bins)
        write_output_file(output, figure_bytes(panels, output.suffix.lower()))
    if options.json:
        print_json({
            "photographs": options.photographs, "simulated": store,
            "paired": bool(gap.attrs["paired"]), "rows": gap_records(gap),
        })
        return 0
    table = gap_table(gap)
    say(table.markdown() if options.markdown else plain_table(table))
    say()
    for line in gap_lines(gap):
        say(line)
    say_next(f"sweep report {shlex.quote(store)}")
    return 0


def _opened(store: str) -> xr.Dataset:
    """Return the results of a finished store."""
    from sweep.errors import StoreError  # noqa: PLC0415
    from sweep.store.lifecycle import open_dataset, open_store  # noqa: PLC0415
    from sweep.store.unfinished import unfinished_line  # noqa: PLC0415

    opened = open_store(store)
    if not opened.finished:
        raise StoreError(unfinished_line(opened))
    return open_dataset(store)


def _simulated(options: argparse.Namespace) -> str:
    """Simulate the photographs' markers; return the store."""
    from sweep.cli.first_use import announce_compilation  # noqa: PLC0415
    from sweep.execution.progress import progress_display  # noqa: PLC0415
    from sweep.execution.runner import execute  # noqa: PLC0415
    from sweep.photographs.twins import read_scene, twin_pipeline, twin_store  # noqa: PLC0415
    from sweep.store.stored_pipeline import read_pipeline  # noqa: PLC0415

    scene = read_scene(options.scene)
    pipeline = twin_pipeline(read_pipeline(options.photographs), scene, options.repeats)
    store: str = os.fspath(options.store or twin_store(options.photographs, options.scene))
    announce_compilation(pipeline)
    options.stopped = CONTINUES
    with progress_display() as display:
        execute(
            pipeline, store, workers=options.workers, overwrite=options.overwrite,
            progress=display,
        )
    return store


def _edges(text: str) -> tuple[str, list[float]]:
    """Return the name and the edges of bins."""
    from sweep.errors import ArgumentError  # noqa: PLC0415

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


COMPARE = Command(
    "compare", "compare photographs with a simulation of them",
    "pipelines/photographs/README.md",
    (
        Example(
            "sweep compare runs/shots.zarr scene.toml",
            "simulates each marker at its pose with this scene; prints the gaps",
        ),
        Example(
            "sweep compare runs/shots.zarr runs/tags.zarr --bins side_px=15,20,30,50",
            "compares with any simulation, by the markers' size in the image",
        ),
    ),
    _add_arguments, _execute,
)
