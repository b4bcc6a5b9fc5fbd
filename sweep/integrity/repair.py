"""Repair of a store: damaged blocks are recomputed, other damaged files are written again."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

from zarr.buffer import cpu, default_buffer_prototype

from sweep.errors import StoreError
from sweep.execution.finalize import close
from sweep.execution.runner import recompute
from sweep.integrity.damage import ArrayDamage, Damage, FileDamage, SampleDamage
from sweep.integrity.stored_values import computable
from sweep.integrity.verification import SAMPLE, IntegrityReport, Verification, root_document
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
"""Groups that no receipt could restore: if damaged, they are deleted, to be measured again."""


def repair(
    url: str, sample: int = SAMPLE, *, workers: int | None = None,
    time_limit_s: float | None = None,
) -> IntegrityReport:
    """Verify a store and repair it: exactly the damaged blocks are recomputed.

    Parameters
    ----------
    url
        The store.
    sample
        Scenes that are recomputed and compared before the repair.
    workers
        Processes that recompute blocks; by default, one a processor.
    time_limit_s
        Block timeout in seconds.

    Returns
    -------
    IntegrityReport
        The state after the repair; ``repaired`` lists the damage before it.

    Raises
    ------
    StoreError
        If there is no store, it cannot be written, or its blocks would be different here.
    RunError
        If blocks failed.
    """
    verification = Verification(url, "r+")
    before = verification.report(sample)
    if not before.damage and not before.left_over:
        return before
    numbers = sorted({damage.block for damage in before.damage if damage.block is not None})
    if any(isinstance(each, ArrayDamage) and each.path == RECEIPTS for each in before.damage):
        raise StoreError(
            f"{url}: its arrays are of another grid than its pipeline; `sweep run --overwrite` "
            "computes it again"
        )
    if numbers:
        computable(verification.store)
    with locked(verification.store):
        with translate_errors(url, "written"):
            _rewrite_files(verification, before.damage, before.left_over)
        store = open_store(url, "r+")
        for number in numbers:
            drop_block(store, store.blocks[number])
        if numbers:
            recompute(store, numbers, workers=workers, time_limit_s=time_limit_s)
        if store.finished:
            close(store)
    after = Verification(url, "r").report(0)
    after.sampled, after.not_sampled = before.sampled, before.not_sampled
    after.retried = before.retried
    after.damage += [each for each in before.damage if isinstance(each, SampleDamage)]
    remaining = {damage.where for damage in after.damage}
    after.repaired = [damage for damage in before.damage if damage.where not in remaining]
    return after


def _rewrite_files(
    verification: Verification, damage: Sequence[Damage], left_over: Sequence[str]
) -> None:
    """Write the damaged files that belong to no block, and delete those that are left over."""
    storage = verification.storage
    keys = {each.key for each in damage if isinstance(each, FileDamage) and each.block is None}
    paths = {each.path for each in damage if isinstance(each, ArrayDamage)}
    if "zarr.json" in keys and verification.manifest is not None:
        root = root_document(verification.manifest)
        sync(storage.set("zarr.json", cpu.Buffer.from_bytes(root)))
    for key, content in documents(verification.planned).items():
        if key in keys or key.removesuffix("/zarr.json") in paths:
            sync(storage.set(key, content))
    for planned in verification.planned:
        if planned.values is not None and (planned.path in paths or keys & planned.value_keys()):
            planned.create(verification.store.group)
    for group in MEASURED:
        if any(key.startswith(f"{group}/") for key in keys):
            sync(storage.delete_dir(group))
    restored = [key for key in keys if key.startswith(("cost/", "failures/"))]
    for key in (*left_over, *restored):
        with contextlib.suppress(FileNotFoundError):
            sync(storage.delete(key))
    write_manifest(storage, _current_manifest(verification.store, verification.planned))


def _current_manifest(store: RunStore, planned: list[PlannedArray]) -> Manifest:
    """Return the manifest of a store's files as they are."""
    of_blocks = tuple(f"{array.path}/c" for array in planned if array.values is None)

    async def gather() -> dict[str, int]:
        files = {}
        async for key in store.storage.list_prefix(""):
            if key.startswith((*of_blocks, f"{RECEIPTS}/")) and key != f"{RECEIPTS}/zarr.json":
                continue
            content = await store.storage.get(key, default_buffer_prototype())
            if content is not None:
                files[key] = digest(content.to_bytes())
        return files

    return Manifest(dict(store.group.attrs), sync(gather()))
