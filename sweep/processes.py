"""Child processes: started on one thread each, and how they ended."""

from __future__ import annotations

import contextlib
import signal

SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}
"""Variables of a child process. Parallelism is over blocks: a process computes on one thread."""

OUTSIDE_SIGNALS = ("SIGKILL", "SIGTERM", "SIGBUS", "SIGHUP", "SIGINT", "SIGXCPU")
"""Signals that the system or its users send, too little memory or space among their reasons: what
a scene's data may cause is SIGSEGV, SIGABRT, SIGFPE, SIGILL, an exit status."""


def ending(code: int) -> str:
    """Return how a process with a return code of `subprocess` ended.

    >>> ending(-11), ending(3)
    ('SIGSEGV', 'exit status 3')
    """
    if code < 0:
        with contextlib.suppress(ValueError):
            return signal.Signals(-code).name
    return f"exit status {code}"
