"""``sweep tradeoff``."""

from __future__ import annotations

import argparse
import shlex

from sweep.cli.arguments import add_json
from sweep.cli.command import CONTINUES, Command, Example
from sweep.cli.output import print_json, quiet_matplotlib, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
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
    form = parser.add_mutually_exclusive_group()
    add_json(form)
    form.add_argument("--markdown", action="store_true", help="print Markdown tables")


def _execute(options: argparse.Namespace) -> int:
    quiet_matplotlib()
    from sweep.execution.progress import stage_display  # noqa: PLC0415
    from sweep.report.output_file import figure_file, write_output_file  # noqa: PLC0415
    from sweep.tradeoff.advice import advice, budget_advice  # noqa: PLC0415
    from sweep.tradeoff.measurement import measure_trade  # noqa: PLC0415

    _check(options)
    output = figure_file(options.output)
    store = options.source
    if store.lower().endswith(".toml"):
        from sweep.execution.progress import progress_display  # noqa: PLC0415
        from sweep.execution.runner import execute  # noqa: PLC0415
        from sweep.messages import notice  # noqa: PLC0415
        from sweep.plan.experiment import Pipeline  # noqa: PLC0415

        options.stopped = CONTINUES
        with progress_display() as bar:
            summary = execute(Pipeline.from_toml(store), None, progress=bar)
        for line in summary.warnings:
            notice(line)
        store = summary.store
    question = {"criterion": options.criterion}
    if options.budget_ms is not None:
        question["budget_ms"] = options.budget_ms
    with stage_display() as report:
        trade, renderers = measure_trade(
            store, options.per, options.limit_s, report, question=question)
    budget = [] if options.budget_ms is None else budget_advice(
        trade, options.criterion, options.budget_ms)
    if output is not None:
        import io  # noqa: PLC0415

        from sweep.report.tradeoff_chart import draw_trade  # noqa: PLC0415

        figure = io.BytesIO()
        draw_trade(trade, options.criterion, figure, output.suffix[1:].lower(), options.budget_ms)
        write_output_file(output, figure.getvalue())
    from sweep.report.renderer_table import renderer_lines  # noqa: PLC0415
    from sweep.report.tradeoff_table import as_json, table_markdown, table_text  # noqa: PLC0415

    if options.json:
        content = as_json(trade)
        if renderers is not None:
            content["renderers"] = as_json(renderers)
        content["advice"] = advice(trade, options.criterion)
        if budget:
            content["budget"] = budget
        print_json(content)
        return 0
    form = table_markdown if options.markdown else table_text
    say(form(trade, options.criterion))
    if renderers is not None:
        say()
        say("\n".join(renderer_lines(renderers, markdown=options.markdown)))
    say()
    frames, sampled = trade.attrs["frames"], trade.attrs["sampled"]
    if frames < sampled:
        say(f"costs are those of {frames:,} of {sampled:,} sampled images; more --seconds, or "
            "markers that are seen, give more\n")
    say("\n".join([*budget, *([""] if budget else []), *advice(trade, options.criterion)]))
    if not options.markdown:
        say()
        say_next(f"sweep report {shlex.quote(store)}", "with these costs and a figure of them")
    return 0


def _check(options: argparse.Namespace) -> None:
    import math  # noqa: PLC0415

    from sweep.errors import ArgumentError  # noqa: PLC0415
    from sweep.messages import nearest  # noqa: PLC0415
    from sweep.tradeoff.pareto import CRITERIA  # noqa: PLC0415

    if options.criterion not in CRITERIA:
        raise ArgumentError(
            "criterion", options.criterion,
            f"expected one of {', '.join(CRITERIA)}{nearest(options.criterion, CRITERIA)}")
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
    _add_arguments, _execute,
)
