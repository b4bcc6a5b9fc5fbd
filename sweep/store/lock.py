"""The locks of a store: who may create, close, change and delete it.

Writing a block twice is harmless, so that writers exclude nobody. What changes a store as a whole
(deleting it, another rule, blocks that are dropped) is refused while a process of a local store
writes, and closing it is done by one process at a time.

A local store's locks are those of its folders (``flock``), which the kernel releases if a process
dies. On S3 a key is created exclusively for the short time of a change; writers are not seen there,
but find that their store was deleted. Elsewhere (file systems without locks of folders, other
object stores) nothing is excluded.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from zarr.abc.store import Store
from zarr.storage import FsspecStore, LocalStore

from sweep.errors import StoreError
from sweep.store.files import delete_files, read_files, sync
from sweep.store.layout import RECEIPTS
from sweep.store.locations import translate_errors

KEY = f"{RECEIPTS}/lock.json"
"""Where the lock of a change lies on S3."""

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
    """Have changes of a local store refused, while this process writes its blocks."""
    with _locked(url, storage, "", fcntl.LOCK_SH, WAIT_S):
        yield


@contextlib.contextmanager
def changing(url: str, storage: Store) -> Iterator[None]:
    """Hold a store alone, to delete it or to change what others rely on.

    Raises
    ------
    StoreError
        If another process writes it.
    """
    with _locked(url, storage, "", fcntl.LOCK_EX, WAIT_S):
        yield


@contextlib.contextmanager
def closing(url: str, storage: Store) -> Iterator[None]:
    """Close a store alone, after another process that does; also beside its writers."""
    with _locked(url, storage, "commits", fcntl.LOCK_EX, CLOSING_S):
        yield


def is_written(storage: Store) -> bool:
    """Return whether a process writes a local store; False elsewhere, where that is not known."""
    try:
        with _folder_locked(storage, "", fcntl.LOCK_EX, 0.0):
            return False
    except BlockingIOError:
        return True
    except OSError:
        return False


@contextlib.contextmanager
def _locked(url: str, storage: Store, folder: str, how: int, wait_s: float) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        with translate_errors(url, "written"):
            if isinstance(storage, LocalStore):
                try:
                    stack.enter_context(_folder_locked(storage, folder, how, wait_s))
                except BlockingIOError:
                    raise StoreError(
                        f"{url}: another process is writing it; wait for it, or choose another "
                        "--store"
                    ) from None
            elif how == fcntl.LOCK_EX:
                stack.enter_context(_key_created(storage))
        yield


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


@contextlib.contextmanager
def _key_created(storage: Store) -> Iterator[None]:
    """Hold the lock's key on S3, after whoever holds it; one that stays the same is replaced."""
    if not isinstance(storage, FsspecStore) or not hasattr(storage.fs, "_call_s3"):
        yield
        return
    token = uuid.uuid4().hex.encode()
    seen, since = None, time.monotonic()
    while not sync(_create(storage, token)):
        content = read_files(storage, [KEY])[0]
        if content != seen:
            seen, since = content, time.monotonic()
        elif time.monotonic() > since + SILENCE_S:
            delete_files(storage, [KEY])
        time.sleep(LOOK_S)
    try:
        yield
    finally:
        with contextlib.suppress(Exception):  # with its store, or taken over
            if read_files(storage, [KEY])[0] == token:
                delete_files(storage, [KEY])


async def _create(storage: FsspecStore, content: bytes) -> bool:
    """Have an S3 server write the key if it does not exist; return whether it did."""
    system: Any = storage.fs
    bucket, key, _ = system.split_path(f"{storage.path}/{KEY}")
    try:
        await system._call_s3(  # noqa: SLF001  (nothing public awaits with conditions)
            "put_object", Bucket=bucket, Key=key, Body=content, IfNoneMatch="*")
    except Exception as error:
        answer = getattr(error.__cause__ or error, "response", None) or {}
        code = answer.get("Error", {}).get("Code")
        if code in REFUSED_CODES:
            return False
        if code == "NotImplemented" or isinstance(error, NotImplementedError):
            return True  # a server without conditions excludes nobody
        raise
    return True
