"""Files of NumPy arrays that are the same bytes for the same arrays: records and recordings."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from sweep.errors import PluginError
from sweep.messages import plain

Record = TypeVar("Record")


@dataclass(frozen=True, slots=True, eq=False)
class ArrayFile(Generic[Record]):
    """A kind of file: a ``.npz`` file of arrays, which is read once in each process.

    Attributes
    ----------
    meaning
        Description of the file, in words that follow "expected".
    version
        The number in its array ``version``.
    arrays
        Names of the arrays, and of the record's attributes that they are written from.
    made
        A function from the arrays by name to the record.
    """

    meaning: str
    version: int
    arrays: tuple[str, ...]
    made: Callable[[Mapping[str, NDArray[Any]]], Record]

    def content(self, record: Record) -> bytes:
        """Return the content of a record's file: the same bytes for the same attributes."""
        file = io.BytesIO()
        arrays = {name: getattr(record, name) for name in self.arrays}
        np.savez_compressed(file, version=self.version, **arrays)  # its members have a fixed date
        return file.getvalue()

    def read(self, path: str | Path) -> tuple[Record, str]:
        """Return a file's record and its SHA-256.

        Raises
        ------
        PluginError
            If it cannot be read, or is none; in words that follow "expected".
        """
        try:
            state = Path(path).stat()
            return _read(self, str(path), state.st_mtime_ns, state.st_size)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            folder = plain(Path(path).parent)
            raise PluginError(f"{self.meaning}, in {folder} ({plain(reason)})") from None


@lru_cache(maxsize=16)
def _read(
    kind: ArrayFile[Record], path: str, modified_ns: int, size: int  # noqa: ARG001  (the key)
) -> tuple[Record, str]:
    """Return a file's record and its SHA-256; OSError or ValueError if there is none."""
    content = Path(path).read_bytes()
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = dict(archive)
        if arrays["version"] == kind.version:
            return kind.made(arrays), hashlib.sha256(content).hexdigest()
    except Exception:
        raise ValueError("it is none") from None
    raise ValueError("of another version")
