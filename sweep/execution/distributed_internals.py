"""What this package uses of Dask's ``distributed`` beyond its documented interface.

Tried with version 2026.8. Everything else of this package uses public names only, so
that a new version of ``distributed`` can break a run in this module alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing.spawn
from collections.abc import Iterator
from typing import Any

from distributed import Client
from distributed.comm.addressing import parse_address
from distributed.comm.core import CommClosedError, FatalCommClosedError
from distributed.comm.registry import backends, get_backend
from distributed.core import send_recv

__all__ = [
    "CommClosedError", "is_known_protocol", "main_not_imported", "peer_type", "thread_counts",
    "worker_deaths", "worker_states", "worker_that_failed",
]


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


def thread_counts(client: Client, timeout_s: float) -> dict[str, int]:
    """Return the number of threads of each worker, by address.

    ``Client.nthreads`` returns the same, but cannot be given a timeout.

    Raises
    ------
    TimeoutError
        If the scheduler does not answer in time.
    OSError
        If the client is not connected.
    """
    counts: dict[str, int] = client.sync(_scheduler(client).ncores, callback_timeout=timeout_s)
    return counts


def worker_states(client: Client, timeout_s: float) -> dict[str, str]:
    """Return the status of each worker, by address: "running", "paused", ...

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
    return {address: str(worker["status"]) for address, worker in identity["workers"].items()}


def worker_deaths(client: Client, timeout_s: float) -> int:
    """Return how many workers went away unasked since the scheduler was started.

    Raises
    ------
    TimeoutError
        If the scheduler does not answer in time.
    OSError
        If the client is not connected.
    """
    events: list[tuple[float, Any]] = client.sync(
        _scheduler(client).events, topic="all", callback_timeout=timeout_s
    )
    return sum(
        isinstance(event, dict) and event.get("action") == "remove-worker"
        and not event.get("expected") for _, event in events
    )


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
