"""The check of a store's blocks: digests of their chunks, and flags against numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.integrity.consistency import contradiction
from sweep.integrity.damage import BlockDamage, Damage, FileDamage
from sweep.plan.grid import Block, scene_axes
from sweep.plan.variable import Variable
from sweep.store.blocks import names_written, parsed_receipt, receipt_key, region
from sweep.store.checksums import digest
from sweep.store.layout import RECEIPTS, decoded_chunk
from sweep.store.receipt import Receipt
from sweep.store.receipt_text import decoded, is_decodable
from sweep.store.run_store import RunStore
from sweep.store.snapshot import BlockKeys

THREADS, WINDOW = 4, 256
"""Blocks that are read and decoded at a time, and that are submitted at a time."""

CHANGED = "changed: does not fit its checksum"


@dataclass(frozen=True, slots=True)
class CheckedBlock:
    """A block that was checked.

    Attributes
    ----------
    number
        Its number.
    bytes
        Size of its receipt and its chunks.
    receipt
        Its receipt; None if that is damaged.
    damage
        What is damaged.
    """

    number: int
    bytes: int
    receipt: Receipt | None
    damage: Sequence[Damage]


class BlockCheck:
    """Checks blocks of a store in several threads."""

    def __init__(self, store: RunStore) -> None:
        self._store = store
        self._keys = BlockKeys(store)

    def run(self, numbers: Sequence[int]) -> Iterator[CheckedBlock]:
        """Yield the blocks of these numbers in order, checked."""
        with ThreadPoolExecutor(THREADS) as pool:
            # A window at a time: there may be very many.
            for start in range(0, len(numbers), WINDOW):
                yield from pool.map(self._check, numbers[start : start + WINDOW])

    def _check(self, number: int) -> CheckedBlock:
        """Check one block; called in any thread."""
        store, block = self._store, self._store.blocks[number]
        key = receipt_key(number)
        chunks = self._keys.of_chunks(number)
        keys = [key, *chunks.values()]
        contents = dict(zip(keys, store.storage.contents(keys), strict=True))
        faults = {
            key: store.storage.unreadable(key) or "missing"
            for key, content in contents.items() if content is None
        }
        receipt = None
        if contents[key] is not None:
            receipt = self._receipt(number, contents[key])
            if receipt is None:
                faults[key] = CHANGED
        values: dict[str, NDArray[Any]] = {}
        written = store.variable_names if receipt is None else names_written(store, receipt)
        for variable in store.variables:
            content = contents[chunks[variable.name]]
            if variable.name not in written:
                faults.pop(chunks[variable.name], None)
                if content is not None:
                    faults[chunks[variable.name]] = "numbers of a block of which none was needed"
                values[variable.name] = self._fill(variable, block)
                continue
            if content is None:
                continue
            decoded = self._values(content, variable, block, receipt)
            if decoded is None:
                faults[chunks[variable.name]] = CHANGED
            else:
                values[variable.name] = decoded
        damage: list[Damage] = [FileDamage(key, what, number) for key, what in faults.items()]
        if not faults and receipt is not None:
            fault = contradiction(store.pipeline, store.variables, values, receipt)
            if fault:
                damage.append(BlockDamage(number, str(block), fault))
        return CheckedBlock(
            number, sum(len(content) for content in contents.values() if content is not None),
            receipt, damage,
        )

    def _fill(self, variable: Variable, block: Block) -> NDArray[Any]:
        """Return what a block holds of a variable of which it has no chunk."""
        pipeline = self._store.pipeline
        along = dict(zip((axis.name for axis in scene_axes(pipeline)), block.shape, strict=True))
        shape = [
            along.get(name, length) for name, length in zip(
                variable.dimensions(pipeline), variable.shape(pipeline), strict=True)
        ]
        return np.full(shape, variable.fill, dtype=variable.dtype)

    def _receipt(self, number: int, content: bytes | None) -> Receipt | None:
        """Return a block's receipt from its chunk; None if it is damaged."""
        array = self._store.array(RECEIPTS)
        try:
            if content is not None and is_decodable(array):
                text = decoded(content)
            else:
                text = np.asarray(array[number : number + 1]).tolist()[0]
            return parsed_receipt(self._store, number, text)
        except Exception:
            # Decoding a damaged chunk may raise anything.
            return None

    def _values(
        self, content: bytes, variable: Variable, block: Block, receipt: Receipt | None
    ) -> NDArray[Any] | None:
        """Return a chunk's values within the grid; None if it fails a checksum."""
        if receipt is not None and digest(content) != receipt.digests[variable.name]:
            return None
        array = self._store.array(variable.name)
        try:
            cells = decoded_chunk(content, array.dtype, array.chunks)
        except (ValueError, RuntimeError):
            return None
        part = region(variable, self._store.pipeline, block)
        return cells[tuple(
            slice(0, (along.stop or length) - (along.start or 0))
            for along, length in zip(part, array.shape, strict=True)
        )]
