"""Chunks of a local store read in the thread that asks for them.

Zarr reads a chunk in six turns between three threads, and where several threads compute each turn
waits for Python's lock: a chunk of 10,000 poses then takes five times as long as its file and its
values do. What is not a part of one chunk is left to Zarr.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from zarr.storage import LocalStore

from sweep.store.layout import decoded_chunk
from sweep.store.locations import open_group
from sweep.store.run_store import RunStore
from sweep.store.snapshot import Snapshot

if TYPE_CHECKING:
    import xarray as xr
    import zarr


class ChunkedVariable:
    """A variable of a local store, as Dask indexes it.

    Parameters
    ----------
    array
        Its array, on ``storage``.
    storage
        The store as its readers see it.
    """

    def __init__(self, array: zarr.Array[Any], storage: Snapshot) -> None:
        self._array, self._storage = array, storage
        self._chunks: tuple[int, ...] = array.chunks
        self._fill = array.metadata.fill_value
        self._path = array.path
        self.shape: tuple[int, ...] = array.shape
        self.dtype: np.dtype[Any] = array.dtype
        self.ndim = array.ndim

    def __getitem__(self, index: Any) -> NDArray[Any]:
        """Return the values at an index, a slice for each dimension."""
        if len(index) != self.ndim or not all(
            isinstance(part, slice) and part.step in (None, 1) for part in index
        ):
            return np.asarray(self._array[index])
        spans = [
            part.indices(length)[:2] for part, length in zip(index, self.shape, strict=True)
        ]
        numbers = [start // size for (start, _), size in zip(spans, self._chunks, strict=True)]
        inside = tuple(
            slice(start - number * size, stop - number * size)
            for (start, stop), number, size in zip(spans, numbers, self._chunks, strict=True)
        )
        if any(
            not 0 <= part.start < part.stop <= size
            for part, size in zip(inside, self._chunks, strict=True)
        ):
            return np.asarray(self._array[index])
        return self._chunk(numbers)[inside]

    def _chunk(self, numbers: list[int]) -> NDArray[Any]:
        """Return a whole chunk; its fill value if nothing was written.

        Raises
        ------
        ValueError
            If it is damaged.
        """
        key = "/".join([self._path, "c", *map(str, numbers)])
        content = self._storage.local_content(key)
        if content is None:
            return np.full(self._chunks, self._fill, dtype=self.dtype)
        try:
            return decoded_chunk(content, self.dtype, self._chunks)
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"{key}: damaged ({error})") from None


def read_directly(dataset: xr.Dataset, store: RunStore, storage: Snapshot) -> xr.Dataset:
    """Return a lazy dataset of a local store's snapshot with its variables read by this module."""
    import dask.array as da  # noqa: PLC0415  (slow to import, and workers do without)

    if not isinstance(storage.below, LocalStore):
        return dataset
    group = open_group(storage, "r")
    replaced = {}
    for variable in store.variables:
        lazy = dataset.get(variable.name)
        if lazy is None or lazy.chunks is None or lazy.ndim == 0:
            continue
        direct = ChunkedVariable(group[variable.name], storage)  # type: ignore[arg-type]
        values = da.from_array(
            direct, chunks=lazy.chunks, name=f"chunks-{lazy.data.name}",
            meta=np.empty((0,) * direct.ndim, dtype=direct.dtype),
        )
        replaced[variable.name] = lazy.copy(deep=False, data=values)
    return dataset.assign(replaced)
