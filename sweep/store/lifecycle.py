"""The life of a store: created, opened, finished, removed.

A local store is created and deleted beside its path and renamed, so that a kill leaves no partial
store; a remote one exists once its URL points to it.
"""

from __future__ import annotations

import json
import os
import shutil
import time
import uuid
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import zarr
import zarr.errors
from zarr.abc.store import Store
from zarr.storage import LocalStore

from sweep.errors import StoreError
from sweep.plan.attributes import with_descriptions
from sweep.plan.camera_facts import camera_facts, notes
from sweep.plan.camera_values import stored_text
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Blocks, scene_axes
from sweep.plan.schema import PHOTOGRAPH_SCHEMA, VARIABLES
from sweep.plugins.declared import RECORDED, recorded_plugins
from sweep.store.checksums import DigestingStore
from sweep.store.direct_reading import read_directly
from sweep.store.durability import DurableStore, flush, flush_tree
from sweep.store.layout import FORMAT, FORMATS, chunk_limits, planned_arrays
from sweep.store.locations import (
    POINTER,
    check_writable,
    checked_url,
    is_remote,
    is_run_id,
    not_a_store,
    open_group,
    open_storage,
    reason_of,
    storage_at,
    translate_errors,
)
from sweep.store.lock import hold
from sweep.store.manifest import Manifest, put, read_manifest, write_manifest
from sweep.store.provenance import environment, fingerprint
from sweep.store.receipt import are_counts
from sweep.store.run_store import RunStore
from sweep.store.schema_check import schema_faults
from sweep.store.snapshot import snapshot
from sweep.store.tidying import beside, tidy_beside
from sweep.store.zarr_sync import sync

if TYPE_CHECKING:
    import xarray as xr

UNREADABLE = (
    AttributeError, KeyError, TypeError, ValueError, RecursionError, OSError,
    zarr.errors.BaseZarrError,
)
"""Errors that reading a foreign, damaged or forged document may raise."""

RUN_METADATA = {
    "format": int, "name": str, "folder": str, "run_id": str, "block": list, "fingerprint": dict,
    "environment": dict, "finished": bool,
}
"""What every store records of its run, and the types; a newer version may record more."""


def open_store(url: str, mode: str = "r", *, durable: bool = False) -> RunStore:
    """Open a store that :func:`create_store` made; ``durable``: one that flushes what it writes.

    Raises
    ------
    StoreError
        If there is no store, or something else, or its arrays are not those of its pipeline.
    """
    url = checked_url(url)
    storage = open_storage(url, mode, durable=durable)
    try:
        attributes = dict(open_group(storage, mode).attrs)
    except PermissionError as error:
        raise StoreError(f"{url}: cannot be read: {reason_of(error)}") from None
    except UNREADABLE:
        if read_manifest(storage)[0] is None:
            raise StoreError(not_a_store(url)) from None
        raise StoreError(
            f"{url}: damaged: zarr.json; `sweep verify --repair` repairs it"
        ) from None
    store = store_of(url, storage, attributes, mode)
    faults = schema_faults(store)
    if faults:
        name, fault = next(iter(faults.items()))
        raise StoreError(
            f"{url}: does not fit its pipeline: {name}: {fault}; `sweep verify` lists all faults"
        )
    return store


def store_of(
    url: str, storage: DigestingStore, attributes: Mapping[str, Any], mode: str = "r"
) -> RunStore:
    """Return the store that has these root attributes; StoreError if they are no store's."""
    try:
        metadata = dict(attributes["sweep"])
        if refused := _refused_format(metadata["format"]):
            raise StoreError(f"{url}: {refused}")
        for key, kind in RUN_METADATA.items():
            if not isinstance(metadata[key], kind):
                raise TypeError(key)
        if metadata["finished"]:
            for name in ("detection", "estimate"):
                if not are_counts(metadata["counts"][name]):
                    raise TypeError(name)
        pipeline = Pipeline.from_text(
            stored_text(str(attributes["pipeline"]), metadata["format"]), name=metadata["name"],
            source=f"{url} (its pipeline)", folder=metadata["folder"],
            files=metadata["fingerprint"]["files"], plugins=recorded_plugins(metadata),
        )
        lengths, extents = tuple(len(a) for a in scene_axes(pipeline)), tuple(metadata["block"])
        if len(extents) != len(lengths) or not all(
            type(extent) is int and 1 <= extent <= length
            for extent, length in zip(extents, lengths, strict=True)
        ):
            raise ValueError(extents)
        if not is_run_id(metadata["run_id"]):
            raise ValueError(metadata["run_id"])
        storage.chunk_limits.update(chunk_limits(pipeline, extents, metadata["format"]))
        if isinstance(storage.below, DurableStore):
            storage.below.deferred = frozenset(storage.chunk_limits)
        return RunStore(
            url, open_group(storage, mode), pipeline, metadata["run_id"],
            Blocks(lengths, extents), metadata["format"],
        )
    except UNREADABLE:
        raise StoreError(not_a_store(url)) from None


def _refused_format(recorded: object) -> str:
    """Return why a store of a format cannot be opened; empty if it can."""
    if type(recorded) is int and recorded in FORMATS:
        return ""
    if isinstance(recorded, int) and recorded > FORMAT:
        return (
            f"store format {recorded} is newer than this version of sweep, which reads formats "
            f"{FORMATS[0]} to {FORMAT}; install a newer version"
        )
    return (
        f"store format {recorded}: this version of sweep reads formats {FORMATS[0]} to {FORMAT}; "
        "run its pipeline into a new store"
    )


def create_store(
    url: str, pipeline: Pipeline, extents: tuple[int, ...], *, durable: bool = False
) -> RunStore:
    """Create an empty store for a pipeline, its chunks equal to blocks of ``extents``.

    If it is ``durable``, it is complete after a power failure if it is there.

    Raises
    ------
    StoreError
        If nothing can be written there.
    """
    run_id = uuid.uuid4().hex
    with translate_errors(url, "written"):
        if is_remote(url):
            _lay_out(storage_at(f"{url}/{run_id}", read_only=False), pipeline, extents, run_id)
            # The URL points to it once it is complete.
            put(storage_at(url, read_only=False), "zarr.json", {
                "zarr_format": 3, "node_type": "group", "attributes": {POINTER: run_id},
            })
        else:
            check_writable(url)
            tidy_beside(url)
            building = beside(url, "new")
            try:
                _lay_out(LocalStore(building), pipeline, extents, run_id)
                if durable:
                    flush_tree(building)
                building.rename(Path(url).resolve())
                if durable:
                    flush(building.parent)
            except BaseException:
                _remove_unfinished(building)
                raise
    return open_store(url, "r+", durable=durable)


def _remove_unfinished(folder: Path) -> None:
    """Delete a store that could not be created.

    After the first write that fails, Zarr's others go on for a moment and may add files again.
    """
    absent = 0
    for _ in range(50):
        if folder.exists():
            shutil.rmtree(folder, ignore_errors=True)
            absent = 0
        elif (absent := absent + 1) == 3:
            return
        time.sleep(0.02)


def _lay_out(to: Store, pipeline: Pipeline, extents: tuple[int, ...], run_id: str) -> None:
    """Write a store's coordinates, its empty arrays, its attributes, and its manifest."""
    storage = DigestingStore(to)
    group = open_group(storage, "w-")
    planned = planned_arrays(pipeline, extents, FORMAT)
    for array in planned:
        array.create(group)
    coordinates = [array.path for array in planned if array.coordinate]
    surprising = notes(pipeline)
    attributes: dict[str, Any] = {
        "title": pipeline.heading,
        "pipeline": pipeline.text,
        **camera_facts(pipeline).attributes(),
        **({"camera_notes": "; ".join(surprising)} if surprising else {}),
        **({"coordinates": " ".join(coordinates)} if coordinates else {}),
        "sweep": {
            "format": FORMAT,
            "name": pipeline.name,
            "folder": pipeline.folder,
            "run_id": run_id,
            "block": list(extents),
            "fingerprint": fingerprint(pipeline),
            "environment": environment(),
            **(
                {RECORDED: [plugin.to_json() for plugin in pipeline.plugins]}
                if pipeline.plugins else {}
            ),
            "created": utc_now(),
            "finished": False,
        },
    }
    group.attrs.update(attributes)
    write_manifest(storage, Manifest(attributes, dict(storage.digests)))


def utc_now() -> str:
    """Return the date and time as stores record them."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def remove_store(url: str) -> None:
    """Delete a sweep store of which this process can take the lock, and nothing else.

    Raises
    ------
    StoreError
        If something else lies there, another process writes it, or it cannot be deleted.
    """
    storage = open_storage(url, "r+")
    metadata = read_run_metadata(url, storage)
    with translate_errors(url, "overwritten"):
        if is_remote(url):
            pointer = storage_at(url, read_only=False)
            with hold(url, storage):
                sync(pointer.delete("zarr.json"))
            sync(pointer.delete_dir(str(metadata["run_id"])))
            return
        # Renamed at once, then deleted: a kill in between leaves no partial store.
        doomed = beside(url, "deleted")
        with hold(url, storage):
            Path(url).resolve().rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)


def read_run_metadata(url: str, storage: DigestingStore) -> dict[str, Any]:
    """Return the run's metadata of a store that may be damaged or of another format.

    Raises
    ------
    StoreError
        If it is not a store.
    """
    manifest, _ = read_manifest(storage)
    try:
        attributes = open_group(storage, "r").attrs if manifest is None else manifest.attributes
        return dict(cast("dict[str, Any]", attributes["sweep"]))
    except UNREADABLE:
        raise StoreError(not_a_store(url)) from None


def open_dataset(url: str | os.PathLike[str]) -> xr.Dataset:
    """Open a store's results, lazily; also those of an unfinished one.

    Raises
    ------
    StoreError
        If there is no store, or something else, or it is damaged.
    """
    store = open_store(os.fspath(url))
    import xarray as xr  # noqa: PLC0415  (slow to import, and workers do without)

    if not is_remote(store.url):
        for planned in planned_arrays(store.pipeline, store.blocks.extents, store.format):
            for key in planned.value_keys():
                if reason := store.storage.unreadable(key):
                    raise StoreError(
                        f"{store.url}: damaged: {key} is {reason}; `sweep verify --repair` repairs "
                        "it"
                    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)  # of files not its own
            storage = snapshot(store)
            dataset: xr.Dataset = xr.open_zarr(storage, consolidated=False, zarr_format=3)
            dataset = read_directly(dataset, store, storage)
            # Short, and asked for one by one.
            together = [name for axis in store.pipeline.axes for name, _ in axis.zipped]
            dataset = dataset.assign_coords({name: dataset[name].compute() for name in together})
        # Much of xarray and pandas does not support NumPy's strings of variable length.
        texts = {name: (value.dims, value.to_numpy().astype(object), value.attrs)
                 for name, value in dataset.coords.items() if value.dtype.kind == "T"}
    except (*UNREADABLE, RuntimeError) as error:
        raise StoreError(
            f"{store.url}: damaged ({reason_of(error)}); `sweep verify --repair` repairs it"
        ) from None
    # Text, as netCDF needs it.
    dataset.attrs["sweep"] = json.dumps(dataset.attrs["sweep"])
    ordered = [
        each.name for each in (*VARIABLES.values(), *PHOTOGRAPH_SCHEMA)
        if each.name in dataset.data_vars
    ]
    return with_descriptions(dataset.assign_coords(texts)[ordered])
