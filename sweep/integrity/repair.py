"""Repair of a store: damaged blocks are recomputed, other damaged files are written again."""

from __future__ import annotations

from collections.abc import Sequence

from sweep.errors import StoreError
from sweep.execution.runner import recompute
from sweep.execution.status import close
from sweep.integrity.recomputation import Damage, IntegrityReport, computable
from sweep.integrity.verification import SAMPLE, damaged_store, report_on
from sweep.store.blocks import RunStore, drop_block
from sweep.store.files import delete_files, sync, write_files
from sweep.store.layout import documents, planned_arrays
from sweep.store.lifecycle import MEASURED, linked_arrays, open_store, write_root
from sweep.store.locations import translate_errors
from sweep.store.lock import changing


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
    store = damaged_store(url, "r+")
    before = report_on(store, sample)
    lasting = [each for each in before.damage if each.lasting]
    if len(lasting) == len(before.damage) and not before.left_over:
        return before
    numbers = sorted({damage.block for damage in before.damage if damage.block is not None})
    if links := linked_arrays(store):
        raise StoreError(
            f"{url}: {links[0]} is a link: nothing is written through it; put the folder in its "
            "place"
        )
    if numbers:
        computable(store)
    with changing(url, store.storage):
        with translate_errors(url, "written"):
            _rewrite_files(store, before.damage, before.left_over)
        store = open_store(url, "r+")
        for number in numbers:
            drop_block(store, store.blocks[number])
        if numbers:
            recompute(store, numbers, workers=workers, time_limit_s=time_limit_s)
        if store.finished:
            close(store)
    after = report_on(damaged_store(url), 0)
    after.sampled, after.not_sampled = before.sampled, before.not_sampled
    after.retried = before.retried
    after.damage += lasting
    remaining = {damage.where for damage in after.damage}
    after.repaired = [damage for damage in before.damage if damage.where not in remaining]
    return after


def _rewrite_files(
    store: RunStore, damage: Sequence[Damage], left_over: Sequence[str]
) -> None:
    """Write the damaged files that belong to no block, and delete those that are left over."""
    storage = store.storage
    keys = {each.where for each in damage if each.kind == "file" and each.block is None}
    planned = planned_arrays(store.pipeline, store.blocks.extents)
    expected = documents(planned)
    write_files(storage, {
        key: content.to_bytes() for key, content in expected.items() if key in keys})
    for array in planned:
        written = {f"{array.path}/zarr.json", *(chunk for chunk, _, _ in array.pieces())}
        if array.values is not None and written & keys:
            array.create(store.group)
    for group in MEASURED:
        if any(key.startswith(f"{group}/") for key in keys):
            sync(storage.delete_dir(group))
    restored = [key for key in keys if key.startswith(("cost/", "failures/"))]
    delete_files(storage, (*left_over, *restored))
    if not store.finished:  # a finished one is closed again
        write_root(store, store.run_metadata)
