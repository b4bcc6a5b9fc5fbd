"""``sweep calibration``."""

from __future__ import annotations

import argparse

from sweep.cli.arguments import add_json, add_store
from sweep.cli.command import Command, Example
from sweep.cli.output import print_json, say, say_next

VIEWS = "10,20,40"


def _add_arguments(parser: argparse.ArgumentParser) -> None:
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
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table")
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.analysis.camera_calibration import (  # noqa: PLC0415
        calibration_summary,
        camera_calibrations,
    )
    from sweep.errors import ArgumentError  # noqa: PLC0415
    from sweep.report.calibration_table import calibration_table  # noqa: PLC0415
    from sweep.report.error_model_table import plain_table  # noqa: PLC0415
    from sweep.store.lifecycle import open_dataset  # noqa: PLC0415

    try:
        views = [int(each) for each in options.views.split(",")]
    except ValueError:
        raise ArgumentError(
            "views", options.views, f"expected whole numbers, such as {VIEWS}"
        ) from None
    summary = calibration_summary(camera_calibrations(
        open_dataset(options.store), views, points=options.points,
        coefficients=options.coefficients, target_m=options.target_m,
    ))
    table = calibration_table(summary)
    if options.json:
        print_json({"rows": [dict(zip(table.headings, row, strict=True)) for row in table.rows]})
        return 0
    say(table.markdown() if options.markdown else plain_table(table))
    say()
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
    _add_arguments, _execute,
)
