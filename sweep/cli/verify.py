"""``sweep verify``."""

from __future__ import annotations

import argparse
import shlex

from sweep.cli.arguments import add_json, add_store, add_workers
from sweep.cli.command import CONTINUES, Command, Example
from sweep.cli.output import MAX_LINES, print_json, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_store(parser)
    parser.add_argument(
        "--repair", action="store_true",
        help="recompute damaged blocks, and rewrite or delete other damaged files",
    )
    parser.add_argument(
        "--sample", type=int, default=20, metavar="N",
        help="number of scenes to recompute and compare, beside all that failed (default: 20); "
        "0 recomputes nothing",
    )
    add_workers(parser)
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    if options.repair:
        options.stopped = CONTINUES
        from sweep.integrity.repair import repair  # noqa: PLC0415

        report = repair(options.store, options.sample, workers=options.workers)
    else:
        from sweep.integrity.verification import verify  # noqa: PLC0415

        report = verify(options.store, options.sample)
    if options.json:
        print_json(report.to_json())
        return 1 if report.damage else 0
    from sweep.messages import plain  # noqa: PLC0415

    for what, listed in (("repaired", report.repaired), ("damaged", report.damage)):
        for damage in listed[:MAX_LINES]:
            say(f"{what:9} {plain(damage.where, 300)}: {plain(damage.what, 300)}")
        if len(listed) > MAX_LINES:
            say(f"{what:9} and {len(listed) - MAX_LINES:,} more; --json lists all")
    if report.left_over:
        example = plain(report.left_over[0])
        say(f"{len(report.left_over):,} files do not belong to the store, such as {example}; "
              "--repair deletes them")
    again = f"{report.sampled} scenes recomputed" if report.sampled else (
        f"no scene recomputed ({report.not_sampled})"
    )
    if report.retried:
        again += f", {report.retried:,} that had failed"
    state = "" if report.finished else ", unfinished"
    say(
        f"{report.store}: {'damaged' if report.damage else 'sound'}{state}: "
        f"{report.blocks_done:,} of {report.blocks:,} blocks, {report.files:,} files, "
        f"{again}"
        + (f"; damaged: {len(report.damage):,}" if report.damage else "")
    )
    store = shlex.quote(options.store)
    if (report.damage or report.left_over) and not options.repair:
        say_next(f"sweep verify {store} --repair", "repairs it")
    elif report.damage:
        say_next(f"sweep run {store} --overwrite", "computes all of it again")
    else:
        say_next(f"sweep {_following(options.store, finished=report.finished)} {store}")
    return 1 if report.damage else 0


def _following(url: str, *, finished: bool) -> str:
    """Return the command to go on with after a sound store."""
    if finished:
        return "report"
    from sweep.store.lifecycle import open_store  # noqa: PLC0415
    from sweep.store.lock import holder  # noqa: PLC0415

    return "run" if holder(open_store(url).storage) is None else "status"


VERIFY = Command(
    "verify", "check a store's integrity; optionally repair it",
    "sweep/integrity/README.md",
    (
        Example("sweep verify runs/smoke.zarr", "checks every file, and recomputes 20 scenes"),
        Example(
            "sweep verify runs/smoke.zarr --repair --sample 100",
            "repairs what is damaged, and recomputes 100 scenes",
        ),
    ),
    _add_arguments, _execute,
)
