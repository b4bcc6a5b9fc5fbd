"""A store as its readers see it: the blocks that were committed when it was opened, no others.

A writer may be at any block meanwhile, or may have been killed in the midst of one.
"""

from __future__ import annotations

from collections.abc import Iterable
from operator import floordiv
from pathlib import Path
from typing import Self

import numpy as np
from zarr.abc.buffer import Buffer, BufferPrototype
from zarr.abc.store import ByteRequest, Store
from zarr.storage import LocalStore, WrapperStore

from sweep.plan.grid import Block, Blocks, scene_axes
from sweep.store.blocks import committed
from sweep.store.checksums import may_be_read
from sweep.store.run_store import RunStore

AxisPositions = dict[str, tuple[int, ...]]
"""Variable -> for each scene axis, its position among the variable's dimensions."""


def axis_positions(store: RunStore) -> AxisPositions:
    """Return where the scene axes are among each variable's dimensions."""
    names = [axis.name for axis in scene_axes(store.pipeline)]
    return {
        variable.name: tuple(variable.dimensions(store.pipeline).index(name) for name in names)
        for variable in store.variables
    }


def block_of_chunk(key: str, blocks: Blocks, where: AxisPositions) -> int | None:
    """Return the number of the block that a variable's chunk holds; None for any other key."""
    name, _, position = key.partition("/c")
    if name not in where:
        return None
    index = position.split("/")[1:]
    try:
        starts = tuple(
            int(index[at]) * extent
            for at, extent in zip(where[name], blocks.extents, strict=True)
        )
    except (IndexError, ValueError):
        return None
    return blocks.number(Block(starts, starts))


def missing_chunks(store: RunStore, numbers: Iterable[int]) -> dict[int, str]:
    """Return those of the committed blocks of which chunks are missing, each with the key of one.

    A copy that was made while the store was written has such blocks, for instance.
    """
    extents = store.blocks.extents
    indices = {
        number: tuple(map(floordiv, store.blocks[number].starts, extents)) for number in numbers
    }
    missing: dict[int, str] = {}
    positions = axis_positions(store)
    for variable in store.variables:
        name = variable.name
        # Formatted, not encoded one by one: there may be millions.
        parts = ["0"] * len(variable.dimensions(store.pipeline))
        for axis, position in enumerate(positions[name]):
            parts[position] = f"{{{axis}}}"
        template = "/".join([name, "c", *parts])
        keys = {
            template.format(*index): number
            for number, index in indices.items() if number not in missing
        }
        missing |= {keys[key]: key for key in store.storage.absent(keys, f"{name}/c")}
    return missing


class Snapshot(WrapperStore[Store]):
    """A storage without the chunks of blocks that were not committed when it was made.

    It holds only what can be pickled, so that a dataset on it can be sent to other processes.
    """

    def __init__(
        self, store: Store, blocks: Blocks, where: AxisPositions, done: bytes,
        chunk_limits: dict[str, int],
    ) -> None:
        super().__init__(store)
        self._blocks, self._where, self._done = blocks, where, done
        self._chunk_limits = chunk_limits

    def _with_store(self, store: Store) -> Self:
        return type(self)(store, self._blocks, self._where, self._done, self._chunk_limits)

    def __eq__(self, other: object) -> bool:
        """Return whether two show the same blocks of the same storage."""
        return super().__eq__(other) and self._done == getattr(other, "_done", None)

    __hash__ = None  # type: ignore[assignment]

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return a key's content; None if it is of a block that was not committed.

        Raises
        ------
        ValueError
            If it is a chunk that is larger than it can be.
        """
        if not self._may_be_read(key):
            return None
        return await super().get(key, prototype, byte_range)

    @property
    def below(self) -> Store:
        """The storage itself."""
        return self._store

    def local_content(self, key: str) -> bytes | None:
        """Return what :meth:`get` returns, of a local storage, without leaving this thread."""
        if not isinstance(self._store, LocalStore):
            raise TypeError(self._store)
        if not self._may_be_read(key):
            return None
        try:
            return Path(f"{self._store.root}/{key}").read_bytes()
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            return None

    def _may_be_read(self, key: str) -> bool:
        number = block_of_chunk(key, self._blocks, self._where)
        if number is not None and not self._done[number]:
            return False
        return not isinstance(self._store, LocalStore) or may_be_read(
            self._store.root, key, self._chunk_limits
        )


def snapshot(store: RunStore) -> Snapshot:
    """Return the storage of a store as it is now; a finished one shows every block."""
    done = np.full(len(store.blocks), store.finished, dtype=np.uint8)
    if not store.finished:
        done[list(committed(store))] = 1
    return Snapshot(
        store.storage.below, store.blocks, axis_positions(store), done.tobytes(),
        store.storage.chunk_limits,
    )
