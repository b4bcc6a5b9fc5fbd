"""The commands of decisions: require, size, limit."""

from __future__ import annotations

import argparse
import dataclasses
import math
from typing import TYPE_CHECKING

from sweep import library
from sweep.cli.command import (
    CONTINUES,
    Command,
    Example,
    add_form,
    add_large_run,
    add_new_store,
    add_pipeline,
    add_settings,
    add_store,
    names_of,
    print_json,
    print_table,
    quiet_matplotlib,
    read_pipeline,
    say,
    say_next,
)
from sweep.cli.prepared import announce_compilation, beside_child, store_of
from sweep.errors import ArgumentError
from sweep.messages import notice, quoted

if TYPE_CHECKING:
    import xarray as xr

    from sweep.isolation.child_process import Child
    from sweep.plan.pipeline import Pipeline


# --------------------------------------------------------------------------------------------------
# ``sweep require``.

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
    add_form(parser)


def _execute(options: argparse.Namespace) -> int:
    results, pipeline = _open(options.store, options.at)
    texts, per = _required(options, pipeline, results)
    if not texts and options.against is None:
        raise ArgumentError(
            "requirements", "[]", "the pipeline has no section [require]; give some, such as "
            "'detection >= 0.95' 'range_error_p95_percent <= 1'")
    required = library.requirements.parse_requirements(texts) if texts else ()
    found, table = [], None
    if required:
        table = library.requirements.check_requirements(results, required, per)
        found = library.requirements.verdicts(table)
    worse = []
    if options.against is not None:
        old, _ = _open(options.against, options.at)
        worse = library.comparisons.regressions(
            old, results, [each.variable for each in required], per
        )
    decision = library.requirements.combined(found) if found else library.requirements.Decision.met
    if any(each.worse for each in worse):
        decision = library.requirements.Decision.not_met
    status = {library.requirements.Decision.met: 0, library.requirements.Decision.not_met: 1}.get(
        decision, TOO_FEW_DRAWS
    )
    pooled = library.answer_tables.pooled_axes(results, per)
    usual = per if options.per is None and list(pipeline.require_per) != per else []
    if options.json:
        print_json(
            {
                "decision": decision,
                "per": per,
                "pooled": pooled,
                "requirements": [
                    {
                        **dataclasses.asdict(each),
                        "failing": library.answer_tables.failing(each, table)[
                            : library.answer_tables.MAX_ROWS
                        ],
                    }
                    for each in found
                ],
                "against": worse,
            }
        )
        return status
    for each in library.answer_tables.tables(found, worse, table, every=options.markdown):
        print_table(each, options)
    if usual:
        say(f"at each value of {', '.join(usual)}; --per '' pools all")
    if pooled:
        say(f"pooled over {', '.join(pooled)}; --per keeps axes apart as conditions")
    if not options.markdown:
        say_next(library.answer_tables.more_draws(found, results, options.store))
    return status


def _open(url: str, at: list[str]) -> tuple[xr.Dataset, Pipeline]:
    """Return a finished store's results at some values of axes, and its pipeline."""
    store = library.lifecycle.open_finished(url)
    return library.answer_tables.selected(
        library.lifecycle.open_dataset(url), at, store.pipeline
    ), store.pipeline


def _required(
    options: argparse.Namespace, pipeline: Pipeline, results: xr.Dataset
) -> tuple[list[str], list[str]]:
    """Return the requirements' texts and the axes of conditions."""
    if options.pipeline is not None:
        pipeline = library.lifecycle.read_pipeline(options.pipeline)
        library.requirements.check_required(pipeline.requirements, options.pipeline)
    texts = options.requirements or list(pipeline.requirements)
    return texts, list(
        library.requirements.conditions(results, names_of(options.per), pipeline.require_per)
    )


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


# --------------------------------------------------------------------------------------------------
# ``sweep size``.

UNDECIDED = 3
"""Exit status where the most trials do not decide the best choice, if any will do, or a limit."""


def _add_arguments_size(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "pipeline", metavar="PIPELINE",
        help="TOML file with the sections [require] and [choose], or the store of a search",
    )
    add_settings(
        parser, "replace a value of the file by this TOML value, such as choose.max_trials=2000")
    add_new_store(parser)
    add_large_run(parser)
    parser.add_argument(
        "--seconds", type=float, default=20.0, metavar="S", dest="limit_s",
        help="time limit of the measurement of costs, in seconds (default: 20)",
    )
    add_form(parser)


@beside_child
def _execute_size(options: argparse.Namespace, child: Child) -> int:
    if not 0 < options.limit_s < math.inf:
        raise ArgumentError("limit_s", options.limit_s, "expected a finite number above 0")
    pipeline = read_pipeline(options)
    library.choice_search.chosen_by(pipeline)
    announce_compilation(pipeline)
    options.stopped = CONTINUES
    with library.progress.progress_display() as bar, library.progress.stage_display() as stage:
        choice = library.choice_search.search_choice(
            pipeline, store_of(options), limit_s=options.limit_s, progress=bar, stage=stage,
            child=child, workers=options.workers, reuse=options.reuse,
            overwrite=options.overwrite, yes=options.yes)
    status = {
        library.requirements.Decision.met: 0,
        library.requirements.Decision.undecided: UNDECIDED,
    }.get(choice.decision, 1)
    if options.json:
        print_json(library.answer_tables.as_json(choice))
        return status
    print_table(library.answer_tables.alternatives(choice), options)
    for line in (library.answer_tables.poses_line(choice), *choice.notes):
        say(line)
    say_next(f"sweep report {quoted(choice.store)}")
    return status


SIZE = Command(
    "size", "find the smallest or cheapest choice that will do",
    "pipelines/sizes/README.md",
    (
        Example(
            "sweep size pipelines/sizes/smallest_marker.toml",
            "how large a marker must be, and by which condition the next smaller one fails",
        ),
        Example(
            "sweep size pipelines/sizes/smallest_marker.toml --set choose.max_trials=2000 "
            "--store runs/quick.zarr --markdown",
            "with fewer trials of a condition at most; prints Markdown",
        ),
    ),
    _add_arguments_size, _execute_size,
)


# --------------------------------------------------------------------------------------------------
# ``sweep limit``.

def _add_arguments_limit(parser: argparse.ArgumentParser) -> None:
    add_pipeline(parser)
    parser.add_argument(
        "--require", action="append", default=[], metavar="REQUIREMENT",
        help="what must hold, in quotes: 'detection >= 0.9'; may be repeated, all hold together "
        "(default: the section [limit], else [require], of the file)",
    )
    parser.add_argument(
        "--along", default="", metavar="AXIS",
        help="the axis of the scene that is searched, such as distance_m",
    )
    parser.add_argument(
        "--per", metavar="AXES",
        help="axes of which each combination of values has its own limit, such as "
        "tilt_deg,noise_grey (default: all; with '' none); others are pooled",
    )
    parser.add_argument(
        "--at-all", metavar="AXES",
        help="axes at all of whose values the requirements must hold",
    )
    parser.add_argument(
        "--max-trials", type=int, metavar="N",
        help="the most trials of a cell (default: that of [limit], else 2400)",
    )
    parser.add_argument(
        "--coarse-trials", type=int, metavar="N",
        help="trials of every cell in the coarse scan (default: as many as make 40 draws of a "
        "value)",
    )
    add_new_store(parser, "runs/NAME-limit-AXIS.zarr")
    add_large_run(parser)
    parser.add_argument("--scheduler", metavar="ADDRESS", help="address of a Dask scheduler")
    parser.add_argument(
        "-o", "--output", metavar="FIGURE", help="draw the limits into this PNG or SVG file"
    )
    add_form(parser)


@beside_child
def _execute_limit(options: argparse.Namespace, child: Child) -> int:
    quiet_matplotlib()

    output = library.output_file.figure_file(options.output)
    options.stopped = CONTINUES
    with library.progress.progress_display() as display:
        limits, summary = library.limit_search.search_limits(
            options.pipeline, require=options.require, along=options.along,
            per=names_of(options.per), at_all=names_of(options.at_all),
            max_trials=options.max_trials, coarse_trials=options.coarse_trials,
            settings=options.settings, store=options.store, begin=announce_compilation,
            workers=options.workers, scheduler=options.scheduler, reuse=options.reuse,
            overwrite=options.overwrite, yes=options.yes, progress=display, child=child)
    for line in summary.warnings if summary is not None else ():
        notice(line)
    store = str(limits.attrs["store"])

    if output is not None:
        library.output_file.write_output_file(
            output,
            library.charts.panels_file(
                library.limit_figure.limit_panels(limits), output.suffix.lower()
            ),
        )
    status = 0 if library.limit_figure.are_decided(limits).all() else UNDECIDED
    if options.json:
        print_json({**library.limit_figure.as_json(limits), "store": store})
        return status
    print_table(library.limit_figure.limit_table(limits), options)
    for line in library.limit_figure.summary_lines(limits):
        say(f"- {line}" if options.markdown else line)
    say_next(f"sweep report {quoted(store)}")
    return status


LIMIT = Command(
    "limit", "find how far along an axis requirements are met",
    "pipelines/limits/README.md",
    (
        Example(
            "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' "
            "--along distance_m",
            "finds from how far a marker is detected, at each tilt",
        ),
        Example(
            "sweep limit pipelines/limits/far.toml --require 'detection >= 0.9' "
            "--along distance_m --at-all tilt_deg -o limit.svg",
            "finds up to which distance it is at all tilts, with a figure",
        ),
    ),
    _add_arguments_limit, _execute_limit,
)
