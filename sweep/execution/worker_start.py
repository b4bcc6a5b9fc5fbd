"""What an embedded cluster's workers run when they start, as a "preload" of Dask."""

from __future__ import annotations

from sweep.isolation.machine_memory import be_killed_before_others

SCORE = 500
"""The client, whose process is the scheduler's, too, has 0; a child of a worker has 1,000."""


def dask_setup(worker: object) -> None:  # noqa: ARG001  (Dask's name and arguments)
    """Have a worker killed rather than the client if memory runs out."""
    be_killed_before_others(SCORE)
