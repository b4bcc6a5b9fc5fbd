"""Failed cells, tried again: the blocks that hold them are computed as if they never had been."""

from __future__ import annotations

from dataclasses import dataclass

from sweep.execution.finalize import lost
from sweep.store.blocks import committed, drop_block, receipts
from sweep.store.closing import reopen
from sweep.store.lifecycle import open_store
from sweep.store.lock import locked
from sweep.store.receipt import Receipt
from sweep.store.run_store import RunStore


@dataclass(frozen=True, slots=True)
class Retry:
    """Blocks that are computed again.

    Attributes
    ----------
    blocks
        Their numbers.
    cells
        How many of their cells had failed or crashed.
    """

    blocks: tuple[int, ...] = ()
    cells: int = 0

    def recovered(self, store: RunStore) -> int:
        """Return how many of the cells neither failed nor crashed again."""
        return self.cells - sum(_lost(receipt) for _, receipt in receipts(store, self.blocks))


def failed_blocks(store: RunStore) -> dict[int, int]:
    """Return the committed blocks in which cells failed or crashed, and how many did.

    Raises
    ------
    StoreError
        If a receipt is damaged.
    """
    return {
        number: count for number, receipt in receipts(store, committed(store))
        if (count := _lost(receipt))
    }


def drop_failed(store: RunStore) -> tuple[RunStore, Retry]:
    """Drop the committed blocks in which cells failed or crashed, so that a run computes them.

    A finished store is marked unfinished before. A kill at any instant leaves a store that another
    run continues: a block is either as it was, or computed anew as a whole.

    Returns
    -------
    The store as it is then, and what was dropped.

    Raises
    ------
    StoreError
        If a receipt is damaged, another process writes the store, or it cannot be written.
    """
    with locked(store):
        failed = failed_blocks(store)
        if failed:
            if store.finished:
                reopen(store)
            for number in failed:
                drop_block(store, store.blocks[number])
    if not failed:
        return store, Retry()
    return open_store(store.url, "r+"), Retry(tuple(failed), sum(failed.values()))


def _lost(receipt: Receipt) -> int:
    return sum(lost(list(receipt.detection), list(receipt.estimate)).values())
