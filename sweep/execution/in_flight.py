"""Which blocks are in flight: how many at a time, which is submitted next, which again.

A bounded window of blocks is on the cluster at a time, so that the memory of client and scheduler
does not grow with the grid. Workers write the blocks; the client receives and counts receipts.
"""

from __future__ import annotations

import contextlib
import time
import uuid
from collections import Counter
from collections.abc import Iterable, Sequence
from queue import Empty, SimpleQueue
from typing import Any

from distributed import Client, Future, KilledWorker

from sweep.errors import RunError, StoreReplacedError
from sweep.evaluation.machine_faults import machine_fault
from sweep.execution.block_task import compute_block, compute_blocks
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
from sweep.execution.waiting import Waiting, Work, in_any_order
from sweep.execution.worker_faults import WorkerFaults
from sweep.isolation.interrupts import POLL_S, Interrupts
from sweep.isolation.machine_memory import deaths_reason, memory_kills, memory_ran_out
from sweep.store.receipt import Receipt
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
        self._works: dict[Future[Any], Work] = {}
        self._deaths: Counter[int] = Counter()
        self._worker_faults = WorkerFaults(client)
        self._kills = memory_kills()

    def compute(self, waiting: Iterable[int] | Waiting, tally: Tally) -> None:
        """Compute the blocks that wait, and count them; numbers are in any order.

        Raises
        ------
        RunError
            If blocks failed, the scheduler went away, or there are no workers.
        StoreReplacedError
            If the store was moved, deleted or replaced.
        """
        try:
            self._compute(in_any_order(waiting), tally)
        finally:
            self._cancel()
        tally.check()

    def _compute(self, waiting: Waiting, tally: Tally) -> None:
        limit = InFlightLimit(self._client)
        watch = StallWatch(self._client, self._time_limit_s)
        self._fill(waiting, limit.blocks(), tally)
        while self._works:
            self._interrupts.check()
            most = limit.blocks()
            try:
                future = self._finished.get(timeout=POLL_S)
            except Empty:
                watch.check(len(self._works))
                continue
            watch.finished()
            work = self._works.pop(future)
            if future.status == "finished":
                done = future.result()
                found = [done] if isinstance(done, Receipt) else done
                for number, receipt in zip(work.numbers, found, strict=True):
                    waiting.committed(number, receipt)
                    tally.add(receipt)
                self._worker_faults.computed(work.numbers[0])
            else:
                self._note_failure(work, future, tally)
            future.release()
            if not tally.hopeless:
                self._fill(waiting, most, tally)

    def _fill(self, waiting: Waiting, most: int, tally: Tally) -> None:
        """Submit what can be computed now, until so much is in flight."""
        while len(self._works) < most and (work := waiting.next()) is not None:
            self._submit(work, tally)

    def _submit(self, work: Work, tally: Tally, workers: Sequence[str] | None = None) -> None:
        """Give blocks to the cluster: to one of ``workers``, unless they leave meanwhile."""
        blocks = [self._store.blocks[number] for number in work.numbers]
        beside = self._sources, self._time_limit_s, tally.quota(), self._store.durable
        one = work.decision is None
        future = self._client.submit(
            compute_block if one else compute_blocks, self._url, self._store.run_id,
            *([blocks[0]] if one else [blocks, work.decision]), *beside, pure=False,
            key=f"block-{blocks[0]}-{uuid.uuid4().hex[:8]}",
            workers=workers, allow_other_workers=workers is not None,
        )
        self._works[future] = work
        future.add_done_callback(self._finished.put)

    def _note_failure(self, work: Work, future: Future[Any], tally: Tally) -> None:
        """Submit blocks again that may still be computed; else note why they failed."""
        number = work.numbers[0]
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
            self._submit(work, tally)
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
            self._submit(work, tally, others)
        else:
            tally.add_failed(f"block {block}: {fault}", machine_fault=True)

    def _cancel(self) -> None:
        """Take back what is still in flight; a caller's cluster outlives the run."""
        if self._works and self._client.status == "running":
            with contextlib.suppress(OSError, TimeoutError):
                self._client.cancel(list(self._works))
        self._works.clear()
