"""Limits of the machine: processors and memory."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def default_workers() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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
