"""The cluster of a run: embedded, a scheduler, or a client of the user's."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import importlib
import logging
import multiprocessing.resource_tracker
import multiprocessing.spawn
import os
import resource
import signal
import socket
import ssl
import sys
from collections import Counter
from collections.abc import Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable
from urllib.parse import urlsplit

from distributed import Client, Security
from distributed.comm.addressing import parse_address
from distributed.comm.core import CommClosedError, FatalCommClosedError
from distributed.comm.registry import backends, get_backend
from distributed.core import send_recv

from sweep.errors import ArgumentError, RunError
from sweep.evaluation.machine_faults import exception_line
from sweep.execution.limits import (
    ANSWER_S,
    NO_WORKERS_TIMEOUT_S,
    THREAD_COUNT_TIMEOUT_S,
    VERSIONS_S,
)
from sweep.experiment.parameters import lacking_plugins
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import SINGLE_THREADED, in_main_thread
from sweep.isolation.machine import (
    be_killed_before_others,
    control_groups,
    default_workers,
    number_in,
    text_of,
)
from sweep.messages import notice
from sweep.processor import differing_processors, processor
from sweep.store.provenance import changes, fingerprint

# --------------------------------------------------------------------------------------------------
# What this package uses of Dask's ``distributed`` beyond its documented interface.
#
# Tried with version 2026.8. Everything else of this package uses public names only, so that a new
# version of ``distributed`` can break a run in this module alone.

WORKER_PROCESS = "Dask Worker process"
"""What the names of the processes begin with that nannies start."""


@contextlib.contextmanager
def main_not_imported() -> Iterator[None]:
    """Have workers that are started now not import the caller's script, of which they need nothing.

    `multiprocessing` has each new process import the main module. A script that calls
    `sweep.run` outside ``if __name__ == "__main__":`` would run again in each worker.
    """
    prepare = multiprocessing.spawn.get_preparation_data

    def without_main(name: str) -> dict[str, Any]:
        prepared = dict(prepare(name))
        if name.startswith(WORKER_PROCESS):
            for key in ("init_main_from_name", "init_main_from_path"):
                prepared.pop(key, None)
        return prepared

    multiprocessing.spawn.get_preparation_data = without_main
    try:
        yield
    finally:
        multiprocessing.spawn.get_preparation_data = prepare


def start_quiet_resource_tracker() -> None:
    """Start the process of `multiprocessing` that tidies up after processes, if none runs yet.

    It tells nobody that it did so: a run that is stopped says itself how it ended.
    """
    option = "ignore:resource_tracker"
    sys.warnoptions.append(option)  # which the process is started with
    try:
        multiprocessing.resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(option)


def is_known_protocol(scheme: str) -> bool:
    """Return whether Dask can connect to addresses that begin with ``scheme``: tcp, tls, ..."""
    return scheme in backends


RETRY_S = 0.1
"""Seconds between two attempts to connect."""


async def peer_type(address: str, options: dict[str, Any]) -> str:
    """Return the type of server at an address: Scheduler, Worker, Nanny.

    It tries until it is cancelled; ``distributed.comm.core.connect`` leaves a connection open if it
    is cancelled during the handshake.

    Parameters
    ----------
    address
        Such as tcp://host:8786.
    options
        Dask's connection arguments, such as ``ssl_context``.

    Raises
    ------
    OSError
        If the server refuses.
    """
    scheme, location = parse_address(address)
    connector = get_backend(scheme).get_connector()
    while True:
        try:
            comm = await connector.connect(location, **options)
            break
        except FatalCommClosedError:
            raise
        except OSError:
            await asyncio.sleep(RETRY_S)
    try:
        ours = comm.handshake_info()
        await comm.write(ours)
        comm.handshake_options = comm.handshake_configuration(ours, await comm.read())
        identity: dict[str, Any] = await send_recv(comm, op="identity")
    finally:
        comm.abort()
    return str(identity["type"])


class WorkerState(NamedTuple):
    """A worker's number of threads, and its status: "running", "paused", ..."""

    threads: int
    status: str


def worker_states(client: Client, timeout_s: float) -> dict[str, WorkerState]:
    """Return the state of each worker, by address.

    Raises
    ------
    TimeoutError
        If the scheduler does not answer in time.
    OSError
        If the client is not connected.
    """
    identity: dict[str, Any] = client.sync(
        _scheduler(client).identity, n_workers=-1, callback_timeout=timeout_s
    )
    return {
        address: WorkerState(int(worker["nthreads"]), str(worker["status"]))
        for address, worker in identity["workers"].items()
    }


def _scheduler(client: Client) -> Any:
    """Return the scheduler to which a client is connected; OSError if it is to none."""
    if client.scheduler is None or client.status != "running":
        raise CommClosedError("not connected")
    return client.scheduler


def worker_that_failed(client: Client, key: str) -> str | None:
    """Return the address of the worker on which a task raised; None if the scheduler tells none.

    A task whose arguments could not even be unpickled raised, too.
    """
    try:
        addresses: list[str] = client.run_on_scheduler(
            lambda dask_scheduler: sorted(dask_scheduler.tasks[key].erred_on or ())
        )
    except Exception:
        return None  # it may be configured to unpickle nothing
    return addresses[-1] if addresses else None


# --------------------------------------------------------------------------------------------------
# A client of a running scheduler by its address, within a bounded time.

ENCRYPTED = ("tls://", "wss://")


def connect_to_scheduler(address: str) -> Client:
    """Return a client that the caller closes.

    If the address begins with ``tls://``, Dask's own configuration names the certificates.

    Raises
    ------
    ArgumentError
        If it is no address, nothing answers there, or what answers refuses or is no scheduler;
        each within a bounded time.
    """
    if not _is_address(address):
        raise ArgumentError(
            "scheduler", address, "expected an address such as tcp://host:8786"
        )
    with _connection_errors(address):
        # Dask's client waits without end for a handshake, so that comes first, and alone.
        peer = _run_in_thread(_peer(address))
        if peer != "Scheduler":
            raise ArgumentError("scheduler", address, f"a {peer} answers there, not a scheduler")
        return Client(address, timeout=ANSWER_S, set_as_default=False)


def _is_address(address: str) -> bool:
    try:
        parts = urlsplit(address)
        return is_known_protocol(parts.scheme) and bool(parts.hostname and parts.port)
    except ValueError:
        return False


async def _peer(address: str) -> str:
    options = _connection_options(address)
    async with asyncio.timeout(ANSWER_S):
        return await peer_type(address, options)


def _run_in_thread(question: Coroutine[Any, Any, str]) -> str:
    """Return a coroutine's result, also if the caller is in an event loop, as notebooks are."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(asyncio.run, question).result()


def _connection_options(address: str) -> dict[str, Any]:
    """Return the connection arguments of Dask's configuration, including certificates."""
    try:
        options: dict[str, Any] = Security().get_connection_args("client")
    except OSError as error:
        raise ArgumentError(
            "scheduler", address,
            "the certificates that Dask's configuration names under distributed.comm.tls cannot "
            f"be read: {_short_reason(error)}",
        ) from None
    if address.startswith(ENCRYPTED) and options.get("ssl_context") is None:
        raise ArgumentError(
            "scheduler", address,
            "no certificates; name them in Dask's configuration, distributed.comm.tls.ca-file, "
            ".client.cert and .client.key",
        )
    return options


@contextlib.contextmanager
def _connection_errors(address: str) -> Iterator[None]:
    """Raise ArgumentError with a reason for an error while a connection is made."""
    try:
        yield
    except ArgumentError:
        raise  # it is a ValueError, too
    except (CommClosedError, ssl.SSLError, ValueError) as error:
        # Which side closes first, and with which words, is a matter of chance.
        if address.startswith(ENCRYPTED):
            reason = (
                f"TLS failed ({_short_reason(error)}); is it a TLS scheduler, and are its "
                "certificate and the one here signed by the same CA?"
            )
        else:
            reason = "it closed the connection; does it expect tls://?"
    except OSError:
        reason = f"no answer within {ANSWER_S:.0f} s; is `dask scheduler` running there?"
    except RuntimeError as error:
        reason = str(error)  # Dask's configuration requires encryption
    else:
        return
    raise ArgumentError("scheduler", address, reason) from None


def _short_reason(error: BaseException) -> str:
    """Return the message of OpenSSL or of the operating system, in a few words."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, ssl.SSLError):
        cause = cause.__cause__ or cause.__context__
    if isinstance(cause, ssl.SSLCertVerificationError):
        return str(cause.verify_message)
    if isinstance(cause, ssl.SSLError) and cause.reason:
        return cause.reason.lower().replace("_", " ")
    if isinstance(error, OSError) and error.strerror and not isinstance(error, CommClosedError):
        return str(error.strerror)
    return "the connection was closed"


# --------------------------------------------------------------------------------------------------
# Whether the system allows the threads and processes of a cluster, before it is started.
#
# Workers that cannot start a thread neither compute nor say so.

THREADS_PER_WORKER, OTHER_THREADS = 12, 9
"""Threads and processes that are started for a cluster, measured: 12 for each worker, with those
that watch it, and 9 of the client and scheduler."""

PRIVILEGES = 1 << 21 | 1 << 24
"""CAP_SYS_ADMIN and CAP_SYS_RESOURCE: processes that have one are not limited."""


def check_threads(workers: int) -> None:
    """Raise RunError if the system allows fewer threads than the workers need."""
    left, needed = threads_left(), THREADS_PER_WORKER * workers + OTHER_THREADS
    if left is not None and left < needed:
        raise RunError(
            f"{workers} worker processes cannot be started: they need {needed} threads, and the "
            f"system allows {max(left, 0)} more; allow more (ulimit -u, or the container's limit "
            "of processes), or use fewer workers"
        )


def threads_left() -> int | None:
    """Return how many threads and processes may still be started; None if that is not limited."""
    left = [_left_to_user(), *(
        most - (number_in(folder / "pids.current") or 0)
        for folder in control_groups("pids")
        if (most := number_in(folder / "pids.max")) is not None
    )]
    return min((each for each in left if each is not None), default=None)


def _left_to_user() -> int | None:
    most = resource.getrlimit(resource.RLIMIT_NPROC)[0]
    if most == resource.RLIM_INFINITY or os.getuid() == 0:
        return None
    if int(_status(Path("/proc/self")).get("CapEff", "0"), 16) & PRIVILEGES:
        return None
    processes = [_status(path) for path in Path("/proc").glob("[0-9]*")]
    if not processes:
        return None  # another system than Linux
    user = str(os.getuid())
    return most - sum(
        int(process["Threads"]) for process in processes
        if process.get("Uid", "").partition("\t")[0] == user
    )


def _status(process: Path) -> dict[str, str]:
    lines = text_of(process / "status").splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


# --------------------------------------------------------------------------------------------------
# Whether the workers of a cluster that is running can compute a pipeline as this process would.

class WorkerIdentity(NamedTuple):
    """What the numbers of a process depend on, and which process it is."""

    versions: dict[str, Any]
    process: tuple[str, int]
    lacking_plugins: list[str]
    processor: str


def check_workers(client: Client, pipeline: Pipeline, argument: str, value: str) -> None:
    """Check that workers have the versions that this process has, and processes of their own.

    A line says if their processors have different features, which the last bits of results, and
    some corners by whole pixels, depend on. Workers that are stalled are left out: a worker that
    was not checked compares its versions with the store's when it gets its first block.

    Parameters
    ----------
    client
        A client of a scheduler that has workers.
    pipeline
        The pipeline; the digests of the files that it refers to are compared too.
    argument, value
        The argument by which the cluster was given, for messages.

    Raises
    ------
    ArgumentError
        If a worker has other versions, cannot import this package, or is a thread of this process;
        if none answers, or the scheduler went away.
    """
    own = _worker_identity(pipeline)
    try:
        identities = client.sync(_worker_identities, client, pipeline)
    except TimeoutError:
        raise ArgumentError(
            argument, value, f"none of its workers answers within {VERSIONS_S:.0f} s"
        ) from None
    except OSError:
        raise ArgumentError(argument, value, "the scheduler went away") from None
    except Exception as error:
        raise ArgumentError(
            argument, value, f"its workers cannot run sweep: {error}; install it there"
        ) from None
    if any(worker.process == own.process for worker in identities.values()):
        raise ArgumentError(
            argument, value,
            "its workers are threads of this process, which a scene may end; "
            "start it with processes=True",
        )
    lines = sorted(
        f"  {address}: {key} {theirs}, here {ours}"
        for address, worker in identities.items()
        for key, theirs, ours in changes({"builds": {}, **worker.versions}, own.versions)
    )
    lines += sorted(
        f"  {address}: {line}"
        for address, worker in identities.items() for line in worker.lacking_plugins
    )
    if lines:
        raise ArgumentError(
            argument, value,
            "workers with other versions; install the same everywhere\n" + "\n".join(lines),
        )
    used = Counter(worker.processor for worker in identities.values())
    for line in differing_processors(used, "workers"):
        notice(f"warning: {line}")


def _worker_identity(pipeline: Pipeline) -> WorkerIdentity:
    """Return what numbers depend on in this process."""
    return WorkerIdentity(
        fingerprint(pipeline), (socket.gethostname(), os.getpid()),
        lacking_plugins(pipeline.plugins, pipeline.folder), processor(),
    )


async def _worker_identities(
    client: Client, pipeline: Pipeline
) -> dict[str, WorkerIdentity]:
    """Return :func:`_worker_identity` of each worker by address; not of those that are stalled."""
    questions = [
        asyncio.ensure_future(client.run(_worker_identity, pipeline, workers=[worker]))
        for worker in await client.nthreads()
    ]
    if not questions:
        raise TimeoutError
    done, _ = await asyncio.wait(
        questions, timeout=VERSIONS_S, return_when=asyncio.FIRST_COMPLETED
    )
    if not done:
        for question in questions:
            question.cancel()
        raise TimeoutError
    done, late = await asyncio.wait(questions, timeout=ANSWER_S)
    for question in late:
        question.cancel()
    identities = {}
    for question in done:
        try:
            identities.update(question.result())
        except OSError:
            if client.status != "running":
                raise
            # The worker left meanwhile, as those of a cluster that adapts to its work do.
    return identities


# --------------------------------------------------------------------------------------------------
# The cluster that computes blocks: embedded, by a scheduler's address, or the caller's own.
#
# The caller's process is left as it was: an embedded cluster's settings hold while it runs,
# Dask's loggers are silenced while this package's own client lives, and a client or cluster of
# the caller is only used. No client here becomes Dask's default.

try:
    import dask
    from distributed import Client, LocalCluster, fire_and_forget
except (ValueError, TypeError, KeyError, AttributeError) as error:
    # Dask interprets its configuration while it is imported.
    raise RunError(
        "Dask cannot be imported with its configuration (~/.config/dask, /etc/dask, DASK_... "
        f"variables): {type(error).__name__}: {error}"
    ) from None


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
        with _interrupts_held_back():
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
        "distributed.worker.preload": ["sweep.execution.cluster"],
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
        states = worker_states(client, THREAD_COUNT_TIMEOUT_S)
        return sum(state.threads for state in states.values())
    except TimeoutError:
        return 0
    except OSError:
        raise RunError("the scheduler went away") from None


@contextlib.contextmanager
def _interrupts_held_back() -> Iterator[None]:
    """Hold Ctrl-C back: threads and processes that are started meanwhile do so for good.

    The handler of this process gets it afterwards.
    """
    start_quiet_resource_tracker()  # which would let Ctrl-C through in the thread that starts it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def silenced_dask_loggers() -> Iterator[None]:
    """Silence the loggers of Dask while the body runs: this package's errors say what matters.

    Dask gives some of the loggers below its own a level and a handler of theirs.
    """
    loggers = [
        logger for name, logger in list(logging.Logger.manager.loggerDict.items())
        if name.partition(".")[0] in ("distributed", "tornado", "asyncio")
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


# --------------------------------------------------------------------------------------------------
# What an embedded cluster's workers run when they start, as a "preload" of Dask.

SCORE = 500
"""The client, whose process is the scheduler's, too, has 0; a child of a worker has 1,000."""


def dask_setup(worker: object) -> None:  # noqa: ARG001  (Dask's name and arguments)
    """Have a worker killed rather than the client if memory runs out, and ignore Ctrl-C.

    That is the client's to act on. A worker that is started in the place of another has not
    inherited it.
    """
    be_killed_before_others(SCORE)
    if in_main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
