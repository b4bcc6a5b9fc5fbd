"""The lock of a store: one writer at a time; a stale lock is ignored."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from typing import Any

from zarr.abc.store import Store

from sweep.errors import StoreError
from sweep.store.layout import RECEIPTS
from sweep.store.lifecycle import tidy
from sweep.store.locations import translate_errors
from sweep.store.manifest import get, put
from sweep.store.run_store import RunStore
from sweep.store.zarr_sync import sync

KEY = f"{RECEIPTS}/lock.json"
BEAT_S = 5.0
"""Seconds between two heartbeats of a writer."""

SILENCE_S = 30.0
"""Seconds without a heartbeat after which a lock is stale."""


@contextlib.contextmanager
def locked(store: RunStore) -> Iterator[None]:
    """Hold a store for writing.

    Raises
    ------
    StoreError
        If another client holds it, or it cannot be written.
    """
    storage = store.storage
    refuse_if_held(store.url, storage)
    mine = {"token": uuid.uuid4().hex, "host": socket.gethostname(), "pid": os.getpid()}
    with translate_errors(store.url, "written"):
        put(storage, KEY, {**mine, "beat": time.time()})
        held = get(storage, KEY)
    if held is None or held.get("token") != mine["token"]:
        raise StoreError(_held(store.url, held or {}))
    done = threading.Event()

    def beat() -> None:
        while not done.wait(BEAT_S):
            # Whatever error a disk or a server reports now, the next beat may succeed.
            with contextlib.suppress(Exception):
                current = get(storage, KEY)
                if current is not None and current.get("token") != mine["token"]:
                    return  # taken over while this process slept
                put(storage, KEY, {**mine, "beat": time.time()})

    heart = threading.Thread(target=beat, daemon=True, name="store lock")
    heart.start()
    try:
        tidy(store)
        yield
    finally:
        done.set()
        heart.join()
        with contextlib.suppress(Exception):
            if (get(storage, KEY) or {}).get("token") == mine["token"]:
                sync(storage.delete(KEY))


def refuse_if_held(url: str, storage: Store) -> None:
    """Raise StoreError if a living client holds the store."""
    held = holder(storage)
    if held is not None:
        raise StoreError(_held(url, held))


def holder(storage: Store) -> dict[str, Any] | None:
    """Return the host and pid of the client that holds a store; None if the lock is stale."""
    held = get(storage, KEY)
    if held is None:
        return None
    # Either sign of death suffices: pids are reused, and clocks differ.
    if held.get("host") == socket.gethostname() and not _alive(held.get("pid")):
        return None
    beat = held.get("beat")
    silent = time.time() - (beat if isinstance(beat, (int, float)) else 0.0)
    return held if silent < SILENCE_S else None


def _alive(pid: Any) -> bool:
    if not isinstance(pid, int) or pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _held(url: str, held: dict[str, Any]) -> str:
    return (
        f"{url}: process {held.get('pid')} on {held.get('host')} is writing it; "
        "wait for it, or choose another --store"
    )
