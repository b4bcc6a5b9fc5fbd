"""The lock of a store: who lives, and who wins."""

from __future__ import annotations

import contextlib
import fcntl
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

from zarr.abc.store import Store
from zarr.buffer import cpu
from zarr.storage import FsspecStore, LocalStore

from sweep.errors import StoreError
from sweep.messages import notice, plain
from sweep.store.blocks import RunStore
from sweep.store.files import encoded, read_files, sync
from sweep.store.layout import RECEIPTS
from sweep.store.locations import translate_errors

# --------------------------------------------------------------------------------------------------
# The lock's file, changed only by comparison: a new content replaces the one that was expected.
#
# Of several processes that expect the same content, one succeeds. On a local file system the
# comparison and the change are made under an exclusive `flock` of the store's folder, which the
# kernel releases if the process dies. An S3 server compares (``If-None-Match``, ``If-Match``).
# Elsewhere (network file systems without `flock` of folders, other object stores, servers that
# ignore these headers) a new file is linked exclusively, or written, and read again after a
# while.

SETTLE_S = 1.0
"""Seconds after which a lock is read again where the change itself excludes nobody."""

BUSY_S = 10.0
"""Seconds that a process waits for another one that is changing the lock."""


REFUSED_CODES = {
    "PreconditionFailed", "ConditionalRequestConflict", "NoSuchKey", "404", "409", "412",
}
"""What an S3 server answers if the content is not the expected one."""


class LockFile:
    """The content of the lock's key in a storage."""

    def __init__(self, storage: Store, key: str) -> None:
        self._storage, self._key = storage, key

    def read(self) -> bytes | None:
        """Return the content; None if there is none."""
        return read_files(self._storage, [self._key])[0]

    def exchange(self, expected: bytes | None, content: bytes | None) -> bool:
        """Replace the content if it is the expected one; None stands for no file.

        Returns whether it was replaced.

        Raises
        ------
        OSError
            If the file cannot be written, or another process has been changing it for long.
        """
        storage = self._storage
        if isinstance(storage, LocalStore):
            with _exclusive(storage.root) as alone:
                return self._compare_and_write(expected, content, alone=alone)
        if isinstance(storage, FsspecStore) and hasattr(storage.fs, "_call_s3"):
            done = sync(self._exchange_on_s3(storage, expected, content))
            if done is False or content is None:
                return bool(done)
            if done:  # also true of a server that ignores the condition
                return self._is_still(content)
        return self._compare_and_write(expected, content, alone=False)

    def _compare_and_write(
        self, expected: bytes | None, content: bytes | None, *, alone: bool
    ) -> bool:
        if self.read() != expected:
            return False
        if content is None:
            with contextlib.suppress(FileNotFoundError):
                sync(self._storage.delete(self._key))
            return True
        buffer = cpu.Buffer.from_bytes(content)
        if alone:
            sync(self._storage.set(self._key, buffer))
            return True
        write = self._storage.set if expected is not None else self._storage.set_if_not_exists
        sync(write(self._key, buffer))
        return self._is_still(content)

    def _is_still(self, content: bytes) -> bool:
        time.sleep(SETTLE_S)
        return self.read() == content

    async def _exchange_on_s3(
        self, store: FsspecStore, expected: bytes | None, content: bytes | None
    ) -> bool | None:
        """Have the server compare and write; None if it cannot."""
        system: Any = store.fs
        call = system._call_s3  # noqa: SLF001  (nothing public awaits with conditions)
        bucket, key, _ = system.split_path(f"{store.path}/{self._key}")
        where = {"Bucket": bucket, "Key": key}
        condition = {"IfNoneMatch": "*"}
        if expected is not None:
            try:
                answer = await call("get_object", **where)
                if await answer["Body"].read() != expected:
                    return False
            except FileNotFoundError:
                return False
            condition = {"IfMatch": answer["ETag"]}
        if content is None:
            await call("delete_object", **where)
            return True
        try:
            await call("put_object", **where, Body=content, **condition)
        except Exception as error:
            answer = getattr(error.__cause__ or error, "response", None) or {}
            code = answer.get("Error", {}).get("Code")
            if code in REFUSED_CODES:
                return False
            if code == "NotImplemented" or isinstance(error, NotImplementedError):
                return None
            raise
        return True


@contextlib.contextmanager
def _exclusive(folder: Path) -> Iterator[bool]:
    """Exclude other processes and threads by a `flock`; gives False where there is none."""
    if fcntl is None:
        yield False
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        deadline = time.monotonic() + BUSY_S
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise TimeoutError(0, "another process is changing its lock") from None
                time.sleep(0.002)
                continue
            except OSError:
                yield False
                return
            yield True
            return
    finally:
        os.close(descriptor)


# --------------------------------------------------------------------------------------------------
# The lock of a store: one writer at a time; a stale lock is replaced.
#
# A writer renews its lock every few seconds. Whether it lives is judged without comparing clocks
# of two machines: on the same boot of a kernel by the process and the kernel's clock, at once;
# elsewhere by watching whether the lock changes.

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
    """Hold a store for writing.

    Raises
    ------
    StoreError
        If another client holds it, or it cannot be written.
    """
    with hold(store.url, store.storage) as lock:
        yield lock


@contextlib.contextmanager
def hold(url: str, storage: Store) -> Iterator[HeldLock]:
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


def refuse_if_held(url: str, storage: Store) -> None:
    """Raise StoreError if a living client holds the store.

    It takes up to :data:`SILENCE_S` if the lock is of another machine, or of another boot.
    """
    with translate_errors(url, "read"):
        _free(url, LockFile(storage, KEY))


def holder(storage: Store) -> Content | None:
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
    boot = lock.get("boot")
    if not boot or (boot, lock.get("namespace")) != (_boot(), _namespace()):
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
