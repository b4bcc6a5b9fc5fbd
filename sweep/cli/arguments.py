"""Arguments that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
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


def add_precision(parser: argparse.ArgumentParser) -> None:
    """Add how well quantities are to be known, in the place of a number of trials."""
    parser.add_argument(
        "--precision", action="append", default=[], metavar="NAME=WIDTH",
        help="compute trials until the interval of this quantity is as narrow at each condition: "
        "half-width of a rate, of another quantity as a share of it, such as "
        "'detection_rate = 0.02' or 'rotation_error_rmse_deg = 5 %%'; may be repeated",
    )
    parser.add_argument(
        "--max-trials", type=int, metavar="N", help="the most trials of a condition",
    )


def precision_settings(precision: Sequence[str], max_trials: int | None) -> list[str]:
    """Return settings, as ``--set`` takes them, that say how well quantities are to be known.

    Raises
    ------
    ArgumentError
        If one has not the form of such.

    Examples
    --------
    >>> precision_settings(["detection_rate = 2 %"], 2400)
    ['precision.detection_rate="2 %"', 'precision.max_trials=2400']
    """
    from sweep.errors import ArgumentError  # noqa: PLC0415

    settings = []
    for text in precision:
        name, equals, width = (part.strip() for part in text.partition("="))
        if not equals or not name.isidentifier() or not width:
            raise ArgumentError(
                "precision", text,
                "expected a quantity and the half-width of its interval, such as "
                "'detection_rate = 0.02'",
            )
        quoted = width if not width.endswith("%") else f'"{width}"'
        settings.append(f"precision.{name}={quoted}")
    if max_trials is not None:
        settings.append(f"precision.max_trials={max_trials}")
    return settings


def read_pipeline(options: argparse.Namespace) -> Pipeline:
    """Return the pipeline of a command that takes one.

    Raises
    ------
    PipelineError
        If the file or a setting is invalid.
    StoreError
        If it is given as a folder that is no store.
    """
    from sweep.errors import ArgumentError, PipelineError  # noqa: PLC0415
    from sweep.plan.stopping import NO_TRIALS  # noqa: PLC0415
    from sweep.store.stored_pipeline import read_pipeline as read  # noqa: PLC0415
    from sweep.store.stored_pipeline import texts_required  # noqa: PLC0415

    source = plain(options.pipeline)
    options.settings = [*options.settings, *precision_settings(
        getattr(options, "precision", ()), getattr(options, "max_trials", None))]
    try:
        pipeline = read(options.pipeline, options.settings)
    except PipelineError as error:
        if options.settings and any(line.endswith(NO_TRIALS) for line in error.faults) and (
                getattr(options, "precision", ())):
            raise ArgumentError(
                "max_trials", "", f"expected {NO_TRIALS}, such as 2400; beside --precision"
            ) from None
        if texts := texts_required(options.pipeline, options.settings):
            from sweep.analysis.required_pipeline import check_required  # noqa: PLC0415

            check_required(texts, source, error)
        raise
    if pipeline.requirements:
        from sweep.analysis.required_pipeline import check_required  # noqa: PLC0415

        check_required(pipeline.requirements, source)
    if pipeline.stopping is not None:
        from sweep.sampling.rules import make_rule  # noqa: PLC0415

        make_rule(pipeline)
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
