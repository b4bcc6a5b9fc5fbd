"""Whether a store's arrays are those that its pipeline and its format ask for."""

from __future__ import annotations

import asyncio
import warnings
from collections.abc import Sequence
from typing import Any

import zarr
from zarr.api import asynchronous

from sweep.store.layout import RECEIPTS, PlannedArray, planned_arrays
from sweep.store.locations import reason_of
from sweep.store.run_store import RunStore, list_folder
from sweep.store.zarr_sync import sync

GROUPS = ("commits", "cost", "failures")
"""The groups of a store."""


def schema_faults(store: RunStore) -> dict[str, str]:
    """Return the faults of a store's arrays by name: missing, unknown, or of another schema."""
    planned = {
        array.path: array
        for array in planned_arrays(store.pipeline, store.blocks.extents, store.format)
    }
    faults: dict[str, str] = {}
    present: set[str] = set()
    with warnings.catch_warnings():
        # Zarr warns of files that are not its own; they are no fault.
        warnings.simplefilter("ignore")
        keys = sync(list_folder(store.storage, ""))
        names = sorted({key for key in keys if not key.startswith(".")} | {RECEIPTS})
        for name, member in zip(names, sync(_members(store, names)), strict=True):
            if isinstance(member, KeyError):
                continue
            present.add(name)
            if isinstance(member, BaseException):
                # A damaged or forged document may raise anything.
                faults[name] = f"unreadable: {reason_of(member)}"
            elif isinstance(member, zarr.AsyncGroup):
                if name not in GROUPS:
                    faults[name] = "not a group of a sweep store"
            elif name not in planned:
                faults[name] = "not an array of a sweep store"
            elif misfit := _misfit(planned[name], zarr.Array(member)):
                faults[name] = misfit
    faults.update({
        name: "missing" for name, array in planned.items()
        if name not in present and not array.optional
    })
    return faults


async def _members(store: RunStore, names: Sequence[str]) -> list[Any]:
    """Return the root group's members, or what reading them raises; all at once."""
    group = await asynchronous.open_group(
        store.storage, mode="r", zarr_format=3, use_consolidated=False
    )
    return await asyncio.gather(*map(group.getitem, names), return_exceptions=True)


def _misfit(planned: PlannedArray, array: zarr.Array[Any]) -> str:
    try:
        return planned.misfit(array)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        return f"unreadable: {reason_of(error)}"
