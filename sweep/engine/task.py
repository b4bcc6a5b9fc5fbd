"""What a worker does: compute one block, write it, and return a receipt."""

from __future__ import annotations

import time
from functools import lru_cache
from typing import Any

import numpy as np

from sweep.engine.fingerprint import fingerprint
from sweep.engine.store import RunStore, open_store, write_block
from sweep.errors import StoreError
from sweep.kernel import run_block
from sweep.plan.grid import Block

MOST_FAILURES = 20
"""Tracebacks that a receipt holds; beyond, failures are counted by their flags."""


@lru_cache(maxsize=4)
def _opened(url: str, run_id: str) -> RunStore:
    """Open a store once in each process, and see that its numbers can be made here."""
    store = open_store(url, "r+")
    if store.run_id != run_id:
        raise StoreError(f"{url}: replaced by another run while this one was going on")
    here, there = fingerprint(store.pipeline), store.fingerprint
    for key, value in there.items():
        if here.get(key) != value:
            raise StoreError(
                f"a worker has {key} {here.get(key)}, the store was begun with {value}; "
                "install the same version on every machine"
            )
    return store


def compute_block(url: str, run_id: str, block: Block) -> dict[str, Any]:
    """Compute, write and commit one block; return its receipt (also when it is run twice)."""
    start = time.perf_counter()
    store = _opened(url, run_id)
    result = run_block(store.pipeline, block)
    detection = np.bincount(result.values["detection"].ravel())
    estimate = np.bincount(result.values["estimate"].ravel())
    receipt = {
        "scenes": len(block),
        "detection": detection.tolist(),
        "estimate": estimate.tolist(),
        "seconds": result.seconds,
        "failures": [
            {"scene": f.scene, "stage": f.stage, "text": f.text}
            for f in result.failures[:MOST_FAILURES]
        ],
    }
    receipt["wall_s"] = time.perf_counter() - start
    write_block(store, block, result.values, receipt)
    return receipt
