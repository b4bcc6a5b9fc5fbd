"""Whether the system allows the threads and processes of a cluster, before it is started.

Workers that cannot start a thread neither compute nor say so.
"""

from __future__ import annotations

import os
import resource
from pathlib import Path

from sweep.errors import RunError
from sweep.isolation.control_groups import control_groups, number_in, text_of

THREADS_PER_WORKER, OTHER_THREADS = 12, 9
"""Threads and processes that are started for a cluster, measured: 12 for each worker, with those
that watch it, and 9 of the client and scheduler."""

PRIVILEGES = 1 << 21 | 1 << 24
"""CAP_SYS_ADMIN and CAP_SYS_RESOURCE: processes that have one are not limited."""


def check_threads(workers: int) -> None:
    """Raise RunError if the system allows fewer threads than the workers need."""
    left, needed = threads_left(), THREADS_PER_WORKER * workers + OTHER_THREADS
    if left is not None and left < needed:
        raise RunError(
            f"{workers} worker processes cannot be started: they need {needed} threads, and the "
            f"system allows {max(left, 0)} more; allow more (ulimit -u, or the container's limit "
            "of processes), or use fewer workers"
        )


def threads_left() -> int | None:
    """Return how many threads and processes may still be started; None if that is not limited."""
    left = [_left_to_user(), *(
        most - (number_in(folder / "pids.current") or 0)
        for folder in control_groups("pids")
        if (most := number_in(folder / "pids.max")) is not None
    )]
    return min((each for each in left if each is not None), default=None)


def _left_to_user() -> int | None:
    most = resource.getrlimit(resource.RLIMIT_NPROC)[0]
    if most == resource.RLIM_INFINITY or os.getuid() == 0:
        return None
    if int(_status(Path("/proc/self")).get("CapEff", "0"), 16) & PRIVILEGES:
        return None
    processes = [_status(path) for path in Path("/proc").glob("[0-9]*")]
    if not processes:
        return None  # another system than Linux
    user = str(os.getuid())
    return most - sum(
        int(process["Threads"]) for process in processes
        if process.get("Uid", "").partition("\t")[0] == user
    )


def _status(process: Path) -> dict[str, str]:
    lines = text_of(process / "status").splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}
