"""Where blocks are computed: one loop over what is out, and children of this process."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from sweep.errors import MachineFaultError, RunError, StoreReplacedError
from sweep.evaluation.machine_faults import exception_line, local_fault, machine_faults_raised
from sweep.execution import BLOCK_TASK
from sweep.execution.block_task import compute_blocks
from sweep.execution.limits import MAX_DEATHS, SMALL_RUN_S, TIME_LIMIT_S
from sweep.execution.progress import AnyOrder, Tally, Waiting, Work
from sweep.isolation.child_process import (
    POLL_S,
    Child,
    ChildDiedError,
    ChildRaisedError,
    Interrupts,
    last_line,
)
from sweep.isolation.machine import explained
from sweep.store.blocks import RunStore
from sweep.store.locations import absolute_url
from sweep.store.receipt import Receipt

# --------------------------------------------------------------------------------------------------
# The loop: blocks are submitted as long as there is room, and receipts are counted.
#
# A bounded number of blocks is out at a time, so that memory does not grow with the grid. Workers
# write the blocks; only receipts come back.

Pending = TypeVar("Pending")
"""What an engine returns for work that it has taken."""


@dataclass(frozen=True, slots=True)
class Again:
    """Work that is begun again, by one of some workers if any are named."""

    workers: Sequence[str] = ()


class Engine(ABC, Generic[Pending]):
    """Computes blocks of a store.

    Parameters
    ----------
    store
        The store.
    sources
        Addresses of the stores whose finished cells are reused.
    time_limit_s
        Block timeout in seconds.
    """

    def __init__(
        self, store: RunStore, sources: Sequence[str] = (), time_limit_s: float = TIME_LIMIT_S
    ) -> None:
        self.store, self.time_limit_s = store, time_limit_s
        self._sources = sources
        self.finished: SimpleQueue[Pending] = SimpleQueue()
        self.out: dict[Pending, Work] = {}

    def run(
        self, waiting: Iterable[int] | Waiting, tally: Tally, interrupts: Interrupts
    ) -> None:
        """Compute the blocks that wait, and count them.

        Parameters
        ----------
        waiting
            Keeps the blocks for which there was no room; numbers are in any order.
        tally
            Counts receipts and failures.
        interrupts
            Entered; checked meanwhile.

        Raises
        ------
        RunError
            If blocks failed, or nothing can be computed any more.
        StoreReplacedError
            If the store was moved, deleted or replaced.
        """
        ready = AnyOrder(waiting) if isinstance(waiting, Iterable) else waiting
        try:
            while self._fill(ready, tally):
                interrupts.check()
                try:
                    done = self.finished.get(timeout=POLL_S)
                except Empty:
                    self.check()
                else:
                    self._note(done, ready, tally)
        finally:
            self.end()
        tally.check()

    def _fill(self, waiting: Waiting, tally: Tally) -> bool:
        """Begin what there is room for; return whether anything is out."""
        while len(self.out) < self.room() and not tally.hopeless:
            if (work := waiting.next()) is None:
                break
            self._begin(work, tally)
        return bool(self.out)

    def _begin(self, work: Work, tally: Tally, others: Sequence[str] = ()) -> None:
        blocks = [self.store.blocks[number] for number in work.numbers]
        done = self.submit(
            (absolute_url(self.store.url), self.store.run_id, blocks, work.decision,
             self._sources, self.time_limit_s, tally.quota()), others)
        self.out[done] = work

    def _note(self, done: Pending, waiting: Waiting, tally: Tally) -> None:
        """Count what was computed; begin again what may still be computed."""
        work = self.out.pop(done)
        block = self.store.blocks[work.numbers[0]]
        try:
            result = self.result(done, work)
        except MachineFaultError as fault:
            tally.add_failed(f"block {block}: {fault}", machine_fault=True)
        except (StoreReplacedError, RunError):
            raise
        except ChildRaisedError as error:
            tally.add_failed(f"block {block}: {last_line(error)}")
        except Exception as error:
            tally.add_failed(f"block {block}: {exception_line(error)}")
        else:
            if isinstance(result, Again):
                self._begin(work, tally, result.workers)
                return
            for number, receipt in zip(work.numbers, result, strict=True):
                waiting.committed(number, receipt)
                tally.add(receipt)

    @abstractmethod
    def room(self) -> int:
        """Return how many tasks may be out now."""

    @abstractmethod
    def submit(self, arguments: tuple[Any, ...], others: Sequence[str]) -> Pending:
        """Call :func:`compute_blocks`, on one of some workers if any are named.

        What it returns is put into ``finished`` when it is done.
        """

    @abstractmethod
    def result(self, done: Pending, work: Work) -> list[Receipt] | Again:
        """Return receipts, or that the work is begun again; raise why it failed."""

    def check(self) -> None:
        """Look after work while nothing is finished; RunError if nothing will be."""

    @abstractmethod
    def end(self) -> None:
        """Take back what is still out."""


# --------------------------------------------------------------------------------------------------
# This machine, without a cluster: the guarantees are those of one. A block that ends its process
# is computed in isolation when it is begun again, and a block is committed by its receipt.

class OnThisMachine(Engine[Future[Any]]):
    """Computes blocks in child processes of this one, beside each a thread of this process.

    Parameters
    ----------
    child
        A child process that was started before. It is ended with the others.
    workers
        How many children there are at most; each is started when it is needed.
    small
        Whether the run is so small that one child is to compute it alone, for at most
        :data:`~sweep.execution.limits.SMALL_RUN_S` seconds.
    """

    def __init__(
        self, store: RunStore, child: Child, workers: int = 1, sources: Sequence[str] = (),
        time_limit_s: float = TIME_LIMIT_S, *, small: bool = False,
    ) -> None:
        super().__init__(store, sources, time_limit_s)
        self._workers, self._threads = workers, ThreadPoolExecutor(workers, "sweep")
        self._children, self._idle = [child], [child]
        self._small_until = time.monotonic() + SMALL_RUN_S if small else 0.0
        self._lock, self._ended = threading.Lock(), False

    def room(self) -> int:
        """Return how many blocks may be out: one waits for each child that computes."""
        return 1 if time.monotonic() < self._small_until else 2 * self._workers

    def submit(self, arguments: tuple[Any, ...], others: Sequence[str]) -> Future[Any]:
        """Have a thread call a child."""
        del others
        done = self._threads.submit(self._compute, arguments)
        done.add_done_callback(self.finished.put)
        return done

    def _compute(self, arguments: tuple[Any, ...]) -> list[Receipt]:
        """Call a child; after a death, or a first fault of the machine, start another one."""
        deaths = faults = 0
        with machine_faults_raised():
            child = self._started(self._idle.pop() if self._idle else None)
            try:
                while True:
                    try:
                        # The block keeps its own time limit; this one is for what surrounds it.
                        receipts: list[Receipt] = child.call(
                            compute_blocks, *arguments, limit_s=2 * self.time_limit_s)
                    except ChildDiedError as death:
                        deaths += 1
                        if deaths > MAX_DEATHS:
                            raise local_fault(f"its process ended: {explained(death)}") from None
                    except MachineFaultError:
                        faults += 1
                        if faults > 1:
                            raise
                    else:
                        return receipts
                    self._started(child, again=True)
            finally:
                self._idle.append(child)

    def _started(self, child: Child | None, *, again: bool = False) -> Child:
        """Return a child that runs: a new one, or one that is started again."""
        with self._lock:
            if self._ended:
                raise RunError("the run was stopped")
            if child is None:
                child = Child(BLOCK_TASK)
                self._children.append(child)
            elif again:
                child.restart()
            return child

    def result(self, done: Future[Any], work: Work) -> list[Receipt]:
        """Return the receipts."""
        del work
        receipts: list[Receipt] = done.result()
        return receipts

    def end(self) -> None:
        """End the children, and the threads that wait for their answers."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._lock:
            self._ended = True
            for child in self._children:
                child.close()
        self._threads.shutdown()
