"""A client of a running scheduler by its address, within a bounded time."""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from collections.abc import Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from urllib.parse import urlsplit

from distributed import Client, Security

from sweep.errors import ArgumentError
from sweep.execution.distributed_internals import CommClosedError, is_known_protocol, peer_type
from sweep.execution.limits import ANSWER_S

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
