"""Closing a complete store: tables of costs and failures, and counts of flags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sweep.errors import StoreError
from sweep.execution.settled import sampled_conditions
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plan.axes import Axis
from sweep.plan.parameters import Stage
from sweep.store.blocks import check_not_replaced, committed, receipts
from sweep.store.closing import finish
from sweep.store.failures import MAX_ROWS, FailedCell, failed_cells, failure_table
from sweep.store.run_store import RunStore
from sweep.store.snapshot import missing_chunks

if TYPE_CHECKING:
    import xarray as xr


def close(store: RunStore) -> None:
    """Close a store of which every block is committed.

    Its receipts are summed up in the groups ``cost`` and ``failures``, which may be empty; then it
    is marked finished.

    Raises
    ------
    StoreError
        If a receipt is damaged, a chunk is missing, or the store cannot be written.
    """
    check_not_replaced(store)
    done = committed(store)
    if missing := missing_chunks(store, done):
        number, key = next(iter(missing.items()))
        raise StoreError(
            f"{store.url}: damaged: {len(missing):,} committed blocks lack chunks, such as {key} "
            f"of block {number}"
        )
    blocks: list[tuple[int, Mapping[str, Sequence[float]]]] = []
    cells: list[FailedCell] = []
    kept: Counter[str] = Counter()
    counts = {"detection": [0] * len(DetectionStatus), "estimate": [0] * len(EstimateStatus)}
    needed: dict[int, int] = {}
    for number, receipt in receipts(store, done):
        needed[number] = receipt.scenes_needed
        if receipt.seconds["scene"]:
            blocks.append((number, receipt.seconds))
        for name, flags in (("detection", receipt.detection), ("estimate", receipt.estimate)):
            for flag, count in enumerate(flags):
                counts[name][flag] += count
        for cell in failed_cells(store, number, receipt):
            kept[cell.kind] += 1
            if kept[cell.kind] <= MAX_ROWS:
                cells.append(cell)
    failures = failure_table(cells, lost(counts["detection"], counts["estimate"]))
    sampled = sampled_conditions(store, needed)
    recorded: dict[str, Any] = dict(counts) if sampled is None else {
        **counts, "sampled": sampled.to_json()}
    finish(store, {"cost": _cost(store, blocks), "failures": failures}, recorded)


def lost(detection: list[int], estimate: list[int]) -> dict[str, int]:
    """Return how many cells failed and crashed, from counts by flag.

    Parameters
    ----------
    detection, estimate
        Counts of cells; the flag is the index.
    """
    def count(flags: list[int], flag: int) -> int:
        return flags[flag] if len(flags) > flag else 0

    return {
        kind: count(detection, DetectionStatus[kind]) + count(estimate, EstimateStatus[kind])
        for kind in ("crashed", "failed")
    }


def _cost(
    store: RunStore, blocks: Sequence[tuple[int, Mapping[str, Sequence[float]]]]
) -> xr.Dataset:
    """Return the cost group: seconds of each block per stage and configuration."""
    import xarray as xr  # noqa: PLC0415  (slow to import, and often not needed)

    pipeline = store.pipeline
    settings = list(pipeline.axes_of(Stage.detection))
    both = [*settings, *pipeline.axes_of(Stage.estimation)]

    def shaped(values: list[Any], axes: list[Axis]) -> Any:
        return np.asarray(values, dtype=np.float64).reshape(
            (len(blocks), *(len(axis) for axis in axes))
        )

    return xr.Dataset(
        {
            "scene_s": (("block",), shaped([s["scene"][0] for _, s in blocks], [])),
            "detection_s": (
                ("block", *(axis.name for axis in settings)),
                shaped([s["detection"] for _, s in blocks], settings),
            ),
            "estimation_s": (
                ("block", *(axis.name for axis in both)),
                shaped([s["estimation"] for _, s in blocks], both),
            ),
        },
        coords={
            "block": [number for number, _ in blocks],
            **{axis.name: axis.coordinates().astype(object)
               if axis.coordinates().dtype.kind == "T" else axis.coordinates() for axis in both},
        },
        attrs={"long_name": "seconds per stage and treatment for each block"},
    )
