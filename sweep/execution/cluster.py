"""Where blocks are computed: an embedded cluster on this machine, or one that is running."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import logging
import os
import signal
import ssl
from collections.abc import Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from urllib.parse import urlsplit

import dask
from distributed import Client, LocalCluster, Security, fire_and_forget
from distributed.comm.core import CommClosedError, connect
from distributed.comm.registry import backends
from distributed.core import send_recv

from sweep.errors import RunError, StoreError
from sweep.isolation.child_process import SINGLE_THREADED
from sweep.isolation.interrupts import in_main_thread
from sweep.plan.experiment import Pipeline
from sweep.store.provenance import fingerprint

ANSWER_S = 10.0
"""How long a scheduler, and then its first worker, may take to answer."""

FIRST_ANSWER_S = 60.0
"""How long all workers may take to say their versions, for which they import this package."""

ASKING_S = 2.0
"""How long a run waits to hear how many workers there are."""

ENCRYPTED = ("tls://", "wss://")

WORKER_ENVIRONMENT = {
    **SINGLE_THREADED,
    "MALLOC_TRIM_THRESHOLD_": "268435456",
    "MALLOC_MMAP_THRESHOLD_": "268435456",
}
"""One thread a worker, and images' memory kept between scenes rather than given back."""

QUIET_DASK_CONFIG: dict[str, Any] = {
    "distributed.worker.memory.terminate": False,
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.tick.cycle": "3s",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.scheduler.active-memory-manager.start": False,
}
"""The cluster watches itself less often: with Dask's defaults two idle workers, their scheduler
and client take 0.12 of a core, so 0.01, and nothing here shows what is watched."""

QUIET = logging.CRITICAL


def default_workers() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def embedded(workers: int) -> Iterator[Client]:
    """Start a cluster of ``workers`` single-threaded processes on this machine; end it quietly.

    It listens on the loopback interface only.
    """
    _hush()
    settings = {"distributed.nanny.pre-spawn-environ": WORKER_ENVIRONMENT, **QUIET_DASK_CONFIG}
    # Ctrl-C reaches every process of the terminal; the workers leave it to the client.
    before = signal.getsignal(signal.SIGINT) if in_main_thread() else None
    if before is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with dask.config.set(settings):
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1",
                dashboard_address="127.0.0.1:0", silence_logs=QUIET,
                scheduler_kwargs={"dashboard": False},
            )
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)
    with cluster, Client(cluster, set_as_default=False) as client:
        # The workers import their packages while the caller measures.
        fire_and_forget(
            [client.submit(_warm, workers=[worker], pure=False) for worker in client.nthreads()]
        )
        yield client


def _warm() -> None:
    """Import what a block needs."""
    importlib.import_module("sweep.execution.block_task")


@contextlib.contextmanager
def external(address: str, pipeline: Pipeline) -> Iterator[Client]:
    """Connect to a running scheduler whose workers make the same numbers as this process.

    Where its address begins with ``tls://``, Dask's own configuration names the certificates.

    Raises
    ------
    StoreError
        Where it does not answer or refuses, has no workers, or a worker has other versions; each
        within a bounded time.
    """
    _hush()
    if not _is_address(address):
        raise StoreError(f"--scheduler {address}: expected an address such as tcp://host:8786")
    with _telling_why(address):
        # Dask's client waits without end for a handshake, so that comes first, and alone.
        kind = _apart(_kind(address))
        if kind != "Scheduler":
            raise StoreError(f"--scheduler {address}: a {kind} answers there, not a scheduler")
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER_S)
        except TimeoutError:
            raise StoreError(
                f"--scheduler {address}: no workers; start some with `dask worker {address}`"
            ) from None
        except OSError:
            raise _went_away(address) from None
        _refuse_other_versions(client, address, pipeline)
        yield client


def threads(client: Client) -> int:
    """Return how many threads the workers of a cluster have; 0 while nobody says.

    Raises
    ------
    RunError
        Where the scheduler went away.
    """
    gone = RunError("the scheduler went away")
    if client.scheduler is None or client.status != "running":
        raise gone
    try:
        counts: dict[str, int] = client.sync(client.scheduler.ncores, callback_timeout=ASKING_S)
    except TimeoutError:
        return 0  # it is stalled, or busy
    except OSError:
        raise gone from None
    return sum(counts.values())


def _is_address(address: str) -> bool:
    try:
        parts = urlsplit(address)
        return parts.scheme in backends and bool(parts.hostname and parts.port)
    except ValueError:
        return False


def _went_away(address: str) -> StoreError:
    return StoreError(f"--scheduler {address}: it went away")


async def _kind(address: str) -> str:
    """Return what answers at an address: Scheduler, Worker, Nanny."""
    options = _connection_options(address)
    async with asyncio.timeout(ANSWER_S):
        comm = await connect(address, timeout=ANSWER_S, **options)
        try:
            identity: dict[str, Any] = await send_recv(comm, op="identity")
        finally:
            comm.abort()
    return str(identity["type"])


def _apart(question: Coroutine[Any, Any, str]) -> str:
    """Return what a coroutine does, also where the caller is in an event loop, as notebooks are."""
    with ThreadPoolExecutor(1) as beside:
        return beside.submit(asyncio.run, question).result()


def _connection_options(address: str) -> dict[str, Any]:
    """Return how Dask's configuration says to connect, its certificates among it."""
    try:
        options: dict[str, Any] = Security().get_connection_args("client")
    except OSError as error:
        raise StoreError(
            f"--scheduler {address}: the certificates that Dask's configuration names under "
            f"distributed.comm.tls cannot be read: {_short(error)}"
        ) from None
    if address.startswith(ENCRYPTED) and options.get("ssl_context") is None:
        raise StoreError(
            f"--scheduler {address}: no certificates; name them in Dask's configuration, "
            "distributed.comm.tls.ca-file, .client.cert and .client.key"
        )
    return options


@contextlib.contextmanager
def _telling_why(address: str) -> Iterator[None]:
    """Raise StoreError for what goes wrong while a connection is made."""
    try:
        yield
    except (CommClosedError, ssl.SSLError, ValueError) as error:
        # Which side closes first, and with which words, is a matter of chance.
        if address.startswith(ENCRYPTED):
            why = (
                f"TLS failed ({_short(error)}); is it a TLS scheduler, and are its "
                "certificate and the one here signed by the same CA?"
            )
        else:
            why = "it closed the connection; does it expect tls://?"
    except OSError:
        why = f"no answer within {ANSWER_S:.0f} s; is `dask scheduler` running there?"
    except RuntimeError as error:
        why = str(error)  # Dask's configuration requires encryption
    else:
        return
    raise StoreError(f"--scheduler {address}: {why}") from None


def _short(error: BaseException) -> str:
    """Return what OpenSSL or the system said, in a few words."""
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


def _refuse_other_versions(client: Client, address: str, pipeline: Pipeline) -> None:
    mine = fingerprint(pipeline)
    try:
        answers = client.sync(_ask_each, client, pipeline)
    except TimeoutError:
        raise StoreError(
            f"--scheduler {address}: none of its workers answers within {FIRST_ANSWER_S:.0f} s"
        ) from None
    except OSError:
        raise _went_away(address) from None
    except Exception as error:
        raise StoreError(
            f"--scheduler {address}: its workers cannot run sweep: {error}; install it there"
        ) from None
    lines = sorted(
        f"  {worker}: {key} {theirs.get(key)}, here {mine[key]}"
        for worker, theirs in answers.items()
        for key in mine
        if theirs.get(key) != mine[key]
    )
    if lines:
        raise StoreError(
            f"--scheduler {address}: workers with other versions; install the same everywhere\n"
            + "\n".join(lines)
        )


async def _ask_each(client: Client, pipeline: Pipeline) -> dict[str, dict[str, Any]]:
    """Return the fingerprint of each worker; those that are stalled are left out.

    A worker that is not asked here compares itself with the store when it gets its first block.
    """
    asked = [
        asyncio.ensure_future(client.run(fingerprint, pipeline, workers=[worker]))
        for worker in await client.nthreads()
    ]
    if not asked:
        raise TimeoutError
    done, _ = await asyncio.wait(
        asked, timeout=FIRST_ANSWER_S, return_when=asyncio.FIRST_COMPLETED
    )
    if not done:
        for one in asked:
            one.cancel()
        raise TimeoutError
    done, late = await asyncio.wait(asked, timeout=ANSWER_S)
    for one in late:
        one.cancel()
    return {worker: theirs for one in done for worker, theirs in one.result().items()}


def _hush() -> None:
    """Keep distributed from narrating: what matters is told as errors of this package.

    Dask gives some of the loggers below its own a level and a handler of theirs.
    """
    for name in ("distributed", *logging.Logger.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(QUIET)
