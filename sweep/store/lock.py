"""The lock of a store: who may create, close, change and delete it.

Writing a block twice is harmless, so that writers exclude nobody. What changes a store as a whole
(deleting it, another rule, blocks that are dropped) is refused while a process writes, and closing
it is done by one process at a time.

A local store's locks are those of its folders (``flock``), which the kernel releases if a process
dies. On S3 a key is created exclusively for the short time of a change, and each writer has a key
that it writes again and again; keys that stay silent are those of processes that died. Elsewhere
(file systems without locks of folders, other object stores) nothing is excluded.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from zarr.abc.store import Store
from zarr.storage import FsspecStore, LocalStore

from sweep.errors import StoreError
from sweep.store.files import delete_files, sync, write_files
from sweep.store.layout import RECEIPTS
from sweep.store.locations import translate_errors

LOCKS = f"{RECEIPTS}/locks"
"""Folder of the keys of a store on S3."""

CHANGE = f"{LOCKS}/change"
"""Key of the process that changes or closes a store on S3."""

WAIT_S = 2.0
"""How long a change waits for writers: `status` holds a lock for an instant."""

CLOSING_S = 600.0
"""How long a process waits for another one that closes the store."""

SILENCE_S = 120.0
"""Seconds after which a key on S3 is taken for that of a process that died."""

LOOK_S = 0.5
"""Seconds between two looks at it."""

REFUSED_CODES = {"PreconditionFailed", "ConditionalRequestConflict", "409", "412"}
"""What an S3 server answers if the key exists."""


@contextlib.contextmanager
def writing(url: str, storage: Store) -> Iterator[None]:
    """Have changes of a store refused, while this process writes its blocks."""
    held = _writer_key(storage) if _is_s3(storage) else _folder_locked(
        storage, "", fcntl.LOCK_SH, WAIT_S)
    with _told(url, held):
        yield


@contextlib.contextmanager
def changing(url: str, storage: Store) -> Iterator[None]:
    """Hold a store alone, to delete it or to change what others rely on.

    Raises
    ------
    StoreError
        If another process writes it.
    """
    held = _change_key(storage) if _is_s3(storage) else _folder_locked(
        storage, "", fcntl.LOCK_EX, WAIT_S)
    with _told(url, held):
        if _is_s3(storage) and _writers(storage):
            raise _refusal(url)
        yield


@contextlib.contextmanager
def closing(url: str, storage: Store) -> Iterator[None]:
    """Close a store alone, after another process that does; also beside its writers."""
    held = _change_key(storage) if _is_s3(storage) else _folder_locked(
        storage, "commits", fcntl.LOCK_EX, CLOSING_S)
    with _told(url, held):
        yield


def is_written(storage: Store) -> bool:
    """Return whether a process writes a store; False where that is not known."""
    if _is_s3(storage):
        return _writers(storage)
    try:
        with _folder_locked(storage, "", fcntl.LOCK_EX, 0.0):
            return False
    except BlockingIOError:
        return True
    except OSError:
        return False


@contextlib.contextmanager
def _told(url: str, held: contextlib.AbstractContextManager[None]) -> Iterator[None]:
    """Hold a lock; say in a line if it cannot be had."""
    with contextlib.ExitStack() as stack:
        with translate_errors(url, "written"):
            try:
                stack.enter_context(held)
            except BlockingIOError:
                raise _refusal(url) from None
        yield


def _refusal(url: str) -> StoreError:
    return StoreError(
        f"{url}: another process is writing it; wait for it, or choose another --store")


# Folders of this machine


@contextlib.contextmanager
def _folder_locked(storage: Store, folder: str, how: int, wait_s: float) -> Iterator[None]:
    """Hold a lock of a local store's folder; BlockingIOError if others hold it for long."""
    if not isinstance(storage, LocalStore):
        yield
        return
    descriptor = os.open(Path(storage.root, folder), os.O_RDONLY | os.O_DIRECTORY)
    try:
        deadline = time.monotonic() + wait_s
        while True:
            try:
                fcntl.flock(descriptor, how | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise
                time.sleep(0.005)
            except OSError:
                break  # a file system without locks of folders
        yield
    finally:
        os.close(descriptor)


# Keys on S3
#
# A writer writes its key and then looks for a change; who changes the store creates its key and
# then looks for writers. Listings are consistent, so that one of the two sees the other.


def _is_s3(storage: Store) -> bool:
    return isinstance(storage, FsspecStore) and hasattr(storage.fs, "_call_s3")


@contextlib.contextmanager
def _writer_key(storage: Store) -> Iterator[None]:
    """Hold a key of this writer on S3, once nobody changes the store."""
    key = f"{LOCKS}/{uuid.uuid4().hex}"
    write_files(storage, {key: b"{}"})
    with _renewed(storage, key):
        while _silences(storage).get(CHANGE, SILENCE_S) < SILENCE_S:
            time.sleep(LOOK_S)
        yield


@contextlib.contextmanager
def _change_key(storage: Store) -> Iterator[None]:
    """Hold the key of a change on S3, after whoever holds it; one of a dead process is replaced."""
    while not sync(_create(storage)):
        if _silences(storage).get(CHANGE, 0.0) > SILENCE_S:
            delete_files(storage, [CHANGE])
        time.sleep(LOOK_S)
    with _renewed(storage, CHANGE):
        yield


@contextlib.contextmanager
def _renewed(storage: Store, key: str) -> Iterator[None]:
    """Write a key again from time to time, and delete it in the end."""
    ended = threading.Event()

    def renew() -> None:
        while not ended.wait(SILENCE_S / 6):
            with contextlib.suppress(Exception):  # a server that is away; the next time
                write_files(storage, {key: b"{}"})

    thread = threading.Thread(target=renew, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        with contextlib.suppress(Exception):  # with its store
            delete_files(storage, [key])


def _writers(storage: Store) -> bool:
    """Return whether a writer's key on S3 was written a short while ago."""
    return any(silent_s < SILENCE_S for key, silent_s in _silences(storage).items()
               if key != CHANGE)


def _silences(storage: Store) -> dict[str, float]:
    """Return the keys that are held on S3, and for how many seconds each was not written."""
    system: Any = storage.fs  # type: ignore[attr-defined]
    root: str = storage.path  # type: ignore[attr-defined]

    async def listed() -> dict[str, Any]:
        return dict(await system._find(f"{root}/{LOCKS}", detail=True, refresh=True))  # noqa: SLF001

    now = time.time()
    return {path.removeprefix(f"{root}/"): now - entry["LastModified"].timestamp()
            for path, entry in sync(listed()).items() if "LastModified" in entry}


async def _create(storage: Any) -> bool:
    """Have an S3 server write the key if it does not exist; return whether it did."""
    system: Any = storage.fs
    bucket, key, _ = system.split_path(f"{storage.path}/{CHANGE}")
    try:
        await system._call_s3(  # noqa: SLF001  (nothing public awaits with conditions)
            "put_object", Bucket=bucket, Key=key, Body=b"{}", IfNoneMatch="*")
    except Exception as error:
        answer = getattr(error.__cause__ or error, "response", None) or {}
        code = answer.get("Error", {}).get("Code")
        if code in REFUSED_CODES:
            return False
        if code == "NotImplemented" or isinstance(error, NotImplementedError):
            return True  # a server without conditions excludes nobody
        raise
    return True
