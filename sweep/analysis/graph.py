"""Tasks of Dask that pass statistics over all blocks of a lazy dataset, once or twice.

No state grows with the dataset. A second pass, if one is needed, reads the chunks again: they are
computed within its tasks, for as tasks of their own a scheduler would keep those of the first pass
in memory for the second.
"""

from __future__ import annotations

import functools
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import dask.array as da
import numpy as np

# Dask's documentation calls these `dask.Task` and `dask.TaskRef`, but no version has them there.
from dask._task_spec import Task, TaskRef
from dask.highlevelgraph import HighLevelGraph
from dask.local import get_sync
from dask.optimization import cull
from dask.typing import Key
from dask.utils import ensure_dict
from numpy.typing import NDArray

from sweep.analysis.layout import Layout, Lengths, block_numbers

FAN_IN = 16
"""States that are merged at once."""

ReadBlock = Callable[[], list[NDArray[Any]]]
"""Computes the arrays of a block."""

Chunks = tuple[tuple[int, ...], ...]
"""The lengths of an array's chunks, along each dimension."""


class TaskLayer:
    """Tasks under one name, which may depend on each other."""

    def __init__(self, name: str) -> None:
        self.name = f"{name}-{uuid.uuid4().hex}"
        self.tasks: dict[Key, Any] = {}

    def add(
        self, function: Callable[..., Any], *dependencies: Key,
        index: tuple[int, ...] | None = None,
    ) -> Key:
        """Add a task that calls a function with the results of others; return its key."""
        key: Key = (self.name, *((len(self.tasks),) if index is None else index))
        self.tasks[key] = Task(key, function, *map(TaskRef, dependencies))
        return key

    def merge(self, function: Callable[..., Any], keys: Sequence[Key]) -> Key:
        """Add tasks that merge results, a few at a time; return the key of the last."""
        while len(keys) > 1:
            keys = [self.add(function, *keys[k : k + FAN_IN])
                    for k in range(0, len(keys), FAN_IN)]
        return keys[0]


class ChunkReader:
    """How the chunks of some arrays are computed within a task, those of a block together."""

    def __init__(self, arrays: Sequence[da.Array]) -> None:
        self._names = [array.name for array in arrays]
        self._graph = {key: task for array in arrays
                       for key, task in ensure_dict(array.__dask_graph__()).items()}

    def block(self, indices: Iterable[tuple[int, ...]]) -> ReadBlock:
        """Return what computes a chunk of each array."""
        keys = [(name, *index) for name, index in zip(self._names, indices, strict=True)]
        needed, _ = cull(self._graph, keys)
        return functools.partial(_compute_chunks, needed, keys)


def _compute_chunks(graph: Mapping[Any, Any], keys: list[Any]) -> list[NDArray[Any]]:
    # No callbacks: a user's progress bar is that of the whole.
    return [np.asarray(chunk) for chunk in get_sync(graph, keys, callbacks=())]


def add_pass(
    layer: TaskLayer, reader: ChunkReader, layout: Layout, lengths: Lengths,
    read_state: Callable[..., Any], fold: Callable[..., Any], known: Sequence[Key] = (),
) -> list[list[Key]]:
    """Add tasks that read every block; return the keys of folded states.

    Parameters
    ----------
    read_state
        Called with the block's sizes, its `ReadBlock`, and the result of a key of ``known``.
    fold
        Called with the results of ``read_state`` for all draws of the same cells.
    known
        A key for each block of the kept dimensions, or none.

    Returns
    -------
    list of lists of keys
        For each block of the kept dimensions, those of the blocks of cells.
    """
    folded = []
    for number, kept in enumerate(block_numbers(layout.kept, lengths)):
        states = []
        for cells in block_numbers(layout.cells, lengths):
            parts = []
            for draws in block_numbers(layout.draws, lengths):
                at = kept | cells | draws
                read = reader.block(
                    tuple(at.get(dim, 0) for dim in dims) for dims in layout.arrays.values())
                sizes = {name: chunks[at.get(name, 0)] for name, chunks in lengths.items()}
                parts.append(layer.add(
                    functools.partial(read_state, sizes, read), *known[number : number + 1]))
            states.append(layer.add(fold, *parts))
        folded.append(states)
    return folded


def array_of_blocks(
    layer: TaskLayer, tables: Sequence[Key], pick: Callable[..., NDArray[Any]], name: str,
    chunks: Chunks, dtype: str,
) -> da.Array:
    """Return the array whose chunks are ``pick(shape, table)`` of the tables' results."""
    picked = TaskLayer(name)
    for table, index in zip(tables, np.ndindex(*map(len, chunks)), strict=True):
        shape = tuple(sizes[k] for sizes, k in zip(chunks, index, strict=True))
        picked.add(functools.partial(pick, shape), table, index=index)
    graph = HighLevelGraph({layer.name: layer.tasks, picked.name: picked.tasks},
                           {layer.name: set(), picked.name: {layer.name}})
    return da.Array(graph, picked.name, chunks, dtype=dtype)
