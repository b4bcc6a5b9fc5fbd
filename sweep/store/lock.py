"""One writer a store: a lock that a dead client does not hold for ever."""

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
from zarr.core.sync import sync

from sweep.errors import StoreError
from sweep.store.layout import RECEIPTS
from sweep.store.lifecycle import RunStore, telling, tidy
from sweep.store.manifest import get, put

KEY = f"{RECEIPTS}/lock.json"
BEAT_S = 5.0
"""How often a writer says that it lives."""

SILENCE_S = 30.0
"""After this long without a word a writer is taken for dead."""


@contextlib.contextmanager
def locked(store: RunStore) -> Iterator[None]:
    """Hold a store for writing.

    Raises
    ------
    StoreError
        Where another living client holds it, or it cannot be written.
    """
    place = store.place
    refuse_if_held(store.url, place)
    mine = {"token": uuid.uuid4().hex, "host": socket.gethostname(), "pid": os.getpid()}
    with telling(store.url, "written"):
        put(place, KEY, {**mine, "beat": time.time()})
        held = get(place, KEY)
    if held is None or held.get("token") != mine["token"]:
        raise StoreError(_held(store.url, held or {}))
    done = threading.Event()

    def beat() -> None:
        while not done.wait(BEAT_S):
            # Whatever a disk or a server says now, the next beat may be heard.
            with contextlib.suppress(Exception):
                now = get(place, KEY)
                if now is not None and now.get("token") != mine["token"]:
                    return  # taken over while this process slept
                put(place, KEY, {**mine, "beat": time.time()})

    heart = threading.Thread(target=beat, daemon=True, name="store lock")
    heart.start()
    try:
        tidy(store)
        yield
    finally:
        done.set()
        heart.join()
        with contextlib.suppress(Exception):
            if (get(place, KEY) or {}).get("token") == mine["token"]:
                sync(place.delete(KEY))


def refuse_if_held(url: str, place: Store) -> None:
    """Raise StoreError where a living client writes the store."""
    held = holder(place)
    if held is not None:
        raise StoreError(_held(url, held))


def holder(place: Store) -> dict[str, Any] | None:
    """Return who holds a store: host and pid; None where nobody living does."""
    held = get(place, KEY)
    if held is None:
        return None
    # Either sign of death will do: a number is soon another process', and clocks differ.
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
        "wait for it, or take another --store"
    )
