"""Runs that are refused unless they are confirmed: longer than a day, or larger than the disk."""

from __future__ import annotations

import contextlib
import math
import os
from dataclasses import dataclass
from pathlib import Path

from sweep.errors import StoreError
from sweep.messages import byte_count, duration
from sweep.plan.experiment import Pipeline
from sweep.plan.schema import variables_of
from sweep.store.locations import is_remote

MAX_S = 86_400.0
"""Seconds from which on a run has to be confirmed."""


@dataclass(frozen=True, slots=True)
class Demand:
    """What the rest of a run would take.

    Attributes
    ----------
    seconds, workers
        Time, with so many workers.
    bytes
        What it writes, before compression.
    files
        How many files it makes.
    """

    seconds: float
    workers: int
    bytes: int
    files: int


@dataclass(frozen=True, slots=True)
class FreeDisk:
    """What is free on a disk; ``files`` is None where their number is not limited."""

    bytes: int
    files: int | None


def files_of(pipeline: Pipeline, blocks: int, share: float = 1.0) -> int:
    """Return how many files some blocks make: a chunk of each variable, and the receipt.

    Those of which nothing is needed, all but a ``share``, have no chunks but those of flags.
    """
    variables = variables_of(pipeline)
    flags = sum(variable.flags is not None for variable in variables)
    return blocks * (flags + 1) + math.ceil(share * blocks) * (len(variables) - flags)


def free_disk(url: str) -> FreeDisk | None:
    """Return what is free on the disk of a local store; None if that is not known."""
    if is_remote(url):
        return None
    path = Path(url).absolute()
    with contextlib.suppress(OSError):
        folder = next(each for each in (path, *path.parents) if each.exists())
        state = os.statvfs(folder)
        return FreeDisk(
            state.f_bavail * state.f_frsize, state.f_favail if state.f_files else None
        )
    return None


def objections(demand: Demand, free: FreeDisk | None) -> list[str]:
    """Return why a run has to be confirmed; nothing if it need not be.

    Examples
    --------
    >>> objections(Demand(3e5, 2, 10**13, 9), FreeDisk(10**12, None))
    ['takes about 3.5 days with 2 workers', 'writes 10 TB before compression, and 1 TB are free']
    >>> objections(Demand(60, 2, 10**9, 9), FreeDisk(10**12, None))
    []
    """
    found = []
    if demand.seconds > MAX_S:
        workers = f"{demand.workers} worker{'s' if demand.workers > 1 else ''}"
        found.append(f"takes about {duration(demand.seconds)} with {workers}")
    if free is not None and demand.bytes > free.bytes:
        found.append(
            f"writes {byte_count(demand.bytes)} before compression, and {byte_count(free.bytes)} "
            "are free"
        )
    if free is not None and free.files is not None and demand.files > free.files:
        found.append(f"makes {demand.files:,} files, and the disk has room for {free.files:,}")
    return found


def check_affordable(url: str, demand: Demand) -> None:
    """Raise StoreError if a run into a store has to be confirmed."""
    found = objections(demand, free_disk(url))
    if found:
        raise StoreError(
            f"{url}: the run {' and '.join(found)}; make it smaller, or confirm it with "
            "`--yes` (in Python, yes=True)"
        )
