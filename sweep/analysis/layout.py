"""How a dataset's dimensions become the four axes of a block: groups, cells, draws, settings.

Named dimensions are kept, all others are pooled. Of these, ``trial`` counts random draws; the
other dimensions of camera, marker and pose make cells, a fixed grid; all others that are pooled
(effects, levels, renderers, settings of detector and estimator, and names that are no parameter's)
see the same draws (`sweep.plan.draws`), so that their values together count as one draw.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.analysis.dimensions import DRAWS, is_grid_axis
from sweep.plan.sobol import REPLICATES
from sweep.plan.variable import LABELS

MAX_BLOCK = 1 << 18
"""Poses in a block of a dataset that is in memory."""

JOINED_BLOCK = 1 << 17
"""Poses up to which the chunks of a lazy dataset are joined.

Of blocks of 10,000 poses half of the time is Python's, during which other threads wait; a thread
needs 25 MB for one of 131,072.
"""

Arrays = dict[str, NDArray[Any]]
"""Arrays of a block, by name."""

Lengths = Mapping[str, tuple[int, ...]]
"""The lengths of the chunks of each dimension."""


@dataclass(frozen=True)
class Layout:
    """What each dimension is: kept, of cells, of draws, or of settings.

    ``arrays`` gives the dimensions of each array; ``order`` the indices of the trials by replicate,
    if they have such (`sweep.analysis.replicates`): then replicates stand in the place of draws.
    """

    arrays: Mapping[str, tuple[str, ...]]
    kept: tuple[str, ...]
    cells: tuple[str, ...]
    draws: tuple[str, ...]
    settings: tuple[str, ...]
    order: NDArray[np.intp] | None = None

    @classmethod
    def of(cls, dataset: xr.Dataset, kept: Sequence[str], *, has_cells: bool = True) -> Layout:
        """Return that of a dataset's arrays; without cells other dimensions are settings."""
        pooled = [str(dim) for dim in dataset.dims if dim not in LABELS and dim not in kept]
        cells = tuple(
            name for name in pooled
            if has_cells and name != DRAWS and is_grid_axis(name, dataset)
        )
        draws = tuple(name for name in pooled if name == DRAWS)
        return cls(
            {str(name): tuple(map(str, array.dims)) for name, array in dataset.items()},
            tuple(kept), cells, draws,
            tuple(name for name in pooled if name not in (*cells, *draws)),
        )

    @property
    def dimensions(self) -> tuple[str, ...]:
        """All dimensions, in the order of a block's axes."""
        return (*self.kept, *self.cells, *self.draws, *self.settings)

    def arrange(self, blocks: Sequence[NDArray[Any]], sizes: Mapping[str, int]) -> Arrays:
        """Return a block's arrays as (groups, cells, draws, settings, ...)."""
        arrays = {}
        parts = (self.kept, self.cells, self.draws, self.settings)
        shape = [math.prod(sizes[name] for name in names) for names in parts]
        for (name, dims), block in zip(self.arrays.items(), blocks, strict=True):
            inner = [dim for dim in dims if dim not in self.dimensions]
            present = [dim for dim in self.dimensions if dim in dims]
            array = block.transpose([dims.index(dim) for dim in (*present, *inner)])
            rest = array.shape[len(present):]
            array = array.reshape(
                (*(sizes[dim] if dim in dims else 1 for dim in self.dimensions), *rest))
            array = np.broadcast_to(array, (*(sizes[dim] for dim in self.dimensions), *rest))
            array = array.reshape((*shape, *rest))
            arrays[name] = array if self.order is None else _by_replicate(array, self.order)
        return arrays

    def rechunk(self, dataset: xr.Dataset, *, lazy: bool) -> xr.Dataset:
        """Return the dataset in chunks; settings and inner dimensions are whole in each.

        So are draws that have replicates.

        Those of a lazy dataset are joined up to `JOINED_BLOCK` poses, but not along kept
        dimensions; one in memory is cut into blocks of `MAX_BLOCK` poses.
        """
        together = () if self.order is None else self.draws
        if lazy:
            whole = {name: -1 for name in dataset.dims
                     if name in LABELS or name in self.settings or name in together}
            return self._joined(dataset.chunk().unify_chunks().chunk(whole))
        lengths: dict[str, int] = {}
        size = math.prod(dataset.sizes[name] for name in self.dimensions if name in dataset.sizes)
        for name in (*self.cells, *self.draws, *self.kept):
            if name in dataset.sizes and name not in together and size > MAX_BLOCK:
                length = dataset.sizes[name]
                lengths[name] = max(1, length * MAX_BLOCK // size)
                size = size // length * lengths[name]
        return dataset.chunk({str(name): lengths.get(str(name), -1) for name in dataset.dims})


    def _joined(self, dataset: xr.Dataset) -> xr.Dataset:
        """Return the dataset with neighbouring chunks of draws and of cells joined."""
        chunks = {name: tuple(dataset.chunks[name])
                  for name in self.dimensions if name in dataset.sizes}
        size = math.prod(map(max, chunks.values()))
        joined = {}
        for name in (*self.draws, *self.cells):
            count = JOINED_BLOCK // size
            if name in chunks and count > 1:
                lengths = chunks[name]
                joined[name] = tuple(
                    sum(lengths[k : k + count]) for k in range(0, len(lengths), count))
                size = size // max(lengths) * max(joined[name])
        return dataset.chunk(joined)


def _by_replicate(array: NDArray[Any], order: NDArray[np.intp]) -> NDArray[Any]:
    """Return (groups, cells, trials, settings, ...) as (groups, cells, replicates, rest, ...)."""
    groups, cells, trials, settings = array.shape[:4]
    rest = trials // REPLICATES * settings
    return array[:, :, order].reshape((groups, cells, REPLICATES, rest, *array.shape[4:]))


def block_numbers(names: Sequence[str], lengths: Lengths) -> Iterator[dict[str, int]]:
    """Yield the number of the chunk along each of some dimensions, for every block of them."""
    for numbers in itertools.product(*(range(len(lengths[name])) for name in names)):
        yield dict(zip(names, numbers, strict=True))
