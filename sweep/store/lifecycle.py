"""The life of a store: created, continued, opened, closed."""

from __future__ import annotations

import glob
import json
import math
import os
import shutil
import time
import uuid
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple
from zlib import crc32

import numpy as np
import zarr
import zarr.errors
from numpy.typing import NDArray
from zarr.abc.store import Store
from zarr.storage import MemoryStore

from sweep.errors import ArgumentError, StoreError, path_of
from sweep.experiment import schema
from sweep.experiment.draws import DISTANCE_PARAMETERS, distance_of_side
from sweep.experiment.grid import TRIAL, Axis, Blocks
from sweep.experiment.parameters import PHOTOGRAPHS
from sweep.experiment.pipeline import Pipeline
from sweep.model.image_file import IMAGE_SUFFIXES
from sweep.plugins.loading import RECORDED, recorded_plugins
from sweep.store import blocks, files, locations
from sweep.store.blocks import RunStore
from sweep.store.lock import changing, is_written
from sweep.store.provenance import environment, fingerprint

if TYPE_CHECKING:
    import xarray as xr

# --------------------------------------------------------------------------------------------------
# The layout of a store: its arrays, their metadata, and the values of its coordinates.

#: Version of the layout of stores; another one is refused.
FORMAT = 11


class PlannedArray(NamedTuple):
    """One array of a store.

    Attributes
    ----------
    path
        Its path in the store.
    shape, chunks, dtype, dimensions, fill, attributes
        Its metadata; ``fill`` is None for Zarr's default.
    values
        Its values; None for an array to which blocks or receipts are written later.
    coordinate
        Whether it is a coordinate that is no dimension.
    """

    path: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: str
    dimensions: tuple[str, ...]
    attributes: dict[str, Any]
    fill: Any = None
    values: NDArray[Any] | None = None
    coordinate: bool = False


def planned_files(planned: Iterable[PlannedArray]) -> dict[str, bytes]:
    """Return the contents of the files that an empty store has by key, except the root's."""
    memory = MemoryStore()
    group = zarr.open_group(memory, mode="w", zarr_format=3)
    for each in planned:
        array = group.create_array(
            each.path, shape=each.shape, chunks=each.chunks, dtype=each.dtype,
            dimension_names=each.dimensions, compressors=files.codecs(), attributes=each.attributes,
            # Also what equals the fill value (a tilt of 0): a missing chunk is a deleted one.
            config={"write_empty_chunks": True}, fill_value=each.fill,
            chunk_key_encoding={"name": "default", "separator": files.SEPARATOR},
        )
        if each.values is not None:
            array[...] = each.values
    return {key: content for key, content in files.files_in(memory).items() if key != "zarr.json"}


def planned_arrays(pipeline: Pipeline, extents: tuple[int, ...]) -> list[PlannedArray]:
    """Return the arrays of a pipeline's store whose chunks are blocks of ``extents``."""
    axes = pipeline.experiment.scene_axes
    scene_extent = dict(zip((axis.name for axis in axes), extents, strict=True))
    planned = []
    for name, dimensions, values, attributes in _coordinates(pipeline):
        array = np.asarray(values)
        if array.dtype.kind in "TU":
            array = array.astype(object)
        planned.append(PlannedArray(
            name, array.shape, array.shape,
            "string" if array.dtype == object else array.dtype.str.lstrip("<>|="), dimensions,
            schema.with_description(name, attributes), None, array, dimensions != (name,)))
    for variable in pipeline.experiment.variables:
        names, shape = variable.dimensions(pipeline), variable.shape(pipeline)
        chunks = tuple(
            scene_extent.get(name, length) for name, length in zip(names, shape, strict=True))
        planned.append(PlannedArray(
            variable.name, shape, chunks, variable.dtype, names,
            schema.with_description(variable.name, variable.attributes()), variable.fill,
            coordinate=bool(variable.drawn_as)))
    count = len(Blocks(tuple(map(len, axes)), extents))
    planned.append(PlannedArray(files.RECEIPTS, (count,), (1,), "string", ("block",), {}))
    return planned


def _coordinates(
    pipeline: Pipeline,
) -> Iterator[tuple[str, tuple[str, ...], Any, Mapping[str, Any]]]:
    """Yield name, dimensions, values and attributes of each coordinate that nothing is drawn for.

    Values are numbers, truth values or texts.
    """
    for axis in pipeline.axes:
        together = [Axis(each.name, {each.name: axis.columns[each.name]}, (each,))
                    for each in axis.parameters if axis.zipped]
        for each in (axis, *together):
            yield each.name, (axis.name,), each.coordinates(), {
                "long_name": each.meaning,
                **({"zip": " ".join(each.columns)} if each.zipped else {}),
                **({"units": each.unit} if each.unit else {}),
            }
    inner = {
        name: length for variable in pipeline.experiment.variables
        for name, length in zip(variable.inner, variable.inner_shape, strict=True)
    }
    for name in sorted(inner):
        yield name, (name,), schema.LABELS[name] or np.arange(inner[name], dtype=np.int64), {}
    if any(side is not None for side in pipeline.values_of("side_px")[:1]):
        # It follows from the side: each axis' values along a dimension of their own.
        wanted = {*DISTANCE_PARAMETERS}
        axes = [axis for axis in pipeline.experiment.scene_axes if axis.columns.keys() & wanted]
        values = {name: pipeline.fixed.get(name) for name in DISTANCE_PARAMETERS}
        for axis, index in zip(axes, np.ix_(*(range(len(axis)) for axis in axes)), strict=True):
            for name in axis.columns.keys() & wanted:
                values[name] = np.array(axis.columns[name], dtype=np.float64)[index]
        distance = np.asarray(distance_of_side(values), dtype=np.float64)
        yield "distance_m", tuple(axis.name for axis in axes), np.broadcast_to(
            distance, [len(axis) for axis in axes]), {
            "long_name": "depth of the marker's centre along the optical axis", "units": "m"}
    yield from _photographs(pipeline)
    for name, (value, attributes) in schema.fixed_values(pipeline).items():
        if name not in schema.VARIABLES:
            yield name, (), value, attributes


def _photographs(
    pipeline: Pipeline,
) -> Iterator[tuple[str, tuple[str, ...], Any, Mapping[str, Any]]]:
    """Yield names and digests of photographs, coordinates along their numbers."""
    trials = pipeline.axis(TRIAL)
    if PHOTOGRAPHS not in pipeline.given or trials is None:
        return
    # Photographs of a record are in the order of their names.
    taken = sorted(
        (name, digest) for name, digest in pipeline.files.items()
        if name.lower().endswith(IMAGE_SUFFIXES)
    )
    if pipeline.is_simulated:  # two cameras' photographs have the same names
        taken = taken[: len({name.rpartition("/")[2] for name, _ in taken})]
        taken *= -(-len(trials) // max(len(taken), 1))
    if len(taken) >= len(trials):
        names, digests = zip(*taken[: len(trials)], strict=True)
        yield ("photograph", (TRIAL,), [name.rpartition("/")[2] for name in names],
               {"long_name": "file of the photograph"})
        yield "sha256", (TRIAL,), digests, {"long_name": "SHA-256 of the photograph's file"}


# --------------------------------------------------------------------------------------------------
# Files of no block. The run's metadata list them with the CRC-32 of their contents: metadata of
# the arrays and coordinates from the creation on, tables once a store is finished.

#: Groups that a finished store has.
TABLES = ("cost",)


def checksums(contents: Mapping[str, bytes]) -> dict[str, int]:
    """Return the CRC-32 of files by key."""
    return {key: crc32(content) for key, content in contents.items()}


def damaged_files(store: RunStore, *, tables: bool) -> dict[str, str]:
    """Return which listed files are missing or changed, and which of the two, by key.

    Tables are left out if they do not matter.
    """
    listed = {key: crc for key, crc in store.run_metadata["files"].items()
              if tables or key.partition("/")[0] not in TABLES}
    contents = files.read_files(store.storage, list(listed))
    return {
        key: "missing" if content is None else files.CHANGED
        for (key, crc), content in zip(listed.items(), contents, strict=True)
        if content is None or crc32(content) != crc
    }


def check_files(store: RunStore, *, tables: bool) -> None:
    """Raise DamagedStoreError if a listed file is missing or changed."""
    for key, fault in damaged_files(store, tables=tables).items():
        blocks.check_not_replaced(store)
        raise blocks.damaged(store.url, f"{key}: {fault}")


# --------------------------------------------------------------------------------------------------
# The life of a store: created, opened, finished, removed.
#
# A local store is created and deleted beside its path and renamed, so that a kill leaves no
# partial store; a remote one exists once its URL points to it.

#: Errors that reading a foreign or damaged document may raise.
UNREADABLE = (
    AttributeError, KeyError, TypeError, ValueError, RecursionError, OSError,
    zarr.errors.BaseZarrError,
)

NEW_RUN = "run its pipeline into a new store: `sweep run PIPELINE --store NEW`"


def open_store(url: str, mode: Literal["r", "r+"] = "r") -> RunStore:
    """Open a store that :func:`create_store` made.

    Raises
    ------
    StoreError
        If there is no store, or something else, or metadata or coordinates of it are damaged.
    """
    store = open_unchecked(url, mode)
    check_files(store, tables=False)  # they may be written at this moment, and blocks need none
    return store


def open_unchecked(url: str, mode: Literal["r", "r+"] = "r") -> RunStore:
    """Open a store that may be damaged; StoreError if its pipeline is lost."""
    url = locations.checked_url(url)
    storage = locations.open_storage(url, mode)
    attributes, metadata = read_root(url, storage)
    try:
        if metadata["format"] != FORMAT:
            raise StoreError(
                f"{url}: store format {metadata['format']!r}, this version of sweep has format "
                f"{FORMAT} alone; {NEW_RUN}"
            )
        if attributes.get(CHECKSUM) != _checksum(attributes):
            raise blocks.damaged(url, "zarr.json was changed", NEW_RUN)
        pipeline = Pipeline.from_text(
            str(attributes["pipeline"]), name=metadata["name"],
            source=f"{url} (its pipeline)", folder=metadata["folder"],
            files=metadata["fingerprint"]["files"], plugins=recorded_plugins(metadata),
        )
        cut = Blocks(
            tuple(len(axis) for axis in pipeline.experiment.scene_axes), tuple(metadata["block"]))
        group = zarr.open_group(
            blocks.CheckedReads(storage, url), mode=mode, zarr_format=3, use_consolidated=False)
        return RunStore(url, storage, group, pipeline, metadata["run_id"], cut)
    except UNREADABLE:
        raise StoreError(locations.not_a_store(url)) from None


def read_root(url: str, storage: Store) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the attributes of the root of a store, and the run's metadata, which are among them.

    The store may be damaged, or of another format.

    Raises
    ------
    StoreError
        If it is not a store.
    """
    try:
        with locations.translate_errors(url, "read"):
            return blocks.root_of(storage)
    except UNREADABLE:
        if files.list_folder(storage, files.RECEIPTS):
            fault = "without its zarr.json, its pipeline is lost"
            raise blocks.damaged(url, fault, NEW_RUN) from None
        raise StoreError(locations.not_a_store(url)) from None


def create_store(url: str, pipeline: Pipeline, extents: tuple[int, ...]) -> RunStore:
    """Create an empty store for a pipeline, its chunks equal to blocks of ``extents``.

    Raises
    ------
    StoreError
        If nothing can be written there.
    """
    run_id = uuid.uuid4().hex
    contents = planned_files(planned_arrays(pipeline, extents))
    metadata = {
        "format": FORMAT,
        "run_id": run_id,
        "block": list(extents),
        **_recorded(pipeline),
        "environment": environment(),
        "created": utc_now(),
        "finished": False,
        "files": checksums(contents),
    }
    contents["zarr.json"] = files.encoded(root_document(pipeline, metadata))
    remote = locations.is_remote(url)
    with locations.translate_errors(url, "written"):
        path = Path(url).resolve()  # a link may lead there
        if not remote:
            locations.check_writable(url)
            for doomed in path.parent.glob(f".{glob.escape(path.name)}.*.deleted"):
                shutil.rmtree(doomed, ignore_errors=True)  # a killed process began it
        home, folder = (url, run_id) if remote else (str(path.parent), _beside(path, "new").name)
        outside = locations.storage_at(home, read_only=False)
        try:
            files.write_files(locations.storage_at(f"{home}/{folder}", read_only=False), contents)
            if locations.exists(url):
                raise StoreError(
                    f"{url}: another process has made it meanwhile; run it again to continue")
            if not remote:
                Path(home, folder).rename(path)
        except BaseException:
            files.delete_folder(outside, folder)
            raise
        if remote:  # the URL points to it once it is complete
            files.write_files(outside, {"zarr.json": files.encoded(
                GROUP | {"attributes": {locations.POINTER: run_id}})})
    return open_store(url, "r+")


def _recorded(pipeline: Pipeline) -> dict[str, Any]:
    """Return the record of a run's pipeline in its metadata, beside the text."""
    plugins = [plugin.to_json() for plugin in pipeline.plugins]
    return {
        "name": pipeline.name, "folder": pipeline.folder, "fingerprint": fingerprint(pipeline),
        **({RECORDED: plugins} if plugins else {}),
    }


def _beside(path: Path, ending: str) -> Path:
    """Return an unused path in the folder of a local store."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.{ending}")


#: Attributes of the root: the CRC-32 of the pipeline's text and of the run's metadata, without
#: which a store is lost, and that of the whole document, which can be written again.
CHECKSUM, SEAL = "checksum", "seal"

#: The document of a group, without its attributes.
GROUP = {"zarr_format": 3, "node_type": "group"}


def root_document(
    pipeline: Pipeline, metadata: Mapping[str, Any], members: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the document of a store's root, sealed.

    Its attributes are texts and numbers, which netCDF can hold. ``members``: documents of arrays
    and groups by path, of which a finished store's root has a copy. That is not part of the Zarr 3
    specification; xarray reads it, and warns if it is missing.
    """
    coordinates = [
        array.path for array in planned_arrays(pipeline, tuple(metadata["block"]))
        if array.coordinate]
    surprising = [*pipeline.facts.camera_notes]
    attributes = {
        "title": pipeline.heading,
        "pipeline": pipeline.text,
        **pipeline.facts.camera_attributes,
        **({"camera_notes": "; ".join(surprising)} if surprising else {}),
        **({"coordinates": " ".join(coordinates)} if coordinates else {}),
        "sweep": json.dumps(metadata),
    }
    attributes[CHECKSUM] = _checksum(attributes)
    return _sealed(GROUP | {"attributes": attributes} | ({} if members is None else {
        "consolidated_metadata": {
            "kind": "inline", "must_understand": False, "metadata": members}}))


def _checksum(attributes: Mapping[str, Any]) -> str:
    return f"{crc32(attributes['pipeline'].encode() + attributes['sweep'].encode()):08x}"


def _sealed(root: Mapping[str, Any]) -> dict[str, Any]:
    """Return the root's document with the checksum of all else that it holds."""
    attributes = {name: value for name, value in root["attributes"].items() if name != SEAL}
    text = json.dumps({**root, "attributes": attributes}, sort_keys=True)
    return {**root, "attributes": {**attributes, SEAL: f"{crc32(text.encode()):08x}"}}


def is_root_sound(store: RunStore) -> bool:
    """Return whether nothing was changed in the root's document, which has a pipeline."""
    root = files.read_json(store.storage, "zarr.json") or {}
    return root == _sealed(root)


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
    storage = locations.open_storage(url, "r+")
    _, metadata = read_root(url, storage)
    with locations.translate_errors(url, "overwritten"):
        if locations.is_remote(url):
            pointer = locations.storage_at(url, read_only=False)
            with changing(url, storage):
                files.delete_files(pointer, ["zarr.json"])
            files.delete_folder(pointer, str(metadata["run_id"]))
            return
        # Renamed at once, then deleted: a kill in between leaves no partial store.
        path = Path(url).resolve()
        doomed = _beside(path, "deleted")
        with changing(url, storage):
            path.rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)


# --------------------------------------------------------------------------------------------------
# The readers' view of a store: its committed blocks.

#: Poses of a Dask chunk: a task for each block would take longer than reading the block.
POSES_TOGETHER = 1 << 20


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
    """Open a store's results, lazily; also an unfinished store's.

    Results of at most ``read_bytes`` are read at once, which is faster than through Dask.

    Raises
    ------
    StoreError
        If there is no store, or something else, or it is damaged.
    """
    store = open_store(path_of("store", url))
    import xarray as xr  # noqa: PLC0415  (slow to import, and workers do without)

    # A writer may be at any other block meanwhile, or may have been killed in the midst of one.
    shown = np.zeros(store.blocks.counts, dtype=bool)
    shown.flat[list(blocks.check_whole(store))] = True
    reads = blocks.CheckedReads(store.storage, store.url, None if shown.all() else shown, {
        variable: name for variable, (name, _) in store.chunks.items()})
    small = store.pipeline.experiment.bytes_of(math.prod(store.blocks.lengths)) <= read_bytes
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)  # of files not its own
        dataset: xr.Dataset = xr.open_zarr(
            reads, chunks=None if small else _together(store), consolidated=False, zarr_format=3)
        dataset = dataset.load() if small else dataset
    # Columns of an axis are short and asked for one by one; much of xarray and pandas does not
    # support NumPy's strings of variable length.
    columns = {name for axis in store.pipeline.axes if axis.zipped for name in axis.columns}
    loaded = {
        name: (value.dims, value.to_numpy().astype(object) if value.dtype.kind == "T"
               else value.to_numpy(), value.attrs)
        for name, value in dataset.coords.items() if value.dtype.kind == "T" or name in columns
    }
    ordered = [
        each.name for each in (*schema.VARIABLES.values(), *schema.PHOTOGRAPH_SCHEMA)
        if each.name in dataset.data_vars
    ]
    return dataset.assign_coords(loaded)[ordered]


# --------------------------------------------------------------------------------------------------
# The end of a run in its store: groups beside the results, and the mark "finished".
#
# Two processes may close a store at once: they write the same files.

def reopen(
    store: RunStore, pipeline: Pipeline | None = None, drop: Iterable[int] = ()
) -> RunStore:
    """Mark a store unfinished, so that a run computes what it lacks then; return it opened again.

    Its metadata and coordinates are written again. Its groups go, since they sum the blocks up. A
    ``pipeline`` of the same cells, such as one of another rule of stopping, is its own from then
    on: blocks are decided again, each from what it has. Blocks to ``drop`` are computed anew. A
    kill at any instant leaves a store with one of the two pipelines and whole blocks, which a run
    continues.

    Raises
    ------
    StoreError
        If another process writes the store, or it cannot be written.
    """
    contents = planned_files(planned_arrays(store.pipeline, store.blocks.extents))
    with changing(store.url, store.storage), locations.translate_errors(store.url, "written"):
        check_same_rule(store)
        metadata = store.run_metadata | ({} if pipeline is None else _recorded(pipeline)) | {
            "finished": False, "files": checksums(contents)}
        for ended in ("finished_at", "counts", "folders"):
            metadata.pop(ended, None)
        files.write_files(store.storage, contents)
        write_root(store, metadata, pipeline)
        for name in TABLES:
            files.delete_folder(store.storage, name)
        for number in drop:
            blocks.drop_block(store, store.blocks[number])
    return open_store(store.url, "r+")


def check_same_rule(store: RunStore) -> None:
    """Raise StoreError if another run has reopened a store with its own rule of stopping.

    Nobody does while this process holds the store's lock.
    """
    attributes, _ = read_root(store.url, store.storage)
    if attributes["pipeline"] != store.pipeline.text:
        raise StoreError(f"{store.url}: another run has changed when its sampling stops")


def write_groups(
    store: RunStore, groups: Mapping[str, xr.Dataset], counts: Mapping[str, Any] | None = None
) -> None:
    """Write groups of a complete store, and consolidate the metadata.

    The store is closed by a record of its ``counts``; what others wrote to its groups stays. Else
    files of earlier groups of these names go first: with other dimensions, one's folder is the
    other's file.
    """
    memory = MemoryStore()
    for name, content in groups.items():
        # Zarr 3 specifies strings of variable length, none of a fixed one.
        texts = [label for label in content.variables if content[label].dtype.kind == "U"]
        content.assign({label: content[label].astype(object) for label in texts}).to_zarr(
            memory, group=name, mode="w", zarr_format=3, consolidated=False,
            encoding={label: {"compressors": files.codecs()} for label in content.variables},
            write_empty_chunks=True,
        )
    within = tuple(f"{name}/" for name in groups)
    contents = {key: content for key, content in files.files_in(memory).items()
                if key.startswith(within)}
    metadata = store.run_metadata
    with locations.translate_errors(store.url, "written"):
        if counts is not None:
            files.delete_folder(store.storage, blocks.BEGUN)
            metadata |= {"finished": True, "finished_at": utc_now(), "counts": counts,
                         "folders": blocks.folder_states(store)}
            blocks.check_whole(store)  # after their states: they may change between the two
        listed = metadata["files"]
        others = {key: crc for key, crc in listed.items()
                  if counts is not None or not key.startswith(within)}
        if len(others) < len(listed):
            write_root(store, {**metadata, "files": others})
            for name in groups:
                files.delete_folder(store.storage, name)
        files.write_files(store.storage, contents)
        write_root(store, {**metadata, "files": others | checksums(contents)})


def write_root(
    store: RunStore, metadata: Mapping[str, Any], pipeline: Pipeline | None = None
) -> None:
    """Write the root's document, with a copy of the others' if the store is finished."""
    members = None
    if metadata["finished"]:
        # Sorted: of a folder whose members are not together Zarr finds the last ones alone.
        keys = sorted(key for key in metadata["files"] if key.endswith("/zarr.json"))
        members = {
            key.removesuffix("/zarr.json"): json.loads(content)
            for key, content in zip(keys, files.read_files(store.storage, keys), strict=True)
            if content
        }
    files.write_files(store.storage, {"zarr.json": files.encoded(
        root_document(pipeline or store.pipeline, metadata, members))})


# --------------------------------------------------------------------------------------------------
# A store that is finished: of another one, who writes it, or how to continue it.

def open_finished(url: str, mode: Literal["r", "r+"] = "r") -> RunStore:
    """Open a store.

    Raises
    ------
    StoreError
        If it is not finished: how many blocks it has, and what to do.
    """
    store = open_store(url, mode)
    if not store.finished:
        after = ("it is being written: wait until it is finished" if is_written(store.storage)
                 else "`sweep run` continues it")
        raise StoreError(f"{store.url}: unfinished: {len(blocks.committed(store)):,} of "
                         f"{len(store.blocks):,} blocks; {after}")
    return store


# --------------------------------------------------------------------------------------------------
# A pipeline by the path of its file, or of a store that was made from it.

def names_store(path: str | os.PathLike[str]) -> bool:
    """Return whether a path or URL leads to a folder or a server, where no pipeline file is."""
    # Path.is_dir would raise of a name that is too long.
    return "://" in os.fspath(path) or os.path.isdir(path)  # noqa: PTH112


def store_of(source: object, store: str | os.PathLike[str] | None) -> str | os.PathLike[str] | None:
    """Return the store that is to be written, or the one that a pipeline is read from; else None.

    None stands for the default.
    """
    if store is None and isinstance(source, (str, os.PathLike)) and names_store(source):
        return source
    return store


def read_pipeline(
    source: Pipeline | Mapping[str, Any] | str | os.PathLike[str], settings: Sequence[str] = ()
) -> Pipeline:
    """Return the pipeline of a TOML file or of a store, or a pipeline with other settings.

    Parameters
    ----------
    source
        A TOML file, the content of one, the path or URL of a store, or a pipeline.
    settings
        "key=value" with TOML values, as ``--set`` takes them.

    Raises
    ------
    ArgumentError
        If the source is none of these.
    PipelineError
        If the file or a setting is invalid.
    StoreError
        If a folder is no store, or the store cannot be read.
    """
    if isinstance(source, Mapping):
        return Pipeline.from_dict(source, settings)
    if not isinstance(source, (Pipeline, str, os.PathLike)):
        raise ArgumentError(
            "pipeline", source,
            "expected a Pipeline, the path of a TOML file or of a store, or a mapping")
    if not isinstance(source, Pipeline):
        url = os.fspath(source)
        if not names_store(url):
            return Pipeline.from_toml(url, settings)
        source = open_store(url).pipeline
    return Pipeline.from_text(
        source.text, settings, name=source.name, source=source.source, folder=source.folder)
