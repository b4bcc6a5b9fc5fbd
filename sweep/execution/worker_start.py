"""What an embedded cluster's workers run when they start, as a "preload" of Dask."""

from __future__ import annotations

import signal

from sweep.isolation.interrupts import in_main_thread
from sweep.isolation.machine_memory import be_killed_before_others

SCORE = 500
"""The client, whose process is the scheduler's, too, has 0; a child of a worker has 1,000."""


def dask_setup(worker: object) -> None:  # noqa: ARG001  (Dask's name and arguments)
    """Have a worker killed rather than the client if memory runs out, and ignore Ctrl-C.

    That is the client's to act on. A worker that is started in the place of another has not
    inherited it.
    """
    be_killed_before_others(SCORE)
    if in_main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
