"""The lock of a store: who may change and delete it.

Writing a block twice is harmless, and so is closing a store twice, so that writers exclude nobody.
What takes something away (deleting the store, another rule, blocks that are dropped) is refused
while a process writes.

A local store's lock is that of its folder (``flock``), which the kernel releases if a process
dies; where a file system has none, a line says so. On an object store, each process that
writes or changes has a key, whose time it renews: one that is out of date is a dead process's.
Everybody looks for others' keys after writing the own one, so that of two at least one sees the
other.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import threading
import time
import uuid
from collections.abc import Iterator
from functools import partial

from zarr.abc.store import Store
from zarr.storage import LocalStore

from sweep.errors import StoreError
from sweep.messages import notice
from sweep.store.files import RECEIPTS, delete_files, list_folder, read_files, write_files
from sweep.store.locations import translate_errors

#: Folder of the keys of a store on an object store.
LOCKS = f"{RECEIPTS}/locks"

#: How long a lock is waited for: `status` holds one for an instant.
WAIT_S = 2.0

#: Seconds after which a key's process is taken for dead.
SILENCE_S = 120.0

#: What file systems without locks of folders answer.
NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL, errno.EBADF}


@contextlib.contextmanager
def held(url: str, storage: Store, *, alone: bool) -> Iterator[None]:
    """Hold the lock of a store: alone, or beside others that do not want it alone.

    Raises
    ------
    StoreError
        If another process writes it; beside others, if one holds it alone.
    """
    with contextlib.ExitStack() as stack:
        with translate_errors(url, "written"):
            try:
                stack.enter_context(
                    _folder_locked(storage, WAIT_S, alone=alone)
                    if isinstance(storage, LocalStore) else _key(storage, alone=alone))
            except BlockingIOError:
                raise StoreError(
                    f"{url}: another process is writing it; wait for it, or choose another --store"
                ) from None
            except OSError as error:
                if error.errno not in NO_LOCKS:
                    raise
                notice(f"{url}: its file system has no locks: keep others from deleting the store")
        yield


#: Have changes of a store refused, while this process writes its blocks.
writing = partial(held, alone=False)

#: Hold a store alone, to delete it or to change what others rely on.
changing = partial(held, alone=True)


def is_written(storage: Store) -> bool:
    """Return whether a process writes a store; False where that is not known."""
    if not isinstance(storage, LocalStore):
        return bool(_living(storage))
    try:
        with _folder_locked(storage, 0.0, alone=True):
            return False
    except OSError as error:
        return isinstance(error, BlockingIOError)


@contextlib.contextmanager
def _folder_locked(storage: Store, wait_s: float, *, alone: bool) -> Iterator[None]:
    """Hold a lock of a local store's folder; BlockingIOError if others hold it for long."""
    how = fcntl.LOCK_EX if alone else fcntl.LOCK_SH
    descriptor = os.open(storage.root, os.O_RDONLY | os.O_DIRECTORY)  # type: ignore[attr-defined]
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
        yield
    finally:
        os.close(descriptor)


#: How keys of processes begin that hold a store alone.
CHANGE = f"{LOCKS}/change-"


@contextlib.contextmanager
def _key(storage: Store, *, alone: bool) -> Iterator[None]:
    """Hold a key of this process; BlockingIOError if another one has one that excludes it."""
    key = f"{CHANGE if alone else f'{LOCKS}/write-'}{uuid.uuid4().hex}"
    ended = threading.Event()

    def renew() -> None:
        while not ended.wait(SILENCE_S / 6):
            with contextlib.suppress(Exception):  # a server that is away; the next time
                write_files(storage, {key: str(time.time()).encode()})

    write_files(storage, {key: str(time.time()).encode()})
    thread = threading.Thread(target=renew, daemon=True)
    thread.start()
    try:
        living = _living(storage)
        if key not in living:
            raise OSError("its listing of files lacks one that was just written")
        others = living - {key}
        if (alone and others) or any(other.startswith(CHANGE) for other in others):
            raise BlockingIOError
        yield
    finally:
        ended.set()
        thread.join()
        with contextlib.suppress(Exception):  # with its store
            delete_files(storage, [key])


def _living(storage: Store) -> set[str]:
    """Return the keys of processes that wrote them a short while ago."""
    keys = [f"{LOCKS}/{name}" for name in list_folder(storage, LOCKS)]
    oldest = time.time() - SILENCE_S
    return {
        key for key, content in zip(keys, read_files(storage, keys), strict=True)
        if content and float(content) > oldest
    }
