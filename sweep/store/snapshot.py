"""A store as its readers see it: the blocks that were committed when it was opened, no others.

A writer may be at any block meanwhile, or may have been killed in the midst of one.
"""

from __future__ import annotations

from collections.abc import Iterable
from operator import floordiv
from typing import Self

import numpy as np
from zarr.abc.buffer import Buffer, BufferPrototype
from zarr.abc.store import ByteRequest, Store
from zarr.storage import WrapperStore

from sweep.plan.grid import Block, Blocks, scene_axes
from sweep.store.blocks import committed
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
    starts = {number: store.blocks[number].starts for number in numbers}
    extents = store.blocks.extents
    missing: dict[int, str] = {}
    for name, positions in axis_positions(store).items():
        # Formatted, not encoded one by one: there may be millions.
        parts = ["0"] * len(store.array(name).shape)
        for axis, position in enumerate(positions):
            parts[position] = f"{{{axis}}}"
        template = "/".join([name, "c", *parts])
        keys = {
            template.format(*map(floordiv, start, extents)): number
            for number, start in starts.items() if number not in missing
        }
        missing |= {keys[key]: key for key in store.storage.absent(keys, f"{name}/c")}
    return missing


class Snapshot(WrapperStore[Store]):
    """A storage without the chunks of blocks that were not committed when it was made.

    It holds only what can be pickled, so that a dataset on it can be sent to other processes.
    """

    def __init__(self, store: Store, blocks: Blocks, where: AxisPositions, done: bytes) -> None:
        super().__init__(store)
        self._blocks, self._where, self._done = blocks, where, done

    def _with_store(self, store: Store) -> Self:
        return type(self)(store, self._blocks, self._where, self._done)

    def __eq__(self, other: object) -> bool:
        """Return whether two show the same blocks of the same storage."""
        return super().__eq__(other) and self._done == getattr(other, "_done", None)

    __hash__ = None  # type: ignore[assignment]

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return a key's content; None if it is of a block that was not committed."""
        number = block_of_chunk(key, self._blocks, self._where)
        if number is not None and not self._done[number]:
            return None
        return await super().get(key, prototype, byte_range)


def snapshot(store: RunStore) -> Snapshot:
    """Return the storage of a store as it is now."""
    done = np.zeros(len(store.blocks), dtype=np.uint8)
    done[list(committed(store))] = 1
    return Snapshot(store.storage.below, store.blocks, axis_positions(store), done.tobytes())
