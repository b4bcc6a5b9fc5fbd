"""The cluster that computes blocks: embedded, by a scheduler's address, or the caller's own.

The caller's process is left as it was: an embedded cluster's settings hold while it runs, Dask's
loggers are silenced while this package's own client lives, and a client or cluster of the caller is
only used. No client here becomes Dask's default.
"""

from __future__ import annotations

import contextlib
import copy
import importlib
import logging
import os
import signal
from collections.abc import Iterator
from typing import Any, Protocol, runtime_checkable

from sweep.errors import ArgumentError, RunError

try:
    import dask
    from distributed import Client, LocalCluster, fire_and_forget
except (ValueError, TypeError, KeyError, AttributeError) as error:
    # Dask interprets its configuration while it is imported.
    raise RunError(
        "Dask cannot be imported with its configuration (~/.config/dask, /etc/dask, DASK_... "
        f"variables): {type(error).__name__}: {error}"
    ) from None

from sweep.evaluation.machine_faults import exception_line
from sweep.execution.distributed_internals import main_not_imported, thread_counts
from sweep.execution.limits import ANSWER_S, NO_WORKERS_TIMEOUT_S, THREAD_COUNT_TIMEOUT_S
from sweep.execution.scheduler_connection import connect_to_scheduler
from sweep.execution.thread_limit import check_threads
from sweep.execution.worker_versions import check_workers
from sweep.isolation.interrupts import in_main_thread
from sweep.plan.experiment import Pipeline
from sweep.processes import SINGLE_THREADED

WORKER_ENVIRONMENT = {
    **SINGLE_THREADED,
    "MALLOC_TRIM_THRESHOLD_": "268435456",
    "MALLOC_MMAP_THRESHOLD_": "268435456",
}
"""One thread a worker; images' memory is kept between scenes rather than given back."""

NEVER_PAUSED: dict[str, Any] = {
    f"distributed.worker.memory.{measure}": False
    for measure in ("target", "spill", "pause", "terminate")
}
"""Results are small, and lie in the store: a worker that waits for memory waits for ever."""

QUIET_DASK_CONFIG: dict[str, Any] = {
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.tick.cycle": "3s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.scheduler.active-memory-manager.start": False,
}
"""The cluster monitors itself less often: with Dask's defaults two idle workers, their scheduler
and client take 0.12 of a core, so 0.01, and nothing here shows what is monitored."""


@runtime_checkable
class Cluster(Protocol):
    """A cluster object: LocalCluster, SLURMCluster, KubeCluster, ..."""

    @property
    def scheduler_address(self) -> str:
        """The address of its scheduler."""


def default_workers() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def connected(
    pipeline: Pipeline, *, workers: int | None = None, scheduler: str | None = None,
    client: Client | Cluster | None = None,
) -> Iterator[Client]:
    """Return a client of a cluster whose workers make the same numbers as this process.

    Parameters
    ----------
    pipeline
        What is to be computed.
    workers
        Processes of the embedded cluster, which is started if no other is given (default: the
        available processors).
    scheduler
        Address of a running scheduler.
    client
        The caller's client, which stays open, or cluster object, of which a client is made and
        closed.

    Raises
    ------
    ArgumentError
        If the cluster cannot be used.
    """
    if scheduler is not None:
        cluster = external(scheduler, pipeline)
    elif client is not None:
        cluster = borrowed(client, pipeline)
    else:
        cluster = embedded(workers or default_workers())
    with cluster as connection:
        yield connection


@contextlib.contextmanager
def embedded(workers: int) -> Iterator[Client]:
    """Start a cluster of ``workers`` single-threaded processes on this machine; end it quietly.

    It listens on the loopback interface only, and has no limits of memory. The user's own
    configuration of Dask (files, environment variables, ``dask.config.set``) does not apply to it.
    """
    with silenced_dask_loggers(), main_not_imported(), dask.config.set(own_dask_config()):
        with _ignored_interrupts():
            cluster = _started(workers)
        with cluster, Client(cluster, set_as_default=False) as client:
            # The workers import their packages while the caller measures.
            fire_and_forget(
                [client.submit(_warm, workers=[worker], pure=False) for worker in client.nthreads()]
            )
            yield client


def _started(workers: int) -> LocalCluster:
    check_threads(workers)
    try:
        return LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1",
            dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL,
            memory_limit=0, scheduler_kwargs={"dashboard": False},
        )
    except (RuntimeError, OSError) as error:
        cause = error.__cause__ or error
        raise RunError(
            f"{workers} worker processes cannot be started: {exception_line(cause)}"
        ) from None


def own_dask_config() -> dict[str, Any]:
    """Return the whole configuration of an embedded cluster: Dask's defaults, and what is set here.

    Workers are given it by their nannies, in place of what they read themselves.
    """
    config: dict[str, Any] = {}
    for defaults in dask.config.defaults:
        dask.config.update(config, copy.deepcopy(defaults), priority="old")
    settings = {
        "distributed.nanny.pre-spawn-environ": WORKER_ENVIRONMENT,
        "distributed.worker.preload": ["sweep.execution.worker_start"],
        **NEVER_PAUSED, **QUIET_DASK_CONFIG,
    }
    with dask.config.set(settings, config=config):
        return copy.deepcopy(config)


def _warm() -> None:
    """Import what a block needs."""
    importlib.import_module("sweep.execution.block_task")


@contextlib.contextmanager
def external(address: str, pipeline: Pipeline) -> Iterator[Client]:
    """Connect to a running scheduler by its address.

    Raises
    ------
    ArgumentError
        If it does not answer or refuses, has no workers, or a worker has other versions; each
        within a bounded time.
    """
    with silenced_dask_loggers(), connect_to_scheduler(address) as client:
        try:
            client.wait_for_workers(1, timeout=ANSWER_S)
        except TimeoutError:
            raise ArgumentError(
                "scheduler", address, f"no workers; start some with `dask worker {address}`"
            ) from None
        except OSError:
            raise ArgumentError("scheduler", address, "it went away") from None
        check_workers(client, pipeline, "scheduler", address)
        yield client


@contextlib.contextmanager
def borrowed(client: Client | Cluster, pipeline: Pipeline) -> Iterator[Client]:
    """Use the caller's client, or a new client of the caller's cluster object.

    Raises
    ------
    ArgumentError
        If it is neither, is closed or asynchronous, has no workers, or a worker has other versions.
    """
    if isinstance(client, str) or not isinstance(client, (Client, Cluster)):
        raise ArgumentError(
            "client", client,
            "expected a distributed.Client or a cluster object such as LocalCluster; "
            "the address of a scheduler is given as scheduler",
        )
    if getattr(client, "asynchronous", False):
        raise ArgumentError("client", _name(client), "it is asynchronous; expected one that is not")
    with contextlib.ExitStack() as stack:
        if isinstance(client, Client):
            connection = client
        else:
            state = getattr(getattr(client, "status", None), "name", "running")
            if state in ("closing", "closed", "failed"):
                raise ArgumentError("client", _name(client), f"it is {state}")
            try:
                connection = stack.enter_context(
                    Client(client, timeout=ANSWER_S, set_as_default=False)
                )
            except (OSError, RuntimeError, ValueError) as error:
                raise ArgumentError("client", _name(client), f"cannot connect: {error}") from None
        if connection.status != "running":
            raise ArgumentError("client", _name(client), f"it is {connection.status}")
        _await_worker(connection, _name(client))
        check_workers(connection, pipeline, "client", _name(client))
        yield connection


def _name(client: Client | Cluster) -> str:
    """Return what a message calls a client or cluster: its type, and the scheduler's address."""
    scheduler = client.scheduler if isinstance(client, Client) else client.scheduler_address
    return f"{type(client).__name__}({getattr(scheduler, 'address', scheduler)})"


def _await_worker(client: Client, name: str) -> None:
    """Wait for a worker by submitting a task, so that a cluster that adapts to work starts one."""
    task = client.submit(os.getpid, pure=False)
    try:
        task.result(timeout=NO_WORKERS_TIMEOUT_S)
    except TimeoutError:
        raise ArgumentError(
            "client", name, f"no workers within {NO_WORKERS_TIMEOUT_S:.0f} s; start some"
        ) from None
    except Exception as error:
        raise ArgumentError("client", name, f"its workers compute nothing: {error}") from None
    finally:
        task.cancel()


def thread_count(client: Client) -> int:
    """Return how many threads the workers of a cluster have; 0 if the scheduler is too busy.

    Raises
    ------
    RunError
        If the scheduler went away.
    """
    try:
        return sum(thread_counts(client, THREAD_COUNT_TIMEOUT_S).values())
    except TimeoutError:
        return 0
    except OSError:
        raise RunError("the scheduler went away") from None


@contextlib.contextmanager
def _ignored_interrupts() -> Iterator[None]:
    """Ignore Ctrl-C: processes that are started meanwhile do so for good, and leave it to us."""
    before = signal.getsignal(signal.SIGINT) if in_main_thread() else None
    if before is None:  # another thread, or a handler that was not installed from Python
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def silenced_dask_loggers() -> Iterator[None]:
    """Silence the loggers of Dask while the body runs: this package's errors say what matters.

    Dask gives some of the loggers below its own a level and a handler of theirs.
    """
    loggers = [
        logger for name, logger in list(logging.Logger.manager.loggerDict.items())
        if name.partition(".")[0] in ("distributed", "tornado")
        and isinstance(logger, logging.Logger)
    ]
    before = {logger: (logger.level, logger.handlers[:]) for logger in loggers}
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, (level, handlers) in before.items():
            logger.setLevel(level)
            for handler in set(logger.handlers).difference(handlers):
                logger.removeHandler(handler)
