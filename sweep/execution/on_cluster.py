"""Blocks on a Dask cluster: how many are out, which worker computes which, and when to give up."""

from __future__ import annotations

import contextlib
import time
import uuid
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

from distributed import Client, Future, KilledWorker

from sweep.errors import MachineFaultError, RunError, StoreReplacedError
from sweep.evaluation.machine_faults import machine_fault
from sweep.execution.block_task import compute_blocks
from sweep.execution.cluster import WorkerState, worker_states, worker_that_failed
from sweep.execution.engines import Again, Engine, Failed
from sweep.execution.limits import (
    BLOCKS_PER_THREAD,
    FAULT_WINDOW,
    MAX_ATTEMPTS,
    MAX_DEATHS,
    MAX_WORKER_FAULTS,
    NO_WORKERS_TIMEOUT_S,
    STALL_S,
    THREAD_COUNT_INTERVAL_S,
    THREAD_COUNT_TIMEOUT_S,
    TIME_LIMIT_S,
)
from sweep.execution.progress import Work
from sweep.isolation.machine import ADVICE
from sweep.messages import notice
from sweep.store.blocks import RunStore
from sweep.store.receipt import Receipt

UNKNOWN = "unknown"
"""In place of the address of a worker that the scheduler does not tell."""


class OnCluster(Engine[Future[Any]]):
    """Computes blocks on a cluster.

    A block whose worker dies, or whose worker's machine is at fault, is given to others. A worker
    that often fails what others compute is retired.

    Parameters
    ----------
    client
        The cluster's client.
    """

    def __init__(
        self, store: RunStore, client: Client, sources: Sequence[str] = (),
        time_limit_s: float = TIME_LIMIT_S,
    ) -> None:
        super().__init__(store, sources, time_limit_s)
        self._client = client
        self._deaths: Counter[int] = Counter()
        self._faults = WorkerFaults(client)
        self._states: dict[str, WorkerState] = {}
        self._asked = 0.0
        self._usable = self._last_block = time.monotonic()
        self._next_line_s = STALL_S

    def room(self) -> int:
        """Return a few blocks for each thread of the cluster, which may grow and shrink.

        Raises
        ------
        RunError
            If the scheduler went away, or no worker has computed or could compute for a minute.
        """
        now = time.monotonic()
        if now > self._asked + THREAD_COUNT_INTERVAL_S:
            try:
                self._states = worker_states(self._client, THREAD_COUNT_TIMEOUT_S)
            except TimeoutError:
                pass  # it is busy
            except OSError:
                raise RunError("the scheduler went away") from None
            self._asked = now
            if any(state.status != "paused" for state in self._states.values()):
                self._usable = now
        if now > self._usable + NO_WORKERS_TIMEOUT_S:
            paused = f": {self._workers()}" if self._states else "; start some"
            raise RunError(f"there have been no workers for {NO_WORKERS_TIMEOUT_S:.0f} s{paused}")
        return BLOCKS_PER_THREAD * max(sum(each.threads for each in self._states.values()), 1)

    def check(self) -> None:
        """Say once in a while that no block is finished, and what the workers do."""
        self.room()
        silent_s = time.monotonic() - self._last_block
        if silent_s >= self._next_line_s:
            self._next_line_s *= 2
            notice(
                f"no block was finished for {silent_s:.0f} s: {len(self.out)} are with "
                f"{self._workers()}; a block ends after at most {self.time_limit_s:.0f} s"
            )

    def _workers(self) -> str:
        """Return how many workers there are, and how many of them Dask has paused."""
        paused = sum(state.status == "paused" for state in self._states.values())
        line = f"{len(self._states)} workers"
        return line if not paused else (
            f"{line}, {paused} of them paused by Dask because of their memory "
            "(`dask worker --memory-limit`)")

    def submit(self, arguments: tuple[Any, ...], others: Sequence[str]) -> Future[Any]:
        """Give blocks to the cluster: to one of ``others``, unless they leave meanwhile."""
        (block, *_) = arguments[2]
        future = self._client.submit(
            compute_blocks, *arguments, pure=False, key=f"block-{block}-{uuid.uuid4().hex[:8]}",
            workers=list(others) or None, allow_other_workers=bool(others),
        )
        future.add_done_callback(self.finished.put)
        return future

    def result(self, done: Future[Any], work: Work) -> list[Receipt] | Failed | Again:
        """Return the receipts; what died, or a machine failed, is given to other workers."""
        number = work.numbers[0]
        try:
            if done.status == "finished":
                self._last_block, self._next_line_s = time.monotonic(), STALL_S
                self._faults.computed(number, len(self._states.keys() - self._faults.retired))
                try:
                    receipts: list[Receipt] = done.result()
                except OSError:  # they come through the scheduler
                    raise RunError("the scheduler went away") from None
                return receipts
            # "lost": the worker died after it committed the block, and its receipt died with it.
            lost = done.status == "lost" and self._client.status == "running"
            if not lost and done.status in ("cancelled", "lost"):
                raise RunError("the scheduler went away")
            error = None if lost else done.exception()
            if isinstance(error, StoreReplacedError):
                raise error
            if lost or isinstance(error, KilledWorker):
                # A block that ends its process is computed in isolation when it is begun again,
                # but it may have been queued behind one, or its workers were killed from outside.
                self._deaths[number] += 1
                if self._deaths[number] <= MAX_DEATHS:
                    return Again()
                return Failed(
                    "its workers died again and again; their logs may tell why; if memory ran out, "
                    f"{ADVICE}", machine_fault=True)
            fault = None if error is None else machine_fault(error)
            if fault is None:
                return Failed(f"{type(error).__name__}: {error}")
            others = self._faults.others(number, str(done.key), fault)
            return Again(others) if others else Failed(str(fault), machine_fault=True)
        finally:
            done.release()

    def end(self) -> None:
        """Take back what is still out; a caller's cluster outlives the run."""
        if self.out and self._client.status == "running":
            with contextlib.suppress(OSError, TimeoutError):
                self._client.cancel(list(self.out))
        self.out.clear()


class WorkerFaults:
    """Counts faults of machines by worker: those that fail what others compute are retired.

    :data:`~sweep.execution.limits.MAX_WORKER_FAULTS` are too many, while each worker computes about
    :data:`~sweep.execution.limits.FAULT_WINDOW` blocks. The last worker stays. ``retired`` are the
    addresses of those that went; the scheduler may list them for a while.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._failed_on: defaultdict[int, list[str]] = defaultdict(list)
        self._blamed: Counter[str] = Counter()
        self._computed = 0
        self._last: dict[str, MachineFaultError] = {}
        self.retired: set[str] = set()

    def others(self, number: int, key: str, fault: MachineFaultError) -> list[str]:
        """Note that a block failed; return the workers that may compute it, empty if none is left.

        Workers of machines that did not fail it come before others.
        """
        worker = worker_that_failed(self._client, key) or UNKNOWN
        failed_on = self._failed_on[number]
        failed_on.append(worker)
        self._last[worker] = fault
        try:
            workers = worker_states(self._client, THREAD_COUNT_TIMEOUT_S)
        except (OSError, TimeoutError):
            return []
        machines = {_machine(failed) for failed in failed_on}
        left = [each for each in workers if each not in failed_on]
        if len(failed_on) >= MAX_ATTEMPTS:
            return []
        return [each for each in left if _machine(each) not in machines] or left

    def computed(self, number: int, workers: int) -> None:
        """Note that a block was computed by one of so many workers; retire those that failed it."""
        self._computed += 1
        if self._computed % (FAULT_WINDOW * max(workers, 1)) == 0:
            self._blamed.clear()
        for worker in set(self._failed_on.pop(number, ())) - {UNKNOWN} - self.retired:
            self._blamed[worker] += 1
            if self._blamed[worker] >= MAX_WORKER_FAULTS and workers > 1:
                del self._blamed[worker]
                self._retire(worker)
                return

    def _retire(self, worker: str) -> None:
        self.retired.add(worker)
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
