"""The life of a store: created, continued, opened, closed."""

from __future__ import annotations

import contextlib
import glob
import json
import math
import os
import shutil
import time
import uuid
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from zlib import crc32

import numpy as np
import zarr
import zarr.errors
from zarr.abc.buffer import Buffer, BufferPrototype
from zarr.abc.store import ByteRequest, Store
from zarr.storage import LocalStore, WrapperStore

from sweep.errors import PipelineError, StoreError
from sweep.experiment.document import MAX_BYTES, read_document
from sweep.experiment.grid import Blocks
from sweep.experiment.pipeline import Pipeline, apply_settings, parse_settings
from sweep.experiment.sampling import texts_in
from sweep.experiment.schema import PHOTOGRAPH_SCHEMA, VARIABLES, with_descriptions
from sweep.messages import plain, refusal
from sweep.model.image_file import read_regular
from sweep.plugins.declared import RECORDED, recorded_plugins
from sweep.store.blocks import (
    BEGUN,
    RunStore,
    check_whole,
    committed,
    run_metadata_in,
)
from sweep.store.chunks import Chunks
from sweep.store.files import (
    delete_files,
    list_folder,
    parsed,
    read_files,
    read_json,
    sync,
    write_document,
)
from sweep.store.layout import (
    FORMAT,
    RECEIPTS,
    PlannedArray,
    codecs,
    documents,
    is_sound,
    misfit,
    planned_arrays,
)
from sweep.store.locations import (
    POINTER,
    check_writable,
    checked_url,
    is_remote,
    not_a_store,
    open_group,
    open_storage,
    reason_of,
    storage_at,
    translate_errors,
)
from sweep.store.lock import changing, is_written
from sweep.store.provenance import environment, fingerprint

if TYPE_CHECKING:
    import xarray as xr


# --------------------------------------------------------------------------------------------------
# Whether a store's arrays are those that its pipeline asks for.

GROUPS = ("commits", "cost", "failures")
"""The groups of a store."""


def schema_faults(store: RunStore) -> dict[str, str]:
    """Return the faults of a store's arrays by name: missing, unknown, or of another schema."""
    expected = documents(planned_arrays(store.pipeline, store.blocks.extents))
    arrays = {key.removesuffix("/zarr.json"): content for key, content in expected.items()}
    listed = {key for key in sync(list_folder(store.storage, "")) if not key.startswith(".")}
    names = sorted((listed | arrays.keys()) - {"zarr.json", *GROUPS})
    contents = read_files(store.storage, [f"{name}/zarr.json" for name in names])
    faults: dict[str, str] = {}
    for name, content in zip(names, contents, strict=True):
        if name not in arrays:
            if content is not None:
                faults[name] = "not part of a sweep store"
        elif content is None:
            faults[name] = "missing"
        elif fault := misfit(parsed(content) or {}, arrays[name]):
            faults[name] = fault
    return faults


# --------------------------------------------------------------------------------------------------
# What readers see of a store: its committed blocks, and coordinates as its pipeline has them.

class CommittedBlocks(WrapperStore[Store]):
    """A storage without the chunks of blocks that were not committed when it was made.

    A writer may be at any block meanwhile, or may have been killed in the midst of one. It holds
    only what can be pickled, so that a dataset on it can be sent to other processes.
    """

    def __init__(self, store: Store, chunks: Chunks, committed: bytes) -> None:
        super().__init__(store)
        self._chunks, self._committed = chunks, committed

    def _with_store(self, store: Store) -> Self:
        return type(self)(store, self._chunks, self._committed)

    def __eq__(self, other: object) -> bool:
        """Return whether two show the same blocks of the same storage."""
        return super().__eq__(other) and self._committed == getattr(other, "_committed", None)

    __hash__ = None  # type: ignore[assignment]

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:
        """Return a key's content; None if it is of a block that was not committed."""
        number = self._chunks.number(key)
        if number is not None and not self._committed[number]:
            return None
        return await super().get(key, prototype, byte_range)


def as_committed(store: RunStore, committed: Collection[int]) -> Store:
    """Return the storage of a store with the chunks of these blocks alone."""
    shown = np.zeros(len(store.blocks), dtype=np.uint8)
    shown[list(committed)] = 1
    return CommittedBlocks(store.storage, store.chunks, shown.tobytes())


def changed_coordinates(store: RunStore, planned: Iterable[PlannedArray]) -> dict[str, str]:
    """Return the keys of chunks that are not as the pipeline has them, and why.

    Coordinates that are drawn for each scene are variables of the blocks.
    """
    faults = {}
    for array in planned:
        for key, part, values in array.pieces():
            (content,) = read_files(store.storage, [key])
            if not content:
                faults[key] = "missing"
            elif not is_sound(content):
                faults[key] = "changed: does not fit its checksum"
            else:
                stored = np.asarray(store.array(array.path)[part])
                if stored.shape != values.shape or not (stored == values).all():
                    faults[key] = "its values differ from the pipeline's"
    return faults


# --------------------------------------------------------------------------------------------------
# The life of a store: created, opened, finished, removed.
#
# A local store is created and deleted beside its path and renamed, so that a kill leaves no
# partial store; a remote one exists once its URL points to it.

UNREADABLE = (
    AttributeError, KeyError, TypeError, ValueError, RecursionError, OSError,
    zarr.errors.BaseZarrError,
)
"""Errors that reading a foreign, damaged or forged document may raise."""

NEW_RUN = "run its pipeline into a new store: `sweep run PIPELINE --store NEW`"


def open_store(url: str, mode: str = "r") -> RunStore:
    """Open a store that :func:`create_store` made.

    Raises
    ------
    StoreError
        If there is no store, or something else, or its arrays are not those of its pipeline.
    """
    url = checked_url(url)
    storage = open_storage(url, mode)
    store = store_of(url, storage, read_attributes(url, storage), mode)
    try:
        faults = schema_faults(store)
    except (FileNotFoundError, zarr.errors.BaseZarrError):
        raise StoreError(
            f"{url}: was deleted or replaced while it was opened; try again") from None
    if faults:
        name, fault = next(iter(faults.items()))
        raise StoreError(
            f"{url}: does not fit its pipeline: {name}: {fault}; `sweep verify` lists all faults"
        )
    return store


def read_attributes(url: str, storage: Store) -> dict[str, Any]:
    """Return the attributes of a storage's root.

    Raises
    ------
    StoreError
        If there are none.
    """
    try:
        root = read_json(storage, "zarr.json") or {}
        return dict(root["attributes"])
    except PermissionError as error:
        raise StoreError(f"{url}: cannot be read: {reason_of(error)}") from None
    except UNREADABLE:
        if sync(list_folder(storage, RECEIPTS)):
            raise StoreError(
                f"{url}: damaged: without its zarr.json, its pipeline is lost; {NEW_RUN}"
            ) from None
        raise StoreError(not_a_store(url)) from None


def store_of(
    url: str, storage: Store, attributes: Mapping[str, Any], mode: str = "r"
) -> RunStore:
    """Return the store that has these root attributes; StoreError if they are no store's."""
    try:
        metadata = run_metadata_in(attributes)
        if metadata["format"] != FORMAT:
            raise StoreError(
                f"{url}: store format {metadata['format']!r}, this version of sweep has format "
                f"{FORMAT} alone; {NEW_RUN}"
            )
        if attributes.get(CHECKSUM) != _checksum(attributes):
            raise StoreError(f"{url}: damaged: zarr.json was changed; {NEW_RUN}")
        pipeline = Pipeline.from_text(
            str(attributes["pipeline"]), name=metadata["name"],
            source=f"{url} (its pipeline)", folder=metadata["folder"],
            files=metadata["fingerprint"]["files"], plugins=recorded_plugins(metadata),
        )
        blocks = Blocks(
            tuple(len(axis) for axis in pipeline.experiment.scene_axes), tuple(metadata["block"]))
        return RunStore(url, open_group(storage, mode), pipeline, metadata["run_id"], blocks)
    except UNREADABLE:
        raise StoreError(not_a_store(url)) from None


def create_store(url: str, pipeline: Pipeline, extents: tuple[int, ...]) -> RunStore:
    """Create an empty store for a pipeline, its chunks equal to blocks of ``extents``.

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
            write_document(storage_at(url, read_only=False), "zarr.json", {
                "zarr_format": 3, "node_type": "group", "attributes": {POINTER: run_id},
            })
        else:
            check_writable(url)
            _remove_deleted(url)
            building = _beside(url, "new")
            try:
                _lay_out(LocalStore(building), pipeline, extents, run_id)
                building.rename(Path(url).resolve())
            except BaseException:
                _remove_unfinished(building)
                raise
    return open_store(url, "r+")


def _beside(url: str, ending: str) -> Path:
    """Return an unused path in the folder of a local store, which may lie behind a link."""
    path = Path(url).resolve()
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.{ending}")


def _remove_deleted(url: str) -> None:
    """Delete what killed processes left of stores that they were deleting here."""
    path = Path(url).resolve()
    for doomed in path.parent.glob(f".{glob.escape(path.name)}.*.deleted"):
        shutil.rmtree(doomed, ignore_errors=True)


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


def _lay_out(storage: Store, pipeline: Pipeline, extents: tuple[int, ...], run_id: str) -> None:
    """Write a store's coordinates, its empty arrays, and its attributes."""
    group = open_group(storage, "w-")
    planned = planned_arrays(pipeline, extents)
    for array in planned:
        array.create(group)
    metadata = {
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
    }
    group.attrs.update(root_attributes(pipeline, planned, metadata))


CHECKSUM = "checksum"
"""Attribute of the root: the CRC-32 of the pipeline's text and of the run's metadata."""


def root_attributes(
    pipeline: Pipeline, planned: Iterable[PlannedArray], metadata: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the attributes of a store's root: texts and numbers, which netCDF can hold."""
    coordinates = [array.path for array in planned if array.coordinate]
    surprising = pipeline.facts.camera_notes
    attributes = {
        "title": pipeline.heading,
        "pipeline": pipeline.text,
        **pipeline.facts.camera.attributes(),
        **({"camera_notes": "; ".join(surprising)} if surprising else {}),
        **({"coordinates": " ".join(coordinates)} if coordinates else {}),
        "sweep": json.dumps(metadata),
    }
    return {**attributes, CHECKSUM: _checksum(attributes)}


def _checksum(attributes: Mapping[str, Any]) -> str:
    return f"{crc32(attributes['pipeline'].encode() + attributes['sweep'].encode()):08x}"


def utc_now() -> str:
    """Return the date and time as stores record them."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


def remove_store(url: str) -> None:
    """Delete a sweep store that no process writes, and nothing else.

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
            with changing(url, storage):
                delete_files(pointer, ["zarr.json"])
            sync(pointer.delete_dir(str(metadata["run_id"])))
            return
        # Renamed at once, then deleted: a kill in between leaves no partial store.
        doomed = _beside(url, "deleted")
        with changing(url, storage):
            Path(url).resolve().rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)


def read_run_metadata(url: str, storage: Store) -> dict[str, Any]:
    """Return the run's metadata of a store that may be damaged or of another format.

    Raises
    ------
    StoreError
        If it is not a store.
    """
    try:
        return run_metadata_in(read_attributes(url, storage))
    except UNREADABLE:
        raise StoreError(not_a_store(url)) from None


POSES_TOGETHER = 1 << 20
"""Poses of a Dask chunk: a task for each block would take longer than reading the block."""


def _together(store: RunStore) -> dict[str, int]:
    """Return the lengths of Dask chunks along the axes, each chunk of whole blocks side by side."""
    experiment = store.pipeline.experiment
    settings = math.prod(len(axis) for axis in store.pipeline.axes) // max(
        math.prod(store.blocks.lengths), 1)
    extents = list(store.blocks.extents)
    for k in reversed(range(len(extents))):
        times = max(POSES_TOGETHER // max(settings * math.prod(extents), 1), 1)
        extents[k] = min(extents[k] * times, store.blocks.lengths[k])
    return {axis.name: extent
            for axis, extent in zip(experiment.scene_axes, extents, strict=True)}


def open_dataset(url: str | os.PathLike[str], read_bytes: int = 0) -> xr.Dataset:
    """Open a store's results, lazily; also those of an unfinished one.

    Results of at most ``read_bytes`` are read at once, which is faster than through Dask.

    Raises
    ------
    StoreError
        If there is no store, or something else, or it is damaged.
    """
    store = open_store(os.fspath(url))
    import xarray as xr  # noqa: PLC0415  (slow to import, and workers do without)

    finished = store.finished
    done = check_whole(store, finished=finished)
    try:
        planned = planned_arrays(store.pipeline, store.blocks.extents)
        for key, fault in changed_coordinates(store, planned).items():
            raise StoreError(
                f"{store.url}: damaged: {key}: {fault}; `sweep verify --repair` repairs it")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)  # of files not its own
            storage = store.storage if finished else as_committed(store, done)
            dataset: xr.Dataset = xr.open_zarr(
                storage, chunks=None, consolidated=False, zarr_format=3)
            if dataset.nbytes <= read_bytes:
                dataset = dataset.load()
            else:
                dataset = xr.open_zarr(
                    storage, chunks=_together(store), consolidated=False, zarr_format=3)
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
    ordered = [
        each.name for each in (*VARIABLES.values(), *PHOTOGRAPH_SCHEMA)
        if each.name in dataset.data_vars
    ]
    return with_descriptions(dataset.assign_coords(texts)[ordered])


# --------------------------------------------------------------------------------------------------
# The end of a run in its store: groups beside the results, and the mark "finished".

MEASURED = ("cost/tradeoff", "cost/renderers")
"""Groups within groups that no receipt could restore."""


def finish(store: RunStore, groups: Mapping[str, xr.Dataset], counts: dict[str, Any]) -> None:
    """Close a complete store: write its groups, consolidate the metadata, mark it finished."""
    metadata = {
        **store.run_metadata, "finished": True, "finished_at": utc_now(), "counts": counts,
    }
    _write_groups(store, groups, metadata)


def reopen(store: RunStore, pipeline: Pipeline | None = None) -> None:
    """Mark a finished store unfinished, so that blocks of it can be computed again.

    Its groups go, since they sum the blocks up. A ``pipeline`` of the same cells is its own from
    then on. A kill at any instant leaves a store with one of the two.
    """
    metadata = {
        key: value for key, value in store.run_metadata.items()
        if key not in ("finished_at", "counts")
    }
    with translate_errors(store.url, "written"):
        write_root(store, {**metadata, "finished": False}, pipeline)
        for name in ("cost", "failures"):
            sync(store.storage.delete_dir(name))


def write_group(store: RunStore, name: str, content: xr.Dataset) -> None:
    """Write a dataset to a group of a finished store, and consolidate the metadata again."""
    _write_groups(store, {name: content}, store.run_metadata)


def write_root(
    store: RunStore, metadata: Mapping[str, Any], pipeline: Pipeline | None = None
) -> None:
    """Write the root's document, with a copy of the others' metadata if the store is finished.

    Consolidated metadata is not part of the Zarr 3 specification; xarray reads it, and warns if it
    is missing.
    """
    pipeline = pipeline or store.pipeline
    planned = planned_arrays(pipeline, store.blocks.extents)
    root: dict[str, Any] = {
        "zarr_format": 3, "node_type": "group",
        "attributes": root_attributes(pipeline, planned, metadata),
    }
    if metadata["finished"]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)
            zarr.consolidate_metadata(store.storage, zarr_format=3)
        written = read_json(store.storage, "zarr.json") or {}
        root["consolidated_metadata"] = written["consolidated_metadata"]
    # Written last: a kill before it leaves a store that is closed again.
    write_document(store.storage, "zarr.json", root)


def _write_groups(
    store: RunStore, groups: Mapping[str, xr.Dataset], metadata: Mapping[str, Any]
) -> None:
    with translate_errors(store.url, "written"):
        sync(store.storage.delete_dir(BEGUN))
        for name, content in groups.items():
            for child in sync(list_folder(store.storage, name)):
                if f"{name}/{child}" not in MEASURED:
                    with contextlib.suppress(ValueError):  # a file, such as the group's zarr.json
                        sync(store.storage.delete_dir(f"{name}/{child}"))
            # Zarr 3 specifies strings of variable length, none of a fixed one.
            texts = [label for label in content.variables if content[label].dtype.kind == "U"]
            content.assign({label: content[label].astype(object) for label in texts}).to_zarr(
                store.storage, group=name, mode="a", zarr_format=3, consolidated=False,
                encoding={label: {"compressors": codecs()} for label in content.variables},
                write_empty_chunks=True,
            )
        write_root(store, metadata)


# --------------------------------------------------------------------------------------------------
# What to say of a store that is not finished: who writes it, or how to continue it.

def unfinished_line(store: RunStore) -> str:
    """Return a line on a store that is not finished: its blocks, and what to do.

    A run continues one that no process writes.
    """
    done, blocks = len(committed(store)), len(store.blocks)
    after = "`sweep run` continues it"
    if is_written(store.storage):
        after = "it is being written: wait until it is finished"
    return f"{store.url}: unfinished: {done:,} of {blocks:,} blocks; {after}"


def open_finished(url: str) -> RunStore:
    """Open a store; StoreError if it is not finished."""
    store = open_store(url)
    if not store.finished:
        raise StoreError(unfinished_line(store))
    return store


# --------------------------------------------------------------------------------------------------
# A pipeline by the path of its file, or of a store that was made from it.

def names_store(path: str | os.PathLike[str]) -> bool:
    """Return whether a path or URL leads to a folder or a server, where no pipeline file is."""
    return "://" in os.fspath(path) or Path(path).is_dir()


def read_pipeline(path: str | os.PathLike[str], settings: Sequence[str] = ()) -> Pipeline:
    """Return the pipeline of a TOML file, or that of a store.

    Parameters
    ----------
    path
        A TOML file, or the path or URL of a store.
    settings
        "key=value" with TOML values, as ``--set`` takes them.

    Raises
    ------
    PipelineError
        If the file or a setting is invalid, or a folder is no store.
    StoreError
        If the store cannot be read.
    """
    if not names_store(path):
        return Pipeline.from_toml(os.fspath(path), settings)

    url = os.fspath(path)
    if "://" not in url and not (Path(url) / "zarr.json").exists():
        raise refusal([f"{plain(url)}: a folder that is no store; expected a TOML file or a store"])
    stored = open_store(url).pipeline
    return Pipeline.from_text(
        stored.text, settings, name=stored.name, source=f"{url} (its pipeline)",
        folder=stored.folder, camera_files=stored.files,
    )


def texts_required(path: str | os.PathLike[str], settings: Sequence[str] = ()) -> list[str]:
    """Return what a TOML file that has faults requires; nothing if it is no file of TOML."""
    try:
        document = read_document(read_regular(os.fspath(path), MAX_BYTES).decode())
        apply_settings(document, parse_settings(settings))
    except (OSError, ValueError, PipelineError):
        return []
    return texts_in(document)
