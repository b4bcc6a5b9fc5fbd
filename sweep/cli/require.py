"""``sweep require``."""

from __future__ import annotations

import argparse
import dataclasses
import math
from typing import TYPE_CHECKING, Any

from sweep.cli.arguments import add_json, add_store
from sweep.cli.command import Command, Example
from sweep.cli.output import print_json, say, say_next

if TYPE_CHECKING:
    import xarray as xr

    from sweep.analysis.regressions import Regression
    from sweep.analysis.verdicts import Verdict
    from sweep.plan.experiment import Pipeline

TOO_FEW_DRAWS = 3
"""Exit status where draws are too few to tell."""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_store(parser)
    parser.add_argument(
        "requirements", nargs="*", metavar="REQUIREMENT",
        help="what is required, in quotes: 'detection >= 0.95', 'range_error_p95_percent <= 1' "
        "(default: the section [require] of the store's pipeline)",
    )
    parser.add_argument(
        "--per", metavar="AXES",
        help="axes whose values are conditions, at each of which all must hold, such as "
        "distance_m,tilt_deg; others are pooled, with '' all (default: those of [require], else "
        "the axes of size, angle and boards)",
    )
    parser.add_argument(
        "--pipeline", metavar="FILE",
        help="take [require] from this TOML file in place of the store's pipeline",
    )
    parser.add_argument(
        "--at", action="append", default=[], metavar="NAME=VALUE,...",
        help="judge these values of axes alone, such as solver=ippe_square; may be repeated",
    )
    parser.add_argument(
        "--against", metavar="STORE",
        help="also compare pose by pose with this older store: significantly worse is not met",
    )
    parser.add_argument(
        "--markdown", action="store_true",
        help="print Markdown, with a table of all conditions, for the summary of a job",
    )
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.analysis.regressions import regressions  # noqa: PLC0415
    from sweep.analysis.requirements import (  # noqa: PLC0415
        Decision,
        check_requirements,
        parse_requirements,
    )
    from sweep.analysis.verdicts import combined, verdicts  # noqa: PLC0415
    from sweep.cli import requirement_lines as lines  # noqa: PLC0415
    from sweep.errors import ArgumentError  # noqa: PLC0415

    if options.markdown and options.json:
        raise ArgumentError("markdown", "", "expected one of --markdown and --json")
    results, pipeline = _open(options.store, options.at)
    texts, per = _required(options, pipeline, results)
    if not texts and options.against is None:
        raise ArgumentError(
            "requirements", "[]", "the pipeline has no section [require]; give some, such as "
            "'detection >= 0.95' 'range_error_p95_percent <= 1'")
    required = parse_requirements(texts) if texts else ()
    found, table = [], None
    if required:
        table = check_requirements(results, required, per)
        found = verdicts(table)
    worse = []
    if options.against is not None:
        old, _ = _open(options.against, options.at)
        worse = regressions(old, results, [each.variable for each in required], per)
    decision = combined(found) if found else Decision.met
    if any(each.worse for each in worse):
        decision = Decision.not_met
    status = {Decision.met: 0, Decision.not_met: 1}.get(decision, TOO_FEW_DRAWS)
    pooled = lines.pooled_axes(results, per)
    usual = per if options.per is None and list(pipeline.require_per) != per else []
    if options.json:
        print_json(_as_json(found, worse, decision.name, per, pooled))
    elif options.markdown:
        say(lines.markdown(found, worse, table, decision, pooled))
    else:
        for line in lines.text(found, worse, pooled, usual):
            say(line)
        say_next(lines.more_draws(found, results, options.store))
    return status


def _open(store: str, at: list[str]) -> tuple[xr.Dataset, Pipeline]:
    """Return a finished store's results at some values of axes, and its pipeline."""
    from sweep.cli.requirement_lines import selected  # noqa: PLC0415
    from sweep.errors import StoreError  # noqa: PLC0415
    from sweep.store.lifecycle import open_dataset, open_store  # noqa: PLC0415
    from sweep.store.unfinished import unfinished_line  # noqa: PLC0415

    opened = open_store(store)
    if not opened.finished:
        raise StoreError(unfinished_line(opened))
    return selected(open_dataset(store), at, opened.pipeline), opened.pipeline


def _required(
    options: argparse.Namespace, pipeline: Pipeline, results: xr.Dataset
) -> tuple[list[str], list[str]]:
    """Return the requirements' texts and the axes of conditions."""
    from sweep.analysis.conditions import conditions  # noqa: PLC0415
    from sweep.analysis.required_pipeline import check_required  # noqa: PLC0415
    from sweep.store.stored_pipeline import read_pipeline  # noqa: PLC0415

    if options.pipeline is not None:
        pipeline = read_pipeline(options.pipeline)
        check_required(pipeline.requirements, options.pipeline)
    texts = options.requirements or list(pipeline.requirements)
    per = None if options.per is None else [
        name for part in options.per.split(",") if (name := part.strip())]
    return texts, list(conditions(results, per, pipeline.require_per))


def _as_json(
    found: list[Verdict], worse: list[Regression], decision: str, per: list[str],
    pooled: list[str],
) -> dict[str, Any]:
    return {
        "decision": decision, "per": per, "pooled": pooled,
        "requirements": [_plain({
            **dataclasses.asdict(each), "decision": each.decision.name,
            "counts": {flag.name: count for flag, count in each.counts.items()},
        }) for each in found],
        "against": [_plain(dataclasses.asdict(each)) for each in worse],
    }


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return values that JSON has: a number that does not exist or is infinite is text or null."""
    def number(value: Any) -> Any:
        if isinstance(value, float) and not math.isfinite(value):
            return None if math.isnan(value) else str(value)
        return value

    return {name: number(value) for name, value in values.items()}


REQUIRE = Command(
    "require", "decide whether a store's results meet requirements",
    "sweep/analysis/README.md",
    (
        Example(
            "sweep require runs/smoke.zarr 'detection >= 0.2'",
            "exits with 0 if it is met, 1 if it is not, 3 if draws are too few to tell",
        ),
        Example(
            "sweep require runs/smoke.zarr 'detection >= 0.2' --per tilt_deg --markdown",
            "prints a table of all tilts, for the summary of a job",
        ),
    ),
    _add_arguments, _execute,
)
