"""Repair of a store: damaged blocks are recomputed, other damaged files are written again."""

from __future__ import annotations

from collections.abc import Collection

from sweep.execution.runner import recompute
from sweep.execution.status import close
from sweep.integrity.recomputation import computable
from sweep.integrity.verification import SAMPLE, IntegrityReport, report_on
from sweep.store.blocks import RunStore, drop_block
from sweep.store.files import delete_files, sync, write_files
from sweep.store.layout import planned_arrays, planned_files
from sweep.store.lifecycle import (
    MEASURED,
    checksums,
    is_of_table,
    open_store,
    open_unchecked,
    write_root,
)
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
    store = open_unchecked(url, "r+")
    before = report_on(store, sample)
    lasting = [each for each in before.damage if before.unstable and each.where == before.unstable]
    if before.damage == lasting and not before.left_over:
        return before
    numbers = sorted({damage.block for damage in before.damage if damage.block is not None})
    if numbers:
        computable(store)
    with changing(url, store.storage):
        with translate_errors(url, "written"):
            delete_files(store.storage, before.left_over)
            _rewrite(store, {each.where for each in before.damage if each.block is None})
        store = open_store(url, "r+")
        for number in numbers:
            drop_block(store, store.blocks[number])
        if numbers:
            recompute(store, numbers, workers=workers, time_limit_s=time_limit_s)
        if store.finished:
            close(store)
    after = report_on(open_unchecked(url), 0)
    after.sampled, after.not_sampled = before.sampled, before.not_sampled
    after.unstable, after.damage = before.unstable, after.damage + lasting
    remaining = {damage.where for damage in after.damage}
    after.repaired = [damage for damage in before.damage if damage.where not in remaining]
    return after


def _rewrite(store: RunStore, keys: Collection[str]) -> None:
    """Write the files of these keys that follow from the pipeline; delete those of tables.

    A finished store's tables are written when it is closed again, but for what was measured.
    """
    planned = planned_files(planned_arrays(store.pipeline, store.blocks.extents))
    again = {key: planned[key] for key in keys if key in planned}
    write_files(store.storage, again)
    metadata = store.run_metadata
    files = {**metadata["files"], **checksums(again)}
    for group in MEASURED:
        if any(key.startswith(f"{group}/") for key in keys):
            sync(store.storage.delete_dir(group))
            files = {key: value for key, value in files.items() if not key.startswith(f"{group}/")}
    delete_files(store.storage, filter(is_of_table, keys))
    write_root(store, {**metadata, "files": files})
