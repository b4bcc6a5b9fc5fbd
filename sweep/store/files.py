"""Files of a store and of a user: written whole, by renaming a finished one; read at once."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import stat
import tempfile
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from zarr.abc.store import Store
from zarr.buffer import cpu, default_buffer_prototype
from zarr.core.sync import sync
from zarr.storage import LocalStore

__all__ = ["sync"]


# --------------------------------------------------------------------------------------------------
# Files that are read and written whole: those of a store by key, and results for a user.

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
        # A pipe without a writer is read as empty in place of waiting for one.
        with open(path, "rb", opener=_open_without_waiting) as file:
            return file.read()
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return None


def _open_without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def write_files(storage: Store, contents: Mapping[str, bytes]) -> None:
    """Write files, each whole or not at all, in any order."""
    async def write_all() -> None:
        await asyncio.gather(*(
            storage.set(key, cpu.Buffer.from_bytes(content)) for key, content in contents.items()
        ))

    sync(write_all())


def delete_files(storage: Store, keys: Iterable[str]) -> None:
    """Delete files one after another; missing ones are left out."""
    for key in keys:
        with contextlib.suppress(FileNotFoundError):
            sync(storage.delete(key))


def absent_files(storage: Store, keys: Iterable[str], folder: str) -> Iterator[str]:
    """Yield those of the keys, all below a folder, that are missing, empty, or no file."""
    if not isinstance(storage, LocalStore):
        present = sync(_nonempty(storage, folder))
        yield from (key for key in keys if key not in present)
        return
    root = os.fspath(storage.root)
    for key in keys:
        try:
            status = os.stat(f"{root}/{key}")  # noqa: PTH116  (one in 10^6)
        except OSError:
            yield key
        else:
            if status.st_size == 0 or not stat.S_ISREG(status.st_mode):
                yield key


async def _nonempty(storage: Store, folder: str) -> set[str]:
    return {key async for key in storage.list_prefix(f"{folder}/")}


async def list_folder(storage: Store, prefix: str) -> list[str]:
    """Return the names in a folder of a storage; none if there is no such folder."""
    try:
        return [name async for name in storage.list_dir(prefix)]
    except FileNotFoundError:
        return []


def encoded(content: Mapping[str, Any]) -> bytes:
    """Return a JSON document's bytes."""
    return json.dumps(content, separators=(",", ":")).encode()


def parsed(content: bytes | None) -> dict[str, Any] | None:
    """Return a JSON document's content; None if it is missing or damaged."""
    try:
        document = json.loads(content or b"")
    except (ValueError, RecursionError):
        return None
    return document if isinstance(document, dict) else None


def read_json(storage: Store, key: str) -> dict[str, Any] | None:
    """Return a JSON document's content; None if it is missing or damaged."""
    return parsed(read_files(storage, [key])[0])


def write_document(storage: Store, key: str, content: Mapping[str, Any]) -> None:
    """Write a JSON document."""
    write_files(storage, {key: encoded(content)})


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open a new file beside a path, which takes the path's name once everything is written.

    Its own name cannot be foreseen, and it is refused if it exists: nothing is written through a
    link that waits there. A link at the path is replaced; a file there passes on its permissions.
    """
    temporary = path.with_name(f".sweep-{uuid.uuid4().hex}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
        if path.is_file() and not path.is_symlink():
            temporary.chmod(stat.S_IMODE(path.stat().st_mode))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def check_folder_writable(folder: Path) -> None:
    """Raise OSError if no file can be made in a folder."""
    with tempfile.TemporaryFile(dir=folder):
        pass


def write_whole(path: Path, content: bytes) -> None:
    """Write a file as :func:`whole_file` does."""
    with whole_file(path) as file:
        file.write(content)
