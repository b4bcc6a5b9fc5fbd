"""Small runs: blocks are computed one after another in the child process that measured scenes.

A cluster takes seconds to start and to end, and as many processors as it has workers to import the
packages. The guarantees are those of a cluster: a block that ends its process is computed in
isolation when it is begun again, and a block is committed by its receipt.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor

from sweep.errors import MachineFaultError, StoreReplacedError, SweepError
from sweep.evaluation.machine_faults import machine_faults_raised
from sweep.execution.block_task import compute_block, compute_blocks
from sweep.execution.limits import MAX_DEATHS, SMALL_RUN_LIMIT_S, TIME_LIMIT_S
from sweep.execution.tally import Tally
from sweep.execution.waiting import Waiting, Work, in_any_order
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError, last_line
from sweep.isolation.interrupts import Interrupts
from sweep.isolation.machine_memory import explained, memory_kills
from sweep.store.receipt import Receipt
from sweep.store.run_store import RunStore


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
                self._time_limit_s, tally.quota(), self._store.durable,
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
