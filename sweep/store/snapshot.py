"""A store as its readers see it: the blocks that were committed when it was opened, no others.

A writer may be at any block meanwhile, or may have been killed in the midst of one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from operator import floordiv
from pathlib import Path
from typing import Self

import numpy as np
from zarr.abc.buffer import Buffer, BufferPrototype
from zarr.abc.store import ByteRequest, Store
from zarr.storage import LocalStore, WrapperStore

from sweep.plan.grid import Block, Blocks, scene_axes
from sweep.store.blocks import committed, receipt_key, receipts
from sweep.store.checksums import may_be_read
from sweep.store.layout import RECEIPTS
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


class BlockKeys:
    """The keys of the blocks' chunks and receipts in a store; there may be millions of them.

    Parameters
    ----------
    store
        The store.
    """

    def __init__(self, store: RunStore) -> None:
        self._blocks = store.blocks
        self._positions = axis_positions(store)
        # Variable -> the key of its chunk, to be filled in with a block's index along each axis.
        self._templates: dict[str, str] = {}
        for variable in store.variables:
            parts = ["0"] * len(variable.dimensions(store.pipeline))
            for axis, position in enumerate(self._positions[variable.name]):
                parts[position] = f"{{{axis}}}"
            self._templates[variable.name] = "/".join([variable.name, "c", *parts])

    def of_chunks(self, number: int) -> dict[str, str]:
        """Return the keys of a block's chunks by variable."""
        index = self._index(number)
        return {name: template.format(*index) for name, template in self._templates.items()}

    def missing(
        self, store: RunStore, numbers: Iterable[int], names: Collection[str] | None = None
    ) -> dict[int, str]:
        """Return those of the blocks of which chunks are missing, each with the key of one.

        Of all variables, or of those of some names.
        """
        indices = {number: self._index(number) for number in numbers}
        missing: dict[int, str] = {}
        for name, template in self._templates.items():
            if names is not None and name not in names:
                continue
            keys = {
                template.format(*index): number
                for number, index in indices.items() if number not in missing
            }
            missing |= {keys[key]: key for key in store.storage.absent(keys, f"{name}/c")}
        return missing

    def _index(self, number: int) -> tuple[int, ...]:
        """Return a block's index along each scene axis."""
        return tuple(map(floordiv, self._blocks[number].starts, self._blocks.extents))

    def number(self, key: str) -> int | None:
        """Return the number of the block whose receipt or chunk lies under a key, else None."""
        name, _, rest = key.rpartition("/c/")
        if name == RECEIPTS:
            found = int(rest) if rest.isascii() and rest.isdecimal() else None
            return found if found is not None and receipt_key(found) == key else None
        found = block_of_chunk(key, self._blocks, self._positions)
        if found is None or not 0 <= found < len(self._blocks):
            return None
        template = self._templates[key.partition("/c")[0]]
        return found if template.format(*self._index(found)) == key else None


def missing_chunks(store: RunStore, numbers: Iterable[int]) -> dict[int, str]:
    """Return those of the committed blocks of which chunks are missing, each with the key of one.

    A copy that was made while the store was written has such blocks, for instance.

    Raises
    ------
    StoreError
        If the receipt of a block without chunks is damaged.
    """
    keys = BlockKeys(store)
    missing = keys.missing(store, numbers)
    if store.pipeline.stopping is None or not missing:
        return missing
    # Blocks of which nothing was needed have chunks of flags alone.
    flags = [number for number, receipt in receipts(store, missing) if not receipt.any_needed]
    lacking = keys.missing(store, flags, store.flag_names)
    return {number: key for number, key in missing.items() if number not in set(flags)} | lacking


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
