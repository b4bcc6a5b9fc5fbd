"""Files of NumPy arrays that are the same bytes for the same arrays: records and recordings."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def array_file(arrays: Mapping[str, Any]) -> bytes:
    """Return the content of a ``.npz`` file of arrays by name: the same bytes for the same ones."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, values in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(values), allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy")  # of a fixed date
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, member.getvalue())
    return file.getvalue()


def read_arrays(path: str) -> tuple[dict[str, NDArray[Any]], str]:
    """Return the arrays of a ``.npz`` file by name, and the SHA-256 of the file.

    Raises
    ------
    OSError, ValueError
        If it cannot be read, or is none.
    """
    content = Path(path).read_bytes()
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (KeyError, TypeError, EOFError, AttributeError, zipfile.BadZipFile):
        raise ValueError("it is none") from None
    return arrays, hashlib.sha256(content).hexdigest()
