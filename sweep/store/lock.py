"""The lock of a store: one writer at a time; a stale lock is replaced.

A writer renews its lock every few seconds. Whether it lives is judged without comparing clocks of
two machines: on the same boot of a kernel by the process and the kernel's clock, at once; elsewhere
by watching whether the lock changes.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from sweep.errors import StoreError
from sweep.messages import notice, plain
from sweep.store.checksums import DigestingStore
from sweep.store.layout import RECEIPTS
from sweep.store.locations import translate_errors
from sweep.store.lock_file import LockFile
from sweep.store.manifest import encoded
from sweep.store.run_store import RunStore
from sweep.store.tidying import tidy

KEY = f"{RECEIPTS}/lock.json"

BEAT_S = 5.0
"""Seconds between two heartbeats of a writer."""

SILENCE_S = 30.0
"""Seconds without a heartbeat after which a lock is stale."""

WATCH_S = 0.5
"""Seconds between two looks at a lock that is watched."""

Content = dict[str, Any]

_unchanged: dict[str, tuple[bytes, float]] = {}
"""Store -> a lock that did not change while it was watched, and when it was first seen."""


class HeldLock:
    """A lock that this process holds, with the thread that renews it."""

    def __init__(self, url: str, file: LockFile, token: str, since: float) -> None:
        self._url, self._file, self._token, self._since = url, file, token, since
        self._renewed = time.monotonic()
        self._lost = False
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True, name="store lock")
        self._thread.start()

    def check(self, *, now: bool = False) -> None:
        """Raise StoreError if another process took the lock over while this one was silent.

        The file is read only if ``now`` is set, or this process missed a heartbeat.
        """
        if now or time.monotonic() > self._renewed + 2 * BEAT_S:
            with translate_errors(self._url, "read"):
                self._lost = self._lost or self._own() is None
        if self._lost:
            raise StoreError(
                f"{self._url}: another process took over its lock, because this one was stopped, "
                "or could not write there"
            )

    def checked(self, numbers: Iterable[int]) -> Iterator[int]:
        """Yield numbers of blocks as long as this process has the lock; then raise StoreError."""
        for number in numbers:
            self.check()
            yield number

    def release(self) -> None:
        """End the heartbeat, and delete the lock unless another process has it."""
        self._done.set()
        self._thread.join()
        with contextlib.suppress(Exception):
            own = self._own()
            if own is not None:
                self._file.exchange(own, None)

    def _own(self) -> bytes | None:
        """Return the file's content if it is this lock's."""
        content = self._file.read()
        lock = _parsed(content)
        return content if lock is not None and lock["token"] == self._token else None

    def _beat(self) -> None:
        while not self._done.wait(BEAT_S):
            # Whatever error a disk or a server reports now, the next beat may succeed.
            with contextlib.suppress(Exception):
                own = self._own()
                if own is None or not self._file.exchange(own, _content(self._token, self._since)):
                    self._lost = self._own() is None
                if self._lost:
                    return
                self._renewed = time.monotonic()


@contextlib.contextmanager
def locked(store: RunStore) -> Iterator[HeldLock]:
    """Hold a store for writing, and delete what killed writers left in it.

    Raises
    ------
    StoreError
        If another client holds it, or it cannot be written.
    """
    with hold(store.url, store.storage) as lock:
        tidy(store)
        yield lock


@contextlib.contextmanager
def hold(url: str, storage: DigestingStore) -> Iterator[HeldLock]:
    """Hold the lock of a storage, whatever else it holds.

    Raises
    ------
    StoreError
        If another client holds it, or it cannot be written.
    """
    file, token, since = LockFile(storage, KEY), uuid.uuid4().hex, time.time()
    with translate_errors(url, "written"):
        while not file.exchange(_free(url, file), _content(token, since)):
            pass  # another process was faster: it is judged in its turn
    lock = HeldLock(url, file, token, since)
    try:
        yield lock
    finally:
        lock.release()


def refuse_if_held(url: str, storage: DigestingStore) -> None:
    """Raise StoreError if a living client holds the store.

    It takes up to :data:`SILENCE_S` if the lock is of another machine, or of another boot.
    """
    with translate_errors(url, "read"):
        _free(url, LockFile(storage, KEY))


def holder(storage: DigestingStore) -> Content | None:
    """Return the host and pid of the client that seems to hold a store, None if nobody does.

    It answers at once: for another machine by its clock, which is enough to show.
    """
    lock = _parsed(LockFile(storage, KEY).read())
    alive = None if lock is None else _alive(lock)
    if lock is None or alive is False:
        return None
    return lock if alive or abs(time.time() - lock["beat"]) < SILENCE_S else None


def _free(url: str, file: LockFile) -> bytes | None:
    """Return the content of a missing or stale lock; StoreError if it is held.

    What cannot be known is watched, and that is said.
    """
    watched: bytes | None = None
    while True:
        content = file.read()
        lock = _parsed(content)
        alive = False if lock is None else _alive(lock)
        if content is None or lock is None or alive is False:
            return content
        if alive or watched not in (None, content):
            raise StoreError(_held(url, lock))
        if watched is None:
            watched = content
            if _unchanged.get(url, (b"", 0.0))[0] != content:
                _unchanged[url] = content, time.monotonic()
                notice(
                    f"{url}: process {lock['pid']} on {lock['host']} may be writing it: watching "
                    f"its lock for up to {SILENCE_S:.0f} s"
                )
        if time.monotonic() >= _unchanged[url][1] + SILENCE_S:
            return content
        time.sleep(WATCH_S)


def _content(token: str, since: float = 0.0) -> bytes:
    """Return a lock that this process holds since a time (seconds since 1970), renewed now."""
    return encoded({
        "token": token, "host": socket.gethostname(), "pid": os.getpid(), "boot": _boot(),
        "namespace": _namespace(), "started": _started(os.getpid()),
        "beat": time.time(), "clock": time.monotonic(), "since": since,
    })


def _parsed(content: bytes | None) -> Content | None:
    """Return a lock's content; None for what is no lock."""
    try:
        lock = json.loads(content or b"")
    except (ValueError, RecursionError):
        return None
    valid = (
        isinstance(lock, dict)
        and isinstance(lock.get("token"), str)
        and isinstance(lock.get("host"), str)
        and type(lock.get("pid")) is int and lock["pid"] > 0
        and type(lock.get("beat")) in (int, float) and math.isfinite(lock["beat"])
        and type(lock.get("clock", 0.0)) in (int, float)
        and type(lock.get("since", 0.0)) in (int, float)
    )
    return lock if valid else None


def _alive(lock: Content) -> bool | None:
    """Return whether a lock's process lives and renews it; None if it cannot be known from here."""
    if "boot" not in lock:  # of version 0.6 or before
        if lock["host"] != socket.gethostname():
            return None
        if not _exists(lock["pid"]):
            return False
        return True if abs(time.time() - lock["beat"]) < SILENCE_S else None
    if not lock["boot"] or (lock["boot"], lock.get("namespace")) != (_boot(), _namespace()):
        return None
    started = _started(lock["pid"]) or (lock.get("started") if _exists(lock["pid"]) else None)
    if lock.get("started") != started:
        return False
    return bool(0 <= time.monotonic() - lock.get("clock", 0.0) < SILENCE_S)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _boot() -> str:
    """Return the id of this boot of the kernel; empty if there is none."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return ""


def _namespace() -> int:
    """Return the number of this process' namespace of pids; 0 if there is none."""
    with contextlib.suppress(OSError):
        return Path("/proc/self/ns/pid").stat().st_ino
    return 0


def _started(pid: int) -> str:
    """Return when a process started, in ticks since boot; empty if there is none."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        # The fields after the command's name, which may hold anything.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    return ""


def _held(url: str, lock: Content) -> str:
    return (
        f"{url}: process {lock['pid']} on {plain(lock['host'])} is writing it; "
        "wait for it, or choose another --store"
    )
