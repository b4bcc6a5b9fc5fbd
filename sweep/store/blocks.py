"""Blocks of a store: begun, written, committed by their receipts, and dropped.

A block's values are written first and its receipt last, so that a block is either complete or
absent. The receipts are the checkpoint; that a chunk exists says nothing.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import time
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from zarr.buffer import default_buffer_prototype
from zarr.storage import LocalStore

from sweep.errors import StoreError, StoreReplacedError
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, scene_axes
from sweep.plan.schema import VARIABLES
from sweep.plan.variable import Variable
from sweep.store.checksums import DigestingStore
from sweep.store.durability import DurableStore
from sweep.store.layout import RECEIPTS
from sweep.store.locations import is_remote, open_group, remote_run_id, translate_errors
from sweep.store.manifest import put
from sweep.store.receipt import NAMING_FORMAT, Receipt
from sweep.store.receipt_text import decoded, is_decodable
from sweep.store.run_store import RunStore
from sweep.store.zarr_sync import sync

BEGUN = f"{RECEIPTS}/begun"
"""Folder of a mark for each block that was begun and is not committed."""

GOVERNING = {each.present_when.flag for each in VARIABLES.values() if each.present_when}
"""The flag variables that say where numbers exist."""

RECEIPTS_AT_ONCE = 1000
"""Receipts that are read and held at a time."""


def region(variable: Variable, pipeline: Pipeline, block: Block) -> tuple[slice, ...]:
    """Return a block's part of a variable's array."""
    slices = {
        axis.name: slice(start, stop)
        for axis, start, stop in zip(
            scene_axes(pipeline), block.starts, block.stops, strict=True
        )
    }
    return tuple(slices.get(name, slice(None)) for name in variable.dimensions(pipeline))


def chunk_key(store: RunStore, variable: Variable, block: Block) -> str:
    """Return the key of a variable's one chunk that holds a block."""
    array = store.array(variable.name)
    position = tuple(
        (part.start or 0) // extent
        for part, extent in zip(
            region(variable, store.pipeline, block), array.chunks, strict=True
        )
    )
    return f"{variable.name}/{array.metadata.encode_chunk_key(position)}"


def receipt_key(number: int) -> str:
    """Return the key of a block's receipt."""
    return f"{RECEIPTS}/c/{number}"


def begin_block(store: RunStore, block: Block) -> bool:
    """Mark a block as begun; return whether it had been begun before."""
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        key = f"{BEGUN}/{store.blocks.number(block)}"
        if sync(store.storage.exists(key)):
            return True
        put(store.storage, key, {"pid": os.getpid(), "at": time.time()})
    return False


def withdraw_block(store: RunStore, block: Block) -> None:
    """Delete the mark that a block was begun, if that can be: it did not end its process."""
    with contextlib.suppress(Exception):
        sync(store.storage.delete(f"{BEGUN}/{store.blocks.number(block)}"))


def write_block(
    store: RunStore, block: Block, values: Mapping[str, NDArray[Any]], receipt: Receipt
) -> Receipt:
    """Write a block's values, then commit them by its receipt; return it with the digests.

    A block that is committed on the same basis stays as it is; on another one, it is replaced. Of a
    block of which nothing was needed, only the flags are written: its numbers are fill values.
    """
    number = store.blocks.number(block)
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        if sync(store.storage.exists(receipt_key(number))):
            if receipt.basis is None or committed_basis(store, number) == receipt.basis:
                withdraw_block(store, block)
                # Another worker was given it too, perhaps of another processor.
                return receipt_of(store, block) or receipt
            if receipt.any_needed:
                sync(store.storage.delete(receipt_key(number)))
            else:
                drop_block(store, block)
        written = [v for v in store.variables if receipt.any_needed or v.flags is not None]
        for variable in in_writing_order(written):
            array = store.array(variable.name)
            array[region(variable, store.pipeline, block)] = values[variable.name]
        check_not_replaced(store)
        keys = {variable.name: chunk_key(store, variable, block) for variable in written}
        digests = {name: _take_digest(store, key) for name, key in keys.items()}
        if isinstance(store.storage.below, DurableStore):
            store.storage.below.flush(keys.values())
        receipt = dataclasses.replace(receipt, digests=digests, block=number)
        _commit(store, receipt)
    return receipt


def _commit(store: RunStore, receipt: Receipt) -> None:
    """Write a receipt, in the place of another if there is one."""
    number = receipt.block
    if number is None:
        raise AssertionError(receipt)
    text = receipt.to_json(store.format)
    store.array(RECEIPTS)[number : number + 1] = np.array([text], dtype=object)
    store.storage.digests.pop(receipt_key(number), None)
    with contextlib.suppress(FileNotFoundError):
        sync(store.storage.delete(f"{BEGUN}/{number}"))


def recommit_block(store: RunStore, receipt: Receipt) -> None:
    """Replace a block's receipt; its values stay as they are."""
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        _commit(store, receipt)


def receipt_of(store: RunStore, block: Block) -> Receipt | None:
    """Return a block's receipt; None if it is not committed, or its receipt is damaged."""
    number = store.blocks.number(block)
    try:
        return parsed_receipt(store, number, receipt_texts(store, [number])[0])
    except (ValueError, AttributeError, KeyError, TypeError, OSError):
        return None


def committed_basis(store: RunStore, number: int) -> int | None:
    """Return the basis of a committed block."""
    receipt = receipt_of(store, store.blocks[number])
    return None if receipt is None else receipt.basis


def names_written(store: RunStore, receipt: Receipt) -> frozenset[str]:
    """Return the names of the variables of which a block has a chunk, by its receipt."""
    return store.variable_names if receipt.any_needed else store.flag_names


def in_writing_order(variables: Iterable[Variable]) -> list[Variable]:
    """Return variables in the order in which a block's are written: numbers before their flags.

    So whoever reads the store meanwhile finds no flag that speaks of a number that is not there.
    """
    return sorted(variables, key=lambda v: (v.flags is not None, v.name in GOVERNING))


def _take_digest(store: RunStore, key: str) -> int:
    """Return the digest of the content that was written under a key, and forget it."""
    if key not in store.storage.digests:
        # The same block was written twice at once in this process.
        sync(store.storage.get(key, default_buffer_prototype()))
    return store.storage.digests.pop(key)


def drop_block(store: RunStore, block: Block) -> None:
    """Delete a block's receipt and its chunks, so that it is computed again."""
    last_first = reversed(in_writing_order(store.variables))
    keys = [receipt_key(store.blocks.number(block))]
    keys += [chunk_key(store, variable, block) for variable in last_first]
    with translate_errors(store.url, "written"):
        for key in keys:
            with contextlib.suppress(FileNotFoundError):
                sync(store.storage.delete(key))


def check_not_replaced(store: RunStore) -> None:
    """Raise StoreReplacedError if another run has replaced the store since it was opened."""
    current: str | None
    if is_remote(store.url):
        current = remote_run_id(store.url)
    else:
        try:
            storage = DigestingStore(LocalStore(store.url, read_only=True))
            group = open_group(storage, "r")
            current = cast("dict[str, Any]", group.attrs["sweep"])["run_id"]
        except (KeyError, FileNotFoundError):
            current = None
    if current != store.run_id:
        raise StoreReplacedError(
            f"{store.url}: moved, or replaced by another run, while this run was in progress"
        )


def committed(store: RunStore) -> set[int]:
    """Return the numbers of the blocks that are committed."""
    async def gather(keys: AsyncIterator[str]) -> set[int]:
        return {int(key) async for key in keys if key.isascii() and key.isdecimal()}

    count = len(store.blocks)
    try:
        listed = sync(gather(store.storage.list_dir(f"{RECEIPTS}/c")))
    except FileNotFoundError:
        return set()
    return {number for number in listed if number < count}


def receipts(store: RunStore, numbers: Iterable[int]) -> Iterable[tuple[int, Receipt]]:
    """Yield the receipts of committed blocks, in the order of their numbers.

    Raises
    ------
    StoreError
        If one is damaged.
    """
    ordered = sorted(numbers)
    for start in range(0, len(ordered), RECEIPTS_AT_ONCE):
        some = ordered[start : start + RECEIPTS_AT_ONCE]
        try:
            texts = receipt_texts(store, some)
            contents = [
                parsed_receipt(store, number, text)
                for number, text in zip(some, texts, strict=True)
            ]
        except (ValueError, AttributeError, KeyError, TypeError, OSError) as error:
            raise StoreError(
                f"{store.url}: damaged receipts among blocks {some[0]} to {some[-1]} ({error}); "
                "`sweep verify --repair` repairs it"
            ) from None
        yield from zip(some, contents, strict=True)


def receipt_texts(store: RunStore, numbers: Sequence[int]) -> list[str]:
    """Return the texts of committed blocks' receipts; ValueError if one is missing or damaged."""
    array = store.array(RECEIPTS)
    if not is_decodable(array):
        return cast("list[str]", np.asarray(array.oindex[np.array(numbers)]).tolist())
    keys = [receipt_key(number) for number in numbers]
    texts = []
    for key, content in zip(keys, store.storage.contents(keys), strict=True):
        if content is None:
            raise ValueError(f"{key}: {store.storage.unreadable(key) or 'missing'}")
        texts.append(decoded(content))
    return texts


def parsed_receipt(store: RunStore, number: int, text: str) -> Receipt:
    """Return a block's receipt from its text; ValueError if it is not one of this run's."""
    receipt = Receipt.from_json(text)
    if receipt.run_id != store.run_id:
        raise ValueError("of another run")
    if receipt.block != (number if store.format >= NAMING_FORMAT else None):
        raise ValueError(f"block {number} has the receipt of block {receipt.block}")
    settings, estimators = store.configurations
    receipt.check(len(store.blocks[number]), settings, settings * estimators)
    if receipt.digests.keys() != names_written(store, receipt):
        raise ValueError("digests of other variables than the store's")
    return receipt
