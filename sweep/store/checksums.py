"""A Zarr storage that records the digests of its contents and never writes outside its folder."""

from __future__ import annotations

import asyncio
import os
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self
from zlib import crc32

from zarr.abc.buffer import Buffer, BufferPrototype
from zarr.abc.store import ByteRequest, Store
from zarr.buffer import default_buffer_prototype
from zarr.storage import LocalStore, WrapperStore

from sweep.store.zarr_sync import sync


def digest(content: bytes | memoryview) -> int:
    """Return the CRC-32 of stored bytes."""
    return crc32(content)


MAX_DOCUMENT_BYTES = 1 << 24
"""Size from which on metadata, a receipt, a lock or a coordinate is no such thing."""

MAX_TABLE_BYTES = 1 << 30
"""The same of a chunk of the groups of costs and failures."""

TOO_LARGE = "larger than it can be"


def unreadable(path: str | Path, limit: int) -> str:
    """Return why a path must not be read; empty if it may be, or if nothing lies there.

    Reading a pipe would never end, and a file of holes may be larger than the memory.
    """
    try:
        status = os.stat(path)  # noqa: PTH116  (a path is made for every chunk that is read)
    except OSError:
        return ""
    if stat.S_ISREG(status.st_mode):
        return TOO_LARGE if status.st_size > limit else ""
    return "" if stat.S_ISDIR(status.st_mode) else "not a file"


def limit_of(key: str, chunk_limits: Mapping[str, int]) -> int:
    """Return the most bytes that a key's file may have; ``chunk_limits`` are those of variables."""
    name = key.partition("/c/")[0].removesuffix("/c")
    if name in chunk_limits and name != key:
        return chunk_limits[name]
    table = key.startswith(("cost/", "failures/")) and name != key
    return MAX_TABLE_BYTES if table else MAX_DOCUMENT_BYTES


def may_be_read(root: str | Path, key: str, chunk_limits: Mapping[str, int]) -> bool:
    """Return whether a local file may be read; what must not be read is as if missing.

    Raises
    ------
    ValueError
        If it is a chunk that is too large: Zarr takes a missing chunk for one of fill values.
    """
    reason = unreadable(f"{root}/{key}", limit_of(key, chunk_limits))
    if reason == TOO_LARGE and "/c/" in f"{key}/":
        raise ValueError(f"{key}: {reason}")
    return not reason


class DigestingStore(WrapperStore[Store]):
    """A storage that records the digest of every key that is written, or read completely.

    A local one refuses keys whose folder is a link that leads out of it.

    Parameters
    ----------
    store
        The storage itself.
    keep_alive
        An object that lives as long as this one, such as a folder that is held open.

    Attributes
    ----------
    digests
        Key -> CRC-32 of its content.
    substitutes
        Key -> content that is read in place of a damaged one, until the key is written.
    chunk_limits
        Variable -> most bytes that a chunk of it may have.
    """

    def __init__(self, store: Store, keep_alive: object = None) -> None:
        super().__init__(store)
        self._keep_alive = keep_alive
        self.digests: dict[str, int] = {}
        self.substitutes: dict[str, Buffer] = {}
        self.chunk_limits: dict[str, int] = {}
        self._root = store.root if isinstance(store, LocalStore) else None

    def contents(self, keys: Sequence[str]) -> list[bytes | None]:
        """Return the contents of keys, None for missing ones; from any thread."""
        if self._root is None:
            return sync(self._contents(keys))
        contents: list[bytes | None] = []
        for key in keys:
            try:
                if self.unreadable(key):
                    contents.append(None)
                    continue
                with open(f"{self._root}/{key}", "rb") as file:  # noqa: PTH123  (one in 10^6)
                    contents.append(file.read())
            except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
                contents.append(None)
        return contents

    def unreadable(self, key: str) -> str:
        """Return why a local file must not be read; empty if it may be, or if it is missing."""
        if self._root is None:
            return ""
        return unreadable(f"{self._root}/{key}", limit_of(key, self.chunk_limits))

    def absent(self, keys: Iterable[str], folder: str) -> Iterator[str]:
        """Yield the keys, all below a folder, that are missing or empty."""
        if self._root is None:
            present = sync(self._nonempty(folder))
            yield from (key for key in keys if key not in present)
            return
        root = os.fspath(self._root)
        for key in keys:
            try:
                if os.stat(f"{root}/{key}").st_size == 0:  # noqa: PTH116  (one in 10^6)
                    yield key
            except OSError:
                yield key

    async def _nonempty(self, folder: str) -> set[str]:
        return {key async for key in self._store.list_prefix(f"{folder}/")}

    async def _contents(self, keys: Sequence[str]) -> list[bytes | None]:
        async def content(key: str) -> bytes | None:
            buffer = await self._store.get(key, default_buffer_prototype())
            return None if buffer is None else buffer.to_bytes()

        return await asyncio.gather(*(content(key) for key in keys))

    @property
    def below(self) -> Store:
        """The storage itself."""
        return self._store

    def _with_store(self, store: Store) -> Self:
        new = type(self)(store, self._keep_alive)
        new.digests, new.substitutes = self.digests, self.substitutes
        new.chunk_limits = self.chunk_limits
        return new

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return a key's content, and record its digest.

        Raises
        ------
        ValueError
            If it is a chunk that is larger than it can be; such a document is None, as if missing.
        """
        if key in self.substitutes:
            return self.substitutes[key]
        if self._root is not None and not may_be_read(self._root, key, self.chunk_limits):
            return None
        content = await super().get(key, prototype, byte_range)
        if content is not None and byte_range is None:
            self.digests[key] = _digest_of(content)
        return content

    async def set(self, key: str, value: Buffer) -> None:
        """Write a key, and record its digest."""
        self._check_inside(key)
        await super().set(key, value)
        self.substitutes.pop(key, None)
        self.digests[key] = _digest_of(value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write a key unless it exists, and record the digest of its content."""
        self._check_inside(key)
        await super().set_if_not_exists(key, value)
        await self.get(key, default_buffer_prototype())

    async def delete(self, key: str) -> None:
        """Delete a key."""
        self._check_inside(key)
        await super().delete(key)
        self.digests.pop(key, None)

    async def delete_dir(self, prefix: str) -> None:
        """Delete a folder."""
        self._check_inside(f"{prefix}/x")
        await super().delete_dir(prefix)

    def _check_inside(self, key: str) -> None:
        if self._root is None:
            return
        root = os.path.realpath(self._root)
        folder = os.path.realpath(Path(root, key).parent)
        if os.path.commonpath((root, folder)) != root:
            raise PermissionError(0, f"{key} is a link that leads out of the store", key)


def _digest_of(content: Buffer) -> int:
    view: Any = content.as_buffer_like()
    return digest(view)
