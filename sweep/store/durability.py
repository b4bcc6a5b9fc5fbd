"""A local storage whose contents survive a power failure.

A file is flushed before it gets its name, and then the folders that lead to it, so that what was
written earlier is on the disk before what is written later. Chunks of variables are many: theirs
are flushed together by :meth:`DurableStore.flush`, before the receipt that speaks of them.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import uuid
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from zarr.abc.buffer import Buffer
from zarr.storage import LocalStore

from sweep.store.layout import RECEIPTS

THREADS = 8
"""Files that are flushed at a time: a file system writes them to its journal together."""

NEVER_FLUSHED = (f"{RECEIPTS}/begun/", f"{RECEIPTS}/lock.json")
"""Keys of marks that say nothing after a power failure."""


class DurableStore(LocalStore):
    """A local storage that flushes what it writes and deletes.

    Attributes
    ----------
    deferred
        Names of the arrays whose chunks are flushed by :meth:`flush` only.
    """

    deferred: frozenset[str] = frozenset()

    async def set(self, key: str, value: Buffer) -> None:
        """Write a key."""
        self._check_writable()
        await asyncio.to_thread(self._write, key, value, Path.replace)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write a key unless it exists."""
        self._check_writable()
        if await self.exists(key):
            return
        with contextlib.suppress(FileExistsError):
            await asyncio.to_thread(self._write, key, value, _move)

    async def delete(self, key: str) -> None:
        """Delete a key."""
        await super().delete(key)
        if not self._later(key):
            await asyncio.to_thread(self._flush_folders, [Path(self.root, key)])

    async def delete_dir(self, prefix: str) -> None:
        """Delete a folder."""
        await super().delete_dir(prefix)
        await asyncio.to_thread(self._flush_folders, [Path(self.root, prefix)])

    def flush(self, keys: Iterable[str]) -> None:
        """Flush chunks that were written, and the folders that lead to them."""
        paths = [Path(self.root, key) for key in keys]
        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(flush, paths))
        self._flush_folders(paths)

    def _later(self, key: str) -> bool:
        return key.partition("/c/")[0].removesuffix("/c") in self.deferred or (
            key.startswith(NEVER_FLUSHED)
        )

    def _write(
        self, key: str, value: Buffer, named: Callable[[Path, Path], object]
    ) -> None:
        path, later = Path(self.root, key), self._later(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(f".{uuid.uuid4().hex}.partial")
        try:
            with temporary.open("wb") as file:
                file.write(value.as_buffer_like())
                if not later:
                    file.flush()
                    os.fsync(file.fileno())
            named(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        if not later:
            self._flush_folders([path])

    def _flush_folders(self, paths: Iterable[Path]) -> None:
        """Flush every folder from the root to paths: another process may have made it just now."""
        root = Path(self.root)
        folders = {
            folder for path in paths for folder in path.parents
            if folder == root or root in folder.parents
        }
        with contextlib.suppress(FileNotFoundError), ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(flush, sorted(folders, reverse=True)))


def _move(temporary: Path, path: Path) -> None:
    """Rename a file; FileExistsError if the new name is taken."""
    path.hardlink_to(temporary)
    temporary.unlink()


def flush_tree(root: Path) -> None:
    """Flush every file and folder below a folder, and the folder itself."""
    def paths() -> Iterator[Path]:
        for folder, _, names in os.walk(root, topdown=False):
            yield from (Path(folder, name) for name in names)
            yield Path(folder)

    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(flush, paths()))


def flush(path: Path) -> None:
    """Flush a file, or a folder's list of names."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
