"""Files that a command writes for its user: completely, or not at all.

An existing file is replaced at once. A link stays: the file that it points to is replaced. What
cannot be replaced, a device or a pipe, is written into.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from sweep.errors import ArgumentError, StoreError, path_of
from sweep.messages import plain
from sweep.store.files import check_folder_writable, write_whole
from sweep.store.locations import enclosing_store, reason_of

FIGURE_SUFFIXES = (".png", ".svg")


def figure_file(
    name: str | os.PathLike[str] | None, suffixes: tuple[str, ...] = FIGURE_SUFFIXES
) -> Path | None:
    """Return the path of a figure, checked before there is one; None without a name.

    Raises
    ------
    ArgumentError, StoreError
        If the suffix names no format; as :func:`check_output_file`.
    """
    if name is None:
        return None
    path = Path(path_of("output", name))
    if path.suffix.lower() not in suffixes:
        endings = " or ".join(filter(None, suffixes))
        raise ArgumentError("output", str(path), f"expected a file that ends in {endings}")
    check_output_file(path)
    return path


def check_output_file(path: Path) -> None:
    """Check that a file can be written, before there is anything to write.

    Raises
    ------
    StoreError
        If it is a folder, if it cannot be written, or if it would be inside a store.
    """
    with write_errors_explained(path):
        around, target = enclosing_store(path), _target(path)
        if around is not None:
            raise StoreError(f"{path}: cannot be written: it is inside the store {around}")
        if target is not None:
            check_folder_writable(target.parent)


def write_output_file(path: Path, content: bytes) -> None:
    """Write a file.

    Raises
    ------
    StoreError
        As :func:`check_output_file`, or if the disk is full.
    """
    with write_errors_explained(path):
        target = _target(path)
        if target is not None:
            write_whole(target, content)
            return
        descriptor = standard_stream(path)
        with open(path if descriptor is None else os.dup(descriptor), "wb") as file:  # noqa: PTH123
            file.write(content)


def standard_stream(path: Path) -> int | None:
    """Return the descriptor of this process' output if a path names it, such as ``/dev/stdout``."""
    for file in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):
            if os.path.samestat(path.stat(), os.fstat(file.fileno())):
                return file.fileno()
    return None


@contextlib.contextmanager
def write_errors_explained(path: Path) -> Iterator[None]:
    """Turn errors of a disk, and of a name that no path can have, into a StoreError."""
    try:
        yield
    except BrokenPipeError:  # whoever reads wants no more, as of all that is printed
        raise
    except (OSError, ValueError) as error:
        raise StoreError(f"{plain(path, 300)}: cannot be written: {reason_of(error)}") from None


def _target(path: Path) -> Path | None:
    """Return the file that a path names, behind links; None for what cannot be replaced.

    StoreError if it is a folder, or its folder is missing. Without a link it stays relative: the
    folders above the current one need not be readable.
    """
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        path.stat()  # of a link in a circle, or a name that is too long, it raises
        if path.is_dir():
            raise StoreError(f"{path}: cannot be written: it is a folder; choose a file in it")
        if not path.is_file() or standard_stream(path):
            return None
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    if not target.parent.is_dir():
        raise StoreError(f"{path}: cannot be written: folder {target.parent} not found")
    return target
