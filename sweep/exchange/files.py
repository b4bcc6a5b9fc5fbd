"""Files of an export: written beside their name and renamed, so that each is whole or absent."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from sweep.errors import StoreError
from sweep.messages import plain
from sweep.store.locations import reason_of


@contextlib.contextmanager
def replaced_file(path: Path) -> Iterator[TextIO]:
    """Open a text file for writing; it takes its name once everything is written."""
    temporary = path.with_name(f"{path.name}.part")
    with temporary.open("w", encoding="utf-8", newline="") as file:
        yield file
    temporary.replace(path)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file at once."""
    temporary = path.with_name(f"{path.name}.part")
    temporary.write_bytes(content)
    temporary.replace(path)


@contextlib.contextmanager
def write_errors(folder: Path) -> Iterator[None]:
    """Turn the system's errors into a StoreError that names the folder."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{plain(error.filename or folder, 300)}: cannot be written: {reason_of(error)}; the "
            "same command continues"
        ) from None
