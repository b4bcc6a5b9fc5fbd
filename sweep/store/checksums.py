"""A Zarr store that notes the digest of what goes through it, and never writes elsewhere."""

from __future__ import annotations

import asyncio
import os
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self
from zlib import crc32

from zarr.abc.store import ByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype, default_buffer_prototype
from zarr.core.sync import sync
from zarr.storage import LocalStore, WrapperStore


def digest(content: bytes | memoryview) -> int:
    """Return the CRC-32 of stored bytes."""
    return crc32(content)


def is_special(path: Path) -> bool:
    """Tell whether a path is neither a file nor a folder: reading a pipe would never end."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


class DigestingStore(WrapperStore[Store]):
    """A store beside which the digests of the keys that were written or read whole are kept.

    A local one refuses keys whose folder is a link that leads out of it. ``instead`` has what is
    read in place of keys that are damaged, until they are written; ``keeps`` is kept alive as long
    as the store.
    """

    def __init__(self, store: Store, keeps: object = None) -> None:
        super().__init__(store)
        self._keeps = keeps
        self.digests: dict[str, int] = {}
        self.instead: dict[str, Buffer] = {}
        self._root = store.root if isinstance(store, LocalStore) else None

    def contents(self, keys: Sequence[str]) -> list[bytes | None]:
        """Return what is stored under keys, None where nothing is; from any thread."""
        if self._root is None:
            return sync(self._contents(keys))
        found: list[bytes | None] = []
        for key in keys:
            path = Path(self._root, key)
            try:
                found.append(None if is_special(path) else path.read_bytes())
            except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
                found.append(None)
        return found

    async def _contents(self, keys: Sequence[str]) -> list[bytes | None]:
        async def content(key: str) -> bytes | None:
            buffer = await self._store.get(key, default_buffer_prototype())
            return None if buffer is None else buffer.to_bytes()

        return await asyncio.gather(*(content(key) for key in keys))

    @property
    def below(self) -> Store:
        """The store itself."""
        return self._store

    def _with_store(self, store: Store) -> Self:
        new = type(self)(store, self._keeps)
        new.digests, new.instead = self.digests, self.instead
        return new

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return what is under a key, and note its digest."""
        if key in self.instead:
            return self.instead[key]
        if self._root is not None and is_special(Path(self._root, key)):
            return None
        content = await super().get(key, prototype, byte_range)
        if content is not None and byte_range is None:
            self.digests[key] = _digest_of(content)
        return content

    async def set(self, key: str, value: Buffer) -> None:
        """Write under a key, and note its digest."""
        self._see_that_it_is_inside(key)
        await super().set(key, value)
        self.instead.pop(key, None)
        self.digests[key] = _digest_of(value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write under a key where nothing is there, and note the digest of what is."""
        self._see_that_it_is_inside(key)
        await super().set_if_not_exists(key, value)
        await self.get(key, default_buffer_prototype())

    async def delete(self, key: str) -> None:
        """Delete a key."""
        self._see_that_it_is_inside(key)
        await super().delete(key)
        self.digests.pop(key, None)

    async def delete_dir(self, prefix: str) -> None:
        """Delete a folder."""
        self._see_that_it_is_inside(f"{prefix}/x")
        await super().delete_dir(prefix)

    def _see_that_it_is_inside(self, key: str) -> None:
        if self._root is None:
            return
        root = os.path.realpath(self._root)
        folder = os.path.realpath(Path(root, key).parent)
        if os.path.commonpath((root, folder)) != root:
            raise PermissionError(0, f"{key} is a link that leads out of the store", key)


def _digest_of(content: Buffer) -> int:
    view: Any = content.as_buffer_like()
    return digest(view)
