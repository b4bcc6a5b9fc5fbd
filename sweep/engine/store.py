"""The Zarr store: laid out by the template, written a block at a time, committed by receipts.

A block's values are written first and its receipt last, so that a block is either whole or not
there. The receipts are the checkpoint; that a chunk exists says nothing.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
import uuid
import warnings
from collections.abc import AsyncIterator, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import zarr
import zarr.errors
from numpy.typing import NDArray
from zarr.abc.store import Store
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.buffer import cpu, default_buffer_prototype
from zarr.core.sync import sync

from sweep.engine.provenance import environment, fingerprint
from sweep.errors import StoreError
from sweep.model.camera import VIEW_PARAMETERS
from sweep.plan.axes import Axis
from sweep.plan.grid import Block, Blocks, resolve_distance, scene_axes
from sweep.plan.pipeline import Pipeline
from sweep.plan.template import LABELS, TEMPLATE, Variable

if TYPE_CHECKING:
    import xarray as xr

FORMAT = 1
"""Version of the store's layout."""

RECEIPTS = "commits/receipt"
"""Array of the blocks' receipts by number, JSON, a chunk each; empty where not committed."""

REQUIRED = {"scenes", "detection", "estimate", "seconds", "failures", "written"}
"""What every receipt holds."""

COORDINATE_CHUNK = 1 << 20


@dataclass(frozen=True)
class RunStore:
    """An open store: where it is, what it holds, and how its grid is cut."""

    url: str
    group: zarr.Group
    pipeline: Pipeline
    run_id: str
    blocks: Blocks
    _arrays: dict[str, zarr.Array[Any]] = field(default_factory=dict, repr=False, compare=False)

    def array(self, name: str) -> zarr.Array[Any]:
        """Return an array by its path; its metadata is read once."""
        if name not in self._arrays:
            self._arrays[name] = cast("zarr.Array[Any]", self.group[name])
        return self._arrays[name]

    @property
    def finished(self) -> bool:
        """Whether every block is committed and the store is closed."""
        return bool(self.about["finished"])

    @property
    def fingerprint(self) -> dict[str, Any]:
        """The fingerprint of the run that made the store."""
        return dict(self.about["fingerprint"])

    @property
    def about(self) -> dict[str, Any]:
        """What is recorded of the run: format, run id, fingerprint, environment, dates."""
        return _about(self.group)


def _about(group: zarr.Group) -> dict[str, Any]:
    return dict(cast("dict[str, Any]", group.attrs["sweep"]))


def is_remote(url: str) -> bool:
    """Tell whether a store is not a local path."""
    return "://" in url


def _open_group(url: str, mode: str) -> zarr.Group:
    return zarr.open_group(url, mode=mode, use_consolidated=False)  # type: ignore[arg-type]


def exists(url: str) -> bool:
    """Tell whether anything is at a store's place."""
    if not is_remote(url):
        return Path(url).exists() or Path(url).is_symlink()
    try:
        _open_group(url, "r")
    except (FileNotFoundError, zarr.errors.GroupNotFoundError):
        return False
    except (ImportError, ValueError, OSError) as error:
        raise StoreError(f"{url}: cannot be reached: {error}") from None
    return True


def open_store(url: str, mode: str = "r") -> RunStore:
    """Open a store that :func:`create_store` made.

    Raises
    ------
    StoreError
        Where there is none, or something else.
    """
    if not exists(url):
        raise StoreError(f"{url}: there is no store; `sweep run` makes one")
    try:
        group = _open_group(url, mode)
        about = _about(group)
        pipeline = Pipeline.from_text(
            str(group.attrs["pipeline"]), name=about["name"], source=f"{url} (its pipeline)",
            folder=about["folder"], files=about["fingerprint"]["files"],
        )
        if about["format"] != FORMAT:
            raise StoreError(f"{url}: store format {about['format']}, expected {FORMAT}")
        lengths, extents = tuple(len(a) for a in scene_axes(pipeline)), tuple(about["block"])
        if len(extents) != len(lengths) or not all(extent >= 1 for extent in extents):
            raise ValueError(extents)
        blocks = Blocks(lengths, extents)
        return RunStore(url, group, pipeline, about["run_id"], blocks)
    except (KeyError, TypeError, ValueError, OSError, zarr.errors.BaseZarrError) as error:
        if isinstance(error, PermissionError):
            raise StoreError(f"{url}: cannot be read: {error.strerror}") from None
        raise StoreError(
            f"{url}: holds something else than a store of sweep; name another place"
        ) from None


def check_place(url: str) -> None:
    """See that a local store can be made at a place, before any work is done for it.

    Raises
    ------
    StoreError
        Where it cannot be written.
    """
    if is_remote(url):
        return
    try:
        Path(url).parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=Path(url).parent, prefix=".sweep-"):
            pass
    except OSError as error:
        raise StoreError(f"{url}: cannot be written: {error.strerror or error}") from None


def create_store(url: str, pipeline: Pipeline, extents: tuple[int, ...]) -> RunStore:
    """Lay out an empty store for a pipeline, its chunks equal to blocks of ``extents``.

    Raises
    ------
    StoreError
        Where the place cannot be written.
    """
    try:
        if is_remote(url):
            _lay_out(url, pipeline, extents)
        else:
            # Beside its place and then moved there: a kill between leaves no half a store.
            check_place(url)
            building = _beside(url, "new")
            try:
                _lay_out(str(building), pipeline, extents)
                building.rename(url)
            finally:
                shutil.rmtree(building, ignore_errors=True)
    except OSError as error:
        raise StoreError(f"{url}: cannot be written: {error.strerror or error}") from None
    return open_store(url, "r+")


def _beside(url: str, ending: str) -> Path:
    """Return an unused path in the folder of a local store."""
    return Path(url).with_name(f".{Path(url).name}.{uuid.uuid4().hex[:8]}.{ending}")


def _lay_out(url: str, pipeline: Pipeline, extents: tuple[int, ...]) -> None:
    """Write a store's coordinates, its empty arrays, and its attributes last."""
    group = _open_group(url, "w-")
    scene_extent = dict(zip((axis.name for axis in scene_axes(pipeline)), extents, strict=True))
    for axis in pipeline.axes:
        _write_axis(group, axis)
    used = {name for variable in TEMPLATE for name in variable.inner}
    for name in sorted(used):
        _write_strings(group, name, LABELS[name], {})
    coordinates = _write_distance(group, pipeline)
    for variable in TEMPLATE:
        _create_variable(group, variable, pipeline, scene_extent)
    lengths = tuple(len(axis) for axis in scene_axes(pipeline))
    group.create_array(
        RECEIPTS, shape=(len(Blocks(lengths, extents)),), chunks=(1,), dtype="string",
        dimension_names=("block",), compressors=_codecs(),
    )
    group.attrs.update(
        {
            "title": pipeline.title or pipeline.name,
            "pipeline": pipeline.text,
            **({"coordinates": " ".join(coordinates)} if coordinates else {}),
            "sweep": {
                "format": FORMAT,
                "name": pipeline.name,
                "folder": pipeline.folder,
                "run_id": uuid.uuid4().hex,
                "block": list(extents),
                "fingerprint": fingerprint(pipeline),
                "environment": environment(),
                "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
                "finished": False,
            },
        }
    )


def remove_store(url: str) -> None:
    """Delete a store of sweep, and nothing else.

    Raises
    ------
    StoreError
        Where something else is there, or it cannot be deleted.
    """
    store = open_store(url, "r+")
    try:
        if is_remote(url):
            sync(store.group.store.clear())
            return
        # Out of the way at once, then at leisure: a kill between leaves no half a store.
        doomed = _beside(url, "deleted")
        Path(url).rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)
    except OSError as error:
        raise StoreError(f"{url}: cannot be overwritten: {error.strerror or error}") from None


def _codecs() -> list[Any]:
    """Return the codecs of every array: a damaged chunk fails its checksum when it is read."""
    return [ZstdCodec(level=3), Crc32cCodec()]


def _create_variable(
    group: zarr.Group, variable: Variable, pipeline: Pipeline, scene_extent: dict[str, int]
) -> None:
    names, shape = variable.dimensions(pipeline), variable.shape(pipeline)
    chunks = tuple(
        scene_extent.get(name, length) for name, length in zip(names, shape, strict=True)
    )
    group.create_array(
        variable.name, shape=shape, chunks=chunks or (), dtype=variable.dtype,
        fill_value=variable.fill, dimension_names=names, compressors=_codecs(),
        attributes=variable.attributes(),
    )


def _write_axis(group: zarr.Group, axis: Axis) -> None:
    attributes: dict[str, Any] = {"long_name": axis.meaning}
    if axis.unit:
        attributes["units"] = axis.unit
    if axis.labelled:
        _write_strings(group, axis.name, axis.coordinates().tolist(), attributes)
        return
    chunk = min(len(axis), COORDINATE_CHUNK)
    array = group.create_array(
        axis.name, shape=(len(axis),), chunks=(chunk,), dtype=axis.coordinates(0, 1).dtype,
        dimension_names=(axis.name,), compressors=_codecs(), attributes=attributes,
    )
    for start in range(0, len(axis), chunk):
        stop = min(start + chunk, len(axis))
        array[start:stop] = axis.coordinates(start, stop)


def _write_strings(
    group: zarr.Group, name: str, labels: Iterable[str], attributes: dict[str, Any]
) -> None:
    values = np.array(list(labels), dtype=object)
    array = group.create_array(
        name, shape=values.shape, chunks=values.shape, dtype="string",
        dimension_names=(name,), attributes=attributes,
    )
    array[:] = values


def _write_distance(group: zarr.Group, pipeline: Pipeline) -> list[str]:
    """Write ``distance_m`` as a coordinate where it follows from ``side_px``; return its name."""
    sides = pipeline.values_of("side_px")
    if not sides or sides[0] is None:
        return []
    names = (*VIEW_PARAMETERS, "size_m", "side_px")
    axes = [axis for axis in scene_axes(pipeline) if axis.name in names]
    grids = np.meshgrid(
        *(np.array(axis.values, dtype=np.float64) for axis in axes), indexing="ij", sparse=True
    )
    values = {**{name: pipeline.fixed.get(name) for name in names},
              **{axis.name: grid for axis, grid in zip(axes, grids, strict=True)}}
    resolve_distance(values)
    distance = np.broadcast_to(
        np.asarray(values["distance_m"], dtype=np.float64), tuple(len(axis) for axis in axes)
    )
    array = group.create_array(
        "distance_m", shape=distance.shape, chunks=distance.shape, dtype="f8",
        dimension_names=tuple(axis.name for axis in axes),
        attributes={"long_name": "depth of the marker's centre along the optical axis",
                    "units": "m"},
    )
    array[...] = distance
    return ["distance_m"]


def region(variable: Variable, pipeline: Pipeline, block: Block) -> tuple[slice, ...]:
    """Return a block's part of a variable's array."""
    cuts = {
        axis.name: slice(start, stop)
        for axis, start, stop in zip(
            scene_axes(pipeline), block.starts, block.stops, strict=True
        )
    }
    return tuple(cuts.get(name, slice(None)) for name in variable.dimensions(pipeline))


def write_block(
    store: RunStore, block: Block, values: dict[str, NDArray[Any]], receipt: dict[str, Any]
) -> None:
    """Write a block's values, then commit them by its receipt."""
    _see_that_it_is_ours(store)
    for variable in TEMPLATE:
        array = store.array(variable.name)
        array[region(variable, store.pipeline, block)] = values[variable.name]
    _see_that_it_is_ours(store)
    number = store.blocks.number(block)
    content = json.dumps({"run_id": store.run_id, **receipt}, separators=(",", ":"))
    store.array(RECEIPTS)[number : number + 1] = np.array([content], dtype=object)


def _see_that_it_is_ours(store: RunStore) -> None:
    """Raise StoreError where another run has replaced the store since it was opened."""
    try:
        run_id = _about(_open_group(store.url, "r"))["run_id"]
    except (KeyError, FileNotFoundError):
        run_id = None
    if run_id != store.run_id:
        raise StoreError(f"{store.url}: replaced by another run while this one was going on")


def put(store: Store, key: str, content: dict[str, Any]) -> None:
    """Write a small JSON document beside the arrays."""
    encoded = json.dumps(content, separators=(",", ":")).encode()
    sync(store.set(key, cpu.Buffer.from_bytes(encoded)))


def get(store: Store, key: str) -> dict[str, Any] | None:
    """Read a small JSON document; None where it is not there or is torn."""
    buffer = sync(store.get(key, default_buffer_prototype()))
    if buffer is None:
        return None
    try:
        content = json.loads(buffer.to_bytes())
    except ValueError:
        return None
    return content if isinstance(content, dict) else None


def committed(store: RunStore) -> set[int]:
    """Return the numbers of the blocks that are committed."""
    async def gather(keys: AsyncIterator[str]) -> set[int]:
        return {int(key) async for key in keys if key.isdecimal()}

    try:
        return sync(gather(store.group.store.list_dir(f"{RECEIPTS}/c")))
    except FileNotFoundError:
        return set()


def receipts(
    store: RunStore, numbers: Iterable[int]
) -> Iterable[tuple[int, dict[str, Any]]]:
    """Yield the receipts of committed blocks by number."""
    ordered = sorted(numbers)
    for start in range(0, len(ordered), 1000):
        some = ordered[start : start + 1000]
        try:
            texts = np.asarray(store.array(RECEIPTS).oindex[np.array(some)]).tolist()
            contents = [json.loads(text) for text in texts]
            if not all(content.keys() >= REQUIRED for content in contents):
                raise ValueError("incomplete")
        except (ValueError, AttributeError, KeyError) as error:
            raise StoreError(
                f"{store.url}: damaged receipts among blocks {some[0]} to {some[-1]} ({error}); "
                "--overwrite computes the store again"
            ) from None
        yield from zip(some, contents, strict=True)


def finish(store: RunStore, cost: xr.Dataset) -> None:
    """Close a complete store: its cost group, the mark, and the metadata in one place."""
    about = store.about
    about["finished"] = True
    about["finished_at"] = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    write_group(store, "cost", cost, about)


def write_group(
    store: RunStore, name: str, content: xr.Dataset, about: dict[str, Any] | None = None
) -> None:
    """Write a dataset to a group of a complete store, then what is new about the store, if any.

    All metadata is then put in one place.
    """
    # Zarr 3 specifies strings of any length, none of a fixed one.
    texts = [label for label in content.variables if content[label].dtype.kind == "U"]
    content = content.assign({label: content[label].astype(object) for label in texts})
    with warnings.catch_warnings():
        # Consolidated metadata is not part of the Zarr 3 specification; xarray reads it, and
        # warns where it is missing.
        warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)
        content.to_zarr(store.url, group=name, mode="w", zarr_format=3, consolidated=False)
        if about is not None:
            store.group.attrs["sweep"] = about
        zarr.consolidate_metadata(store.group.store, zarr_format=3)


def open_dataset(url: str | os.PathLike[str]) -> xr.Dataset:
    """Open a store's results, lazily; also those of an unfinished one.

    Raises
    ------
    StoreError
        Where there is none, or something else.
    """
    store = open_store(os.fspath(url))
    import xarray as xr  # noqa: PLC0415  (slow to import, and workers do without)

    dataset: xr.Dataset = xr.open_zarr(store.url, consolidated=False)
    # NumPy's strings of any length are new, and much of xarray and pandas does without them.
    texts = {name: (value.dims, value.to_numpy().astype(object), value.attrs)
             for name, value in dataset.coords.items() if value.dtype.kind == "T"}
    ordered = [variable.name for variable in TEMPLATE if variable.name in dataset]
    return dataset.assign_coords(texts)[ordered]
