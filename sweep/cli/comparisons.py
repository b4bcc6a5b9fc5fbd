"""The commands of analyses: report, tradeoff, compare, error-model, calibration."""

from __future__ import annotations

import argparse
import dataclasses
import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from sweep import library
from sweep.cli.command import (
    CONTINUES,
    Command,
    Example,
    add_form,
    add_json,
    add_store,
    add_workers,
    command_line,
    names_of,
    print_json,
    print_table,
    quiet_matplotlib,
    say,
    say_next,
)
from sweep.cli.prepared import run_prepared
from sweep.errors import ArgumentError
from sweep.messages import byte_count, nearest, notice, quoted

if TYPE_CHECKING:
    import xarray as xr


# --------------------------------------------------------------------------------------------------
# ``sweep report``.

NO_REPORTS = {
    ".pdf", ".png", ".svg", ".jpg", ".jpeg", ".docx", ".odt", ".tex", ".ipynb", ".csv",
}
"""Suffixes of files that neither HTML nor Markdown would be taken for."""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_store(parser)
    parser.add_argument(
        "-o", "--output", metavar="FILE",
        help="file to write (default: report.html, or report.md with --format md)",
    )
    parser.add_argument(
        "--format", choices=("html", "md"), dest="form",
        help="one HTML page, or Markdown with a folder of figures (default: by FILE's suffix)",
    )
    parser.add_argument(
        "--figures", metavar="DIR", help="also write each figure into DIR, as SVG and PNG"
    )
    parser.add_argument(
        "--require", action="append", default=[], metavar="REQUIREMENT", dest="requirements",
        help="what is required, in quotes: 'detection >= 0.99', 'range_error_p95_percent <= 1'; "
        "the report begins with whether it is met; may be repeated (default: the section "
        "[require] of the store's pipeline)",
    )
    parser.add_argument(
        "--per", action="append", metavar="AXES",
        help="axes whose values are conditions, such as distance_m,tilt_deg; '' pools all "
        "(default: those of [require], else the axes of size, angle and boards)",
    )
    parser.add_argument(
        "--error-model", action="append", default=[], metavar="FILE",
        help="also write the error models as JSON, as `sweep error-model` does",
    )
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    quiet_matplotlib()

    for name in ("output", "figures"):
        value = getattr(options, name)
        if value is not None and not value.strip():
            raise ArgumentError(name, repr(value), "expected a name")
    for path in options.error_model:
        library.error_model_file.check_error_model_file(path)
    suffix = Path(options.output or "").suffix.lower()
    if suffix in NO_REPORTS:
        raise ArgumentError("output", options.output, "expected a file that ends in .html or .md")
    form = options.form or ("md" if str(options.output).lower().endswith(".md") else "html")
    output = Path(options.output or f"report.{form}")
    figures = Path(options.figures) if options.figures else None
    per = names_of(None if options.per is None else ",".join(options.per))
    data = library.report_data.read_report_data(
        options.store, options.requirements, per, command_line(options)
    )
    if options.json and library.output_file.is_standard_stream(output):
        raise ArgumentError("json", "", "and the report both go to standard output; choose -o FILE")
    if options.error_model:
        data = data.in_memory()
        library.error_model_file.written_error_models(data, options.error_model)
    count, found = library.write_report.write_report(data, output, form, figures)
    if library.output_file.is_standard_stream(output):
        return 0  # a line more would not be HTML
    if options.json:
        print_json({"report": str(output), "figures": count, "store": data.store,
                    "required": list(data.require), "per": list(data.per)} | found.as_json())
        return 0
    size = f", {byte_count(output.stat().st_size)}" if output.is_file() else ""
    say(f"{output}: {library.formatting.plural(count, 'figure')}{size}")
    for line in data.warnings:
        say(line)
    say(found.headline)
    if data.trade is None and data.setting_axes:
        say_next(f"sweep tradeoff {quoted(options.store)}", "what each configuration costs")
    else:
        say_next(f"look at {output}")
    return 0


REPORT = Command(
    "report", "write a report of a store: answer, figures, example scenes",
    "sweep/analysis/README.md",
    (
        Example(
            "sweep report runs/smoke.zarr --require 'detection >= 0.9'",
            "writes report.html, which begins with how far that is met",
        ),
        Example(
            "sweep report runs/smoke.zarr -o answer.md --figures figures",
            "writes Markdown, and each figure as SVG and PNG",
        ),
    ),
    _add_arguments, _execute,
)


# --------------------------------------------------------------------------------------------------
# ``sweep tradeoff``.

def _add_arguments_tradeoff(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "source", metavar="STORE|PIPELINE",
        help="a finished store, or a TOML file, which is run into its default store first",
    )
    parser.add_argument(
        "--per", action="append", default=[], metavar="AXIS",
        help="scene axis whose values are separate conditions, such as side_px; may be repeated",
    )
    parser.add_argument(
        "--criterion", default="rotation_p95_deg", metavar="NAME",
        help="error that ranks the configurations (default: rotation_p95_deg)",
    )
    parser.add_argument(
        "--seconds", type=float, default=60.0, metavar="S", dest="limit_s",
        help="time limit of the cost measurement, in seconds (default: 60)",
    )
    parser.add_argument(
        "--budget-ms", type=float, metavar="MS",
        help="name the most accurate configuration that costs at most so many ms a frame",
    )
    parser.add_argument(
        "-o", "--output", metavar="FIGURE", help="draw a figure into this PNG or SVG file"
    )
    add_form(parser)


def _execute_tradeoff(options: argparse.Namespace) -> int:
    quiet_matplotlib()

    _check(options)
    output = library.output_file.figure_file(options.output)
    store = options.source
    if store.lower().endswith(".toml"):

        options.stopped = CONTINUES
        with library.progress.progress_display() as bar:
            summary = library.runner.execute(
                library.pipeline.Pipeline.from_toml(store), None, progress=bar
            )
        for line in summary.warnings:
            notice(line)
        store = summary.store
    question = {"criterion": options.criterion}
    if options.budget_ms is not None:
        question["budget_ms"] = options.budget_ms
    with library.progress.stage_display() as report:
        trade, renderers = library.measurement.measure_trade(
            store, options.per, options.limit_s, report, question=question)
    budget = [] if options.budget_ms is None else library.pareto.budget_advice(
        trade, options.criterion, options.budget_ms)
    if output is not None:
        import io  # noqa: PLC0415

        figure = io.BytesIO()
        library.tradeoff_figure.draw_trade(
            trade, options.criterion, figure, output.suffix[1:].lower(), options.budget_ms
        )
        library.output_file.write_output_file(output, figure.getvalue())

    if options.json:
        content = trade.to_dict()
        if renderers is not None:
            content["renderers"] = renderers.to_dict()
        content["advice"] = library.pareto.advice(trade, options.criterion)
        if budget:
            content["budget"] = budget
        print_json(content)
        return 0
    tables = [library.tradeoff_figure.tradeoff_table(trade, options.criterion)]
    if renderers is not None:
        tables.append(library.tradeoff_figure.renderer_table(renderers))
    say("\n".join(library.tradeoff_figure.headlines(trade)))
    say()
    for table in tables:
        print_table(table, options)
    say("\n".join([*library.tradeoff_figure.legend(options.criterion), ""]))
    frames, sampled = trade.attrs["frames"], trade.attrs["sampled"]
    if frames < sampled:
        say(f"costs are those of {frames:,} of {sampled:,} sampled images; more --seconds, or "
            "markers that are seen, give more\n")
    say(
        "\n".join(
            [*budget, *([""] if budget else []), *library.pareto.advice(trade, options.criterion)]
        )
    )
    if not options.markdown:
        say()
        say_next(f"sweep report {quoted(store)}", "with these costs and a figure of them")
    return 0


def _check(options: argparse.Namespace) -> None:
    import math  # noqa: PLC0415

    if options.criterion not in library.pareto.CRITERIA:
        raise ArgumentError(
            "criterion",
            options.criterion,
            f"expected one of {', '.join(library.pareto.CRITERIA)}"
            + nearest(options.criterion, library.pareto.CRITERIA),
        )
    if options.budget_ms is not None and not 0 < options.budget_ms < math.inf:
        raise ArgumentError("budget_ms", options.budget_ms, "expected a finite number above 0")
    if not 0 < options.limit_s < math.inf:
        raise ArgumentError("limit_s", options.limit_s, "expected a finite number above 0")


TRADEOFF = Command(
    "tradeoff", "compare configurations: cost and accuracy on the same images",
    "sweep/tradeoff/README.md",
    (
        Example(
            "sweep tradeoff runs/tradeoff.zarr --per side_px -o trade.svg",
            "compares the configurations at each size of the marker, with a figure",
        ),
        Example(
            "sweep tradeoff pipelines/tradeoff.toml --criterion range_p95_percent --markdown",
            "runs the pipeline first; ranks by the range error; prints Markdown",
        ),
    ),
    _add_arguments_tradeoff, _execute_tradeoff,
)


# --------------------------------------------------------------------------------------------------
# ``sweep compare``.

def _add_arguments_compare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "photographs", metavar="STORE",
        help="store of photographs, as `sweep photos` makes it; or any store, to be compared with "
        "another one of the same pipeline",
    )
    parser.add_argument(
        "scene", metavar="SIMULATION",
        help="store of a simulation, or a TOML file with a section [scene], such as `sweep fit` "
        "writes: the photographs' markers are then simulated with it, at the same poses; or a "
        "store that another version of OpenCV made of the first store's pipeline",
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
    add_form(parser)


def _execute_compare(options: argparse.Namespace) -> int:
    output = library.output_file.figure_file(options.output)
    bins = dict(_edges(each) for each in options.bins) or None
    photographs = _opened(options.photographs)
    store = options.scene
    if store.endswith(".toml"):
        store = _simulated(options)
    simulated = _opened(store)
    if library.simulation_gaps.is_measured(photographs) == library.simulation_gaps.is_measured(
        simulated
    ):
        return _compare_stores(options, photographs, simulated)
    gap = library.analysis.simulation_gap(photographs, simulated, bins).load()
    if output is not None:
        quiet_matplotlib()

        panels = library.gap_figure.gap_panels(photographs, simulated, bins)
        library.output_file.write_output_file(
            output, library.charts.panels_file(panels, output.suffix.lower())
        )
    if options.json:
        print_json({
            "photographs": options.photographs, "simulated": store,
            "paired": bool(gap.attrs["paired"]), "rows": library.gap_figure.gap_records(gap),
        })
        return 0
    print_table(library.gap_figure.gap_table(gap), options)
    for line in library.gap_figure.gap_lines(gap):
        say(line)
    say_next(f"sweep report {shlex.quote(store)}")
    return 0


def _compare_stores(
    options: argparse.Namespace, first: xr.Dataset, second: xr.Dataset
) -> int:
    """Print how two stores of one pipeline differ."""
    for name in ("bins", "output", "store"):
        if getattr(options, name):
            raise ArgumentError(name, "", "expected a store of photographs and a simulation")
    differences = library.comparisons.store_differences(first, second)
    if options.json:
        print_json({"first": options.photographs, "second": options.scene,
                    **library.gap_figure.store_difference_json(differences)})
        return 0
    for table in library.gap_figure.store_difference_tables(differences):
        if table.rows:
            print_table(table, options)
    say_next(f"sweep report {shlex.quote(options.scene)}")
    return 0


def _opened(url: str) -> xr.Dataset:
    """Return the results of a finished store."""
    library.lifecycle.open_finished(url)
    return library.lifecycle.open_dataset(url)


def _simulated(options: argparse.Namespace) -> str:
    """Simulate the photographs' markers; return the store."""
    scene = library.twins.read_scene(options.scene)
    pipeline = library.twins.twin_pipeline(
        library.lifecycle.read_pipeline(options.photographs), scene, options.repeats
    )
    store: str = os.fspath(
        options.store or library.twins.twin_store(options.photographs, options.scene)
    )
    run_prepared(options, pipeline, store, ())
    return store


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


COMPARE = Command(
    "compare", "compare photographs with a simulation, or two stores",
    "pipelines/photographs/README.md",
    (
        Example(
            "sweep compare runs/shots.zarr scene.toml",
            "simulates each marker at its pose with this scene; prints the gaps",
        ),
        Example(
            "sweep compare runs/opencv4.zarr runs/opencv5.zarr",
            "counts what differs between versions of OpenCV on the same images",
        ),
    ),
    _add_arguments_compare, _execute_compare,
)


# --------------------------------------------------------------------------------------------------
# ``sweep error-model``.

def _add_arguments_error_model(parser: argparse.ArgumentParser) -> None:
    add_store(parser)
    parser.add_argument(
        "-o", "--output", action="append", default=[], metavar="FILE", dest="error_model",
        help="JSON file to write: formula, coefficients, units, the region that was seen "
        "(default: error_model.json)",
    )
    parser.add_argument(
        "--at", action="append", default=[], metavar="NAME=VALUE,...",
        help="only these values of an axis, such as solver=ippe; may be repeated",
    )
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table")


def _execute_error_model(options: argparse.Namespace) -> int:
    outputs = options.error_model or ["error_model.json"]
    for output in outputs:
        library.error_model_file.check_error_model_file(output)
    data = library.report_data.read_report_data(options.store)
    results = library.answer_tables.selected(data.results, options.at, data.pipeline)
    data = dataclasses.replace(data, results=results).in_memory()
    models = library.error_model_file.written_error_models(data, outputs)
    print_table(library.error_model_file.error_model_table(models), options)
    for line in [
        *library.error_model_file.exponent_lines(models),
        *library.error_model_file.warnings_of(models),
    ]:
        say(f"- {line}")
    say()
    say_next(f"look at {', '.join(outputs)}", "sigma and bias anywhere in the store's domain")
    return 0


ERROR_MODEL = Command(
    "error-model",
    "write models of the pose's error as JSON",
    "sweep/analysis/README.md",
    (
        Example("sweep error-model runs/tags.zarr",
                "writes error_model.json and prints a table"),
        Example(
            "sweep error-model runs/tags.zarr --at solver=ippe_square -o tag.json",
            "writes the models of one solver",
        ),
    ),
    _add_arguments_error_model, _execute_error_model,
)


# --------------------------------------------------------------------------------------------------
# ``sweep calibration``.

VIEWS = "10,20,40"


def _add_arguments_calibration(parser: argparse.ArgumentParser) -> None:
    add_store(parser)
    parser.add_argument(
        "--views", default=VIEWS, metavar="N,...",
        help=f"numbers of views in a calibration (default: {VIEWS})",
    )
    parser.add_argument(
        "--points", choices=("chessboard", "markers"),
        help="points of the board that are used (default: the chessboard's if there is one)",
    )
    parser.add_argument(
        "--coefficients", type=int, default=5, metavar="N",
        help="lens coefficients that are estimated: 0, 1 (k1), 2 (k2), 4 (p1, p2), 5 (k3) "
        "(default: 5)",
    )
    parser.add_argument(
        "--target-m", type=float, default=3.0, metavar="M",
        help="distance of the target whose depth is estimated with each camera (default: 3)",
    )
    add_form(parser)


def _execute_calibration(options: argparse.Namespace) -> int:
    try:
        views = [int(each) for each in options.views.split(",")]
    except ValueError:
        raise ArgumentError(
            "views", options.views, f"expected whole numbers, such as {VIEWS}"
        ) from None
    summary = library.camera_calibration.calibration_summary(
        library.camera_calibration.camera_calibrations(
            library.lifecycle.open_dataset(options.store),
            views,
            points=options.points,
            coefficients=options.coefficients,
            target_m=options.target_m,
        )
    )
    if options.json:
        print_json({
            "points": summary.attrs["points"], "target_m": summary.attrs["target_m"],
            "rows": library.gap_figure.calibration_records(summary),
        })
        return 0
    print_table(library.gap_figure.calibration_table(summary), options)
    say_next(
        f"sweep.analysis.camera_calibrations(sweep.open({options.store!r}), [20]) in Python",
        "the errors of each calibration",
    )
    return 0


CALIBRATION = Command(
    "calibration",
    "calibrate cameras from views of a board, and judge them",
    "pipelines/calibration/README.md",
    (
        Example("sweep calibration runs/calibration.zarr",
                "errors and coverage for 10, 20 and 40 views"),
        Example("sweep calibration runs/calibration.zarr --views 5,20 --coefficients 2",
                "fewer views, and a lens of two coefficients"),
    ),
    _add_arguments_calibration, _execute_calibration,
)
