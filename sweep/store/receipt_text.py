"""The text of a receipt from the bytes of its chunk, and back.

Zarr decodes each chunk in a thread of its own: for 10^5 receipts that takes half a minute of
processor time, four times what the same codecs take when they are called one after another.
"""

from __future__ import annotations

from typing import Any

import google_crc32c
import numpy as np
import zarr
from numcodecs.vlen import VLenUTF8
from numcodecs.zstd import Zstd

from sweep.store.layout import ZSTD_LEVEL

CODECS = ("VLenUTF8Codec", "ZstdCodec", "Crc32cCodec")
"""The codecs of receipts, as this package writes them."""

CHECKSUM_BYTES = 4


def is_decodable(array: zarr.Array[Any]) -> bool:
    """Return whether an array's chunks are written by :data:`CODECS`."""
    codecs = getattr(array.metadata, "codecs", ())
    return tuple(type(codec).__name__ for codec in codecs) == CODECS


def decoded(content: bytes) -> str:
    """Return the text that a chunk holds; ValueError if it is damaged."""
    body, checksum = content[:-CHECKSUM_BYTES], content[-CHECKSUM_BYTES:]
    if google_crc32c.value(body) != int.from_bytes(checksum, "little"):
        raise ValueError("a receipt's checksum differs")
    try:
        (text,) = VLenUTF8().decode(Zstd().decode(body))
    except RuntimeError as error:
        raise ValueError(str(error)) from None
    return str(text)


def encoded(text: str) -> bytes:
    """Return the content of a chunk that holds a text, the same bytes as Zarr writes."""
    body = bytes(Zstd(ZSTD_LEVEL).encode(VLenUTF8().encode(np.array([text], dtype=object))))
    checksum: int = google_crc32c.value(body)
    return body + checksum.to_bytes(CHECKSUM_BYTES, "little")
