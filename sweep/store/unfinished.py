"""What to say of a store that is not finished: who writes it, or how to continue it."""

from __future__ import annotations

from sweep.store.blocks import committed
from sweep.store.lock import holder
from sweep.store.run_store import RunStore


def unfinished_line(store: RunStore) -> str:
    """Return a line on a store that is not finished: its blocks, and what to do.

    A store that a living client holds is being written; any other is continued by a run.
    """
    done, blocks = len(committed(store)), len(store.blocks)
    writer = holder(store.storage)
    after = "`sweep run` continues it" if writer is None else (
        f"it is being written by {writer['host']}, process {writer['pid']}: wait until it is "
        "finished")
    return f"{store.url}: unfinished: {done:,} of {blocks:,} blocks; {after}"
