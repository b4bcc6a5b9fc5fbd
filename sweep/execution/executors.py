"""Where blocks are computed: the loop over submitted blocks, and this machine's child processes."""

from __future__ import annotations

import contextlib
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from sweep.evaluation.machine_faults import machine_fault
from sweep.execution.block_task import compute_block
from sweep.isolation.child_process import POLL_S, Child, ChildDiedError, ChildError, Interrupts
from sweep.messages import exception_line, notice
from sweep.store.blocks import Receipt, StoreReplacedError

# --------------------------------------------------------------------------------------------------
# The loop: blocks are submitted as long as there is room, and what becomes of them is yielded.
#
# A bounded number of blocks is out at a time, so that memory does not grow with the grid. Workers
# write the blocks; only receipts come back.

#: How often a block is tried whose worker dies, or fails by a fault of its machine.
MAX_ATTEMPTS = 10

#: How long no block may be finished before a line says so, again and again.
SILENCE_S = 60.0


class Failed(NamedTuple):
    """Why a block failed.

    Attributes
    ----------
    reason
        In a line.
    machine_fault
        Whether a machine is at fault, and not the block.
    died
        Whether the worker's process ended: the block is computed in isolation when it is begun
        again.
    worker
        The address of the worker that failed, if it is known.
    """

    reason: str
    machine_fault: bool = False
    died: bool = False
    worker: str = ""


def attempt(
    compute: Callable[..., Receipt | Failed], *arguments: Any, worker: str = ""
) -> Receipt | Failed:
    """Return the receipt of a block, which a function computes, or why there is none.

    Raises
    ------
    StoreReplacedError
        If the store was moved, deleted or replaced: this one goes on.
    """
    try:
        return compute(*arguments)
    except StoreReplacedError:
        raise
    except Exception as error:
        fault = machine_fault(error)
        return Failed(str(fault or exception_line(error)), fault is not None, worker=worker)


#: A block's number, and the arguments of :func:`compute_block`.
Task = tuple[int, tuple[Any, ...]]


class Executor(ABC):
    """Computes blocks in other processes.

    Attributes
    ----------
    threads
        How many blocks are computed at once.
    """

    threads: int

    def map(
        self, tasks: Iterable[Task], limit_s: float, interrupts: Interrupts
    ) -> Generator[tuple[int, Receipt | Failed]]:
        """Compute blocks; yield the number of each with its receipt, or why there is none.

        Parameters
        ----------
        tasks
            The blocks.
        limit_s
            Block timeout in seconds.
        interrupts
            Entered; checked meanwhile.

        Raises
        ------
        RunError
            If nothing can be computed any more.
        StoreReplacedError
            If the store was moved, deleted or replaced.
        """
        left, finished = iter(tasks), SimpleQueue[Any]()
        # Submitted blocks, and how they failed before.
        out: dict[Any, tuple[Task, list[Failed]]] = {}
        last = time.monotonic()

        def begin(task: Task, failures: list[Failed]) -> None:
            future = self.submit(task[1], failures)
            out[future] = task, failures
            future.add_done_callback(finished.put)

        try:
            while True:
                while len(out) < self.room() and (task := next(left, None)) is not None:
                    begin(task, [])
                if not out:
                    return
                interrupts.check()
                try:
                    future = finished.get(timeout=POLL_S)
                except Empty:
                    if time.monotonic() >= last + SILENCE_S:
                        last = time.monotonic()
                        notice(f"no block was finished for {SILENCE_S:.0f} s: {len(out)} are with "
                               f"{self.workers()}; a block ends after at most {limit_s:.0f} s")
                    continue
                last = time.monotonic()
                task, failures = out.pop(future)
                result = self.result(future)
                if isinstance(result, Failed):
                    failures = [*failures, result]
                    again = result.died or (result.machine_fault and self.elsewhere(failures))
                    if again and len(failures) < MAX_ATTEMPTS:
                        begin(task, failures)
                        continue
                yield task[0], result
        finally:
            self.cancel(out)

    def room(self) -> int:
        """Return how many blocks may be out now."""
        return self.threads

    @abstractmethod
    def submit(self, arguments: tuple[Any, ...], failures: list[Failed]) -> Any:
        """Have a block computed, rather not where it failed; return a future."""

    def result(self, future: Future[Receipt | Failed]) -> Receipt | Failed:
        """Return the receipt of a future that is done, or why there is none."""
        return future.result()

    def elsewhere(self, failures: list[Failed]) -> bool:
        """Return whether a block that machines failed may be tried again: here once."""
        return len(failures) == 1

    def workers(self) -> str:
        """Return in words what computes."""
        return f"{self.threads} processes"

    @abstractmethod
    def cancel(self, out: Collection[Any]) -> None:
        """Take back the blocks that are still submitted."""


# --------------------------------------------------------------------------------------------------
# Child processes of this machine, each called by a thread.

class Children(Executor, contextlib.AbstractContextManager["Children"]):
    """Computes blocks in child processes.

    With a line, fewer do than were asked for if the system allows no more.

    Parameters
    ----------
    child
        The first one.
    count
        How many there are to be.
    """

    def __init__(self, child: Child, count: int) -> None:
        self._children, self._idle = [child], SimpleQueue[Child]()
        try:
            while len(self._children) < count:
                self._children.append(Child())
        except OSError as error:
            notice(f"{len(self._children)} of {count} processes could be started: "
                   f"{exception_line(error)}")
        for each in self._children:
            self._idle.put(each)
        self.threads = len(self._children)
        self._pool = ThreadPoolExecutor(self.threads)

    def __exit__(self, *_: object) -> None:
        """End the processes; a thread that waits for one gets its end for an answer."""
        for child in self._children:
            child.close()
        self._pool.shutdown(cancel_futures=True)
        for child in self._children:  # one may have been begun again meanwhile
            child.close()

    def submit(self, arguments: tuple[Any, ...], _failures: list[Failed]) -> Any:
        """Have a thread call a child that is idle."""
        return self._pool.submit(attempt, self._call, *arguments)

    def _call(self, *arguments: Any) -> Receipt | Failed:
        *_, limit_s, _ = arguments
        child = self._idle.get()
        try:
            # The block keeps its own time limit; this one is for what surrounds it.
            return child.call(compute_block, *arguments, limit_s=2 * limit_s)
        except ChildError as error:
            return Failed(error.line, error.from_outside, isinstance(error, ChildDiedError))
        except Exception:  # of the machine, perhaps of this process: another one tries again
            child.close()
            raise
        finally:
            self._idle.put(child)

    def cancel(self, out: Collection[Any]) -> None:
        """End the processes if they still compute."""
        if out:
            self.__exit__()
