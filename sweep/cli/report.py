"""``sweep report``."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from sweep.cli.arguments import add_json, add_store
from sweep.cli.command import Command, Example
from sweep.cli.output import command_line, print_json, quiet_matplotlib, say, say_next

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
        help="also write the error models, as `sweep error-model` does, in the format of FILE's "
        "suffix: .json, .hpp, .py, .java or .yaml; may be repeated",
    )
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    quiet_matplotlib()
    from sweep.errors import ArgumentError  # noqa: PLC0415
    from sweep.messages import byte_count  # noqa: PLC0415
    from sweep.report.error_model_file import (  # noqa: PLC0415
        check_error_model_file,
        written_error_models,
    )
    from sweep.report.formatting import plural  # noqa: PLC0415
    from sweep.report.output_file import is_standard_stream  # noqa: PLC0415
    from sweep.report.report_data import read_report_data  # noqa: PLC0415
    from sweep.report.write_report import write_report  # noqa: PLC0415

    for name in ("output", "figures"):
        value = getattr(options, name)
        if value is not None and not value.strip():
            raise ArgumentError(name, repr(value), "expected a name")
    for path in options.error_model:
        check_error_model_file(path)
    suffix = Path(options.output or "").suffix.lower()
    if suffix in NO_REPORTS:
        raise ArgumentError("output", options.output, "expected a file that ends in .html or .md")
    form = options.form or ("md" if str(options.output).lower().endswith(".md") else "html")
    output = Path(options.output or f"report.{form}")
    figures = Path(options.figures) if options.figures else None
    per = None if options.per is None else [
        name for part in options.per for each in part.split(",") if (name := each.strip())]
    data = read_report_data(options.store, options.requirements, per, command_line(options))
    if options.json and is_standard_stream(output):
        raise ArgumentError("json", "", "and the report both go to standard output; choose -o FILE")
    if options.error_model:
        data = data.in_memory()
        written_error_models(data, options.error_model)
    count, found = write_report(data, output, form, figures)
    if is_standard_stream(output):
        return 0  # a line more would not be HTML
    if options.json:
        print_json({"report": str(output), "figures": count, "store": data.store,
                    "required": list(data.require), "per": list(data.per)} | found.as_json())
        return 0
    size = f", {byte_count(output.stat().st_size)}" if output.is_file() else ""
    say(f"{output}: {plural(count, 'figure')}{size}")
    for line in data.warnings:
        say(line)
    say(found.headline)
    if data.trade is None and data.setting_axes:
        say_next(f"sweep tradeoff {shlex.quote(options.store)}", "what each configuration costs")
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
