"""Where blocks are computed: one loop over what is out, and one child process as an engine."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from sweep.errors import MachineFaultError, StoreReplacedError, SweepError
from sweep.evaluation.machine_faults import machine_faults_raised
from sweep.execution.block_task import compute_blocks
from sweep.execution.limits import MAX_DEATHS, SMALL_RUN_LIMIT_S, TIME_LIMIT_S
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
class Failed:
    """Why work failed: by a machine's fault, or because it raises."""

    reason: str
    machine_fault: bool = False


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
            self._fill(ready, tally)
            while self.out:
                interrupts.check()
                try:
                    done = self.finished.get(timeout=POLL_S)
                except Empty:
                    self.check()
                    continue
                self._note(done, ready, tally)
                self._fill(ready, tally)
        finally:
            self.end()
        tally.check()

    def _fill(self, waiting: Waiting, tally: Tally) -> None:
        while len(self.out) < self.room() and not tally.hopeless:
            if (work := waiting.next()) is None:
                return
            self._begin(work, tally)

    def _begin(self, work: Work, tally: Tally, others: Sequence[str] = ()) -> None:
        blocks = [self.store.blocks[number] for number in work.numbers]
        done = self.submit(
            (absolute_url(self.store.url), self.store.run_id, blocks, work.decision,
             self._sources, self.time_limit_s, tally.quota()), others)
        self.out[done] = work

    def _note(self, done: Pending, waiting: Waiting, tally: Tally) -> None:
        """Count what was computed; begin again what may still be computed."""
        work = self.out.pop(done)
        result = self.result(done, work)
        if isinstance(result, Failed):
            block = self.store.blocks[work.numbers[0]]
            tally.add_failed(f"block {block}: {result.reason}", machine_fault=result.machine_fault)
        elif isinstance(result, Again):
            self._begin(work, tally, result.workers)
        else:
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
    def result(self, done: Pending, work: Work) -> list[Receipt] | Failed | Again:
        """Return receipts, or why there are none, or that the work is begun again."""

    def check(self) -> None:
        """Look after work while nothing is finished; RunError if nothing will be."""

    @abstractmethod
    def end(self) -> None:
        """Take back what is still out."""


# --------------------------------------------------------------------------------------------------
# Small runs: blocks are computed one after another in the child process that measured scenes.
#
# A cluster takes seconds to start and to end, and as many processors as it has workers to import
# the packages. The guarantees are those of a cluster: a block that ends its process is computed
# in isolation when it is begun again, and a block is committed by its receipt.

class InChild(Engine[Future[Any]]):
    """Computes blocks in a child process, for at most :data:`SMALL_RUN_LIMIT_S` seconds.

    Parameters
    ----------
    child
        The child process; another is started in its place if it ends.
    """

    def __init__(
        self, store: RunStore, child: Child, sources: Sequence[str] = (),
        time_limit_s: float = TIME_LIMIT_S,
    ) -> None:
        super().__init__(store, sources, time_limit_s)
        self._child, self._thread = child, ThreadPoolExecutor(1)
        self._deaths: Counter[int] = Counter()
        self._faults: Counter[int] = Counter()
        self._deadline: float | None = None

    def room(self) -> int:
        """Return 1 until time is up; the first block is begun in any case."""
        if self._deadline is None:
            self._deadline = time.monotonic() + SMALL_RUN_LIMIT_S
            return 1
        return int(time.monotonic() <= self._deadline)

    def submit(self, arguments: tuple[Any, ...], others: Sequence[str]) -> Future[Any]:
        """Call the child in a thread."""
        del others
        done = self._thread.submit(
            self._child.call, compute_blocks, *arguments,
            # The block keeps its own time limit; this one is for what surrounds it.
            limit_s=2 * self.time_limit_s,
        )
        done.add_done_callback(self.finished.put)
        return done

    def result(self, done: Future[Any], work: Work) -> list[Receipt] | Failed | Again:
        """Return the receipts; after a death, or a first fault, the block is begun again."""
        number = work.numbers[0]
        try:
            receipts: list[Receipt] = done.result()
        except StoreReplacedError:
            raise
        except ChildDiedError as error:
            self._deaths[number] += 1
            with machine_faults_raised():
                self._child.restart()
            if self._deaths[number] <= MAX_DEATHS:
                return Again()
            reason = f"its process ended: {explained(error)}"
            return Failed(reason, machine_fault=error.from_outside)
        except MachineFaultError as error:
            self._faults[number] += 1
            if self._faults[number] > 1:
                return Failed(str(error), machine_fault=True)
            with machine_faults_raised():
                self._child.restart()
            return Again()
        except ChildRaisedError as error:
            return Failed(last_line(error))
        except SweepError as error:
            return Failed(f"{type(error).__name__}: {error}")
        return receipts

    def end(self) -> None:
        """End the child if it still computes: the thread waits for its answer."""
        if self.out:
            self._child.close()
        self._thread.shutdown()
