"""Blocks of which nothing was needed, written together: flags alone, of few different contents."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from zarr.buffer import cpu

from sweep.plan.grid import Block
from sweep.plan.schema import VARIABLES
from sweep.plan.variable import Variable
from sweep.store.blocks import (
    BEGUN,
    check_not_replaced,
    chunk_key,
    in_writing_order,
    region,
)
from sweep.store.checksums import digest
from sweep.store.durability import DurableStore
from sweep.store.layout import RECEIPTS, encoded_chunk
from sweep.store.locations import translate_errors
from sweep.store.receipt import STAGES, Receipt
from sweep.store.receipt_text import encoded
from sweep.store.run_store import RunStore
from sweep.store.zarr_sync import sync


def write_unneeded(
    store: RunStore, blocks: Sequence[Block], basis: int, processor: str
) -> list[Receipt]:
    """Write blocks that are not committed and of which nothing is needed; return their receipts.

    The values of all are written first, then their receipts. No block is marked as begun: nothing
    is computed that might end the process.

    Parameters
    ----------
    store
        A store whose sampling stops by a rule.
    blocks
        The blocks.
    basis
        What it follows from that nothing is needed.
    processor
        Features of this processor.
    """
    if not blocks:
        return []
    begun = time.perf_counter()
    flags = in_writing_order(v for v in store.variables if v.flags is not None)
    with translate_errors(store.url, "written"):
        check_not_replaced(store)
        chunks: dict[str, bytes] = {}
        digests: list[dict[str, int]] = []
        for block in blocks:
            own = {v.name: (chunk_key(store, v, block), _content(store, v, block)) for v in flags}
            chunks.update(own.values())
            digests.append({name: digest(content) for name, (_, content) in own.items()})
        _write(store, chunks)
        if isinstance(store.storage.below, DurableStore):
            store.storage.below.flush(chunks)
        wall_s = (time.perf_counter() - begun) / len(blocks)
        receipts = [
            Receipt(
                run_id=store.run_id, processor=processor, scenes=len(block),
                computed={"scenes": 0, "detections": 0, "estimates": 0},
                detection=_counts(store, "detection", block),
                estimate=_counts(store, "estimate", block),
                seconds={stage: [] for stage in STAGES}, failures=(), wall_s=wall_s,
                written=time.time(), digests=own, block=store.blocks.number(block), basis=basis,
            )
            for block, own in zip(blocks, digests, strict=True)
        ]
        check_not_replaced(store)
        _write(store, {
            f"{RECEIPTS}/c/{receipt.block}": encoded(receipt.to_json(store.format))
            for receipt in receipts
        })
        marks = {f"{BEGUN}/{receipt.block}" for receipt in receipts}
        left = marks.difference(store.storage.absent(marks, BEGUN))
        for key in left:
            with contextlib.suppress(FileNotFoundError):
                sync(store.storage.delete(key))
    return receipts


def _content(store: RunStore, variable: Variable, block: Block) -> bytes:
    """Return the content of a block's chunk of a flag where nothing was needed."""
    array = store.array(variable.name)
    extent = tuple(
        min(length - (part.start or 0), chunk) for part, length, chunk in zip(
            region(variable, store.pipeline, block), array.shape, array.chunks, strict=True)
    )
    return _filled(
        array.dtype.str, array.chunks, extent, int(variable.fill), int(variable.not_needed))


@lru_cache(maxsize=64)
def _filled(
    dtype: str, chunks: tuple[int, ...], extent: tuple[int, ...], fill: int, value: int
) -> bytes:
    """Return a stored chunk of one value, and fill values beyond the array's end."""
    values = np.full(chunks, fill, dtype=dtype)
    values[tuple(map(slice, extent))] = value
    return encoded_chunk(values)


def _counts(store: RunStore, name: str, block: Block) -> list[int]:
    """Return how often each value of a flag occurs in a block where nothing was needed."""
    variable = VARIABLES[name]
    counts = [0] * (int(variable.not_needed) + 1)
    counts[-1] = len(block) * variable.configurations(store.pipeline)
    return counts


def _write(store: RunStore, contents: Mapping[str, bytes]) -> None:
    """Write contents by their keys, all at once."""
    async def write() -> None:
        await asyncio.gather(*(
            store.storage.set(key, cpu.Buffer.from_bytes(content))
            for key, content in contents.items()
        ))

    sync(write())
    for key in contents:
        store.storage.digests.pop(key, None)
