"""Limits of the machine: processors, memory, and control groups."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


def default_workers() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


# --------------------------------------------------------------------------------------------------
# What Linux says of the control groups of this process, which limit processes and threads.

MOUNT = Path("/sys/fs/cgroup")


def control_groups(controller: str) -> Iterator[Path]:
    """Yield the folder of this process's group, and of those around it; none without such groups.

    In a container, its own group may be seen as the root. A controller is "pids", for instance.
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
# Memory: what a death may mean, and who dies first.

ADVICE = "use fewer workers, or give them more memory"


def explained(death: object) -> str:
    """Return how a child process ended; of SIGKILL, what that may mean.

    >>> explained("SIGKILL")
    'SIGKILL, as where memory runs out: use fewer workers, or give them more memory'
    """
    return f"SIGKILL, as where memory runs out: {ADVICE}" if str(death) == "SIGKILL" else str(death)


def be_killed_before_others(score: int) -> None:
    """Ask the system to kill this process before others if memory runs out.

    Parameters
    ----------
    score
        0 to 1000; that of most processes is 0.
    """
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(score))
