"""Files of NumPy arrays that are the same bytes for the same arrays: records and recordings."""

from __future__ import annotations

import hashlib
import io
import zipfile
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
        Name of an array -> its type (such as ``"f8"``, ``"U"``) and its shape, in which equal
        letters are equal lengths.
    made
        A function from the arrays by name to the record; ValueError if one is damaged.
    """

    meaning: str
    version: int
    arrays: Mapping[str, tuple[str, tuple[str | int, ...]]]
    made: Callable[[Mapping[str, NDArray[Any]]], Record]

    def content(self, record: Record) -> bytes:
        """Return the content of a record's file: the same bytes for the same attributes."""
        arrays = {"version": self.version, **{name: getattr(record, name) for name in self.arrays}}
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            for name, values in arrays.items():
                member = io.BytesIO()
                np.lib.format.write_array(member, np.asarray(values), allow_pickle=False)
                info = zipfile.ZipInfo(f"{name}.npy")  # of a fixed date
                info.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(info, member.getvalue())
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
            arrays = {name: archive[name] for name in archive.files}
    except (KeyError, TypeError, EOFError, AttributeError, zipfile.BadZipFile):
        raise ValueError("it is none") from None
    if not arrays.keys() >= {"version", *kind.arrays}:
        raise ValueError("it is none")
    if arrays["version"].shape != () or int(arrays["version"]) != kind.version:
        raise ValueError("of another version")
    lengths: dict[str | int, int] = {}
    for name, (dtype, shape) in kind.arrays.items():
        values = arrays[name]
        fits = len(values.shape) == len(shape) and all(
            length == (lengths.setdefault(side, length) if isinstance(side, str) else side)
            for side, length in zip(shape, values.shape, strict=True))
        if not fits or not values.dtype.str[1:].startswith(dtype):
            raise ValueError(f"damaged: {name}")
    return kind.made(arrays), hashlib.sha256(content).hexdigest()
