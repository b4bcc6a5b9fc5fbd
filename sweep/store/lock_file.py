"""The lock's file, changed only by comparison: a new content replaces the one that was expected.

Of several processes that expect the same content, one succeeds. On a local file system the
comparison and the change are made under an exclusive `flock` of the store's folder, which the
kernel releases if the process dies. An S3 server compares (``If-None-Match``, ``If-Match``).
Elsewhere (network file systems without `flock` of folders, other object stores, servers that ignore
these headers) a new file is linked exclusively, or written, and read again after a while.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from zarr.buffer import cpu
from zarr.storage import FsspecStore, LocalStore

from sweep.store.checksums import DigestingStore
from sweep.store.zarr_sync import sync

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

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

    def __init__(self, storage: DigestingStore, key: str) -> None:
        self._storage, self._key = storage, key

    def read(self) -> bytes | None:
        """Return the content; None if there is none."""
        return self._storage.contents([self._key])[0]

    def exchange(self, expected: bytes | None, content: bytes | None) -> bool:
        """Replace the content if it is the expected one; None stands for no file.

        Returns whether it was replaced.

        Raises
        ------
        OSError
            If the file cannot be written, or another process has been changing it for long.
        """
        below = self._storage.below
        if isinstance(below, LocalStore):
            with _exclusive(below.root) as alone:
                return self._compare_and_write(expected, content, alone=alone)
        if isinstance(below, FsspecStore) and hasattr(below.fs, "_call_s3"):
            done = sync(self._exchange_on_s3(below, expected, content))
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
