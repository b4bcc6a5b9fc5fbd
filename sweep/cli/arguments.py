"""Arguments that several commands share."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from sweep.messages import plain

if TYPE_CHECKING:
    from sweep.plan.experiment import Pipeline


def add_pipeline(parser: argparse.ArgumentParser) -> None:
    """Add the pipeline file and the settings that replace its values."""
    parser.add_argument(
        "pipeline", metavar="PIPELINE",
        help="TOML file of the experiment, or a store that was made from it",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="replace a value of the file by this TOML value; a list makes an axis; "
        "may be repeated",
    )


def read_pipeline(options: argparse.Namespace) -> Pipeline:
    """Return the pipeline of a command that takes one.

    Raises
    ------
    PipelineError
        If the file or a setting is invalid.
    StoreError
        If it is given as a folder that is no store.
    """
    from sweep.errors import PipelineError  # noqa: PLC0415
    from sweep.store.stored_pipeline import read_pipeline as read  # noqa: PLC0415
    from sweep.store.stored_pipeline import texts_required  # noqa: PLC0415

    source = plain(options.pipeline)
    try:
        pipeline = read(options.pipeline, options.settings)
    except PipelineError as error:
        if texts := texts_required(options.pipeline, options.settings):
            from sweep.analysis.required_pipeline import check_required  # noqa: PLC0415

            check_required(texts, source, error)
        raise
    if pipeline.requirements:
        from sweep.analysis.required_pipeline import check_required  # noqa: PLC0415

        check_required(pipeline.requirements, source)
    return pipeline


def add_store(parser: argparse.ArgumentParser) -> None:
    """Add the store that is read."""
    parser.add_argument("store", metavar="STORE", help="path or URL of the store")


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add the number of worker processes."""
    parser.add_argument(
        "--workers", type=int, metavar="N",
        help="number of worker processes (default: one for each processor)",
    )


def add_cell(parser: argparse.ArgumentParser, meaning: str, *, several: bool = False) -> None:
    """Add the selection of one cell, or of several."""
    parser.add_argument(
        "--at", metavar="NAME=VALUE,...",
        help=f"{meaning}; an axis that is not named takes its first value"
        + ("; may be repeated" if several else "; may be repeated, with other names"),
        action="append", default=[],
    )


def add_picture(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """Add where and how one scene is drawn; without a default, nothing is unless asked for."""
    written = f"default: {default}" if default else "default: no file is written"
    parser.add_argument(
        "-o", "--output", default=default, metavar="PNG",
        help=f"file to write the image to ({written})",
    )
    parser.add_argument("--plain", action="store_true", help="draw the image without annotations")
    parser.add_argument(
        "--full", action="store_true",
        help="draw the whole frame instead of the marker's surroundings",
    )


def add_json(parser: argparse._ActionsContainer) -> None:
    """Add the choice of JSON on standard output."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")
