"""Blocks on a Dask cluster: how many are out, which worker computes which, and when to give up."""

from __future__ import annotations

import contextlib
import time
import uuid
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

from distributed import Client, Future, KilledWorker

from sweep.errors import MachineFaultError, RunError
from sweep.evaluation.machine_faults import local_fault, raise_machine_fault
from sweep.execution.block_task import compute_blocks
from sweep.execution.cluster import WorkerState, worker_states, worker_that_failed
from sweep.execution.engines import Again, Engine
from sweep.execution.limits import (
    BLOCKS_PER_THREAD,
    FAULT_WINDOW,
    MAX_ATTEMPTS,
    MAX_DEATHS,
    MAX_WORKER_FAULTS,
    NO_WORKERS_TIMEOUT_S,
    STALL_S,
    THREAD_COUNT_INTERVAL_S,
    TIME_LIMIT_S,
)
from sweep.execution.progress import Work
from sweep.isolation.machine import ADVICE
from sweep.messages import notice
from sweep.store.blocks import RunStore
from sweep.store.receipt import Receipt


class OnCluster(Engine[Future[Any]]):
    """Computes blocks on a cluster.

    A block whose worker dies, or whose worker's machine is at fault, is given to others. A worker
    that fails :data:`~sweep.execution.limits.MAX_WORKER_FAULTS` blocks which others compute is
    retired; the last one stays.

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
        self._failed_on: defaultdict[int, list[str]] = defaultdict(list)
        self._faults: dict[str, MachineFaultError] = {}
        self._blamed: Counter[str] = Counter()
        self._retired: set[str] = set()
        self._computed = 0
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
            states = worker_states(self._client)
            self._states = self._states if states is None else states
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

    def result(self, done: Future[Any], work: Work) -> list[Receipt] | Again:
        """Return the receipts; what died, or a machine failed, is given to other workers."""
        number = work.numbers[0]
        try:
            if done.status == "finished":
                self._last_block, self._next_line_s = time.monotonic(), STALL_S
                try:
                    receipts: list[Receipt] = done.result()
                except OSError:  # they come through the scheduler
                    raise RunError("the scheduler went away") from None
                self._blame(number)
                return receipts
            # "lost": the worker died after it committed the block, and its receipt died with it.
            lost = done.status == "lost" and self._client.status == "running"
            if not lost and done.status in ("cancelled", "lost"):
                raise RunError("the scheduler went away")
            error = None if lost else done.exception()
            if error is not None and not isinstance(error, KilledWorker):
                try:
                    raise_machine_fault(error)
                except MachineFaultError as fault:
                    return self._elsewhere(number, str(done.key), fault)
                raise error
            # A block that ends its process is computed in isolation when it is begun again,
            # but it may have been queued behind one, or its workers were killed from outside.
            self._deaths[number] += 1
            if self._deaths[number] > MAX_DEATHS:
                raise local_fault(
                    "its workers died again and again; their logs may tell why; if memory ran out, "
                    f"{ADVICE}")
            return Again()
        finally:
            done.release()

    def _elsewhere(self, number: int, key: str, fault: MachineFaultError) -> Again:
        """Give a block to a worker that did not fail it; raise the fault if none is left."""
        worker = worker_that_failed(self._client, key)
        self._failed_on[number].append(worker)
        self._faults[worker] = fault
        others = [each for each in worker_states(self._client) or {}
                  if each not in self._failed_on[number]]
        if not others or len(self._failed_on[number]) >= MAX_ATTEMPTS:
            raise fault
        # Those that failed no block come first.
        return Again([each for each in others if each not in self._faults] or others)

    def _blame(self, number: int) -> None:
        """Blame the workers that failed a block which another one computed; retire them."""
        self._computed += 1
        if self._computed % (FAULT_WINDOW * max(len(self._states), 1)) == 0:
            self._blamed.clear()
        for worker in set(self._failed_on.pop(number, ())) - self._retired - {""}:
            self._blamed[worker] += 1
            left = self._states.keys() - self._retired
            if self._blamed[worker] >= MAX_WORKER_FAULTS and len(left) > 1:
                self._retired.add(worker)
                fault = self._faults[worker]
                notice(
                    f"worker {worker} on {fault.machine} is used no more: {MAX_WORKER_FAULTS} "
                    f"blocks that it failed were computed by others; the last fault: {fault.fault}"
                )
                with contextlib.suppress(OSError, TimeoutError):
                    self._client.retire_workers([worker], close_workers=True)

    def end(self) -> None:
        """Take back what is still out; a caller's cluster outlives the run."""
        if self.out and self._client.status == "running":
            with contextlib.suppress(OSError, TimeoutError):
                self._client.cancel(list(self.out))
        self.out.clear()
