"""Files of NumPy arrays that are the same bytes for the same arrays: records and recordings."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Generic, TypeVar, get_type_hints

import numpy as np

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
    record
        The dataclass of a record, whose fields are arrays, tuples of texts, texts or numbers.
    shapes
        Field -> shape of its array: lengths, or letters, each of which stands for one length.
    """

    meaning: str
    version: int
    record: type[Record]
    shapes: Mapping[str, tuple[int | str, ...]]

    def content(self, record: Record) -> bytes:
        """Return the content of a record's file: the same bytes for the same attributes."""
        file = io.BytesIO()
        values: dict[str, Any] = {
            name: getattr(record, name) for name in get_type_hints(self.record)}
        np.savez_compressed(file, version=self.version, **values)  # its members have a fixed date
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
        values = {}
        if arrays["version"] == kind.version:
            for name, hint in get_type_hints(kind.record).items():
                array = values[name] = arrays[name]
                if array.ndim == 0:
                    values[name] = hint(array.item())
                elif array.dtype.kind == "U":
                    values[name] = tuple(array.tolist())
    except Exception:
        raise ValueError("it is none") from None
    if arrays["version"] != kind.version:
        raise ValueError("of another version")
    lengths: dict[int | str, int] = {}
    for name, shape in kind.shapes.items():
        found = arrays[name].shape
        known = [lengths.setdefault(each, length) if isinstance(each, str) else each
                 for each, length in zip(shape, found, strict=False)]
        if len(found) != len(shape) or [*found] != known:
            wanted = ", ".join(str(lengths.get(each, each)) for each in shape)
            raise ValueError(f"{name}: expected the shape ({wanted}), not {found}")
    return kind.record(**values), hashlib.sha256(content).hexdigest()
