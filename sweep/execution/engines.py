"""Where blocks are computed: in flight on a cluster, or in one child process."""

from __future__ import annotations

import contextlib
import time
import uuid
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import Empty, SimpleQueue
from typing import Any
from urllib.parse import urlsplit

from distributed import Client, Future, KilledWorker

from sweep.errors import MachineFaultError, RunError, StoreReplacedError, SweepError
from sweep.evaluation.machine_faults import machine_fault, machine_faults_raised
from sweep.execution.block_task import compute_block, compute_blocks
from sweep.execution.cluster import (
    thread_count,
    thread_counts,
    worker_deaths,
    worker_states,
    worker_that_failed,
)
from sweep.execution.limits import (
    BLOCKS_PER_THREAD,
    FAULT_WINDOW,
    MAX_ATTEMPTS,
    MAX_BLOCK_SHARE,
    MAX_DEATHS,
    MAX_WORKER_DEATHS,
    MAX_WORKER_FAULTS,
    NO_WORKERS_TIMEOUT_S,
    SMALL_RUN_LIMIT_S,
    STALL_S,
    STATES_INTERVAL_S,
    THREAD_COUNT_INTERVAL_S,
    THREAD_COUNT_TIMEOUT_S,
    TIME_LIMIT_S,
)
from sweep.execution.progress import Tally, Waiting, Work, in_any_order
from sweep.isolation.child_process import (
    POLL_S,
    Child,
    ChildDiedError,
    ChildRaisedError,
    Interrupts,
    last_line,
)
from sweep.isolation.machine import deaths_reason, explained, memory_kills, memory_ran_out
from sweep.messages import notice
from sweep.store.blocks import RunStore
from sweep.store.receipt import Receipt

# --------------------------------------------------------------------------------------------------
# Runs in which no block is finished for long: the reason is said, or ends the run.

class StallWatch:
    """Watches for a run in which nothing is finished.

    A line says why after :data:`~sweep.execution.limits.STALL_S`, and again after twice that time,
    four times, and so on. The run ends if it would never go on: if all workers are paused for so
    long, or die again and again.

    Parameters
    ----------
    client
        The cluster's client.
    time_limit_s
        Block timeout in seconds, for the line.
    """

    def __init__(self, client: Client, time_limit_s: float) -> None:
        self._client = client
        self._time_limit_s = time_limit_s
        self._kills = memory_kills()
        self.finished()

    def finished(self) -> None:
        """Note that a block was finished."""
        self._since = self._asked = time.monotonic()
        self._paused_since: float | None = None
        self._deaths_before: int | None = None
        self._dying = False
        self._next_line_s = STALL_S

    def check(self, blocks: int) -> None:
        """Say why nothing is finished, if that has lasted; called often while ``blocks`` are out.

        Raises
        ------
        RunError
            If for :data:`~sweep.execution.limits.STALL_S` all workers have been paused, or each
            died :data:`~sweep.execution.limits.MAX_WORKER_DEATHS` times on average.
        """
        now = time.monotonic()
        if now < self._asked + STATES_INTERVAL_S:
            return
        self._asked = now
        silent_s = now - self._since
        reason = self._reason(blocks, now)
        paused = self._paused_since is not None and now >= self._paused_since + STALL_S
        if paused or (self._dying and silent_s >= STALL_S):
            raise RunError(f"no block was finished for {silent_s:.0f} s: {reason}")
        if silent_s >= self._next_line_s and reason:
            self._next_line_s *= 2
            notice(f"no block was finished for {silent_s:.0f} s: {reason}")

    def _reason(self, blocks: int, now: float) -> str:
        """Return what is wrong, empty if nothing is; note what may end the run."""
        try:
            states = worker_states(self._client, THREAD_COUNT_TIMEOUT_S)
            deaths = worker_deaths(self._client, THREAD_COUNT_TIMEOUT_S)
        except (OSError, TimeoutError):
            return "the scheduler does not answer"
        if self._deaths_before is None:
            self._deaths_before = deaths
        deaths -= self._deaths_before
        self._dying = deaths >= MAX_WORKER_DEATHS * max(len(states), 1)
        if deaths:
            return f"workers died {deaths} times meanwhile; {deaths_reason(self._kills)}"
        if not states:
            return "there are no workers; start some"
        paused = sum(status == "paused" for status in states.values())
        if paused < len(states):
            self._paused_since = None
        elif self._paused_since is None:
            self._paused_since = now
        if paused:
            return (
                f"{paused} of {len(states)} workers are paused by Dask, because they use most of "
                "the memory that they may; give them more (`dask worker --memory-limit`), or set "
                "distributed.worker.memory.pause to false in Dask's configuration there"
            )
        if now < self._since + MAX_BLOCK_SHARE * self._time_limit_s:
            return ""  # a block may well take as long
        line = (
            f"{blocks} blocks are with {len(states)} workers, which compute; a block ends after "
            f"at most {self._time_limit_s:.0f} s (time limit)"
        )
        if now > self._since + self._time_limit_s:
            line += ": they hang, or do other work first; their logs may tell"
        return line


# --------------------------------------------------------------------------------------------------
# Blocks that failed by faults of machines: which workers compute them, and who is retired.

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


# --------------------------------------------------------------------------------------------------
# Which blocks are in flight: how many at a time, which is submitted next, which again.
#
# A bounded window of blocks is on the cluster at a time, so that the memory of client and
# scheduler does not grow with the grid. Workers write the blocks; the client receives and counts
# receipts.

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
        beside = self._sources, self._time_limit_s, tally.quota()
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


# --------------------------------------------------------------------------------------------------
# Small runs: blocks are computed one after another in the child process that measured scenes.
#
# A cluster takes seconds to start and to end, and as many processors as it has workers to import
# the packages. The guarantees are those of a cluster: a block that ends its process is computed
# in isolation when it is begun again, and a block is committed by its receipt.

class BlocksInChild:
    """Computes blocks of a store in a child process.

    Parameters
    ----------
    store
        A store of which this process holds the lock.
    child
        The child process; another is started in its place if it ends.
    url
        The store's absolute address.
    sources
        Addresses of the stores whose finished cells are reused.
    time_limit_s
        Block timeout in seconds.
    interrupts
        Entered; checked while a block is computed.
    """

    def __init__(
        self, store: RunStore, child: Child, url: str, sources: Sequence[str] = (),
        time_limit_s: float = TIME_LIMIT_S, *, interrupts: Interrupts,
    ) -> None:
        self._store = store
        self._child = child
        self._url = url
        self._sources = sources
        self._time_limit_s = time_limit_s
        self._interrupts = interrupts

    def compute(self, waiting: Iterable[int] | Waiting, tally: Tally) -> None:
        """Compute the blocks that wait for at most :data:`SMALL_RUN_LIMIT_S` seconds.

        ``waiting`` keeps those that were not begun; numbers are in any order.

        Raises
        ------
        RunError
            If blocks failed, or this machine cannot start processes.
        StoreReplacedError
            If the store was moved, deleted or replaced.
        """
        waiting = in_any_order(waiting)
        deadline = time.monotonic() + SMALL_RUN_LIMIT_S
        with machine_faults_raised(), ThreadPoolExecutor(1) as thread:
            try:
                while (work := waiting.next()) is not None:
                    self._compute_work(thread, work, waiting, tally)
                    if tally.hopeless or time.monotonic() > deadline:
                        break
            except BaseException:
                self._child.close()  # the thread waits for its answer
                raise
        tally.check()

    def _compute_work(
        self, thread: ThreadPoolExecutor, work: Work, waiting: Waiting, tally: Tally
    ) -> None:
        blocks = [self._store.blocks[number] for number in work.numbers]
        block, task = blocks[0], compute_block if work.decision is None else compute_blocks
        what = (block,) if work.decision is None else (blocks, work.decision)
        faults, kills = 0, memory_kills()
        for _ in range(1 + MAX_DEATHS):
            call = thread.submit(
                self._child.call, task, self._url, self._store.run_id, *what, self._sources,
                self._time_limit_s, tally.quota(),
                # The block keeps its own time limit; this one is for what surrounds it.
                limit_s=2 * self._time_limit_s,
            )
            try:
                done: Receipt | list[Receipt] = self._interrupts.await_result(call)
            except StoreReplacedError:
                raise
            except ChildDiedError as error:
                fault = error.from_outside
                reason = f"its process ended: {explained(error, kills)}"
                self._child.restart()
                continue
            except MachineFaultError as error:
                fault, reason = True, str(error)
                faults += 1
                if faults == 1:  # once more, in another process
                    self._child.restart()
                    continue
            except ChildRaisedError as error:
                fault, reason = False, last_line(error)
            except SweepError as error:
                fault, reason = False, f"{type(error).__name__}: {error}"
            else:
                found = [done] if isinstance(done, Receipt) else done
                for number, receipt in zip(work.numbers, found, strict=True):
                    waiting.committed(number, receipt)
                    tally.add(receipt)
                return
            break
        tally.add_failed(f"block {block}: {reason}", machine_fault=fault)
