"""A part of a variable of a store that is being written, read from its chunks one after another.

Zarr reads each chunk in turns between threads, which takes several times as long as its file and
its values do where chunks are small.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.store.layout import decoded_chunk
from sweep.store.run_store import RunStore


def read_part(store: RunStore, name: str, part: tuple[slice, ...]) -> NDArray[Any]:
    """Return a variable's values in a part, a slice for each dimension.

    Chunks that do not exist are fill values.

    Raises
    ------
    ValueError
        If a chunk is damaged, or is no file that can be read.
    """
    array = store.array(name)
    chunks = array.chunks
    spans = [each.indices(length)[:2] for each, length in zip(part, array.shape, strict=True)]
    numbers = list(product(*(
        range(start // size, -(-stop // size))
        for (start, stop), size in zip(spans, chunks, strict=True)
    )))
    keys = [f"{name}/{array.metadata.encode_chunk_key(number)}" for number in numbers]
    values = np.full(
        [stop - start for start, stop in spans], array.metadata.fill_value, dtype=array.dtype)
    for number, key, content in zip(numbers, keys, store.storage.contents(keys), strict=True):
        if content is None:
            if reason := store.storage.unreadable(key):
                raise ValueError(f"{key}: {reason}")
            continue
        try:
            chunk = decoded_chunk(content, array.dtype, chunks)
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"{key}: damaged ({error})") from None
        common = [
            (max(start, k * size), min(stop, (k + 1) * size))
            for (start, stop), k, size in zip(spans, number, chunks, strict=True)
        ]
        into = tuple(
            slice(a - start, b - start) for (a, b), (start, _) in zip(common, spans, strict=True))
        values[into] = chunk[tuple(
            slice(a - k * size, b - k * size)
            for (a, b), k, size in zip(common, number, chunks, strict=True)
        )]
    return values
