"""The cluster of a run, where it is not this machine alone: a scheduler, or a client of the user's.

The caller's process is left as it was: Dask's loggers are silenced while this package's own client
lives, and a client or cluster of the caller is only used. No client here becomes Dask's default.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import ssl
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol, runtime_checkable
from urllib.parse import urlsplit

from sweep.errors import ArgumentError, RunError
from sweep.evaluation.machine_faults import exception_line
from sweep.execution.limits import (
    ANSWER_S,
    NO_WORKERS_TIMEOUT_S,
    THREAD_COUNT_TIMEOUT_S,
    VERSIONS_S,
)
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.plugins import lacking_plugins
from sweep.messages import notice
from sweep.processor import differing_processors, processor
from sweep.store.provenance import changes, fingerprint

try:
    from distributed import Client, Security, rpc
    from distributed.comm.core import CommClosedError
    from distributed.comm.registry import backends
except (ValueError, TypeError, KeyError, AttributeError) as error:
    # Dask interprets its configuration while it is imported.
    raise RunError(
        "Dask cannot be imported with its configuration (~/.config/dask, /etc/dask, DASK_... "
        f"variables): {type(error).__name__}: {error}"
    ) from None


@runtime_checkable
class Cluster(Protocol):
    """A cluster object: LocalCluster, SLURMCluster, KubeCluster, ..."""

    @property
    def scheduler_address(self) -> str:
        """The address of its scheduler."""


@contextlib.contextmanager
def connected(
    pipeline: Pipeline, scheduler: str | None, client: Client | Cluster | None
) -> Iterator[Client]:
    """Return a client of a cluster whose workers make the same numbers as this process.

    Parameters
    ----------
    pipeline
        What is to be computed.
    scheduler
        Address of a running scheduler; None if a client is given.
    client
        The caller's client, which stays open, or cluster object, of which a client is made and
        closed.

    Raises
    ------
    ArgumentError
        If the cluster cannot be used: it does not answer or refuses, is closed or asynchronous, has
        no workers, or a worker has other versions; each within a bounded time.
    """
    with contextlib.ExitStack() as stack:
        if scheduler is not None:
            argument, name = "scheduler", scheduler
            stack.enter_context(silenced_dask_loggers())
            connection = stack.enter_context(connect_to_scheduler(scheduler))
        else:
            argument, name = "client", _name(client)
            connection = _client_of(client, name, stack)
        _await_worker(connection, argument, name)
        check_workers(connection, pipeline, argument, name)
        yield connection


def _name(client: object) -> str:
    """Return what a message calls a client or cluster: its type, and the scheduler's address."""
    scheduler = client.scheduler if isinstance(client, Client) else (
        getattr(client, "scheduler_address", client))
    return f"{type(client).__name__}({getattr(scheduler, 'address', scheduler)})"


def _client_of(client: object, name: str, stack: contextlib.ExitStack) -> Client:
    """Return the caller's client, or a new one of the caller's cluster object."""
    if isinstance(client, str) or not isinstance(client, (Client, Cluster)):
        raise ArgumentError(
            "client", client,
            "expected a distributed.Client or a cluster object such as LocalCluster; "
            "the address of a scheduler is given as scheduler",
        )
    if getattr(client, "asynchronous", False):
        raise ArgumentError("client", name, "it is asynchronous; expected one that is not")
    state = getattr(client, "status", "running")
    state = getattr(state, "name", state)  # a cluster's status is an Enum
    if state in ("closing", "closed", "failed"):
        raise ArgumentError("client", name, f"it is {state}")
    if isinstance(client, Client):
        return client
    try:
        connection: Client = stack.enter_context(
            Client(client, timeout=ANSWER_S, set_as_default=False))
    except (OSError, RuntimeError, ValueError) as error:
        raise ArgumentError("client", name, f"cannot connect: {error}") from None
    return connection


def _await_worker(client: Client, argument: str, name: str) -> None:
    """Wait for a worker by submitting a task, so that a cluster that adapts to work starts one."""
    # Who names a scheduler has started workers; a cluster object may have to.
    wait_s = ANSWER_S if argument == "scheduler" else NO_WORKERS_TIMEOUT_S
    task = client.submit(os.getpid, pure=False)
    try:
        task.result(timeout=wait_s)
    except TimeoutError:
        raise ArgumentError(
            argument, name,
            f"no workers within {wait_s:.0f} s; start some, as with `dask worker ADDRESS`"
        ) from None
    except Exception as error:
        raise ArgumentError(
            argument, name, f"its workers compute nothing: {exception_line(error)}") from None
    finally:
        task.cancel()


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
        raise ArgumentError("scheduler", address, "expected an address such as tcp://host:8786")
    try:
        # Dask's client waits without end for a handshake, so that comes first, and alone; in a
        # thread, for the caller may be in an event loop, as notebooks are.
        with ThreadPoolExecutor(1) as thread:
            peer = thread.submit(asyncio.run, _peer(address)).result()
        if peer == "Scheduler":
            return Client(address, timeout=ANSWER_S, set_as_default=False)
        reason = f"a {peer} answers there, not a scheduler"
    except TimeoutError:
        reason = f"no answer within {ANSWER_S:.0f} s; is `dask scheduler` running there?"
    except (OSError, ValueError, RuntimeError) as error:
        reason = f"cannot connect: {_short_reason(error)}"
        if address.startswith(ENCRYPTED):
            reason += (
                "; is it a TLS scheduler, and does Dask's configuration, distributed.comm.tls, "
                "name certificates that the same CA signed?"
            )
        elif isinstance(error, CommClosedError):
            reason += "; does it expect tls://?"
    raise ArgumentError("scheduler", address, reason) from None


def _is_address(address: str) -> bool:
    try:
        parts = urlsplit(address)
        return parts.scheme in backends and bool(parts.hostname and parts.port)
    except ValueError:
        return False


async def _peer(address: str) -> str:
    """Return the type of server at an address: Scheduler, Worker, Nanny."""
    options = Security().get_connection_args("client")
    async with asyncio.timeout(ANSWER_S), rpc(address, connection_args=options) as server:
        identity: dict[str, Any] = await server.identity()
    return str(identity["type"])


def _short_reason(error: BaseException) -> str:
    """Return the message of OpenSSL or of the operating system, in a few words."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ssl.SSLCertVerificationError):
            return str(cause.verify_message)
        if isinstance(cause, ssl.SSLError) and cause.reason:
            return cause.reason.lower().replace("_", " ")
        cause = cause.__cause__ or cause.__context__
    return exception_line(error)


# --------------------------------------------------------------------------------------------------
# Workers: how many threads they have, and whether they compute a pipeline as this process would.

class WorkerState(NamedTuple):
    """A worker's number of threads, and its status: "running", "paused", ..."""

    threads: int
    status: str


def worker_states(client: Client) -> dict[str, WorkerState] | None:
    """Return the state of each worker, by address; None if the scheduler is too busy to answer.

    Raises
    ------
    RunError
        If the scheduler went away.
    """
    try:
        if client.scheduler is None or client.status != "running":
            raise CommClosedError("not connected")
        identity: dict[str, Any] = client.sync(
            client.scheduler.identity, n_workers=-1, callback_timeout=THREAD_COUNT_TIMEOUT_S)
    except TimeoutError:
        return None
    except OSError:
        raise RunError("the scheduler went away") from None
    return {
        address: WorkerState(int(worker["nthreads"]), str(worker["status"]))
        for address, worker in identity["workers"].items()
    }


def thread_count(client: Client) -> int:
    """Return how many threads the workers of a cluster have, at least 1."""
    return max(sum(state.threads for state in (worker_states(client) or {}).values()), 1)


def worker_that_failed(client: Client, key: str) -> str:
    """Return the address of the worker on which a task raised; empty if the scheduler tells none.

    A task whose arguments could not even be unpickled raised, too.
    """
    try:
        addresses: list[str] = client.run_on_scheduler(
            lambda dask_scheduler: sorted(dask_scheduler.tasks[key].erred_on or ())
        )
    except Exception:
        return ""  # it may be configured to unpickle nothing
    return addresses[-1] if addresses else ""


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
