"""Limits of the machine: processors, memory, and control groups."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Iterator
from pathlib import Path


def default_workers() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# --------------------------------------------------------------------------------------------------
# What Linux says of the control groups of this process, which limit memory, processes, threads.

MOUNT = Path("/sys/fs/cgroup")


def control_groups(controller: str) -> Iterator[Path]:
    """Yield the folder of this process's group, and of those around it; none without such groups.

    In a container, its own group may be seen as the root.

    Parameters
    ----------
    controller
        "memory" or "pids".
    """
    for line in text_of(Path("/proc/self/cgroup")).splitlines():
        _, controllers, path = (line + "::").split(":")[:3]
        if controllers == "":
            top = MOUNT
        elif controller in controllers.split(","):
            top = MOUNT / controller
        else:
            continue
        group = top / path.strip("/")
        yield group
        yield from (folder for folder in group.parents if folder.is_relative_to(top))


def number_in(path: Path) -> int | None:
    """Return the number that a file holds; None if it holds none, such as "max"."""
    text = text_of(path).strip()
    return int(text) if text.isdecimal() else None


def text_of(path: Path) -> str:
    """Return a file's text, empty if it cannot be read."""
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError):
        return ""


# --------------------------------------------------------------------------------------------------
# The memory that this machine grants, and whether processes were killed because it ran out.

ADVICE = "use fewer workers, or give them more memory"


def memory_kills() -> int | None:
    """Return how many processes the system has killed because memory ran out; None if unknown.

    Those of this process's control group, or of the whole machine where that does not tell.
    """
    counters = [
        folder / name for folder in control_groups("memory")
        for name in ("memory.events", "memory.oom_control")
    ]
    for path in (*counters, Path("/proc/vmstat")):
        for line in text_of(path).splitlines():
            name, _, count = line.partition(" ")
            if name == "oom_kill" and count.isdecimal():
                return int(count)
    return None


def memory_limit_bytes() -> int:
    """Return the memory that all processes here may use together: a container's, or all."""
    limits = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]
    for folder in control_groups("memory"):
        files = (folder / "memory.max", folder / "memory.limit_in_bytes")
        limits += [limit for file in files if (limit := number_in(file)) is not None]
    return min(limits)


def memory_ran_out(kills_before: int | None) -> bool:
    """Return whether processes were killed since :func:`memory_kills` returned ``kills_before``."""
    kills = memory_kills()
    return kills is not None and kills_before is not None and kills > kills_before


def explained(death: object, kills_before: int | None) -> str:
    """Return how a child process ended; of SIGKILL, why, and what to do.

    Parameters
    ----------
    death
        How it ended, such as "SIGKILL".
    kills_before
        What :func:`memory_kills` returned when it was started.
    """
    if str(death) != "SIGKILL":
        return str(death)
    why = "because memory ran out" if memory_ran_out(kills_before) else "as where memory runs out"
    used = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    return (
        f"SIGKILL, {why} (limit {memory_limit_bytes() / 1e6:,.0f} MB; a process used up to "
        f"{used / 1e6:,.0f} MB): {ADVICE}"
    )


def deaths_reason(kills_before: int | None) -> str:
    """Return why workers died, as far as this machine can tell, and what to do."""
    if memory_ran_out(kills_before):
        return f"SIGKILL, because memory ran out ({memory_limit_bytes() / 1e6:,.0f} MB): {ADVICE}"
    return f"if by SIGKILL, as where memory runs out, {ADVICE}; their logs may tell"


def be_killed_before_others(score: int) -> None:
    """Ask the system to kill this process before others if memory runs out.

    Parameters
    ----------
    score
        0 to 1000; that of most processes is 0.
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(score))
