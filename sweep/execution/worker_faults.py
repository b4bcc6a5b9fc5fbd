"""Blocks that failed by faults of machines: which workers compute them, and who is retired."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from urllib.parse import urlsplit

from distributed import Client

from sweep.errors import MachineFaultError
from sweep.execution.distributed_internals import thread_counts, worker_that_failed
from sweep.execution.limits import (
    FAULT_WINDOW,
    MAX_ATTEMPTS,
    MAX_WORKER_FAULTS,
    THREAD_COUNT_TIMEOUT_S,
)
from sweep.messages import notice

UNKNOWN = ""
"""In place of a worker's address where the scheduler does not tell it."""


class WorkerFaults:
    """The machine faults of a run: of which blocks, on which workers.

    A worker fails a block that another one then computes: so the worker is at fault. After
    :data:`~sweep.execution.limits.MAX_WORKER_FAULTS` of them, while each worker computes about
    :data:`~sweep.execution.limits.FAULT_WINDOW` blocks, it is retired, unless it is the last one.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._failed_on: defaultdict[int, list[str]] = defaultdict(list)
        self._blamed: defaultdict[str, list[int]] = defaultdict(list)
        self._computed = 0
        self._workers = 1
        self._last: dict[str, MachineFaultError] = {}

    def others(self, number: int, key: str, fault: MachineFaultError) -> list[str]:
        """Note that a block failed; return the workers that may compute it, empty if none is left.

        Workers of machines that did not fail it come before others.

        Parameters
        ----------
        number, key
            The block, and the key of its task.
        fault
            What happened.
        """
        worker = worker_that_failed(self._client, key) or UNKNOWN
        failed_on = self._failed_on[number]
        failed_on.append(worker)
        self._last[worker] = fault
        if len(failed_on) >= MAX_ATTEMPTS:
            return []
        try:
            workers = thread_counts(self._client, THREAD_COUNT_TIMEOUT_S)
        except (OSError, TimeoutError):
            return []
        self._workers = len(workers)
        machines = {_machine(failed) for failed in failed_on}
        left = [each for each in workers if each not in failed_on]
        return [each for each in left if _machine(each) not in machines] or left

    def computed(self, number: int) -> None:
        """Note that a block was computed; retire workers that failed too many of these."""
        self._computed += 1
        since = self._computed - FAULT_WINDOW * self._workers
        for worker in set(self._failed_on.pop(number, ())) - {UNKNOWN}:
            recent = [at for at in self._blamed[worker] if at > since] + [self._computed]
            self._blamed[worker] = recent
            if len(recent) >= MAX_WORKER_FAULTS and self._workers > 1:
                self._workers -= 1
                self._blamed[worker] = []
                self._retire(worker)

    def _retire(self, worker: str) -> None:
        fault = self._last[worker]
        notice(
            f"worker {worker} on {fault.machine} is used no more: {MAX_WORKER_FAULTS} blocks that "
            f"it failed were computed by others; the last fault: {fault.fault}"
        )
        with contextlib.suppress(OSError, TimeoutError):
            self._client.retire_workers([worker], close_workers=True)


def _machine(worker: str) -> str:
    """Return the host of a worker's address."""
    return urlsplit(worker).hostname or worker
