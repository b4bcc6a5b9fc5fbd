"""Files of a store and of a user: written whole, by renaming a finished one; read at once."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import stat
import tempfile
import uuid
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import google_crc32c
import numcodecs.zstd
from zarr.abc.store import Store
from zarr.buffer import cpu, default_buffer_prototype
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.sync import collect_aiterator, sync
from zarr.storage import FsspecStore, LocalStore

# --------------------------------------------------------------------------------------------------
# Files that are read and written whole: a store's by key, and results for a user.

def read_files(storage: Store, keys: Sequence[str]) -> list[bytes | None]:
    """Return the contents of keys, None for missing ones."""
    if isinstance(storage, LocalStore):  # Zarr reads each file in a thread of its own
        return [_read(f"{storage.root}/{key}") for key in keys]

    async def read(key: str) -> bytes | None:
        buffer = await storage.get(key, default_buffer_prototype())
        return None if buffer is None else buffer.to_bytes()

    async def read_all() -> list[bytes | None]:
        return await asyncio.gather(*map(read, keys))

    return sync(read_all())


def _read(path: str) -> bytes | None:
    try:
        with open(path, "rb", buffering=0) as file:  # noqa: PTH123  (twice as fast as a Path)
            return file.read()
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return None


def write_files(storage: Store, contents: Mapping[str, bytes]) -> None:
    """Write files, each whole or not at all, in any order."""
    async def write_all() -> list[BaseException | None]:
        return await asyncio.gather(*(
            storage.set(key, cpu.Buffer.from_bytes(content)) for key, content in contents.items()
        ), return_exceptions=True)

    # Raised once no other write is under way that could make its folder again.
    for error in sync(write_all()):
        if error is not None:
            raise error


def delete_files(storage: Store, keys: Iterable[str]) -> None:
    """Delete files one after another; missing ones are left out."""
    for key in keys:
        with contextlib.suppress(FileNotFoundError):
            sync(_delete(storage, key))


def delete_folder(storage: Store, folder: str) -> None:
    """Delete all files below a folder, in any order."""
    async def delete_all(keys: Sequence[str]) -> None:
        await asyncio.gather(*(_delete(storage, key) for key in keys))

    if isinstance(storage, LocalStore):
        sync(storage.delete_dir(folder))
        return
    keys = [*collect_aiterator(storage.list_prefix(f"{folder}/"))]
    for start in range(0, len(keys), DELETED_AT_ONCE):
        sync(delete_all(keys[start : start + DELETED_AT_ONCE]))


#: Requests that delete files of an object store, under way at once.
DELETED_AT_ONCE = 100


async def _delete(storage: Store, key: str) -> None:
    if isinstance(storage, FsspecStore):
        # Zarr asks for the deletion of a list of keys, which servers beside Amazon's refuse: the
        # libraries no longer send the checksum (Content-MD5) that these expect.
        await storage.fs._rm_file(f"{storage.path}/{key}")  # noqa: SLF001  (as Zarr does)
    else:
        await storage.delete(key)


def list_folder(storage: Store, folder: str) -> list[str]:
    """Return the names in a folder of a storage; none if there is no such folder."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        if isinstance(storage, LocalStore):  # Zarr makes a path of each
            return os.listdir(f"{storage.root}/{folder}")  # noqa: PTH208  (10^6 names a second)
        return [*collect_aiterator(storage.list_dir(folder))]
    return []


def files_in(storage: Store) -> dict[str, bytes]:
    """Return the contents of all files of a storage by key."""
    keys = [*collect_aiterator(storage.list())]
    return {key: content or b"" for key, content in zip(
        keys, read_files(storage, keys), strict=True)}


def encoded(content: Mapping[str, Any]) -> bytes:
    """Return a JSON document's bytes."""
    return json.dumps(content, separators=(",", ":")).encode()


def read_json(storage: Store, key: str) -> dict[str, Any] | None:
    """Return a JSON document's content; None if it is missing or damaged."""
    try:
        document = json.loads(read_files(storage, [key])[0] or b"")
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def write_whole(path: Path, content: bytes) -> None:
    """Write a new file beside a path, which takes the path's name once everything is written.

    A link at the path is replaced; a file there passes on its permissions.
    """
    temporary = path.with_name(f".sweep-{uuid.uuid4().hex}")
    try:
        temporary.write_bytes(content)
        if path.is_file() and not path.is_symlink():
            temporary.chmod(stat.S_IMODE(path.stat().st_mode))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check_folder_writable(folder: Path) -> None:
    """Raise OSError if no file can be made in a folder."""
    with tempfile.TemporaryFile(dir=folder):
        pass


# --------------------------------------------------------------------------------------------------
# Chunks of a store, as Zarr writes them: compressed, with a checksum at the end.

#: Array of the blocks' receipts by number, JSON, a chunk each; empty unless committed.
RECEIPTS = "commits/receipt"

#: Between the indices in a chunk's name. Zarr's default makes folders of them; without folders, one
#: listing tells which chunks of a variable there are.
SEPARATOR = "."

#: The fault of a file.
CHANGED = "changed: does not fit its checksum"

#: Level of the compression of every chunk.
ZSTD_LEVEL = 3


def codecs() -> list[Any]:
    """Return the codecs of every array; a damaged chunk fails its checksum when it is read."""
    return [ZstdCodec(level=ZSTD_LEVEL), Crc32cCodec()]


def checksum_of(content: bytes) -> int:
    """Return the CRC-32C that Zarr wrote at a chunk's end."""
    return int.from_bytes(content[-4:], "little")


def packed(body: bytes) -> bytes:
    """Return a chunk's content from its bytes before compression, as Zarr writes it."""
    compressed = bytes(numcodecs.zstd.compress(body, ZSTD_LEVEL))
    checksum: int = google_crc32c.value(compressed)
    return compressed + checksum.to_bytes(4, "little")


def is_sound(content: bytes) -> bool:
    """Return whether a chunk fits the checksum at its end."""
    return len(content) > 4 and bool(google_crc32c.value(content[:-4]) == checksum_of(content))


def unpacked(content: bytes) -> bytes:
    """Return the bytes that :func:`packed` took; ValueError or RuntimeError if damaged."""
    if not is_sound(content):
        raise ValueError("its checksum differs")
    return bytes(numcodecs.zstd.decompress(content[:-4]))
