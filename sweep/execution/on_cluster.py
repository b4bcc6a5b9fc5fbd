"""Blocks on a Dask cluster: one on this machine, a scheduler's, or the caller's own."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import time
from collections import Counter
from collections.abc import Collection, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Any, cast
from urllib.parse import urlsplit

from distributed import Client, KilledWorker, LocalCluster, Security, get_worker, wait
from distributed.core import rpc

from sweep.errors import ArgumentError, RunError
from sweep.evaluation.results import differing_processors, processor
from sweep.execution.block_task import compute_block, other_here
from sweep.execution.executors import Executor, Failed, attempt
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import ADVICE, SINGLE_THREADED, default_workers
from sweep.messages import exception_line, notice
from sweep.store.blocks import Receipt, StoreReplacedError
from sweep.store.provenance import fingerprint

# --------------------------------------------------------------------------------------------------
# The client of a cluster whose workers make the same numbers as this process.
#
# The caller's client or cluster is only used; no client here becomes Dask's default.

#: In place of a scheduler's address: a cluster of processes on this machine, for this run alone.
LOCAL = "local"

#: How long a scheduler may take to answer.
ANSWER_S = 10.0

#: How long a run waits for a first worker, for all workers' versions, for which they import this
#: package, and after the last worker left.
WORKERS_S = 60.0


@contextlib.contextmanager
def connected(
    pipeline: Pipeline, scheduler: str | None, client: object, workers: int | None = None,
) -> Iterator[OnCluster]:
    """Return the executor on a cluster.

    Parameters
    ----------
    pipeline
        The experiment.
    scheduler
        Address of a running scheduler, or :data:`LOCAL`.
    client
        Without one, the caller's client, which stays open, or cluster object.
    workers
        Processes of a local cluster (default: the available processors).

    Raises
    ------
    ArgumentError
        If the cluster cannot be used: it does not answer or refuses, has no workers, or a worker
        has other versions; each within a bounded time.
    """
    own: Any = client
    with contextlib.ExitStack() as stack:
        if scheduler is not None:
            for name in [*logging.Logger.manager.loggerDict]:  # this package's errors say it
                if name.partition(".")[0] in ("distributed", "tornado", "asyncio"):
                    logger = logging.getLogger(name)
                    stack.callback(logger.setLevel, logger.level)
                    logger.setLevel(logging.CRITICAL)
            own = stack.enter_context(_local_cluster(workers or default_workers())) \
                if scheduler == LOCAL else _checked_address(scheduler)
        elif not (isinstance(client, Client) or hasattr(client, "scheduler_address")):
            raise ArgumentError(
                "client", client,
                "expected a distributed.Client or a cluster object such as LocalCluster; "
                "the address of a scheduler is given as scheduler")
        try:
            status = getattr(own, "status", "running")
            state = "asynchronous" if getattr(own, "asynchronous", False) else str(status)
            if state.endswith(("asynchronous", "closing", "closed", "failed")):
                raise ValueError(f"it is {state.removeprefix('Status.')}")
            if not isinstance(own, Client):
                own = stack.enter_context(Client(own, timeout=ANSWER_S, set_as_default=False))
            check_workers(own, pipeline)
        except (OSError, RuntimeError, ValueError) as error:
            argument = "client" if scheduler is None else "scheduler"
            raise ArgumentError(
                argument, scheduler or type(client).__name__, str(error)) from None
        yield OnCluster(own)


def _local_cluster(workers: int) -> LocalCluster:
    """Return a cluster of single-threaded processes on this machine.

    Dask's limit of memory is off: results lie in the store, and a worker that it pauses waits for
    ever.
    """
    try:
        return LocalCluster(
            n_workers=workers, threads_per_worker=1, host="127.0.0.1", memory_limit=0,
            dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL, env=SINGLE_THREADED)
    except (RuntimeError, OSError) as error:
        raise RunError(f"{workers} workers cannot be started: {exception_line(error)}") from None


def _checked_address(address: str) -> str:
    """Return the address of a scheduler that answers.

    If it begins with ``tls://``, Dask's own configuration names the certificates.
    """
    async def ask() -> None:
        options = Security().get_connection_args("client")
        async with asyncio.timeout(ANSWER_S), rpc(
            address, timeout=2 * ANSWER_S, connection_args=options
        ) as server:
            kind = (await server.identity())["type"]
        if kind != "Scheduler":  # Dask's client waits without end for a worker
            raise TypeError(f"a {kind}")

    try:
        # Dask's client waits without end for a handshake, so that comes first, and alone; in a
        # thread, since the caller may be in an event loop, as notebooks are.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(asyncio.run, ask()).result()
    except Exception as error:
        raise ArgumentError(
            "scheduler", address,
            f"expected an address such as tcp://host:8786, or {LOCAL}; no scheduler answers "
            f"there within {ANSWER_S:.0f} s: {exception_line(error)}") from None
    return address


def this_process(
    pipeline: Pipeline, begun: dict[str, Any]
) -> tuple[list[str], tuple[str, int], str]:
    """Return where the calling process differs from the run's; which it is; its processor."""
    return other_here(pipeline, begun), (socket.gethostname(), os.getpid()), processor()


def check_workers(client: Client, pipeline: Pipeline) -> None:
    """Check that workers have this process's versions and files, and are other processes.

    A line says if their processors have different features, which the last bits of results, and
    some corners by whole pixels, depend on. A worker that does not answer in time is not checked:
    each compares its versions with the store's when it gets its first block.

    Raises
    ------
    ValueError
        If a worker cannot compute the pipeline as this process would, or none answers.
    """
    begun = fingerprint(pipeline)
    try:
        # A task that any worker may take, so that a cluster that adapts to work starts one.
        client.submit(os.getpid, pure=False).result(timeout=WORKERS_S)
        asked = {
            worker: client.submit(this_process, pipeline, begun, workers=[worker], pure=False)
            for worker in client.nthreads()
        }
        with contextlib.suppress(TimeoutError), client.as_current():
            wait(list(asked.values()), timeout=WORKERS_S)
        told = {worker: answer.result() for worker, answer in asked.items() if answer.done()}
    except TimeoutError:
        raise ValueError(f"no workers within {WORKERS_S:.0f} s; start some") from None
    except Exception as error:
        raise ValueError(f"its workers cannot run sweep: {exception_line(error)}") from None
    if any(process == (socket.gethostname(), os.getpid()) for _, process, _ in told.values()):
        raise ValueError("its workers are threads of this process, which a scene may end; "
                         "start it with processes=True")
    if lines := [f"\n  {worker}: {line}" for worker, (other, _, _) in sorted(told.items())
                 for line in other]:
        raise ValueError(
            "workers with other versions; install the same everywhere" + "".join(lines))
    for line in differing_processors(Counter(used for _, _, used in told.values()), "workers"):
        notice(f"warning: {line}")


# --------------------------------------------------------------------------------------------------
# Blocks on the cluster: how many are out, which worker computes which, and when to give up.

#: Blocks in flight per worker thread: enough that none waits, few enough that none pile up.
BLOCKS_PER_THREAD = 3

#: How often the scheduler is asked what workers it has, and how long a run waits for the answer.
LOOK_S, LOOK_LIMIT_S = 1.0, 2.0

AWAY = "the scheduler went away"


class OnCluster(Executor):
    """Computes blocks on a cluster.

    A block whose worker dies, or whose worker's machine is at fault, is given to others; a line
    names the machine.

    Parameters
    ----------
    client
        The cluster's client.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self._states: dict[str, dict[str, Any]] = {}
        self._told: set[str] = set()
        self._asked = 0.0
        self._usable = time.monotonic()
        self._look()

    @property
    def threads(self) -> int:  # type: ignore[override]
        """Threads of the cluster's workers, which may come and go."""
        return max(sum(int(state["nthreads"]) for state in self._states.values()), 1)

    def _look(self) -> None:
        """Ask the scheduler for its workers."""
        try:
            if self._client.scheduler is None or self._client.status != "running":
                raise ConnectionError
            self._states = self._client.sync(
                self._client.scheduler.identity, n_workers=-1, callback_timeout=LOOK_LIMIT_S,
            )["workers"]
        except TimeoutError:
            pass  # it is busy
        except OSError:
            raise RunError(AWAY) from None
        self._asked = time.monotonic()
        if any(state["status"] != "paused" for state in self._states.values()):
            self._usable = self._asked

    def room(self) -> int:
        """Return a few blocks for each thread of the cluster.

        Raises
        ------
        RunError
            If the scheduler went away, or no worker has been able to compute for a minute.
        """
        if time.monotonic() > self._asked + LOOK_S:
            self._look()
        if self._asked > self._usable + WORKERS_S:
            raise RunError(f"there have been no workers for {WORKERS_S:.0f} s: {self.workers()}")
        return BLOCKS_PER_THREAD * self.threads

    def workers(self) -> str:
        """Return how many workers there are, and how many of them Dask has paused."""
        paused = sum(state["status"] == "paused" for state in self._states.values())
        return f"{len(self._states)} workers" + (
            f", {paused} of them paused by Dask because of their memory "
            "(`dask worker --memory-limit`)" if paused else "")

    def submit(self, arguments: tuple[Any, ...], failures: list[Failed]) -> Any:
        """Give blocks to the cluster: if some workers failed them, to others, best elsewhere."""
        others = self._others(failures) if failures else []
        return self._client.submit(
            on_worker, *arguments, pure=False, key=f"block-{time.monotonic_ns()}",
            workers=others or None, allow_other_workers=bool(others),
        )

    def _others(self, failures: list[Failed]) -> list[str]:
        failed_on = {each.worker for each in failures}
        left = [worker for worker in self._states if worker not in failed_on]
        hosts = {urlsplit(worker).hostname for worker in failed_on}
        return [each for each in left if urlsplit(each).hostname not in hosts] or left

    def elsewhere(self, failures: list[Failed]) -> bool:
        """Return whether there are workers that did not fail; name the one that did, once."""
        worker = failures[-1].worker
        if worker not in self._told:
            self._told.add(worker)
            notice(f"worker {worker}: {failures[-1].reason}; others compute its blocks")
        return bool(self._others(failures))

    def result(self, future: Any) -> Receipt | Failed:
        """Return the receipt, or why there is none."""
        try:
            if future.status != "lost":
                return cast("Receipt | Failed", future.result())  # through the scheduler
        except StoreReplacedError:
            raise
        except (OSError, CancelledError):
            raise RunError(AWAY) from None
        except Exception as error:
            if not isinstance(error, KilledWorker):
                return Failed(exception_line(error))
        finally:
            future.release()
        self._look()  # it raises if the scheduler went away
        # A block that ends its process is computed in isolation when it is begun again, but it may
        # have been queued behind one, or its workers were killed from outside; or died with its
        # receipt.
        return Failed("its workers died again and again; their logs may tell why; if memory ran "
                      f"out, {ADVICE}", machine_fault=True, died=True)

    def cancel(self, out: Collection[Any]) -> None:
        """Take back the blocks that are still submitted; a caller's cluster outlives the run."""
        if out and self._client.status == "running":
            with contextlib.suppress(OSError, TimeoutError):
                self._client.cancel(list(out))


def on_worker(*arguments: Any) -> Receipt | Failed:
    """Compute a block on a worker; return its receipt, or why there is none."""
    return attempt(compute_block, *arguments, worker=get_worker().address)
