"""A damaged store mended: its damaged blocks are computed again, the rest is written again."""

from __future__ import annotations

import contextlib

from zarr.buffer import cpu, default_buffer_prototype

from sweep.errors import StoreError
from sweep.execution.finalize import close
from sweep.execution.limits import TIME_LIMIT_S
from sweep.execution.runner import recompute
from sweep.integrity.verification import (
    SAMPLE,
    Check,
    IntegrityReport,
    computable,
    root_document,
)
from sweep.store.blocks import drop_block
from sweep.store.checksums import digest
from sweep.store.layout import RECEIPTS, PlannedArray, documents
from sweep.store.lifecycle import open_store
from sweep.store.locations import translate_errors
from sweep.store.lock import locked
from sweep.store.manifest import Manifest, write_manifest
from sweep.store.run_store import RunStore
from sweep.store.zarr_sync import sync

MEASURED = ("cost/tradeoff", "cost/renderers")
"""Groups of which no receipt tells: where they are damaged they go, to be measured again."""


def repair(
    url: str, sample: int = SAMPLE, *, workers: int | None = None,
    time_limit_s: float = TIME_LIMIT_S,
) -> IntegrityReport:
    """Check a store and mend what is wrong: exactly the damaged blocks are computed again.

    The verdict is that after it; ``repaired`` tells what was wrong before.

    Raises
    ------
    StoreError
        Where there is no store, or it cannot be written, or its blocks would not be the same here.
    RunError
        Where blocks failed.
    """
    check = Check(url, "r+")
    before = check.verdict(sample)
    if not before.damage and not before.left_over:
        return before
    store, place = check.store, check.place
    numbers = sorted({damage.block for damage in before.damage if damage.block is not None})
    wrong = {damage.where for damage in before.damage if damage.block is None}
    if RECEIPTS in wrong:
        raise StoreError(
            f"{url}: its arrays are of another grid than its pipeline; `sweep run --overwrite` "
            "computes it again"
        )
    if numbers:
        computable(store)
    with locked(store):
        with translate_errors(url, "written"):
            if "zarr.json" in wrong and check.manifest is not None:
                sync(place.set("zarr.json", cpu.Buffer.from_bytes(root_document(check.manifest))))
            for key, content in documents(check.planned).items():
                if wrong & {key, key.removesuffix("/zarr.json")}:
                    sync(place.set(key, content))
            for planned in check.planned:
                if planned.values is not None and wrong & {planned.path, *planned.value_keys()}:
                    planned.create(store.group)
            for group in MEASURED:
                if any(key.startswith(f"{group}/") for key in wrong):
                    sync(place.delete_dir(group))
            remade = [key for key in wrong if key.startswith(("cost/", "failures/"))]
            for key in (*before.left_over, *remade):
                with contextlib.suppress(FileNotFoundError):
                    sync(place.delete(key))
            write_manifest(place, _recorded(store, check.planned))
        store = open_store(url, "r+")
        for number in numbers:
            drop_block(store, store.blocks[number])
        if numbers:
            recompute(store, numbers, workers=workers, time_limit_s=time_limit_s)
        if store.finished:
            close(store)
    after = Check(url, "r").verdict(0)
    after.sampled, after.not_sampled = before.sampled, before.not_sampled
    # What no block can be blamed for is not mended by computing blocks again.
    after.damage += [damage for damage in before.damage if damage.where == "sample"]
    left = {damage.where for damage in after.damage}
    after.repaired = [damage for damage in before.damage if damage.where not in left]
    return after


def _recorded(store: RunStore, planned: list[PlannedArray]) -> Manifest:
    """Return the manifest of a store as it is now."""
    blocks = tuple(f"{array.path}/c" for array in planned if array.values is None)

    async def gather() -> dict[str, int]:
        files = {}
        async for key in store.storage.list_prefix(""):
            if key.startswith((*blocks, f"{RECEIPTS}/")) and key != f"{RECEIPTS}/zarr.json":
                continue
            content = await store.storage.get(key, default_buffer_prototype())
            if content is not None:
                files[key] = digest(content.to_bytes())
        return files

    return Manifest(dict(store.group.attrs), sync(gather()))
