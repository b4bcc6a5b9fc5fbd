"""Which blocks are in flight: how many at a time, which is submitted next, which again.

A bounded window of blocks is on the cluster at a time, so that the memory of client and scheduler
does not grow with the grid. Workers write the blocks; the client receives and counts receipts.
"""

from __future__ import annotations

import contextlib
import itertools
import time
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from queue import Empty, SimpleQueue
from typing import Any

from distributed import Client, Future, KilledWorker

from sweep.errors import RunError, StoreReplacedError
from sweep.evaluation.machine_faults import machine_fault
from sweep.execution.block_task import compute_block
from sweep.execution.cluster import thread_count
from sweep.execution.distributed_internals import worker_deaths
from sweep.execution.limits import (
    BLOCKS_PER_THREAD,
    MAX_DEATHS,
    NO_WORKERS_TIMEOUT_S,
    THREAD_COUNT_INTERVAL_S,
    THREAD_COUNT_TIMEOUT_S,
    TIME_LIMIT_S,
)
from sweep.execution.stall import StallWatch
from sweep.execution.tally import Tally
from sweep.execution.worker_faults import WorkerFaults
from sweep.isolation.interrupts import POLL_S, Interrupts
from sweep.isolation.machine_memory import deaths_reason, memory_kills, memory_ran_out
from sweep.store.run_store import RunStore


class InFlightLimit:
    """How many blocks may be in flight: grows and shrinks with the cluster."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._asked = 0.0
        self._blocks = BLOCKS_PER_THREAD
        self._last_worker = time.monotonic()
        self._kills = memory_kills()

    def blocks(self) -> int:
        """Return the number of blocks that may be in flight now.

        Raises
        ------
        RunError
            If the scheduler went away, or there have been no workers for a minute.
        """
        if time.monotonic() > self._asked + THREAD_COUNT_INTERVAL_S:
            threads = thread_count(self._client)
            self._asked = time.monotonic()
            if threads:
                self._blocks, self._last_worker = BLOCKS_PER_THREAD * threads, self._asked
        if time.monotonic() > self._last_worker + NO_WORKERS_TIMEOUT_S:
            raise RunError(
                f"there have been no workers for {NO_WORKERS_TIMEOUT_S:.0f} s{self._reason()}"
            )
        return self._blocks

    def _reason(self) -> str:
        """Return why there are no workers, as far as that is known, and what to do."""
        died = 0
        with contextlib.suppress(OSError, TimeoutError):
            died = worker_deaths(self._client, THREAD_COUNT_TIMEOUT_S)
        if died or memory_ran_out(self._kills):
            return f": they died; {deaths_reason(self._kills)}"
        return "; start some"


class BlocksInFlight:
    """Submits blocks of a store to a cluster and collects their receipts.

    Parameters
    ----------
    store
        A store of which this process holds the lock.
    client
        The cluster's client.
    url
        The store's address as every worker understands it.
    sources
        Addresses of the stores whose finished cells are reused.
    time_limit_s
        Block timeout in seconds.
    interrupts
        Entered; checked between blocks.
    """

    def __init__(
        self, store: RunStore, client: Client, url: str, sources: Sequence[str] = (),
        time_limit_s: float = TIME_LIMIT_S, *, interrupts: Interrupts,
    ) -> None:
        self._store = store
        self._client = client
        self._url = url
        self._sources = sources
        self._time_limit_s = time_limit_s
        self._interrupts = interrupts
        self._finished: SimpleQueue[Future[Any]] = SimpleQueue()
        self._numbers: dict[Future[Any], int] = {}
        self._deaths: Counter[int] = Counter()
        self._worker_faults = WorkerFaults(client)
        self._kills = memory_kills()

    def compute(self, numbers: Iterable[int], tally: Tally) -> None:
        """Compute blocks by their numbers, and count them.

        Raises
        ------
        RunError
            If blocks failed, the scheduler went away, or there are no workers.
        StoreReplacedError
            If the store was moved, deleted or replaced.
        """
        try:
            self._compute(iter(numbers), tally)
        finally:
            self._cancel()
        tally.check()

    def _compute(self, waiting: Iterator[int], tally: Tally) -> None:
        limit = InFlightLimit(self._client)
        watch = StallWatch(self._client, self._time_limit_s)
        for number in itertools.islice(waiting, limit.blocks()):
            self._submit(number, tally)
        while self._numbers:
            self._interrupts.check()
            most = limit.blocks()
            try:
                future = self._finished.get(timeout=POLL_S)
            except Empty:
                watch.check(len(self._numbers))
                continue
            watch.finished()
            number = self._numbers.pop(future)
            if future.status == "finished":
                tally.add(future.result())
                self._worker_faults.computed(number)
            else:
                self._note_failure(number, future, tally)
            future.release()
            if not tally.hopeless:
                for following in itertools.islice(waiting, max(most - len(self._numbers), 0)):
                    self._submit(following, tally)

    def _submit(
        self, number: int, tally: Tally, workers: Sequence[str] | None = None
    ) -> None:
        """Give a block to the cluster: to one of ``workers``, unless they leave meanwhile."""
        block = self._store.blocks[number]
        future = self._client.submit(
            compute_block, self._url, self._store.run_id, block, self._sources,
            self._time_limit_s, tally.quota(), self._store.durable, pure=False,
            key=f"block-{block}-{uuid.uuid4().hex[:8]}",
            workers=workers, allow_other_workers=workers is not None,
        )
        self._numbers[future] = number
        future.add_done_callback(self._finished.put)

    def _note_failure(self, number: int, future: Future[Any], tally: Tally) -> None:
        """Submit a block again that may still be computed; else note why it failed."""
        # "lost": the worker died after it committed the block, and its receipt died with it.
        lost = future.status == "lost" and self._client.status == "running"
        if not lost and future.status in ("cancelled", "lost"):
            raise RunError("the scheduler went away")
        error = None if lost else future.exception()
        if isinstance(error, StoreReplacedError):
            raise error
        killed = lost or isinstance(error, KilledWorker)
        if killed and self._deaths[number] < MAX_DEATHS:
            # A block that ends its process is computed in isolation when it is begun again, but
            # it may have been queued behind one, or its workers were killed from outside.
            self._deaths[number] += 1
            self._submit(number, tally)
            return
        block = self._store.blocks[number]
        fault = None if error is None else machine_fault(error)
        if fault is None:
            reason = (
                f"its workers died again and again; {deaths_reason(self._kills)}" if killed
                else f"{type(error).__name__}: {error}"
            )
            tally.add_failed(f"block {block}: {reason}", machine_fault=killed)
            return
        others = self._worker_faults.others(number, str(future.key), fault)
        if others:
            self._submit(number, tally, others)
        else:
            tally.add_failed(f"block {block}: {fault}", machine_fault=True)

    def _cancel(self) -> None:
        """Take back what is still in flight; a caller's cluster outlives the run."""
        if self._numbers and self._client.status == "running":
            with contextlib.suppress(OSError, TimeoutError):
                self._client.cancel(list(self._numbers))
        self._numbers.clear()
