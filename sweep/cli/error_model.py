"""``sweep error-model``."""

from __future__ import annotations

import argparse

from sweep.cli.arguments import add_store
from sweep.cli.command import Command, Example
from sweep.cli.output import say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_store(parser)
    parser.add_argument(
        "-o", "--output", action="append", default=[], metavar="FILE", dest="error_model",
        help="file to write, in the format of its suffix: .json, .hpp (C++17), .py, .java, .yaml "
        "(covariances for ROS); may be repeated (default: error_model.json)",
    )
    parser.add_argument(
        "--at", action="append", default=[], metavar="NAME=VALUE,...",
        help="only the models of these values of an axis, such as solver=ippe; may be repeated",
    )
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table")


def _execute(options: argparse.Namespace) -> int:
    from sweep.report.error_model_file import (  # noqa: PLC0415
        check_error_model_file,
        selected,
        warnings_of,
        written_error_models,
    )
    from sweep.report.error_model_table import (  # noqa: PLC0415
        error_model_table,
        exponent_lines,
        plain_table,
    )
    from sweep.report.report_data import read_report_data  # noqa: PLC0415

    outputs = options.error_model or ["error_model.json"]
    for output in outputs:
        check_error_model_file(output)
    data = selected(read_report_data(options.store), options.at).in_memory()
    models = written_error_models(data, outputs)
    table = error_model_table(models)
    say(table.markdown() if options.markdown else plain_table(table))
    say()
    for line in [*exponent_lines(models), *warnings_of(models)]:
        say(f"- {line}")
    say()
    say_next(f"look at {', '.join(outputs)}", "sigma and bias anywhere in the store's domain")
    return 0


ERROR_MODEL = Command(
    "error-model",
    "write models of the pose's error for C++, Python, Java, ROS",
    "sweep/analysis/README.md",
    (
        Example("sweep error-model runs/tags.zarr",
                "writes error_model.json and prints a table"),
        Example(
            "sweep error-model runs/tags.zarr --at solver=ippe_square -o tag.hpp -o tag.yaml",
            "writes the models of one solver as C++ and as covariances for ROS",
        ),
    ),
    _add_arguments, _execute,
)
